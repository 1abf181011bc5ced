"""`refined`: the pose by least squares on the known rectangle.

    r = w l(X) . (x', y', 1),   l = h / |h_xy|,   h = P_i x P_j   (P_i, P_j: the side's corners in the camera)

with the analytic Jacobian. (x', y') are two points on each side with their joint information (perception/joint_fit.py)
or, where there is none, all edge points with robust weights; they act only through their `Moments`.

Frames: L left head camera, C either camera, V marker. theta turns V about its own axes, R exp([theta]x); p is in L [m].
"""

import dataclasses as dc
import functools
import math

import numpy as np

from valve_drake import frames
from valve_drake.least_squares import minimize
from valve_drake.perception.marker import NEXT
from valve_drake.perception.moments import Moments
from valve_drake.perception.rectangle_config import RectangleEstimatorConfig

# chi^2 must fall by so much, if the right camera is another than calibrated, before the calibration is doubted: 12
# is exceeded by chance once in 30 pairs with five unknowns. Raise it if a good head's covariances are too wide.
_CONTRADICTED = 12.0
# How far a head may be off its calibration (prior on it): the turn [rad] and the magnifications [relative].
_OTHER_CAMERA = np.array([0.02, 0.02, 0.02, 0.03, 0.03])
_NEAREST = 1e-3  # a corner less deep than this is behind the camera [m]


@dc.dataclass(frozen=True)
class Fit:
    """A pose and what is known about it."""

    R: np.ndarray  # (3, 3) R_LV
    p: np.ndarray  # (3,) p_LV [m]
    yaw: float  # of the right camera against its calibration [rad]
    cost: float  # chi^2
    information: np.ndarray  # (6 or 7, 6 or 7): theta, p, yaw, with the prior on the yaw
    gradient: np.ndarray | None = None  # (6 or 7,) half of that of chi^2; None: not a minimum, nothing is known of it


@functools.lru_cache(maxsize=16)
def _model_sides(model: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Of the model's sides: e = m_j - m_i (4, 3), and [-[c]x c; -[e]x e] (4, 6, 4), where c = m_i x m_j."""
    m = np.frombuffer(model).reshape(4, 3)
    e, c = m[NEXT] - m, frames.cross(m, m[NEXT])
    both = np.empty((4, 6, 4))
    both[:, :3, :3], both[:, 3:, :3] = -frames.skew(c), -frames.skew(e)
    both[:, :3, 3], both[:, 3:, 3] = c, e
    return e, both


def linearize(
    moments: Moments, model: np.ndarray, R: np.ndarray, p: np.ndarray, yaw: float, other_camera: bool = False
) -> tuple[np.ndarray, np.ndarray] | None:
    """Residuals (12 views,) [sigma] of the rectangle `model` (4, 3) at R_LV, p_LV, and their Jacobian by theta, p and,
    if it is unknown, yaw; None if behind a camera. other_camera: instead of by yaw, by a turn of the right camera about
    its x, y and z, and by its magnification along x and y.

    All sides of all cameras at once, since this is most of an estimate's time. With A = R_CL R and t = R_CL p + p_CL a
    corner m is at P = A m + t, so h = A c + t x (A e), with c = m_i x m_j and e = m_j - m_i of the model alone.
    """
    R_CL, p_CL = moments.R_CL, moments.p_CL
    if yaw:
        back = np.stack([frames.rot_y(-yaw * right) for right in moments.right])
        R_CL, p_CL = back @ R_CL, np.einsum("cij,cj->ci", back, p_CL)
    A, t = R_CL @ R, R_CL @ p + p_CL
    if not (A[:, 2] @ model.T + t[:, 2:]).min() > _NEAREST:
        return None
    count = len(A)
    e, both = _model_sides(model.tobytes())
    of_both = np.empty((count, 1, 3, 6))  # [A, [t]x A]
    of_both[:, 0, :, :3] = A
    np.matmul(frames.skew(t), A, out=of_both[:, 0, :, 3:])
    turned = of_both @ both  # (views, 4, 3, 4): dh by theta, and h
    n = 11 if other_camera else 7 if moments.yaw_prior else 6
    dh = np.empty((count, 4, 3, n + 1))  # by theta, p, yaw or the other camera; the last column is h itself
    dh[..., :3], dh[..., n] = turned[..., :3], turned[..., 3]
    dh[..., 3:6] = -frames.skew(e @ A.transpose(0, 2, 1)) @ R_CL[:, None]
    h = dh[..., n] * moments.right[:, None, None]  # the left camera is the frame: nothing moves it
    if n == 7:
        dh[..., 0, 6], dh[..., 1, 6], dh[..., 2, 6] = -h[..., 2], 0, h[..., 0]  # -e_y x h
    elif n == 11:
        dh[..., 6:9] = frames.skew(h)  # column k is -e_k x h
        dh[..., 9:11] = h[..., None] * [[0, 1], [1, 0], [1, 1]]
    return _normalized(moments.B, dh)


def _normalized(B: np.ndarray, dh: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals B l and their Jacobian, of l = h / |h_xy|, from dh (views, 4, 3, n + 1), whose last column is h."""
    count, _, _, columns = dh.shape
    xy = dh[..., :2, -1]
    dh /= np.sqrt((xy * xy).sum(-1))[..., None, None]
    line = dh[..., -1].copy()
    dh -= line[..., None] * (line[..., None, :2] @ dh[..., :2, :])
    dh[..., -1] = line
    out = (B @ dh.reshape(count, 12, columns)).reshape(-1, columns)
    return out[:, -1], out[:, :-1]


def refine(
    moments: Moments,
    model: np.ndarray,
    R: np.ndarray,
    p: np.ndarray,
    yaw: float,
    config: RectangleEstimatorConfig,
    enough: float = 1e-6,
    known: Fit | None = None,
) -> Fit | None:
    """The least-squares pose from R_LV, p_LV on, until a step is expected to lower chi^2 by less than `enough`; None if
    that is behind a camera. known: the fit that is there already, with the same moments.
    """
    prior = moments.yaw_prior

    def problem(state: tuple[np.ndarray, np.ndarray, float]) -> tuple[float, np.ndarray, np.ndarray]:
        at = linearize(moments, model, *state)
        if at is None:
            return math.inf, np.zeros((0, 0)), np.zeros(0)
        r, J = at
        H, g = J.T @ J, J.T @ r
        if prior:
            H[6, 6] += prior
            g[6] += prior * state[2]
        return r @ r + prior * state[2] ** 2, H, g

    def moved(state: tuple[np.ndarray, np.ndarray, float], step: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        yaw = state[2] + step[6] if prior else state[2]
        return state[0] @ frames.rotation(step[:3]), state[1] + step[3:6], yaw

    at = (known.cost, known.information, known.gradient) if known and known.gradient is not None else None
    (R, p, yaw), (cost, H, g) = minimize(
        problem, (R, p, yaw), moved, steps=config.max_iterations, enough=enough, relative=0.0, at=at
    )
    if not math.isfinite(cost):
        return None
    return Fit(R=R, p=p, yaw=float(yaw), cost=float(cost), information=H, gradient=g)


def covariance_of(moments: Moments, model: np.ndarray, fit: Fit) -> np.ndarray:
    """(6, 6) of theta [rad] and p [m], for the most frontal tilt within two standard deviations.

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
    information = at[1].T @ at[1]
    information[6:, 6:] += moments.yaw_prior
    return np.linalg.inv(information)[:6, :6]


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
