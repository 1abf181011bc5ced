"""The four sides of a coloured quadrilateral to a few hundredths of a pixel.

1. The image is mixed to ONE linear channel: the direction in RGB that separates inside from outside best. The light on
   either side of a shadow's edge across the marker is evened first. From here on the cut-outs of all cameras lie side
   by side in one sheet, and each step is made once.
2. Hough lines through its edge pixels give the four coarse lines (section 4 of the paper), and the mean of the pixels
   along each a better one: what is fitted next then needs fewer steps, and ends at the same place from any start.
3. Every image column (or row, for an upright side) that crosses a side is one short profile of untouched pixels. A
   blurred step, b + A Phi(d / s) of the distance d from the side, is fitted to all of them together: levels (with a
   linear trend along the side), blur s, and the side as a smooth curve. One Gauss-Newton step per profile from there
   gives that profile's own edge point. No pixel is interpolated or used twice, so the points' errors are
   independent, but for the side's levels, whose share is counted in sigma.
4. Where light allows it, all four sides are fitted once more together, up to the corners (joint_fit.py).
5. Points (never images) are undistorted; the straight line through them is judged, and lines meet in the corners.
"""

import dataclasses as dc
import math
from typing import Any

import cv2
import numpy as np

from valve_drake.camera.lens import LensModel, StereoHead
from valve_drake.config import Config, number, plain
from valve_drake.messages import MarkerCandidate, MarkerEdges, QuadEdges, SegmentationPair
from valve_drake.perception.edge_profiles import ROW, Sheet, Terms, gram, moments, normal_cdf, normal_density
from valve_drake.perception.joint_fit import PRIOR_POINTS, Curves, basis, joint_fit, sums
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.matching import StereoPositioningConfig, match, single, wrong_size
from valve_drake.perception.quadrilateral import meet, side_lines

# 1, tau, rise, tau rise, bell, tau bell, and the grey value. A short side shows no trend: it is held near zero there.
_LEVEL_TERMS = Terms((0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1), (4, 0))
_LEVEL_PRIOR = np.diag([1e-9, 0.1, 1e-9, 0.1, 1e-6, 1e-6])
_CURVE_PRIOR, _BEND = np.diag([1e-9, 1e-9, 0.0]), np.diag([0.0, 0.0, 1.0])
_FOUR = np.arange(4)
_ALONG = (np.arange(12) + 0.5) / 12  # of a side's length: where light beside it is looked at
_STEP_REACH = 4.5  # a profile must extend this far on either side to hold a blurred step [blur]
_MIN_PADDING = 12  # of a cut-out round its quadrilateral [px]
_HALF_RESOLUTION_SIZE = 100  # from this size on colours and coarse lines come from half the resolution [px]
_SHADOW_DEVIATION = 0.1  # deviation over mean of the marker's inside above which a shadow is looked for
_MIN_HUE_COSINE = 0.96  # between the marker's colour in the shadow and in the light; lower: something covers it
_MAX_UNEXPLAINED = 0.25  # share of that variance that two levels of light may leave
_MIN_HALF_WINDOW = 2  # of a profile at a side's ends, where the light plate is narrowest [px]
_PIXELS_PER_STEP = 2.5  # the half window grows by one pixel every 2.5 px away from a corner
_COARSE_PROFILES = 30  # long sides are subsampled to this many until the last iteration
_MASK_SCALES = np.array([0.75, 1.14, 1.3])  # of the marker's outline: its inside, and both rims of a ring round it
_DARK, _BRIGHT = 2, 253  # a value up to the one, or from the other on, may be clipped
_CLIPPED_SHARE = 0.05  # of the pixels beside the sides that are clipped, from which a colour channel is left out
_CLIPPED_BIAS = 0.6  # error of a side whose level is clipped, the same way on all sides [blur]
_START_BLUR = 0.8  # of the fit: a lens in focus, and the pixel itself [px]


