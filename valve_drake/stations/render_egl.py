"""A Drake RenderEngine for machines without a GPU or a display: the whole scene in one vertex buffer and one draw call.

    add_renderer(scene_graph, "egl", RenderEngineEgl(lights=[...]))  # after the plant's Finalize

draws colour images by OpenGL on EGL (in Mesa's llvmpipe, where there is no GPU) three to eight times faster than
RenderEngineVtk, which issues a draw call for each geometry and shades each sample of each pixel. A pixel is the mean of
what it covers (`supersample` squared points of it). Left out: depth and label images, textures, specular light,
transparency, shadows, meshes other than OBJ. See docs/renderer.md.

Lengths [m]. Colours linear as in Drake, no gamma.
"""

import ctypes
import dataclasses as dc
import functools
import math
import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import moderngl
import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    ColorRenderCamera,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    LightParameter,
    Mesh,
    PerceptionProperties,
    RenderEngine,
    Rgba,
    Role,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo

from valve_drake.checks import ConfigError

SEGMENTS = 48  # of round shapes, as in RenderEngineVtk; raise it where a rim looks angular
MAX_LIGHTS = 4
FINE = ("valve_drake", "fine_within")  # perception property: farther off, one point a pixel will do [m]
_SIDES = 4  # of the part of a picture that is drawn
_RIM = 4  # round what is fine, for whatever blurs the picture then [px]
_MOST = 0.3  # of a picture; where its fine parts are larger, all of it at once costs less
_SMOOTHING = 0.45  # standard deviation of the blur of what has one point a pixel, against stepped edges [px]
_BUSY = 2.4  # mean step between neighbours [grey levels]; in a picture with more edges their errors add up to a tenth
_CLIP_DISTANCE = 0x3000  # GL_CLIP_DISTANCE0, which moderngl has no name for

_COMMENT = re.compile(r"(?m)(^|\s)#.*$")

_VERTEX_SHADER = """
#version 330
uniform sampler2D poses;   // row g: the four columns of X_CG, C the camera: x right, y down, z forward
uniform vec4 projection;   // clip x = p.x x + p.y z, clip y = p.z y + p.w z
uniform vec2 range;        // near, far
uniform vec4 sides[4];     // planes through C that bound what is drawn, inward
uniform int light_count;
uniform vec4 lights[4];    // in C: direction towards the light, or its position (w = 1)
uniform float intensities[4];
in vec3 position;
in vec3 normal;
in vec3 color;
in int geometry;
out vec3 shade;
out float gl_ClipDistance[4];
void main() {
    mat4 X = mat4(texelFetch(poses, ivec2(0, geometry), 0), texelFetch(poses, ivec2(1, geometry), 0),
                  texelFetch(poses, ivec2(2, geometry), 0), texelFetch(poses, ivec2(3, geometry), 0));
    vec3 p = (X * vec4(position, 1.0)).xyz;
    vec3 n = mat3(X) * normal;
    if (dot(n, p) > 0.0) n = -n;  // both sides of a surface are lit
    float sum = 0.0;
    for (int k = 0; k < light_count; ++k) {
        vec3 to_light = lights[k].w > 0.5 ? normalize(lights[k].xyz - p) : lights[k].xyz;
        sum += intensities[k] * max(dot(n, to_light), 0.0);
    }
    shade = color * sum;
    for (int k = 0; k < 4; ++k) gl_ClipDistance[k] = dot(sides[k].xyz, p);
    gl_Position = vec4(projection.x * p.x + projection.y * p.z, projection.z * p.y + projection.w * p.z,
                       (p.z * (range.y + range.x) - 2.0 * range.x * range.y) / (range.y - range.x), p.z);
}
"""
_FRAGMENT_SHADER = """
#version 330
in vec3 shade;
out vec4 pixel;
void main() { pixel = vec4(shade, 1.0); }
"""


