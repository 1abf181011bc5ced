"""Stage 2: the marker's pose from the edge points of its four sides (section 4 of the paper), in two variants.

`paper` (perception/paper.py) is the closed form as printed; `refined` (perception/refinement.py) fits the known
rectangle by least squares, from both mirrored tilts (perception/ambiguity.py), with the 6x6 covariance.

Frames: L left head camera, V marker. Side k joins corner k and k + 1, clockwise as seen (perception/marker.py).
"""

import dataclasses as dc
import math

import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import StereoHead
from valve_drake.messages import MarkerEdges, RectangleEstimate
from valve_drake.perception.ambiguity import Track, candidates, settle_axis
from valve_drake.perception.mark_angle import mark_angle
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import epipolar_offset
from valve_drake.perception.moments import Moments, moments_of, point_residuals, robust_weights
from valve_drake.perception.paper import paper_pose
from valve_drake.perception.quadrilateral import COUNTED_FROM, middle
from valve_drake.perception.rectangle_config import RectangleEstimatorConfig
from valve_drake.perception.refinement import Fit, covariance_of, other_camera_step, refine
from valve_drake.perception.views import View, views_of

__all__ = ["RectangleEstimatorConfig", "Track", "estimate"]


def estimate(
    edges: MarkerEdges, head: StereoHead, marker: Marker, config: RectangleEstimatorConfig, track: Track | None = None
) -> RectangleEstimate:
    """The marker's pose from the edges of one or two cameras; `found` is False with a `reason` if there is none.

    The covariance of a pose that is found is positive definite.
    """
    try:
        found = _estimate(edges, head, marker, config, track)
        np.linalg.cholesky(_correlation(found.covariance) if found.found else np.eye(6))
    except np.linalg.LinAlgError:
        return _refuse(edges, config, "the sides do not determine a pose")
    return found


def _correlation(covariance: np.ndarray) -> np.ndarray:
    """The covariance with unit diagonal. Raises LinAlgError for a variance that is none."""
    variance = np.diag(covariance)
    if not (np.isfinite(covariance).all() and (variance > 0).all()):
        raise np.linalg.LinAlgError("no variance")
    scale = 1 / np.sqrt(variance)
    return covariance * np.outer(scale, scale)


def _estimate(
    edges: MarkerEdges, head: StereoHead, marker: Marker, config: RectangleEstimatorConfig, track: Track | None
) -> RectangleEstimate:
    views, reason = views_of(edges, head, config)
    if reason:
        return _refuse(edges, config, reason)
    moments = moments_of(views, [view.trust for view in views], config)
    fits, turn = candidates(views, moments, marker, config)
    if not fits:
        return _refuse(edges, config, "no pose explains the sides")
    if track is not None and len(fits) > 1 and fits[1].cost - fits[0].cost < config.ambiguity_gate:
        fits.sort(key=lambda fit: -fit.R[:, 2] @ track.X_LV[:, 2])
    turn, axis_known, fits = settle_axis(views, moments, fits, turn, marker, config, track)
    model = marker.corners()[COUNTED_FROM[turn]]
    pose_by = _paper if config.method == "paper" else _refined
    pose = pose_by(views, moments, model, fits[0], config)
    if isinstance(pose, str):
        return _refuse(edges, config, pose)
    fit, covariance = pose.fit, pose.covariance
    residual = _residual_px(views, pose, model)
    reason = _gate(views, fit, residual, config)
    ambiguity = fits[1].cost - fits[0].cost if len(fits) > 1 else 0.0
    if pose.misfit > _chance(8 * len(views) - 6):
        covariance, ambiguity = covariance * pose.misfit, ambiguity / pose.misfit
    if pose.other_camera is not None:
        covariance = _contradicted(covariance, pose, _triangulated_distance(views))
    if len(fits) > 1 and track is None and ambiguity < config.ambiguity_gate and config.method == "refined":
        covariance = covariance + _either_tilt(fit, fits[1], ambiguity)
    other = fits[1] if len(fits) > 1 else fit
    by_marks = None
    if marker.X_VA is not None:
        by_marks = mark_angle(views, fit.R, fit.p, marker, track.angle if track is not None else 0.0)
    return RectangleEstimate(
        time=edges.time,
        sequence=edges.sequence,
        found=not reason,
        method=config.method,
        cameras=len(views),
        X_LV=frames.make(fit.R, fit.p),
        covariance=(covariance + covariance.T) / 2,
        X_LV_other=frames.make(other.R, other.p),
        ambiguity=float(ambiguity),
        residual_px=residual,
        axis_known=axis_known,
        corners_left=edges.left.corners_px if edges.left.found else np.zeros((0, 2)),
        corners_right=edges.right.corners_px if edges.right.found else np.zeros((0, 2)),
        reason=reason,
        angle=by_marks.angle if by_marks is not None else 0.0,
        angle_sigma=by_marks.sigma if by_marks is not None else 0.0,
        angle_seen=by_marks is not None,
    )


@dc.dataclass(frozen=True)
class _Pose:
    """The pose by one of the methods, and what its covariance must still be widened by."""

    fit: Fit
    covariance: np.ndarray  # (6, 6) of theta [rad] and p [m]
    weights: list[np.ndarray]  # of each view's edge points
    misfit: float  # chi^2 per degree of freedom of whole sides, which independent points do not show
    other_camera: np.ndarray | None  # (6,) step that makes good a right camera not as calibrated, if the sides ask it


