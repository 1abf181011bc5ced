"""Lens models and the stereo head's calibration (the paper's eq. 1 and 2, Table 1).

Two image planes are used. `px`: the raw image as the camera delivers it, (u, v) in px, pixel (0, 0) is the centre of
the first pixel. `xy`: the ideal, distortion-free image at unit focal length, x' = x_c / z_c, y' = y_c / z_c of a point
in the camera's frame (x right, y down, z forward). Points are undistorted, never images.

The paper's eq. (1) leads from raw to ideal in closed form; `project`, its inverse, is Newton's method.
"""

import dataclasses as dc
import math
import pathlib
from collections.abc import Sequence, Set
from typing import Any, Protocol, TypeAlias

import cv2
import numpy as np

from valve_drake import outputs, yaml_file
from valve_drake.checks import ConfigError, is_number, require, require_in, shown

SigmaMap: TypeAlias = Sequence[Sequence[float]] | None  # rows from top to bottom, evenly over the image [px]

KNOWN = 1.0  # a lens counts as known at a pixel up to this standard deviation; raise it for coarse work [px]
_MOST_PX = 1e6  # of a focal length, and of the principal point's distance from the image
_NEWTON_STEPS = 6  # quadratic: 1e-12 px after four steps for any lens that `check` lets pass


class LensModel(Protocol):
    """What the program needs of a lens, whatever its formula."""

    @property
    def width(self) -> int:
        """Of the raw image [px]."""

    @property
    def height(self) -> int:
        """Of the raw image [px]."""

    def normalize(self, px: np.ndarray) -> np.ndarray:
        """Raw px (..., 2) -> ideal xy (..., 2)."""

    def normalize_jacobian(self, px: np.ndarray) -> np.ndarray:
        """d xy / d px at raw px (..., 2) -> (..., 2, 2) [1/px]."""

    def project(self, xy: np.ndarray) -> np.ndarray:
        """Ideal xy (..., 2) -> raw px (..., 2)."""

    def magnification(self) -> tuple[float, float]:
        """Pixels for one unit of xy near the image's centre, along u and along v [px]."""

    def focal(self) -> float:
        """The geometric mean of `magnification` [px]."""

    def sigma(self, px: np.ndarray) -> np.ndarray:
        """Standard deviation of where the lens puts a point seen at raw px (..., 2): (...,) [px]; 0 if not known.

        It is that of the calibration: small where its boards were, large where they were not.
        """

    def __hash__(self) -> int:
        """Lenses are immutable: what is computed from one may be cached by it."""


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
    sigma_px: SigmaMap = dc.field(default=None, compare=False, repr=False)

    def check(self, key: str = "lens") -> None:
        """Raises ConfigError unless eq. (1) can be inverted over the whole image."""
        for name in ("k_u", "k_v"):
            require(is_number(getattr(self, name)), f"{key}.{name}", "a finite number", getattr(self, name))
        for name in ("k_x", "k_y"):
            require_in(getattr(self, name), 1.0, _MOST_PX, f"{key}.{name}")
        for name in ("u_0", "v_0"):
            require_in(getattr(self, name), -_MOST_PX, _MOST_PX, f"{key}.{name}")
        _check_size(self, key)
        _check_sigma(self.sigma_px, key)
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
            if np.abs(step).max(initial=0.0) < 1e-3:  # convergence is quadratic: the next step would be some 1e-12
                break
        out = np.empty(np.shape(xy))
        out[..., 0], out[..., 1] = u / (1 + self.k_u * rr) + self.u_0, v / (1 + self.k_v * rr) + self.v_0
        return out

    def magnification(self) -> tuple[float, float]:
        return self.k_x, self.k_y

    def focal(self) -> float:
        return float(np.sqrt(self.k_x * self.k_y))

    def sigma(self, px: np.ndarray) -> np.ndarray:
        return _sigma_at(self.sigma_px, self.width, self.height, px)

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
    sigma_px: SigmaMap = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.array(self.K, float).reshape(3, 3))
        object.__setattr__(self, "dist", np.array(self.dist, float).ravel())

    def check(self, key: str = "lens") -> None:
        """Raises ConfigError for numbers that are no camera, or one that folds back inside its image."""
        K, dist = self.K, self.dist
        require(bool(np.isfinite(K).all()), f"{key}.K", "3 rows of 3 finite numbers", K.tolist())
        require(K[0, 1] == 0 and K[1, 0] == 0, f"{key}.K", "without skew: K[0][1] = 0", K.tolist())
        require(K[2].tolist() == [0, 0, 1], f"{key}.K", "with [0, 0, 1] as its last row", K.tolist())
        focal = bool((np.diag(K)[:2] >= 1).all() and (np.diag(K)[:2] <= _MOST_PX).all())
        require(focal, f"{key}.K", f"of focal lengths within 1 to {_MOST_PX:g} px", K.tolist())
        require(bool((np.abs(K) <= _MOST_PX).all()), f"{key}.K", f"within {_MOST_PX:g}", K.tolist())
        ok = np.isfinite(dist).all() and (np.abs(dist) <= 1e4).all() and len(dist) in (0, 4, 5, 8, 12, 14)
        require(bool(ok), f"{key}.dist", "4, 5, 8, 12 or 14 finite numbers up to 10000", dist.tolist())
        _check_size(self, key)
        _check_sigma(self.sigma_px, key)
        reach, corner = self.radial_reach()
        if reach < corner:
            raise ConfigError(
                f"{key}.dist: the lens folds back {reach:.0f} px from its centre, inside the image (its corner is "
                f"{corner:.0f} px away), got {shown(dist.tolist())}"
            )

    def radial_reach(self) -> tuple[float, float]:
        """(radius up to which the projection is one to one, radius of the image's farthest corner) [px].

        About the principal point. Beyond the first radius a pixel belongs to no ray, or to two.
        """
        k1, k2, _, _, k3, k4, k5, k6 = np.append(self.dist, np.zeros(8))[:8] if len(self.dist) else np.zeros(8)
        r = np.tan(np.linspace(0, math.radians(89.9), 4000))
        rr = r * r
        seen = r * (1 + rr * (k1 + rr * (k2 + rr * k3))) / (1 + rr * (k4 + rr * (k5 + rr * k6)))
        falls = np.flatnonzero(~(np.diff(seen) > 0))
        last = seen[falls[0]] if len(falls) else seen[-1]
        center, f = self.K[:2, 2], np.diag(self.K)[:2]
        farthest = np.maximum(np.abs(center), np.abs([self.width - 1, self.height - 1] - center))
        return float(last * f.mean()), float(np.linalg.norm(farthest / f) * f.mean())

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
        # At z = 1 the derivatives by t_x, t_y are those by x, y.
        J = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.K, self.dist)[1][:, 3:5]
        return np.linalg.inv(J.reshape(-1, 2, 2)).reshape(*np.shape(px), 2)

    def project(self, xy: np.ndarray) -> np.ndarray:
        flat = np.asarray(xy, float).reshape(-1, 2)
        if len(flat) == 0:
            return np.zeros_like(xy, dtype=float)
        points = np.column_stack([flat, np.ones(len(flat))])
        px = cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.K, self.dist)[0]
        return px.reshape(np.shape(xy))

    def magnification(self) -> tuple[float, float]:
        return float(self.K[0, 0]), float(self.K[1, 1])

    def focal(self) -> float:
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    def sigma(self, px: np.ndarray) -> np.ndarray:
        return _sigma_at(self.sigma_px, self.width, self.height, px)


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
    rms_px: float = 0.0  # rms residual of the calibration's own corners [px]; 0: unknown

    def __post_init__(self) -> None:
        X = np.array(self.X_LR, float)
        check_rigid(X, "head.X_LR")
        X.setflags(write=False)
        object.__setattr__(self, "X_LR", X)

    def lenses(self) -> tuple[LensModel, LensModel]:
        return self.left, self.right


