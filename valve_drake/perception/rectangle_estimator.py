"""Stage 2: the marker's pose from the edge points of its four sides (section 4 of the paper), in two variants.

`paper`   The closed form, eq. (8)-(25): n from the two sides parallel to X (both cameras: four equations), a from
          the two parallel to Y, the rough position from all four, then the fine step through the area. The four
          sides' directions are vanishing points, which a small rectangle hardly shows: 10 to 20 times the error of
          the bound at 1 to 2 m. Its printed fine step is biased, see `fine_step`.
`refined` The sides seen by one or two cameras are fitted to the known rectangle by least squares,

              r = w l(X) . (x', y', 1),   l = h / |h_xy|,   h = P_i x P_j   (P_i, P_j: the side's corners in the camera)

          with the analytic Jacobian, both mirror images of the tilt, and the 6x6 covariance. (x', y') are two points
          on each side with their joint information (perception/joint_fit.py), or, where there is none, all edge
          points with robust weights. Since r is linear in l, they act only through their moments: each side is two
          or three numbers, however many points it has, and a Gauss-Newton step costs the same at every distance.

Frames: L left head camera, V marker. Side k joins corner k and k + 1, clockwise as seen (perception/marker.py).
Which side is which is settled last: green marks, else sizes, else the track, else n_x > 0 (`_settle_axis`).
"""

import dataclasses as dc
import functools
import math
from collections.abc import Sequence

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import LensModel, StereoHead
from valve_drake.checks import require
from valve_drake.config import Config, choice, number
from valve_drake.messages import MarkerEdges, QuadEdges, RectangleEstimate
from valve_drake.perception.joint_fit import NODES
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.matching import epipolar_offset
from valve_drake.perception.quadrilateral import corner_offset, meet, middle, side_lines, through_corners