@dc.dataclass
class SidesConfig(Config):
    """How the sides of one quadrilateral are fitted."""

    KEY = "handle_marker.lines"
    half_window: int = number(8, 3, 20, "of a profile; shorter on small quadrilaterals and towards the corners [px]")
    reach: float = number(
        0.15, 0.02, 0.5, "of half a profile over the quadrilateral's width, at most; the surroundings are plain there"
    )
    trim: float = number(2.5, 0.0, 20.0, "of a side at each corner, beyond the profile's reach [px]")
    gamma: float = number(
        1.0, 0.3, 4.0, "light = value^gamma; 1 if pixel values are linear in light, 2.2 for ordinary cameras"
    )
    iterations: int = number(5, 2, 20, "of the fit of each side")
    together: bool = plain(True, "all sides and their corners are fitted once more with what they share")
    max_sigma: float = number(0.4, 0.01, 5.0, "scatter of the edge points about the side [px]")
    min_contrast: float = number(10.0, 1.0, 255.0, "between inside and outside [grey levels, over all channels]")
    min_share: float = number(0.5, 0.1, 1.0, "of a side's profiles that must fit")
    color_only: bool = plain(
        False, "compare colours and not brightness: for a mark whose surroundings are bright and dark"
    )


@dc.dataclass
class LineFittingConfig(SidesConfig):
    """Scenario key `line_fitting`."""

    KEY = "line_fitting"
    single_camera: bool = plain(False, "one camera is enough if the other sees no marker, or no sides of it")


@dc.dataclass(frozen=True)
class RawQuad:
    """Sub-pixel sides in the raw image; `reason` says why there are none."""

    points: np.ndarray = dc.field(default_factory=lambda: np.zeros((0, 2)))  # (n, 2) [px]
    side: np.ndarray = dc.field(default_factory=lambda: np.zeros(0, int))  # (n,) 0..3
    sigma: float = 0.0  # of a point along the side's normal [px]
    blur: float = 0.0  # standard deviation of the edge's spread [px]
    bias: np.ndarray = dc.field(default_factory=lambda: np.zeros(4))  # of each side by clipped light, see QuadEdges
    together: np.ndarray | None = None  # (4, n, 2) points on the sides, from the fit of all four together [px]
    information: np.ndarray | None = None  # (8, 8) of the sides so fitted, see QuadEdges [1/px^2]
    reason: str = ""


def fit_pair(
    pair: SegmentationPair,
    head: StereoHead,
    marker: Marker,
    config: LineFittingConfig,
    matching: StereoPositioningConfig,
) -> MarkerEdges:
    """Edges of the marker in both head images: of the pair of candidates that `match` chooses."""
    cameras = ((pair.left, head.left), (pair.right, head.right))
    found = match(pair.left.candidates, pair.right.candidates, head, marker, matching)
    chosen, why_none = [found.left, found.right], found.reason
    if found.reason and config.single_camera:
        alone = [single(seen.candidates, lens, marker, matching) for seen, lens in cameras]
        chosen = [k for k, _ in alone]
        if min(chosen) >= 0:  # both see one, but not the same: neither can be trusted
            chosen = [-1, -1]
        elif pair.right.frame.image.size == 0:  # there is one image only
            why_none = alone[0][1]
    quads: list[QuadEdges | None] = [None, None]
    used = [k for k in (0, 1) if chosen[k] >= 0]
    candidates = [cameras[k][0].candidates[chosen[k]] for k in used]
    images = [cameras[k][0].frame.image for k in used]
    raw = fit_quads(images, [candidate.corners for candidate in candidates], config)
    for k, candidate, one in zip(used, candidates, raw):
        seen, lens = cameras[k]
        quads[k] = _edges_of(one, candidate, seen.green, lens, config.max_sigma)
    left, right = (quad or QuadEdges(reason=why_none) for quad in quads)
    reason = ""
    if left.found and right.found:
        reason = wrong_size(left.corners, right.corners, head, marker, matching)
    elif len(used) == 2 and not config.single_camera:  # one camera alone takes many things for the marker
        reason = left.reason or right.reason
    if reason:
        left, right = (q if q.reason else QuadEdges(reason=reason, center_px=q.center_px) for q in (left, right))
    return MarkerEdges(time=pair.time, sequence=pair.sequence, left=left, right=right)


