"""What the hands were taught: the reference image of each green mark, as its feature, and the image Jacobian there."""

import dataclasses as dc
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from valve_drake import outputs, yaml_file
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
    """Both hands' references. Raises ConfigError that names the file and the key, and never shows a foreign file."""
    source = f"taught references {path}"
    data = yaml_file.read(path, source=source)
    if not isinstance(data, dict) or set(data) != set(SIDES):
        raise ConfigError(f"{source}: no taught references: must be a mapping of left and right")
    out = {}
    for side in SIDES:
        values: dict[str, Any] = {}
        for name, shape in _SHAPES.items():
            key = f"taught references {path}: {side}.{name}"
            try:
                value = np.array(data[side][name], float)
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise ConfigError(f"{key} must be {shape} numbers") from error
            require(
                value.shape == shape and bool(np.isfinite(value).all()), key, f"{shape} finite numbers", value.tolist()
            )
            values[name] = float(value) if shape == () else value
        require(float(values["area"]) > 0, f"taught references {path}: {side}.area", "> 0", values["area"])
        try:
            out[side] = TaughtReference(**values)
        except ConfigError as error:
            raise ConfigError(f"taught references {path}: {side}: {error}") from error
    return out


def save_taught(taught: Mapping[str, TaughtReference], path: str | pathlib.Path, comment: str) -> None:
    """Writes what `load_taught` reads."""
    data = {side: {name: np.asarray(getattr(taught[side], name)).tolist() for name in _SHAPES} for side in SIDES}
    outputs.write(path, yaml_file.dump(data, comment))