@dc.dataclass(frozen=True)
class Triangles:
    """A surface in its geometry's frame.

    points, normals, colors: (m, 3), float32, of corners that triangles may share. corners: (3n,), three rows of them a
    triangle, counterclockwise seen from outside. fine_within: see FINE.
    """

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    corners: np.ndarray
    fine_within: float = math.inf


class RenderEngineEgl(RenderEngine):
    """Colour images of all perception geometry, shaded by vertices (Gouraud) with diffuse light.

    lights: directional or point lights without attenuation, at most four, fixed in the world or in the camera; none
    is Drake's default, one at the camera. default_clear_color: of the background. default_diffuse: of geometry without
    ("phong", "diffuse"). supersample: points of a pixel along each side, 1 to 4; raise it where edges are to be
    smoother, its square is paid for. Geometry may have a property ("valve_drake", "fine_within") [m]: if some has,
    that many points are drawn in the rectangles round what is nearer to the camera than its own (without one it always
    is), and one point a pixel elsewhere. cull: leave out triangles that are seen from behind, which closed surfaces
    never show. needed: tells for a camera the corners (4, 2) [px] of the convex part of its picture that is looked at,
    in Drake's convention; what lies outside costs next to nothing and has the background's colour. None: all of it.

    Raises ValueError for a light that it cannot make; RuntimeError from the first image where EGL is missing.
    """

    def __init__(
        self,
        lights: Sequence[LightParameter] = (),
        default_clear_color: Sequence[float] = (204 / 255, 229 / 255, 255 / 255),
        default_diffuse: Sequence[float] = (0.9, 0.7, 0.2, 1.0),
        supersample: int = 2,
        cull: bool = True,
        needed: Callable[[CameraInfo], np.ndarray] | None = None,
    ):
        RenderEngine.__init__(self)
        if supersample not in (1, 2, 3, 4):
            raise ValueError(f"supersample must be 1, 2, 3 or 4, got {supersample}")
        lights = list(lights) or [LightParameter(type="directional", direction=[0, 0, 1], frame="camera")]
        if len(lights) > MAX_LIGHTS:
            raise ValueError(f"lights must be at most {MAX_LIGHTS}, got {len(lights)}")
        for light in lights:
            if light.type not in ("directional", "point") or light.frame not in ("world", "camera"):
                raise ValueError(f"a light must be directional or point, in world or camera, got {light}")
        self._settings = (lights, tuple(default_clear_color), tuple(default_diffuse), supersample, cull, needed)
        self._lights, self._clear, self._diffuse, self._supersample, self._cull, self._needed = self._settings
        self._X_WC = RigidTransform()
        self._surfaces: dict[GeometryId, Triangles] = {}
        self._rows: dict[GeometryId, int] = {}  # of self._poses
        self._poses = np.zeros((0, 4, 4), np.float32)  # X_WG
        self._on_stage: _Stage | None = None  # the surfaces as OpenGL has them; shared by clones

    # ------------------------------------------------------------ RenderEngine's own interface
    # Drake's binding forbids to keep the arguments of these: what is needed is read off at once.

    def UpdateViewpoint(self, X_WC: RigidTransform) -> None:
        self._X_WC = RigidTransform(X_WC)

    def DoRegisterVisual(
        self, id: GeometryId, shape: Shape, properties: PerceptionProperties, X_WG: RigidTransform
    ) -> bool:
        if id in self._rows:  # a clone's, see DoClone
            return True
        color = properties.GetPropertyOrDefault("phong", "diffuse", Rgba(*self._diffuse))
        if color.a() <= 0.0:
            return False
        surface = _surface(shape, (color.r(), color.g(), color.b()))
        fine_within = properties.GetPropertyOrDefault(*FINE, math.inf)
        if surface is None:
            return False
        self._surfaces = {**self._surfaces, id: dc.replace(surface, fine_within=fine_within)}
        self._rows = {**self._rows, id: len(self._poses)}
        self._poses = np.concatenate([self._poses, X_WG.GetAsMatrix4()[None].astype(np.float32)])
        self._on_stage = None
        return True

    def DoUpdateVisualPose(self, id: GeometryId, X_WG: RigidTransform) -> None:
        self._poses[self._rows[id]] = X_WG.GetAsMatrix4()

    def DoRemoveGeometry(self, id: GeometryId) -> bool:
        if id not in self._surfaces:
            return False
        kept = [other for other in self._rows if other != id]
        self._poses = self._poses[[self._rows[other] for other in kept]]
        self._rows = {other: k for k, other in enumerate(kept)}
        self._surfaces = {other: self._surfaces[other] for other in kept}
        self._on_stage = None
        return True

    def DoClone(self) -> "RenderEngineEgl":
        clone = RenderEngineEgl(*self._settings)
        clone._X_WC = RigidTransform(self._X_WC)
        clone._surfaces, clone._rows, clone._poses = self._surfaces, self._rows, self._poses.copy()
        clone._on_stage = self._on_stage
        # Which poses Drake tells an engine of is in its C++ part, that Python cannot copy: it is told once more.
        for id in self._rows:
            clone.RegisterVisual(id, Sphere(1.0), PerceptionProperties(), RigidTransform(), needs_updates=True)
        return clone

    def DoRenderColorImage(self, camera: ColorRenderCamera, color_image_out: Any) -> None:
        gl = _open()
        if self._on_stage is None or self._on_stage.gl is not gl:
            self._on_stage = _Stage(gl, [self._surfaces[id] for id in self._rows])
        core = camera.core()
        X_CW = self._X_WC.inverse()
        uniforms = _light_uniforms(self._lights, X_CW)
        info, clipping = core.intrinsics(), core.clipping()
        width, height = info.width(), info.height()
        # OpenGL's first row is the lowest; here it is the first of the image, so that nothing has to be turned over.
        uniforms["projection"] = (
            2 * info.focal_x() / width,
            2 * info.center_x() / width - 1,
            2 * info.focal_y() / height,
            2 * info.center_y() / height - 1,
        )
        uniforms["range"] = (clipping.near(), clipping.far())
        # Of a whole picture, a little more: its own corners must not fall to rounding.
        needed = _corners(-1, -1, width + 1, height + 1) if self._needed is None else self._needed(info)
        sides = _sides(info, needed)
        uniforms["sides"] = np.column_stack([sides, np.zeros(_SIDES)]).astype(np.float32).tobytes()
        view = _View(X_CW.GetAsMatrix4().astype(np.float32) @ self._poses, uniforms, info, sides, clipping.near())
        out, k = color_image_out.mutable_data, self._supersample
        whole = (0, 0, width, height)
        fine = self._on_stage.fine(view) if k > 1 else []
        if sum(w * h for _, _, w, h in fine) > _MOST * width * height:
            fine = [whole]
        if fine != [whole]:
            self._on_stage.draw(view, 1, whole, out, self._clear, self._cull)
            if k > 1:
                cv2.GaussianBlur(out, (3, 3), _SMOOTHING, dst=out)
                fine = [whole] if _mean_step(out) > _BUSY else fine
        for x, y, w, h in fine:
            points = gl.pixels(k * w, k * h)
            self._on_stage.draw(view, k, (x, y, w, h), points, self._clear, self._cull)
            cv2.resize(points, (w, h), dst=out[y : y + h, x : x + w], interpolation=cv2.INTER_AREA)


