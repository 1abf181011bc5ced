"""The simulated cameras: rendered images through a real lens, blur, noise and JPEG.

`CameraRig` owns a scene of its own, made only to be rendered; a camera block keeps the joint positions at capture
time and delivers the image made from them `latency` later. So an image shows the scene at its capture, whenever it is
read, and a camera that no block reads costs nothing.

Pixel convention: Drake's renderer puts the centre of the first pixel at (0.5, 0.5), everybody else here at (0, 0).
It is converted in `_Lensed.__init__` alone.
"""

import dataclasses as dc
import functools
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    Role,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex
from pydrake.systems.framework import Context, DiagramBuilder, State
from pydrake.systems.sensors import CameraInfo

from valve_drake import profiling
from valve_drake.camera.image_file import MAX_PIXELS, jpeg_size
from valve_drake.camera.lens import LensModel, distortion_maps
from valve_drake.frames import compose, inverse, make, rot_z
from valve_drake.messages import CameraFrame
from valve_drake.ports import PythonSystem
from valve_drake.robot.description import RobotDescription
from valve_drake.stations.render_egl import FINE, RenderEngineEgl, add_renderer
from valve_drake.stations.scene import add_scene
from valve_drake.stations.simulation_config import CameraConfig, LightConfig, ValveConfig
from valve_drake.valve.model import marker_frame
from valve_drake.valve.valve import Valve

ROLL = 0.17  # of the render against the image; only edges at this angle lie along the render's rows [rad]
NEEDED = 2.0  # beyond what the map reads, so much is drawn as well [px of the render]
MAP_BLUR = 0.4  # standard deviation of the blur that the bilinear map adds [px]


@dc.dataclass(frozen=True)
class Mount:
    """One camera: its lens, the frame it sits on, and how far off that frame it really is (X_FC, (3, 4))."""

    lens: LensModel
    frame: str
    X_FC: np.ndarray


class _Lensed:
    """Turns an ideal rendered image into the raw image of one lens.

    The render's camera is rotated about the optical axis by ROLL. A renderer samples points, so an edge along a row of
    samples is located to that row only. Level and upright edges are common in a room; in a rotated render they cross
    many rows. The lens's map resamples every pixel anyway and rotates the image back. The map is bilinear: the weights
    of a rendered point sum to one over the image, so that no edge is moved.
    """

    def __init__(self, lens: LensModel):
        x, y = distortion_maps(lens, np.eye(3))  # the ray of every pixel: x/z and y/z
        c, s = np.cos(ROLL), np.sin(ROLL)
        self.X_CR = make(rot_z(ROLL), np.zeros(3))  # the render's camera in the image's
        focal = max(lens.magnification())
        u, v = focal * (c * x + s * y), focal * (c * y - s * x)
        u0, v0 = np.floor(u.min()) - 1, np.floor(v.min()) - 1
        width, height = int(np.ceil(u.max()) + 2 - u0), int(np.ceil(v.max()) + 2 - v0)
        # In OpenCV's convention the principal point is at (-u0, -v0); Drake's is half a pixel on.
        self.info = CameraInfo(width, height, focal, focal, 0.5 - u0, 0.5 - v0)
        # What the map reads, in Drake's convention: a rectangle turned by ROLL that leaves a third of the render free.
        margin = NEEDED / focal
        low, high = np.array([x.min(), y.min()]) - margin, np.array([x.max(), y.max()]) + margin
        X, Y = np.array([low[0], high[0], high[0], low[0]]), np.array([low[1], low[1], high[1], high[1]])
        self.needed = focal * np.column_stack([c * X + s * Y, c * Y - s * X]) + [0.5 - u0, 0.5 - v0]
        maps = ((u - u0).astype(np.float32), (v - v0).astype(np.float32))
        self._maps = cv2.convertMaps(*maps, cv2.CV_16SC2)  # fixed-point, as remap computes in any case: 1/32 px

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """RGBA as rendered -> (H, W, 3) RGB."""
        return cv2.cvtColor(cv2.remap(image, *self._maps, cv2.INTER_LINEAR), cv2.COLOR_RGBA2RGB)


def _same(a: CameraInfo, b: CameraInfo) -> bool:
    return (
        a.width() == b.width()
        and a.height() == b.height()
        and bool((a.intrinsic_matrix() == b.intrinsic_matrix()).all())
    )


