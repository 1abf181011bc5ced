"""Block `kinematic_approach`: stage 3 on ports. No mathematics here."""

from valve_drake.behaviors.kinematic_approach import NOT_OWNED, KinematicApproach, Memory
from valve_drake.behaviors.kinematic_approach import Inputs as Read
from valve_drake.messages import (
    Command,
    GraspPlan,
    HandleMarks,
    Mode,
    ModeState,
    PathPlan,
    PlanRequest,
    RectangleEstimate,
    RobotState,
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
    grasps: GraspPlan
    path: PathPlan


class KinematicApproachSystem(Block[KinematicApproachInputs, Memory]):
    """Arms by forward and inverse kinematics, and the looks at rest before and after the turn.

    port         dir  type               notes
    -----------  ---  -----------------  ------------------------------------------------------
    robot_state  in   RobotState
    mode         in   ModeState
    estimate     in   RectangleEstimate  stage 2
    marks        in   HandleMarks        green marks in the wrist images
    turn         in   TurnState          how far the hands say that the valve was turned
    grasps       in   GraspPlan          answers of stance_planner
    path         in   PathPlan
    command      out  Command            arms and grippers
    status       out  Status             measure, reach, fold, verify
    plan         out  GraspPlan          the valve and the grasps in B, measured at rest
    request      out  PlanRequest        to stance_planner
    """

    AWAKE = frozenset(Mode) - frozenset(NOT_OWNED)
    OUTPUTS = {"command": Command, "status": Status, "plan": GraspPlan, "request": PlanRequest}

    def __init__(self, law: KinematicApproach, name: str = "kinematic_approach"):
        self._law = law
        super().__init__(name)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: KinematicApproachInputs, memory: Memory) -> tuple[Memory, Outputs]:
        read = Read(
            state=inputs.robot_state,
            mode=inputs.mode,
            estimate=inputs.estimate,
            marks=inputs.marks,
            turn=inputs.turn,
            grasps=inputs.grasps,
            path=inputs.path,
        )
        memory, command = self._law.step(time, memory, read)
        return memory, {"command": command, "status": memory.status, "plan": memory.plan, "request": memory.request}
