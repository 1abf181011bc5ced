"""The marker in photographs of any camera: the stages of this package, with room for what real cameras add.

A head that was calibrated from pictures is known to within the residual of that calibration, its cameras need not be
triggered together, and their colours come at a fraction of the resolution. So, by the calibration's own residual
(`StereoHead.rms_px`; none of this where it is 0):

- the match may be off the epipolar line by more, and the right camera's edges are moved onto it;
- the relative yaw of the cameras is a state with a prior, and the known size of the rectangle settles it.
"""

import dataclasses as dc

import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import LensModel, StereoHead
from valve_drake.checks import ConfigError, require
from valve_drake.messages import CameraFrame, QuadEdges, RectangleEstimate, Segmentation, SegmentationPair
from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segmented
from valve_drake.perception.line_fitting import LineFittingConfig, fit_pair
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.matching import StereoPositioningConfig, epipolar_offset
from valve_drake.perception.quadrilateral import corner_offset
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, estimate

_SIDES = ("left", "right")
_MOST_OTHERS = 8  # further rectangles that are looked for; each costs as much as the first
_SLACK = 3.0  # by how many rms of its calibration a head may be off
_MAX_YAW_SIGMA, _MAX_GATE = 0.2, 90.0  # beyond, such a head says nothing of where the marker is [rad], [px]


@dc.dataclass(frozen=True)
class Look:
    """What was seen in one or two photographs; index 0 is the left camera, or the only one."""

    estimate: RectangleEstimate  # X_LV is in camera 0
    seen: tuple[Segmentation, ...]
    edges: tuple[QuadEdges, ...]
    corners_px: tuple[np.ndarray | None, ...]  # (4, 2) for each camera, in one order, clockwise as seen [px]
    epipolar_px: float  # distance of the right centre from the left one's epipolar line
    lens_px: float = 0.0  # standard deviation of the lens where the marker is, the largest of its corners


@dc.dataclass(frozen=True)
class _Stages:
    """The stages' configurations for photographs of one head, or of one lens in both its places."""

    head: StereoHead
    images: int
    slack: float  # by which the head may be off its calibration [px]
    marker: Marker
    coloring: ColorSegmentationConfig
    lines: LineFittingConfig
    matching: StereoPositioningConfig
    fitting: RectangleEstimatorConfig

    @classmethod
    def of(cls, cameras: StereoHead | LensModel, images: int, size: tuple[float, float], method: str) -> "_Stages":
        """Raises ConfigError for an impossible marker, or a calibration that says nothing."""
        head = cameras if isinstance(cameras, StereoHead) else StereoHead(cameras, cameras, np.eye(3, 4))
        slack = _SLACK * head.rms_px if images == 2 else 0.0
        most = min(_MAX_YAW_SIGMA * head.right.focal(), _MAX_GATE) / _SLACK
        known = images == 1 or head.rms_px <= most
        require(known, "rms_px of the calibration", f"at most {most:.3g} for two images", head.rms_px)
        stages = cls(
            head=head,
            images=images,
            slack=slack,
            marker=Marker.of(size, max(0.15, max(size))),
            coloring=ColorSegmentationConfig(min_fill=0.78),  # blurred colours round the corners off
            lines=LineFittingConfig(max_sigma=1.5, single_camera=images == 1),
            matching=StereoPositioningConfig(epipolar_gate=4.0 + slack, size_gate=0.3, side_gate=0.3),
            fitting=RectangleEstimatorConfig(
                method=method,
                yaw_sigma=slack / head.right.focal(),
                max_residual=1.2,
                epipolar_gate=4.0 + slack,
                size_gate=0.2,
                min_distance=0.1,
            ),
        )
        for config in (stages.marker, stages.coloring, stages.lines, stages.matching, stages.fitting):
            config.check()
        return stages

    def segment(self, images: list[np.ndarray]) -> tuple[Segmentation, ...]:
        cameras = (CameraFrame(camera=name, image=np.array(image)) for name, image in zip(_SIDES, images))
        return tuple(segmented(frame, self.coloring) for frame in cameras)

    def locate(self, seen: tuple[Segmentation, ...]) -> Look:
        """The pose of the marker among the candidates of one or two segmented images."""
        head, lenses = self.head, self.head.lenses()[: self.images]
        pair = SegmentationPair(left=seen[0], right=seen[1] if self.images == 2 else Segmentation())
        edges = fit_pair(pair, head, self.marker, self.lines, self.matching)
        shift = np.zeros(2)
        if edges.left.found and edges.right.found:
            shift = epipolar_offset(edges.left.corners, edges.right.corners, head.X_LR)
        moved = edges
        if self.slack:
            right = dc.replace(edges.right, points=edges.right.points - shift, corners=edges.right.corners - shift)
            moved = dc.replace(edges, right=right)
        found = estimate(moved, head, self.marker, self.fitting)
        quads = (edges.left, edges.right)[: self.images]
        corners: list[np.ndarray | None] = [None] * self.images
        if found.found:
            corners = [quad.corners_px if quad.found else None for quad in quads]
            if found.method == "refined":
                model = self.marker.corners() @ found.X_LV[:, :3].T + found.X_LV[:, 3]
                in_each = (model, (model - head.X_LR[:, 3]) @ head.X_LR[:, :3])
                each = zip(in_each, quads, lenses)
                corners = [_fitted(P, quad, lens) if quad.found else None for P, quad, lens in each]
            elif len(corners) == 2 and corners[0] is not None and corners[1] is not None:
                corners[1] = np.roll(corners[1], -corner_offset(corners[0], corners[1]), axis=0)
        epipolar = float(np.linalg.norm(shift)) * head.right.focal()
        lens_px = 0.0
        if found.found:
            used = [camera for camera, px in enumerate(corners) if px is not None]
            of_lens, lens_px = _covariance_of_lenses(found.X_LV, head, used, self.marker)
            found = dc.replace(found, covariance=found.covariance + of_lens)
        return Look(found, seen, quads, tuple(corners), epipolar, lens_px)


