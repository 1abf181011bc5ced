"""From head images to the marker's pose (stages 1 and 2), from wrist images to the handles' marks.

Each stage is a pair: `x.py` is mathematics in plain numpy and OpenCV, `x_system.py` puts it on Drake's ports.

    estimate = estimate_rectangle(left, right, load_head("head.yaml"), (0.098, 0.100))
    estimate.X_LV, estimate.covariance
"""

import functools

import numpy as np

from valve_drake.camera.lens import StereoHead
from valve_drake.messages import CameraFrame, RectangleEstimate, Segmentation, SegmentationPair
from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segmented
from valve_drake.perception.line_fitting import LineFittingConfig, fit_pair
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import StereoPositioningConfig
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, Track, estimate


@functools.lru_cache(maxsize=64)
def _marker(size: tuple[float, ...]) -> Marker:
    """Checked once: a check takes as long as a step of the fit."""
    marker = Marker.of(size, max(0.15, max(size)))
    marker.check()
    return marker


@functools.lru_cache(maxsize=64)
def _estimator(method: str) -> RectangleEstimatorConfig:
    config = RectangleEstimatorConfig(method=method)
    config.check()
    return config


def estimate_rectangle(
    left: np.ndarray,
    right: np.ndarray | None,
    head: StereoHead,
    marker_size: tuple[float, float] = (0.098, 0.100),
    method: str = "refined",
    *,
    track: Track | None = None,
    segmentation: ColorSegmentationConfig | None = None,
    lines: LineFittingConfig | None = None,
    matching: StereoPositioningConfig | None = None,
    estimator: RectangleEstimatorConfig | None = None,
) -> RectangleEstimate:
    """The pose of the red rectangle in one or two raw images.

    left, right: (H, W, 3) uint8 RGB of the calibration's size; without `right` the left camera alone is used.
    marker_size: 2 X_w, 2 Y_w [m]. The result's `found` is False, with a `reason`, if there is no such marker.
    Raises ConfigError for an impossible marker or configuration, ValueError for images of another size.
    """
    marker = _marker(tuple(marker_size))
    # What is not given is right; checking it would cost more than a step of the fit.
    given = [config for config in (segmentation, lines, matching, estimator) if config is not None]
    segmentation = segmentation or ColorSegmentationConfig()
    lines = lines or LineFittingConfig(single_camera=right is None)
    matching = matching or StereoPositioningConfig()
    estimator = estimator or _estimator(method)
    for config in given:
        config.check()
    seen = []
    for image, lens, camera in ((left, head.left, "left"), (right, head.right, "right")):
        if image is None:
            seen.append(Segmentation())
            continue
        if image.shape != (lens.height, lens.width, 3) or image.dtype != np.uint8:
            raise ValueError(
                f"{camera} image must be {lens.width} x {lens.height} RGB uint8, got {image.shape} {image.dtype}"
            )
        # A view: the frame makes what it holds read-only, and the caller's array is not ours to lock.
        seen.append(segmented(CameraFrame(camera=camera, image=image.view()), segmentation))
    pair = SegmentationPair(left=seen[0], right=seen[1])
    return estimate(fit_pair(pair, head, marker, lines, matching), head, marker, estimator, track)


__all__ = ["estimate_rectangle"]