METHODS = ("refined", "paper")
_PRUNE_CHI2 = 1000.0  # a start whose chi^2 is this much above the best one's is not refined
_CONTRADICTED = 12.0  # fall of chi^2 by another right camera from which the head's calibration is doubted
_OTHER_CAMERA = np.array([0.02, 0.02, 0.02, 0.03, 0.03])  # prior on it: its turn [rad], its magnifications [relative]
_UNEVEN_BIAS = 0.1  # part of a side's `QuadEdges.bias` in which it differs from the other sides
_LEAST_WEIGHT = 0.5  # share of a side's own weight below which the joint fit may not push it
_SHORT_SIDE = 40.0  # sides below are biased more by blur and by what surrounds them [px]
_FOUR, _EYE, _NODES = np.arange(4), np.eye(8), np.array(NODES)[:, None]
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])
_SKEW = np.zeros((3, 9))  # v @ _SKEW is [v]x row by row
_SKEW[0, [7, 5]], _SKEW[1, [2, 6]], _SKEW[2, [3, 1]] = (1, -1), (1, -1), (1, -1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b of (3,) or (n, 3); numpy's own takes ten times as long on a few vectors."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]).T


@dc.dataclass
class RectangleEstimatorConfig(Config):
    """Scenario key `rectangle_estimator`."""

    KEY = "rectangle_estimator"
    method: str = choice("refined", METHODS, "of the pose")
    fine_step: str = choice(
        "paper", ("paper", "exact", "none"), "of method paper: paper = eq. (22), (23); exact = ray and plane"
    )
    loss: str = choice("tukey", ("tukey", "huber", "none"), "of the edge points' residuals")
    loss_width: float = number(4.7, 1.0, 1e6, "residual beyond which a point counts less [sigma]")
    min_sigma: float = number(0.01, 1e-6, 10.0, "an edge point is not believed better than this [px]")
    side_bias: float = number(0.003, 0.0, 10.0, "what all points of a side have in common: lens, plate, renderer [px]")
    yaw_sigma: float = number(
        0.0, 0.0, 0.2, "of the head cameras' relative yaw, then estimated as well; 0 = known [rad]"
    )
    square_tolerance: float = number(0.05, 0.0, 1.0, "sides that differ by less do not tell which is X [relative]")
    ambiguity_gate: float = number(
        9.0, 0.0, 1e6, "chi^2 by which the mirror image must be worse; below, the track decides"
    )
    max_residual: float = number(0.8, 1e-3, 100.0, "rms of the edge points about the fit [px]")
    epipolar_gate: float = number(
        4.0, 0.01, 100.0, "distance of the right centre from the left one's epipolar line that is allowed [px]"
    )
    size_gate: float = number(
        0.1, 1e-3, 10.0, "difference of distance by triangulation and by the fit that is allowed [relative]"
    )
    min_distance: float = number(0.25, 0.01, 100.0, "of a marker [m]")
    max_distance: float = number(6.0, 0.01, 100.0, "of a marker [m]")
    max_tilt: float = number(1.13, 0.1, 1.56, "of the marker against the line of sight [rad]")
    max_iterations: int = number(15, 1, 200, "of the refinement")
    track_timeout: float = number(3.0, 0.0, 3600.0, "the X axis is not followed over a longer gap [s]")

    def relations(self, key: str) -> None:
        ordered = self.min_distance <= self.max_distance
        require(ordered, f"{key}.max_distance", f"at least min_distance, {self.min_distance:g}", self.max_distance)


@dc.dataclass(frozen=True)
class Track:
    """What is known from earlier: where the marker should be now."""

    X_LV: np.ndarray  # (3, 4) predicted
    axis_known: bool = False  # its X axis was settled by marks or sizes


@dc.dataclass(frozen=True)
class _View:
    """The edge points of one camera."""

    X_CL: np.ndarray  # (3, 4) the left camera in this one
    right: bool
    focal: float  # [px]
    points: np.ndarray  # (n, 2)
    side: np.ndarray  # (n,) int
    scale: np.ndarray  # (4,) px of the raw image per unit of distance from each side in the ideal one
    sigma: float  # [px]
    bias: np.ndarray  # (4,) of the sides, all inward or all outward [px]
    lines: np.ndarray  # (4, 3)
    corners: np.ndarray  # (4, 2)
    green: np.ndarray  # (m, 2)
    trust: np.ndarray  # (n,) 0..1: weight as a point of its own side
    information: np.ndarray  # (8, 8) of the nodes' distances [1/px^2], or zeros


@dc.dataclass(frozen=True)
class _Moments:
    """All that least squares needs of weighted edge points: r = B l, and the part that no line can remove."""

    R_CL: np.ndarray  # (views, 3, 3)
    p_CL: np.ndarray  # (views, 3)
    right: np.ndarray  # (views,) 1.0 for the right camera, which a relative yaw moves
    yaw_prior: float  # what is known of that yaw [1/rad^2]; 0 = it is no unknown
    B: np.ndarray  # (views, 12, 12) of the four sides' l [sigma]
    floor: float  # chi^2 of the points about their own sides' best lines


@dc.dataclass(frozen=True)
class _Fit:
    R: np.ndarray  # (3, 3) R_LV
    p: np.ndarray  # (3,) p_LV
    yaw: float  # of the right camera against its calibration [rad]
    cost: float  # chi^2
    information: np.ndarray  # (6 or 7, 6 or 7): theta, p, yaw
    prior: np.ndarray  # (6 or 7,) of these, the diagonal of its own information
    at: tuple[np.ndarray, np.ndarray] | None = None  # what `_linearize` gave there, if that is known


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
    views, reason = _views(edges, head, config)
    if reason:
        return _refuse(edges, config, reason)
    weights = [view.trust for view in views]
    moments = _moments(views, weights, config)
    model = marker.corners()
    fits = _candidates(views, moments, model, config)
    if not fits:
        return _refuse(edges, config, "no pose explains the sides")
    if track is not None and len(fits) > 1 and fits[1].cost - fits[0].cost < config.ambiguity_gate:
        fits.sort(key=lambda fit: -fit.R[:, 2] @ track.X_LV[:, 2])
    turn, axis_known, fits = _settle_axis(views, moments, fits, marker, config, track)
    model = model[(_FOUR + turn) % 4]
    best = fits[0]
    ambiguity = fits[1].cost - best.cost if len(fits) > 1 else 0.0
    if config.method == "paper":
        step, refined = _contradiction(moments, model, best), best
        fit, paper_covariance, reason = _paper(views, model, config)
        if fit is None or paper_covariance is None:
            return _refuse(edges, config, reason)
        best, covariance = fit, paper_covariance
        inflation = 1.0
        if step is not None:  # from this pose to the one that the other camera makes of the refined one
            step = np.append(frames.rotation_vector(best.R.T @ refined.R), refined.p - best.p) + step
    else:
        told = all(view.information.any() for view in views)
        if not told:
            weights = [_weights(view, _point_residuals(view, best, model), config) for view in views]
            moments = _moments(views, weights, config)
        fit = _refine(moments, model, best.R, best.p, best.yaw, config, at=best.at if told else None)
        if fit is None:
            return _refuse(edges, config, "no pose explains the sides")
        best = fit
        covariance = _covariance(moments, model, best)
        # Misfit of whole sides, that independent points do not show: calibration, a marker that is not flat.
        inflation = (best.cost - moments.floor) / (8 * len(views) - 6)
        step = _contradiction(moments, model, best)
    square = sum(float((w * _point_residuals(v, best, model) ** 2).sum()) for v, w in zip(views, weights))
    residual = math.sqrt(square / max(sum(float(w.sum()) for w in weights), 1e-9))
    if inflation > _chance(8 * len(views) - 6):
        covariance, ambiguity = covariance * inflation, ambiguity / inflation
    reason = _gate(views, best, residual, config)
    if step is not None:
        # Either the right camera is not as calibrated, which `step` makes good, or the marker is of another size, and
        # the triangulated distance is right: the covariance holds both.
        other_size = np.append(np.zeros(3), (_triangulated_distance(views) / math.hypot(*best.p) - 1) * best.p)
        covariance = covariance + np.outer(step, step) + np.outer(other_size, other_size)
    X_LV = frames.make(best.R, best.p)
    X_other = frames.make(fits[1].R, fits[1].p) if len(fits) > 1 else X_LV
    if len(fits) > 1 and track is None and ambiguity < config.ambiguity_gate and config.method == "refined":
        # Nothing decides between the two tilts: the covariance holds the other one with its probability.
        other = np.append(frames.rotation_vector(best.R.T @ fits[1].R), fits[1].p - best.p)
        covariance = covariance + np.outer(other, other) / (1 + math.exp(max(ambiguity, 0.0) / 2))
    return RectangleEstimate(
        time=edges.time,
        sequence=edges.sequence,
        found=not reason,
        method=config.method,
        cameras=len(views),
        X_LV=X_LV,
        covariance=(covariance + covariance.T) / 2,
        X_LV_other=X_other,
        ambiguity=float(ambiguity),
        residual_px=residual,
        axis_known=axis_known,
        corners_left=edges.left.corners_px if edges.left.found else np.zeros((0, 2)),
        corners_right=edges.right.corners_px if edges.right.found else np.zeros((0, 2)),
        reason=reason,
    )


def _chance(freedom: int) -> float:
    """chi^2 per degree of freedom that chance exceeds once in 10^4 (Wilson and Hilferty)."""
    return (1 - 2 / (9 * freedom) + 3.72 * math.sqrt(2 / (9 * freedom))) ** 3


# ---------------------------------------------------------------- the edges of the cameras


def _views(edges: MarkerEdges, head: StereoHead, config: RectangleEstimatorConfig) -> tuple[list[_View], str]:
    views: list[_View] = []
    X_RL = frames.inverse(head.X_LR)
    cameras = ((edges.left, head.left, np.eye(3, 4), False), (edges.right, head.right, X_RL, True))
    for quad, lens, X_CL, right in cameras:
        if quad.found:
            view = _view(quad, lens, X_CL, right, config)
            if isinstance(view, str):
                return [], view
            views.append(view)
    if not views:
        return [], edges.left.reason or edges.right.reason or "no edges"
    if len(views) == 2:
        views[1] = _aligned(views[0], views[1])
    return views, ""


def _view(
    quad: QuadEdges, lens: LensModel, X_CL: np.ndarray, right: bool, config: RectangleEstimatorConfig
) -> _View | str:
    """The edges of one camera; or why they cannot be used."""
    side = quad.side.astype(int)
    if np.bincount(side, minlength=4).min() < 2:
        return "a side has fewer than two points"
    sigma = max(quad.sigma, config.min_sigma)
    if quad.information.any():
        corners, trust = quad.corners, np.ones(len(side))
        lines = through_corners(corners)
    else:
        robust, trust = _robust_lines(quad.points, side, sigma / lens.focal(), config)
        if robust is None:
            return "sides do not make a quadrilateral"
        lines = robust
        corners = meet(lines)
    d = corners[NEXT] - corners
    turning = d[:, 0] * d[NEXT, 1] - d[:, 1] * d[NEXT, 0]
    if not (np.isfinite(corners).all() and (turning > 0).all()):
        return "sides do not make a convex quadrilateral in clockwise order"
    # Errors are even in the raw image, not in the ideal one: |A^T n| with A = d xy / d px along the side's normal.
    # It changes by a few percent over an image, so one value for each side will do.
    A = lens.normalize_jacobian((quad.corners_px + quad.corners_px[NEXT]) / 2)
    stretch = np.linalg.norm((lines[:, None, :2] @ A)[:, 0], axis=1)
    return _View(
        X_CL=X_CL,
        right=right,
        focal=lens.focal(),
        points=quad.points,
        side=side,
        scale=1 / stretch,
        sigma=sigma,
        bias=quad.bias,
        lines=lines,
        corners=corners,
        green=quad.green,
        trust=trust,
        information=quad.information * min(quad.sigma / sigma, 1) ** 2,
    )


def _robust_lines(
    points: np.ndarray, side: np.ndarray, sigma: float, config: RectangleEstimatorConfig
) -> tuple[np.ndarray | None, np.ndarray]:
    """Lines (4, 3) of the sides and each point's weight; points far from their own side lose theirs."""
    trust = np.ones(len(side))
    lines, scatter = side_lines(points, side)
    if config.loss != "none" and scatter > 1.5 * sigma:
        for _ in range(5):  # L1 reweighting tolerates outliers; then a cut at the points' own scale
            off = np.abs((lines[side, :2] * points).sum(1) + lines[side, 2])
            lines = _weighted_lines(points, side, 1 / np.maximum(off, sigma))
        off = np.abs((lines[side, :2] * points).sum(1) + lines[side, 2])
        trust = (off < config.loss_width * max(sigma, 1.48 * float(np.median(off)))).astype(float)
        if np.bincount(side, trust, 4).min() < 2:
            return None, trust
        lines = _weighted_lines(points, side, trust)
    return (lines if np.isfinite(lines).all() else None), trust


def _weighted_lines(points: np.ndarray, side: np.ndarray, weight: np.ndarray) -> np.ndarray:
    _, mean, scatter = _side_moments(points, side, weight)
    angle = np.arctan2(2 * scatter[:, 0, 1], scatter[:, 0, 0] - scatter[:, 1, 1]) / 2
    normal = np.stack([-np.sin(angle), np.cos(angle)], -1)
    return np.column_stack([normal, -(normal * mean).sum(1)])


def _side_moments(
    points: np.ndarray, side: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weight (4,), mean (4, 2) and weighted scatter (4, 2, 2) of the points of each side."""
    total = np.bincount(side, weight, 4)
    safe = np.maximum(total, 1e-300)[:, None]
    mean = np.stack([np.bincount(side, weight * points[:, k], 4) for k in (0, 1)], -1) / safe
    d = points - mean[side]
    wx = weight * d[:, 0]
    xx, xy = np.bincount(side, wx * d[:, 0], 4), np.bincount(side, wx * d[:, 1], 4)
    yy = np.bincount(side, weight * d[:, 1] ** 2, 4)
    return total, mean, np.stack([xx, xy, xy, yy], -1).reshape(4, 2, 2)


def _aligned(left: _View, right: _View) -> _View:
    """The right view with its sides counted from the same corner as the left one's."""
    turn = corner_offset(left.corners, right.corners)
    if turn == 0:
        return right
    by_side = (right.lines, right.corners, right.scale, right.bias)
    lines, corners, scale, bias = (values[(_FOUR + turn) % 4] for values in by_side)
    nodes = (np.arange(8) + 2 * turn) % 8
    information = right.information[np.ix_(nodes, nodes)]
    return dc.replace(
        right,
        side=(right.side - turn) % 4,
        scale=scale,
        bias=bias,
        lines=lines,
        corners=corners,
        information=information,
    )


def _moments(views: list[_View], weights: list[np.ndarray], config: RectangleEstimatorConfig) -> _Moments:
    B = np.zeros((len(views), 12, 12))
    floor = 0.0
    corners = np.array([view.corners for view in views])
    along = corners[:, NEXT] - corners
    lengths = np.sqrt((along * along).sum(2)) * np.array([[view.focal] for view in views])
    # A side is not better known than its common bias, however many points it has.
    biases = config.side_bias * np.minimum(np.maximum((_SHORT_SIDE / lengths) ** 3, 1), 10)
    if any(view.bias.any() for view in views):
        biases = np.hypot(biases, [_UNEVEN_BIAS * view.bias for view in views])
    told = [k for k, view in enumerate(views) if view.information.any()]
    if told:
        # Two nodes make a side: each has twice the variance of the bias.
        information = np.array([views[k].information for k in told])
        common = np.repeat(2 * biases[told] ** 2, 2, axis=1)[:, None]
        root = np.linalg.cholesky(np.linalg.solve(_EYE + information * common, information))
        distance = np.zeros((len(told), 4, 2, 4, 3))  # of the nodes from the sides, by l
        at_node = np.ones((4, len(told), 2, 3))
        at_node[..., :2] = (corners[told, :, None] + along[told, :, None] * _NODES).swapaxes(0, 1)
        at_node *= np.array([views[k].scale for k in told]).T[:, :, None, None]
        distance[:, _FOUR, :, _FOUR] = at_node
        B[told, :8] = root.swapaxes(1, 2) @ distance.reshape(-1, 8, 12)
    for k, (view, weight, bias, rows) in enumerate(zip(views, weights, biases, B)):
        if k in told:
            continue
        information = np.bincount(view.side, weight, 4) / view.sigma**2
        share = 1 / (1 + information * bias**2)
        w = weight * share[view.side] * (view.scale[view.side] / view.sigma) ** 2
        total, mean, S = _side_moments(view.points, view.side, w)
        root = np.sqrt(total)
        out = np.zeros((4, 3, 3))
        out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = root * mean[:, 0], root * mean[:, 1], root
        c11 = np.sqrt(S[:, 0, 0]) + 1e-150
        c21 = S[:, 0, 1] / c11
        out[:, 1, 0], out[:, 1, 1] = c11, c21
        out[:, 2, 1] = np.sqrt(np.maximum(S[:, 1, 1] - c21**2, 0))
        half, gap = (S[:, 0, 0] + S[:, 1, 1]) / 2, np.hypot((S[:, 0, 0] - S[:, 1, 1]) / 2, S[:, 0, 1])
        floor += float(np.maximum(half - gap, 0).sum())
        rows.reshape(4, 3, 4, 3)[_FOUR, :, _FOUR] = out
    for view, rows in zip(views, B):
        if view.bias.any():
            # Whitening: residuals with the covariance I + a a^T, a being what one standard deviation does to them.
            a = rows[:, 2::3] @ (view.bias / view.scale)
            aa = float(a @ a)
            rows -= np.outer(a, a @ rows) * ((1 - 1 / math.sqrt(1 + aa)) / max(aa, 1e-300))
    X_CL = np.array([view.X_CL for view in views])
    right = np.array([float(view.right) for view in views])
    yaw_prior = 1 / config.yaw_sigma**2 if config.yaw_sigma > 0 and right.any() else 0.0
    return _Moments(R_CL=X_CL[:, :, :3], p_CL=X_CL[:, :, 3], right=right, yaw_prior=yaw_prior, B=B, floor=floor)


def _point_residuals(view: _View, fit: _Fit, model: np.ndarray) -> np.ndarray:
    """Distances of the edge points from the projected rectangle [px]."""
    P = (model @ fit.R.T + fit.p) @ view.X_CL[:, :3].T + view.X_CL[:, 3]
    if view.right and fit.yaw:
        P = P @ frames.rot_y(fit.yaw)
    h = _cross(P, P[NEXT])
    line = (h / np.hypot(h[:, 0], h[:, 1])[:, None])[view.side]
    return (line[:, 0] * view.points[:, 0] + line[:, 1] * view.points[:, 1] + line[:, 2]) * view.scale[view.side]


def _weights(view: _View, residual: np.ndarray, config: RectangleEstimatorConfig) -> np.ndarray:
    """Robust weight of each point; its scale is the residuals' own where a systematic misfit exceeds the noise.

    A side that lies off the joint fit as a whole keeps the weights from its own line: outliers are single points, and
    without a side the pose is free to go anywhere.
    """
    off = np.abs(residual)
    scale = config.loss_width * max(view.sigma, 1.48 * float(np.median(off)))
    if config.loss == "tukey":
        if not (off > 0.9 * scale).any():
            return view.trust
        weight = np.where(off < scale, (1 - (off / scale) ** 2) ** 2, 0.0)
    elif config.loss == "huber":
        weight = view.trust * np.minimum(1.0, scale / np.maximum(off, 1e-12))
    else:
        return np.ones(len(off))
    emptied = np.bincount(view.side, weight, 4) < _LEAST_WEIGHT * np.bincount(view.side, view.trust, 4)
    return np.where(emptied[view.side], view.trust, weight)


# ---------------------------------------------------------------- refined: least squares on the known rectangle


@functools.lru_cache(maxsize=16)
def _model_sides(model: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Of the model's sides: e = m_j - m_i (4, 3), and [-[c]x c; -[e]x e] (4, 6, 4), where c = m_i x m_j."""
    m = np.frombuffer(model).reshape(4, 3)
    e, c = m[NEXT] - m, _cross(m, m[NEXT])
    both = np.empty((4, 6, 4))
    both[:, :3, :3], both[:, 3:, :3] = (c @ -_SKEW).reshape(4, 3, 3), (e @ -_SKEW).reshape(4, 3, 3)
    both[:, :3, 3], both[:, 3:, 3] = c, e
    return e, both


def _linearize(
    moments: _Moments, model: np.ndarray, R: np.ndarray, p: np.ndarray, yaw: float, other_camera: bool = False
) -> tuple[np.ndarray, np.ndarray] | None:
    """Residuals (12 views,) in sigmas and Jacobian by theta (R exp([theta]x)), p and, if unknown, yaw; None if behind
    a camera. other_camera: instead of by yaw, by a turn of the right camera about its x, y and z, and by its
    magnification along x and y."""
    R_CL, p_CL = moments.R_CL, moments.p_CL
    if yaw:
        back = np.stack([frames.rot_y(-yaw * right) for right in moments.right])
        R_CL, p_CL = back @ R_CL, np.einsum("cij,cj->ci", back, p_CL)
    # With A = R_CL R and t = R_CL p + p_CL a corner m is at P = A m + t, so h = A c + t x (A e).
    A, t = R_CL @ R, R_CL @ p + p_CL
    if not (A[:, 2] @ model.T + t[:, 2:]).min() > 1e-3:
        return None
    count = len(A)
    e, both = _model_sides(model.tobytes())
    of_both = np.empty((count, 1, 3, 6))
    of_both[:, 0, :, :3] = A
    np.matmul((t @ _SKEW).reshape(count, 3, 3), A, out=of_both[:, 0, :, 3:])
    turned = of_both @ both  # (C, 4, 3, 4)
    n = 11 if other_camera else 7 if moments.yaw_prior else 6
    dh = np.empty((count, 4, 3, n + 1))  # by theta, p, yaw; the last column is h itself
    dh[..., :3], dh[..., n] = turned[..., :3], turned[..., 3]
    dh[..., 3:6] = (e @ A.transpose(0, 2, 1) @ -_SKEW).reshape(count, 4, 3, 3) @ R_CL[:, None]
    if n == 7:
        x, y, z = dh[..., 7].transpose(2, 0, 1) * moments.right[:, None]
        dh[:, :, 0, 6], dh[:, :, 1, 6], dh[:, :, 2, 6] = -z, 0, x  # -e_y x h
    elif n == 11:
        h = dh[..., 11] * moments.right[:, None, None]
        dh[..., 6:9] = (h @ _SKEW).reshape(count, 4, 3, 3)  # column k is -e_k x h
        dh[..., 9:11] = h[..., None] * [[0, 1], [1, 0], [1, 1]]
    xy = dh[..., :2, n]
    dh /= np.sqrt((xy * xy).sum(-1))[..., None, None]
    line = dh[..., n].copy()
    dh -= line[..., None] * (line[..., None, :2] @ dh[..., :2, :])
    dh[..., n] = line
    out = (moments.B @ dh.reshape(count, 12, n + 1)).reshape(-1, n + 1)
    return out[:, n], out[:, :n]


def _refine(
    moments: _Moments,
    model: np.ndarray,
    R: np.ndarray,
    p: np.ndarray,
    yaw: float,
    config: RectangleEstimatorConfig,
    enough: float = 1e-6,
    at: tuple[np.ndarray, np.ndarray] | None = None,
) -> _Fit | None:
    """Levenberg-Marquardt from (R, p), until a step is expected to lower chi^2 by less than `enough`.

    at: what `_linearize` gives there, if known already.
    """
    at = at or _linearize(moments, model, R, p, yaw)
    if at is None:
        return None
    known = moments.yaw_prior
    prior = np.array([0.0] * 6 + [known] * bool(known))
    damping = 1e-4
    cost = at[0] @ at[0] + known * yaw**2
    for _ in range(config.max_iterations):
        r, J = at
        H, g = J.T @ J, J.T @ r
        if known:
            H[6, 6] += known
            g[6] += known * yaw
        damped = H.copy()
        damped.flat[:: len(H) + 1] += damping * (H.diagonal() + 1e-12)
        step = cv2.solve(damped, -g, flags=cv2.DECOMP_CHOLESKY)[1][:, 0]  # a fifth of the time of numpy's
        gain = -2 * (g @ step) - step @ H @ step  # the decrease that the linear model expects
        R_new, p_new = R @ frames.rotation(step[:3]), p + step[3:6]
        yaw_new = yaw + step[6] if known else yaw
        trial = _linearize(moments, model, R_new, p_new, yaw_new)
        cost_new = math.inf if trial is None else trial[0] @ trial[0] + known * yaw_new**2
        if trial is not None and cost_new <= cost:
            R, p, yaw, at, cost = R_new, p_new, yaw_new, trial, cost_new
            damping = max(damping / 10, 1e-9)
        else:
            damping = max(damping * 10, 1e-5)
        if gain < enough or damping > 1e8:
            break
    information = at[1].T @ at[1] + np.diag(prior)
    return _Fit(R=R, p=p, yaw=float(yaw), cost=float(cost), information=information, prior=prior, at=at)


def _covariance(moments: _Moments, model: np.ndarray, fit: _Fit) -> np.ndarray:
    """(6, 6) of theta and p, for the most frontal tilt within two standard deviations.

    Foreshortening goes with the square of the tilt: a marker seen almost frontally seems to know its tilt the better
    the more noise has tilted it.
    """
    C = np.linalg.inv(fit.information)
    sight = fit.R.T @ fit.p / np.linalg.norm(fit.p)
    axis = np.array([-sight[1], sight[0], 0.0])  # z x sight: turning about it brings z to the line of sight
    tilt = math.atan2(math.hypot(sight[0], sight[1]), sight[2])
    if tilt < 1e-9:
        return C[:6, :6]
    axis /= np.linalg.norm(axis)
    way = C[:, :3] @ axis  # what goes with it
    variance = float(axis @ way[:3])
    step = way * min(tilt, 2 * math.sqrt(variance)) / variance
    yaw = fit.yaw + step[6] if len(step) == 7 else 0.0
    at = _linearize(moments, model, fit.R @ frames.rotation(step[:3]), fit.p + step[3:6], yaw)
    if at is None:
        return C[:6, :6]
    return np.linalg.inv(at[1].T @ at[1] + np.diag(fit.prior))[:6, :6]


def _contradiction(moments: _Moments, model: np.ndarray, fit: _Fit) -> np.ndarray | None:
    """The step of the pose (6,) that another right camera than the calibrated one would make, if the sides contradict
    the calibration; None if they do not."""
    if len(moments.right) < 2 or fit.cost - moments.floor < _CONTRADICTED:
        return None
    at = _linearize(moments, model, fit.R, fit.p, fit.yaw, other_camera=True)
    if at is None:
        return None
    r, J = at
    H, g = J.T @ J, J.T @ r
    H[range(6, 11), range(6, 11)] += 1 / _OTHER_CAMERA**2
    H[7, 7] += moments.yaw_prior
    g[7] += moments.yaw_prior * fit.yaw
    step = -np.linalg.solve(H, g)
    return step[:6] if -g @ step > _CONTRADICTED else None


def _candidates(
    views: list[_View], moments: _Moments, model: np.ndarray, config: RectangleEstimatorConfig
) -> list[_Fit]:
    """The distinct minima, best first: from both poses of IPPE, else the closed form; then the mirrored tilt."""
    view = views[0]
    starts = []
    # V's z points away from the camera: with z towards it IPPE's answers are wrong.
    ok, rvecs, tvecs, _ = cv2.solvePnPGeneric(
        model, view.corners[:, None, :], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
    )
    for rvec, tvec in zip(rvecs, tvecs) if ok else ():
        starts.append(_to_left(view, cv2.Rodrigues(rvec)[0], tvec.ravel()))
    fits, pruned = _distinct(moments, model, starts, config, [])
    if not fits:
        closed = closed_form([v.corners for v in views], [v.X_CL for v in views], model, "exact")
        fits, pruned = _distinct(moments, model, [closed] if closed is not None else [], config, [])
    if len(fits) == 1 and not pruned:
        mirrored = _mirrored(fits[0].R, fits[0].p)
        fits, pruned = _distinct(moments, model, [mirrored], config, fits)
        if len(fits) == 1 and not pruned:
            pruned = [(_moved_to_fit(moments, model, *mirrored), mirrored[0])]
    if len(fits) == 1 and math.isfinite(pruned[0][0]):
        # If the mirrored tilt has no minimum of its own, its best translation is the alternative.
        cost, R = pruned[0]
        fits.append(dc.replace(fits[0], R=R, cost=max(cost, fits[0].cost), at=None))
    return fits


def _distinct(
    moments: _Moments,
    model: np.ndarray,
    starts: list[tuple[np.ndarray, np.ndarray]],
    config: RectangleEstimatorConfig,
    known: list[_Fit],
) -> tuple[list[_Fit], list[tuple[float, np.ndarray]]]:
    """`known` and the fits from `starts` that end elsewhere, best first; and chi^2 and R of those before the cameras
    that were so much worse than a known one that they were left."""
    fits, pruned = list(known), []
    for R, p in starts:
        if not (np.isfinite(R).all() and np.isfinite(p).all()):
            continue
        if fits:
            cost = _moved_to_fit(moments, model, R, p)
            if cost > fits[0].cost + _PRUNE_CHI2:
                if math.isfinite(cost):
                    pruned.append((cost, R))
                continue
        fit = _refine(moments, model, R, p, 0.0, config, enough=0.05)
        if fit is not None and fit.R[2, 2] > 0:
            if not any(np.linalg.norm(frames.rotation_vector(fit.R.T @ other.R)) < 1e-3 for other in fits):
                fits.append(fit)
    return sorted(fits, key=lambda fit: fit.cost), pruned


def _moved_to_fit(moments: _Moments, model: np.ndarray, R: np.ndarray, p: np.ndarray) -> float:
    """chi^2 of this orientation at the position that suits it best; infinite behind a camera."""
    at = _linearize(moments, model, R, p, 0.0)
    if at is None:
        return math.inf
    J, r = at[1][:, 3:6], at[0]
    g = J.T @ r
    return float(r @ r - g @ cv2.solve(J.T @ J, g, flags=cv2.DECOMP_CHOLESKY)[1][:, 0])


def _to_left(view: _View, R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    X = frames.compose(frames.inverse(view.X_CL), frames.make(R, p))
    return X[:, :3], X[:, 3]


def _mirrored(R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same marker with its tilt against the line of sight mirrored."""
    d = p / np.linalg.norm(p)
    axis = _cross(R[:, 2], d)
    angle = math.atan2(float(np.linalg.norm(axis)), float(R[:, 2] @ d))
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    return frames.rotation(2 * angle * axis) @ R, p


# ---------------------------------------------------------------- which axis is X


def _settle_axis(
    views: list[_View],
    moments: _Moments,
    fits: list[_Fit],
    marker: Marker,
    config: RectangleEstimatorConfig,
    track: Track | None,
) -> tuple[int, bool, list[_Fit]]:
    """How many corners the image's first one lies ahead of the model's (0..3), whether that is sure, the fits so."""
    swapped, known = None, True
    votes = _mark_votes(views, fits[0], marker)
    if votes[0] != votes[1]:
        quarter = int(votes[1] > votes[0])
    elif marker.aspect() > 1 + config.square_tolerance:
        swapped = _quarter_turned(moments, fits, marker, config)
        quarter = int(bool(swapped) and swapped[0].cost < fits[0].cost)
    else:
        angles = fits[0].R.T @ track.X_LV[:, 0] if track is not None else fits[0].R[0]
        quarter = int(abs(angles[1]) > abs(angles[0]))
        known = track is not None and track.axis_known
    if quarter:
        fits = swapped or _quarter_turned(moments, fits, marker, config) or fits
    n = fits[0].R[:, 0]
    ahead = n @ track.X_LV[:, 0] if track is not None else n[0]
    if ahead < 0:
        fits = [_half_turned(fit) for fit in fits]
    return quarter + 2 * int(ahead < 0), known, fits


def _mark_votes(views: list[_View], fit: _Fit, marker: Marker) -> tuple[int, int]:
    """Green marks found where they should be if X is the fit's x axis, or its y axis."""
    r, depth = marker.handle_radius, marker.mark_depth
    places = np.array([[r, 0, depth], [-r, 0, depth], [0, r, depth], [0, -r, depth], [0, 0, 0]])
    votes = np.zeros(4, int)
    for view in views:
        P = (places @ fit.R.T + fit.p) @ view.X_CL[:, :3].T + view.X_CL[:, 3]
        if len(view.green) == 0 or not (P[:, 2] > 1e-3).all():
            continue
        xy = P[:, :2] / P[:, 2:]
        off, far = view.green[None] - xy[:4, None], xy[:4] - xy[4]
        votes += (off * off).sum(2).min(1) < 0.04 * (far * far).sum(1)
    return int(votes[0] + votes[1]), int(votes[2] + votes[3])


def _quarter_turned(
    moments: _Moments, fits: list[_Fit], marker: Marker, config: RectangleEstimatorConfig
) -> list[_Fit]:
    """The fits with the image's first corner one further along the model."""
    model = marker.corners()[NEXT]
    # Corner 0 of the image now is the model's corner 1: V turns back by a quarter against the image.
    Q = frames.rot_z(-np.pi / 2)
    turned = [_refine(moments, model, fit.R @ Q, fit.p, fit.yaw, config) for fit in fits[:2]]
    return sorted((fit for fit in turned if fit is not None), key=lambda fit: fit.cost)


def _half_turned(fit: _Fit) -> _Fit:
    sign = np.ones(len(fit.information))
    sign[:2] = -1  # theta is in V
    at = (fit.at[0], fit.at[1] * sign) if fit.at else None
    return dc.replace(fit, R=fit.R @ _HALF_TURN, information=fit.information * np.outer(sign, sign), at=at)


# ---------------------------------------------------------------- the paper's closed form


def closed_form(
    corners: list[np.ndarray], X_CL: list[np.ndarray], model: np.ndarray, fine_step: str = "paper"
) -> tuple[np.ndarray, np.ndarray] | None:
    """Section 4 of the paper: R_LV (3, 3) and p_LV (3,), or None where it has no solution.

    corners: for each camera the (4, 2) ideal corners, side k (k to k + 1) being the model's side k of `model` (4, 3);
    X_CL: the left camera in each. The first camera gives a and p; all give n.
    """
    q = np.column_stack([corners[0], np.ones(4)])
    plane = [_cross(np.column_stack([c, np.ones(4)]), np.column_stack([c[NEXT], np.ones(4)])) for c in corners]
    R_0C = [X_CL[0][:, :3] @ X[:, :3].T for X in X_CL]
    # A model turned by a quarter has its sides parallel to X at 1 and 3.
    quarter = int(abs(model[0, 0] - model[1, 0]) < abs(model[0, 1] - model[1, 1]))
    x_sides, y_sides = ([1, 3], [0, 2]) if quarter else ([0, 2], [1, 3])
    n = _vector_n(np.vstack([plane[k][x_sides] @ R_0C[k].T for k in range(len(plane))]))
    # n points from low to high x: its sense in the image at the first such side.
    i = x_sides[0]
    j = NEXT[i]
    sense = (q[j] - q[i]) @ (n - n[2] * (q[i] + q[j]) / 2) * (model[j, 0] - model[i, 0])
    n = n if sense > 0 else -n
    a = _vector_a(n, q, y_sides)
    if a is None:
        return None
    o = _cross(a, n)
    R = np.column_stack([n, o, a])
    p = _position(R, q, model, x_sides, y_sides, fine_step)
    if p is None or p[2] <= 0:
        return None
    X = frames.compose(frames.inverse(X_CL[0]), frames.make(R, p))
    return X[:, :3], X[:, 3]


def _vector_n(m: np.ndarray) -> np.ndarray:
    """Eq. (8)-(10): unit n from the normals q_i x q_j (k, 3) of the planes through the sides parallel to X."""
    area = np.abs(m[0, 0] * m[1:, 1] - m[0, 1] * m[1:, 0]).max()
    if area > 1e-9 * (m[:, :2] ** 2).sum():  # eq. (9): divided by n_z
        n = np.append(np.linalg.lstsq(m[:, :2], -m[:, 2], rcond=None)[0], 1.0)
    else:  # eq. (10): n_z = 0
        m = m * np.sign(m @ m[0])[:, None]
        n = np.array([m[:, 1].sum(), -m[:, 0].sum(), 0.0])
    return n / np.linalg.norm(n)


def _vector_a(n: np.ndarray, q: np.ndarray, y_sides: list[int]) -> np.ndarray | None:
    """Eq. (13), (14): unit a from points on the two sides parallel to Y; each side has its own constant C'_2.

    The paper removes a'_x and divides by n_x. Where n_y is the larger, x and y change places.
    """
    x, y = (0, 1) if abs(n[0]) >= abs(n[1]) else (1, 0)
    rows, right = [], []
    for k, side in enumerate(y_sides):
        for point in (q[side], q[NEXT[side]]):
            row = [n[x] * point[y] - n[y] * point[x], 0.0, 0.0]
            row[1 + k] = -n[x] * (n @ point)
            rows.append(row)
            right.append(n[2] * point[x] - n[x])
    a_y = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0][0]
    a = np.empty(3)
    a[x], a[y], a[2] = -(n[2] + n[y] * a_y) / n[x], a_y, 1.0
    return a / np.linalg.norm(a) if np.isfinite(a).all() else None


def _position(
    R: np.ndarray, q: np.ndarray, model: np.ndarray, x_sides: list[int], y_sides: list[int], fine_step: str
) -> np.ndarray | None:
    """Rough position, eq. (15)-(18), then the fine step, eq. (20)-(25)."""
    n, o, a = R.T
    X_w, Y_w = np.abs(model[0, :2])

    def constant(axis: np.ndarray, side: int) -> float:  # C_1 of eq. (6) for o; 1 / C_2 of eq. (12) for n
        ends = q[[side, NEXT[side]]]
        return float(((ends @ axis) / (ends @ a)).mean())

    def high_low(axis: np.ndarray, sides: list[int], k: int) -> tuple[float, float]:
        values = sorted((model[side, k] + model[NEXT[side], k], constant(axis, side)) for side in sides)
        return values[1][1], values[0][1]

    C11, C12 = high_low(o, x_sides, 1)
    E21, E22 = high_low(n, y_sides, 0)  # 1 / C_21, 1 / C_22
    rows = np.array([2 * o - (C11 + C12) * a, (C11 - C12) * a, 2 * n - (E21 + E22) * a, (E21 - E22) * a])
    p = np.linalg.lstsq(rows, np.array([0, 2 * Y_w, 0, 2 * X_w]), rcond=None)[0]
    if fine_step == "none" or p[2] <= 0:
        return p
    b = p / p[2]
    if fine_step == "paper":  # eq. (22), (23), over p_z
        m_x = (q[:, 0] - b[0]) * math.hypot(a[0], a[2]) / (a[2] + a[0] * q[:, 0])
        m_y = (q[:, 1] - b[1]) * math.hypot(a[1], a[2]) / (a[2] + a[1] * q[:, 1])
    else:  # the ray's point in the plane through b
        X = q * ((a @ b) / (q @ a))[:, None] - b
        m_x, m_y = X @ n, X @ o
    S_1 = abs((m_x * m_y[NEXT] - m_x[NEXT] * m_y).sum()) / 2  # eq. (24)
    if not S_1 > 0:
        return None
    p_z = 2 * math.sqrt(X_w * Y_w / S_1)  # eq. (25)
    p_xy = np.linalg.solve(rows[[0, 2], :2], -rows[[0, 2], 2] * p_z)
    return np.append(p_xy, p_z)


def _paper(
    views: list[_View], model: np.ndarray, config: RectangleEstimatorConfig
) -> tuple[_Fit | None, np.ndarray | None, str]:
    """The closed form, and its covariance by propagating the sides' offsets and angles; or why there is none."""
    X_CL = [view.X_CL for view in views]

    def pose(lines: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
        return closed_form([meet(line) for line in lines], X_CL, model, config.fine_step)

    lines = [view.lines for view in views]
    found = pose(lines)
    if found is None:
        return None, None, "the closed form has no solution"
    R, p = found
    columns = []
    for c, view in enumerate(views):
        w = view.trust * (view.scale[view.side] / view.sigma) ** 2
        total, mean, S = _side_moments(view.points, view.side, w)
        for k in range(4):
            normal = view.lines[k, :2]
            along = np.array([normal[1], -normal[0]])
            offset = 1 / math.sqrt(total[k]) + config.side_bias / view.focal
            angle = 1 / math.sqrt(max(along @ S[k] @ along, 1e-300))
            for change in ((0.0, offset), (angle, 0.0)):
                turned = normal + change[0] * along
                moved = [line.copy() for line in lines]
                moved[c][k] = [*turned, -(turned @ mean[k]) + change[1]]
                there = pose(moved)
                if there is None:
                    return None, None, "the closed form has no solution nearby"
                columns.append(np.append(frames.rotation_vector(R.T @ there[0]), there[1] - p))
        if view.bias.any():
            moved = [line.copy() for line in lines]
            moved[c][:, 2] += view.bias / view.scale
            there = pose(moved)
            if there is None:
                return None, None, "the closed form has no solution nearby"
            columns.append(np.append(frames.rotation_vector(R.T @ there[0]), there[1] - p))
    if config.fine_step == "paper":  # the printed step has a bias of its own, which the exact one shows
        exact = closed_form([meet(line) for line in lines], X_CL, model, "exact")
        if exact is not None:
            columns.append(np.append(np.zeros(3), exact[1] - p))
    J = np.array(columns)
    fit = _Fit(R=R, p=p, yaw=0.0, cost=0.0, information=np.eye(6), prior=np.zeros(6))
    return fit, J.T @ J, ""


# ---------------------------------------------------------------- gates and several frames


def _gate(views: list[_View], fit: _Fit, residual: float, config: RectangleEstimatorConfig) -> str:
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


def _triangulated_distance(views: list[_View]) -> float:
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


@dc.dataclass(frozen=True)
class FusedPose:
    """The mean of several estimates at rest, in the common frame O."""

    found: bool
    X_OV: np.ndarray = dc.field(default_factory=lambda: np.eye(3, 4))
    covariance: np.ndarray = dc.field(default_factory=lambda: np.zeros((6, 6)))  # theta in V, p in O [rad^2, m^2]
    spread: np.ndarray = dc.field(default_factory=lambda: np.zeros(6))  # standard deviation over the frames [rad, m]
    used: int = 0  # frames that took part
    axis_known: bool = False
    reason: str = ""


def fuse(estimates: Sequence[RectangleEstimate], common: float = 0.2, gate: float = 4.0) -> FusedPose:
    """Mean pose of estimates at rest, each weighted by its covariance, outliers dropped.

    common: share of an estimate's variance that all frames have in common (lens, pixel phase: the robot stands
    still), which no mean removes. gate: an estimate further than this from the median is dropped [sigma].
    """
    good = [e for e in estimates if e.found]
    if not good:
        return FusedPose(found=False, reason=estimates[-1].reason if estimates else "no estimate")
    poses = [frames.compose(e.X_OL, e.X_LV) for e in good]
    reference = next((k for k, e in enumerate(good) if e.axis_known), 0)
    R0, p0 = poses[reference][:, :3], poses[reference][:, 3]
    offsets, spreads = [], []
    for e, X in zip(good, poses):
        R, sign = X[:, :3], np.ones(6)
        if R[:, 0] @ R0[:, 0] < 0:  # the bar's two ends look alike
            R, sign[:2] = R @ _HALF_TURN, -1
        to_O = np.eye(6)
        to_O[3:, 3:] = e.X_OL[:, :3]
        C = to_O @ e.covariance @ to_O.T
        spreads.append(C * np.outer(sign, sign))
        offsets.append(np.append(frames.rotation_vector(R0.T @ R), X[:, 3] - p0))
    errors, covariances = np.array(offsets), np.array(spreads)
    off = errors - np.median(errors, axis=0)
    scatter = 1.48 * np.median(np.abs(off), axis=0)
    scale = np.maximum(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)), scatter)
    keep = (np.abs(off) < gate * scale).all(1)
    if not keep.any():
        return FusedPose(found=False, reason="the estimates disagree")
    information = np.linalg.inv(covariances[keep])
    total = np.linalg.inv(information.sum(0))
    mean = total @ np.einsum("kij,kj->i", information, errors[keep])
    n = int(keep.sum())
    left = errors[keep] - mean
    inflation = 1.0
    if n > 1:
        inflation = max(1.0, float(np.einsum("ki,kij,kj->", left, information, left)) / (6 * (n - 1)))
    return FusedPose(
        found=True,
        X_OV=frames.make(R0 @ frames.rotation(mean[:3]), p0 + mean[3:]),
        covariance=total * ((1 - common) * inflation + common * n),
        spread=left.std(0, ddof=1) if n > 1 else np.zeros(6),
        used=n,
        axis_known=any(e.axis_known for e, k in zip(good, keep) if k),
    )
