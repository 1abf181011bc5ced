"""Pictures of a robot as the cameras will see it: from ahead and from behind, through its eyes, at the valve."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from pydrake.geometry import Box, ClippingRange, ColorRenderCamera, LightParameter, RenderCameraCore
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from valve_drake.checks import OperationFailed
from valve_drake.stations.render_egl import RenderEngineEgl, add_renderer

SIZE = 480, 600  # width, height of each view [px]
FIELD = np.radians(40)  # of view, upright
SKY = (0.85, 0.9, 0.95)
NEAR, FAR = 0.02, 25.0  # of what is drawn [m]
_VIEWS = (np.array([0.8, 0.55, 0.3]), np.array([-0.75, 0.65, 0.35]))  # from the robot towards the camera
_LIGHTS = (
    LightParameter(type="directional", direction=[-0.4, 0.3, -0.8], frame="world", intensity=0.65),
    LightParameter(type="directional", direction=[0, 0, 1], frame="camera", intensity=0.45),
)

Add = Callable[[MultibodyPlant], ModelInstanceIndex]  # of a model to a plant that is not finalized


class Studio:
    """A scene that is only looked at: a robot, whatever else is added, a floor if one is wanted.

    plant: finalized. robot: the model that `add` has added.
    """

    def __init__(self, add: Add, *, floor: bool = True, sky: tuple[float, float, float] = SKY):
        builder = DiagramBuilder()
        self.plant, self._scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
        self.robot = add(self.plant)
        if floor:
            X = RigidTransform([0, 0, -0.005])
            color = np.array([0.62, 0.64, 0.66, 1])
            self.plant.RegisterVisualGeometry(self.plant.world_body(), X, Box(6, 6, 0.01), "floor", color)
        self.plant.Finalize()
        add_renderer(self._scene_graph, "portrait", RenderEngineEgl(list(_LIGHTS), default_clear_color=sky))
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()

    def pose(self, positions: Mapping[str, float]) -> None:
        """Puts the robot's joints where they are said to be [rad, m]; the others at zero, or at the nearest limit."""
        plant = self.plant
        context = plant.GetMyMutableContextFromRoot(self._context)
        q = np.clip(plant.GetPositions(context), plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
        for name, value in positions.items():
            q[plant.GetJointByName(name, self.robot).position_start()] = value
        plant.SetPositions(context, q)

    def frame(self, name: str) -> np.ndarray:
        """X_WF of a frame of the robot's -> (3, 4)."""
        context = self.plant.GetMyContextFromRoot(self._context)
        X: np.ndarray = self.plant.GetFrameByName(name, self.robot).CalcPoseInWorld(context).GetAsMatrix34()
        return X

    def view(self, X_WC: np.ndarray, info: CameraInfo) -> np.ndarray:
        """What a camera at X_WC (3, 4) sees -> (height, width, 3) BGR."""
        core = RenderCameraCore("portrait", info, ClippingRange(NEAR, FAR), RigidTransform())
        query = self._scene_graph.get_query_output_port().Eval(self._scene_graph.GetMyContextFromRoot(self._context))
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(X_WC[:, :3]), X_WC[:, 3])
        image = query.RenderColorImage(ColorRenderCamera(core, False), self._scene_graph.world_frame_id(), X)
        return np.ascontiguousarray(image.data[:, :, 2::-1])

    def around(self, box: np.ndarray, directions: Sequence[np.ndarray] = _VIEWS) -> np.ndarray:
        """Views of what a box (2, 3) [m] holds, beside each other. directions: from it towards the cameras (3,)."""
        centre, radius = box.mean(axis=0), float(np.linalg.norm(np.ptp(box, axis=0))) / 2
        width, height = SIZE
        distance = 0.85 * radius / np.sin(FIELD / 2 * min(1.0, width / height))
        info = CameraInfo(width, height, FIELD)
        views = []
        for view in directions:
            z = -view / np.linalg.norm(view)
            x = np.cross(z, [0.0, 0.0, 1.0])
            x /= np.linalg.norm(x)
            X_WC = np.column_stack([x, np.cross(z, x), z, centre - distance * z])
            views.append(self.view(X_WC, info))
        return np.hstack(views)


def png(image: np.ndarray) -> bytes:
    """An image (H, W, 3) BGR as the bytes of a file."""
    return bytes(cv2.imencode(".png", image)[1].tobytes())


def portrait(model: Path, box: np.ndarray, positions: Mapping[str, float] | None = None) -> bytes:
    """A PNG of two views of a model (URDF or SDF) that stands on the floor.

    box: (2, 3) that holds it [m]. positions: of joints [rad, m]; the others are at zero, or at the nearest limit.
    Raises OperationFailed if the model cannot be parsed or drawn.
    """

    def add(plant: MultibodyPlant) -> ModelInstanceIndex:
        (instance,) = Parser(plant).AddModels(str(model))
        children = {plant.get_joint(j).child_body().index() for j in plant.GetJointIndices(instance)}
        root = next(body for body in plant.GetBodyIndices(instance) if body not in children)
        plant.WeldFrames(plant.world_frame(), plant.get_body(root).body_frame())
        return instance

    try:
        studio = Studio(add)
        studio.pose(positions or {})
        return png(studio.around(box))
    except (RuntimeError, ValueError) as error:
        raise OperationFailed(f"{model.name} cannot be drawn: {str(error).splitlines()[0]}") from error
