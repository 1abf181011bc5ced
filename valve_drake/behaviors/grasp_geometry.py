"""Which turns both hands can follow, holding the valve; and the stance: where the robot stands so that they can.

With both hands on handles, a hand's pose X_AG in the valve's axis frame does not change while the valve turns, since A
turns with it. A turn that is longer than one grasp reaches is made of several: turn, let go, take other handles.
"""

import dataclasses as dc
import itertools
from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np

from valve_drake.checks import require
from valve_drake.config import Config, number
from valve_drake.frames import compose, inverse, make, planar
from valve_drake.messages import LEFT, RIGHT, SIDES
from valve_drake.robot.kinematics import RobotKinematics, seeds
from valve_drake.valve.valve import Valve, has_heading, heading, turned

MAX_PLACES = 40  # distances of one search for a stance: it must end while the robot waits


@dc.dataclass
class StanceConfig(Config):
    """Scenario key `stance`: which places to stand at are tried."""

    KEY = "stance"
    distance_min: float = number(0.0, 0.0, 3.0, "least distance that is tried, base to panel; 0: the robot's [m]")
    distance_max: float = number(0.0, 0.0, 3.0, "largest distance that is tried; 0: the robot's [m]")
    distance_step: float = number(0.02, 0.005, 0.2, "between two distances; halving it doubles the search [m]")
    aside: float = number(0.12, 0.0, 0.5, "to either side that is tried where straight before the valve fails [m]")
    lift_step: float = number(0.08, 0.01, 1.0, "between two heights of a lift that are tried [m]")
    standoff: float = number(
        0.12, 0.02, 0.3, "hands start and end this far from the grasp, along the wrist camera's view [m]"
    )
    arc_step: float = number(
        0.27, 0.1, 1.0, "between two angles of the turn that are checked; halving it doubles the search [rad]"
    )
    arc_least: float = number(0.4, 0.1, 3.0, "a grasp that turns less is no use, unless that is all that is left [rad]")
    margin_enough: float = number(0.9, 0.01, 1.0, "the search ends at the first stance with this arm margin")
    margin_good: float = number(0.5, 0.01, 1.0, "with a stance of this arm margin nothing less simple is tried")
    margin_min: float = number(0.15, 0.01, 1.0, "least arm margin that is accepted (1 is comfortable)")

    def relations(self, key: str) -> None:
        for name in ("distance_min", "distance_max"):
            value = getattr(self, name)
            require(value == 0 or value >= 0.3, f"{key}.{name}", "0 (the robot's) or at least 0.3", value)

    def distances(self, stand: tuple[float, float]) -> np.ndarray:
        """What is tried, from near to far (K,) [m]. stand: the robot's. Raises ConfigError: none, or too many."""
        low, high = self.distance_min or stand[0], self.distance_max or stand[1]
        require(low <= high, f"{self.KEY}.distance_min", f"at most the largest distance, {high:g}", low)
        most = MAX_PLACES - 1
        few = high - low <= most * self.distance_step
        words = f"at least {(high - low) / most:.3g}: {MAX_PLACES} distances"
        require(few, f"{self.KEY}.distance_step", words, self.distance_step)
        return np.arange(low, high + 1e-9, self.distance_step)


def standoff(X_AG: np.ndarray, view_G: np.ndarray, distance: float) -> np.ndarray:
    """The hand drawn back from X_AG by `distance` against its camera's view direction (in G), so that the
    mark stays in the middle of the wrist image -> (3, 4)."""
    return make(X_AG[:, :3], X_AG[:, 3] - distance * X_AG[:, :3] @ view_G)


@dc.dataclass(frozen=True)
class Grasp:
    """Where a hand holds the valve: which of its handles, and which way round (Valve.grasp)."""

    handle: int
    sign: float


Pair = Mapping[str, Grasp]  # by side