def _mean_step(image: np.ndarray) -> float:
    """Between pixels side by side of an image (h, w, 4) RGBA [grey levels]."""
    rows = image[::4]  # enough to tell
    return sum(cv2.mean(cv2.absdiff(rows[:, 1:], rows[:, :-1]))[:3]) / 3


def add_renderer(scene_graph: SceneGraph, name: str, engine: RenderEngine) -> None:
    """`scene_graph.AddRenderer(name, engine)` for an engine written in Python; what is registered later is not drawn.

    Drake 1.51's binding hands a shape to Python only if Python holds that very object already (1.58's always does), so
    all are held for the length of the call.
    """
    inspector = scene_graph.model_inspector()
    held = []
    for id in inspector.GetAllGeometryIds(Role.kPerception):
        held += [inspector.GetShape(id), inspector.GetPerceptionProperties(id)]
    scene_graph.AddRenderer(name, engine)


def _light_uniforms(lights: Sequence[LightParameter], X_CW: RigidTransform) -> dict[str, Any]:
    rows = np.zeros((MAX_LIGHTS, 4), np.float32)
    intensities = np.zeros(MAX_LIGHTS, np.float32)
    for k, light in enumerate(lights):
        in_world = light.frame == "world"
        if light.type == "point":
            position = np.array(light.position, float)
            rows[k] = (*(X_CW.multiply(position) if in_world else position), 1.0)
        else:
            direction = np.array(light.direction, float)
            direction = direction / np.linalg.norm(direction)
            rows[k, :3] = -(X_CW.rotation().multiply(direction) if in_world else direction)
        intensities[k] = light.intensity
    return {"light_count": len(lights), "lights": rows.tobytes(), "intensities": intensities.tobytes()}


