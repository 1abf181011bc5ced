"""How a base moves: which of the plane's three speeds it has, in the order of every twist, and their limits.

Behaviours think in all three, (forward, sideways to the left, yaw rate); a twist on a port has those that there are.
"""

import dataclasses as dc
from collections.abc import Mapping

import numpy as np

PLANE = ("forward", "sideways", "yaw_rate")  # [m/s, m/s, rad/s]
SPEEDS: Mapping[str, tuple[str, ...]] = {  # by robot.yaml's base.drive
    "differential": ("forward", "yaw_rate"),
    "holonomic": PLANE,
    "fixed": (),
}


def whole(twist: np.ndarray) -> tuple[float, float, float]:
    """Forward, sideways and yaw rate of a twist of two, three or no speeds; what it lacks is zero."""
    if len(twist) == 0:
        return 0.0, 0.0, 0.0
    forward, *sideways, yaw_rate = twist.tolist()
    return forward, sideways[0] if sideways else 0.0, yaw_rate


@dc.dataclass(frozen=True, eq=False)
class Drive:
    """A robot's base. speed, acceleration: at most, of each of its `names` (k,) [m/s, rad/s; m/s^2, rad/s^2]."""

    names: tuple[str, ...]
    speed: np.ndarray
    acceleration: np.ndarray

    @property
    def fixed(self) -> bool:
        return not self.names

    @property
    def sideways(self) -> bool:
        """Whether it can go sideways."""
        return len(self.names) == len(PLANE)

    def part(self, plane: np.ndarray) -> np.ndarray:
        """The twist of a motion (forward, sideways, yaw rate), of the speeds that there are -> (k,)."""
        return plane if self.sideways else np.array([plane[PLANE.index(name)] for name in self.names])


def drive(kind: str, speed: list[float], acceleration: list[float]) -> Drive:
    """The drive of a description's key `base`."""
    names = SPEEDS[kind]
    return Drive(names, np.array(speed[: len(names)], float), np.array(acceleration[: len(names)], float))


DIFFERENTIAL = drive("differential", [0.8, 1.2], [0.8, 2.0])  # robot.yaml's defaults