@dc.dataclass(frozen=True)
class Arc:
    """Both arms along a turn.

    margin: the least of the arms over it; -1: out of reach. turn: how far it goes, at most what was asked for [rad].
    q, q_standoff: side -> joints at the turn's start, and at the stand-off before it (n,); empty if out of reach.
    way: side -> joints at angles spread evenly from the start to `turn` (k, n).
    begun: the hands reach the handles where the turn begins.
    """

    margin: float = -1.0
    turn: float = 0.0
    grasps: Pair = dc.field(default_factory=dict)
    q: Mapping[str, np.ndarray] = dc.field(default_factory=dict)
    q_standoff: Mapping[str, np.ndarray] = dc.field(default_factory=dict)
    begun: bool = False
    way: Mapping[str, np.ndarray] = dc.field(default_factory=dict)


OTHERS = 4  # postures that a redundant arm's way begins from, beside the first
JUMP = 1.0  # a joint that moves so far between two angles of the turn is on another branch [rad]
ONE_GRASP = 2.3  # a longer turn is not tried with one grasp alone [rad]
AROUND = (0.5, -0.5, 1.0, -1.0)  # sides from which a valve with an upright axis is tried, off the nearest [rad]
FAR = 2.5  # a comfortable grasp that turns so far ends the search for a better one [rad]
CROSSED = 0.02  # the left hand is to the right of the right one by more than this [m]
PAIRS = 6  # of handles, at most, that are tried of each kind


class Free(Protocol):
    """No contact and enough clearance with both arms at q, the valve at X_BA (None: no valve).

    posture: lift and waist; None: at home.
    """

    def __call__(self, X_BA: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None = None) -> bool: ...


@dc.dataclass(frozen=True, eq=False)
class Place:
    """Where the robot may stand: base (x, y, heading) in O, posture (lift and waist; None: at home)."""

    base: np.ndarray
    posture: np.ndarray | None = None


@dc.dataclass(frozen=True, eq=False)
class ArcSearch:
    """A search for the grasps at one place, cut into portions of one pair each: see `Stances.advance_arc`."""

    X_BA: np.ndarray
    turn_angle: float
    groups: tuple[tuple[Pair, ...], ...]  # of `Stances.pairs`
    whole: bool  # see `Stances.check_arc`
    split: bool  # a turn that no grasps hold to its end is turned as far as some reach
    near: Arc | None = None
    least: float = 0.0
    posture: np.ndarray | None = None
    group: int = 0
    index: int = 0  # of the next pair in its group
    best: Arc = Arc()
    begun: bool = False
    done: bool = False


@dc.dataclass(frozen=True, eq=False)
class StanceSearch:
    """A search for a stance, cut into portions of one pair of grasps each: `Stances.advance` makes the next one.

    places: by group; the search ends with a place of `margin_enough`, or after a group that has one of `margin_good`.
    """

    X_OA: np.ndarray
    turn_angle: float
    places: tuple[tuple[Place, ...], ...]
    kept: bool = False  # the first group keeps a lift where it is: it will do where it is accepted
    group: int = 0
    index: int = 0  # of the next place in its group
    split: bool = False  # in the second round: by several grasps, where no place serves with one
    arcs: ArcSearch | None = None  # at this place
    arc: Arc | None = None  # of the place before, to start from
    begun: bool = False  # the hands reach handles from one of the places
    turned: float = 0.0  # of the turn, by the grasps at this place that are found [rad]
    grasps: int = 0  # how many these are
    least: float = 1.0  # their margin
    best: Place | None = None
    margin: float = -1.0  # of `best`
    done: bool = False


