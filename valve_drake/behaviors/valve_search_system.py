"""Block `valve_search`: the search and the gaze on ports. No mathematics here."""

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

    head_pose: base (x, y, heading) in O, torso (3,) -> X_OL (3, 4).
    """

    OUTPUTS = {"command": Command, "status": Status}

    def __init__(self, config: ValveSearchConfig, head_pose: HeadPose, name: str = "valve_search"):
        config.check()
        self.config = config
        self.head_pose = head_pose
        super().__init__(name, period=2 * TICK)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: ValveSearchInputs, memory: Memory) -> tuple[Memory, Outputs]:
        memory, command, status = step(
            self.config,
            memory,
            time,
            self.period,
            inputs.robot_state,
            inputs.mode,
            inputs.position,
            inputs.estimate,
            self.head_pose,
        )
        return memory, {"command": command, "status": status}
