"""The marker in photographs of any camera: the stages of this package, with room for what real cameras add.

A head that was calibrated from pictures is known to within the residual of that calibration, its cameras need not be
triggered together, and their colours come at a fraction of the resolution. So, by the calibration's own residual
(`StereoHead.rms_px`; none of this where it is 0):

- the match may be off the epipolar line by more, and the right camera's edges are moved onto it;
- the relative yaw of the cameras is a state with a prior, and the known size of the rectangle settles it.
"""

import dataclasses as dc

import numpy as np

from valve_drake.camera.lens import LensModel, StereoHead
from valve_drake.checks import ConfigError
from valve_drake.messages import CameraFrame, MarkerEdges, QuadEdges, RectangleEstimate, Segmentation, SegmentationPair
from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segmented
from valve_drake.perception.line_fitting import LineFittingConfig, fit_pair
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, estimate
from valve_drake.perception.stereo_positioning import StereoPositioningConfig, turn_between

_SLACK = 3.0  # by how many rms of its calibration a head may be off


@dc.dataclass(frozen=True)
class Look:
    """What was seen in one or two photographs; index 0 is the left camera, or the only one."""

    estimate: RectangleEstimate  # X_LV is in camera 0
    seen: tuple[Segmentation, ...]
    edges: tuple[QuadEdges, ...]
    corners_px: tuple[np.ndarray | None, ...]  # (4, 2) for each camera, in one order, clockwise as seen [px]
    epipolar_px: float  # distance of the right centre from the left one's epipolar line


def look(
    images: list[np.ndarray], cameras: StereoHead | LensModel, size: tuple[float, float], method: str = "refined"
) -> Look:
    """The pose of a red rectangle of `size` (2 X_w, 2 Y_w) [m] in one image of a lens, or two of a stereo head.

    images: (H, W, 3) uint8 RGB each. Raises ConfigError for an impossible marker or images of another size.
    """
    single = not isinstance(cameras, StereoHead)
    head = StereoHead(cameras, cameras, np.eye(3, 4)) if single else cameras
    lenses = head.lenses()[: len(images)]
    for name, image, lens in zip(("left", "right"), images, lenses):
        if image.shape[:2] != (lens.height, lens.width):
            which, (height, width) = name if len(images) == 2 else "the", image.shape[:2]
            raise ConfigError(f"{which} image is {width} x {height}, its calibration for {lens.width} x {lens.height}")
    slack = _SLACK * head.rms_px if len(images) == 2 else 0.0  # [px]
    marker = Marker(size=list(size), handle_radius=max(0.15, max(size)))
    coloring = ColorSegmentationConfig(min_fill=0.78)  # blurred colours round the corners off
    lines = LineFittingConfig(max_sigma=1.5, single_camera=len(images) == 1)
    matching = StereoPositioningConfig(epipolar_gate=4.0 + slack, size_gate=0.3, side_gate=0.3)
    fitting = RectangleEstimatorConfig(
        method=method, yaw_sigma=slack / head.right.focal(), max_residual=1.2, size_gate=0.2, min_distance=0.1
    )
    for config in (marker, coloring, lines, matching, fitting):
        config.check()
    seen = []
    for name, image in zip(("left", "right"), images):
        seen.append(segmented(CameraFrame(camera=name, image=np.array(image)), coloring))
    pair = SegmentationPair(left=seen[0], right=seen[1] if len(seen) == 2 else Segmentation())
    edges = fit_pair(pair, head, marker, lines, matching)
    shift = np.zeros(2)
    if edges.left.found and edges.right.found:
        shift = _off_the_epipolar_line(edges, head)
    moved = edges
    if slack:
        right = dc.replace(edges.right, points=edges.right.points - shift, corners=edges.right.corners - shift)
        moved = dc.replace(edges, right=right)
    found = estimate(moved, head, marker, fitting)
    quads = (edges.left, edges.right)[: len(images)]
    corners: list[np.ndarray | None] = [None] * len(images)
    if found.found:
        corners = [quad.corners_px if quad.found else None for quad in quads]
        if method == "refined":
            model = marker.corners() @ found.X_LV[:, :3].T + found.X_LV[:, 3]
            in_each = (model, (model - head.X_LR[:, 3]) @ head.X_LR[:, :3])
            corners = [_fitted(P, quad, lens) if quad.found else None for P, quad, lens in zip(in_each, quads, lenses)]
        elif len(corners) == 2 and corners[0] is not None and corners[1] is not None:
            corners[1] = np.roll(corners[1], -turn_between(corners[0], corners[1]), axis=0)
    epipolar = float(np.linalg.norm(shift)) * head.right.focal()
    return Look(estimate=found, seen=tuple(seen), edges=quads, corners_px=tuple(corners), epipolar_px=epipolar)


def _off_the_epipolar_line(edges: MarkerEdges, head: StereoHead) -> np.ndarray:
    """By how much the right centre is off the left one's epipolar line, in the right ideal image (2,)."""
    a, b = (np.append(quad.corners.mean(0), 1.0) for quad in (edges.left, edges.right))
    line = head.X_LR[:, :3].T @ np.cross(head.X_LR[:, 3], a)
    return line[:2] * (line @ b) / max(line[:2] @ line[:2], 1e-300)


def _fitted(P: np.ndarray, quad: QuadEdges, lens: LensModel) -> np.ndarray:
    """Corners (4, 2) [px] of the fitted rectangle P (4, 3), moved to where this camera's own edges are.

    Blurred colours bend the sides of a small rectangle; its fitted shape stands above them. Its place does not.
    """
    corners = P[:, :2] / P[:, 2:]
    corners = corners + quad.corners.mean(0) - corners.mean(0)
    along = corners[NEXT] - corners
    normal = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=1)[:, None]
    # The estimator numbers the sides its own way: each point belongs to the side it lies nearest to.
    off = ((quad.points[:, None] - corners) * normal).sum(2)
    share = ((quad.points[:, None] - corners) * along).sum(2) / (along * along).sum(1)
    beyond = np.abs(share - share.clip(0, 1)) * np.linalg.norm(along, axis=1)
    near = np.argmin(np.hypot(off, beyond), axis=1)
    own, n = off[np.arange(len(off)), near], normal[near]
    for _ in range(3):
        shift = np.linalg.lstsq(n, own, rcond=None)[0]
        left = own - n @ shift
        keep = np.abs(left) <= 4 * np.median(np.abs(left)) + 1e-12
        own, n = own[keep], n[keep]
    return lens.project(corners + shift)