def lights(config: LightConfig) -> list[LightParameter]:
    """A lamp in the room, and the robot's own light above its eyes. Each one costs the renderer a fifth of a frame."""
    a, k = config.azimuth, config.intensity
    lamp = [np.cos(a), np.sin(a), -0.9]
    out = [
        LightParameter(type="directional", direction=lamp, frame="world", intensity=0.75 * k),
        LightParameter(type="directional", direction=[0.1, 0.25, 1.0], frame="camera", intensity=0.55 * k),
    ]
    for angle in (a + 2.1, a - 2.1):
        side = [np.cos(angle), np.sin(angle), -0.6]
        out.append(LightParameter(type="directional", direction=side, frame="world", intensity=config.fill * k))
    return out if config.fill > 0 else out[:2]


RENDERER = "cameras"  # its name in the rig's SceneGraph
DARK = 0.02  # of an image's brightness, where the lamps are out
BACKGROUND = (0.80, 0.85, 0.90)  # where nothing is, RGB
# Up to which distance the edges of the valve's visuals are measured, by name [m]: the marker's always, those of the
# handles' marks by the wrist cameras alone (of the head cameras' images, from farther off, only their middles count).
FINE_WITHIN = {"marker": math.inf, **{f"mark_{k}": 0.5 for k in range(1, 13)}}


Needed = Callable[[CameraInfo], np.ndarray]  # as of RenderEngineEgl


def _add_vtk(scene_graph: SceneGraph, lights: list[LightParameter], supersample: int, needed: Needed) -> None:
    params = RenderEngineVtkParams(lights=lights, default_clear_color=np.array(BACKGROUND))
    scene_graph.AddRenderer(RENDERER, MakeRenderEngineVtk(params))


def _add_egl(scene_graph: SceneGraph, lights: list[LightParameter], supersample: int, needed: Needed) -> None:
    engine = RenderEngineEgl(lights, BACKGROUND, supersample=supersample, needed=needed)
    add_renderer(scene_graph, RENDERER, engine)


def _draw_finely(plant: MultibodyPlant, scene_graph: SceneGraph, valve: ModelInstanceIndex) -> None:
    """What is measured in images is drawn with many points a pixel, the rest with one. Before a renderer is added."""
    inspector, source = scene_graph.model_inspector(), plant.get_source_id()
    assert source is not None  # the plant has its geometry there
    measured = {
        id: FINE_WITHIN.get(inspector.GetName(id).split("::")[-1], 0.0)
        for name in ("wheel", "panel")
        for id in plant.GetVisualGeometriesForBody(plant.GetBodyByName(name, valve))
    }
    for id in inspector.GetAllGeometryIds(Role.kPerception):
        properties = PerceptionProperties(inspector.GetPerceptionProperties(id))
        properties.AddProperty(*FINE, measured.get(id, 0.0))
        scene_graph.RemoveRole(source, id, Role.kPerception)  # Drake replaces no perception properties
        scene_graph.AssignRole(source, id, properties)


RENDERERS = {"egl": _add_egl, "vtk": _add_vtk}  # scenario key simulation.camera.renderer


