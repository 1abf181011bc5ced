"""What each camera tells of the rectangle: the edges of `line_fitting`, judged and numbered alike in both cameras.

Frames: L left head camera, C either camera, V marker. Points and lines are ideal; errors are in px of the raw image.
"""

import dataclasses as dc

import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import LensModel, StereoHead
from valve_drake.messages import MarkerEdges, QuadEdges
from valve_drake.perception.marker import NEXT
from valve_drake.perception.quadrilateral import corner_offset, meet, side_lines, through_corners, weighted_lines
from valve_drake.perception.rectangle_config import RectangleEstimatorConfig


@dc.dataclass(frozen=True)
class View:
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
    room: np.ndarray  # (m, 4) from each green mark's middle to the image's left, upper, right, lower border [px]
    trust: np.ndarray  # (n,) 0..1: weight as a point of its own side
    information: np.ndarray  # (8, 8) of the nodes' distances [1/px^2], or zeros


def views_of(edges: MarkerEdges, head: StereoHead, config: RectangleEstimatorConfig) -> tuple[list[View], str]:
    """The one or two cameras whose edges can be used, left first, and ""; or none, and why."""
    views: list[View] = []
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
) -> View | str:
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
    return View(
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
        room=_room(quad.green, lens),
        trust=trust,
        information=quad.information * min(quad.sigma / sigma, 1) ** 2,
    )


def _room(points: np.ndarray, lens: LensModel) -> np.ndarray:
    """From points (m, 2) to the left, upper, right and lower border of the image (m, 4) [px]."""
    if not len(points):
        return np.zeros((0, 4))
    px = lens.project(points)
    return np.hstack([px, np.array([lens.width, lens.height]) - 1.0 - px])


def _robust_lines(
    points: np.ndarray, side: np.ndarray, sigma: float, config: RectangleEstimatorConfig
) -> tuple[np.ndarray | None, np.ndarray]:
    """Lines (4, 3) of the sides and each point's weight; points far from their own side lose theirs."""
    trust = np.ones(len(side))
    lines, scatter = side_lines(points, side)
    if config.loss != "none" and scatter > 1.5 * sigma:
        for _ in range(5):  # L1 reweighting tolerates outliers; then a cut at the points' own scale
            off = np.abs((lines[side, :2] * points).sum(1) + lines[side, 2])
            lines = weighted_lines(points, side, 1 / np.maximum(off, sigma))
        off = np.abs((lines[side, :2] * points).sum(1) + lines[side, 2])
        trust = (off < config.loss_width * max(sigma, 1.48 * float(np.median(off)))).astype(float)
        if np.bincount(side, trust, 4).min() < 2:
            return None, trust
        lines = weighted_lines(points, side, trust)
    return (lines if np.isfinite(lines).all() else None), trust


def _aligned(left: View, right: View) -> View:
    """The right view with its sides counted from the same corner as the left one's."""
    turn = corner_offset(left.corners, right.corners)
    if turn == 0:
        return right
    by_side = (right.lines, right.corners, right.scale, right.bias)
    lines, corners, scale, bias = (values[(np.arange(4) + turn) % 4] for values in by_side)
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
