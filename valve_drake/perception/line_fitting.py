"""The four sides of a coloured quadrilateral to a few hundredths of a pixel.

1. The image is mixed to ONE linear channel: the direction in RGB that separates inside from outside best. The light on
   either side of a shadow's edge across the marker is evened first.
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

import cv2
import numpy as np

from valve_drake.camera.lens import LensModel, StereoHead
from valve_drake.checks import require_in
from valve_drake.messages import MarkerCandidate, MarkerEdges, QuadEdges, SegmentationPair
from valve_drake.perception.color_segmentation import every, polygon_area
from valve_drake.perception.joint_fit import PRIOR_POINTS, Curves, Images, basis, joint_fit, meet, normal_cdf, sums
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.stereo_positioning import StereoPositioningConfig, match, single, wrong_size

# Of the functions 1, tau, rise, tau rise, bell, tau bell. A short side shows no trend: it is held near zero there.
_LEVEL_PRIOR = np.diag([1e-9, 0.1, 1e-9, 0.1, 1e-6, 1e-6])
_FOUR = np.arange(4)
_REACH = 4.5  # half a profile's length that holds a blurred step [blur]
_PAD = 12  # least room round the quadrilateral [px]
_LARGE = 100  # of a quadrilateral of this size colours and coarse lines are looked for at half resolution [px]
_EVEN = 0.1  # deviation over mean of the marker's inside above which a shadow is looked for
_ONE_HUE = 0.96  # least cosine between the marker's colour in the shadow and in the light
_TWO_LEVELS = 0.25  # share of that variance which two lights leave unexplained at most
_LEAST_HALF = 2  # half a profile's length at a side's ends, where the light plate is narrowest [px] ...
_LEAN = 2.5  # ... and the pixels along the side that it needs for one more
_ENOUGH = 30  # profiles of a side that find the way to its edge
_SHARP = 0.8  # blur that is looked for first: a lens in focus, and the pixel itself [px]


@dc.dataclass
class LineFittingConfig:
    half_window: int = 8  # of a profile [px]; shorter on small quadrilaterals and towards the corners
    reach: float = 0.15  # of half a profile over the quadrilateral's width, at most; the surroundings are plain there
    trim: float = 2.5  # of a side at each corner, beyond the profile's reach [px]
    gamma: float = 1.0  # light = value^gamma; 1 if pixel values are linear in light, 2.2 for ordinary cameras
    iterations: int = 5
    together: bool = True  # all sides and their corners are fitted once more with what they share
    max_sigma: float = 0.4  # scatter of the edge points about the side [px]
    min_contrast: float = 10.0  # between inside and outside [grey levels, over all channels]
    min_share: float = 0.5  # of a side's profiles that must fit
    color_only: bool = False  # compare colours and not brightness: for a mark whose surroundings are bright and dark
    single_camera: bool = False  # one camera is enough if the other sees no marker, or no sides of it

    def check(self) -> None:
        for name, low, high in (
            ("half_window", 3, 20),
            ("reach", 0.02, 0.5),
            ("trim", 0, 20),
            ("gamma", 0.3, 4),
            ("iterations", 2, 20),
            ("max_sigma", 0.01, 5),
            ("min_contrast", 1, 255),
            ("min_share", 0.1, 1),
        ):
            require_in(getattr(self, name), low, high, f"line_fitting.{name}")


@dc.dataclass(frozen=True)
class RawQuad:
    """Sub-pixel sides in the raw image; `reason` says why there are none."""

    points: np.ndarray = dc.field(default_factory=lambda: np.zeros((0, 2)))  # (n, 2) [px]
    side: np.ndarray = dc.field(default_factory=lambda: np.zeros(0, int))  # (n,) 0..3
    sigma: float = 0.0  # of a point along the side's normal [px]
    blur: float = 0.0  # standard deviation of the edge's spread [px]
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
    chosen = [found.left, found.right]
    if found.reason and config.single_camera:
        chosen = [single(seen.candidates, lens, marker, matching) for seen, lens in cameras]
        if min(chosen) >= 0:  # both see one, but not the same: neither can be trusted
            chosen = [-1, -1]
    quads = [QuadEdges(reason=found.reason)] * 2
    used = [k for k in (0, 1) if chosen[k] >= 0]
    candidates = [cameras[k][0].candidates[chosen[k]] for k in used]
    images = [cameras[k][0].frame.image for k in used]
    raw = fit_quads(images, [candidate.corners for candidate in candidates], config)
    for k, candidate, one in zip(used, candidates, raw):
        seen, lens = cameras[k]
        quads[k] = _edges_of(one, candidate, seen.green, lens, config.max_sigma)
    reason = ""
    if quads[0].found and quads[1].found:
        reason = wrong_size(quads[0].corners, quads[1].corners, head, marker, matching)
    elif len(used) == 2 and not config.single_camera:  # one camera alone takes many things for the marker
        reason = quads[0].reason or quads[1].reason
    if reason:
        quads = [quad if quad.reason else QuadEdges(reason=reason, center_px=quad.center_px) for quad in quads]
    return MarkerEdges(time=pair.time, sequence=pair.sequence, left=quads[0], right=quads[1])


def _edges_of(
    raw: RawQuad, candidate: MarkerCandidate, green: np.ndarray, lens: LensModel, max_sigma: float
) -> QuadEdges:
    """The edge points in ideal coordinates, if straight lines through them make a quadrilateral."""
    if raw.reason:
        return QuadEdges(reason=raw.reason, center_px=candidate.center)
    n = len(raw.points)
    if raw.together is None:
        points = lens.normalize(raw.points)
        lines, off = side_lines(points, raw.side)
        scatter = off * lens.focal()
    else:
        on_each = raw.together.shape[1]
        points = lens.normalize(np.concatenate([raw.points, raw.together.reshape(-1, 2)]))
        lines, off = side_lines(points[n:], np.arange(4 * on_each) // on_each)
        scatter = math.hypot(off * lens.focal(), raw.sigma)  # these are on the curves that the points scatter about
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
        corners=corners,
        corners_px=lens.project(corners),
        information=np.zeros((8, 8)) if raw.information is None else raw.information,
        center_px=candidate.center,
        green=lens.normalize(green[:, :2]) if len(green) else green[:, :2],
    )


def fit_quads(images: list[np.ndarray], corners: list[np.ndarray], config: LineFittingConfig) -> list[RawQuad]:
    """Edge points of one quadrilateral in each image (H, W, 3) uint8 RGB, within about 2 px of corners (4, 2) [px].

    Corners go clockwise as seen. All are fitted in one pass, which costs little more than one.
    """
    out: list[RawQuad] = []
    parts = []
    for k, (image, near) in enumerate(zip(images, corners)):
        pad = max(_PAD, int(0.1 * np.ptp(near, axis=0).max()))  # the ring that `_mix` looks at grows with the marker
        low = np.maximum(np.floor(near.min(0)).astype(int) - pad, 0)
        high = np.minimum(np.ceil(near.max(0)).astype(int) + pad + 1, [image.shape[1], image.shape[0]])
        out.append(RawQuad(reason="outside of the image"))
        if (high - low < 6).any():
            continue
        channel, contrast = _mix(image[low[1] : high[1], low[0] : high[0]], near - low, config)
        if contrast < config.min_contrast:
            out[k] = RawQuad(reason=f"contrast: {contrast:.0f}")
            continue
        coarse = _hough_corners(channel, near - low)
        sides = _place(channel, coarse, config)
        if isinstance(sides, str):
            out[k] = RawQuad(reason=sides)
        else:
            parts.append((k, low, coarse, sides))
    if parts:
        for (k, low, coarse, sides), raw in zip(parts, _fit_sides([part[-1] for part in parts], config)):
            if int(_REACH * raw.blur) > sides.half:
                # A step that reaches beyond its profiles is fitted once more, to longer ones.
                wide = _place(sides.channel, coarse, config, _REACH * raw.blur)
                if not isinstance(wide, str) and wide.half > sides.half:
                    raw = _fit_sides([wide], config)[0]
            together = None if raw.together is None else raw.together + low
            out[k] = raw if raw.reason else dc.replace(raw, points=raw.points + low, together=together)
    return out


def side_lines(points: np.ndarray, side: np.ndarray) -> tuple[np.ndarray, float]:
    """Total-least-squares lines: (4, 3) with unit normals, l . (x, y, 1) = 0, and the rms distance of the points.

    points (n, 2), side (n,) 0..3. A side without two points gives NaN.
    """
    middle = points.sum(0) / max(len(points), 1)
    x, y = (points - middle).T
    own = (np.asarray(side)[:, None] == _FOUR).astype(float)
    n, sx, sy, sxx, sxy, syy = np.array([np.ones(len(x)), x, y, x * x, x * y, y * y]) @ own
    safe = np.maximum(n, 1)
    mean_x, mean_y = sx / safe, sy / safe
    xx, xy, yy = sxx - sx * mean_x, sxy - sx * mean_y, syy - sy * mean_y
    angle = np.arctan2(2 * xy, xx - yy) / 2  # of the side's direction
    lines = np.empty((4, 3))
    c, s = np.cos(angle), np.sin(angle)
    lines[:, 0], lines[:, 1] = -s, c
    lines[:, 2] = s * (mean_x + middle[0]) - c * (mean_y + middle[1])
    square = float((s * s * xx - 2 * s * c * xy + c * c * yy).sum())
    lines[n < 2] = np.nan
    return lines, math.sqrt(max(square, 0.0) / max(len(points) - 8, 1))


def _mix(part: np.ndarray, corners: np.ndarray, config: LineFittingConfig) -> tuple[np.ndarray, float]:
    """One linear channel, float32: about 1 inside, about 0 outside; and the contrast it has [grey levels]."""
    step = _step(corners)
    small, corners = every(part, step), corners / step
    if config.gamma != 1.0:
        table = (255 * (np.arange(256) / 255) ** config.gamma).astype(np.float32)
        part, small = table[part], table[small]
    else:
        part, small = part.astype(np.float32), small.astype(np.float32)
    middle = corners.mean(0)

    def grown(factor: float) -> np.ndarray:
        mask = np.zeros(small.shape[:2], np.uint8)
        shape = ((middle + factor * (corners - middle)) * 16).round().astype(np.int32)
        return cv2.fillConvexPoly(mask, shape, 255, shift=4)

    inside = grown(0.75)
    part, small = _even_light(part, small, inside, step)
    core = np.array(cv2.mean(small, inside)[:3])
    ring = np.array(cv2.mean(small, cv2.subtract(grown(1.3), grown(1.14)))[:3])
    difference = core - ring
    if config.color_only:
        difference = difference - difference.mean()
    contrast = float(np.linalg.norm(difference))
    if contrast < 1e-3:
        return part[:, :, 0], 0.0
    w = difference / (difference @ (core - ring))
    return cv2.transform(part, np.array([[*w, -w @ ring]], np.float32)), contrast


def _step(corners: np.ndarray) -> int:
    """Every how many-th pixel tells the colours and the coarse lines of a quadrilateral (4, 2)."""
    return 2 if np.ptp(corners, axis=0).max() > _LARGE else 1


def _even_light(part: np.ndarray, small: np.ndarray, inside: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
    """The image (H, W, 3) float32 as if all of it were in the light, if a shadow's edge crosses the marker.

    small, and what is returned second: every step-th pixel of it; inside: mask of the marker's inside in it. It is of
    one colour, so two levels on either side of a straight edge are two lights. The edge is taken to go on straight
    beyond the marker.
    """
    mean, deviation = (x.ravel() for x in cv2.meanStdDev(small, mask=inside))
    if deviation.max() < _EVEN * mean.max():
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
    if square > _TWO_LEVELS * len(y) * y.var():
        return part, small
    levels = np.linalg.lstsq(np.column_stack([form[:, 2], np.tanh(form @ best[:3])]), colors, rcond=None)[0]
    one, other = levels[0] + levels[1], levels[0] - levels[1]
    if one @ other < _ONE_HUE * np.linalg.norm(one) * np.linalg.norm(other):
        return part, small  # something lies before the marker
    rows, columns = (np.arange(n)[shape] for n, shape in zip(part.shape, ((..., None), (None, ...))))
    s = np.tanh(((columns - middle[0]) * best[0] + (rows - middle[1]) * best[1]) / size + best[2])
    lit = np.maximum(one, other)
    part = (part / np.clip((levels[0] + levels[1] * s[..., None]) / lit, 0.1, 1)).astype(np.float32)
    return part, every(part, step)


def _hough_corners(channel: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Corners from the strongest Hough lines near the four sides, each moved to the mean of the edge pixels by it.

    A side without such a line (a wide-angle lens bends long ones) starts from its coarse one.
    """
    step = _step(corners)
    coarse, corners, channel = corners, corners / step, every(channel, step)
    gray = cv2.convertScaleAbs(cv2.max(channel, 0.0), alpha=255)
    edges = cv2.Canny(gray, 60, 120)
    band = np.zeros(edges.shape, np.uint8)
    cv2.polylines(band, [(corners * 16).round().astype(np.int32)], True, 255, 7, shift=4)
    ends = corners[NEXT]
    along = ends - corners
    lengths = np.sqrt((along * along).sum(1))
    votes = max(int(0.35 * lengths.min()), 4)
    turn = min(max(4 / lengths.max(), np.pi / 180), np.pi / 45)  # a pixel either way at the ends of a side
    edges = cv2.bitwise_and(edges, band)
    found = cv2.HoughLines(edges, 1.0, turn, votes)
    direction = along / lengths[:, None]
    lines = np.empty((4, 3))
    lines[:, 0], lines[:, 1] = -direction[:, 1], direction[:, 0]
    lines[:, 2] = -(lines[:, :2] * corners).sum(1)
    reach = np.full(4, 3.5)
    if found is not None:
        rho, theta = found[:, 0].astype(float).T
        all_lines = np.stack([np.cos(theta), np.sin(theta), -rho], -1)
        turned = np.abs(all_lines[:, :2] @ direction.T)  # (lines, 4)
        off = np.abs(all_lines[:, :2] @ ((corners + ends) / 2).T - rho[:, None])
        near = (turned < 0.2 + 2 / lengths) & (off < 3.0)
        best, seen = near.argmax(0), near.any(0)  # the most votes come first
        lines[seen], reach[seen] = all_lines[best[seen]], 2.0
    pixels = cv2.findNonZero(edges)
    if pixels is None:
        return coarse
    pixels = pixels[:, 0].astype(float)
    off = np.abs(pixels @ lines[:, :2].T + lines[:, 2])
    side = off.argmin(1)
    by = off[np.arange(len(off)), side] < reach[side]
    lines = side_lines(pixels[by], side[by])[0]
    refined = step * meet(lines)
    ok = np.isfinite(refined).all() and np.abs(refined - coarse).max() < 4 + 0.05 * step * lengths.max()
    return refined if ok else coarse