def _edges_of(
    raw: RawQuad, candidate: MarkerCandidate, green: np.ndarray, lens: LensModel, max_sigma: float
) -> QuadEdges:
    """The edge points in ideal coordinates, if straight lines through them make a quadrilateral."""
    if raw.reason:
        return QuadEdges(reason=raw.reason, center_px=candidate.center)
    n = len(raw.points)
    if raw.together is None:
        points, side, own = lens.normalize(raw.points), raw.side, 0.0
    else:
        points = lens.normalize(np.concatenate([raw.points, raw.together.reshape(-1, 2)]))
        side = np.repeat(_FOUR, raw.together.shape[1])
        own = raw.sigma  # these are on the curves that the points scatter about
    lines, off = side_lines(points[-len(side) :], side)
    scatter = math.hypot(off * lens.focal(), own)
    corners = meet(lines)
    if not np.isfinite(corners).all():
        return QuadEdges(reason="sides do not meet", center_px=candidate.center)
    if scatter > max_sigma:
        return QuadEdges(reason=f"sides not straight: {scatter:.2f} px", center_px=candidate.center)
    return QuadEdges(
        found=True,
        points=points[:n],
        side=raw.side,
        sigma=raw.sigma,
        bias=raw.bias,
        corners=corners,
        corners_px=lens.project(corners),
        information=np.zeros((8, 8)) if raw.information is None else raw.information,
        center_px=candidate.center,
        green=lens.normalize(green[:, :2]) if len(green) else green[:, :2],
    )


def fit_quads(images: list[np.ndarray], corners: list[np.ndarray], config: SidesConfig) -> list[RawQuad]:
    """Edge points of one quadrilateral in each image (H, W, 3) uint8 RGB, within about 2 px of corners (4, 2) [px].

    Corners go clockwise as seen. All are fitted in one pass, which costs little more than one.
    """
    out = [RawQuad(reason="outside of the image")] * len(images)
    parts = []
    for k, (image, start) in enumerate(zip(images, corners)):
        least, most = start.min(0), start.max(0)
        pad = max(_MIN_PADDING, int(0.1 * (most - least).max()))  # the ring that `_mix` looks at grows with the marker
        low = np.maximum(np.floor(least).astype(int) - pad, 0)
        high = np.minimum(np.ceil(most).astype(int) + pad + 1, [image.shape[1], image.shape[0]])
        if (high - low < 6).any():
            continue
        channel, contrast, clipped = _mix(image[low[1] : high[1], low[0] : high[0]], start - low, config)
        if contrast < config.min_contrast:
            out[k] = RawQuad(reason=f"contrast: {contrast:.0f}")
            continue
        parts.append((k, channel, low, start - low, clipped))
    if not parts:
        return out
    number, channels, lows, near, clips = zip(*parts)
    sheet = Sheet.of(channels)
    coarse = _hough_corners(sheet, np.array(near) + sheet.low[:, None])
    sides, reasons = _place(sheet, coarse, config)
    fits = np.array([not reason for reason in reasons])
    own = _where(fits)
    fitted = iter(_fit_each(sheet[own], sides[own], config) if fits.any() else ())
    for q, k in enumerate(number):
        raw = next(fitted) if fits[q] else RawQuad(reason=reasons[q])
        if int(_STEP_REACH * raw.blur) > sides.half[q]:
            # A step that reaches beyond its profiles is fitted once more, to longer ones.
            one = slice(q, q + 1)
            wide, (reason,) = _place(sheet[one], coarse[one], config, _STEP_REACH * raw.blur)
            if not reason and wide.half[0] > sides.half[q]:
                raw = _fit_each(sheet[one], wide, config)[0]
        if not raw.reason:
            back = lows[q] - sheet.low[q]
            together = None if raw.together is None else raw.together + back
            raw = dc.replace(raw, points=raw.points + back, together=together)
            if clips[q].any():
                raw = dc.replace(raw, bias=_CLIPPED_BIAS * max(raw.blur, _START_BLUR) * clips[q])
        out[k] = raw
    return out


