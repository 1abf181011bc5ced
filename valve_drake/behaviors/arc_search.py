"""The best of all grasps for a turn from one place: a search in portions."""

import dataclasses as dc
import math

import numpy as np

from valve_drake.behaviors.arcs import Arcs
from valve_drake.behaviors.grasp_geometry import Arc, Pair, Turn, pairs
from valve_drake.behaviors.questions import UNITS, Enough, Questions

ONE_GRASP = 2.3  # a longer turn is not tried with one grasp alone [rad]
AS_FAR = 0.3  # of two turns that differ by less the one with the larger margin is the better [rad]
FAR = 2.5  # a comfortable grasp that turns so far ends the search for a better one [rad]


@dc.dataclass(frozen=True, eq=False)
class ArcSearch:
    """A search for the grasps at one place: see `GraspSearch.advance_arc`.

    answers: of the pair that is being looked at, so far.
    """

    turn: Turn
    groups: tuple[tuple[Pair, ...], ...]  # of `pairs`
    whole: bool  # see `Arcs.check_arc`
    group: int = 0
    index: int = 0  # of the next pair in its group
    best: Arc = Arc()
    begun: bool = False
    answers: tuple[object, ...] = ()
    done: bool = False


class GraspSearch(Arcs):
    """The grasps with which a turn goes best."""

    def begin_arc(self, turn: Turn) -> ArcSearch:
        """A search for the grasps that turn the valve the best; see `best_arc`."""
        whole = abs(turn.angle) <= ONE_GRASP
        return self._onwards(ArcSearch(turn, self._groups(turn, whole), whole))

    def _groups(self, turn: Turn, whole: bool) -> tuple[tuple[Pair, ...], ...]:
        return tuple(pairs(self.valve, turn.X_BA, turn.angle if whole else np.copysign(ONE_GRASP / 2, turn.angle)))

    def advance_arc(self, search: ArcSearch) -> ArcSearch:
        """The search after one more pair of grasps, or with redundant arms after a part of the work on one."""
        c, s = self.config, search
        redundant = any(len(arm) > 6 for arm in self.robot.arms.values())
        ask = Questions(s.answers, UNITS if redundant else math.inf)
        bound = max(s.best.margin, s.turn.least) if s.whole else 0.0
        try:
            arc = self.check_arc(dc.replace(s.turn, least=bound), s.groups[s.group][s.index], whole=s.whole, ask=ask)
        except Enough:
            return dc.replace(s, answers=ask.answers())
        best = arc if _better(arc, s.best, s.whole) else s.best
        served = best.margin >= c.margin_good and (s.whole or abs(best.turn) > FAR)
        after = dc.replace(s, index=s.index + 1, best=best, begun=s.begun or arc.begun, answers=())
        return dc.replace(after, done=True) if served else self._onwards(after)

    def _onwards(self, search: ArcSearch) -> ArcSearch:
        """The search at the next pair that is worth trying; done if there is none."""
        group, index, s = search.group, search.index, search
        while group < len(s.groups):
            others = group % 2 == 1 and not s.begun  # other fingers reach no farther
            if not others and index < len(s.groups[group]):
                return dc.replace(s, group=group, index=index)
            if s.best.margin >= self.config.margin_min:
                break
            group, index = group + 1, 0
        long = abs(s.turn.angle) > self.config.arc_least
        if s.whole and s.turn.split and s.begun and long and s.best.margin < self.config.margin_min:
            return self._onwards(ArcSearch(s.turn, self._groups(s.turn, False), whole=False))
        return dc.replace(s, done=True)

    def best_arc(self, turn: Turn) -> Arc:
        """The first grasps of `pairs` that serve for the whole turn, the best of their group; for a turn that is longer
        than one grasp reaches, and with `turn.split` where none serves, those that turn the farthest."""
        search = self.begin_arc(turn)
        while not search.done:
            search = self.advance_arc(search)
        return search.best


def _better(arc: Arc, best: Arc, whole: bool) -> bool:
    if whole or abs(abs(arc.turn) - abs(best.turn)) < AS_FAR:
        return arc.margin > best.margin
    return abs(arc.turn) > abs(best.turn)