Part = tuple[int, int, int, int]  # of a picture: first column, first row, width, height [px]


def _corners(left: float, top: float, right: float, bottom: float) -> np.ndarray:
    return np.array([[left, top], [right, top], [right, bottom], [left, bottom]], float)


def _sides(info: CameraInfo, corners: np.ndarray) -> np.ndarray:
    """Inward normals (4, 3) of the planes through the camera and the sides of a convex quadrilateral (4, 2) [px]."""
    a = np.ones((_SIDES, 3))
    a[:, 0] = (corners[:, 0] - info.center_x()) / info.focal_x()
    a[:, 1] = (corners[:, 1] - info.center_y()) / info.focal_y()
    b = a[[1, 2, 3, 0]]
    normals = a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]  # np.cross takes ten times as long
    return normals * (np.sign(normals @ a.sum(axis=0)) / np.sqrt((normals**2).sum(axis=1)))[:, None]


@dc.dataclass(frozen=True)
class _View:
    """What a camera sees. poses: X_CG (n, 4, 4); sides: of what is needed (4, 3); near [m]."""

    poses: np.ndarray
    uniforms: dict[str, Any]
    info: CameraInfo
    sides: np.ndarray
    near: float


# ---------------------------------------------------------------- OpenGL


class _OpenGL:
    """An OpenGL context of this process, its program, and the images that it has drawn into."""

    def __init__(self) -> None:
        try:
            # moderngl's stub asks for a dict for each setting.
            self.context = moderngl.create_context(standalone=True, backend="egl", require=330)  # type: ignore[arg-type]
            self._egl = ctypes.CDLL("libEGL.so.1")
            self._egl.eglGetCurrentContext.restype = ctypes.c_void_p
            with self.context:
                self.program = self.context.program(vertex_shader=_VERTEX_SHADER, fragment_shader=_FRAGMENT_SHADER)
        except Exception as error:
            raise RuntimeError(f"no OpenGL 3.3 by EGL: {error}") from error
        self._targets: dict[tuple[int, int], moderngl.Framebuffer] = {}
        self._pixels = np.zeros(0, np.uint8)

    def alive(self) -> bool:
        """Whether it can be made current.

        When Drake's VTK renderer is deleted, it ends EGL's display, and with it every context of this process.
        """
        with self.context:
            return bool(self._egl.eglGetCurrentContext())

    def target(self, width: int, height: int) -> moderngl.Framebuffer:
        size = (width, height)
        if size not in self._targets:
            color, depth = self.context.renderbuffer(size, 4), self.context.depth_renderbuffer(size)
            self._targets[size] = self.context.framebuffer(color, depth)
        return self._targets[size]

    def pixels(self, width: int, height: int) -> np.ndarray:
        """Where an image (height, width, 4) uint8 is read to: fresh memory would cost as much again."""
        size = width * height * 4
        if len(self._pixels) < size:
            self._pixels = np.zeros(size, np.uint8)
        return self._pixels[:size].reshape(height, width, 4)