def _mix(part: np.ndarray, corners: np.ndarray, config: SidesConfig) -> tuple[np.ndarray, float, np.ndarray]:
    """One linear channel, float32: about 1 inside, about 0 outside; the contrast it has [grey levels]; and the share
    of clipped light beside each side that is in it (4,).

    A colour whose light is clipped takes no part if the others have contrast enough.
    """
    clipped = _clipped(part, corners)
    step = 2 if (corners.max(0) - corners.min(0)).max() > _HALF_RESOLUTION_SIZE else 1
    small, corners = _every(part, step), corners / step
    if config.gamma != 1.0:
        table = (255 * (np.arange(256) / 255) ** config.gamma).astype(np.float32)
        part, small = cv2.LUT(part, table), cv2.LUT(small, table)
    middle = corners.sum(0) / 4
    grown = ((middle + _MASK_SCALES[:, None, None] * (corners - middle)) * 16 + 0.5).astype(np.int32)
    inside, near, far = (cv2.fillConvexPoly(np.zeros(small.shape[:2], np.uint8), c, 255, shift=4) for c in grown)
    part, small = _even_light(part, small, inside, step)
    core = np.array(cv2.mean(small, inside)[:3])
    ring = np.array(cv2.mean(small, cv2.subtract(far, near))[:3])
    difference = core - ring
    if config.color_only:
        difference = difference - difference.mean()
    lost = np.zeros(4)
    if clipped is not None:
        whole = np.where(clipped.mean(0) > _CLIPPED_SHARE, 0.0, difference)
        if np.linalg.norm(whole) > 2 * config.min_contrast:
            difference = whole
        lost = clipped @ np.abs(difference) / max(float(np.abs(difference).sum()), 1e-9)
    contrast = float(np.linalg.norm(difference))
    if contrast < 1e-3:
        return part[:, :, 0], 0.0, lost
    w = difference / (difference @ (core - ring))
    return cv2.transform(part.astype(np.float32), np.array([[*w, -w @ ring]], np.float32)), contrast, lost


def _clipped(part: np.ndarray, corners: np.ndarray) -> np.ndarray | None:
    """The share of clipped pixels beside each side, inside or outside, whichever is larger, in each colour: (4, 3).

    None if there are none. An edge that is fitted to a clipped level lies off, towards the level that is not clipped.
    """
    if part.max() < _BRIGHT and part.min() > _DARK:
        return None
    along = corners[NEXT] - corners
    lengths = np.sqrt((along * along).sum(1))
    inward = np.stack([-along[:, 1], along[:, 0]], -1) / lengths[:, None]
    beside = min(max(0.12 * float(lengths.min()), 3.0), 6.0) * np.array([[[[1.0]]], [[[-1.0]]]])
    at = corners[:, None] + along[:, None] * _ALONG[:, None] + beside * inward[:, None]  # (2, 4, n, 2)
    u, v = np.rint(at).astype(int).transpose(3, 0, 1, 2)
    values = part[np.clip(v, 0, part.shape[0] - 1), np.clip(u, 0, part.shape[1] - 1)]
    share = ((values >= _BRIGHT) | (values <= _DARK)).mean(2).max(0)
    return share if share.any() else None


def _every(image: np.ndarray, step: int) -> np.ndarray:
    """Every step-th pixel of every step-th row (1 or 2), but perhaps the last: what slices give, sooner."""
    return image if step == 1 else cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_NEAREST)


