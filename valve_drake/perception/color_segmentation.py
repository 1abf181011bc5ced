"""Finds what may be the red marker, and the green marks, in one image.

Red, or green, is the share of that opponent channel (R - (G + B) / 2) in the brightness: a shadow's edge hardly
changes it. It is searched by LOCAL contrast against its mean over a small and a large neighbourhood, at half
resolution. Absolute hues fail with the white balance; a single neighbourhood fails when the marker is larger than it.
Every region is then cut out, halfway between its inside and its surroundings, and judged by shape:
a convex quadrilateral with even surroundings. Nothing is dropped silently: a candidate carries the reason for its
rejection.
"""

import dataclasses as dc

import cv2
import numpy as np

from valve_drake.checks import require
from valve_drake.config import Config, number, plain
from valve_drake.messages import CameraFrame, MarkerCandidate, Segmentation
from valve_drake.perception import quadrilateral
from valve_drake.perception.marker import NEXT

# Red, green and brightness of RGB; the offset stands for the noise that would else make colours of black.
_OPPONENT_MIX = np.array([[1, -0.5, -0.5, 0], [-0.5, 1, -0.5, 0], [1 / 3, 1 / 3, 1 / 3, 16]], np.float32)
_COLORS = {"red": 0, "green": 1}
_HALF_RESOLUTION_SIZE = 100  # regions from this size on are cut out at half resolution; raise it for precision [px]
_KERNEL_3X3 = np.ones((3, 3), np.uint8)
_MEAN_STEP = 4  # neighbourhood means are computed at the half resolution divided by this


@dc.dataclass
class RegionConfig(Config):
    """What a coloured region has to be to be looked at closer."""

    KEY = "handle_marker.segmentation"
    min_contrast: float = number(
        18.0, 1.0, 100.0, "of the colour's share against the neighbourhood, to look closer; lower it in faint light [%]"
    )
    small_box: int = number(61, 5, 2000, "neighbourhood whose mean is compared with [px of the full image]")
    large_box: int = number(301, 5, 4000, "and a larger one, for large markers [px of the full image]")
    min_area: float = number(60.0, 9.0, 1e6, "of a marker [px^2]")
    max_aspect: float = number(
        3.9, 1.0, 20.0, "long side over short side in the image (75 deg oblique makes 3.9 of a square)"
    )
    max_candidates: int = number(12, 1, 1000, "regions judged per image, largest contrast x area first")

    def relations(self, key: str) -> None:
        require(
            self.large_box > self.small_box, f"{key}.large_box", f"above small_box, {self.small_box}", self.large_box
        )


@dc.dataclass
class ColorSegmentationConfig(RegionConfig):
    """Scenario key `color_segmentation`."""

    KEY = "color_segmentation"
    min_opponent: float = number(24.0, 1.0, 200.0, "of R - (G + B) / 2 between inside and surroundings [grey levels]")
    min_green_area: float = number(12.0, 4.0, 1e6, "of a green mark [px^2]")
    min_fill: float = number(0.86, 0.5, 1.0, "region's area over its quadrilateral's, and the inverse")
    border: int = number(3, 0, 100, "a region this near to the image's border is cut off [px]")
    follow: bool = plain(True, "look only round the last candidates, and everywhere if they are gone")
    full_every: int = number(4, 1, 1000, "and everywhere at every n-th look")


@dc.dataclass(frozen=True)
class Region:
    """One coloured region cut out at full resolution."""

    contour: np.ndarray  # (n, 2) of its outline, pixel centres [px]
    center: np.ndarray  # (2,) centroid [px]
    area: float  # [px^2]
    contrast: float  # of R - (G + B) / 2, or of G - (R + B) / 2, inside against surroundings [grey levels]
    evenness: float  # share of the ring round the region that is clearly not of its colour


def segment(
    image: np.ndarray, config: ColorSegmentationConfig, roi: tuple[int, int, int, int] | None = None
) -> tuple[tuple[MarkerCandidate, ...], np.ndarray]:
    """Candidates for the marker (best first, rejected last), and green marks (n, 3): u, v [px], area [px^2].

    image: (H, W, 3) uint8 RGB. roi: x, y, width, height [px]: look only there.
    """
    x, y, w, h = roi if roi else (0, 0, image.shape[1], image.shape[0])
    half = _Half.of(image[y : y + h, x : x + w], (x, y))
    regions, red = _regions(image, half, config, "red")
    red += [_judge(image, region, config) for region in regions]
    accepted = sorted((c for c in red if not c.rejected), key=lambda c: -c.score)
    rejected = sorted((c for c in red if c.rejected), key=lambda c: -c.area)
    return (*accepted, *rejected), _green_marks(half, config)


