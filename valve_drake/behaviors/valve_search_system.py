"""Block `valve_search`: the search and the gaze on ports. No mathematics here."""

import dataclasses as dc

import numpy as np

from valve_drake.behaviors.valve_search import HeadPose, Memory, ValveSearchConfig, step
from valve_drake.messages import Command, ModeState, RectangleEstimate, RobotState, Status, StereoPosition
from valve_drake.ports import TICK, Block, Inputs, Outputs


class ValveSearchInputs(Inputs):
    robot_state: RobotState
    mode: ModeState
    position: StereoPosition = StereoPosition()
    estimate: RectangleEstimate = RectangleEstimate()


class ValveSearchSystem(Block[ValveSearchInputs, Memory]):
    """Search and gaze; 1/64 s (wheels and neck need no more), slot 1.

    port         dir  type               notes
    -----------  ---  -----------------  ---------------------------------------
    robot_state  in   RobotState
    mode         in   ModeState
    position     in   StereoPosition     stage 1
    estimate     in   RectangleEstimate  stage 2
    command      out  Command            torso always, base_twist in search
    status       out  Status

    head_pose: base (x, y, heading) in O, torso (n,) -> X_OL (3, 4). rest: the torso's joints at home (n,). waist: which
    of them is the waist; None: the robot has none. The last two are tilt and pan. The gaze is that of waist (0 if there
    is none), tilt and pan; what else the torso has stays at home.
    """

    OUTPUTS = {"command": Command, "status": Status}

    def __init__(
        self,
        config: ValveSearchConfig,
        head_pose: HeadPose,
        rest: np.ndarray,
        waist: int | None,
        name: str = "valve_search",
    ):
        config.check()
        self.config = config if waist is not None else dc.replace(config, sweep_waist=0.0)
        self._rest, self._waist = rest, waist
        self._plain = waist == 0 and len(rest) == 3  # the torso is the gaze
        self.head_pose = head_pose if self._plain else lambda base, gaze: head_pose(base, self._torso(gaze))
        super().__init__(name, period=2 * TICK)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: ValveSearchInputs, memory: Memory) -> tuple[Memory, Outputs]:
        memory, command, status = step(
            self.config,
            memory,
            time,
            self.period,
            self._seen(inputs.robot_state),
            inputs.mode,
            inputs.position,
            inputs.estimate,
            self.head_pose,
        )
        if command.torso is not None and not self._plain:
            command = dc.replace(command, torso=self._torso(command.torso))
        return memory, {"command": command, "status": status}

    def _seen(self, state: RobotState) -> RobotState:
        """The state with the gaze for its torso."""
        if self._plain:
            return state
        waist = 0.0 if self._waist is None else state.torso[self._waist]
        return dc.replace(state, torso=np.array([waist, *state.torso[-2:]]))

    def _torso(self, gaze: np.ndarray) -> np.ndarray:
        """The torso's joints for waist, tilt and pan."""
        torso = self._rest.copy()
        torso[-2:] = gaze[1:]
        if self._waist is not None:
            torso[self._waist] = gaze[0]
        return torso
