"""Makes the pictures of docs/ from the log of a run: python docs/pictures.py logs/run-1.mcap docs"""

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from valve_drake import named_files
from valve_drake import scenario as scenarios
from valve_drake.analysis.metrics import summarize
from valve_drake.analysis.traces import Traces
from valve_drake.camera.lens import load_head
from valve_drake.frames import make
from valve_drake.recording.reader import LogReader
from valve_drake.robot.robot import Robot
from valve_drake.stations.camera_rig import CameraRig
from valve_drake.stations.simulated import make_mounts


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """X_WC of a camera at `eye` that looks at `target`, upright."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    return make(np.column_stack([x, np.cross(z, x), z]), eye)


def positions(rig: CameraRig, reader: LogReader, robot: Robot, bar_angle: float, time: float) -> np.ndarray:
    """The plant's positions (n,) that the log has at `time` [s]."""

    def at(topic: str) -> Any:
        return next(m for _, _, m in reader.messages([topic], start=time))

    states = {j.name: j.position for j in at("/joint_states").joints}
    values = robot.named(
        base=at("/truth/base_pose").values,
        torso=[states[name] for name in robot.torso.names],
        arms={side: np.array([states[name] for name in arm.names]) for side, arm in robot.arms.items()},
        opening=states["left_gripper"],
    )
    values["stem"] = bar_angle + at("/truth/valve_angle").values[0]
    q = np.zeros(rig.plant.num_positions())
    for name, value in values.items():
        q[rig.plant.GetJointByName(name).position_start()] = value
    return q


def main(log: Path, folder: Path) -> None:
    reader = LogReader(log)
    scenario = scenarios.parse(reader.metadata["run"]["scenario"], "log")
    robot = Traces(reader).robot
    assert robot is not None
    simulation = scenario.simulation
    simulation.light.intensity, simulation.light.fill = 0.95, 0.35
    head = load_head(named_files.find(scenario, "head_calibration"))
    rig = CameraRig(
        make_mounts(head, simulation, scenario.seed, robot.description.cameras),
        simulation.valve,
        scenario.valve,
        simulation.light,
        simulation.camera,
        scenario.seed,
        robot.description,
    )
    spans = {span.mode: span for span in summarize(reader).spans}
    turn, drive = spans["turn"], spans["fine_approach"]
    yaw = simulation.valve.yaw
    out = np.array([-np.cos(yaw), -np.sin(yaw), 0.0])  # from the panel into the room
    side = np.array([-out[1], out[0], 0.0])
    axis = np.array([0, 0, simulation.valve.height])
    shots = {
        # when, where from, what at, field of view [deg]
        "at_the_valve.png": (
            turn.start + 0.35 * (turn.end - turn.start),
            axis + 2.05 * out + 1.05 * side + [0, 0, 0.75],
            axis + 0.30 * out - [0, 0, 0.10],
            44,
        ),
        "approach.png": (
            drive.start + 0.3 * (drive.end - drive.start),
            axis + 3.6 * out + 2.6 * side + [0, 0, 1.0],
            axis + 0.9 * out - [0, 0, 0.25],
            48,
        ),
    }
    for name, (time, eye, target, fov) in shots.items():
        q = positions(rig, reader, robot, simulation.valve.bar_angle, time)
        image = rig.view(look_at(eye, target), q, 2560, 1600, np.radians(fov))
        image = cv2.resize(image, (1280, 800), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / name), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
