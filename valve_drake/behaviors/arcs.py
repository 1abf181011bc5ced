"""How far both arms can follow a turn with one grasp: reach, margin, and freedom from collision all along."""

import dataclasses as dc
import functools
import math
from collections.abc import Callable, Mapping

import numpy as np

from valve_drake.behaviors.grasp_geometry import Arc, Free, Grasp, Pair, Turn, standoff
from valve_drake.behaviors.questions import PAIRS_A_UNIT, SOLVED, SOUGHT, Questions
from valve_drake.behaviors.stance_config import StanceConfig
from valve_drake.frames import compose
from valve_drake.messages import SIDES
from valve_drake.robot.kinematics import RobotKinematics, seeds
from valve_drake.valve.valve import Valve, turned

BEGINNINGS = 6  # of a redundant arm's search for joints without a neighbour
OTHERS = 4  # postures that a redundant arm's way begins from, beside the first
ENDS = 4  # of a turn that are tried for freedom from collision, the farthest first; each takes some milliseconds
JUMP = 1.0  # a joint that moves so far between two angles of the turn is on another branch [rad]

Solution = tuple[np.ndarray | None, float]  # joints and their margin
Way = tuple[list[np.ndarray], list[float]]  # of one arm: joints and margins at the angles of a turn


@dc.dataclass(frozen=True, eq=False)
class Arcs:
    """Which turns the hands can follow with given grasps.

    view: each wrist camera's view direction in its hand's frame (from the taught reference).
    shape_pairs: how many is_free goes through.
    """

    robot: RobotKinematics
    valve: Valve
    config: StanceConfig
    view: Mapping[str, np.ndarray]
    is_free: Free
    shape_pairs: int = 0

    def check_arc(self, turn: Turn, grasps: Pair, *, whole: bool = True, ask: Questions | None = None) -> Arc:
        """How far both hands can hold their handles along a turn, and draw back from them at both ends.

        whole: a turn that is not followed to its end is out of reach, and the check ends where the margin falls to
        `turn.least`; else as far as the margin is `margin_good`, or, if that is not `arc_least`, as far as it is
        accepted. Unless the arms are free of all at every angle, and drawn back, it is out of reach.
        ask: answers of earlier portions, and how much this one may ask: then Enough may be raised.
        """
        c, ask = self.config, ask or Questions()
        count = max(2, int(np.ceil(abs(turn.angle) / c.arc_step)) + 1)
        angles = np.linspace(0.0, turn.angle, count)
        limit = turn.least if whole else c.margin_min
        arms = {side: self._ways(turn, angles, side, grasps, limit, ask) for side in SIDES}
        begun = all(len(q) for q, _ in arms.values())
        reached = min(len(q) for q, _ in arms.values())
        out = Arc(-1.0, 0.0, grasps, begun=begun)
        if reached < 2 or (whole and reached < count):
            lowest = min(margins[-1] if margins else -1.0 for _, margins in arms.values())
            known = whole and begun and lowest <= turn.least
            return dc.replace(out, margin=min(lowest, turn.least)) if known else out
        margins = np.minimum(*(np.minimum.accumulate(arms[side][1][:reached]) for side in SIDES))
        ends = [reached - 1]
        if not whole:
            ends = list(range(reached - 1, 0, -1))
            good = [k for k in ends if margins[k] >= c.margin_good and abs(angles[k]) >= c.arc_least]
            ends = good or [k for k in ends if abs(angles[k]) >= min(c.arc_least, abs(turn.angle))]
        for end in ends[:ENDS]:
            arc = self._arc(turn, angles[: end + 1], grasps, {side: arms[side][0] for side in SIDES}, ask)
            margin = min(arc.margin, float(margins[end]))
            if arc.q and margin > limit:
                return dc.replace(arc, margin=margin)
            if whole:
                return dc.replace(out, margin=margin if arc.q else -1.0)
        return out

    def _ways(self, turn: Turn, angles: np.ndarray, side: str, grasps: Pair, least: float, ask: Questions) -> Way:
        """What `_follow` gives; a redundant arm that is not comfortable so begins from a few other postures too."""
        arm, grasp = self.robot.arms[side], grasps[side]
        like = turn.near is not None and dict(turn.near.grasps) == dict(grasps)
        near = turn.near.q.get(side) if like and turn.near is not None else None
        best = self._follow(turn, angles, side, grasp, near, least, ask)
        if len(arm) <= 6 or not best[1]:
            return best
        first = compose(turn.X_BA, self.valve.grasp(grasp.handle, grasp.sign))
        for start in seeds(arm)[:OTHERS]:
            if len(best[0]) == len(angles) and min(best[1]) >= self.config.margin_good:
                break
            q = ask(SOLVED, functools.partial(self.robot.inverse, side, first, start, turn.posture))
            if q is None:
                continue
            way = self._follow(turn, angles, side, grasp, q, least, ask)
            if way[1] and (len(way[0]), min(way[1])) > (len(best[0]), min(best[1])):
                best = way
        return best

    def _follow(
        self,
        turn: Turn,
        angles: np.ndarray,
        side: str,
        grasp: Grasp,
        near: np.ndarray | None,
        least: float,
        ask: Questions,
    ) -> Way:
        """One arm's joints and margins at the angles of a turn, up to where it can follow with a margin over `least`.

        near: joints of a like arc's start.

        A margin that falls to `least` is the last of the second list, which is then the longer one.
        """
        robot, posture, X_AG = self.robot, turn.posture, self.valve.grasp(grasp.handle, grasp.sign)

        def solve(angle: float, start: np.ndarray | None) -> Solution:
            q = robot.inverse(side, compose(turned(turn.X_BA, angle), X_AG), start, posture)
            return q, -1.0 if q is None else robot.margin(side, q)

        q_last = near
        arc: list[np.ndarray] = []
        margins: list[float] = []
        for k, angle in enumerate(angles):
            start = q_last if k < 2 else 2 * arc[-1] - arc[-2]  # goes on as before
            q, margin = None, -1.0
            if start is not None:
                q, margin = ask(SOLVED, functools.partial(solve, angle, start))
            if q is None and k == 0:
                q, margin = self._search(side, functools.partial(solve, angle), ask)
            if q is None or (k > 0 and q_last is not None and np.max(np.abs(q - q_last)) > JUMP):
                break
            margins.append(margin)
            if margins[-1] <= least:
                break
            arc.append(q)
            q_last = q
        return arc, margins

    def _search(self, side: str, solve: Callable[[np.ndarray | None], Solution], ask: Questions) -> Solution:
        """Joints without a neighbour; for a redundant arm each beginning is a question of its own."""
        arm = self.robot.arms[side]
        if len(arm) <= 6:
            return ask(SOUGHT, functools.partial(solve, None))
        best: Solution = (None, -math.inf)
        for start in seeds(arm)[:BEGINNINGS]:
            q, margin = ask(SOUGHT, functools.partial(solve, start))
            if q is not None and margin > best[1]:
                best = q, margin
            if best[1] > self.config.margin_good:
                break
        return best

    def _arc(
        self, turn: Turn, angles: np.ndarray, grasps: Pair, q: Mapping[str, list[np.ndarray]], ask: Questions
    ) -> Arc:
        """The arc over all of these angles: the hands draw back at its ends, and the arms are free of all."""
        robot, margin, last = self.robot, 1.0, len(angles) - 1
        backs: dict[str, list[np.ndarray]] = {side: [] for side in SIDES}
        for side in SIDES:
            X_AG = self.valve.grasp(grasps[side].handle, grasps[side].sign)
            for k in (0, last):
                X_back = standoff(compose(turned(turn.X_BA, angles[k]), X_AG), self.view[side], self.config.standoff)
                back = ask(SOLVED, functools.partial(robot.inverse, side, X_back, q[side][k], turn.posture))
                if back is None:
                    return Arc(grasps=grasps, begun=True)
                margin = min(margin, robot.margin(side, back))
                backs[side].append(back)
        # Ends and middle first: there most arms that will meet have met.
        along = dict.fromkeys((0, last, (last + 1) // 2, *range(last)))
        poses = [(k, q, k) for k in along] + [(0, backs, 0), (last, backs, 1)]
        for at, joints, k in poses:
            q_both = np.concatenate([joints[side][k] for side in SIDES])
            look = functools.partial(self.is_free, turned(turn.X_BA, angles[at]), q_both, turn.posture)
            if not ask(1 + self.shape_pairs // PAIRS_A_UNIT, look):
                return Arc(grasps=grasps, begun=True)
        first, behind = ({side: joints[side][0] for side in SIDES} for joints in (q, backs))
        way = {side: np.array(q[side][: last + 1]) for side in SIDES}
        return Arc(margin, float(angles[last]), grasps, first, behind, True, way)
