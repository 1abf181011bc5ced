"""Which red area is the marker: the candidates of both head cameras matched, left with right.

`match` chooses the pair of candidates, one of each camera, that can be one rectangle of the known size: both centres on
one epipolar line, the same depth by triangulation as by size. `single` chooses for one camera alone. `wrong_size`
measures the sides that are fitted later, by both cameras together.
"""

import dataclasses as dc
import math

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import LensModel, StereoHead
from valve_drake.camera.triangulation import mid_points
from valve_drake.checks import require
from valve_drake.config import Config, number
from valve_drake.messages import MarkerCandidate
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.quadrilateral import COUNTED_FROM, corner_offset, middle, polygon_area

_PINHOLE, _NO_DISTORTION = np.eye(3), np.zeros(4)  # of the ideal image, for OpenCV
_OBLONG = 1.03  # aspect from which a marker is matched with its long sides either way; below, one answer serves both


@dc.dataclass
class StereoPositioningConfig(Config):
    """Scenario key `stereo_positioning`."""

    KEY = "stereo_positioning"
    center_sigma: float = number(0.5, 1e-3, 20.0, "of the red area's centre [px]")
    epipolar_gate: float = number(4.0, 0.1, 100.0, "distance from the epipolar line that is allowed [px]")
    size_gate: float = number(
        0.18, 0.01, 1.0, "relative difference of depth by triangulation and by size that is allowed"
    )
    corner_sigma: float = number(
        1.0, 0.0, 20.0, "of a candidate's coarse corners, widens both gates on small ones [px]"
    )
    shape_gate: float = number(0.08, 0.01, 1.0, "misfit of the coarse corners to the rectangle, as a share of its size")
    side_gate: float = number(
        0.08, 0.01, 10.0, "relative error of a side's length, measured by both cameras together, that is allowed"
    )
    side_sigma: float = number(
        0.3, 0.0, 20.0, "of a fitted corner's disparity, beside the calibration's; widens that gate [px]"
    )
    yaw_sigma: float = number(
        0.0, 0.0, 0.2, "of the relative yaw of the two cameras, for the covariance only; 0 = known [rad]"
    )
    min_distance: float = number(0.25, 0.01, 100.0, "of a marker [m]")
    max_distance: float = number(6.5, 0.01, 100.0, "of a marker [m]")

    def relations(self, key: str) -> None:
        ordered = self.min_distance <= self.max_distance
        require(ordered, f"{key}.max_distance", f"at least min_distance, {self.min_distance:g}", self.max_distance)


@dc.dataclass(frozen=True)
class Match:
    """The chosen candidates by index, -1 where there is none; `reason` says why there is no pair."""

    left: int = -1
    right: int = -1
    reason: str = ""


def match(
    left: tuple[MarkerCandidate, ...],
    right: tuple[MarkerCandidate, ...],
    head: StereoHead,
    marker: Marker,
    config: StereoPositioningConfig,
) -> Match:
    """The pair of accepted candidates that fits the marker best."""
    rectangles = _rectangles(marker)
    seen = [
        [(k, _coarse_fit(c, lens, rectangles)) for k, c in enumerate(candidates) if not c.rejected]
        for candidates, lens in ((left, head.left), (right, head.right))
    ]
    for side, one in zip(("left", "right"), seen):
        if not one:
            return Match(reason=f"no candidate in the {side} image")
    best, least, reason = None, math.inf, ""
    for i, fit_i in seen[0]:
        for j, fit_j in seen[1]:
            cost, why = _disagreement(fit_i, fit_j, head, config)
            if why:
                reason = reason or f"candidates {i}, {j}: {why}"
            elif cost < least:
                best, least = (i, j), cost
    if best is None:
        return Match(reason=reason)
    return Match(left=best[0], right=best[1])


def single(
    candidates: tuple[MarkerCandidate, ...], lens: LensModel, marker: Marker, config: StereoPositioningConfig
) -> tuple[int, str]:
    """The accepted candidate that one camera alone takes for the marker, the best of those whose corners fit the
    rectangle at a plausible distance: its index and "", or -1 and why there is none."""
    rectangles = _rectangles(marker)
    reason = "no candidate in the image"
    for k, candidate in enumerate(candidates):
        if candidate.rejected:
            continue
        fits = _coarse_fit(candidate, lens, rectangles).by_size
        for depth, misfit in fits:
            if misfit < _shape_gate(candidate.area, config) and config.min_distance < depth < config.max_distance:
                return k, ""
        if reason.startswith("no candidate"):  # of the best one
            depth, misfit = min(fits, key=lambda fit: fit[1])
            far = misfit < _shape_gate(candidate.area, config)
            wrong = f"distance: {depth:.2f} m" if far else f"shape: corners off by {misfit:.2f} of its size"
            reason = f"candidate {k}: {wrong}"
    return -1, reason


