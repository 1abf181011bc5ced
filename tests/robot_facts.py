"""Facts of the robot for the tests, taken from the package, so that no test has a copy of its own."""

import numpy as np

from valve_drake.behaviors.kinematic_approach import KinematicApproachConfig
from valve_drake.kinematics import MIRROR, both_arms
from valve_drake.messages import LEFT

HOME = np.array(KinematicApproachConfig().home)  # left arm (6,)
ARMS_HOME = both_arms(HOME)  # (12,)
AT_VALVE = np.array([0.11, 0.72, -1.73, 0.13, 1.01, -0.07])  # left arm, its hand on a handle (6,)


def arm(side: str, left: np.ndarray) -> np.ndarray:
    """A pose of the left arm (6,), for the arm of this side."""
    return left if side == LEFT else left * MIRROR
