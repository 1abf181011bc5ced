"""Block `valve_search`: the search and the gaze on ports. No mathematics here."""

import dataclasses as dc

import numpy as np

from valve_drake.behaviors.valve_search import USUAL, HeadPose, Memory, Sight, ValveSearchConfig, bolted, step
from valve_drake.memory import changed
from valve_drake.messages import (
    Command,
    Mode,
    ModeState,
    RectangleEstimate,
    RobotState,
    Stance,
    Status,
    StereoPosition,
)
from valve_drake.ports import TICK, Block, Inputs, Outputs
from valve_drake.robot.drive import DIFFERENTIAL, Drive
from valve_drake.robot.gaze import Gaze


class ValveSearchInputs(Inputs):
    robot_state: RobotState
    mode: ModeState
    position: StereoPosition = StereoPosition()
    estimate: RectangleEstimate = RectangleEstimate()
    stance: Stance = Stance()


class ValveSearchSystem(Block[ValveSearchInputs, Memory]):
    """Search and gaze; 1/64 s (wheels and neck need no more), slot 1.

    port         dir  type               notes
    -----------  ---  -----------------  ---------------------------------------
    robot_state  in   RobotState
    mode         in   ModeState
    position     in   StereoPosition     stage 1
    estimate     in   RectangleEstimate  stage 2
    stance       in   Stance             lift to stand there with, by stance_planner
    command      out  Command            torso always, base_twist in search
    status       out  Status

    head_pose: base (x, y, heading) in O, torso (n,) -> X_OL (3, 4). gaze: how the torso turns the eyes. The lift is
    driven to the stance's in fine_approach, and stays there.
    look: where to look near the valve, off the marker's middle, in V (3,); None: at the marker. drive: of the base.
    sight: of the eyes.
    """

    OUTPUTS = {"command": Command, "status": Status}

    def __init__(
        self,
        config: ValveSearchConfig,
        head_pose: HeadPose,
        gaze: Gaze,
        look: np.ndarray | None = None,
        drive: Drive = DIFFERENTIAL,
        sight: Sight = USUAL,
        name: str = "valve_search",
    ):
        config.check()
        self.config = config if gaze.joints[0] is not None else dc.replace(config, sweep_waist=0.0)
        if drive.fixed:
            self.config = bolted(self.config, sight)
        else:
            speed, acceleration = float(drive.speed[-1]), float(drive.acceleration[-1])
            self.config = dc.replace(
                self.config,
                turn_speed=min(config.turn_speed, speed),
                turn_acceleration=min(config.turn_acceleration, acceleration),
            )
        self._gaze, self._look, self._drive, self._sight = gaze, look, drive, sight
        self._held, self._plain = gaze.held, gaze.plain
        self._whole_pose = head_pose
        super().__init__(name, period=2 * TICK)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: ValveSearchInputs, memory: Memory) -> tuple[Memory, Outputs]:
        stance = inputs.stance
        if inputs.mode.mode == Mode.FINE_APPROACH and stance.found and len(stance.posture) == self._held:
            memory = changed(memory, lift=stance.posture)
        lift = self._gaze.rest[: self._held] if memory.lift is None else memory.lift
        measured = inputs.robot_state.torso

        def head_pose(base: np.ndarray, gaze: np.ndarray) -> np.ndarray:
            return self._whole_pose(base, gaze if self._plain else self._gaze.torso(gaze, measured[: self._held]))

        memory, command, status = step(
            self.config,
            memory,
            time,
            self.period,
            self._seen(inputs.robot_state),
            inputs.mode,
            inputs.position,
            inputs.estimate,
            head_pose,
            self._look,
            self._drive,
            self._sight,
        )
        if command.torso is not None and not self._plain:
            command = dc.replace(command, torso=self._gaze.torso(command.torso, lift))
        return memory, {"command": command, "status": status}

    def _seen(self, state: RobotState) -> RobotState:
        """The state with the gaze for its torso."""
        return state if self._plain else dc.replace(state, torso=self._gaze.of(state.torso))
