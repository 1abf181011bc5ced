"""Arms with any number of joints: inverse kinematics by damped least squares, and what behaviours ask of a robot.

The pose and the Jacobian of a hand come from the robot's model (robot.py). This module has no model and no Drake: the
solver is a pure function of them.

A step is  J^T (J J^T + lambda I)^-1 e  with lambda = min(0.01 |e|^2, 1e-3): far from the goal it is careful, near it
converges quadratically. An arm with more than six joints is also drawn to its working posture in the Jacobian's null
space. That pull fades with the error, or it would never converge.

Frames: frames.py.
"""

import dataclasses as dc
import math
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from valve_drake.frames import rotation_vector
from valve_drake.messages import LEFT, RIGHT

OUTWARD: Mapping[str, float] = {LEFT: 1.0, RIGHT: -1.0}  # along y of B, away from the other arm
TOLERANCE = 1e-6  # of a pose [rad, m]
STRIDE = 0.5  # a joint that would move so far in one tick is on another branch: the wrist would turn by far [rad]
LENGTH = 0.4  # of an arm's order: what a radian is worth in meters when both are compared [m]

_STEP = 0.35  # of a joint in one iteration [rad]
_LAST = 1e-3  # after so small a step the next error is below TOLERANCE [rad]
_ITERATIONS = 40
_PATIENCE = 8  # iterations in which the error must have halved
_SEEDS = 10  # random ones, beside the working posture and home
_MOSTLY = 0.6  # share of a joint's range; with less of it within half a turn of zero, it is searched all over
_ENOUGH = 0.5  # margin at which no further seed is tried
_ROOM = math.radians(40)  # to a joint limit that is comfortable
_SINGULAR, _REGULAR = 0.05, 0.20  # least singular value of the scaled Jacobian at margins 0 and 1

_FELT = np.array([50.0] * 3 + [200.0] * 3)  # standard deviation of what a hand may feel; hardly matters [N m, N]

_UNITS = np.array([[1.0]] * 3 + [[LENGTH]] * 3)  # of a Jacobian's rows, for angles and lengths to compare

PoseAndJacobian = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # q (n,) -> X_BG (3, 4), J (6, n): [w; v] in B


@dc.dataclass(frozen=True, eq=False)
class Joints:
    """A group of joints, in the order of its vectors. A continuous joint's limits are infinite."""

    names: tuple[str, ...]
    low: np.ndarray  # (n,) [rad or m]
    high: np.ndarray  # (n,)
    speed: np.ndarray  # (n,) at most [1/s]
    home: np.ndarray  # (n,)

    def __len__(self) -> int:
        return len(self.names)

    def within(self, q: np.ndarray) -> bool:
        return bool(np.all(q >= self.low) and np.all(q <= self.high))


@dc.dataclass(frozen=True, eq=False)
class Arm(Joints):
    """An arm. work: the posture that it is drawn to at the valve (n,)."""

    work: np.ndarray


@dc.dataclass(frozen=True, eq=False)
class HandLoad:
    """What a wrist sensor carries, and where the hand's grip point is on it."""

    mass: float  # of all beyond the sensor [kg]
    p_SCom: np.ndarray  # its centre of mass in the sensor's frame (3,) [m]
    X_SG: np.ndarray  # (3, 4)