class CameraRig:
    """The scene as the cameras see it."""

    def __init__(
        self,
        mounts: Mapping[str, Mount],
        valve: ValveConfig,
        shape: Valve,
        light: LightConfig,
        camera: CameraConfig,
        seed: int,
        robot: RobotDescription | None = None,
        place: Sequence[float] = (0.0, 0.0, 0.0),
    ):
        """place: of a fixed base, see add_scene."""
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1.0)
        scene_graph.set_name("scene_graph")
        self.scene = add_scene(self.plant, valve, shape, robot, place)
        self.plant.Finalize()
        _draw_finely(self.plant, scene_graph, self.scene.valve)
        self._lensed = {name: _Lensed(mount.lens) for name, mount in mounts.items()}
        RENDERERS[camera.renderer](scene_graph, lights(light), camera.supersample, self._needed)
        self._scene_graph = scene_graph
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._plant_context = self.plant.GetMyMutableContextFromRoot(self._context)
        self._query = scene_graph.get_query_output_port()
        self._camera, self._light = camera, light
        gains = np.array([light.red_gain, 1.0, light.blue_gain])
        levels = np.clip(np.arange(256)[:, None] * gains, 0, 255)
        self._white_balance = np.rint(levels).astype(np.uint8)[None]  # (1, 256, 3), a table
        self._seed = seed
        self._noise = _noise_pool(seed, camera.noise)
        self._mounts = dict(mounts)
        self._names = sorted(mounts)

    def _needed(self, info: CameraInfo) -> np.ndarray:
        """The corners (4, 2) of what is looked at in a picture [px]: of a camera's, what its lens's map reads."""
        for lensed in self._lensed.values():
            if _same(lensed.info, info):
                return lensed.needed
        w, h = info.width(), info.height()
        return np.array([[0.0, 0], [w, 0], [w, h], [0, h]])

    def pose(self, q: np.ndarray) -> None:
        """Sets the positions of the renderer's own scene; the running plant is not touched."""
        self.plant.SetPositions(self._plant_context, q)

    def _render(self, frame: Frame, X_FC: np.ndarray, info: CameraInfo) -> np.ndarray:
        X = frame.GetFixedPoseInBodyFrame() @ RigidTransform(RotationMatrix(X_FC[:, :3]), X_FC[:, 3])
        core = RenderCameraCore(RENDERER, info, ClippingRange(0.02, 25.0), RigidTransform())
        query = self._query.Eval(self._scene_graph.GetMyContextFromRoot(self._context))
        parent = self.plant.GetBodyFrameIdOrThrow(frame.body().index())
        return query.RenderColorImage(ColorRenderCamera(core, False), parent, X).data

    def ideal(self, name: str, q: np.ndarray) -> np.ndarray:
        """The raw image of one camera without noise (H, W, 3) uint8."""
        mount, lensed = self._mounts[name], self._lensed[name]
        self.pose(q)
        X_FR = compose(mount.X_FC, lensed.X_CR)
        return lensed(self._render(self.plant.GetFrameByName(mount.frame), X_FR, lensed.info))

    def optical(self, name: str, q: np.ndarray) -> np.ndarray:
        """The same with the blur of its optics: what falls on the sensor."""
        image, blur = self.ideal(name, q), self._camera.blur
        return cv2.GaussianBlur(image, (0, 0), float(np.sqrt(blur**2 - MAP_BLUR**2))) if blur > MAP_BLUR else image

    def captured(self, name: str, capture: "Capture") -> None:
        """Does nothing: this rig makes an image when it is read."""

    def frame(self, name: str, capture: "Capture") -> CameraFrame:
        """What the camera delivers: lens, blur, white balance, noise, JPEG and back."""
        return decoded(self.exposed(name, capture))

    def exposed(self, name: str, capture: "Capture") -> CameraFrame:
        """The same as it goes over a wire: JPEG alone."""
        image = self.optical(name, capture.q)
        if 0 <= self._light.off_at <= capture.time < self._light.off_at + self._light.off_for:
            image = cv2.convertScaleAbs(image, alpha=DARK)
        rng = np.random.Generator(np.random.SFC64([self._seed, self._names.index(name), capture.sequence]))
        start = int(rng.integers(len(self._noise[0]) - image.size))
        more, less = (part[start : start + image.size].reshape(image.shape) for part in self._noise)
        image = cv2.subtract(cv2.add(cv2.LUT(image, self._white_balance), more), less)  # saturates
        return CameraFrame(name, capture.time, capture.sequence, data=_jpeg(image, self._camera.jpeg_quality))

    def marker_pose(self, name: str, q: np.ndarray) -> np.ndarray:
        """X_CV: where one camera truly has the marker (3, 4)."""
        self.pose(q)
        mount = self._mounts[name]
        marker = marker_frame(self.plant, self.scene.valve)
        frame = self.plant.GetFrameByName(mount.frame, self.scene.robot)
        X_FV = self.plant.CalcRelativeTransform(self._plant_context, frame, marker)
        return compose(inverse(mount.X_FC), make(X_FV.rotation().matrix(), X_FV.translation()))

    def view(self, X_WC: np.ndarray, q: np.ndarray, width: int, height: int, fov_y: float) -> np.ndarray:
        """A picture from anywhere, for people (height, width, 3)."""
        self.pose(q)
        focal = height / 2 / np.tan(fov_y / 2)
        info = CameraInfo(width, height, focal, focal, width / 2, height / 2)
        return np.ascontiguousarray(self._render(self.plant.world_frame(), X_WC, info)[..., :3])


class RigWhenRead:
    """A CameraRig that is made when the first image is read: a station at whose images nobody looks has none."""

    def __init__(self, *arguments: Any):
        self._arguments = arguments

    @functools.cached_property
    def _rig(self) -> CameraRig:
        return CameraRig(*self._arguments)

    def captured(self, name: str, capture: "Capture") -> None:
        """Does nothing, as the rig's own."""

    def frame(self, name: str, capture: "Capture") -> CameraFrame:
        return self._rig.frame(name, capture)


