"""blind_servo: the last decimetre without a camera in the hand, and whether the errors fit between open fingers."""

import dataclasses as dc

import numpy as np
import pytest
from robot_facts import ROBOT

from valve_drake import diagram, yaml_file
from valve_drake import scenario as scenarios
from valve_drake.behaviors.blind_servo import STRAIGHT, BlindServo, Memory
from valve_drake.behaviors.grasp_geometry import Turn, standoff
from valve_drake.behaviors.image_servo import ImageServoConfig
from valve_drake.behaviors.stance_config import StanceConfig
from valve_drake.behaviors.stance_search import Stances
from valve_drake.checks import ConfigError
from valve_drake.frames import compose, inverse, make, planar, rotation
from valve_drake.messages import SIDES, CameraFrame, GraspPlan, Mode, ModeState, RobotState
from valve_drake.ports import TICK
from valve_drake.rehearsal import make_twin
from valve_drake.robot import description
from valve_drake.robot.robot import Robot
from valve_drake.stations.scene import panel_pose
from valve_drake.stations.simulation_config import ErrorConfig, ValveConfig
from valve_drake.valve.valve import Valve

CONFIG, VALVE = ImageServoConfig(), Valve()
SERVO = ModeState(mode=Mode.SERVO, activation=4)
BACK = 0.12  # [m]


def at_the_valve(robot: Robot):
    """Both hands' grasps and joints, and the valve, in the base of a robot at its stance."""
    X_OA = compose(panel_pose(ValveConfig(height=1.0)), inverse(VALVE.X_AP()))
    stances = Stances(robot, VALVE, StanceConfig(), dict.fromkeys(SIDES, STRAIGHT), lambda *_: True)
    place, _ = stances.find(X_OA, np.pi / 2, np.array([-2.0, 0.0]))
    posture = robot.posture.home if place.posture is None else place.posture
    X_BA = compose(inverse(planar(*place.base)), X_OA)
    arc = stances.best_arc(Turn(X_BA, np.pi / 2, posture=posture))
    grasps = {side: compose(X_BA, VALVE.grasp(arc.grasps[side].handle, arc.grasps[side].sign)) for side in SIDES}
    return grasps, arc.q, X_BA, posture


@pytest.fixture(scope="module")
def valve():
    return at_the_valve(ROBOT)


class Bench:
    """Hands that follow at once, from the stand-off on."""

    def __init__(self, valve):
        self.grasps, q, _, _ = valve
        self.law, self.memory, self.time = BlindServo(CONFIG, ROBOT), Memory(), 3.0
        self.plan = GraspPlan(X_BG_left=self.grasps["left"], X_BG_right=self.grasps["right"])
        self.q = {side: ROBOT.inverse(side, standoff(X, STRAIGHT, BACK), q[side]) for side, X in self.grasps.items()}
        self.force = {side: np.array([1.0, -2.0, 5.0]) for side in SIDES}  # a bias, and the hand's weight [N]

    def left(self, side: str) -> np.ndarray:
        """From the hand to its grasp, in the grasp's frame [m]."""
        X = ROBOT.forward(side, self.q[side])
        return self.grasps[side][:, :3].T @ (self.grasps[side][:, 3] - X[:, 3])

    def run(self, limit=6.0, each=lambda bench: None):
        for _ in range(int(limit / TICK)):
            each(self)
            loads = {f"{side}_wrench": np.concatenate([np.zeros(3), self.force[side]]) for side in SIDES}
            state = RobotState(time=self.time, left_arm=self.q["left"], right_arm=self.q["right"], **loads)
            self.memory, command, self.servo = self.law.step(self.time, TICK, self.memory, state, SERVO, self.plan)
            self.q = {"left": command.left_arm, "right": command.right_arm}
            self.time += TICK
            if self.memory.status.state != "running":
                break
        return self.memory.status


def test_both_hands_go_straight_and_slowly_to_the_grasps_and_rest_there(valve):
    bench, ways = Bench(valve), []
    status = bench.run(each=lambda b: ways.append([b.left(side) for side in SIDES]))
    assert status.state == "succeeded" and bench.servo.left_converged
    ways = np.array(ways)
    assert np.abs(ways[:, :, :2]).max() < 1e-5  # along the approach alone
    assert np.abs(np.diff(ways[:, :, 2], axis=0)).max() / TICK <= CONFIG.speed * 1.001
    assert bench.time - 3.0 == pytest.approx(BACK / CONFIG.speed + CONFIG.rest, abs=0.1)
    for side in SIDES:
        assert np.abs(bench.left(side)).max() < 2e-6


