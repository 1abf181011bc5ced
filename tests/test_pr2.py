"""The PR2 of models/pr2, a robot that is not our own: by its files alone. Whole runs are slow: docs/your_robot.md."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from valve_drake import diagram, drawing, resources, runner
from valve_drake import scenario as scenarios
from valve_drake.messages import SIDES, Mode
from valve_drake.recording.reader import LogReader

NEAR = ["simulation.start.distance=2.6", "simulation.start.bearing=0.1", "simulation.start.heading=0.1"]


@pytest.fixture(scope="module")
def scenario():
    return scenarios.resolve(scenarios.load("pr2.scenario.yaml", [*NEAR, "seed=4"]))


@pytest.fixture(scope="module")
def robot(scenario):
    return diagram.robot_of(scenario)


def test_its_file_is_short():
    lines = (resources.models() / "pr2" / "pr2.robot.yaml").read_text().splitlines()
    assert len(lines) < 80


@pytest.mark.system
def test_the_wiring_is_the_reviewed_one(scenario):
    """If this fails: look at the difference, then run `valve-drake draw pr2.scenario.yaml`."""
    system = diagram.make_diagram(scenario).diagram
    assert drawing.wiring_text(system) == (resources.diagrams() / "pr2.wiring.txt").read_text()
    assert drawing.svg(system) == (resources.diagrams() / "pr2.svg").read_text()


@pytest.mark.system
def test_it_finds_the_valve_within_a_second_and_the_log_has_its_own_joints(tmp_path, scenario):
    result = runner.run(scenario, tmp_path / "pr2.mcap", duration=1.0)
    assert [span.mode for span in result.summary.spans] == [Mode.IDLE, Mode.SEARCH, Mode.ROUGH_APPROACH]
    reader = LogReader(tmp_path / "pr2.mcap")
    assert reader.damage == []
    for topic in ("/head_left/image", "/joint_states", "/tf", "/scene"):
        assert reader.topics[topic].count > 0, topic
    layout = reader.attachments["layout.json"].data.decode()
    assert "l_shoulder_pan_joint" in layout and "left_arm_1" not in layout
    # Its body is drawn where it is: the frames of its shapes move with those of the joints.
    drawn = {entity.frame_id for _, _, m in reader.messages(["/scene"]) for entity in m.entities}
    moved = {t.child_frame_id for _, _, m in reader.messages(["/tf"]) for t in m.transforms}
    assert any("wrist" in frame for frame in drawn) and drawn - moved <= {"valve::panel", "valve::wheel"}


class Rig:
    """Its simulated station alone, the inputs held by hand."""

    def __init__(self, scenario, **commands):
        self.station = diagram.make_station(scenario)
        self.simulator = Simulator(self.station)
        for name, value in (diagram.initial_commands(scenario) | commands).items():
            self.station.GetInputPort(name).FixValue(self.simulator.get_mutable_context(), value)

    def run(self, until):
        self.simulator.AdvanceTo(until)
        return self

    def read(self, name):
        return self.station.GetOutputPort(name).Eval(self.simulator.get_context())


def test_its_servos_hold_it_at_home_within_the_efforts_of_its_file(scenario, robot):
    rig = Rig(scenario).run(0.5)
    plant = robot.model.plant
    assert rig.read("torso.position_measured") == pytest.approx(robot.torso.home, abs=1e-3)
    for side in SIDES:
        assert rig.read(f"{side}_arm.position_measured") == pytest.approx(robot.arms[side].home, abs=2e-3)
        limits = [plant.GetJointActuatorByName(name).effort_limit() for name in _actuators(plant, robot, side)]
        assert np.all(np.abs(rig.read(f"{side}_arm.torque_measured")) < 0.2 * np.array(limits))
        assert rig.read(f"{side}_gripper.position_measured") == pytest.approx([robot.opening], abs=1e-3)


def _actuators(plant, robot, side):
    by_joint = {plant.get_joint_actuator(i).joint().name(): plant.get_joint_actuator(i).name()
                for i in plant.GetJointActuatorIndices()}  # fmt: skip
    return [by_joint[name] for name in robot.arms[side].names]


@pytest.mark.system
@pytest.mark.parametrize("limit", [30.0, 60.0])
def test_its_fingers_shut_and_press_with_the_force_limit(scenario, limit):
    """The joint turns: the limit reaches it by the lever, and comes back as what the actuator pushes with."""
    shut = {"left_gripper.position_command": np.array([-0.02]), "left_gripper.force_limit": np.array([limit])}
    rig = Rig(scenario, **shut).run(1.0)
    assert rig.read("left_gripper.position_measured")[0] == pytest.approx(0.0, abs=1e-3)
    assert rig.read("left_gripper.force_measured")[0] == pytest.approx(limit, rel=0.02)
    assert abs(rig.read("right_gripper.force_measured")[0]) < 2.0


def test_its_lift_carries_hands_and_eyes_to_the_same_height(robot):
    up = robot.posture.home + 0.1
    torso = np.concatenate([up, robot.torso.home[-2:]])
    assert robot.X_BL(torso)[2, 3] - robot.X_BL(robot.torso.home)[2, 3] == pytest.approx(0.1)
    for side in SIDES:
        q = robot.arms[side].home
        assert (robot.forward(side, q, up) - robot.forward(side, q))[2, 3] == pytest.approx(0.1)
