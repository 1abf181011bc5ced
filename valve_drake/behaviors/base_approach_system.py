"""Block `base_approach`: stages 1 and 2 on ports. No mathematics here."""

from valve_drake.behaviors.base_approach import MODES, BaseApproachConfig, Memory, step
from valve_drake.messages import Command, ModeState, RectangleEstimate, RobotState, Stance, Status, StereoPosition
from valve_drake.ports import TICK, Block, Inputs, Outputs
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
    stance       in   Stance             where to stand, by kinematic_approach
    command      out  Command            base_twist, in its modes
    status       out  Status
    """

    AWAKE = frozenset(MODES)
    OUTPUTS = {"command": Command, "status": Status}

    def __init__(self, config: BaseApproachConfig, valve: Valve, name: str = "base_approach"):
        config.check()
        self.config = config
        self.valve = valve
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
        )
        return memory, {"command": command, "status": status}
