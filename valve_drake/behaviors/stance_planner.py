"""Where to stand, how to hold the valve, how the arms get there: the searches, beside the control loop.

    fine_approach  the stance for the whole turn, from the last few estimates. With each estimate it moves along with
                   the valve; it is searched again, at most every `period`, if the valve is seen higher or tilted
    a PlanRequest  grasps from where the robot stands, or a collision-free path of both arms

A search takes up to some seconds of processor time. It is cut into portions of 2 to 5 ms, one portion a step, so that
no control tick waits for it. Portions are counted (inverse solutions, pairs of shapes) and not timed: the same inputs
give the same answer in the same step.
"""

import copy
import dataclasses as dc

import numpy as np

from valve_drake.behaviors.arc_search import ArcSearch
from valve_drake.behaviors.grasp_geometry import Arc, Turn, standoff
from valve_drake.behaviors.joint_path import PathSearch
from valve_drake.behaviors.stance_search import Stances, StanceSearch
from valve_drake.config import Config, number
from valve_drake.frames import compose
from valve_drake.memory import changed
from valve_drake.messages import (
    SIDES,
    GraspPlan,
    Mode,
    ModeState,
    PathPlan,
    PlanRequest,
    RectangleEstimate,
    Stance,
)
from valve_drake.perception.fusion import MOVING, fuse
from valve_drake.robot.kinematics import OUTWARD
from valve_drake.task.modes import TABLE

# Modes in which kinematic_approach may ask: it moves the arms.
ASKED = tuple(mode for mode, row in TABLE.items() if row.hands == "kinematic_approach")
LOOKS = 5  # estimates that a stance is made from; those from nearby are better, so old ones are dropped
BACK = (0.10, 0.16, 0.22)  # of the via poses: hands drawn straight back from the valve [m]


@dc.dataclass
class StancePlannerConfig(Config):
    """Scenario key `stance_planner`."""

    KEY = "stance_planner"
    period: float = number(0.5, 0.1, 10.0, "between two searches for the stance [s]")


@dc.dataclass(frozen=True)
class Memory:
    """Everything between two steps."""

    activation: int = -1
    looks: tuple[RectangleEstimate, ...] = ()
    search: StanceSearch | None = None
    last: StanceSearch | None = None  # the one before, if it has found a stance
    searched: RectangleEstimate = RectangleEstimate()  # the newest estimate that was taken into account
    begun: float = -1e9  # when the last search for a stance began [s]
    stance: Stance = Stance()
    number: int = -1  # of the last request
    arc_search: ArcSearch | None = None
    path_search: PathSearch | None = None
    vias_left: bool = False  # the via poses are still to be found
    grasps: GraspPlan = GraspPlan()
    path: PathPlan = PathPlan()