class RobotKinematics(Protocol):
    """What the behaviours know of a robot. Every answer depends on the question alone.

    q: an arm's joints (n,). posture: lift and waist, in the order of `posture.names`; None or empty: where they are at
    home.
    """

    @property
    def arms(self) -> Mapping[str, Arm]: ...

    @property
    def posture(self) -> Joints: ...

    @property
    def lift(self) -> int:
        """How many of the posture's joints are the lift; they come first."""

    @property
    def stand(self) -> tuple[float, float]:
        """The nearest and the farthest place before a panel that are worth a try, base to panel along the floor [m]."""

    @property
    def hands(self) -> Mapping[str, HandLoad]: ...

    @property
    def opening(self) -> float: ...

    @property
    def home(self) -> np.ndarray:
        """Both arms at home, left first (n + m,)."""

    def split(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """Both arms' joints (n + m,) -> by side."""

    def held(self, torso: np.ndarray) -> np.ndarray:
        """The posture, of the torso's joints (..., n) -> (..., m); empty where they were not measured yet."""

    def forward(self, side: str, q: np.ndarray, posture: np.ndarray | None = None) -> np.ndarray:
        """X_BG (3, 4)."""

    def inverse(
        self, side: str, X_BG: np.ndarray, near: np.ndarray | None = None, posture: np.ndarray | None = None
    ) -> np.ndarray | None:
        """Joints (n,) within their limits that bring the hand to X_BG within 1e-6 rad and m, or None.

        near: the solution that continues this pose; None: any, with a good margin where there is one.
        """

    def margin(self, side: str, q: np.ndarray) -> float:
        """Of an arm from its limits and singularities: 1 is comfortable, 0 at a limit, negative beyond."""


def pose_error(X: np.ndarray, X_goal: np.ndarray) -> np.ndarray:
    """The small motion from X to X_goal, both in one frame: [rotation vector; translation] in that frame (6,)."""
    R = X_goal[:, :3] @ X[:, :3].T
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    out = np.empty(6)
    if a + e + i > 2.99:  # below 6 degrees: the sine's series is enough, and quicker
        x, y, z = (h - f) / 2, (c - g) / 2, (d - b) / 2
        scale = 1 + (x * x + y * y + z * z) / 6
        out[0], out[1], out[2] = x * scale, y * scale, z * scale
    else:
        out[:3] = rotation_vector(R)
    out[3:] = X_goal[:, 3] - X[:, 3]
    return out


def solve(evaluate: PoseAndJacobian, X_goal: np.ndarray, start: np.ndarray, arm: Arm) -> np.ndarray | None:
    """The joints at X_goal that are reached from `start`, within the arm's limits; None if it does not get there."""
    q = np.minimum(np.maximum(start, arm.low), arm.high)
    redundant = len(arm) > 6
    identity = np.eye(len(arm)) if redundant else _NONE
    patience, target = 0, math.inf
    for k in range(_ITERATIONS):
        X, J = evaluate(q)
        e = pose_error(X, X_goal)
        square = float(e @ e)
        if square < TOLERANCE**2:
            return q
        if square < target:
            patience, target = k + _PATIENCE, square / 4
        elif k >= patience:
            return None
        A = J @ J.T
        A.flat[::7] += min(0.01 * square, 1e-3)
        step = J.T @ np.linalg.solve(A, e)
        if redundant:
            pull = min(0.05, 2 * math.sqrt(square)) * (arm.work - q)
            step = step + (identity - J.T @ np.linalg.solve(A, J)) @ pull
        largest = max(map(abs, step.tolist()))  # of so few numbers a third of numpy's time
        if largest > _STEP:
            step = step * (_STEP / largest)
        wanted = q + step
        q = np.minimum(np.maximum(wanted, arm.low), arm.high)
        if largest < _LAST and q.tolist() == wanted.tolist():
            return q
    return None


_NONE = np.zeros((0, 0))


def seeds(arm: Arm) -> list[np.ndarray]:
    """Where a search without a neighbour begins: always the same places."""
    rng = np.random.Generator(np.random.SFC64(len(arm)))
    low, high = np.maximum(arm.low, -math.pi), np.minimum(arm.high, math.pi)
    beyond = high - low < _MOSTLY * np.minimum(arm.high - arm.low, 2 * math.pi)  # of such a joint zero is no middle
    low, high = np.where(beyond, arm.low, low), np.where(beyond, np.minimum(arm.high, arm.low + 2 * math.pi), high)
    return [arm.work, arm.home, *(low + (high - low) * rng.uniform(0.1, 0.9, len(arm)) for _ in range(_SEEDS))]


def search(
    evaluate: PoseAndJacobian,
    X_goal: np.ndarray,
    arm: Arm,
    starts: list[np.ndarray],
    margin: Callable[[np.ndarray], float],
) -> np.ndarray | None:
    """The first solution from `starts` with a good margin, or the best there is."""
    best, most = None, -math.inf
    for start in starts:
        q = solve(evaluate, X_goal, start, arm)
        if q is None:
            continue
        value = margin(q)
        if value > most:
            best, most = q, value
        if most > _ENOUGH:
            break
    return best


def wrench(J: np.ndarray, load: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """The likeliest [torque; force] on a hand, for what it adds to the joints' loads (6,).

    J: of the hand (6, n). load: of the joints, J^T wrench and noise (n,); noise: its standard deviation (n,) [N m].
    Wrenches are expected to be of the size _FELT: that decides where the joints tell nothing.
    """
    weighed = J / noise**2
    A = weighed @ J.T
    A.flat[::7] += _FELT**-2.0
    out: np.ndarray = np.linalg.solve(A, weighed @ load)
    return out


def margin(q: np.ndarray, J: np.ndarray, arm: Arm) -> float:
    """See RobotKinematics.margin; J: its Jacobian there (6, n)."""
    limits = zip(q.tolist(), arm.low.tolist(), arm.high.tolist())
    room = min(min(at - low, high - at) / min(_ROOM, (high - low) / 4) for at, low, high in limits)
    scaled = J / _UNITS
    least = math.sqrt(max(float(np.linalg.eigvalsh(scaled @ scaled.T)[0]), 0.0))
    return min(1.0, room, (least - _SINGULAR) / (_REGULAR - _SINGULAR))
