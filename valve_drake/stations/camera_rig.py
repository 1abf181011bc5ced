"""The simulated cameras: rendered images through a real lens, blur, noise and JPEG.

`CameraRig` owns a scene of its own, made only to be rendered; a camera block keeps the joint positions at capture
time and delivers the image made from them `latency` later. So an image shows the instant it was taken, whenever it is
read, and a camera that nobody looks at costs nothing.

Pixel convention: Drake's renderer puts the centre of the first pixel at (0.5, 0.5), everybody else here at (0, 0).
It is converted in `_Lensed.__init__` alone.
"""

import dataclasses as dc
import functools
import typing
from collections.abc import Mapping

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import Frame
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, State
from pydrake.systems.sensors import CameraInfo

from valve_drake.camera.lens import Lens, distortion_maps
from valve_drake.messages import CameraFrame
from valve_drake.ports import profile
from valve_drake.stations.scene import add_scene
from valve_drake.stations.simulation_config import CameraConfig, LightConfig, ValveConfig

MARGIN = 26  # rendered beyond the image on every side: Table 1's lenses reach 23 px outward at the corners [px]


@dc.dataclass(frozen=True)
class Mount:
    """One camera: its lens, the frame it sits on, and how far off that frame it really is (X_FC, (3, 4))."""

    lens: Lens
    frame: str
    X_FC: np.ndarray


class _Lensed:
    """From an ideal rendered image to the raw image of one lens."""

    def __init__(self, lens: Lens, supersample: int):
        m, k = MARGIN, supersample
        self.width, self.height = (lens.width + 2 * m) * k, (lens.height + 2 * m) * k
        # Ideal pixel of the render in OpenCV's convention: u = fx x' + cx. Scaling by k keeps pixel edges, not centres.
        fx, fy = lens.k_x * k, lens.k_y * k
        cx, cy = (lens.u_0 + m + 0.5) * k - 0.5, (lens.v_0 + m + 0.5) * k - 0.5
        self.info = CameraInfo(self.width, self.height, fx, fy, cx + 0.5, cy + 0.5)
        # Maps into the render reduced to normal size.
        reduced = np.array([[lens.k_x, 0, lens.u_0 + m], [0, lens.k_y, lens.v_0 + m], [0, 0, 1]])
        self.map_u, self.map_v = distortion_maps(lens, reduced)
        self.supersample = k
        self.reduced = (self.width // k, self.height // k)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        if self.supersample > 1:
            image = cv2.resize(image, self.reduced, interpolation=cv2.INTER_AREA)
        return cv2.remap(image, self.map_u, self.map_v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


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


class CameraRig:
    """The scene as the cameras see it."""

    def __init__(
        self,
        mounts: Mapping[str, Mount],
        valve: ValveConfig,
        marker_size: tuple[float, float],
        light: LightConfig,
        camera: CameraConfig,
        seed: int,
    ):
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1.0)
        scene_graph.set_name("scene_graph")
        params = RenderEngineVtkParams(lights=lights(light), default_clear_color=np.array([0.80, 0.85, 0.90]))
        scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(params))
        self.scene = add_scene(self.plant, valve, marker_size)
        self.plant.Finalize()
        self._scene_graph = scene_graph
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._plant_context = self.plant.GetMyMutableContextFromRoot(self._context)
        self._query = scene_graph.get_query_output_port()
        self._camera = camera
        self._gains = np.array([light.red_gain, 1.0, light.blue_gain])
        self._seed = seed
        self._noise = _noise_pool(seed)
        self._mounts = dict(mounts)
        self._names = sorted(mounts)
        self._lensed = {name: _Lensed(mount.lens, camera.supersample) for name, mount in mounts.items()}

    def pose(self, q: np.ndarray) -> None:
        """Poses the renderer's own scene as it was at capture time; the running plant is not touched."""
        self.plant.SetPositions(self._plant_context, q)

    def _render(self, frame: Frame, X_FC: np.ndarray, info: CameraInfo) -> np.ndarray:
        X = frame.GetFixedPoseInBodyFrame() @ RigidTransform(RotationMatrix(X_FC[:, :3]), X_FC[:, 3])
        core = RenderCameraCore("vtk", info, ClippingRange(0.02, 25.0), RigidTransform())
        query = self._query.Eval(self._scene_graph.GetMyContextFromRoot(self._context))
        parent = self.plant.GetBodyFrameIdOrThrow(frame.body().index())
        image = query.RenderColorImage(ColorRenderCamera(core, False), parent, X)
        return np.ascontiguousarray(image.data[..., :3])

    def ideal(self, name: str, q: np.ndarray) -> np.ndarray:
        """The raw image of one camera without noise (H, W, 3) uint8."""
        mount, lensed = self._mounts[name], self._lensed[name]
        self.pose(q)
        return lensed(self._render(self.plant.GetFrameByName(mount.frame), mount.X_FC, lensed.info))

    def captured(self, name: str, capture: "Capture") -> None:
        """Nothing to do ahead: images are made where they are read."""

    def frame(self, name: str, capture: "Capture") -> CameraFrame:
        """What the camera delivers: lens, blur, white balance, noise, JPEG and back."""
        image = self.ideal(name, capture.q)
        c = self._camera
        if c.blur > 0:
            image = cv2.GaussianBlur(image, (0, 0), c.blur)
        rng = np.random.Generator(np.random.SFC64([self._seed, self._names.index(name), capture.sequence]))
        start = int(rng.integers(len(self._noise) - image.size))
        noise = self._noise[start : start + image.size].reshape(image.shape)
        values = cv2.multiply(image, (*self._gains, 0.0), dtype=cv2.CV_32F)
        values = cv2.scaleAdd(noise, c.noise, values)
        return encode_frame(
            name, capture.time, capture.sequence, cv2.convertScaleAbs(cv2.max(values, 0.0)), c.jpeg_quality
        )

    def view(self, X_WC: np.ndarray, q: np.ndarray, width: int, height: int, fov_y: float) -> np.ndarray:
        """A picture from anywhere, for people (height, width, 3)."""
        self.pose(q)
        focal = height / 2 / np.tan(fov_y / 2)
        info = CameraInfo(width, height, focal, focal, width / 2, height / 2)
        return self._render(self.plant.world_frame(), X_WC, info)


