"""Lens models and the stereo head's calibration (the paper's eq. 1 and 2, Table 1).

Two image planes are used. `px`: the raw image as the camera delivers it, (u, v) in px, pixel (0, 0) is the centre of
the first pixel. `xy`: the ideal, distortion-free image at unit focal length, x' = x_c / z_c, y' = y_c / z_c of a point
in the camera's frame (x right, y down, z forward). Points are undistorted, never images.

The paper's eq. (1) leads from raw to ideal in closed form; `project`, its inverse, is Newton's method.
"""

import dataclasses as dc
import pathlib
from typing import Any, Protocol

import cv2
import numpy as np
import yaml

from valve_drake.checks import ConfigError, require, require_in

_NEWTON_STEPS = 6  # quadratic: 1e-12 px after four steps for any lens that `check` lets pass


class LensModel(Protocol):
    """What the program needs of a lens, whatever its formula."""

    width: int  # of the raw image [px]
    height: int

    def normalize(self, px: np.ndarray) -> np.ndarray:
        """Raw px (..., 2) -> ideal xy (..., 2)."""

    def normalize_jacobian(self, px: np.ndarray) -> np.ndarray:
        """d xy / d px at raw px (..., 2) -> (..., 2, 2) [1/px]."""

    def project(self, xy: np.ndarray) -> np.ndarray:
        """Ideal xy (..., 2) -> raw px (..., 2)."""

    def focal(self) -> float:
        """Pixels for one unit of xy near the image's centre (mean of both directions) [px]."""


