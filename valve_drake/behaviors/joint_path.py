"""Collision-free joint paths for both arms together, and their timing.

`find_path` tries the straight line in joint space, then lines through given via poses, then RRT-Connect with
short-cuts; every sample is checked by the caller's `is_free(q (n,)) -> bool` (left arm, right arm).
"""

import dataclasses as dc
from collections.abc import Callable, Sequence

import numpy as np

Free = Callable[[np.ndarray], bool]
STEP = 0.03  # largest joint step between two checks [rad]
LEAVE = 0.06  # poses this near to the start are not checked: the robot is there, free or not [rad]


@dc.dataclass(frozen=True)
class Path:
    """Way points of both arms, with a stop at each: trapezoidal speed along every leg.

    points: (N, n) [rad]; start: when it begins [s].
    """

    points: np.ndarray
    start: float
    speed: float  # of the fastest joint [rad/s]
    acceleration: float  # [rad/s^2]

    def durations(self) -> np.ndarray:
        """Time of each leg [s] -> (N-1,)."""
        reach = np.max(np.abs(np.diff(self.points, axis=0)), axis=1)
        short = reach < self.speed**2 / self.acceleration
        return np.where(
            short, 2 * np.sqrt(reach / self.acceleration), reach / self.speed + self.speed / self.acceleration
        )

    def end(self) -> float:
        return self.start + float(np.sum(self.durations()))

    def sample(self, time: float) -> np.ndarray:
        """Joint angles at `time` -> (n,)."""
        left = max(time - self.start, 0.0)  # a leg without length takes no time
        for k, duration in enumerate(self.durations()):
            if left < duration:
                a, b = self.points[k], self.points[k + 1]
                reach = float(np.max(np.abs(b - a)))
                return a + (b - a) * (_trapezoid(left, duration, reach, self.acceleration) / reach)
            left -= duration
        return self.points[-1]


def _trapezoid(t: float, duration: float, reach: float, acceleration: float) -> float:
    """Distance covered after t of a rest-to-rest move of `reach` in `duration`."""
    ramp = (duration - np.sqrt(max(duration**2 - 4 * reach / acceleration, 0.0))) / 2
    if t < ramp:
        return acceleration * t * t / 2
    if t > duration - ramp:
        return reach - acceleration * (duration - t) ** 2 / 2
    return acceleration * ramp * (t - ramp / 2)


def line_is_free(a: np.ndarray, b: np.ndarray, is_free: Free) -> bool:
    """Whether every checked sample of the joint line after `a` is free; the middle first, which fails most often."""
    count = max(1, int(np.ceil(np.max(np.abs(b - a)) / STEP)))
    order = sorted(range(1, count + 1), key=lambda k: abs(k / count - 0.5))
    return all(is_free(a + (b - a) * (k / count)) for k in order)


def find_path(
    start: np.ndarray, goal: np.ndarray, vias: Sequence[np.ndarray], is_free: Free, *, tries: int = 400
) -> np.ndarray | None:
    """Way points (N, n) from start to goal, or None. The start need not be free: the robot is there."""
    if not is_free(goal):
        return None

    def free(q: np.ndarray) -> bool:
        return bool(np.max(np.abs(q - start)) < LEAVE) or is_free(q)

    if line_is_free(start, goal, free):
        return np.array([start, goal])
    for via in vias:
        if line_is_free(start, via, free) and line_is_free(via, goal, free):
            return np.array([start, via, goal])
    return _rrt_connect(start, goal, free, tries)


def _rrt_connect(start: np.ndarray, goal: np.ndarray, is_free: Free, tries: int) -> np.ndarray | None:
    rng = np.random.default_rng(0)  # the same problem gives the same path
    low, high = np.minimum(start, goal) - 0.8, np.maximum(start, goal) + 0.8
    trees: list[list[tuple[np.ndarray, int]]] = [[(start, -1)], [(goal, -1)]]
    for k in range(tries):
        grow, other = trees[k % 2], trees[1 - k % 2]
        reached = _extend(grow, rng.uniform(low, high), is_free, 0.4)
        if reached is None:
            continue
        joined = _extend(other, reached, is_free, np.inf)
        if joined is not None and np.array_equal(joined, reached):
            half = [_branch(grow), _branch(other)]
            points = half[0][::-1] + half[1][1:]
            return _shortcut(points if k % 2 == 0 else points[::-1], is_free, rng)
    return None


def _extend(tree: list[tuple[np.ndarray, int]], to: np.ndarray, is_free: Free, most: float) -> np.ndarray | None:
    near = int(np.argmin([np.max(np.abs(q - to)) for q, _ in tree]))
    q = tree[near][0]
    reach = float(np.max(np.abs(to - q)))
    target = to if reach <= most else q + (to - q) * (most / reach)
    if not line_is_free(q, target, is_free):
        return None
    tree.append((target, near))
    return target


def _branch(tree: list[tuple[np.ndarray, int]]) -> list[np.ndarray]:
    """From the newest node back to the root."""
    out, k = [], len(tree) - 1
    while k >= 0:
        out.append(tree[k][0])
        k = tree[k][1]
    return out


def _shortcut(points: list[np.ndarray], is_free: Free, rng: np.random.Generator) -> np.ndarray:
    for _ in range(60):
        if len(points) < 3:
            break
        i, j = sorted(rng.choice(len(points), 2, replace=False))
        if j > i + 1 and line_is_free(points[i], points[j], is_free):
            points = points[: i + 1] + points[j:]
    return np.array(points)
