"""Bounded motion in discrete time: the laws that all blocks with a commanded motion share, element by element."""

from typing import Any, TypeVar

import numpy as np

Numbers = TypeVar("Numbers", float, np.ndarray)  # a number, or an array of them


def braking_speed(distance: Numbers, acceleration: np.ndarray | float, dt: float) -> Numbers:
    """The highest speed that still stops within `distance` >= 0 when it falls by acceleration * dt each step.

    Exact for steps of dt: n of them cover d = n v dt - n (n - 1) / 2 a dt^2, with the fewest n that end at rest.
    """
    unit = acceleration * dt
    n: Any = np.maximum(np.ceil((np.sqrt(1 + 8 * distance / (unit * dt)) - 1) / 2), 1.0)
    speed: Numbers = distance / (n * dt) + unit * (n - 1) / 2
    return speed


def slew(value: Numbers, goal: Numbers, step: np.ndarray | float) -> Numbers:
    """`value` moved towards `goal` by at most `step`."""
    return value + np.clip(goal - value, -step, step)


def towards(gap: float, speed: float, acceleration: float, dt: float) -> float:
    """Signed speed that closes `gap` as fast as allowed and stops there."""
    return float(np.copysign(min(speed, braking_speed(abs(gap), acceleration, dt)), gap))


def follow(
    target: np.ndarray,
    target_velocity: np.ndarray,
    position: np.ndarray,
    velocity: np.ndarray,
    speed: np.ndarray | float,
    acceleration: np.ndarray | float,
    dt: float,
) -> tuple[np.ndarray, np.ndarray]:
    """One step of a commanded position after a target -> position, velocity.

    Never overshoots: the result lies between `position` and `target`. No faster than `speed`; gains speed, and brakes
    for a target at rest, by no more than `acceleration`. A target that itself keeps these bounds is met exactly,
    without lag, since braking counts against its own velocity. A target that stops or turns back more abruptly than
    that is obeyed at once: running past it could hit something.
    """
    gap = target - position
    side = np.sign(gap)
    distance = np.abs(gap)
    lead = np.minimum(np.maximum(side * target_velocity, 0.0), speed)  # np.clip takes twice as long
    brake = lead + braking_speed(np.maximum(distance - lead * dt, 0.0), acceleration, dt)
    reach = np.minimum(np.minimum(np.maximum(side * velocity, 0.0) + acceleration * dt, speed), brake) * dt
    new = np.where(reach >= distance, target, position + side * reach)
    return new, (new - position) / dt
