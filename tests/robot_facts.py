"""The robot of the tests, and facts of it that no file states: its right arm mirrors the left one."""

from typing import Any

import numpy as np

from valve_drake.messages import LEFT, SIDES, RobotState
from valve_drake.robot import description
from valve_drake.robot.robot import Robot
from valve_drake.stations.contract import vectors

ROBOT = Robot.load(description.find(description.OURS))
GROUPS = ROBOT.groups
SIZES = vectors(GROUPS)  # of the contract's vectors
MIRROR = np.array([1.0, -1, -1, -1, -1, -1])  # left arm to right arm: all axes but the lateral first one change sign
HOME = ROBOT.arms[LEFT].home  # left arm (6,)
ARMS_HOME = ROBOT.home  # (12,)
AT_VALVE = ROBOT.arms[LEFT].work  # left arm, its hand on a handle (6,)
LIMITS = ROBOT.arms[LEFT].high  # +- of either arm (6,) [rad]


def robot_state(**fields: Any) -> RobotState:
    """A state in which all joints are at zero, measured once, but for what is given."""
    zeros = {
        name: np.zeros(6) for side in SIDES for name in (f"{side}_arm", f"{side}_arm_velocity", f"{side}_arm_torque")
    }
    return RobotState(**{"torso": np.zeros(3), "history": np.zeros((1, 7))} | zeros | fields)


def arm(side: str, left: np.ndarray) -> np.ndarray:
    """A pose of the left arm (6,), for the arm of this side."""
    return left if side == LEFT else left * MIRROR
