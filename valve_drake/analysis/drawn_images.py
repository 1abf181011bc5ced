"""Images drawn from geometry, exact to a thousandth of a pixel, for the experiments on the estimator.

Every pixel is the integral of a scene of flat shapes, blurred by the lens, over the pixel's square. Along a straight
edge at the signed distance d that integral has a closed form: the step, convolved with a Gaussian and with the two
boxes of the pixel's projection onto the normal (n_u, n_v). At a corner two edges meet; unless they are perpendicular,
their product is corrected by the series of the bivariate normal distribution. Nothing is sampled: a renderer's
anti-aliasing takes a few samples in each pixel, which shifts whole sides by 0.02 px, ten times the estimator's error.
"""

import functools
import math
from collections.abc import Iterator

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import LensModel
from valve_drake.perception.marker import NEXT, Marker

RED, GREEN, PLATE, WALL, METAL = (190, 30, 28), (20, 140, 45), (190, 190, 186), (118, 122, 126), (90, 92, 96)
_ERF = np.frompyfunc(math.erf, 1, 1)
_NEAR = 0.05  # shapes nearer to the camera than this are not drawn [m]
_STEP = 1 / 128  # of the tables below [px]
_UNIT = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)


@functools.lru_cache(maxsize=8)
def _grid(lens: LensModel) -> tuple[np.ndarray, np.ndarray]:
    """Every pixel's ideal xy (H, W, 2) and d xy / d px (H, W, 2, 2)."""
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(float)
    px = np.stack([u, v], -1)
    return lens.normalize(px), lens.normalize_jacobian(px)


def _second_integral(x: np.ndarray, s: float) -> np.ndarray:
    """The second integral over x of the blurred step Phi(x / s)."""
    phi = np.exp(-0.5 * (x / s) ** 2) / math.sqrt(2 * math.pi)
    return (x * x + s * s) / 2 * (1 + np.asarray(_ERF(x / (s * math.sqrt(2))), float)) / 2 + x * s / 2 * phi


