"""Where the hands hold the valve, at any angle of it; and the stance: where the base stands so that they can.

With both hands on the handles, a hand's pose X_VG in the marker's frame does not change while the valve
turns, since V turns with it. Turning by theta (positive opens, about -z of V): X_OV(theta) = X_OV R_z(-theta).
"""

import dataclasses as dc
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from valve_drake.checks import require
from valve_drake.config import Config, number
from valve_drake.frames import compose, inverse, make, planar, rot_z
from valve_drake.messages import LEFT, RIGHT, SIDES
from valve_drake.perception.marker import Marker
from valve_drake.robot.kinematics import OUTWARD, RobotKinematics

MAX_PLACES = 40  # distances of one search for a stance: it must end while the robot waits


@dc.dataclass
class StanceConfig(Config):
    """Scenario key `stance`: which places to stand at are tried."""

    KEY = "stance"
    distance_min: float = number(
        0.70, 0.5, 1.2, "least distance that is tried, shoulder axis to the panel along the floor [m]"
    )
    distance_max: float = number(0.84, 0.5, 1.2, "largest distance that is tried [m]")
    distance_step: float = number(0.02, 0.005, 0.2, "between two distances; halving it doubles the search [m]")
    standoff: float = number(
        0.12, 0.02, 0.3, "hands start and end this far from the grasp, along the wrist camera's view [m]"
    )
    arc_step: float = number(
        0.27, 0.1, 1.0, "between two angles of the turn that are checked; halving it doubles the search [rad]"
    )
    lift_step: float = number(0.08, 0.01, 1.0, "between two heights of a lift that are tried [m]")
    margin_enough: float = number(0.9, 0.01, 1.0, "the search ends at the first stance with this arm margin")
    margin_good: float = number(0.5, 0.01, 1.0, "with a stance of this arm margin no other height is tried")
    margin_min: float = number(0.15, 0.01, 1.0, "least arm margin that is accepted (1 is comfortable)")

    def relations(self, key: str) -> None:
        span = self.distance_max - self.distance_min
        require(span >= 0, f"{key}.distance_min", f"at most distance_max, {self.distance_max:g}", self.distance_min)
        few = span <= (MAX_PLACES - 1) * self.distance_step
        least = span / (MAX_PLACES - 1)
        require(few, f"{key}.distance_step", f"at least {least:.3g}: {MAX_PLACES} distances", self.distance_step)


def turned(X_AV: np.ndarray, angle: float) -> np.ndarray:
    """The marker's pose after the valve turned by `angle` (positive opens) -> (3, 4)."""
    return compose(X_AV, make(rot_z(-angle), np.zeros(3)))


def angle_turned(X_AV0: np.ndarray, X_AV1: np.ndarray) -> float:
    """The angle turned from pose 0 to pose 1 about the common axis, in (-pi, pi], positive opens."""
    R = X_AV0[:, :3].T @ X_AV1[:, :3]
    return float(-np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))


def hand_in_valve(side: str, swapped: bool, marker: Marker) -> np.ndarray:
    """X_VG of a hand on its handle -> (3, 4). z_G into the panel, x_G along the bar, towards the left hand's end."""
    s = OUTWARD[side] * (-1.0 if swapped else 1.0)
    R = np.eye(3) if swapped else np.diag([-1.0, -1.0, 1.0])
    return make(R, np.array([-s * marker.handle_radius, 0, marker.handle_depth]))


def standoff(X_AG: np.ndarray, view_G: np.ndarray, distance: float) -> np.ndarray:
    """The hand drawn back from X_AG by `distance` against its camera's view direction (in G), so that the
    mark stays in the middle of the wrist image -> (3, 4)."""
    return make(X_AG[:, :3], X_AG[:, 3] - distance * X_AG[:, :3] @ view_G)


@dc.dataclass(frozen=True)
class ArcCheck:
    """Both arms along a turn: the least margin over it, and each arm's joint angles at its start."""

    margin: float
    swapped: bool
    q: Mapping[str, np.ndarray] = dc.field(default_factory=dict)  # side -> (n,); empty if the turn is out of reach
    q_standoff: Mapping[str, np.ndarray] = dc.field(default_factory=dict)  # the same at the stand-off before it


