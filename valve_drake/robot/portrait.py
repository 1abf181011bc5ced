"""A picture of a model as the cameras will see it: its visual shapes, from ahead and from behind."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from pydrake.geometry import Box, ClippingRange, ColorRenderCamera, LightParameter, RenderCameraCore
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from valve_drake.checks import OperationFailed
from valve_drake.stations.render_egl import RenderEngineEgl, add_renderer

SIZE = 480, 600  # width, height of each view [px]
FIELD = np.radians(40)  # of view, upright
_VIEWS = (np.array([0.8, 0.55, 0.3]), np.array([-0.75, 0.65, 0.35]))  # from the robot towards the camera
_LIGHTS = (
    LightParameter(type="directional", direction=[-0.4, 0.3, -0.8], frame="world", intensity=0.65),
    LightParameter(type="directional", direction=[0, 0, 1], frame="camera", intensity=0.45),
)


def portrait(model: Path, box: np.ndarray, positions: Mapping[str, float] | None = None) -> bytes:
    """A PNG of two views of a model (URDF or SDF) that stands on the floor.

    box: (2, 3) that holds it [m]. positions: of joints [rad, m]; the others are at zero, or at the nearest limit.
    Raises OperationFailed if the model cannot be parsed or drawn.
    """
    try:
        views = _views(model, box, positions or {})
    except (RuntimeError, ValueError) as error:
        raise OperationFailed(f"{model.name} cannot be drawn: {str(error).splitlines()[0]}") from error
    return bytes(cv2.imencode(".png", np.hstack(views))[1].tobytes())


def _views(model: Path, box: np.ndarray, positions: Mapping[str, float]) -> list[np.ndarray]:
    """(height, width, 3) BGR each."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
    (instance,) = Parser(plant).AddModels(str(model))
    children = {plant.get_joint(j).child_body().index() for j in plant.GetJointIndices(instance)}
    root = next(body for body in plant.GetBodyIndices(instance) if body not in children)
    plant.WeldFrames(plant.world_frame(), plant.get_body(root).body_frame())
    floor = RigidTransform([0, 0, -0.005])
    plant.RegisterVisualGeometry(plant.world_body(), floor, Box(6, 6, 0.01), "floor", np.array([0.62, 0.64, 0.66, 1]))
    plant.Finalize()
    add_renderer(scene_graph, "portrait", RenderEngineEgl(list(_LIGHTS), default_clear_color=(0.85, 0.9, 0.95)))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    inside = plant.GetMyMutableContextFromRoot(context)
    q = np.clip(plant.GetPositions(inside), plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
    for name, value in positions.items():
        q[plant.GetJointByName(name, instance).position_start()] = value
    plant.SetPositions(inside, q)
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    centre, radius = box.mean(axis=0), float(np.linalg.norm(np.ptp(box, axis=0))) / 2
    width, height = SIZE
    distance = 0.85 * radius / np.sin(FIELD / 2 * min(1.0, width / height))
    info = CameraInfo(width, height, FIELD)
    core = RenderCameraCore("portrait", info, ClippingRange(0.05 * distance, 10 * distance), RigidTransform())
    out = []
    for view in _VIEWS:
        z = -view / np.linalg.norm(view)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        X_WC = RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), centre - distance * z)
        image = query.RenderColorImage(ColorRenderCamera(core, False), scene_graph.world_frame_id(), X_WC)
        out.append(np.ascontiguousarray(image.data[:, :, 2::-1]))
    return out
