"""sensor: torque: what a hand feels by its joints' torques, against forces that are known."""

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.tree import MultibodyForces
from pydrake.systems.analysis import Simulator
from robot_facts import ROBOT
from robot_variants import seven_joints, variant, with_roll, without_force_sensors

from valve_drake import rehearsal
from valve_drake.diagram import initial_commands, make_station
from valve_drake.messages import LEFT, SIDES
from valve_drake.robot.kinematics import wrench
from valve_drake.robot.robot import Robot
from valve_drake.scenario import load, resolve
from valve_drake.stations.bus import Bus
from valve_drake.stations.hardware import RobotLink, make_hardware_station

FORCES = [np.array([1.0, -2.0, 0.5, 12.0, -20.0, 7.0]), np.array([0.0, 0.0, 0.0, 0.0, 0.0, -30.0])]


@pytest.fixture(scope="module", params=["six joints", "seven joints"])
def robot(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    if request.param == "six joints":
        return Robot.load(variant(folder, change=without_force_sensors))
    return Robot.load(variant(folder, seven_joints, lambda given: (with_roll(given), without_force_sensors(given))))


def torques(robot, side, q, velocity, posture, F_G):
    """Of the arm's actuators while the world pushes its hand by F_G at the grip and nothing accelerates (n,)."""
    plant, arm = robot.model.plant, robot.arms[side]
    context = plant.CreateDefaultContext()
    at = robot.rest(robot.opening)
    at[robot.slots(arm.names)] = q
    at[robot.slots(robot.posture.names)] = posture
    plant.SetPositions(context, at)
    v = np.zeros(plant.num_velocities())
    joints = [plant.GetJointByName(name).velocity_start() for name in arm.names]
    v[joints] = velocity
    plant.SetVelocities(context, v)
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    grip = plant.GetFrameByName(f"{side}_grip")
    X = grip.GetFixedPoseInBodyFrame()
    R_WBody = plant.EvalBodyPoseInWorld(context, grip.body()).rotation()
    R_WG = R_WBody @ X.rotation()
    F_W = SpatialForce(R_WG.matrix() @ F_G[:3], R_WG.matrix() @ F_G[3:])
    shifted = F_W.Shift(-(R_WBody.matrix() @ X.translation()))  # to the body's origin
    grip.body().AddInForceInWorld(context, shifted, forces)
    return plant.CalcInverseDynamics(context, np.zeros_like(v), forces)[joints]


@pytest.mark.parametrize("F_G", FORCES)
@pytest.mark.parametrize("side", SIDES)
def test_a_known_force_on_the_hand_is_read_off_the_torques(robot, side, F_G):
    arm, posture = robot.arms[side], np.array([0.2])
    q, velocity = arm.work + 0.05, np.linspace(-0.5, 0.5, len(arm))
    torque = torques(robot, side, q, velocity, posture, F_G)
    assert robot.torque_wrench(side, q, velocity, torque, posture) == pytest.approx(F_G, abs=2e-3)


def test_a_hand_that_nothing_touches_feels_nothing_whatever_it_weighs(robot):
    for q in (robot.arms[LEFT].home, robot.arms[LEFT].work):
        zero = np.zeros(len(q))
        torque = torques(robot, LEFT, q, zero, np.zeros(1), np.zeros(6))
        assert np.abs(torque).max() > 3  # the arm is heavy
        assert robot.torque_wrench(LEFT, q, zero, torque, np.zeros(1)) == pytest.approx(np.zeros(6), abs=1e-6)
    assert robot.hands[LEFT].mass == 0  # nothing is left to subtract


def test_a_readings_error_is_that_of_the_joints_and_stays_bounded_at_a_singularity(robot):
    arm = robot.arms[LEFT]
    J, noise = robot.jacobian(LEFT, arm.work), np.full(len(arm), 0.1)
    rng = np.random.default_rng(0)
    read = np.array([wrench(J, noise * rng.standard_normal(len(arm)), noise) for _ in range(4000)])
    likeliest = np.linalg.inv((J / noise**2) @ J.T)
    assert np.cov(read.T) == pytest.approx(likeliest, rel=0.15, abs=0.05 * likeliest.max())
    straight = np.zeros(len(arm))  # the elbow is stretched: forces along the arm move no joint
    J = robot.jacobian(LEFT, straight)
    read = [np.abs(wrench(J, noise * rng.standard_normal(len(arm)), noise)[3:]).max() for _ in range(100)]
    assert max(read) < 100


def test_a_joint_that_reads_badly_counts_for_less():
    J = np.hstack([np.eye(6), np.eye(6)])
    load = np.concatenate([np.ones(6), np.full(6, 3.0)])
    noise = np.concatenate([np.full(6, 0.01), np.full(6, 1.0)])
    assert wrench(J, load, noise) == pytest.approx(np.ones(6), abs=1e-3)


@pytest.fixture(scope="module")
def stood(tmp_path_factory):
    """The simulated station of our robot without force sensors, at rest."""
    path = variant(tmp_path_factory.mktemp("torque"), change=without_force_sensors)
    scenario = resolve(load(None, [f"robot={path}", "simulation.error.arm_offset=0"]))
    station = make_station(scenario)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    for port, value in initial_commands(scenario).items():
        station.GetInputPort(port).FixValue(context, value)
    rows = []
    for k in range(1, 129):
        simulator.AdvanceTo(k / 128)
        rows.append({name: station.GetOutputPort(name).Eval(context).copy() for side in SIDES
                     for name in (f"{side}_wrist.wrench", f"{side}_arm.torque_measured")})  # fmt: skip
    health = station.GetOutputPort("health").Eval(context)
    return {name: np.array([row[name] for row in rows[64:]]) for name in rows[0]}, health, Robot.load(path)


def test_torques_are_read_with_the_noise_and_the_bias_of_the_file(stood):
    read, _, robot = stood
    biases = []
    for side in SIDES:
        torque = read[f"{side}_arm.torque_measured"]
        assert torque.std(axis=0) == pytest.approx(np.full(6, 0.1), rel=0.35)
        weight = torques(robot, side, robot.arms[side].home, np.zeros(6), np.zeros(1), np.zeros(6))
        biases += (torque.mean(axis=0) - weight).tolist()
    assert 0.08 < np.std(biases) < 0.4


def test_the_station_computes_the_wrench_on_the_port_of_the_sensor_that_there_is_none_of(stood):
    read, health, robot = stood
    for side in SIDES:
        wrenches = read[f"{side}_wrist.wrench"]
        J = robot.jacobian(side, robot.arms[side].home)
        R = robot.forward(side, robot.arms[side].home)[:, :3]
        sigma = np.sqrt(np.diag(R.T @ np.linalg.inv(J @ J.T)[3:, 3:] @ R))
        assert wrenches.std(axis=0)[3:] == pytest.approx(0.1 * sigma, rel=0.35)
        assert np.abs(wrenches.mean(axis=0)[3:]).max() < 3 * 0.2 * sigma.max()  # the biases alone: no weight
    assert {"left_wrist_sensor", "right_wrist_sensor"}.isdisjoint(health.devices)
    assert set(ROBOT.groups.absent) == set()


@pytest.mark.system
def test_over_the_wire_the_same_wrench_comes_of_what_the_joints_report(tmp_path):
    path = variant(tmp_path, change=without_force_sensors)
    settings = [f"robot={path}", "hardware.lcm_url='memq://'", "hardware.lockstep=true"]
    settings.append("faults=[{kind: dead, device: left_arm, start: 0.3}]")
    scenario, lcm = resolve(load(None, settings)), DrakeLcm("memq://")
    robot, twin = Robot.load(path), rehearsal.make_twin(scenario, lcm=lcm)
    link = RobotLink(Bus(scenario.hardware, lcm), robot.groups, idle=twin.poll)
    station = make_hardware_station(link, robot)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    for port, value in initial_commands(scenario).items():
        station.GetInputPort(port).FixValue(context, value)
    simulator.AdvanceTo(0.2)

    def read(name):
        return station.GetOutputPort(name).Eval(context)

    for side in SIDES:
        joints = [read(f"{side}_arm.{what}_measured") for what in ("position", "velocity", "torque")]
        wanted = robot.torque_wrench(side, *joints, read("torso.position_measured")[:1])
        assert read(f"{side}_wrist.wrench") == pytest.approx(wanted) and np.isfinite(wanted).all()
    assert read("health").faults == () and "left_wrist_sensor" not in read("health").devices
    simulator.AdvanceTo(0.5)  # the left arm has said nothing for 0.2 s: its force is not known, its joints are
    assert np.isnan(read("left_wrist.wrench")).all() and np.isfinite(read("right_wrist.wrench")).all()
    assert np.isfinite(read("left_arm.position_measured")).all()
    link.leave()
