"""How the hands hold the valve, and which turn they are asked to follow: values.

With both hands on handles, a hand's pose X_AG in the valve's axis frame does not change while the valve turns, since A
turns with it. A turn that is longer than one grasp reaches is made of several: turn, let go, take other handles.
"""

import dataclasses as dc
import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np

from valve_drake.frames import compose, make
from valve_drake.messages import LEFT, RIGHT
from valve_drake.valve.valve import Valve, turned

CROSSED = 0.02  # the left hand is to the right of the right one by more than this [m]
APART = 0.03  # hands that are nearer across the axis leave open how the valve is turned [m]
WIDEST = 6  # pairs of handles of each kind, at most, that are tried first: those that are the widest apart
OTHERS = 9  # pairs, at most, that are tried then, spread over all there are; raise it for wheels of more handles


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


@dc.dataclass(frozen=True, eq=False)
class Turn:
    """A turn that is asked for, and from where.

    X_BA: the valve in the base, before it. angle: to turn [rad]. posture: lift and waist; None: at home.
    near: a like arc, to start from. least: whoever asks knows an arc of this margin, and a worse one is of no use.
    split: if no grasps hold it to its end, as far as some reach will do.
    """

    X_BA: np.ndarray
    angle: float
    posture: np.ndarray | None = None
    near: Arc | None = None
    least: float = 0.0
    split: bool = False


class Free(Protocol):
    """No contact and enough clearance with both arms at q, the valve at X_BA (None: no valve).

    posture: lift and waist; None: at home.
    """

    def __call__(self, X_BA: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None = None) -> bool: ...


def pairs(valve: Valve, X_BA: np.ndarray, turn_angle: float) -> Iterator[tuple[Pair, ...]]:
    """What both hands may hold, in groups that get worse: arms that do not cross, the hands wide apart, then anywhere
    (both at the bottom of a wheel that is high, for one), before those that cross; fingers with x_G to the robot's
    left, before the other way round."""
    middle = turned(X_BA, turn_angle / 2)
    ahead = middle[:, :3] @ np.array([0.0, 0, 1])
    aside = np.array([-ahead[1], ahead[0]])  # to the robot's left, along the panel
    level = np.linalg.norm(aside)
    aside = aside / level if level > 0.3 else np.array([0.0, 1.0])
    count = range(len(valve.handles))
    places = [compose(middle, valve.grasp(k, 1.0)) for k in count]
    at = [float(aside @ X[:2, 3]) for X in places]
    sign = [1.0 if aside @ X[:2, 0] >= 0 else -1.0 for X in places]
    both = [(i, k) for i, k in itertools.permutations(count, 2) if math.dist(valve.radius(i), valve.radius(k)) >= APART]
    both.sort(key=lambda pair: at[pair[1]] - at[pair[0]])
    plain = [pair for pair in both if at[pair[0]] - at[pair[1]] > -CROSSED]
    crossed = [pair for pair in both if pair not in plain][:WIDEST]
    widest = plain[:WIDEST]
    for some in (widest, _unlike(plain[WIDEST:], widest, [X[:, 3] for X in places]), crossed):
        for flips in (((1.0, 1.0),), ((-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0))):
            yield tuple(
                {LEFT: Grasp(i, sign[i] * flip[0]), RIGHT: Grasp(k, sign[k] * flip[1])}
                for i, k in some
                for flip in flips
            )


def _unlike(
    others: list[tuple[int, int]], tried: list[tuple[int, int]], places: list[np.ndarray]
) -> list[tuple[int, int]]:
    """Of the pairs of handles `others`, OTHERS at most: each the least like those before it, by both hands' places."""
    at = {pair: np.concatenate([places[k] for k in pair]) for pair in (*others, *tried)}
    near = {pair: min(math.dist(at[pair], at[other]) for other in tried) for pair in others}
    chosen: list[tuple[int, int]] = []
    while near and len(chosen) < OTHERS:
        least = max(near, key=lambda pair: round(near[pair], 6))  # the first of those that are as unlike
        chosen.append(least)
        near = {pair: min(d, math.dist(at[pair], at[least])) for pair, d in near.items() if pair != least}
    return chosen
