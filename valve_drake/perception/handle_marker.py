"""The green mark of a handle in a wrist image, and the feature that the image servo controls.

No calibration is used. feature = (u, v, 1) / sqrt(area), with (u, v) the image of the mark's centre and the area
that of the fitted quadrilateral: a mask's area would shift the depth by its ring of half-lit pixels.
"""

import dataclasses as dc

import numpy as np

from valve_drake.config import Config, number
from valve_drake.messages import HandleMark
from valve_drake.perception.color_segmentation import (
    Region,
    RegionConfig,
    green_regions,
)
from valve_drake.perception.edges import SidesConfig
from valve_drake.perception.line_fitting import fit_quads
from valve_drake.perception.marker import NEXT
from valve_drake.perception.quadrilateral import from_outline, meet, middle, polygon_area, side_lines


@dc.dataclass
class HandleMarkerConfig(Config):
    """Scenario key `handle_marker`."""

    KEY = "handle_marker"
    # Marks fill much of a wrist image: the neighbourhoods are larger than the head cameras'.
    segmentation: RegionConfig = dc.field(
        default_factory=lambda: RegionConfig(small_box=181, large_box=561, min_area=150.0, max_candidates=6)
    )
    lines: SidesConfig = dc.field(default_factory=lambda: SidesConfig(color_only=True, reach=0.12, together=False))
    border: int = number(3, 0, 100, "a mark this near to the image's border is cut off [px]")
    min_fill: float = number(0.85, 0.3, 1.0, "region's area over its quadrilateral's, and the inverse")
    max_aspect: float = number(4.0, 1.0, 20.0, "long side over short side in the image")
    center_weight: float = number(1.0, 0.0, 100.0, "how much nearness to the image's centre counts against size")


def find_mark(image: np.ndarray, config: HandleMarkerConfig) -> HandleMark:
    """The nearest and most central green quadrilateral of an image (H, W, 3) uint8 RGB.

    At the border: found is False, reason "border", centre and area are those of the visible part.
    """
    regions = [r for r in green_regions(image, config.segmentation) if r.area >= config.segmentation.min_area]
    if not regions:
        return HandleMark(reason="no green region")
    reasons = []
    for region in sorted(regions, key=lambda r: -_score(r, image.shape, config)):
        mark = _judge(image, region, config)
        if mark.found or mark.reason == "border":
            return mark
        reasons.append(mark.reason)
    return HandleMark(reason=reasons[0])


def _score(region: Region, shape: tuple[int, ...], config: HandleMarkerConfig) -> float:
    half = np.array([shape[1], shape[0]]) / 2
    off = np.linalg.norm((region.center - half) / half)
    return float(np.sqrt(region.area) * region.evenness / (1 + config.center_weight * off**2))


def _judge(image: np.ndarray, region: Region, config: HandleMarkerConfig) -> HandleMark:
    low, high = region.contour.min(0), region.contour.max(0)
    last = np.array([image.shape[1], image.shape[0]]) - 1 - config.border
    if (low < config.border).any() or (high > last).any():
        return HandleMark(center=region.center, area=region.area, reason="border")
    corners = from_outline(region.contour)
    if corners is None:
        return HandleMark(reason="corners: not four")
    sides = np.linalg.norm(corners[NEXT] - corners, axis=1)
    lengths = sorted((sides[0] + sides[2], sides[1] + sides[3]))
    fill = region.area / (polygon_area(corners) + sides.sum() / 2 + 1)
    if min(fill, 1 / fill) < config.min_fill:
        return HandleMark(reason=f"fill: {fill:.2f}")
    if lengths[1] > config.max_aspect * lengths[0]:
        return HandleMark(reason="aspect")
    quad = fit_quads([image], [corners], config.lines)[0]
    if quad.reason:
        return HandleMark(reason=quad.reason)
    fitted = meet(side_lines(quad.points, quad.side)[0])
    area = polygon_area(fitted)
    if not np.isfinite(fitted).all() or not 0.7 < area / region.area < 1.4:
        return HandleMark(reason="sides do not meet")
    center = middle(fitted)
    return HandleMark(
        found=True, center=center, area=area, corners=fitted, feature=np.append(center, 1.0) / np.sqrt(area)
    )
