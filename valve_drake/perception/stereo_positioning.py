"""Stage 1 of the paper's figure: where the marker's centre is, seen by both head cameras."""

import numpy as np

from valve_drake.camera.lens import StereoHead
from valve_drake.camera.triangulation import triangulate
from valve_drake.messages import SegmentationPair, StereoPosition
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import StereoPositioningConfig, match


def locate(
    pair: SegmentationPair, head: StereoHead, marker: Marker, config: StereoPositioningConfig, X_OL: np.ndarray
) -> StereoPosition:
    """The marker's centre in the left camera, from the centres of the red area in both images."""
    found = match(pair.left.candidates, pair.right.candidates, head, marker, config)
    if found.reason:
        return StereoPosition(time=pair.time, sequence=pair.sequence, X_OL=X_OL, reason=found.reason)
    centers = pair.left.candidates[found.left].center, pair.right.candidates[found.right].center
    p_LV, covariance, _ = triangulate(*centers, head, config.center_sigma, config.yaw_sigma)
    return StereoPosition(
        time=pair.time, sequence=pair.sequence, found=True, p_LV=p_LV, covariance=covariance, X_OL=X_OL
    )
