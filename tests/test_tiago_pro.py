"""TIAGo Pro, which is not in this repository: imported from its wheel, with examples/tiago_pro.robot.yaml."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from valve_drake import cli, diagram, robot_check
from valve_drake import scenario as scenarios
from valve_drake.checks import ConfigError
from valve_drake.messages import SIDES
from valve_drake.robot import packages

FILE = Path(__file__).parents[1] / "examples" / "tiago_pro.robot.yaml"
MODEL = "package://example-robot-data/robots/tiago_pro_description/robots/tiago_pro.urdf"
HEIGHTS = (1.0, 1.1, 1.2)  # at which it turns valves [m]
FAR = 1.6  # beyond its reach [m]


@pytest.fixture(scope="module")
def robot_yaml(tmp_path_factory):
    pytest.importorskip("trimesh", reason="the extra `robots` is not installed")
    try:
        packages.resolve(MODEL, None, "MODEL")
    except ConfigError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("tiago") / "tiago_pro"
    assert cli.main(["import-robot", MODEL, "-o", str(folder)]) == 0
    return shutil.copy(FILE, folder / "robot.yaml")


@pytest.fixture(scope="module")
def robot(robot_yaml):
    return diagram.robot_of(scenarios.load(None, [f"robot={robot_yaml}"]))


def test_its_file_is_short():
    assert len(FILE.read_text().splitlines()) < 80


@pytest.mark.robots
def test_it_is_a_robot_with_two_eyes_and_a_camera_in_each_hand(robot_yaml, robot):
    assert all(len(robot.arms[side]) == 7 for side in SIDES) and robot.lift == 1
    for side in SIDES:
        X_GC, other = robot.X_GC(side), -1.0 if side == "left" else 1.0
        aim = X_GC[:, 3] - X_GC[2, 3] / X_GC[2, 2] * X_GC[:, 2]  # where the axis meets the grip's plane
        assert np.linalg.norm(aim) < 0.02, "it looks at the handle between the pads"
        assert X_GC[0, 3] * other < 0, "from the side away from the other hand"
        effort = robot.model.plant.GetJointActuatorByName(robot.grippers[side].joint).effort_limit()
        assert effort == 5.0, "the model's 0.1 N m press with 2 N"
    _, lines = diagram.gaze_of(scenarios.load(None, [f"robot={robot_yaml}"]))
    assert any("valve_search.pitch_low: -0.3491 instead of -0.45" in line for line in lines)


@pytest.mark.robots
def test_it_reaches_valves_about_its_shoulders_and_one_beyond_them_is_refused(robot_yaml, monkeypatch):
    monkeypatch.setattr(robot_check, "HEIGHTS", HEIGHTS)
    monkeypatch.setattr(robot_check, "TILTS", (0.0,))
    report = robot_check.check(
        scenarios.load(None, [f"robot={robot_yaml}", f"simulation.valve.height={FAR}"]), str(robot_yaml)
    )
    rows = {round(row.height, 2): row for row in report.reach}
    assert all(rows[height].serves(report.least_margin) for height in HEIGHTS)
    missing = [finding.line() for finding in report.findings if finding.level == robot_check.MISSING]
    assert missing == [f"missing: reach: the scenario's valve at {FAR:g} m is out of reach"]
