"""The estimator's error over the Cramer-Rao bound on the images that the simulated head cameras deliver:
`valve-drake experiment bound --images rendered`.

The drawn images of `experiments.bound` are exact; these are what a run looks at: rendered, with the lens, blur, noise
and JPEG of the default camera, the calibration perfect, the robot at a place of its working range. So whatever the
renderer does to the marker's sides is in the error. The bound is that of the same marker in exact images of this blur
and noise, its colours read off the image; what JPEG takes away counts as loss.
"""

import dataclasses as dc
import math
from typing import Any

import numpy as np

from valve_drake import frames
from valve_drake.analysis import experiments
from valve_drake.analysis.drawn_images import Canvas
from valve_drake.camera.lens import StereoHead
from valve_drake.diagram import robot_of
from valve_drake.messages import HEAD, MarkerEdges
from valve_drake.perception.marker import Marker
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, Track, estimate
from valve_drake.scenario import Scenario
from valve_drake.stations.camera_rig import CameraRig, Capture
from valve_drake.stations.scene import start_pose
from valve_drake.stations.simulated import true_head
from valve_drake.stations.simulation_config import CameraConfig, ErrorConfig, LightConfig, StartConfig, ValveConfig
from valve_drake.valve.valve import Valve

BANDS = ((0.6, 0.9), (0.9, 1.4), (1.4, 2.2), (2.2, 3.2))  # of the marker's distance from the left eye [m]
BEARING, HEADING, PITCH = 0.5, 0.12, (-0.1, 0.6)  # of the drawn places: +-, +-, lowest and highest [rad]
MARGIN = 12.0  # of the marker's corners from the rim of both images [px]
METHODS = {"": RectangleEstimatorConfig(), " without side_bias": experiments.REFINED}  # column's ending -> its config


@dc.dataclass(frozen=True)
class _Place:
    """Where the robot is put. q: positions of the rig's plant; X_LV: the marker's true pose in the left camera."""

    q: np.ndarray
    X_LV: np.ndarray


class _Studio:
    """The head cameras before the valve, with a perfect calibration."""

    def __init__(self, seed: int, camera: CameraConfig):
        self.eyes: StereoHead = experiments.head()
        self.marker, self.camera, self.valve = Marker(), camera, ValveConfig()
        self._robot = robot_of(Scenario())
        none = ErrorConfig(head_yaw=0.0, head_rotation=0.0, head_mount=0.0)
        mounts = true_head(self.eyes, none, seed, self._robot.description.cameras["head_left"])
        self.rig = CameraRig(mounts, self.valve, Valve(), LightConfig(), camera, seed)
        self.noise = float(self.camera.noise)  # type: ignore[arg-type]  # resolved: no distribution

    def place(self, rng: np.random.Generator, band: tuple[float, float]) -> _Place:
        """A place from which both eyes see the marker, in a band of distances [m]."""
        plant, scene = self.rig.plant, self.rig.scene
        while True:
            distance, bearing = rng.uniform(band[0], band[1] + 0.6), rng.uniform(-BEARING, BEARING)
            start = StartConfig(distance, bearing, rng.uniform(-HEADING, HEADING))
            torso = self._robot.torso.home.copy()
            torso[-2] += rng.uniform(*PITCH)  # tilt
            arms = self._robot.split(self._robot.home)
            values = self._robot.named(base=start_pose(start, self.valve), torso=torso, arms=arms)
            q = np.zeros(plant.num_positions())
            for name, value in values.items():
                q[plant.GetJointByName(name, scene.robot).position_start()] = value
            q[plant.GetJointByName("stem", scene.valve).position_start()] = rng.uniform(0, math.pi / 2)
            X_LV = self.rig.marker_pose("head_left", q)
            if band[0] <= X_LV[2, 3] < band[1] and self._seen(X_LV):
                return _Place(q, X_LV)

    def _seen(self, X_LV: np.ndarray) -> bool:
        for lens, X_CL in zip(self.eyes.lenses(), (np.eye(3, 4), frames.inverse(self.eyes.X_LR))):
            P = frames.apply(frames.compose(X_CL, X_LV), self.marker.corners())
            px = lens.project(P[:, :2] / P[:, 2:])
            if (px < MARGIN).any() or (px > np.array([lens.width, lens.height]) - 1 - MARGIN).any():
                return False
        return True

    def images(self, place: _Place, number: int) -> list[np.ndarray]:
        """What both cameras deliver, with the noise of that number."""
        return [self.rig.frame(name, Capture(0.0, number, place.q)).image for name in HEAD]

    def colors(self, place: _Place, scale: float, grow: float) -> np.ndarray:
        """The mean colour in the left image of what lies between the marker scaled by `scale` and by `grow` (3,);
        scale 0: of the marker itself, so scaled."""
        canvas = Canvas(self.eyes.left, float(self.camera.blur))  # type: ignore[arg-type]
        half = np.array(self.marker.size) / 2
        outer, box = canvas.seen(place.X_LV, tuple(grow * half))
        inside = outer > 0.999
        if scale:
            inside &= canvas.seen(place.X_LV, tuple(scale * half), box)[0] < 0.001
        return self.rig.optical("head_left", place.q)[box][inside].mean(axis=0)

    def contrast(self, place: _Place, plate_by_red: np.ndarray) -> float:
        """Of the marker and the plate behind it, which lie in the same light [grey levels]."""
        red = self.colors(place, 0.0, 0.8)
        return float(np.linalg.norm(red - np.minimum(plate_by_red * red, 255)))

    def information(self, place: _Place, contrast: float) -> np.ndarray:
        """Fisher's matrix of (theta, dp) by camera (2, 6, 6), of all pixels."""
        blur = float(self.camera.blur)  # type: ignore[arg-type]
        return experiments.information(place.X_LV, self.eyes, self.marker, self.noise, blur, contrast)[:, 0]


