"""From where a robot's head sees a valve, for `check-robot`: the gaze as it is led in a run, both eyes' images."""

import math

import numpy as np

from valve_drake.behaviors.valve_search import ValveSearchConfig, aim
from valve_drake.camera.lens import StereoHead
from valve_drake.frames import apply, compose, inverse, make
from valve_drake.robot.robot import Robot

EDGE = 4.0  # of a marker's corner from the image's edge [px]
STEPS = 10  # of the gaze: each leaves a sixth of the error at the most
FAR = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)  # distances that are tried, base to panel along the floor [m]


def sees(
    robot: Robot, head: StereoHead, search: ValveSearchConfig, base: np.ndarray, posture: np.ndarray, points: np.ndarray
) -> bool:
    """Whether both eyes have all `points` (n, 3) in their images, the gaze at the middle of them as far as it goes.

    base: x, y, heading. search: as the robot's joints can do it. The waist stays at home.
    """
    rest = robot.torso.home.copy()
    rest[: len(posture)] = posture
    X_LEyes = make(np.eye(3), head.X_LR[:, 3] / 2)

    def torso(pitch: float, yaw: float) -> np.ndarray:
        out = rest.copy()
        for joint, angle in zip(robot.gaze[1:], robot.gaze_signs[1:] * [pitch, yaw]):
            if joint is not None:
                out[joint] = angle
        return out

    pitch = yaw = 0.0
    for _ in range(STEPS):
        way = aim(lambda b, gaze: compose(robot.head_pose(b, torso(*gaze[1:])), X_LEyes), base,
                  np.array([0.0, pitch, yaw]), points.mean(axis=0))  # fmt: skip
        pitch = min(max(way[0], search.pitch_low), search.pitch_high)
        yaw = min(max(way[1], -search.yaw_limit), search.yaw_limit)
    X_BL = robot.head_pose(base, torso(pitch, yaw))
    for lens, X_LC in zip(head.lenses(), (np.eye(3, 4), head.X_LR)):
        P = apply(inverse(compose(X_BL, X_LC)), points)
        if P[:, 2].min() <= 0.0:
            return False
        px = lens.project(P[:, :2] / P[:, 2:])
        if (px < EDGE).any() or (px > np.array([lens.width, lens.height]) - 1 - EDGE).any():
            return False
    return True


def seen_from(
    robot: Robot,
    head: StereoHead,
    search: ValveSearchConfig,
    base: np.ndarray,
    posture: np.ndarray,
    points: np.ndarray,
) -> float:
    """From the stance `base` (x, y, heading; the panel at the origin) straight back, how far the head sees `points`
    without a gap, base to panel [m]; NaN where it does not see them from the stance. A fixed robot stays there."""
    near = float(np.linalg.norm(base[:2]))
    if not sees(robot, head, search, base, posture, points):
        return math.nan
    far = near
    if not robot.drive.fixed:
        for distance in (d for d in FAR if d > near):
            if not sees(robot, head, search, base * [distance / near, distance / near, 1.0], posture, points):
                break
            far = distance
    return far