@dc.dataclass(frozen=True)
class _Sides:
    """The profiles of four sides before the fit: everything (4, ...) or (4,)."""

    channel: np.ndarray  # (H, W) float32
    flat: np.ndarray  # profiles are columns of the image (t is u), else rows (t is v)
    first: np.ndarray  # t of the first profile
    count: np.ndarray  # profiles
    start: np.ndarray  # position across the side at t = 0 ...
    slope: np.ndarray  # ... and its change with t
    inward: np.ndarray  # +-1: the way across the side that leads inside
    half: int  # of a profile [px]


def _place(channel: np.ndarray, corners: np.ndarray, config: LineFittingConfig, least: float = 0.0) -> _Sides | str:
    """Lays the profiles across the sides of a coarse quadrilateral; or why it cannot.

    least: half a profile's length that blur calls for, if the opposite side is far enough [px].
    """
    ends = corners[NEXT]
    along = ends - corners
    lengths = np.sqrt((along * along).sum(1))
    if lengths.min() < 4:
        return "small"
    flat = np.abs(along[:, 0]) >= np.abs(along[:, 1])
    t_axis = np.where(flat, 0, 1)
    slope = along[_FOUR, 1 - t_axis] / along[_FOUR, t_axis]
    cosine = 1 / np.sqrt(1 + slope**2)
    # A profile must reach neither the opposite side nor the rim of the light plate round the marker.
    width = polygon_area(corners) / lengths.max()
    half = int(max(min(max(round(config.reach * width), 3), config.half_window), min(least, 0.3 * width)))
    reach = np.maximum(config.trim, np.minimum(0.15 * lengths, 3.0)) + _LEAST_HALF * np.abs(slope) * cosine
    begin = np.minimum(corners[_FOUR, t_axis], ends[_FOUR, t_axis]) + reach * cosine
    stop = np.maximum(corners[_FOUR, t_axis], ends[_FOUR, t_axis]) - reach * cosine
    limit = np.where(flat, channel.shape[1], channel.shape[0]) - 1
    first = np.maximum(np.ceil(begin), 0).astype(int)
    count = np.minimum(np.floor(stop), limit).astype(int) - first + 1
    if count.min() < 3:
        return f"side {int(np.argmin(count))} short"
    start = corners[_FOUR, 1 - t_axis] - slope * corners[_FOUR, t_axis]
    inward = np.sign(corners.mean(0)[1 - t_axis] - (corners + ends)[_FOUR, 1 - t_axis] / 2)
    return _Sides(channel, flat, first, count, start, slope, inward, half)


