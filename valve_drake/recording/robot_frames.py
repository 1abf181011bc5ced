"""Poses of all bodies of robot and valve, computed from measurements and estimates, for the log's 3D view."""

import functools

import numpy as np
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from valve_drake.camera.lens import StereoHead
from valve_drake.frames import compose, planar
from valve_drake.messages import SIDES, GraspPlan, RectangleEstimate, RobotState, TurnState
from valve_drake.recording.scene import parts_of, scene
from valve_drake.robot.robot import Robot
from valve_drake.valve.valve import turned

Transforms = list[tuple[str, str, np.ndarray]]
ODOMETRY = "odometry"


class RobotFrames:
    """The controllers' model of the robot in its measured pose. Frames are named as in SceneGraph, after the model
    ("robot::chest"), so that the bodies' looks move with them."""

    def __init__(self, robot: Robot, head: StereoHead):
        shared = robot.model
        self._plant, instance = shared.plant, shared.robot
        self._context = self._plant.CreateDefaultContext()
        self._q = np.array(self._plant.GetPositions(self._context))
        self._poses = self._plant.get_body_poses_output_port()
        self._bodies = {
            int(i): self._plant.get_body(i).scoped_name().get_full() for i in self._plant.GetBodyIndices(instance)
        }
        eye = self._plant.GetFrameByName(robot.description.cameras["head_left"], instance)
        self._constant = [
            (eye.body().scoped_name().get_full(), "head_left", eye.GetFixedPoseInBodyFrame().GetAsMatrix34()),
            ("head_left", "head_right", head.X_LR),
        ]
        self._valve = valve = shared.shape
        self._X_VA, self._X_AV, self._X_AP = valve.X_VA(), valve.X_AV(), valve.X_AP()
        self._X_VWheel = compose(self._X_VA, self._X_AP)
        self.scene = _scene(robot)
        self._slots = {
            "base": [self._slot(n) for n in robot.base.names],
            "torso": [self._slot(n) for n in robot.torso.names],
            **{side: [self._slot(n) for n in robot.arms[side].names] for side in SIDES},
        }
        self._grippers = {side: (self._slot(g.joint), g.position) for side, g in robot.grippers.items()}
        self._follow = robot.follow

    def _slot(self, joint: str) -> int:
        return self._plant.GetJointByName(joint).position_start()

    def __call__(self, state: RobotState, estimate: RectangleEstimate, plan: GraspPlan, turn: TurnState) -> Transforms:
        """(parent, child, X) of all bodies, the head cameras and the valve; poses a display model only."""
        q = self._q.copy()
        if base := self._slots["base"]:
            q[base] = state.odometry[:3]
        q[self._slots["torso"]] = state.torso
        for side in SIDES:
            q[self._slots[side]] = getattr(state, f"{side}_arm")
            slot, position = self._grippers[side]
            q[slot] = position(getattr(state, f"{side}_gripper"))
        self._follow(q)
        self._plant.SetPositions(self._context, q)
        X_WB = self._poses.Eval(self._context)  # of all bodies
        out = [(ODOMETRY, name, X_WB[i].GetAsMatrix34()) for i, name in self._bodies.items()] + self._constant
        if plan.found:
            X_OA = compose(planar(*state.odometry[:3]), plan.X_BA)
        elif estimate.found:
            X_OA = self._valve.place(compose(estimate.X_OL, estimate.X_LV), estimate.angle)
        else:
            return out
        X_now = turned(X_OA, turn.angle - plan.turned) if plan.found and turn.number == plan.number else X_OA
        if self._valve.fixed:
            X_O0 = X_OA if not estimate.found else compose(estimate.X_OL, estimate.X_LV, self._X_VA)
            return out + [
                (ODOMETRY, "valve::panel", compose(X_O0, self._X_AP)),
                (ODOMETRY, "marker", compose(X_O0, self._X_AV)),
                (ODOMETRY, "valve::wheel", compose(X_now, self._X_AP)),
            ]
        return out + [
            (ODOMETRY, "marker", compose(X_now, self._X_AV)),
            ("marker", "valve::wheel", self._X_VWheel),
            (ODOMETRY, "valve::panel", compose(X_OA, self._X_AP)),
        ]


@functools.lru_cache(maxsize=4)
def _scene(robot: Robot) -> SceneUpdate:
    """The looks of a robot and its valve; nobody changes them, and a robot is made once."""
    return scene(parts_of(robot.model.scene_graph.model_inspector()))


def pinholes(head: StereoHead) -> dict[str, tuple[tuple[int, int], np.ndarray]]:
    """Size and pinhole matrix of each calibrated camera, for viewers (they know no lens like eq. 1)."""
    out = {}
    for name, lens in (("head_left", head.left), ("head_right", head.right)):
        xy = np.array([[0.0, 0.0], [1e-4, 0.0], [0.0, 1e-4]])
        center, right, down = lens.project(xy)
        K = np.array([[(right - center)[0] * 1e4, 0, center[0]], [0, (down - center)[1] * 1e4, center[1]], [0, 0, 1]])
        out[name] = ((lens.width, lens.height), K)
    return out
