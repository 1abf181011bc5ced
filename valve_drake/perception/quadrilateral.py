"""Geometry of quadrilaterals in one image plane: their corners, sides, centre and area. Nothing here sees a pixel.

Corners (4, 2) go clockwise as seen (v points down); side k joins corner k and corner k + 1. A line l (3,) has a unit
normal and holds the points with l . (x, y, 1) = 0. The plane is the raw image [px] or the ideal one at unit distance.
"""

import math

import cv2
import numpy as np

from valve_drake.perception.marker import NEXT

BEFORE = [3, 0, 1, 2]  # of each corner, or side, the one before it
COUNTED_FROM = (np.arange(4)[:, None] + np.arange(4)) % 4  # row k: the corners counted from the k-th one


def from_outline(contour: np.ndarray) -> np.ndarray | None:
    """The four corners that an outline (n, 2) simplifies to, clockwise as seen, or None -> (4, 2) [px].

    A corner that something covers is where the sides beside it would meet.
    """
    hull = cv2.convexHull(contour.astype(np.float32).reshape(-1, 1, 2))
    length = cv2.arcLength(hull, True)
    for share in (0.02, 0.03, 0.045, 0.06, 0.08):
        corners = cv2.approxPolyDP(hull, share * length, True)[:, 0].astype(float)
        if len(corners) == 5:
            corners = _without_cut(corners)
        if len(corners) == 4:
            return corners if _signed_area(corners) > 0 else corners[::-1]
    return None


def _without_cut(corners: np.ndarray) -> np.ndarray:
    """A convex pentagon (5, 2) with that side removed whose neighbours then meet nearest, if they do so nearby."""
    before, after = np.roll(corners, 1, 0), np.roll(corners, -2, 0)
    end = np.roll(corners, -1, 0)
    a, b, gap = corners - before, end - after, end - corners  # neighbours of side k, lengthened
    turn = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    turn = np.where(np.abs(turn) < 1e-9, 1e-9, turn)
    s = (gap[:, 0] * b[:, 1] - gap[:, 1] * b[:, 0]) / turn
    t = (gap[:, 0] * a[:, 1] - gap[:, 1] * a[:, 0]) / turn
    added = np.where((s > 0) & (t > 0), np.abs(s * t * turn), np.inf)  # twice the triangle's area
    k = int(np.argmin(added))
    if not added[k] < 0.2 * polygon_area(corners):
        return corners
    corners = corners.copy()
    corners[k] += s[k] * a[k]
    return np.delete(corners, (k + 1) % 5, 0)


def _signed_area(p: np.ndarray) -> float:
    """Positive when clockwise as seen in an image (v down)."""
    q = p[NEXT] if len(p) == 4 else np.roll(p, -1, 0)
    return float(p[:, 0] @ q[:, 1] - p[:, 1] @ q[:, 0]) / 2


def polygon_area(corners: np.ndarray) -> float:
    """Of a polygon (n, 2), whichever way it turns [square of the corners' unit]."""
    return abs(_signed_area(corners))


def middle(corners: np.ndarray) -> np.ndarray:
    """Where the diagonals of a quadrilateral (4, 2) meet, (2,): the image of a rectangle's centre."""
    a, b, gap = corners[2] - corners[0], corners[3] - corners[1], corners[1] - corners[0]
    return corners[0] + a * ((gap[0] * b[1] - gap[1] * b[0]) / (a[0] * b[1] - a[1] * b[0]))


