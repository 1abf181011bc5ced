"""Postures for a robot.yaml whose own do not serve: `work`, from which the hands turn a valve, and `home`.

Both are found by trying: joints drawn at random, always the same ones, lead the arms to where hands are at a valve or
before the shoulders, and the best are kept. `check-robot` tells them, to be copied. Lengths [m], angles [rad].
"""

import copy
import dataclasses as dc
import math
from collections.abc import Callable, Mapping

import numpy as np

from valve_drake.behaviors.grasp_geometry import Grasp, standoff
from valve_drake.behaviors.stance_search import Stances
from valve_drake.collision import CollisionModel
from valve_drake.frames import compose, inverse, make, planar, rot_z
from valve_drake.messages import SIDES
from valve_drake.robot.description import RobotDescription
from valve_drake.robot.kinematics import OUTWARD, Arm
from valve_drake.robot.robot import Robot
from valve_drake.valve.valve import turned

BEGINNINGS = 100  # from which an arm is led to a handle; more of them find narrower ways
HANDLES = 2  # of those on an arm's side of the axis, the outermost
PLACES = 5  # distances to the panel that are tried
STEPS = 3  # from the middle of a turn to either end
CLOSEST = 3  # of the best places, whose postures are asked of the search that a run makes
HOMES = 250  # hands' places before the shoulders that are tried
AHEAD, ASIDE, BELOW = (0.15, 0.45), (0.0, 0.25), (0.1, 0.6)  # of these, from the shoulders [m]
EASY = 0.2  # margin of an arm at home
_FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # z of a hand ahead, x to the right

Postures = Mapping[str, list[float]]  # by side, rounded to two digits


@dc.dataclass(frozen=True)
class Work:
    """Working postures, and what a run's search gets with them."""

    postures: Postures
    height: float
    margin: float


def find_work(
    stances: Stances,
    valves: Mapping[float, np.ndarray],
    angle: float,
    least: float,
    margin_with: Callable[[Robot, np.ndarray], float],
) -> Work | None:
    """The working postures with which one of these valves is turned with the largest margin over `least`, or None.

    valves: the axis frame X_WA by height. margin_with: asks a run's search for grasps, of a robot and the valve's axis
    frame X_BA in its base.
    """
    robot, found = _of(stances), []
    low, high = robot.stand
    rng = np.random.Generator(np.random.SFC64(1))
    for height, X_WA in valves.items():
        for distance in np.linspace(low, high, PLACES):
            X_BA = compose(inverse(planar(-float(distance), 0.0, 0.0)), X_WA)
            arms = {side: _best(stances, side, X_BA, angle, rng) for side in SIDES}
            found.append((min(margin for margin, _ in arms.values()), height, X_BA, arms))
    found.sort(key=lambda one: -one[0])
    best: Work | None = None
    for margin, height, X_BA, arms in found[:CLOSEST]:
        if margin <= least:
            break
        postures = {side: _rounded(arms[side][1], robot.arms[side]) for side in SIDES}
        asked = margin_with(_with(robot, "work", postures), X_BA)
        if asked > (least if best is None else best.margin):
            best = Work(postures, height, asked)
    return best


