"""The robot of the tests, and facts of it that no file states: its right arm mirrors the left one."""

import numpy as np

from valve_drake.messages import LEFT
from valve_drake.robot import description
from valve_drake.robot.robot import Robot

ROBOT = Robot.load(description.find(description.OURS))
MIRROR = np.array([1.0, -1, -1, -1, -1, -1])  # left arm to right arm: all axes but the lateral first one change sign
HOME = ROBOT.arms[LEFT].home  # left arm (6,)
ARMS_HOME = ROBOT.home  # (12,)
AT_VALVE = ROBOT.arms[LEFT].work  # left arm, its hand on a handle (6,)
LIMITS = ROBOT.arms[LEFT].high  # +- of either arm (6,) [rad]


def arm(side: str, left: np.ndarray) -> np.ndarray:
    """A pose of the left arm (6,), for the arm of this side."""
    return left if side == LEFT else left * MIRROR