def wrong_size(
    left: np.ndarray, right: np.ndarray, head: StereoHead, marker: Marker, config: StereoPositioningConfig
) -> str:
    """Why two quadrilaterals, (4, 2) ideal corners each, are not the marker in both images; "" if they may be.

    Their corners are triangulated, with no knowledge of the marker. The means of opposite sides (as vectors: the
    corners' errors in depth do not lengthen them) must have the marker's lengths. One camera cannot tell a long box
    from the marker seen at a slant, two can.
    """
    P, _ = mid_points(left, right[COUNTED_FROM[corner_offset(left, right)]], head)
    sides = P[NEXT] - P
    lengths = np.linalg.norm(sides[:2] - sides[2:], axis=1) / 2
    baseline = max(float(np.linalg.norm(head.X_LR[:, 3])), 1e-9)
    per_pixel = P[:, 2].mean() ** 2 / (head.right.focal() * baseline)  # of disparity [m]
    x, y = marker.size
    off = min(float(np.abs(lengths / size - 1).max()) for size in ([x, y], [y, x]))
    if not off <= config.side_gate + (config.side_sigma + head.rms_px) * per_pixel / min(x, y):
        return f"sides: {1000 * lengths[0]:.0f} x {1000 * lengths[1]:.0f} mm"
    return ""


def epipolar_offset(left: np.ndarray, right: np.ndarray, X_LR: np.ndarray) -> np.ndarray:
    """By how much the rectangle's centre in the right image is off the epipolar line of that in the left one: (2,) in
    the right ideal image. left, right: (4, 2) ideal corners."""
    a, b = (np.append(middle(corners), 1.0) for corners in (left, right))
    line = X_LR[:, :3].T @ frames.cross(X_LR[:, 3], a)
    return line[:2] * (line @ b) / max(line[:2] @ line[:2], 1e-300)


def _rectangles(marker: Marker) -> list[np.ndarray]:
    """The marker's corners (4, 3), for one that is no square once for either choice of its long sides.

    A few pixels do not tell a rectangle from one with its sides exchanged and tilted: that choice is not made here.
    """
    corners = marker.corners()
    return [corners, corners[COUNTED_FROM[3]]] if marker.aspect() > _OBLONG else [corners]


@dc.dataclass(frozen=True)
class _CoarseFit:
    """What the coarse corners of a candidate alone tell."""

    center: np.ndarray  # (2,) where the diagonals meet, ideal: the area's centre is not the image of one point
    area: float  # [px^2]
    by_size: list[tuple[float, float]]  # for each of `_rectangles`: depth [m], misfit as a share of its size


def _coarse_fit(candidate: MarkerCandidate, lens: LensModel, rectangles: list[np.ndarray]) -> _CoarseFit:
    corners = lens.normalize(candidate.corners)
    size = math.sqrt(max(candidate.area, 1.0)) / lens.focal()
    # Corners of a mask lie half a pixel inside; the area does not.
    larger = size / math.sqrt(polygon_area(corners))
    fits = []
    for rectangle in rectangles:
        ok, _, tvecs, errors = cv2.solvePnPGeneric(
            rectangle, corners[:, None], _PINHOLE, _NO_DISTORTION, flags=cv2.SOLVEPNP_IPPE
        )
        if ok and tvecs[0][2, 0] > 0:  # the best comes first; its error is the rms of all coordinates
            fits.append((float(tvecs[0][2, 0]) / larger, math.sqrt(2) * float(errors[0, 0]) / size))
        else:
            fits.append((math.inf, math.inf))
    return _CoarseFit(center=middle(corners), area=candidate.area, by_size=fits)


def _shape_gate(area: float, config: StereoPositioningConfig) -> float:
    return config.shape_gate + config.corner_sigma / math.sqrt(max(area, 1.0))


def _disagreement(
    left: _CoarseFit, right: _CoarseFit, head: StereoHead, config: StereoPositioningConfig
) -> tuple[float, str]:
    """How badly a pair fits one marker (small is good), or why it cannot be one."""
    small = min(left.area, right.area)
    gate = _shape_gate(max(left.area, right.area), config)
    misfits = [max(a[1], b[1]) for a, b in zip(left.by_size, right.by_size)]
    if min(misfits) > gate:
        return 0.0, f"shape: corners off by {min(misfits):.2f} of its size"
    P, gap = mid_points(left.center[None], right.center[None], head)
    p = P[0]
    if not p[2] > 0:
        return 0.0, "rays do not meet"
    off = float(gap[0]) / p[2] * head.right.focal()
    if off > config.epipolar_gate:
        return 0.0, f"epipolar: {off:.1f} px"
    if not config.min_distance < p[2] < config.max_distance:
        return 0.0, f"distance: {p[2]:.2f} m"
    # Relative depth error of one pixel, by size and by disparity.
    disparity = head.right.focal() * np.linalg.norm(head.X_LR[:, 3]) / p[2]
    allowed = config.size_gate + config.corner_sigma * (1 / math.sqrt(small) + 1 / disparity)
    p_R = frames.apply(frames.inverse(head.X_LR), p)
    wrong, misfit = min(
        (max(abs(math.log(a[0] / p[2])), abs(math.log(b[0] / p_R[2]))), m)
        for a, b, m in zip(left.by_size, right.by_size, misfits)
        if m <= gate
    )
    if wrong > allowed:
        return 0.0, f"size: {math.exp(wrong):.2f} times off"
    return (off / config.epipolar_gate) ** 2 + (wrong / allowed) ** 2 + (misfit / gate) ** 2, ""