def load_head(path: str | pathlib.Path) -> StereoHead:
    """Reads a head calibration (see `save_head`). Raises ConfigError naming the file and the key."""
    key = f"calibration {path}"
    data = yaml_file.read(path, source=key)
    if not isinstance(data, dict):  # its content is not shown: it may be any file of the user's
        raise ConfigError(f"{key} must be a mapping with left, right and X_LR")
    return head_from(data, key)


def head_from(data: dict[str, Any], key: str) -> StereoHead:
    """The head of a mapping as `save_head` writes it. Raises ConfigError naming `key`."""
    _require_keys(data, {"left", "right", "X_LR"}, key, optional={"rms_px"})
    rms_px = data.get("rms_px", 0.0)
    require_in(rms_px, 0.0, 1000.0, f"{key}: rms_px")
    rule = "3 rows of 4 finite numbers"
    X_LR = data["X_LR"]
    rows = isinstance(X_LR, list) and len(X_LR) == 3 and all(isinstance(row, list) and len(row) == 4 for row in X_LR)
    require(rows and all(is_number(value) for row in X_LR for value in row), f"{key}: X_LR", rule, X_LR)
    left, right = (lens_from(data[side], f"{key}: {side}") for side in ("left", "right"))
    return head_of(left, right, np.array(X_LR, float), f"{key}: X_LR", float(rms_px))


def head_of(left: LensModel, right: LensModel, X_LR: np.ndarray, key: str, rms_px: float = 0.0) -> StereoHead:
    """The head of two cameras side by side, X_LR (3, 4) [m]. Raises ConfigError naming `key` if it is none."""
    check_rigid(X_LR, key)
    head = StereoHead(left, right, X_LR, rms_px)
    check_baseline(head, key)
    return head


def check_rigid(X: np.ndarray, key: str) -> None:
    """Raises ConfigError naming `key` unless X is a rigid transform (3, 4)."""
    rigid = X.shape == (3, 4) and np.isfinite(X).all() and np.abs(X[:, :3] @ X[:, :3].T - np.eye(3)).max() < 1e-4
    require(bool(rigid and np.linalg.det(X[:, :3]) > 0), key, "a 3x4 rigid transform [R | p]", X.tolist())


