"""One linear channel of an image round a quadrilateral: about 1 inside, about 0 outside.

The image is mixed by the direction in RGB that separates inside from outside best. Light on either side of a shadow's
edge across the marker is evened first, and a colour whose light is clipped takes no part.
"""

import cv2
import numpy as np

from valve_drake.perception.edges import SidesConfig, within
from valve_drake.perception.marker import NEXT

# Quadrilaterals from this size on have their colours, and their coarse lines, read at half the resolution, which is
# faster; raise it for precision [px].
HALF_RESOLUTION_SIZE = 100
_ALONG = (np.arange(12) + 0.5) / 12  # of a side's length: where light beside it is looked at
# Deviation over mean of the marker's inside above which a shadow is looked for; raise it for a marker that is not even.
_SHADOW_DEVIATION = 0.1
# Cosine between the marker's colours in shadow and in light; below, something covers it. Lower it if shadows have a
# colour of their own.
_MIN_HUE_COSINE = 0.96
_MAX_UNEXPLAINED = 0.25  # share of the inside's variance that two levels of light may leave; raise it for soft shadows
_MASK_SCALES = np.array([0.75, 1.14, 1.3])  # of the outline: the marker's inside, and both rims of a ring round it
_DARK, _BRIGHT = 2, 253  # a value up to the one, or from the other on, may be clipped [grey levels]
_CLIPPED_SHARE = 0.05  # of the pixels beside the sides that are clipped, from which a colour is left out


def mix(part: np.ndarray, corners: np.ndarray, config: SidesConfig) -> tuple[np.ndarray, float, np.ndarray]:
    """One linear channel, float32: about 1 inside, about 0 outside; the contrast it has [grey levels]; and the share
    of clipped light beside each side that is in it (4,).

    A colour whose light is clipped takes no part if the others have contrast enough beside every side.
    """
    clipped = _clipped(part, corners)
    step = 2 if (corners.max(0) - corners.min(0)).max() > HALF_RESOLUTION_SIZE else 1
    small, corners = every_nth(part, step), corners / step
    if config.gamma != 1.0:
        table = (255 * (np.arange(256) / 255) ** config.gamma).astype(np.float32)
        part, small = cv2.LUT(part, table), cv2.LUT(small, table)
    middle = corners.sum(0) / 4
    grown = ((middle + _MASK_SCALES[:, None, None] * (corners - middle)) * 16 + 0.5).astype(np.int32)
    inside, near, far = (cv2.fillConvexPoly(np.zeros(small.shape[:2], np.uint8), c, 255, shift=4) for c in grown)
    part, small = even_light(part, small, inside, step)
    core = np.array(cv2.mean(small, inside)[:3])
    ring = np.array(cv2.mean(small, cv2.subtract(far, near))[:3])
    difference = _between(core, ring, np.full(3, True), config)
    lost = np.zeros(4)
    if clipped is not None:
        share, beside = clipped
        inner, outer = part[beside].astype(np.float32)
        whole = _between(core, ring, share.mean(0) <= _CLIPPED_SHARE, config)
        # The ring may reach beyond what lies beside the sides, so it is asked there, of most of each side.
        across = np.median((inner - outer) @ whole, axis=1)
        if across.min() > 2 * config.min_contrast * np.linalg.norm(whole):
            difference = whole
        lost = share @ np.abs(difference) / max(float(np.abs(difference).sum()), 1e-9)
    contrast = float(np.linalg.norm(difference))
    if contrast < 1e-3:
        return part[:, :, 0], 0.0, lost
    w = difference / (difference @ (core - ring))
    return cv2.transform(part.astype(np.float32), np.array([[*w, -w @ ring]], np.float32)), contrast, lost


def _between(core: np.ndarray, ring: np.ndarray, colors: np.ndarray, config: SidesConfig) -> np.ndarray:
    """By what inside and outside differ in these colours (3,), without their common brightness if it is not to count.

    One colour alone tells nothing but brightness.
    """
    difference = np.where(colors, core - ring, 0.0)
    if config.color_only and colors.any():
        difference -= np.where(colors, difference[colors].mean(), 0.0)
    return difference


