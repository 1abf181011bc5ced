"""Bounded motion in discrete time: the laws that all blocks with a commanded motion share.

Blocks move a few joints in every tick. Plain floats take a third of numpy's time for so few, so `follow` works on one.
"""

import math
from typing import TypeVar

import numpy as np

Numbers = TypeVar("Numbers", float, np.ndarray)  # a number, or an array of them

_WHOLE = 2.0**53  # all floats from here on are whole numbers


def braking_speed(distance: float, acceleration: float, dt: float) -> float:
    """The highest speed that still stops within `distance` >= 0 when it falls by acceleration * dt each step.

    Exact for steps of dt: n of them cover d = n v dt - n (n - 1) / 2 a dt^2, with the fewest n that end at rest.
    """
    unit = acceleration * dt
    n = (math.sqrt(1 + 8 * distance / (unit * dt)) - 1) / 2
    if n < _WHOLE:  # not if it is infinite or no number
        n = max(math.ceil(n), 1)
    return distance / (n * dt) + unit * (n - 1) / 2


def slew(value: Numbers, goal: Numbers, step: np.ndarray | float) -> Numbers:
    """`value` moved towards `goal` by at most `step`."""
    return value + np.clip(goal - value, -step, step)


def towards(gap: float, speed: float, acceleration: float, dt: float) -> float:
    """Signed speed that closes `gap` as fast as allowed and stops there."""
    return math.copysign(min(speed, braking_speed(abs(gap), acceleration, dt)), gap)


def follow(
    target: float,
    target_velocity: float,
    position: float,
    velocity: float,
    speed: float,
    acceleration: float,
    dt: float,
) -> float:
    """One step of a commanded position after a target -> the position then.

    Never overshoots: the result lies between `position` and `target`. No faster than `speed`; gains speed, and brakes
    for a target at rest, by no more than `acceleration`. A target that itself keeps these bounds is met exactly,
    without lag, since braking counts against its own velocity. A target that stops or turns back more abruptly than
    that is obeyed at once: running past it could hit something.
    """
    gap = target - position
    if gap == 0:  # nearly always
        return target
    distance = abs(gap)
    side = gap / distance
    lead = min(max(side * target_velocity, 0.0), speed)
    brake = lead + braking_speed(max(distance - lead * dt, 0.0), acceleration, dt)
    reach = min(max(side * velocity, 0.0) + acceleration * dt, speed, brake) * dt
    return target if reach >= distance else position + side * reach