_opened: list[_OpenGL] = []  # the newest last: an engine shares it with all others


def is_open() -> bool:
    """Whether this process has opened OpenGL: a copy of it (fork) could not use it."""
    return bool(_opened)


def _open() -> _OpenGL:
    """The process's OpenGL: to open one takes longer than an image."""
    if not _opened or not _opened[-1].alive():
        _opened.append(_OpenGL())
    return _opened[-1]


class _Stage:
    """Surfaces in OpenGL's memory, row k of the poses belonging to surface k."""

    def __init__(self, gl: _OpenGL, surfaces: Sequence[Triangles]):
        self.gl = gl
        kind = np.dtype([("position", "3f4"), ("normal", "3f4"), ("color", "3f4"), ("geometry", "i4")])
        starts = np.cumsum([0, *(len(s.points) for s in surfaces)])
        vertices = np.zeros(starts[-1], kind)
        for k, s in enumerate(surfaces):
            part = vertices[starts[k] : starts[k + 1]]
            part["position"], part["normal"], part["color"], part["geometry"] = s.points, s.normals, s.colors, k
        # Large surfaces last: most of what lies behind the others is then rejected by depth, before it is shaded.
        self._order = np.array(sorted(range(len(surfaces)), key=lambda k: _extent(surfaces[k].points)), int)
        self._corners = [(starts[k] + surfaces[k].corners).astype(np.int32) for k in range(len(surfaces))]
        self._fine_within = np.array([s.fine_within for s in surfaces], np.float32)
        self._boxes = np.array([_box_around(s.points) for s in surfaces], np.float32).reshape(-1, 8, 3)
        with gl.context as context:
            layout = ("3f 3f 3f 1i", "position", "normal", "color", "geometry")
            self._vertices = None
            if len(vertices):
                buffer = context.buffer(vertices.tobytes())
                self._indices = context.buffer(reserve=4 * sum(map(len, self._corners)), dynamic=True)
                self._vertices = context.vertex_array(gl.program, [(buffer, *layout)], self._indices)
            self._poses = context.texture((4, max(len(surfaces), 1)), 4, dtype="f4")

    def _seen(self, view: _View, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) which surfaces may be seen between the planes `sides` (4, 3), and (n, 8, 3) their boxes in C."""
        P = self._boxes @ view.poses[:, :3, :3].transpose(0, 2, 1) + view.poses[:, None, :3, 3]
        outside = (P @ sides.T.astype(np.float32) < 0).all(axis=1).any(axis=1) | (P[..., 2] < view.near).all(axis=1)
        return ~outside, P

    def fine(self, view: _View) -> list[Part]:
        """The rectangles round fine geometry, those that overlap made one."""
        info, size = view.info, np.array([view.info.width(), view.info.height()])
        whole = [(0, 0, info.width(), info.height())]
        if np.isinf(self._fine_within).all():
            return whole
        seen, boxes = self._seen(view, view.sides)
        distances = np.maximum(boxes[..., 2].min(axis=1), 0.0)
        P = boxes[seen & (distances < self._fine_within)]
        if (P[..., 2] < view.near).any():  # it reaches behind the camera: seen anywhere
            return whole
        px = P[..., :2] / P[..., 2:] * [info.focal_x(), info.focal_y()] + [info.center_x(), info.center_y()]
        low = np.clip(np.floor(px.min(axis=1)) - _RIM, 0, size).astype(int)
        high = np.clip(np.ceil(px.max(axis=1)) + _RIM, 0, size).astype(int)
        apart: list[tuple[np.ndarray, np.ndarray]] = []
        for a, b in zip(low, high):
            for c, d in apart:
                if (a < d).all() and (c < b).all():
                    a, b = np.minimum(a, c), np.maximum(b, d)
            apart = [(c, d) for c, d in apart if (c < a).any() or (d > b).any()] + [(a, b)]
        return [(int(a[0]), int(a[1]), int(b[0] - a[0]), int(b[1] - a[1])) for a, b in apart if (a < b).all()]

    def draw(self, view: _View, k: int, part: Part, out: np.ndarray, clear: Sequence[float], cull: bool) -> None:
        """Draws a part, w x h pixels, with k x k points each into `out` (k h, k w, 4) uint8 RGBA."""
        size = (k * view.info.width(), k * view.info.height())
        x, y, w, h = (k * number for number in part)
        whole = (w, h) == size
        sides = view.sides if whole else _sides(view.info, _corners(*part[:2], part[0] + part[2], part[1] + part[3]))
        seen = self._seen(view, sides)[0]
        corners = [self._corners[surface] for surface in self._order if seen[surface]]
        count = sum(map(len, corners))
        with self.gl.context as context:
            program, target = self.gl.program, self.gl.target(*size)
            target.use()
            target.scissor = None if whole else (x, y, w, h)  # type: ignore[assignment]  # moderngl's stub omits None
            red, green, blue = clear[:3]
            target.clear(red, green, blue, 1.0, viewport=None if whole else (x, y, w, h))
            if self._vertices is not None and count:
                context.enable_only(moderngl.DEPTH_TEST | (moderngl.CULL_FACE if cull else 0))
                for side in range(_SIDES):
                    context.enable_direct(_CLIP_DISTANCE + side)
                context.front_face = "cw"  # seen in the image's own orientation: its rows run downwards
                self._poses.write(np.ascontiguousarray(view.poses.transpose(0, 2, 1)).tobytes())
                self._poses.use(0)
                for name, value in view.uniforms.items():
                    uniform = program[name]
                    assert isinstance(uniform, moderngl.Uniform)
                    if isinstance(value, bytes):
                        uniform.write(value)
                    else:
                        uniform.value = value
                self._indices.write(np.concatenate(corners).tobytes())
                self._vertices.render(moderngl.TRIANGLES, vertices=count)
            target.read_into(out, viewport=(x, y, w, h), components=4)


def _extent(points: np.ndarray) -> float:
    """The longest side of the box that holds them."""
    return float(np.ptp(points, axis=0).max()) if len(points) else 0.0


def _box_around(points: np.ndarray) -> np.ndarray:
    """The corners (8, 3) of the box that holds them; of none, of one at the origin."""
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    return np.where(np.array(list(np.ndindex(2, 2, 2)), bool), high, low)


# ---------------------------------------------------------------- surfaces


def _surface(shape: Shape, color: Sequence[float]) -> Triangles | None:
    """A shape as triangles; None for one that cannot be drawn (a half space, a mesh that is no OBJ)."""
    if isinstance(shape, Box):
        points, normals = _box(shape.size())
    elif isinstance(shape, Cylinder):
        points, normals = _turned(_cylinder_profile(shape.radius(), shape.length()))
    elif isinstance(shape, Sphere):
        points, normals = _turned(_capsule_profile(shape.radius(), 0.0))
    elif isinstance(shape, Capsule):
        points, normals = _turned(_capsule_profile(shape.radius(), shape.length()))
    elif isinstance(shape, Ellipsoid):
        axes = np.array([shape.a(), shape.b(), shape.c()])
        points, normals = _turned(_capsule_profile(1.0, 0.0))
        points, normals = points * axes, normals / axes
    elif isinstance(shape, Mesh | Convex):
        path = shape.source().path() if shape.source().is_path() else None
        if path is None or Path(path).suffix.lower() != ".obj":
            return None
        scale = np.array(shape.scale3())
        points, normals, colors, corners = read_obj(str(path), os.path.getmtime(path))
        points, normals = points * scale, normals / scale
        if np.prod(scale) < 0:  # the other way round: a mirrored triangle would be seen from inside
            corners = corners.reshape(-1, 3)[:, ::-1].ravel()
        colors = np.where(np.isnan(colors), np.array(color), colors)
        return _triangles(points, normals, colors, corners)
    else:
        return None
    shared, corners = np.unique(np.hstack([points, normals]), axis=0, return_inverse=True)
    return _triangles(shared[:, :3], shared[:, 3:], np.tile(color, (len(shared), 1)), corners)


def _triangles(points: np.ndarray, normals: np.ndarray, colors: np.ndarray, corners: np.ndarray) -> Triangles:
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    points, normals, colors = (np.ascontiguousarray(part, np.float32) for part in (points, normals, colors))
    return Triangles(points, normals, colors, corners)


def _box(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    points, normals = [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            n, u = np.zeros(3), np.zeros(3)
            n[axis], u[(axis + 1) % 3] = sign, 1.0
            v = np.cross(n, u)
            corners = [n - u - v, n + u - v, n + u + v, n - u + v]
            points += [corners[k] for k in (0, 1, 2, 0, 2, 3)]
            normals += [n] * 6
    return np.array(points) * np.asarray(size) / 2, np.array(normals)


def _cylinder_profile(radius: float, length: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pieces of the outline (r, z) from the lower pole to the upper one, each with its normals (r, z)."""
    h = length / 2
    down, out, up = np.array([[0.0, -1]] * 2), np.array([[1.0, 0]] * 2), np.array([[0.0, 1]] * 2)
    return [
        (np.array([[0, -h], [radius, -h]]), down),
        (np.array([[radius, -h], [radius, h]]), out),
        (np.array([[radius, h], [0, h]]), up),
    ]


