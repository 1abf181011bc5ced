"""From where a robot's head sees a valve, for `check-robot`: the gaze as it is led in a run, both eyes' images."""

import numpy as np

from valve_drake.behaviors.stance_search import Place
from valve_drake.behaviors.valve_search import ValveSearchConfig, aim, neck
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

    base: x, y, heading. search: as the robot's joints can do it. posture: lift and waist.
    """
    X_LEyes = make(np.eye(3), head.X_LR[:, 3] / 2)
    gaze = robot.gaze.of(np.concatenate([posture, robot.torso.home[len(posture) :]]))

    def head_pose(base: np.ndarray, gaze: np.ndarray) -> np.ndarray:
        return robot.head_pose(base, robot.gaze.torso(gaze, posture))

    for _ in range(STEPS):
        way = aim(lambda base, gaze: compose(head_pose(base, gaze), X_LEyes), base, gaze, points.mean(axis=0))
        gaze = np.array([gaze[0], *neck(search, *way)])
    X_OL = head_pose(base, gaze)
    for lens, X_LC in zip(head.lenses(), (np.eye(3, 4), head.X_LR)):
        P = apply(inverse(compose(X_OL, X_LC)), points)
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
    place: Place,
    points: np.ndarray,
) -> float:
    """From a stance (the panel at the origin) straight back, how far the head sees `points` (n, 3) without a gap, base
    to panel [m]; 0 where it does not see them from the stance. A fixed robot stays there."""
    base, posture = place.base, robot.posture.home if place.posture is None else place.posture
    near = float(np.linalg.norm(base[:2]))
    if not sees(robot, head, search, base, posture, points):
        return 0.0
    far = near
    if not robot.drive.fixed:
        for distance in (d for d in FAR if d > near):
            if not sees(robot, head, search, base * [distance / near, distance / near, 1.0], posture, points):
                break
            far = distance
    return far
