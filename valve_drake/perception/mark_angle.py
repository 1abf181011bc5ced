"""How far the valve is turned, by its green marks alone: for a marker on the panel, which does not turn with it.

Every green spot that lies where some mark passes as the valve turns proposes an angle. The angle that most marks agree
on is the one; of several that are as good, the one nearest to the last. A valve whose marks look the same after a part
of a turn leaves just that part open.
"""

import math
from typing import NamedTuple

import numpy as np

from valve_drake import frames
from valve_drake.perception.marker import MARK, Marker
from valve_drake.perception.views import View

_OFF = 0.12  # a spot so far from a mark's circle is another thing [radii]
_ALIKE = 0.1  # marks that propose angles so near to each other agree: the marker's pose is as good as that [rad]
_TOGETHER = 0.03  # the mean is of those that are so near to it [rad]
_SPOT = 0.7  # standard deviation of a green spot's middle [px]
_EDGE = 2.0  # a mark that comes nearer to the image's border may be cut off, and then its middle is another [px]


class MarkAngle(NamedTuple):
    """Counter-clockwise as the robot sees it, from where the marks are at `Marker.marks`."""

    angle: float  # [rad]
    sigma: float  # standard deviation [rad]
    marks: int  # that agree, over all cameras


def mark_angle(views: list[View], R: np.ndarray, p: np.ndarray, marker: Marker, near: float = 0.0) -> MarkAngle | None:
    """The angle by the marks in these images, the marker at R, p in L; None: no mark is seen.

    near: where it is looked for first [rad].
    """
    assert marker.X_VA is not None
    X_LA = frames.compose(frames.make(R, p), marker.X_VA)
    marks, along = frames.apply(frames.inverse(marker.X_VA), marker.marks), marker.along @ marker.X_VA[:, :3]
    seen: list[tuple[float, float, tuple[int, int]]] = []  # angle, its variance, camera and mark
    for camera, view in enumerate(views):
        X_CA = frames.compose(view.X_CL, X_LA)
        X_AC = frames.inverse(X_CA)
        rays = np.column_stack([view.green, np.ones(len(view.green))]) @ X_AC[:, :3].T
        for k, mark in enumerate(marks):
            radius, at = math.hypot(mark[0], mark[1]), math.atan2(mark[1], mark[0])
            far = mark[2] - X_AC[2, 3]
            for ray, room in zip(rays, view.room):
                scale = far / ray[2] if abs(ray[2]) > 1e-6 else 0.0
                x, y = X_AC[:2, 3] + scale * ray[:2]
                if scale <= 0 or abs(math.hypot(x, y) / radius - 1) >= _OFF:
                    continue
                angle = at - math.atan2(y, x)
                if _whole(frames.rot_z(-angle) @ along[k], np.array([x, y, mark[2]]), X_CA, view.focal, room):
                    sigma = _SPOT / view.focal * scale / radius
                    seen.append((frames.wrap(angle), sigma**2, (camera, k)))
    if not seen:
        return None
    angles, variances = (np.array(values) for values in list(zip(*seen))[:2])
    apart = np.abs(np.array([[frames.wrap(b - a) for b in angles.tolist()] for a in angles.tolist()]))
    agree = [len({mark for near_by, (*_, mark) in zip(row, seen) if near_by < _ALIKE}) for row in apart]
    most = max(agree)
    best = min(
        (i for i, n in enumerate(agree) if n == most), key=lambda i: (abs(frames.wrap(float(angles[i]) - near)), i)
    )
    own = apart[best] < _ALIKE
    off = np.array([frames.wrap(a - angles[best]) for a in angles.tolist()])
    middle = sorted(off[own].tolist())[own.sum() // 2]
    own &= np.abs(off - middle) < _TOGETHER
    weights = own / variances
    mean = float(weights @ off / weights.sum())
    scatter = float(weights @ (off - mean) ** 2 / weights.sum())
    sigma = math.sqrt(1 / weights.sum() + scatter / own.sum())
    turns = round((near - angles[best] - mean) / (2 * math.pi))
    return MarkAngle(float(angles[best]) + mean + 2 * math.pi * turns, sigma, most)


def _whole(along: np.ndarray, middle: np.ndarray, X_CA: np.ndarray, focal: float, room: np.ndarray) -> bool:
    """Whether a mark at `middle`, its longer side `along`, both in A, is in the image whole. room: see View."""
    length, width = MARK[0] * along, MARK[1] * np.array([-along[1], along[0], 0.0])
    corners = [middle + i * length + k * width for i in (-0.5, 0.5) for k in (-0.5, 0.5)]
    P = frames.apply(X_CA, np.array([middle, *corners]))
    px = focal * P[:, :2] / P[:, 2:]
    off = px[1:] - px[0]
    return bool((np.concatenate([-off.min(0), off.max(0)]) + _EDGE < room).all())