@dc.dataclass(frozen=True, eq=False)
class Stances:
    """Which turns the hands can follow, and from where.

    view: each wrist camera's view direction in its hand's frame (from the taught reference).
    """

    robot: RobotKinematics
    valve: Valve
    config: StanceConfig
    view: Mapping[str, np.ndarray]
    is_free: Free

    def __post_init__(self) -> None:
        self.config.distances(self.robot.stand)

    # ------------------------------------------------------------ one grasp
    def check_arc(
        self,
        X_BA: np.ndarray,
        turn_angle: float,
        grasps: Pair,
        near: Mapping[str, np.ndarray] | None = None,
        least: float = 0.0,
        posture: np.ndarray | None = None,
        *,
        whole: bool = True,
    ) -> Arc:
        """How far both hands can hold their handles along a turn, and draw back from them at both ends.

        X_BA: the valve in the base. near: joints of a like arc's start, by side.
        posture: lift and waist; None: at home.
        least: the check ends where the margin falls to it: whoever asks knows a better arc.
        whole: a turn that is not followed to its end is out of reach; else as far as the margin is `margin_good`, or,
        if that is not `arc_least`, as far as it is accepted.
        Unless the arms are free of all at every angle, and drawn back, it is out of reach.
        """
        c = self.config
        count = max(2, int(np.ceil(abs(turn_angle) / c.arc_step)) + 1)
        angles = np.linspace(0.0, turn_angle, count)
        limit = least if whole else c.margin_min
        arms = {side: self._ways(X_BA, angles, side, grasps[side], near, limit, posture) for side in SIDES}
        begun = all(len(q) for q, _ in arms.values())
        reached = min(len(q) for q, _ in arms.values())
        out = Arc(-1.0, 0.0, grasps, begun=begun)
        if reached < 2 or (whole and reached < count):
            lowest = min(margins[-1] if margins else -1.0 for _, margins in arms.values())
            return dc.replace(out, margin=min(lowest, least)) if whole and begun and lowest <= least else out
        margins = np.minimum(*(np.minimum.accumulate(arms[side][1][:reached]) for side in SIDES))
        ends = [reached - 1]
        if not whole:
            ends = list(range(reached - 1, 0, -1))
            good = [k for k in ends if margins[k] >= c.margin_good and abs(angles[k]) >= c.arc_least]
            ends = good or [k for k in ends if abs(angles[k]) >= min(c.arc_least, abs(turn_angle))]
        for end in ends[:4]:
            arc = self._arc(X_BA, angles[: end + 1], grasps, {side: arms[side][0] for side in SIDES}, posture)
            margin = min(arc.margin, float(margins[end]))
            if arc.q and margin > limit:
                return dc.replace(arc, margin=margin)
            if whole:
                return dc.replace(out, margin=margin if arc.q else -1.0)
        return out

    def _ways(
        self,
        X_BA: np.ndarray,
        angles: np.ndarray,
        side: str,
        grasp: Grasp,
        near: Mapping[str, np.ndarray] | None,
        least: float,
        posture: np.ndarray | None,
    ) -> tuple[list[np.ndarray], list[float]]:
        """What `_follow` gives; a redundant arm that is not comfortable so begins from a few other postures too."""
        arm = self.robot.arms[side]
        best = self._follow(X_BA, angles, side, grasp, near.get(side) if near else None, least, posture)
        if len(arm) <= 6 or not best[1]:
            return best
        first = compose(X_BA, self.valve.grasp(grasp.handle, grasp.sign))
        for start in seeds(arm)[:OTHERS]:
            if len(best[0]) == len(angles) and min(best[1]) >= self.config.margin_good:
                break
            q = self.robot.inverse(side, first, start, posture)
            if q is None:
                continue
            way = self._follow(X_BA, angles, side, grasp, q, least, posture)
            if way[1] and (len(way[0]), min(way[1])) > (len(best[0]), min(best[1])):
                best = way
        return best

    def _follow(
        self,
        X_BA: np.ndarray,
        angles: np.ndarray,
        side: str,
        grasp: Grasp,
        near: np.ndarray | None,
        least: float,
        posture: np.ndarray | None,
    ) -> tuple[list[np.ndarray], list[float]]:
        """One arm's joints and margins at the angles of a turn, up to where it can follow with a margin over `least`.

        near: joints of a like arc's start.

        A margin that falls to `least` is the last of the second list, which is then the longer one.
        """
        robot, X_AG = self.robot, self.valve.grasp(grasp.handle, grasp.sign)
        q_last = near
        arc: list[np.ndarray] = []
        margins: list[float] = []
        for k, angle in enumerate(angles):
            X_BG = compose(turned(X_BA, angle), X_AG)
            start = q_last if k < 2 else 2 * arc[-1] - arc[-2]  # goes on as before
            q = robot.inverse(side, X_BG, start, posture)
            if q is None and k == 0 and q_last is not None:
                q = robot.inverse(side, X_BG, posture=posture)
            if q is None or (k > 0 and q_last is not None and np.max(np.abs(q - q_last)) > JUMP):
                break
            margins.append(robot.margin(side, q))
            if margins[-1] <= least:
                break
            arc.append(q)
            q_last = q
        return arc, margins

    def _arc(
        self,
        X_BA: np.ndarray,
        angles: np.ndarray,
        grasps: Pair,
        q: Mapping[str, list[np.ndarray]],
        posture: np.ndarray | None,
    ) -> Arc:
        """The arc over all of these angles: the hands draw back at its ends, and the arms are free of all."""
        robot, margin, last = self.robot, 1.0, len(angles) - 1
        backs: dict[str, list[np.ndarray]] = {side: [] for side in SIDES}
        for side in SIDES:
            X_AG = self.valve.grasp(grasps[side].handle, grasps[side].sign)
            for k in (0, last):
                X_BG = compose(turned(X_BA, angles[k]), X_AG)
                back = robot.inverse(side, standoff(X_BG, self.view[side], self.config.standoff), q[side][k], posture)
                if back is None:
                    return Arc(grasps=grasps, begun=True)
                margin = min(margin, robot.margin(side, back))
                backs[side].append(back)
        # Ends and middle first: there most arms that will meet have met.
        along = dict.fromkeys((0, last, (last + 1) // 2, *range(last)))
        poses = [(k, q, k) for k in along] + [(0, backs, 0), (last, backs, 1)]
        for at, joints, k in poses:
            q_both = np.concatenate([joints[side][k] for side in SIDES])
            if not self.is_free(turned(X_BA, angles[at]), q_both, posture):
                return Arc(grasps=grasps, begun=True)
        first, behind = ({side: joints[side][0] for side in SIDES} for joints in (q, backs))
        way = {side: np.array(q[side][: last + 1]) for side in SIDES}
        return Arc(margin, float(angles[last]), grasps, first, behind, True, way)

    # ------------------------------------------------------------ the best of all grasps
    def pairs(self, X_BA: np.ndarray, turn_angle: float) -> Iterator[tuple[Pair, ...]]:
        """What both hands may hold, in groups that get worse: arms that do not cross, before those that do; fingers
        with x_G to the robot's left, before the other way round."""
        middle = turned(X_BA, turn_angle / 2)
        ahead = middle[:, :3] @ np.array([0.0, 0, 1])
        aside = np.array([-ahead[1], ahead[0]])  # to the robot's left, along the panel
        level = np.linalg.norm(aside)
        aside = aside / level if level > 0.3 else np.array([0.0, 1.0])
        count = range(len(self.valve.handles))
        places = [compose(middle, self.valve.grasp(k, 1.0)) for k in count]
        at = [float(aside @ X[:2, 3]) for X in places]
        sign = [1.0 if aside @ X[:2, 0] >= 0 else -1.0 for X in places]
        both = sorted(itertools.permutations(count, 2), key=lambda pair: at[pair[1]] - at[pair[0]])
        plain = [pair for pair in both if at[pair[0]] - at[pair[1]] > -CROSSED][:PAIRS]
        crossed = [pair for pair in both if pair not in plain][:PAIRS]
        for some in (plain, crossed):
            for flips in (((1.0, 1.0),), ((-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0))):
                yield tuple(
                    {LEFT: Grasp(i, sign[i] * flip[0]), RIGHT: Grasp(k, sign[k] * flip[1])}
                    for i, k in some
                    for flip in flips
                )

    def begin_arc(
        self,
        X_BA: np.ndarray,
        turn_angle: float,
        near: Arc | None = None,
        least: float = 0.0,
        posture: np.ndarray | None = None,
        *,
        split: bool = True,
    ) -> ArcSearch:
        """A search for the grasps that turn the valve the best; see `best_arc`. split: see ArcSearch."""
        whole = abs(turn_angle) <= ONE_GRASP
        return self._onwards(ArcSearch(X_BA, turn_angle, self._groups(X_BA, turn_angle, whole), whole, split, near,
                                       least, posture))  # fmt: skip

    def _groups(self, X_BA: np.ndarray, turn_angle: float, whole: bool) -> tuple[tuple[Pair, ...], ...]:
        return tuple(self.pairs(X_BA, turn_angle if whole else float(np.copysign(ONE_GRASP / 2, turn_angle))))

    def advance_arc(self, search: ArcSearch) -> ArcSearch:
        """The search after one more pair of grasps."""
        c, s = self.config, search
        pair = s.groups[s.group][s.index]
        start = s.near.q if s.near is not None and dict(s.near.grasps) == dict(pair) else None
        bound = max(s.best.margin, s.least) if s.whole else 0.0
        arc = self.check_arc(s.X_BA, s.turn_angle, pair, start, bound, s.posture, whole=s.whole)
        best = arc if _better(arc, s.best, s.whole) else s.best
        served = best.margin >= c.margin_good and (s.whole or abs(best.turn) > FAR)
        after = dc.replace(s, index=s.index + 1, best=best, begun=s.begun or arc.begun)
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
        long = abs(s.turn_angle) > self.config.arc_least
        if s.whole and s.split and s.begun and long and s.best.margin < self.config.margin_min:
            groups = self._groups(s.X_BA, s.turn_angle, False)
            return self._onwards(dc.replace(s, whole=False, groups=groups, group=0, index=0, best=Arc(), begun=False))
        return dc.replace(s, done=True)

    def best_arc(
        self,
        X_BA: np.ndarray,
        turn_angle: float,
        near: Arc | None = None,
        least: float = 0.0,
        posture: np.ndarray | None = None,
        *,
        split: bool = False,
    ) -> Arc:
        """The first grasps of `pairs` that serve for the whole turn, the best of their group; for a turn that is longer
        than one grasp reaches, and with `split` where none serves, those that turn the farthest.

        near: a like arc; the rest: as of `check_arc`.
        """
        search = self.begin_arc(X_BA, turn_angle, near, least, posture, split=split)
        while not search.done:
            search = self.advance_arc(search)
        return search.best

    # ------------------------------------------------------------ where to stand
    def begin(
        self, X_OA: np.ndarray, turn_angle: float, viewer: np.ndarray, posture: np.ndarray | None = None
    ) -> StanceSearch:
        """A search for the stance from which the valve at X_OA can be turned. viewer: the robot's place (x, y) now.

        posture: of a stance that was found for nearly the same valve: kept while it serves, since lifts are slow.
        """
        kept = posture is not None and self.robot.lift > 0
        return StanceSearch(X_OA, turn_angle, self._places(X_OA, viewer, posture), kept=kept)

    def _places(
        self, X_OA: np.ndarray, viewer: np.ndarray, posture: np.ndarray | None
    ) -> tuple[tuple[Place, ...], ...]:
        """Square to the panel, from near to far; first with the lift as given, then at home, then at other heights,
        then a step aside."""
        c = self.config
        angle = heading(X_OA, viewer)
        left = np.array([-np.sin(angle), np.cos(angle)])
        stem = compose(X_OA, self.valve.X_AP())[:2, 3]  # at the panel
        distances = c.distances(self.robot.stand)
        bases = [_before(stem, distance, angle) for distance in distances]
        home = self.robot.posture.home
        groups = [tuple(Place(base) for base in bases)]
        if posture is not None and self.robot.lift:
            kept = tuple(Place(base, posture) for base in bases)
            groups = [kept, *(groups if np.max(np.abs(posture - home)) > 1e-3 else [])]
        if raised := self._postures():
            groups.append(tuple(Place(base, posture) for posture in raised for base in bases))
        if not has_heading(X_OA):  # a valve that lies flat is turned from any side
            groups += [tuple(Place(_before(stem, d, angle + off)) for d in distances) for off in AROUND]
        elif c.aside > 0:
            steps = [np.array([*(side * c.aside * left), 0.0]) for side in (1.0, -1.0)]
            groups.append(tuple(Place(base + step) for step in steps for base in bases[::2]))
        return tuple(groups)

    def _postures(self) -> list[np.ndarray]:
        """Other heights of the lift; none without one."""
        joints, count = self.robot.posture, self.robot.lift
        low, high, home = joints.low[:count], joints.high[:count], joints.home[:count]
        if not count:
            return []
        steps = max(2, int(np.ceil(float(np.max(high - low)) / self.config.lift_step)) + 1)
        raised = [low + share * (high - low) for share in np.linspace(0.0, 1.0, steps)]
        return [np.concatenate([q, joints.home[count:]]) for q in raised if np.max(np.abs(q - home)) > 1e-3]

    def advance(self, search: StanceSearch) -> StanceSearch:
        """The search after one more pair of grasps: at a place, grasps follow each other until the turn is made."""
        c, s = self.config, search
        place = s.places[s.group][s.index]
        asked = s.turn_angle - s.turned
        if s.arcs is None:
            X_BA = turned(compose(inverse(planar(*place.base)), s.X_OA), s.turned)
            alone = s.grasps == 0 and abs(asked) <= ONE_GRASP
            arcs = self.begin_arc(
                X_BA, asked, s.arc, max(s.margin, 0.0) if alone else 0.0, place.posture, split=s.split
            )
        else:
            arcs = s.arcs
        arcs = self.advance_arc(arcs)
        if not arcs.done:
            return dc.replace(s, arcs=arcs)
        s, arc = dc.replace(s, arcs=None, begun=s.begun or arcs.begun), arcs.best
        least, left = min(s.least, arc.margin), asked - arc.turn
        if arc.margin >= c.margin_min and abs(left) > 1e-9 and least > s.margin and s.grasps < 3:
            # Four grasps turn a valve round, mostly; then they repeat themselves.
            return dc.replace(s, arc=arc, turned=s.turned + arc.turn, grasps=s.grasps + 1, least=least)
        best, margin = (place, least) if least > s.margin else (s.best, s.margin)
        group, index = s.group, s.index + 1
        if index == len(s.places[group]):
            group, index = group + 1, 0
        good = c.margin_min if s.kept and group == 1 else c.margin_good
        more = group < len(s.places) and (index > 0 or margin < good)
        done = margin >= c.margin_enough or not more
        fresh = dc.replace(s, group=group, index=index, arc=arc, turned=0.0, grasps=0, least=1.0)
        if done and margin < c.margin_min and s.begun and not s.split and c.arc_least < abs(s.turn_angle) <= ONE_GRASP:
            return dc.replace(fresh, group=0, index=0, split=True)
        return dc.replace(fresh, best=best, margin=margin, done=done)

    def find(self, X_OA: np.ndarray, turn_angle: float, viewer: np.ndarray | None = None) -> tuple[Place, float]:
        """The first place with a comfortable arm margin over the whole turn; if there is none, that with the largest.

        Returns (place, margin); margin < 0 if there is no place from which the hands reach.
        viewer: where the robot is now (x, y); None: the origin.
        """
        search = self.begin(X_OA, turn_angle, np.zeros(2) if viewer is None else viewer)
        while not search.done:
            search = self.advance(search)
        return search.best or Place(np.zeros(3)), search.margin


def _before(stem: np.ndarray, distance: float, angle: float) -> np.ndarray:
    """The base so far before the stem (x, y), facing it -> x, y, heading."""
    return np.array([stem[0] - distance * np.cos(angle), stem[1] - distance * np.sin(angle), angle])


def _better(arc: Arc, best: Arc, whole: bool) -> bool:
    if whole or abs(abs(arc.turn) - abs(best.turn)) < 0.3:
        return arc.margin > best.margin
    return abs(arc.turn) > abs(best.turn)