def side_lines(points: np.ndarray, side: np.ndarray, sides: int = 4) -> tuple[np.ndarray, float]:
    """Total-least-squares lines: (sides, 3) with unit normals, l . (x, y, 1) = 0, and the rms distance of the points.

    points (n, 2), side (n,) 0..sides - 1. A side without two points gives NaN.
    """
    middle = points.sum(0) / max(len(points), 1)
    terms = np.empty((6, len(points)))
    terms[0] = 1
    x, y = np.subtract(points.T, middle[:, None], out=terms[1:3])
    np.multiply(x, terms[1:3], out=terms[3:5])
    np.multiply(y, y, out=terms[5])
    n, sx, sy, sxx, sxy, syy = terms @ (np.asarray(side)[:, None] == np.arange(sides)).astype(float)
    safe = np.maximum(n, 1)
    mean_x, mean_y = sx / safe, sy / safe
    xx, xy, yy = sxx - sx * mean_x, sxy - sx * mean_y, syy - sy * mean_y
    angle = np.arctan2(2 * xy, xx - yy) / 2  # of the side's direction
    lines = np.empty((sides, 3))
    c, s = np.cos(angle), np.sin(angle)
    lines[:, 0], lines[:, 1] = -s, c
    lines[:, 2] = s * (mean_x + middle[0]) - c * (mean_y + middle[1])
    square = float((s * s * xx - 2 * s * c * xy + c * c * yy).sum())
    if n.min() < 2:
        lines[n < 2] = np.nan
    return lines, math.sqrt(max(square, 0.0) / max(len(points) - 2 * sides, 1))


def weighted_lines(points: np.ndarray, side: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The lines (4, 3) of four sides as of `side_lines`, each point (n, 2) with its weight (n,)."""
    _, mean, scatter = side_moments(points, side, weight)
    angle = np.arctan2(2 * scatter[:, 0, 1], scatter[:, 0, 0] - scatter[:, 1, 1]) / 2
    normal = np.stack([-np.sin(angle), np.cos(angle)], -1)
    return np.column_stack([normal, -(normal * mean).sum(1)])


def side_moments(points: np.ndarray, side: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weight (4,), mean (4, 2) and weighted scatter (4, 2, 2) of the points of each side."""
    total = np.bincount(side, weight, 4)
    safe = np.maximum(total, 1e-300)[:, None]
    mean = np.stack([np.bincount(side, weight * points[:, k], 4) for k in (0, 1)], -1) / safe
    d = points - mean[side]
    wx = weight * d[:, 0]
    xx, xy = np.bincount(side, wx * d[:, 0], 4), np.bincount(side, wx * d[:, 1], 4)
    yy = np.bincount(side, weight * d[:, 1] ** 2, 4)
    return total, mean, np.stack([xx, xy, xy, yy], -1).reshape(4, 2, 2)


def through_corners(corners: np.ndarray) -> np.ndarray:
    """The lines (4, 3) of the sides between corners (4, 2), positive inside; unit normals."""
    along = corners[NEXT] - corners
    lines = np.empty((4, 3))
    lines[:, 0], lines[:, 1] = -along[:, 1], along[:, 0]
    lines[:, :2] /= np.sqrt((along * along).sum(1))[:, None]
    lines[:, 2] = -(lines[:, :2] * corners).sum(1)
    return lines


def meet(lines: np.ndarray) -> np.ndarray:
    """Corners (..., 4, 2) of four sides (..., 4, 3): corner k is where sides k - 1 and k meet, NaN if they do not."""
    x, y, z = lines[..., 0], lines[..., 1], lines[..., 2]
    ax, ay, az = x[..., BEFORE], y[..., BEFORE], z[..., BEFORE]
    det = ax * y - ay * x
    det = np.where(det == 0, np.nan, det)
    out = np.empty((*det.shape, 2))
    out[..., 0], out[..., 1] = (ay * z - az * y) / det, (az * x - ax * z) / det
    return out


def corner_offset(left: np.ndarray, right: np.ndarray) -> int:
    """How many corners the right quadrilateral's first one (4, 2) lies behind the left one's: 0..3."""
    # Of the squared distances of all corners only the products depend on the turn.
    products = (left - left.sum(0) / 4) @ (right - right.sum(0) / 4).T
    return int(np.argmax(products[np.arange(4), COUNTED_FROM].sum(1)))