def check_baseline(head: StereoHead, key: str) -> None:
    """Raises ConfigError unless the cameras are two, side by side, with a distance in metres."""
    p = head.X_LR[:, 3]
    require(bool(1e-3 <= np.linalg.norm(p) <= 10), key, "of cameras 0.001 to 10 m apart", p.tolist())
    if abs(p[1]) > abs(p[0]):
        raise ConfigError(f"{key}: one camera is above the other, which is not supported: they must be side by side")
    require(bool(p[0] > 0), key, "of a right camera on the right of the left one", p.tolist())


def save_head(head: StereoHead, path: str | pathlib.Path, comment: str = "") -> None:
    """Writes the calibration as plain YAML; every number survives the round trip bit for bit."""
    data: dict[str, Any] = {"left": lens_to(head.left), "right": lens_to(head.right), "X_LR": head.X_LR.tolist()}
    if head.rms_px:
        data["rms_px"] = float(head.rms_px)
    write_yaml(data, path, comment)


def write_yaml(data: dict[str, Any], path: str | pathlib.Path, comment: str = "") -> None:
    """Writes a mapping below lines of comment. Raises OperationFailed."""
    outputs.write(path, yaml_file.dump(data, comment))


def lens_from(data: Any, key: str) -> LensModel:
    """The lens of a mapping made by `lens_to`. Raises ConfigError naming `key`."""
    require(isinstance(data, dict), key, "a mapping", data)
    kind = OpenCvLens if "K" in data else Lens
    _require_keys(data, {f.name for f in dc.fields(kind)} - {"sigma_px"}, key, optional={"sigma_px"})
    for name, rows in (("K", True), ("dist", False)) if kind is OpenCvLens else ():
        value = data[name]
        lists = [row for row in value if isinstance(row, list)] if isinstance(value, list) and rows else [value]
        numbers = all(isinstance(row, list) and all(map(is_number, row)) for row in lists)
        shape = not rows or (isinstance(value, list) and [len(row) for row in lists] == [3] * 3 == [len(value)] * 3)
        require(bool(numbers and shape), f"{key}.{name}", "3 rows of 3 numbers" if rows else "a list of numbers", value)
    lens = kind(**data)
    lens.check(key)
    return lens


def lens_to(lens: Any) -> dict[str, Any]:
    """The lens's fields as plain numbers and lists."""
    values = {f.name: getattr(lens, f.name) for f in dc.fields(lens)}
    return {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in values.items()
        if value is not None
    }


def _require_keys(data: dict[str, Any], names: set[str], key: str, optional: Set[str] = frozenset()) -> None:
    missing, unknown = sorted(names - set(data)), sorted(shown(n)[1:-1] for n in set(data) - names - optional)
    if missing or unknown:
        parts = [f"lacks {', '.join(missing)}"] * bool(missing)
        parts += [f"has unknown {', '.join(unknown[:6])}"] * bool(unknown)
        raise ConfigError(f"{key} {' and '.join(parts)}")


def _check_size(lens: LensModel, key: str) -> None:
    for name in ("width", "height"):
        value = getattr(lens, name)
        ok = isinstance(value, int) and not isinstance(value, bool) and 16 <= value <= 16384
        require(ok, f"{key}.{name}", "a whole number of 16..16384", value)


def _check_sigma(grid: SigmaMap, key: str) -> None:
    if grid is None:
        return
    rows = isinstance(grid, list) and 2 <= len(grid) <= 64 and all(isinstance(row, list) for row in grid)
    ok = rows and 2 <= len(grid[0]) <= 64 and all(len(row) == len(grid[0]) for row in grid)
    ok = ok and all(is_number(value) and 0 <= value <= _MOST_PX for row in grid for value in row)
    require(ok, f"{key}.sigma_px", "2 to 64 rows of as many numbers >= 0", grid)


def _sigma_at(grid: SigmaMap, width: int, height: int, px: np.ndarray) -> np.ndarray:
    """Standard deviation (...,) at px (..., 2) [px], bilinear between points that lie evenly over the image."""
    px = np.asarray(px, float)
    if grid is None:
        return np.zeros(px.shape[:-1])
    g = np.array(grid, float)
    at = px / [width - 1, height - 1] * [g.shape[1] - 1, g.shape[0] - 1]
    at = at.clip(0, [g.shape[1] - 1, g.shape[0] - 1])
    low = np.minimum(at.astype(int), [g.shape[1] - 2, g.shape[0] - 2])
    (x, y), (i, j) = np.moveaxis(at - low, -1, 0), np.moveaxis(low, -1, 0)
    top = g[j, i] * (1 - x) + g[j, i + 1] * x
    return top * (1 - y) + (g[j + 1, i] * (1 - x) + g[j + 1, i + 1] * x) * y