def push(side: str, at: float, force):
    """Something that the hand meets `at` before its grasp [m]."""

    def each(bench):
        if bench.left(side)[2] < at:
            bench.force[side] = np.array([1.0, -2.0, 5.0 - force])

    return each


def test_a_touch_at_the_handle_is_an_arrival(valve):
    bench = Bench(valve)
    status = bench.run(each=push("left", 0.008, 20.0))
    assert status.state == "succeeded" and status.detail == "left 7 mm (touched), right 0 mm"
    assert 0.004 < bench.left("left")[2] < 0.008 and np.abs(bench.left("right")).max() < 2e-6


@pytest.mark.parametrize("force", [15.0, np.nan])
def test_a_touch_before_the_handle_is_a_miss(valve, force):
    bench = Bench(valve)
    status = bench.run(each=push("right", 0.05, force))
    assert (status.state, status.verdict) == ("failed", "grasp_missed")
    assert status.detail.startswith("right hand touched something") and bench.left("right")[2] > 0.045


def test_less_than_a_touch_is_passed_over(valve):
    assert Bench(valve).run(each=push("left", 0.06, 0.8 * CONFIG.touch_force)).state == "succeeded"


def test_the_errors_fit_between_open_fingers():
    """The head's mount, the arms' encoders and the estimate at their stated scatter: 99 of 100 hands have the handle
    between their pads, and on them."""
    robot, error = Robot.load(description.find("pr2/pr2.robot.yaml")), ErrorConfig()
    grasps, q, X_BA, posture = at_the_valve(robot)
    torso = np.concatenate([posture, [0.4, 0.0]])
    X_BL, rng, off = robot.X_BL(torso), np.random.default_rng(0), []
    X_LA = compose(inverse(X_BL), X_BA)
    for _ in range(300):
        mount = make(rotation(error.head_mount * rng.standard_normal(3)), np.zeros(3))
        seen = make(X_LA[:, :3] @ rotation(0.002 * rng.standard_normal(3)), X_LA[:, 3] + 0.001 * rng.standard_normal(3))
        X_moved = compose(X_BL, mount, seen, inverse(X_BA))  # the valve as it is believed to be, against where it is
        for side in SIDES:
            believed = compose(X_moved, grasps[side])
            wrong = robot.inverse(side, believed, q[side], posture) + error.arm_offset * rng.standard_normal(7)
            off.append(grasps[side][:, :3].T @ (robot.forward(side, wrong, posture)[:, 3] - grasps[side][:, 3]))
    across, along = np.quantile(np.abs(off), 0.99, axis=0)[1:]
    room = (robot.opening - VALVE.handles[0].width) / 2
    assert across < 0.5 * room
    assert along < robot.description.pad.size[1] / 2 + VALVE.handles[0].width / 4  # most of the bar is on the pads


# ---------------------------------------------------------------- in the system


def blind(folder, **cameras):
    path = description.find("pr2/pr2.robot.yaml")
    given = yaml_file.read(path)
    given |= {"servo": "none", "model": str(path.with_name("pr2.urdf")), "taught": ""}
    given["collision"]["srdf"] = str(path.with_name("pr2.srdf"))
    given["cameras"] = {"head_left": given["cameras"]["head_left"], **cameras}
    file = folder / "blind.robot.yaml"
    file.write_text(yaml_file.dump(given))
    return scenarios.resolve(scenarios.load("pr2.scenario.yaml", ["seed=1", f"robot={file}"]))


def test_a_robot_without_wrist_cameras_and_references_has_a_system(tmp_path):
    system = diagram.make_diagram(blind(tmp_path))
    context = system.station.CreateDefaultContext()
    frame = system.station.GetOutputPort("left_wrist.image").Eval(context)
    assert isinstance(frame, CameraFrame) and frame.sequence == -1
    health = system.station.GetOutputPort("health").Eval(context)
    assert not {"left_wrist", "right_wrist"} & set(health.devices)


def test_wrist_cameras_are_asked_for_where_the_hands_are_servoed_by_them(tmp_path):
    scenario = blind(tmp_path)
    text = (tmp_path / "blind.robot.yaml").read_text().replace("servo: none", "servo: camera")
    (tmp_path / "seeing.robot.yaml").write_text(text)
    with pytest.raises(ConfigError, match="cameras.left_wrist must be given, or servo: none, got ''"):
        diagram.robot_of(dc.replace(scenario, robot=str(tmp_path / "seeing.robot.yaml")))
    with pytest.raises(ConfigError, match="cameras.left_wrist must be given for station hardware, got ''"):
        diagram.robot_of(dc.replace(scenario, station="hardware"))
    with pytest.raises(ConfigError, match="cameras.left_wrist must be given for station hardware, got ''"):
        make_twin(scenario)  # it would wait for their first images for ever