def find_home(
    robot: Robot, collision: CollisionModel, work: Postures, serves: Callable[[Robot], bool]
) -> Postures | None:
    """Arms folded with the hands before the shoulders and below them, free of all, as near to `work` as may be.

    serves: whether a robot with that home is free of all, and out of its eyes' sight. None if no posture does.
    """
    rng = np.random.Generator(np.random.SFC64(2))
    near = {side: np.array(work[side]) for side in SIDES}
    shoulders = {side: robot.shoulder(side) for side in SIDES}
    found: list[tuple[float, dict[str, np.ndarray]]] = []
    for _ in range(HOMES):
        ahead, aside, below = (float(rng.uniform(*span)) for span in (AHEAD, ASIDE, BELOW))
        way_round = math.pi * float(rng.integers(2))
        joints = {}
        for side in SIDES:
            p = shoulders[side] + [ahead, OUTWARD[side] * aside, -below]
            X = make(_FORWARD @ rot_z(way_round), p)
            tried = [robot.inverse(side, X, start) for start in (near[side], *_random(robot.arms[side], rng, 4))]
            good = [q for q in tried if q is not None and robot.margin(side, q) > EASY]
            if good:
                joints[side] = min(good, key=lambda q: float(np.max(np.abs(q - near[side]))))
        if len(joints) == len(SIDES) and collision.is_free(None, np.concatenate([joints[side] for side in SIDES])):
            found.append((max(float(np.max(np.abs(joints[side] - near[side]))) for side in SIDES), joints))
    found.sort(key=lambda one: one[0])
    for _, joints in found[:12]:
        postures = {side: _rounded(joints[side], robot.arms[side]) for side in SIDES}
        if serves(_with(robot, "home", postures)):
            return postures
    return None


def _of(stances: Stances) -> Robot:
    assert isinstance(stances.robot, Robot)
    return stances.robot


def _with(robot: Robot, key: str, postures: Postures) -> Robot:
    """The robot with other postures."""
    described: RobotDescription = copy.deepcopy(robot.description)
    for side in SIDES:
        setattr(described.arm(side), key, list(postures[side]))
    return Robot.of(described, "", robot.model.shape)


def _rounded(q: np.ndarray, arm: Arm) -> list[float]:
    return np.round(np.clip(np.round(q, 2), np.ceil(arm.low * 100) / 100, np.floor(arm.high * 100) / 100), 2).tolist()


def _random(arm: Arm, rng: np.random.Generator, count: int) -> list[np.ndarray]:
    low, high = np.maximum(arm.low, -math.pi), np.minimum(arm.high, math.pi)
    return [low + (high - low) * rng.uniform(0.05, 0.95, len(arm)) for _ in range(count)]


def _best(
    stances: Stances, side: str, X_BA: np.ndarray, angle: float, rng: np.random.Generator
) -> tuple[float, np.ndarray]:
    """The joints in the middle of a turn from which an arm follows it to both ends and draws back, and their margin."""
    robot, valve = _of(stances), stances.valve
    middle = turned(X_BA, angle / 2)
    margin, best = -1.0, robot.arms[side].work
    out = [OUTWARD[side] * float(middle[1, :3] @ valve.grasp(k, 1.0)[:, 3]) for k in range(len(valve.handles))]
    order = sorted(range(len(out)), key=lambda k: -out[k])
    own = [k for k in order if out[k] > 0][:HANDLES] or order[:1]
    for handle in own:
        for sign in (1.0, -1.0):
            goal = compose(middle, valve.grasp(handle, sign))
            for start in _random(robot.arms[side], rng, BEGINNINGS):
                q = robot.inverse(side, goal, start)
                if q is None or robot.margin(side, q) <= margin:
                    continue
                reached = _along(stances, side, X_BA, angle, Grasp(handle, sign), q, margin)
                if reached > margin:
                    margin, best = reached, q
    return margin, best


def _along(
    stances: Stances, side: str, X_BA: np.ndarray, angle: float, grasp: Grasp, q: np.ndarray, least: float
) -> float:
    """The least margin of an arm from the middle of a turn to its ends, and drawn back there; -1 below `least`."""
    robot, X_AG = _of(stances), stances.valve.grasp(grasp.handle, grasp.sign)
    margin = robot.margin(side, q)
    for end in (0.0, angle):
        at: np.ndarray | None = q
        for k in range(1, STEPS + 2):
            share = min(k / STEPS, 1.0)
            X = compose(turned(X_BA, angle / 2 + share * (end - angle / 2)), X_AG)
            if k > STEPS:
                X = standoff(X, stances.view[side], stances.config.standoff)
            at = robot.inverse(side, X, at)
            if at is None or (margin := min(margin, robot.margin(side, at))) <= least:
                return -1.0
    return margin