@dc.dataclass(frozen=True)
class Lens:
    """The paper's camera, eq. (1) and (2): radial distortion of first order with own factors in u and v.

    u' - u_0 = (u - u_0)(1 + k_u r^2), r^2 = (u - u_0)^2 + (v - v_0)^2;  x' = (u' - u_0) / k_x; v and y' likewise.
    """

    k_u: float  # distortion [1/px^2]
    k_v: float
    k_x: float  # magnification [px]
    k_y: float
    u_0: float  # image point of the optical axis [px]
    v_0: float
    width: int = 640
    height: int = 480

    def check(self, key: str = "lens") -> None:
        """Raises ConfigError unless eq. (1) can be inverted over the whole image."""
        for name in ("k_u", "k_v", "k_x", "k_y", "u_0", "v_0"):
            value = getattr(self, name)
            ok = isinstance(value, int | float) and np.isfinite(value) and (value > 0 or name not in ("k_x", "k_y"))
            require(ok, f"{key}.{name}", "a finite number, > 0 for k_x and k_y", value)
        _check_size(self, key)
        du, dv = max(self.u_0, self.width - self.u_0), max(self.v_0, self.height - self.v_0)
        worst = 3 * min(self.k_u, self.k_v) * (du * du + dv * dv)
        require(worst > -0.9, f"{key}.k_u, k_v", "so small that the image does not fold back", (self.k_u, self.k_v))

    def normalize(self, px: np.ndarray) -> np.ndarray:
        u, v, rr = self._from_axis(px)
        out = np.empty(np.shape(px))
        out[..., 0], out[..., 1] = u * (1 + self.k_u * rr) / self.k_x, v * (1 + self.k_v * rr) / self.k_y
        return out

    def normalize_jacobian(self, px: np.ndarray) -> np.ndarray:
        u, v, rr = self._from_axis(px)
        out = np.empty((*np.shape(px), 2))
        out[..., 0, 0] = (1 + self.k_u * (rr + 2 * u * u)) / self.k_x
        out[..., 1, 1] = (1 + self.k_v * (rr + 2 * v * v)) / self.k_y
        uv = 2 * u * v
        out[..., 0, 1], out[..., 1, 0] = self.k_u / self.k_x * uv, self.k_v / self.k_y * uv
        return out

    def project(self, xy: np.ndarray) -> np.ndarray:
        # Eq. (1) has one unknown, r^2: with it, u - u_0 = (u' - u_0) / (1 + k_u r^2), and v likewise.
        u, v = self.k_x * xy[..., 0], self.k_y * xy[..., 1]
        uu, vv = u * u, v * v
        rr = uu + vv
        rr = rr / ((1 + self.k_u * rr) * (1 + self.k_v * rr))
        for _ in range(_NEWTON_STEPS):
            by_u, by_v = 1 + self.k_u * rr, 1 + self.k_v * rr
            of_u, of_v = uu / (by_u * by_u), vv / (by_v * by_v)
            slope = 1 + 2 * (self.k_u * of_u / by_u + self.k_v * of_v / by_v)
            step = (of_u + of_v - rr) / slope
            rr = rr + step
            if np.abs(step).max(initial=0.0) < 1e-3:  # the next one would be its square times k, some 1e-12
                break
        out = np.empty(np.shape(xy))
        out[..., 0], out[..., 1] = u / (1 + self.k_u * rr) + self.u_0, v / (1 + self.k_v * rr) + self.v_0
        return out

    def focal(self) -> float:
        return float(np.sqrt(self.k_x * self.k_y))

    def _from_axis(self, px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """u - u_0, v - v_0 and r^2 of eq. (1)."""
        px = np.asarray(px, float)
        u, v = px[..., 0] - self.u_0, px[..., 1] - self.v_0
        return u, v, u * u + v * v


@dc.dataclass(frozen=True, eq=False)
class OpenCvLens:
    """OpenCV's camera: K (3, 3) [px] and dist, the 4 to 14 coefficients of cv2.undistortPoints."""

    K: np.ndarray
    dist: np.ndarray
    width: int = 640
    height: int = 480

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.array(self.K, float).reshape(3, 3))
        object.__setattr__(self, "dist", np.array(self.dist, float).ravel())

    def check(self, key: str = "lens") -> None:
        """Raises ConfigError for numbers that are no camera."""
        ok = np.isfinite(self.K).all() and self.K[0, 0] > 0 and self.K[1, 1] > 0 and self.K[2, 2] == 1
        require(bool(ok), f"{key}.K", "finite with positive focal lengths and K[2][2] = 1", self.K.tolist())
        ok = np.isfinite(self.dist).all() and len(self.dist) in (0, 4, 5, 8, 12, 14)
        require(bool(ok), f"{key}.dist", "4, 5, 8, 12 or 14 finite numbers", self.dist.tolist())
        _check_size(self, key)

    def normalize(self, px: np.ndarray) -> np.ndarray:
        flat = np.ascontiguousarray(px, float).reshape(-1, 1, 2)
        if len(flat) == 0:
            return np.zeros_like(px, dtype=float)
        end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 1e-10)
        return cv2.undistortPointsIter(flat, self.K, self.dist, None, None, end).reshape(np.shape(px))

    def normalize_jacobian(self, px: np.ndarray) -> np.ndarray:
        """The inverse of the projection's analytic Jacobian at the same point."""
        xy = self.normalize(px).reshape(-1, 2)
        if len(xy) == 0:
            return np.zeros((*np.shape(px), 2))
        points = np.column_stack([xy, np.ones(len(xy))])
        J = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.K, self.dist)[1][:, 3:5]  # by t_x, t_y at z = 1
        return np.linalg.inv(J.reshape(-1, 2, 2)).reshape(*np.shape(px), 2)

    def project(self, xy: np.ndarray) -> np.ndarray:
        flat = np.asarray(xy, float).reshape(-1, 2)
        if len(flat) == 0:
            return np.zeros_like(xy, dtype=float)
        points = np.column_stack([flat, np.ones(len(flat))])
        px = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.K, self.dist)[0]
        return px.reshape(np.shape(xy))

    def focal(self) -> float:
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))