JUMP = 1.0  # a joint that moves so far between two angles of the turn is on another branch [rad]


class Free(Protocol):
    """No contact and enough clearance with both arms at q, the valve at X_BV (None: no valve).

    posture: lift and waist; None: at home.
    """

    def __call__(self, X_BV: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None = None) -> bool: ...


@dc.dataclass(frozen=True, eq=False)
class Place:
    """Where the robot may stand: base (x, y, heading) in O, posture (lift and waist; None: at home)."""

    base: np.ndarray
    posture: np.ndarray | None = None


@dc.dataclass(frozen=True, eq=False)
class StanceSearch:
    """A search for a stance, cut into portions of one place each: `Stances.advance` makes the next one.

    places: by group; the search ends with a place of `margin_enough`, or after a group that has one of `margin_good`.
    """

    X_OV: np.ndarray
    turn_angle: float
    places: tuple[tuple[Place, ...], ...]
    group: int = 0
    index: int = 0  # of the next place in its group
    arc: ArcCheck | None = None  # of the place before, to start from
    best: Place | None = None
    margin: float = -1.0  # of `best`
    done: bool = False


@dc.dataclass(frozen=True, eq=False)
class Stances:
    """Which turns the hands can follow, and from where.

    view: each wrist camera's view direction in its hand's frame (from the taught reference).
    """

    robot: RobotKinematics
    marker: Marker
    config: StanceConfig
    view: Mapping[str, np.ndarray]
    is_free: Free

    def check_arc(
        self,
        X_BV: np.ndarray,
        turn_angle: float,
        swapped: bool,
        near: Mapping[str, np.ndarray] | None = None,
        least: float = 0.0,
        posture: np.ndarray | None = None,
    ) -> ArcCheck:
        """Whether both hands can hold their handles all along the turn, and draw back from them at both ends.

        X_BV: marker in the base. near: joints of a like arc's start, by side. posture: lift and waist; None: at home.
        least: the check ends where the margin falls to it: whoever asks knows a better arc.
        Unless the arms are free of all at the turn's start, middle and end, and drawn back, the margin is -1.
        """
        robot, out = self.robot, ArcCheck(-1.0, swapped)
        count = max(2, int(np.ceil(abs(turn_angle) / self.config.arc_step)) + 1)
        angles = np.linspace(0.0, turn_angle, count)
        margin = 1.0
        arcs: dict[str, list[np.ndarray]] = {side: [] for side in SIDES}
        backs: dict[str, list[np.ndarray]] = {side: [] for side in SIDES}
        for side in SIDES:
            X_VG = hand_in_valve(side, swapped, self.marker)
            q_last = near.get(side) if near else None
            for k, angle in enumerate(angles):
                X_BG = compose(turned(X_BV, angle), X_VG)
                start = q_last if k < 2 else 2 * arcs[side][-1] - arcs[side][-2]  # goes on as before
                q = robot.inverse(side, X_BG, start, posture)
                if q is None and k == 0 and q_last is not None:
                    q = robot.inverse(side, X_BG, posture=posture)
                if q is None or (k > 0 and q_last is not None and np.max(np.abs(q - q_last)) > JUMP):
                    return out
                margin = min(margin, robot.margin(side, q))
                if k in (0, count - 1):
                    back = robot.inverse(side, standoff(X_BG, self.view[side], self.config.standoff), q, posture)
                    if back is None:
                        return out
                    margin = min(margin, robot.margin(side, back))
                    backs[side].append(back)
                if margin <= least:
                    return ArcCheck(margin, swapped)
                arcs[side].append(q)
                q_last = q
        poses = [(angles[k], arcs, k) for k in (0, count // 2, count - 1)]
        poses += [(angles[0], backs, 0), (angles[-1], backs, 1)]
        for angle, joints, k in poses:
            q_both = np.concatenate([joints[side][k] for side in SIDES])
            if not self.is_free(turned(X_BV, angle), q_both, posture):
                return out
        return ArcCheck(
            margin, swapped, {side: arcs[side][0] for side in SIDES}, {side: backs[side][0] for side in SIDES}
        )

    def best_arc(
        self,
        X_BV: np.ndarray,
        turn_angle: float,
        near: ArcCheck | None = None,
        least: float = 0.0,
        posture: np.ndarray | None = None,
    ) -> ArcCheck:
        """The assignment of the handles to the hands with which the arms do not cross; where that does not serve, the
        better of the two by its margin. near: a like arc, to start from; the rest: as of `check_arc`."""
        middle = turned(X_BV, turn_angle / 2)
        left = {
            swapped: compose(middle, hand_in_valve(LEFT, swapped, self.marker))[1, 3]
            - compose(middle, hand_in_valve(RIGHT, swapped, self.marker))[1, 3]
            for swapped in (False, True)
        }
        orders = sorted(left, key=lambda swapped: -left[swapped])  # left hand on the left first
        best = ArcCheck(-1.0, orders[0])
        for swapped in orders:
            start = near.q if near is not None and near.swapped == swapped else None
            arc = self.check_arc(X_BV, turn_angle, swapped, start, max(best.margin, least), posture)
            if arc.margin > best.margin:
                best = arc
            if best.margin >= self.config.margin_min:
                break
        return best

    # ------------------------------------------------------------ where to stand
    def begin(self, X_OV: np.ndarray, turn_angle: float, posture: np.ndarray | None = None) -> StanceSearch:
        """A search for the stance from which the valve at X_OV can be turned.

        posture: of a stance that was found for nearly the same valve: kept while it serves, since lifts are slow.
        """
        return StanceSearch(X_OV, turn_angle, self._places(X_OV, posture))

    def _places(self, X_OV: np.ndarray, posture: np.ndarray | None) -> tuple[tuple[Place, ...], ...]:
        """Square to the panel, from near to far; first with the lift as given, then at home, then at other heights."""
        heading = float(np.arctan2(X_OV[1, 2], X_OV[0, 2]))  # of z_V, into the panel, on the floor
        forward = np.array([np.cos(heading), np.sin(heading)])
        axis_point = X_OV[:, 3] + self.marker.panel_depth * X_OV[:, 2]  # the stem at the panel
        c = self.config
        distances = np.arange(c.distance_min, c.distance_max + 1e-9, c.distance_step)
        bases = [np.array([*(axis_point[:2] - distance * forward), heading]) for distance in distances]
        home = self.robot.posture.home
        groups = [tuple(Place(base) for base in bases)]
        if posture is not None and np.max(np.abs(posture - home), initial=0.0) > 1e-3:
            groups.insert(0, tuple(Place(base, posture) for base in bases))
        if raised := self._postures():
            groups.append(tuple(Place(base, posture) for posture in raised for base in bases))
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
        """The search after its next place."""
        c, s = self.config, search
        place = s.places[s.group][s.index]
        X_BV = compose(inverse(planar(*place.base)), s.X_OV)
        arc = self.best_arc(X_BV, s.turn_angle, s.arc, max(s.margin, 0.0), place.posture)
        best, margin = (place, arc.margin) if arc.margin > s.margin else (s.best, s.margin)
        group, index = s.group, s.index + 1
        if index == len(s.places[group]):
            group, index = group + 1, 0
        left = group < len(s.places) and (index > 0 or margin < c.margin_good)
        done = margin >= c.margin_enough or not left
        return dc.replace(s, group=group, index=index, arc=arc, best=best, margin=margin, done=done)

    def find(self, X_OV: np.ndarray, turn_angle: float) -> tuple[Place, float]:
        """The first place with a comfortable arm margin over the whole turn; if there is none, that with the largest.

        Returns (place, margin); margin < 0 if there is no place from which the hands reach.
        """
        search = self.begin(X_OV, turn_angle)
        while not search.done:
            search = self.advance(search)
        return search.best or Place(np.zeros(3)), search.margin
