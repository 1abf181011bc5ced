"""The four coarse lines of a quadrilateral: Hough lines through its edge pixels (section 4 of the paper)."""

import cv2
import numpy as np

from valve_drake.perception.channel import HALF_RESOLUTION_SIZE, every_nth
from valve_drake.perception.edge_profiles import Sheet
from valve_drake.perception.marker import NEXT
from valve_drake.perception.quadrilateral import meet, side_lines


def hough_corners(sheet: Sheet, corners: np.ndarray) -> np.ndarray:
    """Corners (Q, 4, 2) from the strongest Hough lines near the sides, each moved to the mean of the edge pixels by it.

    A side without such a line (a wide-angle lens bends long ones) starts from its coarse one.
    """
    Q = len(corners)
    step = 2 if (corners.max(1) - corners.min(1)).max(1).min() > HALF_RESOLUTION_SIZE else 1
    coarse, corners = corners, corners / step
    gray = cv2.convertScaleAbs(cv2.max(every_nth(sheet.pixels, step), 0.0), alpha=255)
    edges = cv2.Canny(gray, 60, 120)
    band = np.zeros(edges.shape, np.uint8)
    cv2.polylines(band, list((corners * 16).round().astype(np.int32)), True, 255, 7, shift=4)
    edges = cv2.bitwise_and(edges, band)
    pixels = cv2.findNonZero(edges)
    if pixels is None:
        return coarse
    ends = corners[:, NEXT].reshape(-1, 2)
    begin = corners.reshape(-1, 2)
    along = ends - begin
    lengths = np.sqrt((along * along).sum(1))  # (4 Q,), as all that is of a side
    shortest, longest = lengths.reshape(Q, 4).min(1), lengths.reshape(Q, 4).max(1)
    found, of_line = [], []
    for q in range(Q):
        first = int(sheet.low[q, 0]) // step
        part = edges[:, first : int(sheet.high[q, 0]) // step + 1]
        turn = min(max(4 / longest[q], np.pi / 180), np.pi / 45)  # a pixel either way at the ends of a side
        seen = cv2.HoughLines(part, 1.0, turn, max(int(0.35 * shortest[q]), 4))
        if seen is not None:
            seen[:, 0, 0] += first * np.cos(seen[:, 0, 1])
            found.append(seen[:, 0])
            of_line += [q] * len(seen)
    lines = np.empty((4 * Q, 3))
    lines[:, 0], lines[:, 1] = -along[:, 1] / lengths, along[:, 0] / lengths
    lines[:, 2] = -(lines[:, :2] * begin).sum(1)
    reach = np.full(4 * Q, 3.5)
    of_side = np.arange(4 * Q) // 4
    if found:
        rho, theta = np.concatenate(found).astype(float).T
        voted = np.stack([np.cos(theta), np.sin(theta), -rho], 1)
        turned = np.abs(voted[:, :2] @ (along / lengths[:, None]).T)  # (lines, 4 Q)
        off = np.abs(voted[:, :2] @ ((begin + ends) / 2).T - rho[:, None])
        near = (turned < 0.2 + 2 / lengths) & (off < 3.0) & (np.array(of_line)[:, None] == of_side)
        best, seen = near.argmax(0), near.any(0)  # the most votes come first
        lines[seen], reach[seen] = voted[best[seen]], 2.0
    pixels = pixels[:, 0].astype(float)
    of_pixel = (pixels[:, :1] >= sheet.low[1:, 0] / step).sum(1)
    off = np.abs(pixels @ lines[:, :2].T + lines[:, 2])
    off[of_pixel[:, None] != of_side] = np.inf
    side = off.argmin(1)
    by = off[np.arange(len(off)), side] < reach[side]
    lines = side_lines(pixels[by], side[by], 4 * Q)[0]
    refined = step * meet(lines.reshape(Q, 4, 3))
    ok = np.abs(refined - coarse).max((1, 2)) < 4 + 0.05 * step * longest
    return np.where(ok[:, None, None], refined, coarse)
