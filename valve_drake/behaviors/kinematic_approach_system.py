"""Block `kinematic_approach`: stage 3 on ports. No mathematics here."""

from valve_drake.behaviors.kinematic_approach import NOT_OWNED, KinematicApproach, Memory
from valve_drake.messages import (
    Command,
    GraspPlan,
    HandleMarks,
    Mode,
    ModeState,
    RectangleEstimate,
    RobotState,
    Stance,
    Status,
    TurnState,
)
from valve_drake.ports import Block, Inputs, Outputs


class KinematicApproachInputs(Inputs):
    robot_state: RobotState
    mode: ModeState
    estimate: RectangleEstimate
    marks: HandleMarks
    turn: TurnState


class KinematicApproachSystem(Block[KinematicApproachInputs, Memory]):
    """Arms by forward and inverse kinematics, and the looks at rest before and after the turn.

    port         dir  type               notes
    -----------  ---  -----------------  ------------------------------------------------------
    robot_state  in   RobotState
    mode         in   ModeState
    estimate     in   RectangleEstimate  stage 2
    marks        in   HandleMarks        green marks in the wrist images
    turn         in   TurnState          how far the hands say that the valve was turned
    command      out  Command            arms and grippers
    status       out  Status             measure, reach, fold, verify
    stance       out  Stance             where the base should stand, in O
    plan         out  GraspPlan          the valve and the grasps in B, measured at rest
    """

    AWAKE = frozenset(Mode) - frozenset(NOT_OWNED)
    OUTPUTS = {"command": Command, "status": Status, "stance": Stance, "plan": GraspPlan}

    def __init__(self, law: KinematicApproach, name: str = "kinematic_approach"):
        self._law = law
        super().__init__(name)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: KinematicApproachInputs, memory: Memory) -> tuple[Memory, Outputs]:
        memory, command = self._law.step(
            time, memory, inputs.robot_state, inputs.mode, inputs.estimate, inputs.marks, inputs.turn
        )
        return memory, {
            "command": command,
            "status": memory.status,
            "stance": memory.stance,
            "plan": memory.plan,
        }

    def later(self, time: float, inputs: KinematicApproachInputs, memory: Memory) -> tuple[Memory, Outputs]:
        after = self._law.watch_stance(time, memory, inputs.mode, inputs.estimate)
        return after, {} if after.stance is memory.stance else {"stance": after.stance}
