"""Block `base_approach`: stages 1 and 2 on ports. No mathematics here."""

from valve_drake.behaviors.base_approach import MODES, BaseApproachConfig, Memory, bounded, step
from valve_drake.messages import Command, ModeState, RectangleEstimate, RobotState, Stance, Status, StereoPosition
from valve_drake.ports import TICK, Block, Inputs, Outputs
from valve_drake.robot.drive import DIFFERENTIAL, Drive
from valve_drake.valve.valve import Valve


class BaseApproachInputs(Inputs):
    robot_state: RobotState
    mode: ModeState
    position: StereoPosition = StereoPosition()
    estimate: RectangleEstimate = RectangleEstimate()
    stance: Stance = Stance()


class BaseApproachSystem(Block[BaseApproachInputs, Memory]):
    """Driving to the valve and back; 1/64 s (wheels and neck need no more), slot 1.

    port         dir  type               notes
    -----------  ---  -----------------  ---------------------------------------
    robot_state  in   RobotState
    mode         in   ModeState
    position     in   StereoPosition     stage 1
    estimate     in   RectangleEstimate  stage 2
    stance       in   Stance             where to stand, by stance_planner
    command      out  Command            base_twist, in its modes, unless the base is fixed
    status       out  Status

    drive: of the robot's base. room: what it needs to turn before a panel, which the clearance is at least [m].
    """

    AWAKE = frozenset(MODES)
    OUTPUTS = {"command": Command, "status": Status}

    def __init__(
        self,
        config: BaseApproachConfig,
        valve: Valve,
        drive: Drive = DIFFERENTIAL,
        room: float = 0.0,
        name: str = "base_approach",
    ):
        config.check()
        self.config = bounded(config, drive, room)
        self.valve = valve
        self.drive = drive
        super().__init__(name, period=2 * TICK)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: BaseApproachInputs, memory: Memory) -> tuple[Memory, Outputs]:
        memory, command, status = step(
            self.config,
            self.valve,
            memory,
            time,
            self.period,
            inputs.robot_state,
            inputs.mode,
            inputs.position,
            inputs.estimate,
            inputs.stance,
            self.drive,
        )
        return memory, {"command": command, "status": status}
