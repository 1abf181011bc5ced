"""Block `stance_planner`: the searches on ports. No mathematics here."""

from valve_drake.behaviors.stance_planner import ASKED, Memory, StancePlanner
from valve_drake.messages import GraspPlan, ModeState, PathPlan, PlanRequest, RectangleEstimate, Stance
from valve_drake.ports import TICK, Block, Inputs, Outputs

PERIOD = 2 * TICK  # of its portions: every other tick is free of them
PERIOD_REDUNDANT = TICK  # for arms of seven and more joints: more portions, smaller ones


class StancePlannerInputs(Inputs):
    mode: ModeState
    estimate: RectangleEstimate
    request: PlanRequest


class StancePlannerSystem(Block[StancePlannerInputs, Memory]):
    """Searches stances, grasps and paths, a portion every 1/64 s (for redundant arms 1/128 s), in slot 3.

    port      dir  type               notes
    --------  ---  -----------------  ------------------------------------------------------
    mode      in   ModeState
    estimate  in   RectangleEstimate  stage 2
    request   in   PlanRequest        of kinematic_approach
    stance    out  Stance             where the base should stand, in O
    grasps    out  GraspPlan          the answer to a request for grasps
    path      out  PathPlan           the answer to a request for a path
    """

    AWAKE = frozenset(ASKED)
    OUTPUTS = {"stance": Stance, "grasps": GraspPlan, "path": PathPlan}

    def __init__(self, law: StancePlanner, name: str = "stance_planner"):
        self._law = law
        redundant = any(len(arm) > 6 for arm in law.robot.arms.values())
        super().__init__(name, period=PERIOD_REDUNDANT if redundant else PERIOD, slot=3)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: StancePlannerInputs, memory: Memory) -> tuple[Memory, Outputs]:
        after = self._law.step(time, memory, inputs.mode, inputs.estimate, inputs.request)
        outputs = {name: getattr(after, name) for name in self.OUTPUTS}
        return after, {name: value for name, value in outputs.items() if value is not getattr(memory, name)}
