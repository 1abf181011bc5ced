"""What the hands were taught: the reference image of each green mark, as its feature, and the image Jacobian there."""

import dataclasses as dc
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from valve_drake import outputs, yaml_file
from valve_drake.checks import ConfigError, is_number, require
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


@dc.dataclass(frozen=True)
class MadeFor:
    """What references are good for. robot, marker: numbers that differ where these do; opening [m]."""

    robot: str
    marker: str
    opening: float

    def unlike(self, other: "MadeFor | None") -> str:
        """What of the references' own, `other`, is another; "" if they are good. None: their file does not say."""
        if other is None:
            return "a robot, marker and opening that it does not name"
        names = [name for name in ("robot", "marker") if getattr(self, name) != getattr(other, name)]
        words = [f"another {name}" for name in names]
        if abs(self.opening - other.opening) > 1e-6:
            words.append(f"an opening of {1e3 * other.opening:g} mm, not {1e3 * self.opening:g} mm")
        return " and ".join(words)


def load_made_for(path: str | pathlib.Path) -> MadeFor | None:
    """What the references of a file are good for; None if it does not say. Raises ConfigError."""
    source = f"taught references {path}"
    data = _read(path, source).get("made_for")
    if data is None:
        return None
    rule = "a mapping of robot, marker (texts) and opening [m]"
    try:
        made = MadeFor(**data)
    except TypeError:
        raise ConfigError(f"{source}: made_for must be {rule}") from None
    good = all(isinstance(text, str) and len(text) <= 64 for text in (made.robot, made.marker))
    if not (good and is_number(made.opening)):
        raise ConfigError(f"{source}: made_for must be {rule}")
    return made


def _read(path: str | pathlib.Path, source: str) -> dict[str, Any]:
    data = yaml_file.read(path, source=source)
    if not isinstance(data, dict) or set(data) - {"made_for"} != set(SIDES):
        raise ConfigError(f"{source}: no taught references: must be a mapping of left and right")
    return data


def _has_shape(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether it is lists of finite numbers of this shape; no other text, truth value or file's content is."""
    if not shape:
        return is_number(value)
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(item, shape[1:]) for item in value)


def load_taught(path: str | pathlib.Path) -> dict[str, TaughtReference]:
    """Both hands' references. Raises ConfigError that names the file and the key, and never shows a foreign file."""
    data = _read(path, f"taught references {path}")
    out = {}
    for side in SIDES:
        values: dict[str, Any] = {}
        for name, shape in _SHAPES.items():
            key = f"taught references {path}: {side}.{name}"
            given: Any = data[side].get(name) if isinstance(data[side], dict) else None
            if not _has_shape(given, shape):
                raise ConfigError(f"{key} must be {shape} finite numbers")
            values[name] = float(given) if shape == () else np.array(given, float)
        for key, value in (("area", values["area"]), ("feature[2]", float(values["feature"][2]))):
            require(value > 0, f"taught references {path}: {side}.{key}", "> 0", value)
        try:
            out[side] = TaughtReference(**values)
        except ConfigError as error:
            raise ConfigError(f"taught references {path}: {side}: {error}") from error
    return out


def save_taught(
    taught: Mapping[str, TaughtReference], path: str | pathlib.Path, comment: str, made_for: MadeFor | None = None
) -> None:
    """Writes what `load_taught` and `load_made_for` read."""
    data: dict[str, Any] = {} if made_for is None else {"made_for": dc.asdict(made_for)}
    for side in SIDES:
        data[side] = {name: np.asarray(getattr(taught[side], name)).tolist() for name in _SHAPES}
    outputs.write(path, yaml_file.dump(data, comment))
