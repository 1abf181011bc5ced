"""Collision-free joint paths for both arms together, and their timing.

A search tries the straight line in joint space, then lines through given via poses, then RRT-Connect with
short-cuts; every sample is checked by the caller's `is_free(q (n,)) -> bool` (left arm, right arm).
"""

import dataclasses as dc
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Free = Callable[[np.ndarray], bool]
STEP = 0.03  # largest joint step between two checks [rad]
PORTION = 12  # poses checked in one portion of a search, at most; each takes 0.1 to 1 ms
PAIRS = 11_000  # of shapes that they go through together, about
GROWTH = 0.4  # of a tree of RRT-Connect in one try, at most [rad]
AROUND = 0.8  # beyond start and goal that its random poses are drawn; raise it for long ways round [rad]
LEAVE = 0.06  # poses this near to the start are not checked: the robot is there, free or not [rad]


@dc.dataclass(frozen=True)
class Path:
    """Way points of both arms, with a stop at each: trapezoidal speed along every leg.

    points: (N, n) [rad]; start: when it begins [s]. limits: the joints' own speeds (n,) [rad/s]; None: none is slower
    than `speed`.
    """

    points: np.ndarray
    start: float
    speed: float  # of the fastest joint [rad/s]
    acceleration: float  # [rad/s^2]
    limits: np.ndarray | None = None

    def durations(self) -> np.ndarray:
        """Time of each leg [s] -> (N-1,)."""
        ways = np.abs(np.diff(self.points, axis=0))
        reach = np.max(ways, axis=1)
        speed: float | np.ndarray = self.speed
        if self.limits is not None:  # of the joint that goes farthest, so that each keeps its own
            slowest = np.max(ways / self.limits, axis=1)  # [s]
            speed = np.minimum(speed, reach / np.maximum(slowest, 1e-12))
            speed = np.where(reach > 0, speed, self.speed)
        short = reach < speed**2 / self.acceleration
        return np.where(short, 2 * np.sqrt(reach / self.acceleration), reach / speed + speed / self.acceleration)

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


@dc.dataclass(frozen=True)
class Line:
    """A straight line in joint space, whose samples after `a` are checked one by one; the middle ones first, which
    fail most often."""

    a: np.ndarray
    b: np.ndarray

    def samples(self) -> list[float]:
        """Their shares of the way, in the order in which they are checked."""
        count = max(1, int(np.ceil(np.max(np.abs(self.b - self.a)) / STEP)))
        return [k / count for k in sorted(range(1, count + 1), key=lambda k: abs(k / count - 0.5))]


def line_is_free(a: np.ndarray, b: np.ndarray, is_free: Free) -> bool:
    """Whether every checked sample of the joint line after `a` is free."""
    return all(is_free(a + (b - a) * share) for share in Line(a, b).samples())


Tree = tuple[tuple[np.ndarray, int], ...]  # nodes, each with the index of the one it grew from
GOAL, STRAIGHT, VIA, GROW, JOIN, SHORTEN = "goal", "straight", "via", "grow", "join", "shorten"


