"""Block `stereo_positioning`: stage 1 on ports. No mathematics here."""

from collections.abc import Callable

import numpy as np

from valve_drake.camera.lens import StereoHead
from valve_drake.messages import RobotState, SegmentationPair, StereoPosition
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import StereoPositioningConfig
from valve_drake.perception.stereo_positioning import locate
from valve_drake.ports import Block, Inputs, Outputs


class StereoPositioningInputs(Inputs):
    segmentation: SegmentationPair = SegmentationPair()
    robot_state: RobotState


class StereoPositioningSystem(Block[StereoPositioningInputs, int]):
    """Triangulates the marker's centre in every new pair of segmented images. Memory: the last sequence.

    port          dir  type              notes
    ------------  ---  ----------------  ------------------
    segmentation  in   SegmentationPair
    robot_state   in   RobotState        where the head was
    position      out  StereoPosition

    head_pose: base (x, y, heading) in O and torso angles -> X_OL (3, 4).
    """

    OUTPUTS = {"position": StereoPosition}

    def __init__(
        self,
        config: StereoPositioningConfig,
        head: StereoHead,
        head_pose: Callable[[np.ndarray, np.ndarray], np.ndarray],
        marker: Marker | None = None,
        name: str = "stereo_positioning",
        period: float = 1 / 8,
        delay: float = 3 / 128,
    ):
        self._config, self._head, self._head_pose = config, head, head_pose
        self._marker = marker or Marker()
        self._config.check()
        self._marker.check()
        super().__init__(name, period=period, slot=3, delay=delay)

    def initial(self) -> int:
        return -1

    def step(self, time: float, inputs: StereoPositioningInputs, memory: int) -> tuple[int, Outputs]:
        pair = inputs.segmentation
        if pair.sequence == memory:
            return memory, {}
        X_OL = self._head_pose(*inputs.robot_state.head_at(pair.time))
        return pair.sequence, {"position": locate(pair, self._head, self._marker, self._config, X_OL)}
