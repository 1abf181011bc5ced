"""What the hands were taught: the reference image of each green mark, as its feature, and the image Jacobian there."""

import dataclasses as dc
import pathlib
from collections.abc import Mapping

import numpy as np
import yaml

from valve_drake.checks import ConfigError, require
from valve_drake.messages import SIDES

_SHAPES = {"feature": (3,), "jacobian": (3, 3), "area": (), "corners": (4, 2)}


@dc.dataclass(frozen=True)
class TaughtReference:
    """What one hand was taught: s* (3,), J (3, 3) of image_servo's (2); the mark's area [px^2], corners [px] (4, 2)."""

    feature: np.ndarray
    jacobian: np.ndarray
    area: float
    corners: np.ndarray

    def __post_init__(self) -> None:
        rows = np.linalg.norm(self.jacobian, axis=1, keepdims=True)  # u, v and 1 differ by a focal length
        condition = np.linalg.cond(self.jacobian / np.where(rows > 0, rows, 1.0))
        require(bool(condition < 100), "taught image Jacobian", "well conditioned (< 100)", float(condition))

    def displacement(self, feature: np.ndarray) -> np.ndarray:
        """Eq. (2) of image_servo: the hand off its reference, in its own frame -> (3,) [m]."""
        return np.linalg.solve(self.jacobian, feature - self.feature)

    @property
    def view(self) -> np.ndarray:
        """The wrist camera's view direction in the hand's frame -> unit (3,)."""
        d = -np.linalg.solve(self.jacobian, self.feature)
        return d / np.linalg.norm(d)


def load_taught(path: str | pathlib.Path) -> dict[str, TaughtReference]:
    """Both hands' references. Raises ConfigError that names the file and the key."""
    try:
        data = yaml.safe_load(pathlib.Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"taught references {path}: cannot be read ({type(error).__name__})") from error
    require(
        isinstance(data, dict) and set(data) == set(SIDES),
        f"taught references {path}",
        "a mapping of left and right",
        data,
    )
    out = {}
    for side in SIDES:
        values = {}
        for name, shape in _SHAPES.items():
            key = f"taught references {path}: {side}.{name}"
            try:
                value = np.array(data[side][name], float)
            except (KeyError, TypeError, ValueError) as error:
                raise ConfigError(f"{key} must be {shape} numbers") from error
            require(
                value.shape == shape and bool(np.isfinite(value).all()), key, f"{shape} finite numbers", value.tolist()
            )
            values[name] = float(value) if shape == () else value
        require(values["area"] > 0, f"taught references {path}: {side}.area", "> 0", values["area"])
        try:
            out[side] = TaughtReference(**values)
        except ConfigError as error:
            raise ConfigError(f"taught references {path}: {side}: {error}") from error
    return out


def save_taught(taught: Mapping[str, TaughtReference], path: str | pathlib.Path, comment: str) -> None:
    """Writes what `load_taught` reads."""
    data = {side: {name: np.asarray(getattr(taught[side], name)).tolist() for name in _SHAPES} for side in SIDES}
    lines = "".join(f"# {line}\n" for line in comment.splitlines())
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=110)
    pathlib.Path(path).write_text(lines + text, encoding="utf-8")