class StancePlanner:
    """The mathematics of the block. stances: where the hands can turn the valve from; they hold robot and valve."""

    def __init__(self, config: StancePlannerConfig, stances: Stances):
        config.check()
        stances.config.check()
        self.config = copy.copy(config)
        self.stances = dc.replace(stances, config=copy.copy(stances.config), view=dict(stances.view))
        self.robot = stances.robot

    def step(
        self, time: float, memory: Memory, mode: ModeState, estimate: RectangleEstimate, request: PlanRequest
    ) -> Memory:
        """One portion -> memory, with stance, grasps and path in it. A request comes before the stance."""
        m = memory
        if mode.mode == Mode.SEARCH and m.activation != mode.activation:
            m = changed(m, stance=Stance(), looks=(), search=None, last=None, begun=-1e9)
        m = changed(m, activation=mode.activation) if m.activation != mode.activation else m
        if request.number != m.number:
            return self._take(m, request)
        if m.path_search is not None:
            return self._path(m, request)
        if m.arc_search is not None:
            return self._grasps(m, request)
        return self._stance(time, m, mode, estimate) if mode.mode == Mode.FINE_APPROACH else m

    # ------------------------------------------------------------ stance
    def _stance(self, time: float, m: Memory, mode: ModeState, estimate: RectangleEstimate) -> Memory:
        if self.stances.valve.seen_by(estimate) and (not m.looks or estimate.sequence != m.looks[-1].sequence):
            m = changed(m, looks=(*m.looks, estimate)[-LOOKS:])
        if m.search is None:
            if not m.looks or m.looks[-1] is m.searched:
                return m
            m, before = changed(m, searched=m.looks[-1]), m.last
            fused = fuse(m.looks, apart=MOVING)
            if not fused.found:
                return m
            X_OA, viewer = self.stances.valve.place(fused.X_OV, fused.angle), m.looks[-1].X_OL[:2, 3]
            base = None if before is None else self.stances.moved(before, X_OA, mode.turn_angle)
            if base is not None and m.stance.found:
                return changed(m, stance=dc.replace(m.stance, time=m.searched.time, base=base))
            if m.stance.found and time - m.begun < self.config.period:
                return m
            m = changed(m, begun=time, search=self.stances.begin(X_OA, mode.turn_angle, viewer, before))
        assert m.search is not None
        search = self.stances.advance(m.search)
        if not search.done:
            return changed(m, search=search)
        margin, best = search.margin, search.best
        good = best is not None and margin >= self.stances.config.margin_min
        reason = "" if good else f"no stance holds both handles through the turn (margin {margin:.2f})"
        stance = Stance(time=m.searched.time, found=good, margin=margin, reason=reason)
        if best is not None:
            posture = self.robot.posture.home if best.posture is None else best.posture
            stance = dc.replace(stance, base=best.base, posture=posture)
        return changed(m, search=None, last=search if good else None, stance=stance)

    # ------------------------------------------------------------ requests
    def _take(self, m: Memory, request: PlanRequest) -> Memory:
        """A new request: the one before is dropped."""
        m = changed(m, number=request.number, path_search=None, arc_search=None)
        if request.kind == "grasps":
            search = self.stances.begin_arc(Turn(request.X_BA, request.turn_angle, request.posture, split=True))
            return changed(m, arc_search=search)
        if request.kind == "path":
            return changed(m, path_search=PathSearch(request.start, request.goal), vias_left=request.valve)
        return m

    def _grasps(self, m: Memory, request: PlanRequest) -> Memory:
        """One portion of the search for grasps."""
        assert m.arc_search is not None
        search = self.stances.advance_arc(m.arc_search)
        if not search.done:
            return changed(m, arc_search=search)
        return changed(m, arc_search=None, grasps=self._plan_of(request, search.best))

    def _plan_of(self, request: PlanRequest, arc: Arc) -> GraspPlan:
        found = arc.margin >= self.stances.config.margin_min
        plan = GraspPlan(number=request.number, found=found, X_BA=request.X_BA, margin=arc.margin)
        if not found:
            return plan
        left, right = (arc.grasps[side] for side in SIDES)
        X_BG = [compose(request.X_BA, self.stances.valve.grasp(hand.handle, hand.sign)) for hand in (left, right)]
        return dc.replace(
            plan,
            handle_left=left.handle,
            handle_right=right.handle,
            turn=arc.turn,
            X_BG_left=X_BG[0],
            X_BG_right=X_BG[1],
            q_standoff=np.concatenate([arc.q_standoff[side] for side in SIDES]),
            posture=request.posture,
            way=np.hstack([arc.way[side] for side in SIDES]).ravel(),
        )

    def _path(self, m: Memory, request: PlanRequest) -> Memory:
        """One portion of the search for a path; near a valve the via poses are the first."""
        search = m.path_search
        assert search is not None
        X_BA = request.X_BA if request.valve else None
        arms, split = self.robot.arms, self.robot.split

        def is_free(q: np.ndarray) -> bool:
            within = all(arms[side].within(part) for side, part in split(q).items())
            return within and self.stances.is_free(X_BA, q, request.posture)

        if m.vias_left:
            vias = tuple(self.vias(request.start, request.goal, request.posture))
            return changed(m, path_search=dc.replace(search, vias=vias), vias_left=False)
        search = search.advance(is_free, self.stances.shape_pairs)
        if not search.done:
            return changed(m, path_search=search)
        points = np.zeros(0) if search.points is None else search.points.ravel()
        path = PathPlan(number=request.number, found=search.points is not None, points=points)
        return changed(m, path_search=None, path=path)

    def vias(self, start: np.ndarray, goal: np.ndarray, posture: np.ndarray) -> list[np.ndarray]:
        """Via poses: both hands drawn straight back from the end of the path at the valve; nearly always free."""
        at_valve = self.robot.split(start if np.allclose(goal, self.robot.home) else goal)
        out: list[np.ndarray] = []
        for back in BACK:
            arms = []
            for side in SIDES:
                X_BG = standoff(self.robot.forward(side, at_valve[side], posture), np.array([0.0, 0, 1]), back)
                X_BG[1, 3] += OUTWARD[side] * back / 2
                arms.append(self.robot.inverse(side, X_BG, at_valve[side], posture))
            reached = [q for q in arms if q is not None]
            if len(reached) == len(arms):
                out.append(np.concatenate(reached))
        return out