@functools.lru_cache(maxsize=4096)
def _profile(n_u: float, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Light of a pixel at distance d inside an edge of normal (n_u, sqrt(1 - n_u^2)): d and the light, 0..1."""
    a, b = max(abs(n_u), 1e-3), max(math.sqrt(max(1 - n_u * n_u, 0)), 1e-3)
    reach = 6 * blur + 0.75
    d = np.arange(-reach, reach + _STEP, _STEP)
    parts = [_second_integral(d + k, blur) for k in ((a + b) / 2, (a - b) / 2, (b - a) / 2, -(a + b) / 2)]
    return d, (parts[0] - parts[1] - parts[2] + parts[3]) / (a * b)


class Canvas:
    """One camera's image while it is drawn, back to front. blur: of the lens, standard deviation [px]."""

    def __init__(self, lens: LensModel, blur: float = 0.7):
        self.lens, self.blur = lens, max(blur, 0.05)
        self.image = np.empty((lens.height, lens.width, 3))
        self.image[:] = WALL
        self._xy, self._jacobian = _grid(lens)

    def rectangle(self, X_CS: np.ndarray, color: tuple[float, ...], half: tuple[float, float]) -> None:
        """In the plane z = 0 of S, S in this camera, about its origin; half sizes [m]."""
        self._paint(color, self.coverage(X_CS, half))

    def coverage(
        self, X_CS: np.ndarray, half: tuple[float, float], box: tuple[slice, slice] | None = None
    ) -> tuple[np.ndarray, tuple[slice, slice]] | None:
        """How much of each pixel (0..1) within `box` a rectangle covers; None if it is out of sight."""
        P = frames.apply(X_CS, _UNIT * [*half, 0])
        box = box or self._box(P)
        if box is None or (P[:, 2] < _NEAR).any():
            return None
        sides = list(self._distances(P, box))
        light = [np.interp(d, *_profile(n[0], self.blur)) for d, n in sides]
        out = light[0] * light[1] * light[2] * light[3]
        spread = math.hypot(self.blur, math.sqrt(1 / 12))  # of the blur and of the pixel
        for i, j in enumerate(NEXT):
            (a, n), (b, m) = sides[i], sides[j]
            near = (np.abs(a) < 6 * spread) & (np.abs(b) < 6 * spread)
            a, b, rho = a[near] / spread, b[near] / spread, n[0] * m[0] + n[1] * m[1]
            tail = 1 + rho / 2 * a * b + rho**2 / 6 * (a * a - 1) * (b * b - 1)
            joint = rho / (2 * math.pi) * np.exp(-(a * a + b * b) / 2) * tail
            out[near] += joint * light[(i + 2) % 4][near] * light[(i + 3) % 4][near]
        return out, box

    def seen(
        self, X_CS: np.ndarray, half: tuple[float, float], box: tuple[slice, slice] | None = None
    ) -> tuple[np.ndarray, tuple[slice, slice]]:
        """As `coverage`, for a rectangle in sight. Raises ValueError for one out of sight."""
        covered = self.coverage(X_CS, half, box)
        if covered is None:
            raise ValueError("the rectangle is out of the camera's sight")
        return covered

    def off_corners(
        self, X_CS: np.ndarray, half: tuple[float, float], box: tuple[slice, slice], margin: float
    ) -> np.ndarray:
        """Which pixels within `box` lie more than `margin` [px] inside of three sides of a rectangle, or of four."""
        distances = [d for d, _ in self._distances(frames.apply(X_CS, _UNIT * [*half, 0]), box)]
        return np.sort(distances, axis=0)[1] > margin

    def _distances(self, P: np.ndarray, box: tuple[slice, slice]) -> Iterator[tuple[np.ndarray, tuple[float, float]]]:
        """For each side of P (4, 3): the pixels' distance inside of it [px]; its unit normal (u, v) at its middle."""
        xy, A = self._xy[box], self._jacobian[box]
        q = P / P[:, 2:]
        turn = np.sign(np.cross(q[1] - q[0], q[2] - q[1])[2])
        for i, j in enumerate(NEXT):
            line = np.cross(q[i], q[j]) * turn
            g_u = line[0] * A[..., 0, 0] + line[1] * A[..., 1, 0]
            g_v = line[0] * A[..., 0, 1] + line[1] * A[..., 1, 1]
            slope = np.hypot(g_u, g_v)
            # A lens bends an edge noticeably only across the whole image: one normal is enough for a side.
            near = np.abs(xy - (q[i, :2] + q[j, :2]) / 2).sum(-1).argmin()
            n_u, n_v = (round(float(g.flat[near] / slope.flat[near]), 4) for g in (g_u, g_v))
            yield (xy @ line[:2] + line[2]) / slope, (n_u, n_v)

    def disc(self, X_CS: np.ndarray, color: tuple[float, ...], half: tuple[float, float]) -> None:
        """An ellipse. Nothing is measured at its edge, so the pixel's square is approximated by a little more blur."""
        P = frames.apply(X_CS, _UNIT * [*half, 0])
        box = self._box(P)
        if box is None or min(box[0].stop - box[0].start, box[1].stop - box[1].start) < 2:
            return
        H = np.linalg.inv(np.column_stack([X_CS[:, 0], X_CS[:, 1], X_CS[:, 3]]))
        xy = self._xy[box]
        q = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], -1) @ H.T
        radius = np.hypot(q[..., 0] / q[..., 2] / half[0], q[..., 1] / q[..., 2] / half[1])
        slope = np.hypot(*np.gradient(radius))
        self._paint(color, (np.interp((1 - radius) / np.maximum(slope, 1e-9), *_profile(1.0, self.blur)), box))

    def shade(self, X_CS: np.ndarray, factor: float, soft: float) -> None:
        """Darkens what lies on the side x > 0 of S's y axis; the shadow's edge is `soft` wide [px]."""
        P = frames.apply(X_CS, np.array([[0, -0.1, 0], [0, 0.1, 0]]))
        line = np.cross(*(P / P[:, 2:]))
        d = -(self._xy @ line[:2] + line[2]) / np.linalg.norm(line[:2]) * self.lens.focal()
        inside = frames.apply(X_CS, np.array([0.1, 0, 0]))
        sign = -np.sign(line @ inside)
        self.image *= (1 - (1 - factor) / (1 + np.exp(-np.clip(4 * sign * d / soft, -50, 50))))[:, :, None]

    def finish(
        self, rng: np.random.Generator | None, noise: float, light: tuple[float, ...] = (1.0, 1.0, 1.0), jpeg: int = 0
    ) -> np.ndarray:
        """The light's colour, white noise [grey levels], rounding, and JPEG of this quality unless 0 -> uint8."""
        image = self.image * np.asarray(light)
        if rng is not None and noise > 0:
            image += noise * rng.standard_normal(image.shape, dtype=np.float32)
        image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        if not jpeg:
            return image
        flags = [cv2.IMWRITE_JPEG_QUALITY, jpeg, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        data = cv2.imencode(".jpg", image[:, :, ::-1], flags)[1]
        return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[:, :, ::-1])

    def _box(self, P: np.ndarray) -> tuple[slice, slice] | None:
        """Rows and columns that a shape's corners (4, 3) and their blur reach."""
        if (P[:, 2] < _NEAR).any():
            return None
        px = self.lens.project(P[:, :2] / P[:, 2:])
        reach = 6 * self.blur + 2
        u0, v0 = np.maximum(np.floor(px.min(0) - reach), 0).astype(int)
        u1, v1 = np.minimum(np.ceil(px.max(0) + reach) + 1, [self.lens.width, self.lens.height]).astype(int)
        return (slice(v0, v1), slice(u0, u1)) if u1 > u0 and v1 > v0 else None

    def _paint(self, color: tuple[float, ...], covered: tuple[np.ndarray, tuple[slice, slice]] | None) -> None:
        if covered is not None:
            cover, box = covered
            part = self.image[box]
            part += cover[:, :, None] * (np.asarray(color, float) - part)


def draw_board(canvas: Canvas, X_CV: np.ndarray, marker: Marker) -> None:
    """The paper's target alone: the red rectangle on a light board twice its size."""
    canvas.rectangle(X_CV, PLATE, (marker.size[0], marker.size[1]))
    canvas.rectangle(X_CV, RED, (marker.size[0] / 2, marker.size[1] / 2))


def draw_bar(canvas: Canvas, X_CV: np.ndarray, marker: Marker) -> None:
    """The valve: a bar with green marks, a light round plate, and the red rectangle."""

    def at(x: float, z: float) -> np.ndarray:
        return frames.compose(X_CV, frames.make(np.eye(3), np.array([x, 0, z])))

    r, _, depth = (float(n) for n in marker.marks[0])  # a bar along x
    canvas.rectangle(at(0, depth + 0.001), METAL, (r + 0.03, 0.0125))
    for x in (-r, r):
        canvas.rectangle(at(x, depth), GREEN, (0.020, 0.011))
    plate = 0.75 * max(marker.size)
    canvas.disc(at(0, 0.001), PLATE, (plate, plate))
    canvas.rectangle(X_CV, RED, (marker.size[0] / 2, marker.size[1] / 2))
