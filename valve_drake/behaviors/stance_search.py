"""The stance: where the robot stands so that both hands can turn the valve; a search in portions."""

import dataclasses as dc

import numpy as np

from valve_drake.behaviors.arc_search import ONE_GRASP, ArcSearch, GraspSearch
from valve_drake.behaviors.grasp_geometry import Arc, Turn
from valve_drake.behaviors.stance_config import StanceConfig
from valve_drake.frames import compose, inverse, planar, rot_z, rotation_vector
from valve_drake.valve.valve import angle_turned, has_heading, heading, turned

AROUND = (0.5, -0.5, 1.0, -1.0)  # sides from which a valve with an upright axis is tried, off the nearest [rad]
FEW = 9  # distances of a search's first round
# A valve that is seen off by less needs no other stance: well below what a grasp leaves room for.
SAME_HEIGHT = 0.01  # [m]
SAME_TILT = 0.03  # [rad]
AS_GOOD = 0.05  # a place whose margin has fallen by less is as good as it was


@dc.dataclass(frozen=True, eq=False)
class Place:
    """Where the robot may stand: base (x, y, heading) in O, posture (lift and waist; None: at home)."""

    base: np.ndarray
    posture: np.ndarray | None = None


@dc.dataclass(frozen=True, eq=False)
class StanceSearch:
    """A search for a stance: `Stances.advance` makes the next portion.

    places: by group; the search ends with a place of `margin_enough`, or after a group that has one of `margin_good`.
    """

    X_OA: np.ndarray
    turn_angle: float
    places: tuple[tuple[Place, ...], ...]
    kept: bool = False  # the first group keeps a lift where it is: it will do where it is accepted
    dense: int = 100  # groups from this one on are tried only if nothing before is accepted, and with one grasp
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
    found_in: int = 0  # the group of `best`
    done: bool = False
    wanted: float = -1.0  # with a smaller margin ...
    instead: "StanceSearch | None" = None  # ... the search goes on with this one