def _noise_pool(seed: int) -> np.ndarray:
    """White noise of unit deviation, several images' worth: every image takes a stretch of it from a place of its own.

    Drawing a million numbers anew for each image would cost as much as a third of its rendering.
    """
    return np.random.Generator(np.random.SFC64([seed, 99])).standard_normal(4 << 20, dtype=np.float32)


def encode_frame(camera: str, time: float, sequence: int, image: np.ndarray, quality: int) -> CameraFrame:
    """JPEG (without chroma subsampling, which would smear red edges) and back, as a camera on a wire does."""
    flags = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), flags)[1].tobytes()
    return CameraFrame(camera=camera, time=time, sequence=sequence, image=decode_image(data), data=data)


def decode_image(data: bytes) -> np.ndarray:
    """JPEG bytes -> (H, W, 3) RGB. Raises ValueError if they are no whole image."""
    try:
        # A turn noted in the file is not applied: a calibration is about the pixels as the sensor has them.
        flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if b"\xff\xd9" in data else None
    except (cv2.error, MemoryError):
        image = None
    if image is None:
        raise ValueError("an image that cannot be decoded")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


@dc.dataclass(frozen=True)
class Capture:
    """What a camera caught: when, which one, and the plant's positions then."""

    time: float = -1.0
    sequence: int = -1
    q: np.ndarray | None = None


class Images(typing.Protocol):
    """Who makes the images: `CameraRig` here and now, `CameraWorkers` beside the run."""

    def captured(self, name: str, capture: Capture) -> None:
        """Told of every capture, looked at or not, so that its image can be begun ahead."""

    def frame(self, name: str, capture: Capture) -> CameraFrame:
        """The image of a capture."""


@dc.dataclass(frozen=True)
class _Film:
    """The state of a camera: what was delivered last, and what is on its way, oldest first."""

    delivered: Capture = Capture()
    coming: tuple[Capture, ...] = ()

    def __deepcopy__(self, memo: dict) -> "_Film":
        return self


class CameraSystem(LeafSystem):
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
        with profile("rendering"):
            output.set_value(self._images.frame(self.get_name(), capture))
