"""Points in space from their images in both cameras of a stereo head.

`mid_points` is geometry alone: where two rays come nearest. `triangulate` is the least-squares point of two pixels,
with its covariance. Frames: L, R the left and right camera. Ideal points are (x', y') in the plane at unit distance.
"""

import math

import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import StereoHead


def mid_points(left: np.ndarray, right: np.ndarray, head: StereoHead) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays of ideal points (n, 2) come nearest, (n, 3) in L, and the gap between them (n,) [m].

    NaN for parallel rays.
    """
    t = head.X_LR[:, 3]
    a, b = np.ones((2, len(left), 3))
    a[:, :2], b[:, :2] = left, right
    b = b @ head.X_LR[:, :3].T
    aa, ab, bb, ta, tb = (a * a).sum(1), (a * b).sum(1), (b * b).sum(1), a @ t, b @ t
    det = aa * bb - ab * ab
    det[det < 1e-12 * aa * bb] = np.nan
    on_a = ((bb * ta - ab * tb) / det)[:, None] * a
    on_b = ((ab * ta - aa * tb) / det)[:, None] * b + t
    gap = on_a - on_b
    return (on_a + on_b) / 2, np.sqrt((gap * gap).sum(1))


def triangulate_all(head: StereoHead, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Points (n, 3) in L [m] nearest to the rays of raw px (n, 2) of both cameras; NaN for parallel rays."""
    return mid_points(head.left.normalize(left), head.right.normalize(right), head)[0]


def triangulate(
    center_left: np.ndarray, center_right: np.ndarray, head: StereoHead, sigma: float, yaw_sigma: float = 0.0
) -> tuple[np.ndarray, np.ndarray, float]:
    """Position of a point seen at raw px (2,) in both cameras: p_L (3,) [m], covariance (3, 3) [m^2], and the
    distance between the two rays' pixels after the fit [px].

    Least squares of the pixel errors (sigma [px] each, both coordinates). A relative yaw error of the cameras of
    standard deviation yaw_sigma [rad] is added to the covariance.
    """
    X_RL = frames.inverse(head.X_LR)
    xy = [head.left.normalize(center_left), head.right.normalize(center_right)]
    focal = [head.left.focal(), head.right.focal()]
    p = mid_points(xy[0][None], xy[1][None], head)[0][0]
    for _ in range(3):
        rows: list[np.ndarray] = []
        slopes: list[np.ndarray] = []
        turns: list[np.ndarray] = []
        for X, seen, f in ((frames.make(np.eye(3), np.zeros(3)), xy[0], focal[0]), (X_RL, xy[1], focal[1])):
            q = X[:, :3] @ p + X[:, 3]
            if not q[2] > 1e-6:
                return np.full(3, np.nan), np.full((3, 3), np.inf), math.inf
            P = np.array([[1, 0, -q[0] / q[2]], [0, 1, -q[1] / q[2]]]) / q[2] * f
            rows.append((q[:2] / q[2] - seen) * f)
            slopes.append(P @ X[:, :3])
            turns.append(P @ np.array([-q[2], 0, q[0]]) if X is X_RL else np.zeros(2))
        r, J, yaw = np.concatenate(rows), np.concatenate(slopes), np.concatenate(turns)
        N = np.linalg.inv(J.T @ J)
        p = p - N @ (J.T @ r)
    by_yaw = N @ (J.T @ yaw) * yaw_sigma
    return p, N * sigma**2 + np.outer(by_yaw, by_yaw), float(np.linalg.norm(r))
