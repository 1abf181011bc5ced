"""The four sides of a coloured quadrilateral to a few hundredths of a pixel.

1. `channel`: the image is mixed to ONE linear channel. From here on the cut-outs of all cameras lie side by side in one
   sheet, and each step is made once.
2. `coarse_lines`: Hough lines give the four coarse lines, and the mean of the pixels along each a better one: what is
   fitted next then needs fewer steps, and ends at the same place from any start.
3. `edges`: a blurred step is fitted to profiles across the sides, which gives one edge point a profile.
4. `joint_fit`: where light allows it, all four sides are fitted once more together, up to the corners.
5. Points (never images) are undistorted; the straight line through them is judged, and lines meet in the corners.
"""

import dataclasses as dc
import math

import numpy as np

from valve_drake.camera.lens import LensModel, StereoHead
from valve_drake.config import plain
from valve_drake.messages import MarkerCandidate, MarkerEdges, QuadEdges, SegmentationPair
from valve_drake.perception.channel import mix
from valve_drake.perception.coarse_lines import hough_corners
from valve_drake.perception.edge_profiles import Sheet
from valve_drake.perception.edges import START_BLUR, Followed, Sides, SidesConfig, follow, kept_share, place
from valve_drake.perception.joint_fit import PRIOR_POINTS, joint_fit, sums
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import StereoPositioningConfig, match, single, wrong_size
from valve_drake.perception.quadrilateral import meet, side_lines

_STEP_REACH = 4.5  # a profile must extend this far on either side to hold a blurred step [blur]
_MIN_PADDING = 12  # of a cut-out round its quadrilateral; raise it if coarse corners are worse than 2 px [px]
_CLIPPED_BIAS = 0.6  # error of a side whose level is clipped, the same way on all sides [blur]


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
        side = np.repeat(np.arange(4), raw.together.shape[1])
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
        pad = max(_MIN_PADDING, int(0.1 * (most - least).max()))  # the ring that `mix` looks at grows with the marker
        low = np.maximum(np.floor(least).astype(int) - pad, 0)
        high = np.minimum(np.ceil(most).astype(int) + pad + 1, [image.shape[1], image.shape[0]])
        if (high - low < 6).any():
            continue
        channel, contrast, clipped = mix(image[low[1] : high[1], low[0] : high[0]], start - low, config)
        if contrast < config.min_contrast:
            out[k] = RawQuad(reason=f"contrast: {contrast:.0f}")
            continue
        parts.append((k, channel, low, start - low, clipped))
    if not parts:
        return out
    number, channels, lows, near, clips = zip(*parts)
    sheet = Sheet.of(channels)
    coarse = hough_corners(sheet, np.array(near) + sheet.low[:, None])
    sides, reasons = place(sheet, coarse, config)
    fits = np.array([not reason for reason in reasons])
    own = _where(fits)
    fitted = iter(_fit_each(sheet[own], sides[own], config) if fits.any() else ())
    for q, k in enumerate(number):
        raw = next(fitted) if fits[q] else RawQuad(reason=reasons[q])
        if int(_STEP_REACH * raw.blur) > sides.half[q]:
            # A step that reaches beyond its profiles is fitted once more, to longer ones.
            one = slice(q, q + 1)
            wide, (reason,) = place(sheet[one], coarse[one], config, _STEP_REACH * raw.blur)
            if not reason and wide.half[0] > sides.half[q]:
                raw = _fit_each(sheet[one], wide, config)[0]
        if not raw.reason:
            back = lows[q] - sheet.low[q]
            together = None if raw.together is None else raw.together + back
            raw = dc.replace(raw, points=raw.points + back, together=together)
            if clips[q].any():
                raw = dc.replace(raw, bias=_CLIPPED_BIAS * max(raw.blur, START_BLUR) * clips[q])
        out[k] = raw
    return out


def _fit_each(sheet: Sheet, sides: Sides, config: SidesConfig) -> list[RawQuad]:
    """All quadrilaterals in one pass; each alone if one of them has no solution, which then says so."""
    try:
        return _fit_sides(sheet, sides, config)
    except np.linalg.LinAlgError:
        count = len(sides.half)
        if count == 1:
            return [RawQuad(reason="the light beside the sides does not determine them")]
        return [_fit_each(sheet[k : k + 1], sides[k : k + 1], config)[0] for k in range(count)]


def _fit_sides(sheet: Sheet, sides: Sides, config: SidesConfig) -> list[RawQuad]:
    """Steps 3 and 4 for all quadrilaterals together."""
    found = follow(sheet, sides, config)
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


def _judged(found: Followed, config: SidesConfig) -> tuple[list[RawQuad], np.ndarray]:
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
    sigma = np.sqrt(variance / (freedom + PRIOR_POINTS) * by_quad(1 / kept_share(found.normal)) / 4)
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