def _clipped(part: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]] | None:
    """The share of clipped pixels beside each side, inside or outside, whichever is larger, in each colour: (4, 3);
    and the rows and columns (2, 4, n) of those pixels, inside and outside.

    None if there are none. An edge that is fitted to a clipped level lies off, towards the level that is not clipped.
    """
    if part.max() < _BRIGHT and part.min() > _DARK:
        return None
    along = corners[NEXT] - corners
    lengths = np.sqrt((along * along).sum(1))
    inward = np.stack([-along[:, 1], along[:, 0]], -1) / lengths[:, None]
    off = min(max(0.12 * float(lengths.min()), 3.0), 6.0) * np.array([[[[1.0]]], [[[-1.0]]]])
    at = corners[:, None] + along[:, None] * _ALONG[:, None] + off * inward[:, None]  # (2, 4, n, 2)
    u, v = np.rint(at).astype(int).transpose(3, 0, 1, 2)
    beside = within(v, 0, part.shape[0] - 1), within(u, 0, part.shape[1] - 1)
    values = part[beside]
    share = ((values >= _BRIGHT) | (values <= _DARK)).mean(2).max(0)
    return (share, beside) if share.any() else None


def every_nth(image: np.ndarray, step: int) -> np.ndarray:
    """Every step-th pixel of every step-th row (1 or 2), but perhaps the last: what slices give, sooner."""
    return image if step == 1 else cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST)


def even_light(part: np.ndarray, small: np.ndarray, inside: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
    """The image (H, W, 3) as if all of it were in the light, if a shadow's edge crosses the marker.

    small, and what is returned second: every step-th pixel of it; inside: mask of the marker's inside in it. It is of
    one colour, so two levels on either side of a straight edge are two lights. The edge is taken to go on straight
    beyond the marker.
    """
    mean, deviation = (x.ravel() for x in cv2.meanStdDev(small, mask=inside))
    if deviation.max() < _SHADOW_DEVIATION * mean.max():
        return part, small
    v, u = np.nonzero(inside)
    colors = small[v, u].astype(float)
    u, v = step * u, step * v
    y = colors @ deviation / deviation.sum()
    middle, size = np.array([u.mean(), v.mean()]), float(np.hypot(u.std(), v.std()))
    form = np.column_stack([(u - middle[0]) / size, (v - middle[1]) / size, np.ones(len(u))])
    # y = a + b tanh(form . edge). Start: a soft edge half way between the light pixels and the dark ones.
    light = y > (y.max() + y.min()) / 2
    bright, dark = form[light].mean(0)[:2], form[~light].mean(0)[:2]
    way = (bright - dark) / max(float((bright - dark) @ (bright - dark)), 1e-9)
    x = np.array([*(3 * way), -3 * way @ (bright + dark) / 2, y.mean(), y.std()])
    damping, square = 1e-2, np.inf
    for _ in range(25):
        s = np.tanh(form @ x[:3])
        left = y - x[3] - x[4] * s
        if left @ left < square:
            if left @ left > 0.9999 * square:
                break
            square, best, damping = left @ left, x, damping / 5
            J = np.column_stack([x[4] * (1 - s * s)[:, None] * form, form[:, 2], s])
            H, g = J.T @ J, J.T @ left
        else:
            damping *= 10
        x = best + np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-9), g)
    if square > _MAX_UNEXPLAINED * len(y) * y.var():
        return part, small
    levels = np.linalg.lstsq(np.column_stack([form[:, 2], np.tanh(form @ best[:3])]), colors, rcond=None)[0]
    one, other = levels[0] + levels[1], levels[0] - levels[1]
    if one @ other < _MIN_HUE_COSINE * np.linalg.norm(one) * np.linalg.norm(other):
        return part, small  # something lies before the marker
    rows, columns = (np.arange(n)[shape] for n, shape in zip(part.shape, ((..., None), (None, ...))))
    s = np.tanh(((columns - middle[0]) * best[0] + (rows - middle[1]) * best[1]) / size + best[2])
    lit = np.maximum(one, other)
    part = (part / within((levels[0] + levels[1] * s[..., None]) / lit, 0.1, 1.0)).astype(np.float32)
    return part, every_nth(part, step)