@functools.lru_cache(maxsize=1)
def _noise_pool(seed: int, deviation: float) -> tuple[np.ndarray, np.ndarray]:
    """White noise in grey levels, what it adds and what it takes away (uint8), more than one image needs.

    Every image uses a stretch from a random place: a million new random numbers would take as long as its rendering.
    Sums of bytes take a quarter of the time of sums of mixed types.
    """
    noise = np.random.Generator(np.random.SFC64([seed, 99])).standard_normal(4 << 20, dtype=np.float32)
    levels = np.rint(deviation * noise)
    pool = tuple(np.clip(sign * levels, 0, 255).astype(np.uint8) for sign in (1, -1))
    for part in pool:
        part.setflags(write=False)  # it is shared
    return pool[0], pool[1]


def encode_frame(camera: str, time: float, sequence: int, image: np.ndarray, quality: int) -> CameraFrame:
    """JPEG and back, as a camera on a wire does."""
    return decoded(CameraFrame(camera, time, sequence, data=_jpeg(image, quality)))


def decoded(frame: CameraFrame) -> CameraFrame:
    """A frame with the image of its JPEG. Raises ValueError as `decode_image`."""
    return dc.replace(frame, image=decode_image(frame.data))


def _jpeg(image: np.ndarray, quality: int) -> bytes:
    """Without chroma subsampling, which would smear red edges."""
    flags = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), flags)[1].tobytes()


def decode_image(data: bytes) -> np.ndarray:
    """JPEG bytes -> (H, W, 3) RGB. Raises ValueError if they are no whole image, or one of more than MAX_PIXELS."""
    width, height = jpeg_size(data) or (0, 0)
    whole = 0 < width * height <= MAX_PIXELS and data.rfind(b"\xff\xd9") >= 0
    try:
        # The EXIF orientation is not applied: a calibration refers to the sensor's own pixels.
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if whole else None
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise ValueError("an image that cannot be decoded")
    return image


@dc.dataclass(frozen=True)
class Capture:
    """One exposure of a camera: when it was taken, its number, and the plant's positions at that time."""

    time: float = -1.0  # [s]; -1: nothing was captured yet
    sequence: int = -1
    q: np.ndarray = dc.field(default_factory=lambda: np.zeros(0))


class Images(typing.Protocol):
    """Makes the images: `CameraRig` in this process when they are read, `CameraWorkers` in processes of their own."""

    def captured(self, name: str, capture: Capture) -> None:
        """Called at every capture, read or not, so that its image can be begun early."""

    def frame(self, name: str, capture: Capture) -> CameraFrame:
        """The image of a capture."""


@dc.dataclass(frozen=True)
class _Film:
    """The state of a camera: the capture delivered last, and those not delivered yet, oldest first."""

    delivered: Capture = Capture()
    coming: tuple[Capture, ...] = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> "_Film":
        return self


class CameraSystem(PythonSystem):
    """One camera of the simulated station.

    port       dir  type         notes
    ---------  ---  -----------  --------------------------------------------------------
    positions  in   vector       of the whole plant
    image      out  CameraFrame  captured `latency` ago or earlier; made when it is read
    """

    def __init__(self, name: str, positions: int, period: float, latency: float, images: Images):
        super().__init__()
        self.set_name(name)
        self._latency = latency
        self._images = images
        self._positions = self.DeclareVectorInputPort("positions", positions)
        self._film = self.DeclareAbstractState(Value(_Film()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._capture)
        if latency % period:
            self.DeclarePeriodicUnrestrictedUpdateEvent(period, latency % period, self._deliver)
        self.DeclareAbstractOutputPort(
            "image",
            functools.partial(Value, CameraFrame()),
            self._calc_image,
            prerequisites_of_calc={self.abstract_state_ticket(self._film)},
        )

    def _capture(self, context: Context, state: State) -> None:
        film = context.get_abstract_state(int(self._film)).get_value()
        last = film.coming[-1] if film.coming else film.delivered
        new = Capture(context.get_time(), last.sequence + 1, np.array(self._positions.Eval(context)))
        self._images.captured(self.get_name(), new)
        self._advance(dc.replace(film, coming=(*film.coming, new)), context.get_time(), state)

    def _deliver(self, context: Context, state: State) -> None:
        self._advance(context.get_abstract_state(int(self._film)).get_value(), context.get_time(), state)

    def _advance(self, film: _Film, time: float, state: State) -> None:
        due = [c for c in film.coming if c.time <= time - self._latency]
        if due:
            film = _Film(due[-1], film.coming[len(due) :])
        state.get_mutable_abstract_state().get_mutable_value(int(self._film)).set_value(film)

    def _calc_image(self, context: Context, output: Value) -> None:
        capture = context.get_abstract_state(int(self._film)).get_value().delivered
        if capture.sequence < 0:
            output.set_value(CameraFrame(camera=self.get_name()))
            return
        with profiling.work(profiling.IMAGES):
            output.set_value(self._images.frame(self.get_name(), capture))