def _refined(
    views: list[View], moments: Moments, model: np.ndarray, start: Fit, config: RectangleEstimatorConfig
) -> _Pose | str:
    """By least squares from the best candidate on; or why not."""
    weights = [view.trust for view in views]
    told = all(view.information.any() for view in views)
    if not told:
        weights = [
            robust_weights(view, point_residuals(view, start.R, start.p, start.yaw, model), config) for view in views
        ]
        moments = moments_of(views, weights, config)
    fit = refine(moments, model, start.R, start.p, start.yaw, config, known=start if told else None)
    if fit is None:
        return "no pose explains the sides"
    return _Pose(
        fit=fit,
        covariance=covariance_of(moments, model, fit),
        weights=weights,
        # The cause is the calibration, or a marker that is not flat.
        misfit=(fit.cost - moments.floor) / (8 * len(views) - 6),
        other_camera=other_camera_step(moments, model, fit),
    )


def _paper(
    views: list[View], moments: Moments, model: np.ndarray, refined: Fit, config: RectangleEstimatorConfig
) -> _Pose | str:
    """By the closed form; or why not. refined: the best candidate, which shows whether the cameras contradict."""
    step = other_camera_step(moments, model, refined)
    fit, covariance, reason = paper_pose(views, model, config)
    if fit is None or covariance is None:
        return reason
    if step is not None:  # from this pose to the one that the other camera makes of the refined one
        step = _difference(fit, refined) + step
    return _Pose(fit, covariance, [view.trust for view in views], misfit=1.0, other_camera=step)


def _difference(fit: Fit, other: Fit) -> np.ndarray:
    """(6,) the step of theta [rad] and p [m] from one pose to the other."""
    return np.append(frames.rotation_vector(fit.R.T @ other.R), other.p - fit.p)


def _residual_px(views: list[View], pose: _Pose, model: np.ndarray) -> float:
    """Root mean square of the edge points' distances from the projected rectangle [px]."""
    square = 0.0
    for view, weight in zip(views, pose.weights):
        off = point_residuals(view, pose.fit.R, pose.fit.p, pose.fit.yaw, model)
        square += float((weight * off**2).sum())
    return math.sqrt(square / max(sum(float(weight.sum()) for weight in pose.weights), 1e-9))


def _contradicted(covariance: np.ndarray, pose: _Pose, distance: float) -> np.ndarray:
    """The covariance (6, 6) where the cameras contradict each other; distance: of the marker, by triangulation [m].

    Either the right camera is not as calibrated, which `other_camera` makes good, or the marker is of another size, and
    the triangulated distance is right: it holds both.
    """
    assert pose.other_camera is not None
    p = pose.fit.p
    other_size = np.append(np.zeros(3), (distance / math.hypot(*p) - 1) * p)
    return covariance + np.outer(pose.other_camera, pose.other_camera) + np.outer(other_size, other_size)


def _either_tilt(fit: Fit, other: Fit, ambiguity: float) -> np.ndarray:
    """Covariance (6, 6) of two tilts that nothing decides between: the other one with its probability.

    ambiguity: chi^2 by which it fits worse.
    """
    off = _difference(fit, other)
    return np.outer(off, off) / (1 + math.exp(max(ambiguity, 0.0) / 2))


def _chance(freedom: int) -> float:
    """chi^2 per degree of freedom that chance exceeds once in 10^4 (Wilson and Hilferty)."""
    return (1 - 2 / (9 * freedom) + 3.72 * math.sqrt(2 / (9 * freedom))) ** 3


def _gate(views: list[View], fit: Fit, residual: float, config: RectangleEstimatorConfig) -> str:
    """Why a pose is not to be believed, or ""."""
    distance = math.hypot(*fit.p)
    if not np.isfinite(distance) or fit.p[2] <= 0:
        return "behind the camera"
    if len(views) == 2:
        off = views[1].focal * float(
            np.linalg.norm(epipolar_offset(views[0].corners, views[1].corners, frames.inverse(views[1].X_CL)))
        )
        if off > config.epipolar_gate or (residual > config.max_residual and off > residual):
            return f"epipolar: {off:.1f} px"
    # The closed form's own bias leaves residuals that say nothing about the edges.
    if residual > config.max_residual * (5 if config.method == "paper" else 1):
        return f"residual {residual:.2f} px"
    if not config.min_distance <= distance <= config.max_distance:
        return f"distance {distance:.2f} m"
    tilt = math.acos(min(max(float(fit.R[:, 2] @ fit.p) / distance, -1.0), 1.0))
    if tilt > config.max_tilt:
        return f"tilt {math.degrees(tilt):.0f} deg"
    if len(views) == 2:
        ratio = _triangulated_distance(views) / distance
        # One pixel of disparity, widened by the corners' own error.
        allowed = config.size_gate + distance / (views[1].focal * max(math.hypot(*views[1].X_CL[:, 3]), 1e-6))
        if not abs(ratio - 1) < allowed:
            return f"size: {ratio:.2f} of the marker's"
    return ""


def _triangulated_distance(views: list[View]) -> float:
    """Distance of the centre, from where the diagonals meet in both images."""
    rays = []
    for view in views:
        rays.append(view.X_CL[:, :3].T @ np.array([*middle(view.corners), 1.0]))
    p_LR = -views[1].X_CL[:, :3].T @ views[1].X_CL[:, 3]
    a, b = rays
    aa, ab, bb = a @ a, a @ b, b @ b
    s = (bb * (a @ p_LR) - ab * (b @ p_LR)) / max(aa * bb - ab * ab, 1e-300)
    return float(s * np.linalg.norm(rays[0]))


def _refuse(edges: MarkerEdges, config: RectangleEstimatorConfig, reason: str) -> RectangleEstimate:
    cameras = int(edges.left.found) + int(edges.right.found)
    return RectangleEstimate(
        time=edges.time, sequence=edges.sequence, method=config.method, cameras=cameras, reason=reason
    )
