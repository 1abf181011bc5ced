"""`refined`: the pose by least squares on the known rectangle.

    r = w l(X) . (x', y', 1),   l = h / |h_xy|,   h = P_i x P_j   (P_i, P_j: the side's corners in the camera)

with the analytic Jacobian. (x', y') are two points on each side with their joint information (perception/joint_fit.py)
or, where there is none, all edge points with robust weights. Since r is linear in l, they act only through their
moments (`Moments`): each side is two or three numbers, however many points it has, and a step costs the same at every
distance.

Frames: L left head camera, C either camera, V marker. theta turns V about its own axes, R exp([theta]x); p is in L.
"""

import dataclasses as dc
import functools
import math

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.perception.joint_fit import NODES
from valve_drake.perception.marker import NEXT
from valve_drake.perception.quadrilateral import side_moments
from valve_drake.perception.rectangle_config import RectangleEstimatorConfig
from valve_drake.perception.views import View

_FOUR, _EYE, _NODES = np.arange(4), np.eye(8), np.array(NODES)[:, None]


_CONTRADICTED = 12.0  # fall of chi^2 by another right camera from which the head's calibration is doubted
_OTHER_CAMERA = np.array([0.02, 0.02, 0.02, 0.03, 0.03])  # prior on it: its turn [rad], its magnifications [relative]
_UNEVEN_BIAS = 0.1  # part of a side's `QuadEdges.bias` in which it differs from the other sides
_LEAST_WEIGHT = 0.5  # share of a side's own weight below which the joint fit may not push it
_SHORT_SIDE = 40.0  # sides below are biased more by blur and by what surrounds them [px]
_SKEW = np.zeros((3, 9))  # v @ _SKEW is [v]x row by row
_SKEW[0, [7, 5]], _SKEW[1, [2, 6]], _SKEW[2, [3, 1]] = (1, -1), (1, -1), (1, -1)


@dc.dataclass(frozen=True)
class Moments:
    """All that least squares needs of weighted edge points: r = B l, and the part that no line can remove."""

    R_CL: np.ndarray  # (views, 3, 3)
    p_CL: np.ndarray  # (views, 3)
    right: np.ndarray  # (views,) 1.0 for the right camera, which a relative yaw moves
    yaw_prior: float  # what is known of that yaw [1/rad^2]; 0 = it is no unknown
    B: np.ndarray  # (views, 12, 12) of the four sides' l [sigma]
    floor: float  # chi^2 of the points about their own sides' best lines


@dc.dataclass(frozen=True)
class Fit:
    R: np.ndarray  # (3, 3) R_LV
    p: np.ndarray  # (3,) p_LV
    yaw: float  # of the right camera against its calibration [rad]
    cost: float  # chi^2
    information: np.ndarray  # (6 or 7, 6 or 7): theta, p, yaw
    prior: np.ndarray  # (6 or 7,) of these, the diagonal of its own information
    at: tuple[np.ndarray, np.ndarray] | None = None  # what `linearize` gave there, if that is known


def moments_of(views: list[View], weights: list[np.ndarray], config: RectangleEstimatorConfig) -> Moments:
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
        total, mean, S = side_moments(view.points, view.side, w)
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
    return Moments(R_CL=X_CL[:, :, :3], p_CL=X_CL[:, :, 3], right=right, yaw_prior=yaw_prior, B=B, floor=floor)


def point_residuals(view: View, fit: Fit, model: np.ndarray) -> np.ndarray:
    """Distances of the edge points from the projected rectangle [px]."""
    P = (model @ fit.R.T + fit.p) @ view.X_CL[:, :3].T + view.X_CL[:, 3]
    if view.right and fit.yaw:
        P = P @ frames.rot_y(fit.yaw)
    h = frames.cross(P, P[NEXT])
    line = (h / np.hypot(h[:, 0], h[:, 1])[:, None])[view.side]
    return (line[:, 0] * view.points[:, 0] + line[:, 1] * view.points[:, 1] + line[:, 2]) * view.scale[view.side]


def robust_weights(view: View, residual: np.ndarray, config: RectangleEstimatorConfig) -> np.ndarray:
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


@functools.lru_cache(maxsize=16)
def _model_sides(model: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Of the model's sides: e = m_j - m_i (4, 3), and [-[c]x c; -[e]x e] (4, 6, 4), where c = m_i x m_j."""
    m = np.frombuffer(model).reshape(4, 3)
    e, c = m[NEXT] - m, frames.cross(m, m[NEXT])
    both = np.empty((4, 6, 4))
    both[:, :3, :3], both[:, 3:, :3] = (c @ -_SKEW).reshape(4, 3, 3), (e @ -_SKEW).reshape(4, 3, 3)
    both[:, :3, 3], both[:, 3:, 3] = c, e
    return e, both


def linearize(
    moments: Moments, model: np.ndarray, R: np.ndarray, p: np.ndarray, yaw: float, other_camera: bool = False
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


def refine(
    moments: Moments,
    model: np.ndarray,
    R: np.ndarray,
    p: np.ndarray,
    yaw: float,
    config: RectangleEstimatorConfig,
    enough: float = 1e-6,
    at: tuple[np.ndarray, np.ndarray] | None = None,
) -> Fit | None:
    """Levenberg-Marquardt from (R, p), until a step is expected to lower chi^2 by less than `enough`.

    at: what `linearize` gives there, if known already.
    """
    at = at or linearize(moments, model, R, p, yaw)
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
        trial = linearize(moments, model, R_new, p_new, yaw_new)
        cost_new = math.inf if trial is None else trial[0] @ trial[0] + known * yaw_new**2
        if trial is not None and cost_new <= cost:
            R, p, yaw, at, cost = R_new, p_new, yaw_new, trial, cost_new
            damping = max(damping / 10, 1e-9)
        else:
            damping = max(damping * 10, 1e-5)
        if gain < enough or damping > 1e8:
            break
    information = at[1].T @ at[1] + np.diag(prior)
    return Fit(R=R, p=p, yaw=float(yaw), cost=float(cost), information=information, prior=prior, at=at)


def covariance_of(moments: Moments, model: np.ndarray, fit: Fit) -> np.ndarray:
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
    at = linearize(moments, model, fit.R @ frames.rotation(step[:3]), fit.p + step[3:6], yaw)
    if at is None:
        return C[:6, :6]
    return np.linalg.inv(at[1].T @ at[1] + np.diag(fit.prior))[:6, :6]


def other_camera_step(moments: Moments, model: np.ndarray, fit: Fit) -> np.ndarray | None:
    """The step of the pose (6,) that another right camera than the calibrated one would make, if the sides contradict
    the calibration; None if they do not."""
    if len(moments.right) < 2 or fit.cost - moments.floor < _CONTRADICTED:
        return None
    at = linearize(moments, model, fit.R, fit.p, fit.yaw, other_camera=True)
    if at is None:
        return None
    r, J = at
    H, g = J.T @ J, J.T @ r
    H[range(6, 11), range(6, 11)] += 1 / _OTHER_CAMERA**2
    H[7, 7] += moments.yaw_prior
    g[7] += moments.yaw_prior * fit.yaw
    step = -np.linalg.solve(H, g)
    return step[:6] if -g @ step > _CONTRADICTED else None
