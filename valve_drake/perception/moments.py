"""What least squares needs of the edges: the moments of each side, and the robust weights of its points.

A residual is linear in a side's line, r = B l with l (3,) of unit normal, so the points of a side act only through a
(3, 3) root of their weighted second moments, or through two nodes with a joint information matrix. Either way a
Gauss-Newton step of the pose costs the same however many points there are.
"""

import dataclasses as dc
import math

import numpy as np

from valve_drake import frames
from valve_drake.perception.joint_fit import NODES
from valve_drake.perception.marker import NEXT
from valve_drake.perception.quadrilateral import side_moments
from valve_drake.perception.rectangle_config import RectangleEstimatorConfig
from valve_drake.perception.views import View

# Share of a side's `QuadEdges.bias` in which it differs from the other sides; raise it if clipped light tilts the pose.
_UNEVEN_BIAS = 0.1
# Robust weights take at most this share of a side's own weight from it; raise it where sides are rarely half covered.
_LEAST_WEIGHT = 0.5
# Sides below this length are biased more, by blur and by what surrounds them; raise it for a blurred lens [px].
_SHORT_SIDE = 40.0
_FOUR, _NODES = np.arange(4), np.array(NODES)[:, None]


@dc.dataclass(frozen=True)
class Moments:
    """The weighted edges of one or two cameras: residuals r = B l [sigma], and what no line can remove of them."""

    R_CL: np.ndarray  # (views, 3, 3) the left camera in each
    p_CL: np.ndarray  # (views, 3) [m]
    right: np.ndarray  # (views,) 1.0 for the right camera, which a relative yaw moves
    yaw_prior: float  # what is known of that yaw [1/rad^2]; 0 = it is no unknown
    B: np.ndarray  # (views, 12, 12) by the four sides' l
    floor: float  # chi^2 of the points about their own sides' best lines


def moments_of(views: list[View], weights: list[np.ndarray], config: RectangleEstimatorConfig) -> Moments:
    """weights: of each view's edge points (n,); of no account in a view that has its sides' information."""
    B = np.zeros((len(views), 12, 12))
    floor = 0.0
    for k, view in enumerate(views):
        bias = _common_bias(view, config)
        if view.information.any():
            B[k, :8] = _of_nodes(view, bias)
        else:
            B[k], left = _of_points(view, weights[k], bias)
            floor += left
        if view.bias.any():
            _whiten(B[k], view.bias / view.scale)
    X_CL = np.array([view.X_CL for view in views])
    right = np.array([float(view.right) for view in views])
    yaw_prior = 1 / config.yaw_sigma**2 if config.yaw_sigma > 0 and right.any() else 0.0
    return Moments(R_CL=X_CL[:, :, :3], p_CL=X_CL[:, :, 3], right=right, yaw_prior=yaw_prior, B=B, floor=floor)


def _common_bias(view: View, config: RectangleEstimatorConfig) -> np.ndarray:
    """Standard deviation (4,) of what all points of a side have in common [px]: no number of points removes it."""
    along = view.corners[NEXT] - view.corners
    lengths = np.sqrt((along * along).sum(1)) * view.focal
    bias = config.side_bias * np.minimum(np.maximum((_SHORT_SIDE / lengths) ** 3, 1), 10)
    return np.hypot(bias, _UNEVEN_BIAS * view.bias) if view.bias.any() else bias


def _of_nodes(view: View, bias: np.ndarray) -> np.ndarray:
    """B (8, 12) of two nodes on each side, from their joint information."""
    # Two nodes make a side: each has twice the variance of the bias.
    common = np.repeat(2 * bias**2, 2)
    root = np.linalg.cholesky(np.linalg.solve(np.eye(8) + view.information * common, view.information))
    along = view.corners[NEXT] - view.corners
    at_node = np.ones((4, 2, 3))
    at_node[..., :2] = view.corners[:, None] + along[:, None] * _NODES
    at_node *= view.scale[:, None, None]
    distance = np.zeros((4, 2, 4, 3))  # of each side's nodes, by each side's l
    distance[_FOUR, :, _FOUR] = at_node
    return root.T @ distance.reshape(8, 12)


def _of_points(view: View, weight: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, float]:
    """B (12, 12) of the edge points, and chi^2 of them about their sides' best lines."""
    information = np.bincount(view.side, weight, 4) / view.sigma**2
    share = 1 / (1 + information * bias**2)
    w = weight * share[view.side] * (view.scale[view.side] / view.sigma) ** 2
    total, mean, S = side_moments(view.points, view.side, w)
    root = np.sqrt(total)
    rows = np.zeros((4, 3, 3))  # of each side: its mean point, then the Cholesky factor of its scatter
    rows[:, 0, 0], rows[:, 0, 1], rows[:, 0, 2] = root * mean[:, 0], root * mean[:, 1], root
    c11 = np.sqrt(S[:, 0, 0]) + 1e-150
    c21 = S[:, 0, 1] / c11
    rows[:, 1, 0], rows[:, 1, 1] = c11, c21
    rows[:, 2, 1] = np.sqrt(np.maximum(S[:, 1, 1] - c21**2, 0))
    B = np.zeros((4, 3, 4, 3))
    B[_FOUR, :, _FOUR] = rows
    half, gap = (S[:, 0, 0] + S[:, 1, 1]) / 2, np.hypot((S[:, 0, 0] - S[:, 1, 1]) / 2, S[:, 0, 1])
    return B.reshape(12, 12), float(np.maximum(half - gap, 0).sum())  # the scatter's smaller eigenvalue is left


def _whiten(B: np.ndarray, bias: np.ndarray) -> None:
    """Residuals with the covariance I + a a^T made white in place; a is what one standard deviation of the sides'
    common bias (4,), in ideal units, does to them."""
    a = B[:, 2::3] @ bias
    aa = float(a @ a)
    B -= np.outer(a, a @ B) * ((1 - 1 / math.sqrt(1 + aa)) / max(aa, 1e-300))


def point_residuals(view: View, R: np.ndarray, p: np.ndarray, yaw: float, model: np.ndarray) -> np.ndarray:
    """Distances (n,) of the edge points from the sides of the rectangle `model` (4, 3), at R_LV, p_LV [px]."""
    P = (model @ R.T + p) @ view.X_CL[:, :3].T + view.X_CL[:, 3]
    if view.right and yaw:
        P = P @ frames.rot_y(yaw)
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
