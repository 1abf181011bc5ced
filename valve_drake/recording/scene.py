"""The visual shapes of robot, valve and room as foxglove.SceneUpdate, for the viewers' 3D panels."""

import functools
from collections.abc import Callable, Iterable

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from pydrake.geometry import Box, Cylinder, Mesh, ReadObjToTriangleSurfaceMesh, Role, SceneGraphInspector, Shape, Sphere

from valve_drake.checks import ConfigError
from valve_drake.recording.foxglove import pose, stamp

GREY = (0.7, 0.7, 0.7, 1.0)  # of what has no colour, RGBA

Part = tuple[str, Shape, np.ndarray, Iterable[float]]
"""One piece: the frame that carries it, its shape, its pose X (3, 4) in the frame, its colour (r, g, b, a) in 0..1."""


def parts_of(inspector: SceneGraphInspector) -> list[Part]:
    """Everything that has an illustration role; frames carry SceneGraph's names ("robot::chest")."""
    parts: list[Part] = []
    for geometry in inspector.GetAllGeometryIds(Role.kIllustration):
        properties = inspector.GetIllustrationProperties(geometry)
        colored = properties.HasProperty("phong", "diffuse")
        color = properties.GetProperty("phong", "diffuse").rgba if colored else GREY
        X = inspector.GetPoseInFrame(geometry).GetAsMatrix34()
        frame = inspector.GetName(inspector.GetFrameId(geometry))
        parts.append((frame, inspector.GetShape(geometry), X, tuple(color)))
    return parts


def scene(parts: Iterable[Part], time: float = 0.0) -> SceneUpdate:
    """All parts, each drawn in its frame and moving with it, until further notice.

    Boxes, spheres, cylinders and .obj meshes; other shapes have no counterpart and are left out. Raises ConfigError for
    a mesh that cannot be read.
    """
    update, entities = SceneUpdate(), {}
    read = functools.cache(_read)  # several parts have the same mesh
    for frame, shape, X, rgba in parts:
        if frame not in entities:
            entities[frame] = update.entities.add(timestamp=stamp(time), frame_id=frame, id=frame, frame_locked=True)
        r, g, b, a = rgba
        _draw(entities[frame], shape, np.asarray(X), Color(r=r, g=g, b=b, a=a), read)
    return update


def _draw(entity: SceneEntity, shape: Shape, X: np.ndarray, color: Color, read: "ReadMesh") -> None:
    look = {"pose": pose(X), "color": color}
    match shape:
        case Box():
            entity.cubes.add(size=_size(shape.size()), **look)
        case Sphere():
            entity.spheres.add(size=_size([2 * shape.radius()] * 3), **look)
        case Cylinder():
            diameter = 2 * shape.radius()
            entity.cylinders.add(size=_size([diameter, diameter, shape.length()]), bottom_scale=1, top_scale=1, **look)
        case Mesh() if shape.extension() == ".obj":
            points, indices = read(str(shape.source().path()), tuple(shape.scale3()))
            entity.triangles.add(points=points, indices=indices, **look)


ReadMesh = Callable[[str, tuple[float, ...]], tuple[list[Point3], list[int]]]


def _read(path: str, scale: tuple[float, ...]) -> tuple[list[Point3], list[int]]:
    """Vertices of an OBJ's triangles, and three indices a triangle. Raises ConfigError naming the file."""
    try:
        mesh = ReadObjToTriangleSurfaceMesh(path, np.array(scale))
    except RuntimeError as error:
        raise ConfigError(f"mesh {path} cannot be read: {str(error).splitlines()[0]}") from error
    points = [Point3(x=x, y=y, z=z) for x, y, z in np.array(mesh.vertices()).tolist()]
    return points, [triangle.vertex(k) for triangle in mesh.triangles() for k in range(3)]


def _size(lengths: Iterable[float]) -> Vector3:
    x, y, z = lengths
    return Vector3(x=x, y=y, z=z)
