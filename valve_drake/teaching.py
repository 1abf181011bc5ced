"""`valve-drake teach`: the reference image of each hand at its handle, and the image Jacobian by small moves there.

On the simulated robot: both hands are put on the handles of a valve that stands straight before it, gripper open, and
moved by +-20 mm along each axis of the hand. Only images are kept: features, Jacobian, reference pictures.
"""

from pathlib import Path

import cv2
import numpy as np

from valve_drake import named_files, outputs
from valve_drake.behaviors.grasp_geometry import StanceConfig, Stances, hand_in_valve
from valve_drake.behaviors.taught import TaughtReference, save_taught
from valve_drake.camera.lens import load_head
from valve_drake.checks import ConfigError
from valve_drake.collision import CollisionModel
from valve_drake.diagram import robot_of
from valve_drake.frames import compose, inverse, make, planar
from valve_drake.messages import SIDES
from valve_drake.perception.handle_marker import find_mark
from valve_drake.robot.robot import Robot
from valve_drake.scenario import Scenario, resolve
from valve_drake.stations.camera_rig import CameraRig, Capture
from valve_drake.stations.scene import panel_pose, start_pose
from valve_drake.stations.simulated import make_mounts
from valve_drake.stations.simulation_config import ErrorConfig, SimulationConfig

PROBE = 0.02  # of the hand to both sides along each of its axes [m]
DISTANCE = 0.78  # base to the panel [m]
IMAGES = 8  # averaged at every place
ENOUGH = 0.5  # share of them in which the mark is found; noise hides it in one or two
REFERENCES, PICTURES = "hands.yaml", {side: f"{side}.png" for side in SIDES}
FILES = (REFERENCES, *PICTURES.values())
HEADING = "Made by `valve-drake teach`."


def teach(scenario: Scenario) -> tuple[dict[str, TaughtReference], dict[str, np.ndarray]]:
    """References and reference pictures (H, W, 3) of both hands. Raises ConfigError if a mark is not seen."""
    simulation = SimulationConfig(camera=resolve(scenario).simulation.camera, error=ErrorConfig())
    simulation.start.distance = DISTANCE
    valve = simulation.valve
    marker = scenario.marker
    head = load_head(named_files.find(scenario, "head_calibration"))
    robot = robot_of(scenario)
    mounts = make_mounts(head, simulation, scenario.seed, robot.description.cameras)
    size = (marker.size[0], marker.size[1])
    rig = CameraRig(mounts, valve, size, simulation.light, simulation.camera, scenario.seed, robot.description)
    X_WV = compose(panel_pose(valve), make(np.eye(3), np.array([0, 0, -marker.panel_depth])))
    base = start_pose(simulation.start, valve)
    X_BV = compose(inverse(planar(*base)), X_WV)
    straight = {side: np.array([0.0, 0.0, 1.0]) for side in SIDES}  # the view direction is not known yet
    is_free = CollisionModel(robot, marker).is_free
    arc = Stances(robot, marker, StanceConfig(), straight, is_free).best_arc(X_BV, np.pi / 2)
    if arc.margin < 0:
        raise ConfigError("teach: the hands do not reach the handles")
    q0 = dict(arc.q)
    taught, pictures = {}, {}
    for side in SIDES:
        X_BG = compose(X_BV, hand_in_valve(side, arc.swapped, marker))

        def look(
            offset: np.ndarray, side: str = side, X_BG: np.ndarray = X_BG
        ) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
            moved = make(X_BG[:, :3], X_BG[:, 3] + X_BG[:, :3] @ offset)
            q = robot.inverse(side, moved, q0[side])
            if q is None:
                raise ConfigError(f"teach: the {side} hand does not reach a probe at {offset} m")
            positions = _positions(rig, base, q0 | {side: q}, robot)
            frames = [rig.frame(f"{side}_wrist", Capture(0.0, k, positions)) for k in range(IMAGES)]
            marks = [find_mark(frame.image, scenario.handle_marker) for frame in frames]
            found = [mark for mark in marks if mark.found]
            if len(found) < ENOUGH * IMAGES:
                reason = next(mark.reason for mark in marks if not mark.found)
                raise ConfigError(f"teach: no mark in {IMAGES - len(found)} of {IMAGES} {side} wrist images: {reason}")
            mean = [np.mean([getattr(mark, name) for mark in found], axis=0) for name in ("feature", "area", "corners")]
            return mean[0], float(mean[1]), mean[2], frames[0].image

        feature, area, corners, pictures[side] = look(np.zeros(3))
        columns = [(look(d)[0] - look(-d)[0]) / (2 * PROBE) for d in PROBE * np.eye(3)]
        taught[side] = TaughtReference(feature, np.column_stack(columns), area, corners)
    return taught, pictures


def _positions(rig: CameraRig, base: np.ndarray, arms: dict[str, np.ndarray], robot: Robot) -> np.ndarray:
    """The rig's joint positions with the robot at `base` and its arms as given."""
    values = robot.named(base=base, torso=robot.torso.home, arms=arms, opening=robot.opening)
    positions = np.zeros(rig.plant.num_positions())
    for name, value in values.items():
        positions[rig.plant.GetJointByName(name, rig.scene.robot).position_start()] = value
    return positions


def made_before(path: Path) -> bool:
    """Whether `write` has filled the folder of this file: its references say so."""
    try:
        with open(path.with_name(REFERENCES), "rb") as file:
            return file.read(100).startswith(f"# {HEADING}".encode())
    except OSError:
        return False


def write(scenario: Scenario, folder: Path) -> None:
    """Teaches and writes FILES into a folder. Raises ConfigError as `teach` does, OperationFailed."""
    taught, pictures = teach(scenario)
    outputs.make_folder(folder)
    save_taught(
        taught,
        folder / REFERENCES,
        f"{HEADING} For each hand at its handle, gripper open: feature (u, v, 1)/sqrt(area),\n"
        "image Jacobian d feature / d hand translation [1/m] in its frame, the mark's area [px^2] and corners [px].",
    )
    for side, picture in pictures.items():
        _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        outputs.write(folder / PICTURES[side], data.tobytes())
