"""Block `rectangle_estimator`: stage 2 on ports. No mathematics here."""

import dataclasses as dc
from collections.abc import Callable

import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import StereoHead
from valve_drake.messages import MarkerEdges, ModeState, RectangleEstimate, RobotState
from valve_drake.perception.marker import Marker
from valve_drake.perception.rectangle_config import RectangleEstimatorConfig
from valve_drake.perception.rectangle_estimator import Track, estimate
from valve_drake.ports import Block, Inputs, Outputs


@dc.dataclass(frozen=True)
class _Memory:
    sequence: int = -1
    search: int = -1  # activation of the last search: it forgets the track
    X_OV: np.ndarray | None = None  # (3, 4) last estimate
    time: float = -1.0  # of that estimate's image [s]
    axis_known: bool = False
    angle: float = 0.0  # of a marker on the panel: the valve's, when it was seen last [rad]


class RectangleEstimatorInputs(Inputs):
    edges: MarkerEdges = MarkerEdges()
    robot_state: RobotState
    mode: ModeState


class RectangleEstimatorSystem(Block[RectangleEstimatorInputs, _Memory]):
    """Estimates the marker's pose from every new pair of edges; follows its X axis from frame to frame.

    port         dir  type               notes
    -----------  ---  -----------------  ------------------------------
    edges        in   MarkerEdges
    robot_state  in   RobotState         where the head was
    mode         in   ModeState          a new search forgets the track
    estimate     out  RectangleEstimate

    head_pose: base (x, y, heading) in O and torso angles -> X_OL (3, 4).
    """

    OUTPUTS = {"estimate": RectangleEstimate}

    def __init__(
        self,
        config: RectangleEstimatorConfig,
        head: StereoHead,
        head_pose: Callable[[np.ndarray, np.ndarray], np.ndarray],
        marker: Marker | None = None,
        name: str = "rectangle_estimator",
        period: float = 1 / 8,
        delay: float = 3 / 128,
    ):
        self._config, self._head, self._head_pose = config, head, head_pose
        self._marker = marker or Marker()
        self._config.check()
        self._marker.check()
        super().__init__(name, period=period, slot=3, delay=delay)

    def initial(self) -> _Memory:
        return _Memory()

    def step(self, time: float, inputs: RectangleEstimatorInputs, memory: _Memory) -> tuple[_Memory, Outputs]:
        state = inputs.mode
        if state.afresh and state.activation != memory.search:
            memory = _Memory(sequence=memory.sequence, search=state.activation)
        edges = inputs.edges
        if edges.sequence == memory.sequence:
            return memory, {}
        X_OL = self._head_pose(*inputs.robot_state.head_at(edges.time))
        track = None
        still = self._marker.X_VA is not None and memory.axis_known  # a marker on the panel does not turn unseen
        if memory.X_OV is not None and (still or edges.time - memory.time <= self._config.track_timeout):
            track = Track(frames.compose(frames.inverse(X_OL), memory.X_OV), memory.axis_known, memory.angle)
        result = dc.replace(estimate(edges, self._head, self._marker, self._config, track), X_OL=X_OL)
        memory = dc.replace(memory, sequence=edges.sequence)
        if result.found:
            X_OV = frames.compose(X_OL, result.X_LV)
            memory = dc.replace(memory, X_OV=X_OV, time=edges.time, axis_known=result.axis_known)
            if result.angle_seen:
                memory = dc.replace(memory, angle=result.angle)
        return memory, {"estimate": result}