def look(
    images: list[np.ndarray], cameras: StereoHead | LensModel, size: tuple[float, float], method: str = "refined"
) -> Look:
    """The pose of a red rectangle of `size` (2 X_w, 2 Y_w) [m] in one image of a lens, or two of a stereo head.

    images: (H, W, 3) uint8 RGB each. Raises ConfigError for an impossible marker or images of another size.
    """
    stages = _Stages.of(cameras, len(images), size, method)
    for name, image, lens in zip(_SIDES, images, stages.head.lenses()):
        if image.shape[:2] != (lens.height, lens.width):
            which, (height, width) = name if len(images) == 2 else "the", image.shape[:2]
            raise ConfigError(f"{which} image is {width} x {height}, its calibration for {lens.width} x {lens.height}")
    return stages.locate(stages.segment(images))


def look_for_others(
    first: Look, cameras: StereoHead | LensModel, size: tuple[float, float], method: str = "refined"
) -> list[Look]:
    """Further red rectangles in the same photographs that the marker's size and shape fit as well, best first."""
    stages = _Stages.of(cameras, len(first.seen), size, method)
    others: list[Look] = []
    one = first
    for _ in range(_MOST_OTHERS):
        seen = tuple(_without(one_seen, quad) for one_seen, quad in zip(one.seen, one.edges))
        if seen == one.seen:  # nothing was chosen: no candidate is left that could be the marker
            break
        one = stages.locate(seen)
        if one.estimate.found:
            others.append(one)
    return others


def _without(seen: Segmentation, quad: QuadEdges) -> Segmentation:
    """The segmentation with the candidate that `quad` was fitted to rejected; the same one if there is none."""
    for k, candidate in enumerate(seen.candidates):
        if not candidate.rejected and (candidate.center == quad.center_px).all():
            taken = dc.replace(candidate, rejected="seen as a marker already")
            return dc.replace(seen, candidates=(*seen.candidates[:k], *seen.candidates[k + 1 :], taken))
    return seen


def _covariance_of_lenses(
    X_LV: np.ndarray, head: StereoHead, used: list[int], marker: Marker
) -> tuple[np.ndarray, float]:
    """What the calibration of the lenses leaves open of a pose (6, 6), and their largest standard deviation [px].

    Each corner may lie elsewhere by its lens's `sigma`; neighbours share half of that variance. Zero for lenses whose
    calibration does not say. Order and units as in RectangleEstimate.covariance.
    """

    def corners(step: np.ndarray) -> np.ndarray:
        P = marker.corners() @ (X_LV[:, :3] @ frames.rotation(step[:3])).T + X_LV[:, 3] + step[3:]
        in_each = (P, (P - head.X_LR[:, 3]) @ head.X_LR[:, :3])
        return np.array([head.lenses()[k].project(in_each[k][:, :2] / in_each[k][:, 2:]) for k in used])

    px = corners(np.zeros(6))
    sigma = np.array([head.lenses()[k].sigma(one) for k, one in zip(used, px)])  # (cameras, 4)
    if not sigma.any():
        return np.zeros((6, 6)), 0.0
    steps = 1e-6 * np.eye(6)
    J = np.stack([(corners(step) - corners(-step)) / 2e-6 for step in steps], -1)  # (cameras, 4, 2, 6)
    back = np.linalg.pinv(J.reshape(-1, 6)).reshape(6, *px.shape)
    each = back * (sigma / np.sqrt(2))[..., None]  # what one standard deviation of each coordinate does to the pose
    common = each.sum(2).reshape(6, -1)
    each = each.reshape(6, -1)
    return (each @ each.T + common @ common.T) / 2, float(sigma.max())


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
