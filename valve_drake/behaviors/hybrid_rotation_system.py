"""Block `hybrid_rotation`: stage 5 on ports. No mathematics here."""

from valve_drake.behaviors.hybrid_rotation import AT_VALVE, HybridRotation, Memory
from valve_drake.messages import Command, GraspPlan, ModeState, RobotState, Status, TurnState
from valve_drake.ports import TICK, Block, Inputs, Outputs


class HybridRotationInputs(Inputs):
    robot_state: RobotState
    mode: ModeState
    plan: GraspPlan


class HybridRotationSystem(Block[HybridRotationInputs, Memory]):
    """Grasps, turns and releases the valve with both hands.

    port         dir  type        notes
    -----------  ---  ----------  ------------------------------------------------
    robot_state  in   RobotState  joints, grippers, wrenches
    mode         in   ModeState   grasp, turn (with the angle), release; reach: tare
    plan         in   GraspPlan   the valve's axis
    command      out  Command     arms and grippers
    status       out  Status
    turn         out  TurnState   telemetry: angle, couple, forces
    """

    AWAKE = frozenset(AT_VALVE)
    OUTPUTS = {"command": Command, "status": Status, "turn": TurnState}

    def __init__(self, law: HybridRotation, name: str = "hybrid_rotation"):
        self._law = law
        super().__init__(name)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: HybridRotationInputs, memory: Memory) -> tuple[Memory, Outputs]:
        memory, command = self._law.step(time, TICK, memory, inputs.robot_state, inputs.mode, inputs.plan)
        return memory, {"command": command, "status": memory.status, "turn": memory.telemetry}