def _fit_sides(quads: list[_Sides], config: LineFittingConfig) -> list[RawQuad]:
    """Step 3: the sides of all quadrilaterals together, as arrays (S sides, N profiles, M pixels)."""
    flat, first, count, start, slope, inward = (
        np.concatenate([getattr(q, name) for q in quads])
        for name in ("flat", "first", "count", "start", "slope", "inward")
    )
    half = np.repeat([float(q.half) for q in quads], 4)
    images = Images.of([q.channel for q in quads])
    origin, wide, tall = (np.repeat(a, 4) for a in (images.origin, images.wide, images.tall))
    # Pixel (t, y) of a side is pixels[origin + by_t t + by_y y].
    by_t, by_y = np.where(flat, 1, wide)[:, None], np.where(flat, wide, 1)[:, None, None]
    by_y = by_y.astype(np.int32)
    last_t, last_y = np.where(flat, wide, tall)[:, None] - 1, np.where(flat, tall, wide)[:, None, None] - 1
    last_y = last_y.astype(np.int32)
    cosine = 1 / np.sqrt(1 + slope**2)
    reach = int(half.max()) + 1
    across = np.arange(-reach, reach + 1, dtype=np.int32)
    across_32 = across.astype(np.float32)

    def profiles(k: np.ndarray) -> tuple:
        """Those with numbers k on each side, about what is known of it so far: all that the fit needs of them."""
        t = first[:, None] + k  # (S, N)
        used = k < count[:, None]
        tau = 2 * k / (count[:, None] - 1.0) - 1  # -1..1 along each side
        from_end = np.minimum(k, count[:, None] - 1 - k)
        room = half[:, None] - np.maximum(half[:, None] - _LEAST_HALF - from_end / _LEAN, 0)
        room = (room + 1).astype(np.float32)[:, :, None]  # (S, N, 1)
        line = start[:, None] + slope[:, None] * t
        powers = basis(tau)
        middle = np.rint(line + (powers @ coefficient[:, :, None])[:, :, 0])
        y = middle.astype(np.int32)[:, :, None] + across  # (S, N, M)
        inside = np.minimum(np.maximum(y, 0), last_y)
        valid = (inside == y).astype(np.float32)
        valid *= used[:, :, None]
        inside *= by_y
        inside += (origin[:, None] + by_t * np.minimum(t, last_t)).astype(np.int32)[:, :, None]
        f = images.pixels.take(inside)  # float32, as all that is per pixel
        return t, used.astype(float), tau, room, line, middle, f, valid, powers

    # On long sides the way there is found with some of the profiles, and the last step is made with all of them.
    stride = max(int(count.min()) // _ENOUGH, 1)
    coefficient = np.zeros((len(count), 3))  # of the sides' deviation from their first straight lines
    t, used, tau, room, line, middle, f, valid, powers = profiles(np.arange(0, count.max(), stride))
    bend = np.where(count >= 24, 1e-9, 1e9)  # short sides show no curvature of the lens
    good, blur, last = used, np.full(len(count), _SHARP), False
    has_step = np.full(len(count), True)
    for iteration in range(config.iterations):
        if last and stride > 1:
            k = np.arange(count.max())
            t, used, tau, room, line, middle, f, valid, powers = profiles(k)
            good = used * good[:, k // stride]
        curve = line + (powers @ coefficient[:, :, None])[:, :, 0]
        offset = (middle - curve).astype(np.float32)[:, :, None] + across_32
        weight = room - np.abs(offset)  # no pixel enters or leaves at once
        _within(weight, 0, 1, out=weight)
        weight *= valid
        width = blur  # that this step is linear about
        z = offset
        z *= (inward * cosine / blur).astype(np.float32)[:, None, None]
        bell = z * z
        bell *= np.float32(-0.5)
        np.exp(bell, out=bell)
        bell *= np.float32(1 / np.sqrt(2 * np.pi))
        rise = normal_cdf(z, bell)
        level, normal = _levels(weight, good, rise, bell, f, tau)
        has_step &= level[:, 2] >= 0.3
        base = (level[:, 0:1] + level[:, 1:2] * tau).astype(np.float32)
        height = np.maximum(level[:, 2:3] + level[:, 3:4] * tau, 0.05)  # (S, N)
        gain = bell
        gain *= (height / blur[:, None]).astype(np.float32)[:, :, None]
        residual = f - base[:, :, None]
        residual -= height.astype(np.float32)[:, :, None] * rise
        pull = weight * gain
        strength = _dot(pull, gain) + 1e-12
        shift = -_dot(pull, residual) / strength  # of each profile's edge, along the inward normal
        left = gain * shift.astype(np.float32)[:, :, None]
        left += residual
        square = _dot(weight * left, left) / np.maximum(weight @ np.ones(len(across), np.float32), 1)
        pull *= z  # weight times -d model / d blur
        pull *= good.astype(np.float32)[:, :, None]
        by_blur = pull.reshape(len(quads), 1, -1)
        wrong, scale = ((by_blur @ a.reshape(len(quads), -1, 1)).ravel().astype(float) for a in (left, gain * z))
        change = np.repeat(wrong / np.maximum(scale, 1e-12), 4)
        blur = _within(blur - _within(change, -0.5, 0.5), 0.35, 3.0)
        typical = _median(square, used)
        good = used * (square < 6 * typical[:, None] + 4e-4) * (strength > 0.2 * strength.max(1, keepdims=True))
        moved = (inward / cosine)[:, None] * _within(shift, -1.5, 1.5)
        rounds = 2 if last else 1  # outliers are looked for once the model is near
        step, good = _smooth(powers, moved, good, bend, np.sqrt(typical[:, None] / strength), rounds)
        smooth = (powers @ step[:, :, None])[:, :, 0]
        if last:
            break
        coefficient = coefficient + step
        # The next step is about a tenth of this one, and what it leaves a thousandth: the model is odd about the edge.
        settled = np.abs(used * smooth).max() < 0.5 and np.abs(change).max() < 0.25
        last = settled or iteration == config.iterations - 2
    edge = curve + moved
    kept = _kept(normal)
    curves = Curves(flat, inward, first, count, start, slope, coefficient)
    seen = sums(weight, good, rise, gain, z, residual, tau) if config.together else None
    points = np.where(flat[:, None, None], np.stack([t, edge], -1), np.stack([edge, t], -1))
    deviation = good * ((moved - smooth) * cosine[:, None]) ** 2
    predicted = good * typical[:, None] / strength
    out, scatter = [], []
    for q in range(len(quads)):
        own = slice(4 * q, 4 * q + 4)
        keep = good[own] > 0
        share = keep.sum(1) / count[own]
        n = int(keep.sum())
        freedom = n - 8 - int((bend[own] < 1).sum())
        sigma = np.sqrt(
            (deviation[own].sum() + PRIOR_POINTS * predicted[own].sum() / max(n, 1)) / (freedom + PRIOR_POINTS)
        )
        sigma *= np.sqrt(np.mean(1 / kept[own]))
        reason = ""
        if not has_step[own].all():
            reason = f"side {int(np.argmin(has_step[own]))} has no step"
        elif share.min() < config.min_share or keep.sum(1).min() < 3:
            reason = f"side {int(np.argmin(share))}: {share.min():.2f} of it fits"
        elif not sigma <= config.max_sigma:
            reason = f"sides not straight: {sigma:.2f} px"
        if reason:
            out.append(RawQuad(reason=reason))
            continue
        side = np.repeat(_FOUR, keep.sum(1))
        scatter.append((float((deviation * strength)[own].sum()), float(freedom)))
        out.append(RawQuad(points=points[own][keep], side=side, sigma=float(sigma), blur=float(blur[4 * q])))
    if seen is not None and scatter:
        fitted = np.array([not raw.reason for raw in out])
        own = np.repeat(fitted, 4)
        shared = joint_fit(
            images[fitted], curves[own], level[own], width[::4][fitted], seen[own], bend[own], np.array(scatter)
        )
        for q, both in zip(np.flatnonzero(fitted), shared):
            if both is not None:
                out[q] = dc.replace(out[q], together=both[0], information=both[1])
    return out


def _within(x: np.ndarray, low: float, high: float, out: np.ndarray | None = None) -> np.ndarray:
    """np.clip takes three times as long on small arrays."""
    return np.minimum(np.maximum(x, low, out=out), high, out=out)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum over the pixels of each profile: (S, N, M), (S, N, M) -> (S, N)."""
    return np.einsum("snm,snm->sn", a, b)


def _levels(
    weight: np.ndarray, good: np.ndarray, rise: np.ndarray, bell: np.ndarray, f: np.ndarray, tau: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of f = (b0 + b1 tau) + (a0 + a1 tau) rise + (c0 + c1 tau) bell -> (S, 4): b0, b1, a0, a1.

    The bell's share is what a shift and a turn of the side would change. Without it the levels would take part of
    a wrong start for themselves, and the fit would creep. And the normal matrix (S, 6, 6) of all six.
    """
    S, N, M = weight.shape
    functions = np.empty((S, 7, N, M), np.float32)  # each times the weight's root
    root = functions[:, 0]
    np.sqrt(weight * good.astype(np.float32)[:, :, None], out=root)
    for k, values in ((2, rise), (4, bell), (6, f)):
        np.multiply(values, root, out=functions[:, k])
    np.multiply(functions[:, :6:2], tau.astype(np.float32)[:, None, :, None], out=functions[:, 1:6:2])
    functions = functions.reshape(S, 7, -1)
    products = functions[:, :6] @ functions.transpose(0, 2, 1)
    normal = products[:, :, :6] + _LEVEL_PRIOR
    return np.linalg.solve(normal, products[:, :, 6:].astype(float))[:, :4, 0], normal


def _kept(normal: np.ndarray) -> np.ndarray:
    """(S,): the share of what the pixels know of a side's shift that is left, since they must tell its levels as well.

    All points of a side share the levels' error, so their scatter does not show it. normal: see `_levels`.
    """
    levels, bells = normal[:, :4, :4], normal[:, :4, 4:]
    taken = (bells * np.linalg.solve(levels, bells)).sum(1)
    return np.clip(1 - (taken / normal[:, [4, 5], [4, 5]]).mean(1), 0.1, 1.0)


def _median(values: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Upper median of the used entries in each row: (S, N), (S, N) -> (S,)."""
    known = used > 0
    ordered = np.where(known, values, np.inf)
    ordered.sort(axis=1)
    return ordered[np.arange(len(ordered)), np.minimum(known.sum(1) // 2, ordered.shape[1] - 1)]


def _smooth(
    basis: np.ndarray, moved: np.ndarray, good: np.ndarray, bend: np.ndarray, noise: np.ndarray, rounds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Robust curve through the profiles' shifts (S, N): its coefficients, and which profiles belong to it."""
    prior = np.zeros((len(bend), 3, 3))
    prior[:, 0, 0] = prior[:, 1, 1] = 1e-9
    prior[:, 2, 2] = bend
    for _ in range(rounds):
        weighted = (basis * good[:, :, None]).transpose(0, 2, 1)
        c = np.linalg.solve(weighted @ basis + prior, weighted @ moved[:, :, None])
        value = (basis @ c)[:, :, 0]
        off = np.abs(moved - value)
        spread = 1.48 * _median(off, good)[:, None]
        good = good * (off < 4 * np.maximum(noise, spread) + 0.02)
    return c[:, :, 0], good
