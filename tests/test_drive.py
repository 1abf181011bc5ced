"""Bases that go sideways and bases that do not move: twists, station, wire and names follow robot.yaml's base.drive."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from robot_facts import ROBOT
from robot_variants import fixed, holonomic, variant, without_base_joints

from valve_drake import rehearsal
from valve_drake.checks import ConfigError
from valve_drake.diagram import initial_commands, make_diagram, make_station, robot_of
from valve_drake.messages import RobotState
from valve_drake.recording.signals import commanded, measured
from valve_drake.robot.drive import DIFFERENTIAL, drive, whole
from valve_drake.robot.robot import Robot
from valve_drake.scenario import load, resolve
from valve_drake.stations.bus import Bus
from valve_drake.stations.contract import check_contract, vectors
from valve_drake.stations.hardware import RobotLink, make_hardware_station
from valve_drake.stations.lcm_channels import CHANNELS

NEAR = ["distance=0.8", "bearing=0.1", "heading=0.05"]
QUIET = ["odometry_scale", "odometry_noise", "arm_offset"]


@pytest.fixture(scope="module")
def omni(tmp_path_factory):
    return variant(tmp_path_factory.mktemp("omni"), change=holonomic)


@pytest.fixture(scope="module")
def bolted(tmp_path_factory):
    return variant(tmp_path_factory.mktemp("bolted"), without_base_joints, fixed)


def scenario_of(path, *overrides):
    quiet = [f"simulation.error.{name}=0" for name in QUIET]
    near = [f"simulation.start.{setting}" for setting in NEAR] if "fixed" in Path(path).read_text() else []
    return resolve(load(None, [f"robot={path}", *quiet, *near, *overrides]))


class Stood:
    """A simulated station, its inputs held by hand."""

    def __init__(self, scenario):
        self.station = make_station(scenario)
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        for port, value in initial_commands(scenario).items():
            self.set(port, value)

    def set(self, port, value):
        self.station.GetInputPort(port).FixValue(self.context, np.array(value))

    def read(self, port):
        return self.station.GetOutputPort(port).Eval(self.context)


def test_a_twist_has_the_speeds_that_there_are():
    plane = np.array([1.0, 2.0, 3.0])
    for kind, part in (("differential", [1, 3]), ("holonomic", [1, 2, 3]), ("fixed", [])):
        base = drive(kind, [0.5] * len(part), [0.6] * len(part))
        assert base.part(plane).tolist() == part
        assert base.fixed == (kind == "fixed") and base.sideways == (kind == "holonomic")
    assert whole(np.array([1.0, 3.0])) == (1, 0, 3) and whole(plane) == (1, 2, 3) and whole(np.zeros(0)) == (0, 0, 0)
    assert ROBOT.drive.names == DIFFERENTIAL.names


def test_sizes_and_names_follow_the_drive(omni, bolted):
    for path, twist, speeds in (
        (omni, 3, ("base_forward.velocity", "base_sideways.velocity", "base_heading.velocity")),
        (bolted, 0, ()),
    ):
        groups = Robot.load(path).groups
        sizes = vectors(groups)
        assert (sizes["base.twist_command"], sizes["base.odometry"]) == (twist, 3 + twist)
        assert measured(groups)["base.odometry"][3:] == speeds
        assert commanded(groups).get("base.twist_command", ()) == speeds
    assert vectors(ROBOT.groups)["base.odometry"] == 5


@pytest.mark.system
def test_a_holonomic_base_goes_sideways_and_its_odometry_agrees(omni):
    stood = Stood(scenario_of(omni, "simulation.start.distance=3", "simulation.start.bearing=0"))
    start = stood.read("truth.base_pose").copy()
    stood.set("base.twist_command", [0.1, -0.3, 0.2])
    stood.simulator.AdvanceTo(1.0)
    assert stood.read("base.odometry")[3:] == pytest.approx([0.1, -0.3, 0.2], abs=0.02)
    stood.set("base.twist_command", [0.0, 0.0, 0.0])
    stood.simulator.AdvanceTo(1.5)
    x, y, heading = stood.read("base.odometry")[:3]
    assert (x, y) == pytest.approx((0.13, -0.29), abs=0.02) and heading == pytest.approx(0.2, abs=0.01)
    c, s = np.cos(start[2]), np.sin(start[2])
    moved = [c * x - s * y, s * x + c * y, heading]
    assert stood.read("truth.base_pose") - start == pytest.approx(moved, abs=3e-3)


@pytest.mark.system
def test_a_holonomic_base_is_where_it_is_sent_while_it_turns(omni):
    stood = Stood(scenario_of(omni, "simulation.start.distance=3"))
    plant = stood.station.GetSubsystemByName("plant")
    stood.set("base.twist_command", [0.1, -0.3, 0.6])
    for time in (0.5, 1.0, 1.5, 2.0):
        stood.simulator.AdvanceTo(time)
        now = plant.GetOutputPort("now").Eval(plant.GetMyContextFromRoot(stood.context))
        assert stood.read("truth.base_pose") == pytest.approx(now[plant.parts["base"]], abs=4e-3)  # one tick's way


def test_wheels_slip_sideways_too(omni):
    slip = [f"simulation.mishap.wheel_slip_{key}" for key in ("at=0.0", "for=5.0", "share=0.5")]
    stood = Stood(scenario_of(omni, "simulation.start.distance=3", *slip))
    start = stood.read("truth.base_pose").copy()
    stood.set("base.twist_command", [0.0, 0.3, 0.0])
    stood.simulator.AdvanceTo(1.0)
    driven = np.linalg.norm((stood.read("truth.base_pose") - start)[:2])
    assert stood.read("base.odometry")[1] == pytest.approx(2 * driven, rel=0.05) and driven > 0.1


def test_a_fixed_base_stands_where_it_is_bolted(bolted):
    scenario = scenario_of(bolted)
    stood = Stood(scenario)
    pose = stood.read("truth.base_pose").copy()
    valve = scenario.simulation.valve
    assert np.hypot(*pose[:2]) == pytest.approx(0.8) and pose[2] == pytest.approx(valve.yaw + 0.15)
    stood.simulator.AdvanceTo(0.25)
    assert stood.read("base.odometry").tolist() == [0, 0, 0]
    assert np.array_equal(stood.read("truth.base_pose"), pose)
    assert "base" not in stood.read("health").devices
    view = stood.read("head_left.image").image  # it is rendered from there: the marker's red is in the picture
    assert np.sum((view[..., 0] > 120) & (view[..., 1] < 80)) > 200


def test_a_robot_that_its_file_welds_to_the_world_is_bolted_elsewhere(tmp_path):
    path = variant(tmp_path, change=lambda given: (fixed(given), given.update(weld=["base_x", "base_y", "base_yaw"])))
    stood = Stood(scenario_of(path))
    plant = stood.station.GetSubsystemByName("plant")
    context = plant.plant_context(stood.context)
    X = plant.plant.GetFrameByName("B", plant.robot).CalcPoseInWorld(context)
    assert X.translation()[:2] == pytest.approx(stood.read("truth.base_pose")[:2])
    assert X.rotation().ToRollPitchYaw().yaw_angle() == pytest.approx(stood.read("truth.base_pose")[2])


@pytest.mark.parametrize("path", ["omni", "bolted"])
def test_the_whole_program_is_wired_for_any_base(path, request):
    scenario = scenario_of(request.getfixturevalue(path))
    system = make_diagram(scenario)
    check_contract(system.station, Robot.load(scenario.robot).groups)
    simulator = Simulator(system.diagram)
    simulator.AdvanceTo(0.05)


def test_a_base_command_on_the_wire_has_its_speeds_by_name():
    row = CHANNELS["base.command"]
    message = row.encode(7, {"base.twist_command": np.array([0.1, 0.2, 0.3])})
    assert list(message.coord) == ["forward", "sideways", "yaw_rate"]
    assert row.read(message)["base.twist_command"].tolist() == [0.1, 0.2, 0.3]
    message = CHANNELS["base.status"].encode(7, {"base.odometry": np.arange(5.0)})
    assert list(message.coord) == ["x", "y", "heading", "forward", "yaw_rate"]


@pytest.mark.system
@pytest.mark.parametrize("path", ["omni", "bolted"])
def test_any_base_is_spoken_to_over_the_wire(path, request):
    scenario = scenario_of(request.getfixturevalue(path), "hardware.lcm_url='memq://'", "hardware.lockstep=true")
    robot, lcm = Robot.load(scenario.robot), DrakeLcm("memq://")
    twin = rehearsal.make_twin(scenario, lcm=lcm)
    link = RobotLink(Bus(scenario.hardware, lcm), robot.groups, idle=twin.poll)
    station = make_hardware_station(link, robot)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    commands = initial_commands(scenario) | {"base.twist_command": np.array([0.0, 0.3, 0.0][: 3 * (path == "omni")])}
    for port, value in commands.items():
        station.GetInputPort(port).FixValue(context, value)
    simulator.AdvanceTo(0.2)
    odometry = station.GetOutputPort("base.odometry").Eval(context)
    health = station.GetOutputPort("health").Eval(context)
    assert health.faults == () and ("base" in health.devices) == (path == "omni")
    if path == "omni":
        assert odometry[4] == pytest.approx(0.3, abs=0.1)
    else:
        assert odometry.tolist() == [0, 0, 0]
    link.leave()


def test_a_robot_of_another_base_is_refused_over_the_wire(omni):
    scenario = scenario_of(omni, "hardware.lcm_url='memq://'", "hardware.lockstep=true")
    lcm = DrakeLcm("memq://")
    twin = rehearsal.make_twin(scenario, lcm=lcm)
    link = RobotLink(Bus(scenario.hardware, lcm), ROBOT.groups, idle=twin.poll)
    with pytest.raises(ConfigError, match="not the robot of this program: base: 6 values, want 5"):
        link.start()


def test_only_a_fixed_base_begins_right_before_the_valve(omni, bolted):
    for path in (omni, None):
        robot = [] if path is None else [f"robot={path}"]
        for distance in ("0.8", "!Uniform {min: 0.8, max: 2.0}"):
            with pytest.raises(ConfigError, match="start.distance must be at least 0.9 for a base that drives"):
                robot_of(load(None, [*robot, f"simulation.start.distance={distance}"]))
    robot_of(load(None, [f"robot={bolted}", "simulation.start.distance=0.7"]))


def test_a_large_base_begins_where_it_has_room_to_turn(tmp_path):
    large = variant(tmp_path, change=lambda given: given["base"].update(footprint=[0.7, 0.6], stand=[]))
    with pytest.raises(ConfigError, match="start.distance must be at least 1.122 for a base that drives, got 1.0"):
        robot_of(load(None, [f"robot={large}", "simulation.start.distance=1"]))
    robot_of(load(None, [f"robot={large}", "simulation.start.distance=1.2"]))


def test_a_state_tells_the_speeds_that_the_base_has():
    assert RobotState(odometry=[1, 2, 3]).twist.tolist() == []
    assert RobotState(odometry=[1, 2, 3, 4, 5, 6]).twist.tolist() == [4, 5, 6]