@dc.dataclass(frozen=True)
class PathSearch:
    """A search for a path, cut into portions: `advance` makes the next one.

    First the goal alone, then the straight line, then the via poses, then RRT-Connect, then short-cuts.
    """

    start: np.ndarray
    goal: np.ndarray
    vias: tuple[np.ndarray, ...] = ()
    tries: int = 400  # of RRT-Connect
    stage: str = GOAL
    at: int = 0  # which via, try, or pair of points to leave out what lies between
    lines: tuple[Line, ...] = ()  # being checked: all must be free
    checked: int = 0  # samples of the first of them
    trees: tuple[Tree, Tree] = ((), ())  # from the start and from the goal
    way: tuple[np.ndarray, ...] = ()  # what RRT-Connect has found, being shortened
    done: bool = False
    points: np.ndarray | None = None  # (N, n), once found

    def advance(self, is_free: Free, pairs: int = 0) -> "PathSearch":
        """The search after one more portion; the start need not be free: the robot is there.

        pairs: of shapes that is_free goes through.
        """
        s, start = self, self.start

        def free(q: np.ndarray) -> bool:
            return bool(np.max(np.abs(q - start)) < LEAVE) or is_free(q)

        for _ in range(max(1, min(PORTION, PAIRS // max(pairs, 1)))):
            if s.done:
                break
            if not s.lines:
                s = dc.replace(s, lines=(Line(s.goal, s.goal),))  # the first portion
            line = s.lines[0]
            shares = line.samples()
            q = line.a + (line.b - line.a) * shares[s.checked]
            if not (is_free(q) if s.stage == GOAL else free(q)):
                s = s._blocked()
            elif s.checked + 1 < len(shares):
                s = dc.replace(s, checked=s.checked + 1)
            elif len(s.lines) > 1:
                s = dc.replace(s, lines=s.lines[1:], checked=0)
            else:
                s = s._free()
        return s

    def _try(self, stage: str, at: int, *lines: Line, **changes: Any) -> "PathSearch":
        return dc.replace(self, stage=stage, at=at, lines=lines, checked=0, **changes)

    def _found(self, points: Sequence[np.ndarray]) -> "PathSearch":
        return dc.replace(self, done=True, points=np.array(points))

    def _free(self) -> "PathSearch":
        """What follows when the lines are free."""
        start, goal, at = self.start, self.goal, self.at
        if self.stage == GOAL:
            return self._try(STRAIGHT, 0, Line(start, goal))
        if self.stage == STRAIGHT:
            return self._found([start, goal])
        if self.stage == VIA:
            return self._found([start, self.vias[at], goal])
        if self.stage == GROW:  # towards what this tree has reached now grows the other one
            grow, other = self._order()
            target = self.lines[0].b
            grown = (*grow, (target, _nearest(grow, target)))
            q = other[_nearest(other, target)][0]
            return self._try(JOIN, at, Line(q, target), trees=(grown, other) if at % 2 == 0 else (other, grown))
        if self.stage == JOIN:
            grow, other = self._order()
            near = _nearest(other, self.lines[0].b)
            joined = (*other, (self.lines[0].b, near))
            trees = (grow, joined) if at % 2 == 0 else (joined, grow)
            way = (*_branch(trees[0])[::-1], *_branch(trees[1])[1:])
            return dc.replace(self, way=way)._shorten(0)
        i, j = _pairs(len(self.way))[at]
        return dc.replace(self, way=(*self.way[: i + 1], *self.way[j:]))._shorten(0)

    def _blocked(self) -> "PathSearch":
        """What follows when one of the lines is not free."""
        if self.stage == GOAL:
            return dc.replace(self, done=True)
        if self.stage == STRAIGHT:
            return self._via(0)
        if self.stage == VIA:
            return self._via(self.at + 1)
        if self.stage == SHORTEN:
            return self._shorten(self.at + 1)
        return self._grow(self.at + 1)

    def _via(self, k: int) -> "PathSearch":
        if k >= len(self.vias):
            return dc.replace(self, trees=(((self.start, -1),), ((self.goal, -1),)))._grow(0)
        return self._try(VIA, k, Line(self.start, self.vias[k]), Line(self.vias[k], self.goal))

    def _grow(self, tried: int) -> "PathSearch":
        """A tree grows by at most GROWTH towards a random pose."""
        if tried >= self.tries:
            return dc.replace(self, done=True)
        grow = self.trees[tried % 2]
        low, high = np.minimum(self.start, self.goal) - AROUND, np.maximum(self.start, self.goal) + AROUND
        to = np.random.Generator(np.random.SFC64(tried)).uniform(low, high)  # the same problem gives the same path
        q = grow[_nearest(grow, to)][0]
        reach = float(np.max(np.abs(to - q)))
        return self._try(GROW, tried, Line(q, q + (to - q) * min(1.0, GROWTH / reach)))

    def _order(self) -> tuple[Tree, Tree]:
        """The tree that grows in this try, and the other one."""
        return self.trees if self.at % 2 == 0 else self.trees[::-1]

    def _shorten(self, k: int) -> "PathSearch":
        """Leaves out way points that lie between two that see each other, the farthest apart first."""
        pairs = _pairs(len(self.way))
        if k >= len(pairs):
            return self._found(self.way)
        i, j = pairs[k]
        return self._try(SHORTEN, k, Line(self.way[i], self.way[j]))


def find_path(
    start: np.ndarray, goal: np.ndarray, vias: Sequence[np.ndarray], is_free: Free, *, tries: int = 400
) -> np.ndarray | None:
    """Way points (N, n) from start to goal, or None: a PathSearch to its end."""
    search = PathSearch(start, goal, tuple(vias), tries)
    while not search.done:
        search = search.advance(is_free)
    return search.points


def _pairs(count: int) -> list[tuple[int, int]]:
    """Of way points with others between them, the farthest apart first."""
    return [(i, i + apart) for apart in range(count - 1, 1, -1) for i in range(count - apart)]


def _nearest(tree: Tree, to: np.ndarray) -> int:
    return int(np.argmin([np.max(np.abs(q - to)) for q, _ in tree]))


def _branch(tree: Tree) -> list[np.ndarray]:
    """From the newest node back to the root."""
    out, k = [], len(tree) - 1
    while k >= 0:
        out.append(tree[k][0])
        k = tree[k][1]
    return out