def _capsule_profile(radius: float, length: float) -> list[tuple[np.ndarray, np.ndarray]]:
    angles = np.linspace(-np.pi / 2, np.pi / 2, SEGMENTS // 2 + 1)
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    points = radius * normals
    points[:, 1] += np.where(angles < 0, -length / 2, length / 2)
    if length > 0:  # the straight part between the two halves
        middle = SEGMENTS // 4
        points = np.insert(points, middle, [radius, -length / 2], axis=0)
        normals = np.insert(normals, middle, [1.0, 0.0], axis=0)
    return [(points, normals)]


def _turned(profile: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """An outline turned about z: points and normals of its triangles, three rows each."""
    angles = np.linspace(0, 2 * np.pi, SEGMENTS + 1)
    turn = np.column_stack([np.cos(angles), np.sin(angles)])

    def around(rows: np.ndarray) -> np.ndarray:  # (m, 2) -> (m, SEGMENTS + 1, 3)
        out = np.empty((len(rows), len(turn), 3))
        out[..., :2] = rows[:, None, :1] * turn
        out[..., 2] = rows[:, None, 1]
        return out

    points: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    for rows, directions in profile:
        for grid, into in ((around(rows), points), (around(directions), normals)):
            a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
            into.append(np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3))
    P, N = np.concatenate(points), np.concatenate(normals)
    corners = P.reshape(-1, 3, 3)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    keep = np.repeat(area > 1e-15, 3)  # at the poles every other triangle has no area
    return P[keep], N[keep]


@functools.lru_cache(maxsize=256)
def read_obj(path: str, modified: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, normals and colours (m, 3) of the corners of an OBJ's triangles, and (3n,) which corner is where.

    Normals are flat where it has none; colours are NaN where its material library says none (Kd). modified: when the
    file was, so that another one of that name is read again. Raises ConfigError naming the file if it is damaged.
    """
    try:
        return _parse_obj(Path(path))
    except (OSError, ValueError) as error:
        raise ConfigError(f"mesh {path} cannot be read: {error}") from error


def _parse_obj(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """As `read_obj`. Raises ValueError for a damaged file."""
    points: list[str] = []
    normals: list[str] = []
    faces: list[str] = []
    colors: list[tuple[float, ...]] = []
    color: tuple[float, ...] = (np.nan,) * 3
    materials: dict[str, tuple[float, ...]] = {}
    for line in _lines(path):
        word, _, rest = line.partition(" ")
        if word == "v":
            points.append(rest)
        elif word == "vn":
            normals.append(rest)
        elif word == "f":
            corners = rest.split()
            if "-" in rest:
                corners = [_from_the_first(corner, len(points), len(normals)) for corner in corners]
            for k in range(1, len(corners) - 1):  # a fan of triangles
                faces += (corners[0], corners[k], corners[k + 1])
                colors.append(color)
        elif word == "mtllib":
            materials |= _materials(path.parent / rest.strip())
        elif word == "usemtl":
            color = materials.get(rest.strip(), (np.nan,) * 3)
    if not faces:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, int)
    P, N = _vectors(points, "v"), _vectors(normals, "vn")
    distinct: dict[str, int] = {}
    order = np.array([distinct.setdefault(corner, len(distinct)) for corner in faces])
    parts = [(corner.split("/") + ["", ""])[:3] for corner in distinct]
    at = np.array([_index(part[0], len(P)) for part in parts])
    normal_at = np.array([_index(part[2], len(N)) if part[2] else -1 for part in parts])
    if (normal_at >= 0).all() and len(set(colors)) == 1:  # corners of one name are one
        return P[at], N[normal_at], np.tile(colors[0], (len(at), 1)), order
    out, normal_at = P[at][order], normal_at[order]
    corners = out.reshape(-1, 3, 3)
    flat = np.repeat(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), 3, axis=0)
    given = normal_at >= 0
    flat[given] = N[normal_at[given]]
    return out, flat, np.repeat(np.array(colors), 3, axis=0), np.arange(len(out))


def _lines(path: Path) -> list[str]:
    """The lines of an OBJ or its material library: comments left out, continued ones joined, blanks for tabs."""
    text = path.read_text(encoding="utf-8", errors="replace").replace("\t", " ").replace("\\\n", " ")
    if "#" in text:
        text = _COMMENT.sub("", text)
    return [line.strip() for line in text.splitlines()]


def _vectors(rows: list[str], word: str) -> np.ndarray:
    """The first three numbers of each row (n, 3). Raises ValueError."""
    numbers = np.array(" ".join(" ".join(row.split()[:3]) for row in rows).split(), float)
    if numbers.size != 3 * len(rows) or not np.isfinite(numbers).all():
        raise ValueError(f"a line `{word}` has no three finite numbers")
    return numbers.reshape(-1, 3)


def _from_the_first(corner: str, points: int, normals: int) -> str:
    """A face's corner, POINT/TEXTURE/NORMAL, whose negative numbers count back from what was read last."""
    parts = corner.split("/")
    for k, count in ((0, points), (2, normals)):
        if k < len(parts) and parts[k].startswith("-"):
            parts[k] = str(int(parts[k]) + count + 1)
    return "/".join(parts)


def _index(text: str, count: int) -> int:
    """OBJ counts from 1. Raises ValueError."""
    k = int(text)
    if not 1 <= k <= count:
        raise ValueError(f"a face has corner {k}, there are {count}")
    return k - 1


def _materials(path: Path) -> dict[str, tuple[float, ...]]:
    """Diffuse colours by material name; none where the library is missing. Raises ValueError."""
    out: dict[str, tuple[float, ...]] = {}
    name = ""
    for line in _lines(path) if path.is_file() else ():
        words = line.split()
        if words[:1] == ["newmtl"]:
            name = " ".join(words[1:])
        elif words[:1] == ["Kd"] and len(words) >= 4:
            out[name] = tuple(float(word) for word in words[1:4])
    return out