def rendered_bound(
    seed: int = 0,
    trials: int = 100,
    bands: tuple[tuple[float, float], ...] = BANDS,
    camera: CameraConfig | None = None,
) -> dict[str, Any]:
    """Error over the bound, sqrt(mean(e^T F e) / 6), and NEES / 6, by band of distance; one place a pair of images.

    trials: pairs a band. Columns `mm` and `deg` are root mean squares. As in `experiments.bound`, which of two mirrored
    tilts is right is told.
    """
    studio = _Studio(seed, camera or CameraConfig())
    close = studio.place(np.random.default_rng(seed), (0.6, 0.7))
    plate_by_red = studio.colors(close, 1.05, 1.15) / np.maximum(studio.colors(close, 0.0, 0.8), 1.0)
    rows = []
    for number, band in enumerate(bands):
        rng = np.random.default_rng([seed, number])
        found: dict[str, list[tuple[float, ...]]] = {"one": [], "two": []}
        for k in range(trials):
            place = studio.place(rng, band)
            F = studio.information(place, studio.contrast(place, plate_by_red))
            edges = experiments.read(studio.images(place, 10000 * number + k), studio.eyes, studio.marker)[1]
            for cameras, seen in (("one", experiments.one_camera(edges)), ("two", edges)):
                figures = _figures(seen, place, studio, F[0] if cameras == "one" else F.sum(axis=0), cameras)
                if figures is not None:
                    found[cameras].append(figures)
        for cameras, values in found.items():
            row: dict[str, Any] = {"cameras": cameras, "z [m]": f"{band[0]:g} to {band[1]:g}"}
            for name, column in zip(_names(), np.array(values).T if values else ()):
                row[name] = float(column.mean() if name.startswith("NEES") else math.sqrt(column.mean()))
            rows.append(row | {"n": len(values), "of": trials})
    settings = {
        "target_mm": [1000 * s for s in studio.marker.size],
        **{name: getattr(studio.camera, name) for name in ("renderer", "supersample", "blur", "noise", "jpeg_quality")},
        "trials": trials,
        "seed": seed,
    }
    return {"experiment": "bound_rendered", "settings": settings, "rows": rows}


def _names() -> list[str]:
    return [f"{name}{method}" for method in METHODS for name in ("over the bound", "NEES/6", "mm", "deg")]


def _figures(
    seen: MarkerEdges, place: _Place, studio: _Studio, F: np.ndarray, cameras: str
) -> tuple[float, ...] | None:
    """Squares of one pair, in the order of `_names`; None if the marker is not found in all its cameras."""
    out: list[float] = []
    for config in METHODS.values():
        got = estimate(seen, studio.eyes, studio.marker, config, Track(place.X_LV))
        if not got.found or got.cameras != 1 + (cameras == "two"):
            return None
        e = experiments.pose_error(got.X_LV, place.X_LV)
        nees = float(e @ np.linalg.solve(got.covariance, e)) / 6
        out += [float(e @ F @ e) / 6, nees, 1e6 * float(e[3:] @ e[3:]), math.degrees(1) ** 2 * float(e[:3] @ e[:3])]
    return tuple(out)