def distortion_maps(lens: LensModel, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maps for cv2.remap that turn an ideal pinhole image into this lens's raw image.

    K (3, 3) is the pinhole that made the ideal image, in OpenCV's pixel convention. Both maps are (height, width)
    float32. Eq. (1) itself is the look-up: for every raw pixel it says which ideal point it sees.
    """
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(float)
    xy = lens.normalize(np.stack([u, v], -1))
    ideal = xy @ np.asarray(K, float)[:2, :2].T + np.asarray(K, float)[:2, 2]
    return ideal[..., 0].astype(np.float32), ideal[..., 1].astype(np.float32)


@dc.dataclass(frozen=True, eq=False)
class StereoHead:
    """Calibration of the head: both lenses, and X_LR (3, 4), the right camera in the left one [m]."""

    left: LensModel
    right: LensModel
    X_LR: np.ndarray
    rms_px: float = 0.0  # residual of the calibration's own corners, 0 where unknown: what pixels are worth in 3D

    def __post_init__(self) -> None:
        X = np.array(self.X_LR, float)
        R = X[:, :3]
        rigid = X.shape == (3, 4) and np.isfinite(X).all() and np.abs(R @ R.T - np.eye(3)).max() < 1e-4
        require(bool(rigid and np.linalg.det(R) > 0), "head.X_LR", "a 3x4 rigid transform [R | p]", X.tolist())
        X.setflags(write=False)
        object.__setattr__(self, "X_LR", X)

    def lenses(self) -> tuple[LensModel, LensModel]:
        return self.left, self.right


def load_head(path: str | pathlib.Path) -> StereoHead:
    """Reads a head calibration (see `save_head`). Raises ConfigError naming the file and the key."""
    data = read_yaml(path)
    rms_px = data.pop("rms_px", 0.0)
    _require_keys(data, {"left", "right", "X_LR"}, f"calibration {path}")
    require_in(rms_px, 0.0, 1e6, f"calibration {path}: rms_px")
    try:
        X_LR = np.array(data["X_LR"], float)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"calibration {path}: X_LR must be 3 rows of 4 numbers") from error
    require(X_LR.shape == (3, 4), f"calibration {path}: X_LR", "3 rows of 4 numbers", data["X_LR"])
    lenses = [lens_from(data[side], f"calibration {path}: {side}") for side in ("left", "right")]
    return StereoHead(lenses[0], lenses[1], X_LR, rms_px=float(rms_px))


def save_head(head: StereoHead, path: str | pathlib.Path, comment: str = "") -> None:
    """Writes the calibration as plain YAML; every number survives the round trip bit for bit."""
    data: dict[str, Any] = {"left": lens_to(head.left), "right": lens_to(head.right), "X_LR": head.X_LR.tolist()}
    if head.rms_px:
        data["rms_px"] = float(head.rms_px)
    write_yaml(data, path, comment)


def read_yaml(path: str | pathlib.Path) -> dict[str, Any]:
    """The mapping in a YAML file of a calibration. Raises ConfigError naming the file."""
    try:
        data = yaml.safe_load(pathlib.Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"calibration {path}: cannot be read ({error.__class__.__name__})") from error
    except yaml.YAMLError as error:
        line = f" at line {error.problem_mark.line + 1}" if getattr(error, "problem_mark", None) else ""
        raise ConfigError(f"calibration {path}: not YAML{line}") from error
    require(isinstance(data, dict), f"calibration {path}", "a mapping with left, right and X_LR", type(data).__name__)
    return data


def write_yaml(data: dict[str, Any], path: str | pathlib.Path, comment: str = "") -> None:
    """Writes a mapping below lines of comment. Raises ConfigError naming the file."""
    lines = "".join(f"# {line}\n" for line in comment.splitlines())
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=110)
    try:
        pathlib.Path(path).write_text(lines + text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.__class__.__name__})") from error


def lens_from(data: Any, key: str) -> LensModel:
    """The lens of a mapping made by `lens_to`. Raises ConfigError naming `key`."""
    require(isinstance(data, dict), key, "a mapping", data)
    kind = OpenCvLens if "K" in data else Lens
    _require_keys(data, {f.name for f in dc.fields(kind)}, key)
    try:
        lens = kind(**data)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{key}: {error}") from error
    lens.check(key)
    return lens


def lens_to(lens: LensModel) -> dict[str, Any]:
    """The lens's fields as plain numbers and lists."""
    values = dc.asdict(lens)
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}


def _require_keys(data: dict, names: set[str], key: str) -> None:
    missing, unknown = sorted(names - set(data)), sorted(map(str, set(data) - names))
    if missing or unknown:
        parts = [f"lacks {', '.join(missing)}"] * bool(missing) + [f"has unknown {', '.join(unknown)}"] * bool(unknown)
        raise ConfigError(f"{key} {' and '.join(parts)}")


def _check_size(lens: LensModel, key: str) -> None:
    for name in ("width", "height"):
        value = getattr(lens, name)
        require(isinstance(value, int) and 16 <= value <= 16384, f"{key}.{name}", "a whole number of 16..16384", value)
