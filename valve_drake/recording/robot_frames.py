"""Where every body of robot and valve is, as the robot believes it, for the log's 3D view."""

import numpy as np
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from valve_drake.behaviors.grasp_geometry import turned
from valve_drake.camera.lens import StereoHead
from valve_drake.frames import compose, inverse, make, planar
from valve_drake.kinematics import GEOMETRY
from valve_drake.messages import SIDES, GraspPlan, RectangleEstimate, RobotState, TurnState
from valve_drake.perception.marker import Marker
from valve_drake.recording.scene import parts_of, scene
from valve_drake.stations.scene import parse

Transforms = list[tuple[str, str, np.ndarray]]
ODOMETRY = "odometry"


class RobotFrames:
    """The controllers' own model, posed as measured. Frames are named as in SceneGraph ("robot::chest")."""

    def __init__(self, head: StereoHead, marker: Marker):
        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
        robot = parse(self._plant, "robot")
        parse(self._plant, "valve")
        self._plant.Finalize()
        self._diagram = builder.Build()
        self._context = self._plant.CreateDefaultContext()
        self._bodies = [self._plant.get_body(i) for i in self._plant.GetBodyIndices(robot)]
        self._head = head
        self._marker = marker
        self.scene = scene(parts_of(scene_graph.model_inspector()))
        self._slots = {
            "base": [self._slot(n) for n in ("base_x", "base_y", "base_yaw")],
            "torso": [self._slot(n) for n in ("waist", "neck_pitch", "neck_yaw")],
            **{side: [self._slot(f"{side}_arm_{k}") for k in range(1, 7)] for side in SIDES},
        }
        self._fingers = {side: [self._slot(f"{side}_finger_{k}") for k in (1, 2)] for side in SIDES}

    def _slot(self, joint: str) -> int:
        return self._plant.GetJointByName(joint).position_start()

    def __call__(self, state: RobotState, estimate: RectangleEstimate, plan: GraspPlan, turn: TurnState) -> Transforms:
        """(parent, child, X) of all bodies, the head cameras and the valve; poses a display model only."""
        q = np.array(self._plant.GetPositions(self._context))
        q[self._slots["base"]] = state.odometry[:3]
        q[self._slots["torso"]] = state.torso
        for side in SIDES:
            q[self._slots[side]] = getattr(state, f"{side}_arm")
            q[self._fingers[side]] = getattr(state, f"{side}_gripper") / 2
        self._plant.SetPositions(self._context, q)
        out = [
            (ODOMETRY, f"robot::{body.name()}", self._plant.EvalBodyPoseInWorld(self._context, body).GetAsMatrix34())
            for body in self._bodies
        ]
        X_OL = GEOMETRY.head_pose(state.odometry[:3], state.torso)
        out += [(ODOMETRY, "head_left", X_OL), ("head_left", "head_right", self._head.X_LR)]
        X_OV = None
        if plan.found:
            X_OV = turned(compose(planar(*state.odometry[:3]), plan.X_BV), turn.angle)
        elif estimate.found:
            X_OV = compose(estimate.X_OL, estimate.X_LV)
        if X_OV is not None:
            back = make(np.eye(3), np.array([0.0, 0.0, -self._marker.panel_depth]))
            X_OWheel = compose(X_OV, inverse(back))
            out += [
                (ODOMETRY, "marker", X_OV),
                (ODOMETRY, "valve::wheel", X_OWheel),
                (ODOMETRY, "valve::panel", X_OWheel),
            ]
        return out


def pinholes(head: StereoHead) -> dict[str, tuple[tuple[int, int], np.ndarray]]:
    """Size and pinhole matrix of each calibrated camera, for viewers (they know no lens like eq. 1)."""
    out = {}
    for name, lens in (("head_left", head.left), ("head_right", head.right)):
        xy = np.array([[0.0, 0.0], [1e-4, 0.0], [0.0, 1e-4]])
        center, right, down = lens.project(xy)
        K = np.array([[(right - center)[0] * 1e4, 0, center[0]], [0, (down - center)[1] * 1e4, center[1]], [0, 0, 1]])
        out[name] = ((lens.width, lens.height), K)
    return out