@dc.dataclass(frozen=True, eq=False)
class Stances(GraspSearch):
    """Which turns the hands can follow, and from where. bolted: only from where the robot is, the origin of O."""

    bolted: bool = False

    def __post_init__(self) -> None:
        self.config.distances(self.robot.stand)

    def begin(
        self, X_OA: np.ndarray, turn_angle: float, viewer: np.ndarray, last: StanceSearch | None = None
    ) -> StanceSearch:
        """A search for the stance from which the valve at X_OA can be turned. viewer: the robot's place (x, y) now.

        last: the search before, for nearly the same valve. Its lift is kept while that serves, since lifts are slow. If
        it had to look farther than straight before the valve, its place is tried first: it took long.
        """
        found = last is not None and last.best is not None and last.margin >= self.config.margin_min
        if last is None or last.best is None or not found:
            places, dense = self._places(X_OA, viewer, None)
            return StanceSearch(X_OA, turn_angle, places, dense=dense)
        posture = self.robot.posture.home if last.best.posture is None else last.best.posture
        places, dense = self._places(X_OA, viewer, posture)
        afresh = StanceSearch(X_OA, turn_angle, places, kept=self.robot.lift > 0, dense=dense)
        if self.bolted or self.robot.lift or (last.found_in == 0 and last.margin >= self.config.margin_good):
            return afresh
        there = Place(_moved(last.best.base, last.X_OA, X_OA), last.best.posture)
        return StanceSearch(
            X_OA,
            turn_angle,
            ((there,),),
            split=last.split,
            found_in=last.found_in,
            wanted=max(last.margin - AS_GOOD, self.config.margin_min),
            instead=afresh,
        )

    def moved(self, search: StanceSearch, X_OA: np.ndarray, turn_angle: float) -> np.ndarray | None:
        """The base (x, y, heading) of a search's stance, moved along with a valve that is now seen at X_OA.

        None where the valve is another to the arms: higher, tilted or turned, or seen elsewhere by a robot that cannot
        move.
        """
        if search.best is None or self.bolted or turn_angle != search.turn_angle:
            return None
        X_OA = self._alike(search.X_OA, X_OA)
        off = _swing(search.X_OA, X_OA)
        tilt = rotation_vector(rot_z(off) @ search.X_OA[:, :3] @ X_OA[:, :3].T)
        if abs(X_OA[2, 3] - search.X_OA[2, 3]) > SAME_HEIGHT or np.linalg.norm(tilt) > SAME_TILT:
            return None
        return _moved(search.best.base, search.X_OA, X_OA)

    def _alike(self, X_OA: np.ndarray, X_OA1: np.ndarray) -> np.ndarray:
        """The second pose, turned about its axis to what looks the same and is nearest to the first: from another side
        the cameras may take the other end of a marker for its X."""
        period = self.valve.repeats(True)
        times = round(angle_turned(X_OA, X_OA1) / period)
        return turned(X_OA1, -times * period) if times else X_OA1

    def _places(
        self, X_OA: np.ndarray, viewer: np.ndarray, posture: np.ndarray | None
    ) -> tuple[tuple[tuple[Place, ...], ...], int]:
        """Square to the panel, from near to far; first with the lift as given, then at home, then at other heights,
        then a step aside. Where the robot may stand at many distances, a few of them; all, at home, come last ->
        groups, and which is the first of all distances."""
        c: StanceConfig = self.config
        angle = heading(X_OA, viewer)
        left = np.array([-np.sin(angle), np.cos(angle)])
        stem = compose(X_OA, self.valve.X_AP())[:2, 3]  # at the panel
        distances = c.distances(self.robot.stand)
        every = [np.zeros(3)] if self.bolted else [_before(stem, distance, angle) for distance in distances]
        thin = -(-len(every) // FEW)
        distances, bases = distances[::thin], every[::thin]
        home = self.robot.posture.home
        groups = [tuple(Place(base) for base in bases)]
        if posture is not None and self.robot.lift:
            kept = tuple(Place(base, posture) for base in bases)
            groups = [kept, *(groups if np.max(np.abs(posture - home)) > 1e-3 else [])]
        if raised := self._postures():
            groups.append(tuple(Place(base, posture) for posture in raised for base in bases))
        if self.bolted:
            return tuple(groups), len(groups)
        if not has_heading(X_OA):  # a valve that lies flat is turned from any side
            groups += [tuple(Place(_before(stem, d, angle + off)) for d in distances) for off in AROUND]
        elif c.aside > 0:
            steps = [np.array([*(side * c.aside * left), 0.0]) for side in (1.0, -1.0)]
            groups.append(tuple(Place(base + step) for step in steps for base in every[:: 2 * thin]))
        dense = len(groups)
        if thin > 1:
            groups.append(tuple(Place(base) for base in every))
        return tuple(group for group in groups if group), dense

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
        arcs = self.advance_arc(self._here(s, place, asked) if s.arcs is None else s.arcs)
        if not arcs.done:
            return dc.replace(s, arcs=arcs)
        s, arc = dc.replace(s, arcs=None, begun=s.begun or arcs.begun), arcs.best
        least, left = min(s.least, arc.margin), asked - arc.turn
        if arc.margin >= c.margin_min and abs(left) > 1e-9 and least > s.margin and s.grasps < 3:
            # Four grasps turn a valve round, mostly; then they repeat themselves.
            return dc.replace(s, arc=arc, turned=s.turned + arc.turn, grasps=s.grasps + 1, least=least)
        if least > s.margin:
            found_in = s.group if s.instead is None else s.found_in
            s = dc.replace(s, best=place, margin=least, found_in=found_in)
        group, index = s.group, s.index + 1
        if index == len(s.places[group]):
            group, index = group + 1, 0
        good = c.margin_min if (s.kept and group == 1) or group >= s.dense else c.margin_good
        more = group < (min(s.dense, len(s.places)) if s.split else len(s.places)) and (index > 0 or s.margin < good)
        done = s.margin >= c.margin_enough or not more
        if done and s.instead is not None and s.margin < s.wanted:
            return s.instead
        fresh = dc.replace(s, group=group, index=index, arc=arc, turned=0.0, grasps=0, least=1.0)
        splits = s.begun and not s.split and c.arc_least < abs(s.turn_angle) <= ONE_GRASP
        if done and s.margin < c.margin_min and splits:
            return dc.replace(fresh, group=0, index=0, split=True, best=search.best, margin=search.margin)
        return dc.replace(fresh, done=done)

    def _here(self, s: StanceSearch, place: Place, asked: float) -> ArcSearch:
        """The search for the grasps at a place, for what is left of the turn."""
        X_BA = turned(compose(inverse(planar(*place.base)), s.X_OA), s.turned)
        alone = s.grasps == 0 and abs(asked) <= ONE_GRASP
        least = max(s.margin, 0.0) if alone else 0.0
        return self.begin_arc(Turn(X_BA, asked, place.posture, s.arc, least, s.split))

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


def _moved(base: np.ndarray, X_OA: np.ndarray, X_OA1: np.ndarray) -> np.ndarray:
    """The base (x, y, heading) that stands to the valve at X_OA1 as `base` does to the one at X_OA."""
    off = _swing(X_OA, X_OA1)
    x, y = base[:2] - X_OA[:2, 3]
    c, s = np.cos(off), np.sin(off)
    return np.array([X_OA1[0, 3] + c * x - s * y, X_OA1[1, 3] + s * x + c * y, base[2] + off])


def _swing(X_OA: np.ndarray, X_OA1: np.ndarray) -> float:
    """The angle on the floor from where one valve looks to where the other does; of an upright axis 0."""
    if not (has_heading(X_OA) and has_heading(X_OA1)):
        return 0.0
    return heading(X_OA1, np.zeros(2)) - heading(X_OA, np.zeros(2))
