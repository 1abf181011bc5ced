"""Collision-free joint paths for both arms together, and their timing.

A search tries the straight line in joint space, then lines through given via poses, then RRT-Connect with
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


@dc.dataclass(frozen=True)
class PathSearch:
    """A search for a path, cut into portions: `advance` makes the next one. Every portion is a few milliseconds' work.

    First the straight line, then one via pose a portion, then one try of RRT-Connect, then short-cuts.
    """

    start: np.ndarray
    goal: np.ndarray
    vias: tuple[np.ndarray, ...] = ()
    tries: int = 400  # of RRT-Connect
    portion: int = 0
    trees: "tuple[Tree, Tree]" = ((), ())  # from the start and from the goal
    way: tuple[np.ndarray, ...] = ()  # what RRT-Connect has found, being shortened
    cuts: int = 0  # pairs of its points that do not see each other
    done: bool = False
    points: np.ndarray | None = None  # (N, n), once found

    def advance(self, is_free: Free) -> "PathSearch":
        """The search after one more portion; the start need not be free: the robot is there."""
        start, goal = self.start, self.goal

        def free(q: np.ndarray) -> bool:
            return bool(np.max(np.abs(q - start)) < LEAVE) or is_free(q)

        k = self.portion
        after = dc.replace(self, portion=k + 1)
        if self.way:
            return after._shorten(free)
        if k == 0:
            if not is_free(goal):
                return dc.replace(after, done=True)
            return after._found([start, goal]) if line_is_free(start, goal, free) else after
        if k <= len(self.vias):
            via = self.vias[k - 1]
            straight = line_is_free(start, via, free) and line_is_free(via, goal, free)
            return after._found([start, via, goal]) if straight else after
        tried = k - len(self.vias) - 1
        if tried >= self.tries:
            return dc.replace(after, done=True)
        return after._connect(tried, free)

    def _found(self, points: Sequence[np.ndarray]) -> "PathSearch":
        return dc.replace(self, done=True, points=np.array(points))

    def _connect(self, tried: int, free: Free) -> "PathSearch":
        """One try of RRT-Connect: a tree grows towards a random pose, the other one towards what it has reached."""
        trees = self.trees if tried else (((self.start, -1),), ((self.goal, -1),))
        grow, other = trees[tried % 2], trees[1 - tried % 2]
        low, high = np.minimum(self.start, self.goal) - 0.8, np.maximum(self.start, self.goal) + 0.8
        grown = _extend(grow, _random(tried).uniform(low, high), free, 0.4)
        if grown is None:
            return dc.replace(self, trees=trees)
        joined = _extend(other, grown[-1][0], free, np.inf)
        order = (grown, joined or other)
        trees = order if tried % 2 == 0 else order[::-1]
        if joined is None:
            return dc.replace(self, trees=trees)
        return dc.replace(self, trees=trees, way=(*_branch(trees[0])[::-1], *_branch(trees[1])[1:]))

    def _shorten(self, free: Free) -> "PathSearch":
        """Leaves out way points that lie between two that see each other, the farthest apart first."""
        way, cuts = self.way, self.cuts
        for _ in range(4):
            pairs = [(i, i + apart) for apart in range(len(way) - 1, 1, -1) for i in range(len(way) - apart)]
            if cuts >= len(pairs):
                return self._found(way)
            i, j = pairs[cuts]
            if line_is_free(way[i], way[j], free):
                way, cuts = (*way[: i + 1], *way[j:]), 0
            else:
                cuts += 1
        return dc.replace(self, way=way, cuts=cuts)


Tree = tuple[tuple[np.ndarray, int], ...]  # nodes, each with the index of the one it grew from


def find_path(
    start: np.ndarray, goal: np.ndarray, vias: Sequence[np.ndarray], is_free: Free, *, tries: int = 400
) -> np.ndarray | None:
    """Way points (N, n) from start to goal, or None: a PathSearch to its end."""
    search = PathSearch(start, goal, tuple(vias), tries)
    while not search.done:
        search = search.advance(is_free)
    return search.points


def _random(k: int) -> np.random.Generator:
    """The same problem gives the same path."""
    return np.random.Generator(np.random.SFC64(k))


def _extend(tree: Tree, to: np.ndarray, is_free: Free, most: float) -> Tree | None:
    """The tree with one more node, at most `most` from its nearest one towards `to`; None if the way is blocked."""
    near = int(np.argmin([np.max(np.abs(q - to)) for q, _ in tree]))
    q = tree[near][0]
    reach = float(np.max(np.abs(to - q)))
    target = to if reach <= most else q + (to - q) * (most / reach)
    return (*tree, (target, near)) if line_is_free(q, target, is_free) else None


def _branch(tree: Tree) -> list[np.ndarray]:
    """From the newest node back to the root."""
    out, k = [], len(tree) - 1
    while k >= 0:
        out.append(tree[k][0])
        k = tree[k][1]
    return out