def _even_light(part: np.ndarray, small: np.ndarray, inside: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
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
    part = (part / np.clip((levels[0] + levels[1] * s[..., None]) / lit, 0.1, 1)).astype(np.float32)
    return part, _every(part, step)


def _hough_corners(sheet: Sheet, corners: np.ndarray) -> np.ndarray:
    """Corners (Q, 4, 2) from the strongest Hough lines near the sides, each moved to the mean of the edge pixels by it.

    A side without such a line (a wide-angle lens bends long ones) starts from its coarse one.
    """
    Q = len(corners)
    step = 2 if (corners.max(1) - corners.min(1)).max(1).min() > _HALF_RESOLUTION_SIZE else 1
    coarse, corners = corners, corners / step
    gray = cv2.convertScaleAbs(cv2.max(_every(sheet.pixels, step), 0.0), alpha=255)
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


@dc.dataclass(frozen=True)
class _Sides:
    """The profiles of the four sides of Q quadrilaterals before the fit: everything (Q, 4), half (Q,)."""

    flat: np.ndarray  # profiles are columns of the image (t is u), else rows (t is v)
    first: np.ndarray  # t of the first profile
    count: np.ndarray  # profiles
    start: np.ndarray  # position across the side at t = 0 ...
    slope: np.ndarray  # ... and its change with t
    inward: np.ndarray  # +-1: the way across the side that leads inside
    half: np.ndarray  # of a profile [px]

    def __getitem__(self, own: np.ndarray | slice) -> "_Sides":
        return _Sides(*(values[own] for values in vars(self).values()))


def _place(sheet: Sheet, corners: np.ndarray, config: SidesConfig, least: float = 0.0) -> tuple[_Sides, list[str]]:
    """Lays the profiles across the sides of coarse quadrilaterals (Q, 4, 2); and why it cannot, or "", for each.

    least: half a profile's length that blur calls for, if the opposite side is far enough [px].
    """
    ends = corners[:, NEXT]
    along = ends - corners
    lengths = np.sqrt((along * along).sum(2))
    flat = np.abs(along[:, :, 0]) >= np.abs(along[:, :, 1])

    def by_side(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Along and across each side."""
        u, v = points[:, :, 0], points[:, :, 1]
        return np.where(flat, u, v), np.where(flat, v, u)

    (begin_t, begin_y), (end_t, end_y), (middle_t, middle_y) = map(by_side, (corners, ends, corners.mean(1)[:, None]))
    slope = (end_y - begin_y) / np.where(lengths > 0, end_t - begin_t, 1)
    cosine = 1 / np.sqrt(1 + slope**2)
    # A profile must reach neither the opposite side nor the rim of the light plate round the marker.
    one, other = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    width = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) / 2 / np.maximum(lengths.max(1), 1e-9)
    half = np.minimum(np.maximum(np.rint(config.reach * width), 3), config.half_window)
    half = np.maximum(half, np.minimum(least, 0.3 * width)).astype(int)
    reach = np.maximum(config.trim, np.minimum(0.15 * lengths, 3.0)) + _MIN_HALF_WINDOW * np.abs(slope) * cosine
    reach *= cosine
    (low_t, _), (high_t, _) = by_side(sheet.low[:, None]), by_side(sheet.high[:, None])
    first = np.maximum(np.ceil(np.minimum(begin_t, end_t) + reach), low_t).astype(int)
    count = np.minimum(np.floor(np.maximum(begin_t, end_t) - reach), high_t).astype(int) - first + 1
    reasons = []
    for shortest, counts in zip(lengths.min(1), count):
        short = f"side {int(np.argmin(counts))} short" if counts.min() < 3 else ""
        reasons.append("small" if shortest < 4 else short)
    start = begin_y - slope * begin_t
    inward = np.sign(middle_y - (begin_y + end_y) / 2)
    return _Sides(flat, first, count, start, slope, inward, half), reasons


@dc.dataclass(frozen=True)
class _Followed:
    """Where the sides' edges were found to be, (S,) or (S, N) for every profile."""

    curves: Curves
    bend: np.ndarray  # prior on each side's bend
    has_step: np.ndarray  # there was one of enough height at every iteration
    t: np.ndarray  # of the profiles
    edge: np.ndarray  # position across of each profile's own edge
    good: np.ndarray  # 1 where a profile belongs to its side
    off: np.ndarray  # of its edge from the side's curve, along the normal [px]
    expected: np.ndarray  # variance of that, by the noise of the grey values [px^2]
    strength: np.ndarray  # what its pixels know of its edge's place, times the grey values' variance [1/px^2]
    tau: np.ndarray
    products: np.ndarray  # (S, 15, N), see `gram`
    level: np.ndarray  # (S, 4)
    normal: np.ndarray  # (S, 6, 6), see `_levels`
    width: np.ndarray  # blur that the last step was linear about [px] ...
    blur: np.ndarray  # ... and the one found


def _fit_each(sheet: Sheet, sides: _Sides, config: SidesConfig) -> list[RawQuad]:
    """All quadrilaterals in one pass; each alone if one of them has no solution, which then says so."""
    try:
        return _fit_sides(sheet, sides, config)
    except np.linalg.LinAlgError:
        count = len(sides.half)
        if count == 1:
            return [RawQuad(reason="the light beside the sides does not determine them")]
        return [_fit_each(sheet[k : k + 1], sides[k : k + 1], config)[0] for k in range(count)]


def _fit_sides(sheet: Sheet, sides: _Sides, config: SidesConfig) -> list[RawQuad]:
    """Steps 3 and 4 for all quadrilaterals together."""
    found = _follow(sheet, sides, config)
    out, scatter = _judged(found, config)
    fitted = np.array([not raw.reason for raw in out])
    if config.together and fitted.any():
        seen = sums(found.products, found.good, found.tau, found.level, found.width)
        one, own = _where(fitted), _where(np.repeat(fitted, 4))
        width = found.width[::4][one]
        shared = joint_fit(
            sheet[one], found.curves[own], found.level[own], width, seen[own], found.bend[own], scatter[one]
        )
        for q, both in zip(np.flatnonzero(fitted), shared):
            if both is not None:
                out[q] = dc.replace(out[q], together=both[0], information=both[1])
    return out


def _follow(sheet: Sheet, sides: _Sides, config: SidesConfig) -> _Followed:
    """Step 3, as arrays (S sides, M pixels, N profiles)."""
    Q = len(sides.half)
    flat, first, count, start, slope, inward = (
        getattr(sides, name).ravel() for name in ("flat", "first", "count", "start", "slope", "inward")
    )
    wide = sheet.pixels.shape[1]
    pixels = sheet.pixels.ravel()
    by_t, by_y = np.where(flat, 1, wide)[:, None], np.where(flat, wide, 1)[:, None]  # pixel (t, y) is t by_t + y by_y
    low, high = (
        np.repeat(ends, 4, axis=0)[np.arange(4 * Q), flat.astype(int), None] for ends in (sheet.low, sheet.high)
    )
    half = np.repeat(sides.half, 4)[:, None]
    cosine = 1 / np.sqrt(1 + slope**2)
    reach = int(half.max()) + 1
    across = np.arange(-reach, reach + 1)[:, None]
    across_32, across_at = across.astype(np.float32), by_y[:, None] * across
    # Of all profiles: where they are along the image and along the side, how long, and the first straight line.
    k = np.arange(count.max())
    all_t = first[:, None] + k
    from_end = np.minimum(k, count[:, None] - 1 - k)
    all_used = (from_end >= 0).astype(float)
    all_tau = 2 * k / (count[:, None] - 1.0) - 1  # -1..1
    rooms = all_used * (half + 1 - np.maximum(half - _MIN_HALF_WINDOW - from_end / _PIXELS_PER_STEP, 0))
    lines = start[:, None] + slope[:, None] * all_t
    all_powers = basis(all_tau)

    def profiles(stride: int) -> tuple[Any, ...]:
        """Every stride-th one of each side, about what is known of it so far: all that the fit needs of them."""
        some = np.s_[:, ::stride]
        line, powers = lines[some], all_powers[:, :, ::stride]
        middle = np.rint(line + (coefficient[:, None] @ powers)[:, 0])
        at = all_t[some] * by_t + middle.astype(int) * by_y
        functions = np.empty((len(count), 5, len(across), at.shape[1]), np.float32)  # see `gram`
        functions[:, 0] = 1
        functions[:, 4] = pixels.take(at[:, None] + across_at, mode="clip")
        return all_used[some], all_tau[some], rooms[some], line, middle, functions, powers

    def by_quad(values: np.ndarray) -> np.ndarray:
        return np.repeat(values.reshape(Q, -1).sum(1), 4)

    # On long sides the way there is found with some of the profiles, and the last step is made with all of them.
    stride = max(int(count.min()) // _COARSE_PROFILES, 1)
    coefficient = np.zeros((len(count), 3))  # of the sides' deviation from their first straight lines
    used, tau, room, line, middle, functions, powers = profiles(stride)
    bend = np.where(count >= 24, 1e-9, 1e9)  # short sides show no curvature of the lens
    good, blur, last = used, np.full(len(count), _START_BLUR), False
    has_step = np.full(len(count), True)
    for iteration in range(config.iterations):
        if last and stride > 1:
            used, tau, room, line, middle, functions, powers = profiles(1)
            good = used * good[:, k // stride]
        curve = line + (coefficient[:, None] @ powers)[:, 0]
        z = (middle - curve).astype(np.float32)[:, None] + across_32
        # Nothing counts beyond the cut-out's border; and no pixel enters or leaves at once.
        room = np.minimum(room, np.minimum(curve - low, high - curve) + 1)
        weight = room.astype(np.float32)[:, None] - np.abs(z)
        _within(weight, 0, 1, out=weight)
        z *= (inward * cosine / blur).astype(np.float32)[:, None, None]
        _, rise, bell, z_bell, _ = functions.swapaxes(0, 1)
        normal_density(z, out=bell)
        normal_cdf(z, bell, out=rise)
        np.multiply(z, bell, out=z_bell)
        products = gram(weight, functions)
        level, normal = _levels(moments(products, good, tau, _LEVEL_TERMS))
        has_step &= level[:, 2] >= 0.3
        base, height = level[:, 0:1] + level[:, 1:2] * tau, level[:, 2:3] + level[:, 3:4] * tau
        height = np.maximum(height, 0.05)
        # What is left of the grey values, by each function; that by the bell is what a shift of the edge would take.
        left = products[:, ROW[4]] - base[:, None] * products[:, ROW[0]] - height[:, None] * products[:, ROW[1]]
        gain = height / blur[:, None]
        strength = gain * gain * products[:, ROW[2][2]] + 1e-12
        shift = -gain * left[:, 2] / strength  # of each profile's edge, along the inward normal
        square = left[:, 4] - base * left[:, 0] - height * left[:, 1] - strength * shift * shift
        square /= np.maximum(products[:, ROW[0][0]], 1)
        width = blur  # that this step is linear about
        by_z = good * gain  # -d model / d blur is this times z bell
        wrong = by_z * (left[:, 3] + gain * shift * products[:, ROW[2][3]])
        scale = by_z * gain * products[:, ROW[3][3]]
        change = by_quad(wrong) / np.maximum(by_quad(scale), 1e-12)
        blur = _within(blur - _within(change, -0.5, 0.5), 0.35, 3.0)
        typical = _median(square, used)[:, None]
        good = used * (square < 6 * typical + 4e-4) * (strength > 0.2 * strength.max(1, keepdims=True))
        moved = (inward / cosine)[:, None] * _within(shift, -1.5, 1.5)
        expected = typical / strength
        rounds = 2 if last else 1  # outliers are looked for once the model is near
        step, smooth, good = _smooth(powers, moved, good, bend, np.sqrt(expected), rounds)
        if last:
            break
        coefficient = coefficient + step
        # The next step is about a tenth of this one, and what it leaves a thousandth: the model is odd about the edge.
        settled = np.abs(used * smooth).max() < 0.5 and np.abs(change).max() < 0.25
        last = settled or iteration == config.iterations - 2
    curves = Curves(flat, inward, first, count, start, slope, coefficient, cosine)
    off = (moved - smooth) * cosine[:, None]
    return _Followed(
        curves=curves,
        bend=bend,
        has_step=has_step,
        t=all_t,
        edge=curve + moved,
        good=good,
        off=off,
        expected=expected,
        strength=strength,
        tau=tau,
        products=products,
        level=level,
        normal=normal,
        width=width,
        blur=blur,
    )


def _judged(found: _Followed, config: SidesConfig) -> tuple[list[RawQuad], np.ndarray]:
    """Each quadrilateral's edge points, or why it is none; and the points' scatter (Q, 2), see `joint_fit`."""
    Q = len(found.blur) // 4

    def by_quad(values: np.ndarray) -> np.ndarray:
        return values.reshape(Q, -1).sum(1)

    keep = found.good > 0
    on_side = keep.sum(1)
    n = by_quad(on_side)
    freedom = n - 8 - by_quad(found.bend < 1)
    deviation = found.good * found.off * found.off
    variance = by_quad(deviation) + PRIOR_POINTS * by_quad(found.good * found.expected) / np.maximum(n, 1)
    sigma = np.sqrt(variance / (freedom + PRIOR_POINTS) * by_quad(1 / _kept(found.normal)) / 4)
    t, y, flat = found.t[keep], found.edge[keep], np.repeat(found.curves.flat, on_side)
    points = np.stack([np.where(flat, t, y), np.where(flat, y, t)], 1)
    side = np.repeat(np.arange(4 * Q), on_side) % 4
    share = (on_side / found.curves.count).reshape(Q, 4)
    fewest, has_step = on_side.reshape(Q, 4).min(1), found.has_step.reshape(Q, 4)
    out = []
    for q, stop in enumerate(np.cumsum(n)):
        reason = ""
        if not has_step[q].all():
            reason = f"side {int(np.argmin(has_step[q]))} has no step"
        elif share[q].min() < config.min_share or fewest[q] < 3:
            reason = f"side {int(np.argmin(share[q]))}: {share[q].min():.2f} of it fits"
        elif not sigma[q] <= config.max_sigma:
            reason = f"sides not straight: {sigma[q]:.2f} px"
        if reason:
            out.append(RawQuad(reason=reason))
        else:
            own = slice(stop - n[q], stop)
            out.append(
                RawQuad(points=points[own], side=side[own], sigma=float(sigma[q]), blur=float(found.blur[4 * q]))
            )
    return out, np.stack([by_quad(deviation * found.strength), freedom], 1)


def _where(those: np.ndarray) -> np.ndarray | slice:
    """An index of those that are True; it copies nothing if all are."""
    return slice(None) if those.all() else those


def _within(x: np.ndarray, low: float, high: float, out: np.ndarray | None = None) -> np.ndarray:
    """np.clip takes three times as long on small arrays."""
    return np.minimum(np.maximum(x, low, out=out), high, out=out)


def _levels(products: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of f = (b0 + b1 tau) + (a0 + a1 tau) rise + (c0 + c1 tau) bell -> (S, 4): b0, b1, a0, a1.

    products (S, 7, 7): of the functions and f by each other. The bell's share is what a shift and a turn of the side
    would change. Without it the levels would take part of a wrong start for themselves, and the fit would creep.
    And the normal matrix (S, 6, 6) of all six.
    """
    normal = products[:, :6, :6] + _LEVEL_PRIOR
    return np.linalg.solve(normal, products[:, :6, 6:])[:, :4, 0], normal


def _kept(normal: np.ndarray) -> np.ndarray:
    """(S,): the share of what the pixels know of a side's shift that is left, since they must tell its levels as well.

    All points of a side share the levels' error, so their scatter does not show it. normal: see `_levels`.
    """
    levels, bells = normal[:, :4, :4], normal[:, :4, 4:]
    taken = (bells * np.linalg.solve(levels, bells)).sum(1)
    whole = normal[:, 4:, 4:].diagonal(axis1=1, axis2=2)
    return _within(1 - (taken / whole).sum(1) / 2, 0.1, 1.0)


def _median(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Upper median of the used entries in each row: (S, N), (S, N) -> (S,)."""
    S, N = values.shape
    known = used > 0
    ordered = np.where(known, values, np.inf)
    ordered.sort(axis=1)
    return ordered.take(np.arange(0, S * N, N) + np.minimum(known.sum(1) // 2, N - 1))


def _smooth(
    basis: np.ndarray, moved: np.ndarray, good: np.ndarray, bend: np.ndarray, noise: np.ndarray, rounds: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Robust curve through the profiles' shifts (S, N): its coefficients, its values, and which profiles belong to it.

    basis (S, 3, N).
    """
    prior = _CURVE_PRIOR + bend[:, None, None] * _BEND
    both = np.concatenate([basis, moved[:, None]], 1).transpose(0, 2, 1)
    for _ in range(rounds):
        products = (basis * good[:, None]) @ both
        c = np.linalg.solve(products[:, :, :3] + prior, products[:, :, 3:])
        value = (c.transpose(0, 2, 1) @ basis)[:, 0]
        off = np.abs(moved - value)
        spread = 1.48 * _median(off, good)[:, None]
        good = good * (off < 4 * np.maximum(noise, spread) + 0.02)
    return c[:, :, 0], value, good
