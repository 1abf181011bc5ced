"""Can open hands be at the valve's handles at all? Asked once, before a run, so that the file is blamed by its key."""

import itertools
import math
from collections.abc import Callable
from typing import Protocol, TypeAlias

import numpy as np

from valve_drake.behaviors.grasp_geometry import APART
from valve_drake.checks import ConfigError, require
from valve_drake.frames import make
from valve_drake.messages import SIDES
from valve_drake.valve.valve import PLATE, Valve

ROOM = 0.3  # so much farther from the axis a hand is looked for that is clear of the valve, for the error's line [m]


AtHandle: TypeAlias = Callable[[str, np.ndarray], list[str]]  # side, X_AG -> shapes


class Hands(Protocol):
    """What of the valve is at open hands (CollisionModel)."""

    def at_handle(self, side: str, X_AG: np.ndarray) -> list[str]: ...

    def held_at(self, side: str, X_AG: np.ndarray) -> list[str]: ...


def check_handles(hands: Hands, valve: Valve, opening: float) -> None:
    """Raises ConfigError if there are no two handles that open hands can be at: they touch the valve at the others.

    opening: of the hands [m].
    """
    at_handle = hands.at_handle
    count = range(len(valve.handles))
    free = {side: [k for k in count if any(not at_handle(side, X) for X in _ways(valve, k))] for side in SIDES}
    if any(math.dist(valve.radius(i), valve.radius(k)) >= APART for i, k in itertools.product(*free.values())):
        return
    handle, side = next((k, side) for side in SIDES for k in count if k not in free[side])
    way = min(_ways(valve, handle), key=lambda X: len(at_handle(side, X)))
    touched = set(at_handle(side, way))
    if held := touched.intersection(hands.held_at(side, way)):
        rule = (
            f"wider, or frames.{side}_grip and pad.at between the fingers' shapes: an open hand at "
            f"valve.handles[{handle}], {valve.handles[handle].width:g} m wide, touches what it is to hold"
        )
        require(False, "opening", f"{rule} ({', '.join(sorted(held))}) or is nearer than collision.padding", opening)
    if touched == {PLATE}:
        extra = _room(at_handle, side, way, touched, np.array([0.0, 0.0, -1.0]))
        least = math.ceil(1e3 * (valve.panel.depth + (extra or 0.0))) / 1e3
        rule = f"at least {least:g}: an open hand at valve.handles[{handle}] touches the panel"
        require(False, "valve.panel.depth", f"{rule} or is nearer than collision.padding", valve.panel.depth)
    words = f"an open hand there touches the valve ({', '.join(sorted(touched))}) or is nearer than collision.padding"
    fixed = {
        name for name in touched if not name.startswith("spoke") and name != PLATE
    }  # spokes reach as far as the rim, wherever it is
    if not fixed:
        rule = f"fewer, or farther from valve.handles[{handle}]: {words}"
        raise ConfigError(f"valve.spokes must be {rule}, got {valve.spokes}")
    extra = _room(at_handle, side, way, fixed, np.array([*way[:2, 3], 0.0]) / math.hypot(*way[:2, 3]))
    least = math.ceil(1e3 * (math.hypot(*valve.radius(handle)) + (extra or 0.0))) / 1e3
    rule = "where a hand fits" if extra is None else f"at least {least:g} m off the axis"
    require(False, f"valve.handles[{handle}].xyz", f"{rule}: {words}", valve.handles[handle].xyz)


def _ways(valve: Valve, handle: int) -> list[np.ndarray]:
    """The poses X_AG of a hand at a handle."""
    return [valve.grasp(handle, sign) for sign in (1.0, -1.0)]


def _room(at_handle: AtHandle, side: str, X_AG: np.ndarray, touched: set[str], direction: np.ndarray) -> float | None:
    """How much farther along a direction of A (3,) a hand is clear of these shapes [m]; None: nowhere."""

    def touches(extra: float) -> bool:
        there = make(X_AG[:, :3], X_AG[:, 3] + extra * direction)
        return not touched.isdisjoint(at_handle(side, there))

    low, high = 0.0, ROOM
    if touches(high):
        return None
    while high - low > 5e-4:
        middle = (low + high) / 2
        low, high = (middle, high) if touches(middle) else (low, middle)
    return high