def segmented(
    frame: CameraFrame, config: ColorSegmentationConfig, roi: tuple[int, int, int, int] | None = None
) -> Segmentation:
    """The frame with what `segment` finds in it."""
    candidates, green = segment(frame.image, config, roi)
    return Segmentation(frame=frame, candidates=candidates, green=green)


def green_regions(image: np.ndarray, config: RegionConfig) -> list[Region]:
    """Green regions cut out at full resolution, for the wrist cameras."""
    return _regions(image, _Half.of(image, (0, 0)), config, "green")[0]


@dc.dataclass(frozen=True)
class _Half:
    """A part of an image at half resolution, (H, W, 3) uint8, and the share of each colour in its light."""

    image: np.ndarray
    origin: tuple[int, int]  # of the part [px of the full image]
    share: dict[str, np.ndarray]  # (H, W) uint8 [%], see `_shares`

    @classmethod
    def of(cls, part: np.ndarray, origin: tuple[int, int]) -> "_Half":
        small = cv2.resize(part, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        return cls(small, origin, _shares(small))


def _shares(image: np.ndarray) -> dict[str, np.ndarray]:
    """The shares of red and of green in the light of an image (H, W, 3) uint8, none below 0; (H, W) uint8 [%]."""
    *colors, light = cv2.split(cv2.transform(image, _OPPONENT_MIX))
    return {name: cv2.divide(color, light, scale=100) for name, color in zip(_COLORS, colors)}


def _contrast(share: np.ndarray, config: RegionConfig) -> np.ndarray:
    """Largest excess of a colour's share over its means in both neighbourhoods; uint8.

    The background is at least the image's median share: else grey next to green would count as red under warm light.
    """
    size = share.shape[::-1]
    small = share
    for part in (2, _MEAN_STEP):  # two 2 x 2 reductions equal one of 4 x 4 and are faster
        small = cv2.resize(small, [max(n // part, 1) for n in size], interpolation=cv2.INTER_AREA)
    some = small[::2, ::2].ravel()
    small = cv2.max(small, float(np.partition(some, len(some) // 2)[len(some) // 2]))
    means = []
    for box in (config.small_box, config.large_box):
        # A neighbourhood larger than the image would read past its reflection.
        side = min((box // (2 * _MEAN_STEP)) | 1, 2 * min(small.shape) - 1)
        means.append(cv2.blur(small, (side, side), borderType=cv2.BORDER_REFLECT))
    mean = cv2.resize(cv2.min(*means), size, interpolation=cv2.INTER_LINEAR)
    return cv2.blur(cv2.subtract(share, mean), (3, 3))


def _outlines(mask: np.ndarray) -> list[np.ndarray]:
    return list(cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0])


def _regions(
    image: np.ndarray, half: _Half, config: RegionConfig, color: str
) -> tuple[list[Region], list[MarkerCandidate]]:
    """Regions cut out at full resolution, and those that their coarse outline already rules out."""
    contrast = _contrast(half.share[color], config)
    seeds, ruled_out = [], []
    for outline in _outlines(cv2.compare(contrast, config.min_contrast, cv2.CMP_GT)):
        bx, by, bw, bh = cv2.boundingRect(outline)
        if bw * bh * 4 < config.min_area or min(bw, bh) < 2:
            continue
        reason = _coarse_reason(outline, (bx, by, bw, bh), contrast.shape, config)
        if reason and color == "red":
            low = np.array([bx, by], float) * 2 + half.origin
            size = np.array([bw, bh], float) * 2
            corners = low + size * [[0, 0], [1, 0], [1, 1], [0, 1]]
            area = 4 * cv2.contourArea(outline)
            ruled_out.append(MarkerCandidate(corners=corners, center=low + size / 2, area=area, rejected=reason))
        elif not reason or reason == "border":
            seeds.append((cv2.sumElems(contrast[by : by + bh, bx : bx + bw])[0], (bx, by, bw, bh)))
    seeds.sort(key=lambda seed: -seed[0])
    found: list[Region] = []
    for _, box in seeds[: config.max_candidates]:
        region = _cut_out(image, half, box, contrast, color)
        if region is not None and not any(np.abs(region.center - r.center).max() < 1.5 for r in found):
            found.append(region)
    return found, ruled_out


def _coarse_reason(
    outline: np.ndarray, box: tuple[int, int, int, int], shape: tuple[int, ...], config: RegionConfig
) -> str:
    """Why a half-resolution outline cannot be the marker, or ""; generous, the fine outline decides."""
    x, y, w, h = box
    if x == 0 or y == 0 or x + w == shape[1] or y + h == shape[0]:
        return "border"
    area = cv2.contourArea(outline) + cv2.arcLength(outline, True) / 2 + 1
    hull = cv2.convexHull(outline)
    full = cv2.contourArea(hull) + cv2.arcLength(hull, True) / 2 + 1
    if area < 0.65 * full:
        return f"fill: {area / full:.2f}"
    (_, (long, short), _) = cv2.minAreaRect(hull)
    long, short = max(long, short) + 1, min(long, short) + 1
    if long > 1.5 * config.max_aspect * short:
        return f"aspect: {long / short:.1f}"
    return ""


def _cut_out(
    image: np.ndarray, half: _Half, box: tuple[int, int, int, int], contrast: np.ndarray, color: str
) -> Region | None:
    """The region of a box in the half image at full resolution, a large one at half of it.

    contrast: of the half image, whose upper half within the box marks the region's inside.
    """
    x, y, w, h = box
    pad = 2 + max(w, h) // 5
    x0, y0 = max(x - pad, 0), max(y - pad, 0)
    x1, y1 = min(x + w + pad, contrast.shape[1]), min(y + h + pad, contrast.shape[0])
    part, share = half.image[y0:y1, x0:x1], half.share[color][y0:y1, x0:x1]
    local = contrast[y : y + h, x : x + w]
    strong = cv2.compare(local, 0.6 * float(local.max()), cv2.CMP_GT)
    inside = cv2.copyMakeBorder(strong, y - y0, y1 - y - h, x - x0, x1 - x - w, cv2.BORDER_CONSTANT, value=0)
    high = cv2.mean(share, inside)[0]
    around = cv2.subtract(cv2.compare(share, high, cv2.CMP_LT), cv2.dilate(inside, _KERNEL_3X3))
    halfway = (high + cv2.mean(share, around)[0]) / 2
    step = 2 if 2 * max(w, h) > _HALF_RESOLUTION_SIZE else 1
    offset = np.array([half.origin[0] + 2 * x0, half.origin[1] + 2 * y0], float)
    if step == 1:
        u, v = offset.astype(int)
        part = image[v : v + 2 * (y1 - y0), u : u + 2 * (x1 - x0)]
        share = _shares(part)[color]
    else:
        offset += 0.5  # a pixel of the half image is the mean of four
    mask = cv2.compare(share, halfway, cv2.CMP_GT)
    seed = _outline_with_most_of(mask, inside, 2 // step)
    if seed is None:
        return None
    contour = seed[:, 0].astype(float)
    area = cv2.contourArea(seed) + cv2.arcLength(seed, True) / 2 + 1  # the outline runs through pixel centres
    m = cv2.moments(seed)
    center = np.array([m["m10"], m["m01"]]) / m["m00"] if m["m00"] > 0 else contour.mean(0)
    # The ring begins outside the blur of the edge.
    region = np.zeros(mask.shape, np.uint8)
    cv2.drawContours(region, [seed], -1, 255, -1)
    near = cv2.dilate(region, _KERNEL_3X3, iterations=2 // step)
    ring = cv2.subtract(cv2.dilate(near, _KERNEL_3X3, iterations=2 // step), near)
    ringed = cv2.countNonZero(ring)
    clear = ringed - cv2.countNonZero(cv2.bitwise_and(ring, mask))
    core = cv2.erode(region, _KERNEL_3X3) if area > 100 else region
    difference = np.subtract(cv2.mean(part, core), cv2.mean(part, ring))
    return Region(
        contour=step * contour + offset,
        center=step * center + offset,
        area=float(area) * step**2,
        contrast=float(_OPPONENT_MIX[_COLORS[color], :3] @ difference[:3]),
        evenness=clear / ringed if ringed else 0.0,
    )


def _outline_with_most_of(mask: np.ndarray, inside: np.ndarray, step: int) -> np.ndarray | None:
    """Of the outlines in `mask`, the one whose filled area holds most of `inside`, a mask of every step-th pixel."""
    outlines = sorted(_outlines(mask), key=cv2.contourArea, reverse=True)[:3]
    held = []
    for outline in outlines if len(outlines) > 1 else ():
        drawn: np.ndarray = np.zeros(mask.shape, np.uint8)
        cv2.drawContours(drawn, [outline], -1, 255, -1)
        filled: np.ndarray = np.ascontiguousarray(drawn[::step, ::step][: inside.shape[0], : inside.shape[1]])
        held.append(cv2.countNonZero(cv2.bitwise_and(filled, inside[: filled.shape[0], : filled.shape[1]])))
    if held:
        return outlines[int(np.argmax(held))] if max(held) else None
    return outlines[0] if outlines else None


def _judge(image: np.ndarray, region: Region, config: ColorSegmentationConfig) -> MarkerCandidate:
    """Judges the shape of a region."""
    low, high = region.contour.min(0), region.contour.max(0)
    corners = quadrilateral.from_outline(region.contour)
    height, width = image.shape[:2]
    rejected, score = "", 0.0
    if region.area < config.min_area:
        rejected = f"small: {region.area:.0f} px^2"
    elif (low < config.border).any() or high[0] >= width - config.border or high[1] >= height - config.border:
        rejected = "border"
    elif region.contrast < config.min_opponent:
        rejected = f"contrast: {region.contrast:.0f}"
    elif region.evenness < 0.8:
        rejected = f"surroundings: {region.evenness:.2f} clear"
    elif corners is None:
        rejected = "corners: not four"
    else:
        along = corners[NEXT] - corners
        sides = np.sqrt((along * along).sum(1)).tolist()
        # Half a pixel all round: the corners are pixel centres of the outline.
        quad_area = quadrilateral.polygon_area(corners) + sum(sides) / 2 + 1
        fill = min(region.area / quad_area, quad_area / region.area)
        # Blur rounds the corners of a small region.
        least = config.min_fill - min(1.5 / np.sqrt(region.area), 0.1)
        long, short = max(sides[0] + sides[2], sides[1] + sides[3]), min(sides[0] + sides[2], sides[1] + sides[3])
        if fill < least:
            rejected = f"fill: {fill:.2f}"
        elif long > config.max_aspect * short:
            rejected = f"aspect: {long / max(short, 1e-9):.1f}"
        elif max(abs(sides[0] - sides[2]), abs(sides[1] - sides[3])) > 0.35 * long / 2 + 3:
            rejected = "sides: opposite ones differ"
        else:
            score = fill * region.evenness * min(region.contrast / 120, 1.0) * float(np.sqrt(region.area))
    if corners is None:
        corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    return MarkerCandidate(corners=corners, center=region.center, area=region.area, score=score, rejected=rejected)


def _green_marks(half: _Half, config: ColorSegmentationConfig) -> np.ndarray:
    """Centres of small green regions, weighted by contrast, at half resolution; (n, 3)."""
    contrast = _contrast(half.share["green"], config)
    marks = []
    for outline in _outlines(cv2.compare(contrast, config.min_contrast, cv2.CMP_GT)):
        x, y, w, h = cv2.boundingRect(outline)
        box = contrast[y : y + h, x : x + w]
        core = cv2.threshold(box, float(box.max()) / 2, 255, cv2.THRESH_TOZERO)[1]
        area = 4.0 * cv2.countNonZero(core)
        if area >= config.min_green_area:
            m = cv2.moments(core)
            # Half-size pixel k covers full pixels 2k and 2k + 1.
            u, v = 2 * (x + m["m10"] / m["m00"]) + 0.5, 2 * (y + m["m01"] / m["m00"]) + 0.5
            marks.append((area, u + half.origin[0], v + half.origin[1]))
    marks.sort(reverse=True)
    return np.array([(u, v, area) for area, u, v in marks[:32]]).reshape(-1, 3)
