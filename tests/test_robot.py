"""robot.yaml and the robot that is made of it: names, limits, loads, gripper, and one line for whatever is wrong."""

import ast
import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from robot_facts import MIRROR, ROBOT
from robot_variants import (
    fixed,
    part,
    put,
    seven_joints,
    stiff_neck,
    variant,
    with_roll,
    without_base_joints,
    without_gaze,
    without_waist,
)

from valve_drake import cli, named_files, resources, yaml_file
from valve_drake.checks import ConfigError
from valve_drake.diagram import gaze_of, initial_commands, make_blocks, make_diagram, make_station
from valve_drake.frames import compose, make, planar, rot_z
from valve_drake.messages import LEFT, RIGHT, SIDES
from valve_drake.recording.signals import commanded
from valve_drake.robot import description, model
from valve_drake.robot.robot import Gripper, Robot
from valve_drake.scenario import load, resolve
from valve_drake.stations.contract import check_contract, vectors
from valve_drake.stations.lcm_channels import COMMANDS, REPORTS, present

OURS = description.find(description.OURS)
PR2 = "pr2/pr2.robot.yaml"

# ---------------------------------------------------------------- our own robot


def test_groups_limits_and_speeds_are_those_of_the_files():
    assert ROBOT.base.names == ("base_x", "base_y", "base_yaw")
    assert ROBOT.posture.names == ("waist",)
    assert ROBOT.torso.names == ("waist", "neck_pitch", "neck_yaw")
    assert (ROBOT.torso.low.tolist(), ROBOT.torso.high.tolist()) == ([-0.6, -0.5, -1.6], [0.6, 1.1, 1.6])
    for side in SIDES:
        arm = ROBOT.arms[side]
        assert arm.names == tuple(f"{side}_arm_{k}" for k in range(1, 7))
        assert arm.high.tolist() == (-arm.low).tolist() == [2.97, 2.09, 2.62, 3.32, 2.09, 3.14]
        assert arm.speed.tolist() == ROBOT.description.arm_speed
    assert ROBOT.arms[RIGHT].home.tolist() == (ROBOT.arms[LEFT].home * MIRROR).tolist()
    assert np.array_equal(ROBOT.home, np.concatenate([ROBOT.arms[side].home for side in SIDES]))
    assert [part.tolist() for part in ROBOT.split(np.arange(12.0)).values()] == [list(range(6)), list(range(6, 12))]


def test_the_arms_at_zero_point_straight_forward():
    for side, y in ((LEFT, 0.2), (RIGHT, -0.2)):
        X = ROBOT.forward(side, np.zeros(6))
        assert X == pytest.approx(make(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([0.94, y, 1.05])))
        turned = ROBOT.forward(side, np.zeros(6), posture=np.array([0.3]))  # the waist turns all of it
        assert turned == pytest.approx(compose(make(rot_z(0.3), np.zeros(3)), X))


def test_the_eye_is_where_the_model_has_it_and_turns_with_waist_and_neck():
    R = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    assert ROBOT.X_BL(np.zeros(3)) == pytest.approx(make(R, np.array([0.02, 0.06, 1.42])))
    assert ROBOT.X_BL(np.array([0.2, 0, 0])) == pytest.approx(
        compose(make(rot_z(0.2), np.zeros(3)), ROBOT.X_BL(np.zeros(3)))
    )
    down = ROBOT.X_BL(np.array([0, 0.3, 0]))[:, 2]
    assert down == pytest.approx([np.cos(0.3), 0, -np.sin(0.3)])
    base = np.array([1.0, -2.0, 0.4])
    assert ROBOT.head_pose(base, np.zeros(3)) == pytest.approx(compose(planar(*base), ROBOT.X_BL(np.zeros(3))))


def test_a_wrist_sensor_carries_all_that_is_beyond_it():
    """0.7 kg of hand at (8, 0, 28) mm, two fingers of 80 g each at 0.14 - 0.03 m, even to both sides."""
    for side, sign in ((LEFT, 1), (RIGHT, -1)):
        hand = ROBOT.hands[side]
        assert hand.mass == pytest.approx(0.86)
        com = (0.7 * np.array([sign * 0.008, 0, 0.028]) + 2 * 0.08 * np.array([0, 0, 0.11])) / 0.86
        assert hand.p_SCom == pytest.approx(com, abs=1e-9)
        assert hand.X_SG == pytest.approx(make(np.eye(3), np.array([0, 0, 0.14])), abs=1e-12)


def test_the_opening_is_twice_the_fingers_way():
    for side in SIDES:
        gripper = ROBOT.grippers[side]
        assert gripper.opening(0.0) == pytest.approx(0) and gripper.opening(0.04) == pytest.approx(0.08)
        assert gripper.position(0.085) == pytest.approx(0.0425)
    rest = ROBOT.rest(0.06)
    assert rest[ROBOT.slots([f"{side}_finger_{k}" for side in SIDES for k in (1, 2)])] == pytest.approx(0.03)


def test_a_robot_does_not_change_and_is_made_once():
    assert Robot.load(OURS) is Robot.load(OURS)
    with pytest.raises(AttributeError):
        ROBOT.opening = 0.1
    for array in (ROBOT.home, ROBOT.arms[LEFT].low, ROBOT.arms[LEFT].work, ROBOT.hands[LEFT].X_SG):
        with pytest.raises(ValueError):
            array[...] = 0


def test_a_file_that_has_changed_is_another_robot(tmp_path):
    path = variant(tmp_path)
    first = Robot.load(path)
    assert Robot.load(path) is first
    path = variant(tmp_path, lambda m: put(part(m, "link", "left_forearm"), "pose", "0.40 0 0 0 0 0"))
    assert Robot.load(path).forward(LEFT, np.zeros(6))[0, 3] == pytest.approx(0.98)


def test_a_description_can_be_kept_and_read_anywhere(tmp_path):
    kept = tmp_path / "kept.yaml"
    kept.write_bytes(description.text(OURS))
    assert description.load(kept) == description.load(OURS)
    assert description.load(OURS).model == "package://valve_drake_models/robot/robot.sdf"
    other = variant(tmp_path / "other")
    kept.write_bytes(description.text(other))
    assert description.load(kept).model == str(other.with_name("robot.sdf"))


# ---------------------------------------------------------------- what other robots have


def test_planar_joints_are_added_to_a_model_that_has_none(tmp_path):
    robot = Robot.load(variant(tmp_path, without_base_joints))
    assert robot.base.names == ("base_x", "base_y", "base_yaw")
    assert robot.forward(LEFT, np.zeros(6)) == pytest.approx(ROBOT.forward(LEFT, np.zeros(6)))
    plant = robot.model.plant
    context = plant.CreateDefaultContext()
    q = plant.GetPositions(context)
    q[robot.slots(robot.base.names)] = [1.0, 2.0, 0.5]
    plant.SetPositions(context, q)
    X = plant.GetFrameByName("B").CalcPoseInWorld(context).GetAsMatrix34()
    assert X == pytest.approx(planar(1.0, 2.0, 0.5))
    assert all(plant.HasJointActuatorNamed(name) for name in robot.base.names)


def test_joints_without_actuators_get_them_with_the_files_effort(tmp_path):
    robot = Robot.load(variant(tmp_path, seven_joints, with_roll))
    plant = robot.model.plant
    assert plant.GetJointActuatorByName("left_arm_roll").effort_limit() == 100
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(
        '<robot name="a"><link name="l"/><joint name="j" type="revolute"><limit effort="7" lower="0" upper="1"'
        ' velocity="1"/><mimic joint="i" multiplier="-2" offset="0.1"/></joint></robot>'
    )
    assert list(model._file_joints(urdf)) == [("j", 7.0, model.Mimic("j", "i", -2.0, 0.1))]


def test_welded_joints_hold_where_they_are_zero(tmp_path):
    def weld(given):
        given["weld"] = ["left_arm_roll", "right_arm_roll"]

    robot = Robot.load(variant(tmp_path, seven_joints, weld))
    q = ROBOT.arms[LEFT].home
    assert robot.forward(LEFT, q) == pytest.approx(ROBOT.forward(LEFT, q))
    assert not robot.model.plant.HasJointNamed("left_arm_roll")


def test_added_frames_are_frames_of_the_model(tmp_path):
    def edit(m):
        m.remove(part(m, "frame", "left_grip"))

    def change(given):
        given["frames"] = {"left_grip": {"link": "left_hand", "xyz": [0, 0, 0.14], "rpy": [0, 0, 0]}}

    robot = Robot.load(variant(tmp_path, edit, change))
    assert robot.forward(LEFT, np.zeros(6)) == pytest.approx(ROBOT.forward(LEFT, np.zeros(6)))


def test_a_counterbalanced_robot_has_no_weight(tmp_path):
    robot = Robot.load(variant(tmp_path, change=lambda given: given.update(counterbalanced=True)))
    assert robot.hands[LEFT].mass == 0
    assert not robot.model.plant.is_gravity_enabled(robot.model.robot)


def test_the_same_robot_can_be_added_to_any_plant():
    plant = MultibodyPlant(1e-3)
    index = model.add_robot(plant, ROBOT.description)
    plant.Finalize()
    assert plant.num_positions(index) == 3 + 3 + 12 + 4


def rotary(m):
    """Fingers that swing about pivots 90 mm behind their pads."""
    for side in SIDES:
        for k, x in ((1, -1), (2, 1)):
            joint = part(m, "joint", f"{side}_finger_{k}")
            joint.set("type", "revolute")
            put(joint, "axis/xyz", f"{x} 0 0")
            put(joint, "axis/limit/upper", "0.55")
            put(part(m, "link", f"{side}_finger_{k}_link"), "pose", "0 0 0.05 0 0 0")


def test_a_rotary_gripper_opens_by_the_sine_of_its_joint(tmp_path):
    robot = Robot.load(variant(tmp_path, rotary, lambda given: given.update(pad={"at": [0, 0, 0.09]})))
    for angle in (0.0, 0.2, 0.5):
        assert robot.grippers[LEFT].opening(angle) == pytest.approx(2 * 0.09 * np.sin(angle), abs=2e-5)
        assert robot.grippers[LEFT].position(2 * 0.09 * np.sin(angle)) == pytest.approx(angle, abs=2e-4)


def test_a_gripper_reads_between_its_positions_to_the_bit_of_numpy_and_not_a_number_as_that():
    rng = np.random.default_rng(0)
    positions, levers = np.sort(rng.normal(size=65)), rng.normal(size=65)
    rising = np.sort(rng.normal(size=65))
    for openings in (rising, rising[::-1]):
        gripper = Gripper("joint", positions, openings, levers)
        for x in [*rng.uniform(positions[0], positions[-1], 500), *positions]:
            assert gripper.lever(float(x)) == np.interp(x, positions, levers)
            assert gripper.opening(float(x)) == np.interp(x, positions, openings)
        for x in [*rng.uniform(rising[0], rising[-1], 500), *rising]:
            assert gripper.position(float(x)) == np.interp(x, rising, positions[np.argsort(openings)])
        assert gripper.lever(positions[0] - 1) == levers[0] and gripper.lever(positions[-1] + 1) == levers[-1]
        assert np.isnan(gripper.lever(np.nan)) and np.isnan(gripper.opening(np.nan))


def test_a_gripper_whose_joint_falls_as_it_opens(tmp_path):
    def edit(m):
        for side in SIDES:
            for k, y in ((1, -1), (2, 1)):
                joint = part(m, "joint", f"{side}_finger_{k}")
                put(joint, "axis/xyz", f"0 {y} 0")
                put(joint, "axis/limit/lower", "-0.045")
                put(joint, "axis/limit/upper", "0")

    gripper = Robot.load(variant(tmp_path, edit)).grippers[RIGHT]
    assert gripper.opening(-0.03) == pytest.approx(0.06) and gripper.position(0.06) == pytest.approx(-0.03)


def test_colors_paint_the_models_materials_over(tmp_path):
    robot = Robot.load(variant(tmp_path, change=at("colors", {"accent": [0.1, 0.2, 0.3, 1.0]})))

    def color(robot, link, name):
        inspector = robot.model.scene_graph.model_inspector()
        for shape in robot.model.plant.GetVisualGeometriesForBody(robot.model.plant.GetBodyByName(link)):
            if inspector.GetName(shape).endswith(name):
                return inspector.GetPerceptionProperties(shape).GetProperty("phong", "diffuse").rgba.tolist()

    for link in ("left_hand", "right_finger_1_link", "chest"):
        assert color(robot, link, "accent") == pytest.approx([0.1, 0.2, 0.3, 1.0])
        assert color(robot, link, "dark") == color(ROBOT, link, "dark")
    other = Robot.load(description.find(PR2))  # of a URDF: the finger tips, green in the file
    assert color(other, "l_gripper_l_finger_tip_link", "1") == pytest.approx([0.5, 0.5, 0.5, 1.0])


def pr2(folder, edit):
    """The robot.yaml of the PR2 with its URDF's text edited, in a folder."""
    given = resources.models() / "pr2"
    for path in given.iterdir():
        (folder / path.name).symlink_to(path)
    (folder / "pr2.urdf").unlink()
    (folder / "pr2.urdf").write_text(edit((given / "pr2.urdf").read_text()))
    return folder / "pr2.robot.yaml"


def without_colors(path):
    text = path.read_text()
    path.unlink()  # a link to ours
    path.write_text("".join(line for line in text.splitlines(keepends=True) if not line.startswith("colors:")))
    return path


@pytest.mark.parametrize("painted", [True, False])
def test_a_urdf_with_a_prefix_that_it_does_not_declare_is_a_robot(tmp_path, painted):
    """Drake reads it, and files for Gazebo have such prefixes."""
    path = pr2(tmp_path, lambda text: text.replace("</robot>", "<gazebo><controller:x a='1'/></gazebo></robot>"))
    assert Robot.load(path if painted else without_colors(path)).opening == Robot.load(description.find(PR2)).opening


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda text: text[:3000], "pr2.urdf: not XML: unclosed token (line "),
        (lambda text: "", "pr2.urdf: not XML: no element found"),
        (lambda text: text.replace("<robot", "<!DOCTYPE robot><robot", 1), "a document type (<!DOCTYPE ...>) is not"),
    ],
)
def test_a_damaged_model_whose_colours_are_changed_is_refused_in_one_line(tmp_path, edit, words):
    with pytest.raises(ConfigError) as error:
        Robot.load(pr2(tmp_path, edit))
    assert words in str(error.value) and "\n" not in str(error.value) and "pr2.robot.yaml: model " in str(error.value)


def test_pads_get_a_grid_of_contact_points_where_their_surfaces_are(tmp_path):
    """That of our own pads' file, taken out and asked for by `pad`, is the same but for half a millimetre."""

    def edit(m):
        for side in SIDES:
            for k in (1, 2):
                link = part(m, "link", f"{side}_finger_{k}_link")
                for shape in [c for c in link.findall("collision") if c.get("name").startswith("pad_")]:
                    link.remove(shape)

    def points(robot, link):
        plant, inspector = robot.model.plant, robot.model.scene_graph.model_inspector()
        shapes = plant.GetCollisionGeometriesForBody(plant.GetBodyByName(link))
        pads = [shape for shape in shapes if "pad_" in inspector.GetName(shape)]
        return np.array([inspector.GetPoseInFrame(shape).translation() for shape in pads])

    change = at("pad", {"at": [0, 0, 0], "size": [0.022, 0.016], "friction": 0.8})
    robot = Robot.load(variant(tmp_path, edit, change))
    for side in SIDES:
        for k, inwards in ((1, -1), (2, 1)):
            link = f"{side}_finger_{k}_link"
            assert points(robot, link) == pytest.approx(points(ROBOT, link) + [0, inwards * 5e-4, 0])


def test_a_head_that_turns_the_other_way_looks_where_it_is_asked_to(tmp_path):
    """A tilt that looks up as it grows, a pan to the right, a waist to the right: the gaze is the same."""

    def edit(m):
        for joint in ("neck_pitch", "neck_yaw", "waist"):
            axis = part(m, "joint", joint).find("axis/xyz")
            axis.text = " ".join(f"{-float(x):g}" for x in axis.text.split())
        limit = part(m, "joint", "neck_pitch")
        put(limit, "axis/limit/lower", "-1.1")
        put(limit, "axis/limit/upper", "0.5")

    scenario = load(None, [f"robot={variant(tmp_path, edit)}"])
    robot = Robot.load(scenario.robot)
    assert ROBOT.gaze.signs.tolist() == [1, 1, 1] and robot.gaze.signs.tolist() == [-1, -1, -1]
    gaze = np.array([0.3, 0.4, -0.5])  # waist to the left, down, to the right
    torso = robot.gaze.torso(gaze, np.zeros(1))
    assert torso.tolist() == [-0.3, -0.4, 0.5] and ROBOT.gaze.torso(gaze, np.zeros(1)) == pytest.approx(gaze)
    assert robot.X_BL(torso) == pytest.approx(ROBOT.X_BL(gaze))
    assert robot.gaze.of(torso) == pytest.approx(gaze) and ROBOT.gaze.plain and not robot.gaze.plain
    up = load(None, [f"robot={tmp_path / 'robot.yaml'}", "valve_search.pitch_high=1.1", "valve_search.pitch_low=-0.5"])
    make_blocks(up)  # its limits are those of the joint, turned about


def test_a_fixed_base_hangs_on_the_world(tmp_path):
    robot = Robot.load(variant(tmp_path, without_base_joints, fixed))
    assert len(robot.base) == 0
    assert robot.forward(LEFT, np.zeros(6)) == pytest.approx(ROBOT.forward(LEFT, np.zeros(6)))


def test_the_pr2_is_described_by_its_file():
    robot = Robot.load(description.find(PR2))
    assert robot.posture.names == ("torso_lift_joint",) and robot.base.names == ("base_x", "base_y", "base_yaw")
    for side, y in ((LEFT, 1), (RIGHT, -1)):
        gripper, arm = robot.grippers[side], robot.arms[side]
        assert gripper.openings[[0, -1]] == pytest.approx([0.0, 0.0938], abs=5e-4)  # a rotary linkage: no straight line
        assert gripper.opening(0.274) - gripper.openings[-1] / 2 > 1e-3
        for opening in (0.01, 0.05, 0.085):
            assert gripper.opening(gripper.position(opening)) == pytest.approx(opening, abs=1e-6)
            q = gripper.position(opening)
            slope = (gripper.opening(q + 1e-3) - gripper.opening(q - 1e-3)) / 2e-3
            assert 2 * gripper.lever(q) == pytest.approx(slope, rel=5e-3)  # effort of the joint per force
        assert gripper.position(-0.01) == pytest.approx(-0.01 / (2 * gripper.lever(0.0)))  # shut, it presses
        assert len(arm) == 7 and np.isinf(arm.high).sum() == 2  # forearm and wrist turn round and round
        assert robot.hands[side].mass == 0  # its springs carry it
        X = robot.forward(side, arm.work)
        assert X[0, 3] > 0.6 and X[1, 3] * y > 0.1 and X[0, 2] > 0.99  # before it, the hand forwards
        assert robot.margin(side, arm.work) > 0.9
        raised = robot.forward(side, arm.work, robot.posture.home + 0.1)
        assert raised[:, 3] - X[:, 3] == pytest.approx([0, 0, 0.1])
        assert robot.inverse(side, raised, arm.work, robot.posture.home + 0.1) == pytest.approx(arm.work)


# ---------------------------------------------------------------- wrong files


def at(path, value):
    """A change of one key, given as "arms.left.home"."""

    def change(given):
        *inner, last = path.split(".")
        for name in inner:
            given = given[name]
        given[last] = value

    return change


def swapped(given):
    given["arms"]["left"]["joints"], given["arms"]["right"]["joints"] = (
        given["arms"]["right"]["joints"],
        given["arms"]["left"]["joints"],
    )


def by_torque(**keys):
    """A left arm without a force sensor, its other keys as given."""
    return lambda given: given["arms"]["left"].update(sensor="torque", **keys)


WRONG = {
    "an unknown key": (at("wheels", 4), "unknown key wheels; known here: arm_speed"),
    "a key that is missing": (lambda given: given.pop("base"), "base.frame must be given, got ''"),
    "no model": (at("model", ""), "model must be given"),
    "a model that is not there": (at("model", "nobody.urdf"), "model: no such file: 'nobody.urdf'"),
    "a package that is not there": (at("model", "package://pr9/a.urdf"), "model: no package 'pr9' beside the file"),
    "a file that is not in its package": (
        at("model", "package://valve_drake_models/a.urdf"),
        "model: no such file: 'package://valve_drake_models/a.urdf'",
    ),
    "a model that is none": (at("model", "robot.yaml"), "model "),
    "an unknown joint": (
        at("gaze.pan", "neck_yaws"),
        "gaze.pan must be a joint of the model, got 'neck_yaws'; near it: neck_yaw",
    ),
    "an unknown frame": (
        at("cameras.head_left", "head_camera"),
        "cameras.head_left must be a frame of the model, got 'head_camera'; near it: head",
    ),
    "an unknown base frame": (at("base.frame", "footprint"), "base.frame must be a frame of the model"),
    "an unknown link below a frame": (at("frames", {"tool": {"link": "lefthand"}}), "frames.tool.link must be a frame"),
    "a frame that is there": (at("frames", {"left_grip": {"link": "left_hand"}}), "frames.left_grip: the model has"),
    "home beyond a limit": (
        at("arms.left.home", [1.05, 0.65, -2.9, 0, 1.25, 0]),
        "arms.left.home[2] must be within [-2.62, 2.62], the limits of left_arm_3, got -2.9",
    ),
    "work beyond a limit": (at("arms.right.work", [9, 0, 0, 0, 0, 0]), "arms.right.work[0] must be within [-2.97, "),
    "too few values": (at("arms.left.home", [0, 0]), "arms.left.home must be one value for each of 6 joints"),
    "speeds of another arm": (at("arm_speed", [1.0] * 7), "arm_speed must be one value for each of 6 joints"),
    "a joint faster than its model": (at("arm_speed", [1.2, 2.6, 1, 1, 1, 1]), "arm_speed[1] must be at most 2.5"),
    "a waist faster than its model": (at("gaze.waist_speed", 1.6), "gaze.waist_speed must be at most 1.5"),
    "left and right mixed": (swapped, "arms.left.joints[0] must carry left_grip, got 'right_arm_1'"),
    "joints from the hand inwards": (
        at("arms.left.joints", [f"left_arm_{k}" for k in (6, 5, 4, 3, 2, 1)]),
        "arms.left.joints must go from the shoulder outwards: left_arm_1, left_arm_2",
    ),
    "a joint twice": (
        at("gaze.tilt", "neck_yaw"),
        "gaze.tilt must be a joint of its own; gaze.pan has it, got 'neck_yaw'",
    ),
    "a tilt that turns aside": (
        at("gaze", {"waist": "waist", "pan": "neck_pitch", "tilt": "neck_yaw"}),
        "gaze.tilt must be a joint that turns the eye up and down, got 'neck_yaw'",
    ),
    "a gripper that opens too little": (
        at("opening", 0.12),
        "opening must be at most 0.09 m, which the left gripper opens, got 0.12",
    ),
    "a gripper that moves nothing": (
        at("grippers.left.pads", ["left_hand", "left_wrist_3"]),
        "grippers.left.joint must open and shut the pads",
    ),
    "a pad of the other hand": (
        at("grippers.left.pads", ["left_finger_1_link", "right_finger_1_link"]),
        "grippers.left.pads[1] must be beyond left_arm_6, got 'right_finger_1_link'",
    ),
    "a lift that carries no arm": (
        at("lift", {"joints": ["left_finger_2"], "home": [0.01], "speed": [0.02]}),
        "lift.joints[0] must be a joint that carries both arms, got 'left_finger_2'",
    ),
    "one pad": (at("grippers.left.pads", ["left_hand"]), "grippers.left.pads must be 2 values"),
    "a sensor that moves": (at("arms.left.sensor", "left_arm_6"), "arms.left.sensor must be a fixed joint between"),
    "the other hand's sensor": (
        at("arms.left.sensor", "right_wrist_sensor"),
        "arms.left.sensor must be a fixed joint between left_arm_6 and left_grip, got 'right_wrist_sensor'",
    ),
    "torques without their noise": (
        at("arms.left.sensor", "torque"),
        "arms.left.torque_noise must be one value for each of 6 joints, got []",
    ),
    "torques without noise": (
        by_torque(torque_noise=[0.0] * 6),
        "arms.left.torque_noise[0] must be within [0.0001, 100], got 0",
    ),
    "biases of another arm": (
        by_torque(torque_noise=[0.1] * 6, torque_bias=[0.1]),
        "arms.left.torque_bias must be one value for each of 6 joints, got [0.1]",
    ),
    "noise of a joint that nobody reads": (
        at("arms.left.torque_noise", [0.1] * 6),
        "arms.left.torque_noise must be left out without sensor: torque",
    ),
    "five joints feel no wrench": (
        by_torque(
            joints=[f"left_arm_{k}" for k in (1, 2, 3, 4, 5)], home=[0.0] * 5, work=[0.0] * 5, torque_noise=[0.1] * 5
        ),
        "arms.left.sensor must be a fixed joint: torque needs 6 joints or more, got 'torque'",
    ),
    "a holonomic base with two speeds": (
        at("base.drive", "holonomic"),
        "base.speed must be 3 values for a holonomic base, got [0.8, 1.2]",
    ),
    "a holonomic base with two accelerations": (
        lambda given: given["base"].update(drive="holonomic", speed=[0.8, 0.5, 1.2]),
        "base.acceleration must be 3 values for a holonomic base, got [0.8, 2",
    ),
    "a base faster than its model": (at("base.speed", [0.8, 2.5]), "base.speed[1] must be at most 2, base_yaw's limit"),
    "a base slower than slow": (at("base.speed", [0.001, 1.2]), "base.speed[0] must be within [0.01, 3], got 0.001"),
    "lengths in millimeters": (at("base.footprint", [275, 275]), "base.footprint[0] must be within [0.05, 2], got 275"),
    "a drive that there is none of": (at("base.drive", "tracks"), "base.drive must be differential or holonomic"),
    "a fixed base that moves": (at("base.drive", "fixed"), "base.drive must be one that moves: base_x, base_y"),
    "an angle for a length": (at("opening", 1.5), "opening must be within [0.01, 0.5], got 1.5"),
    "a weld of nothing": (at("weld", ["elbow"]), "weld[0] must be a joint of the model, got 'elbow'"),
    "a colour of no material": (
        at("colors", {"accents": [0, 0, 0, 1]}),
        "robot.yaml: colors.accents must be a material of the model, got 'accents'; near it: accent",
    ),
    "a colour of 8 bits": (at("colors", {"accent": [255, 0, 0, 255]}), "colors.accent[0] must be within [0, 1]"),
    "a pad in millimeters": (at("pad", {"size": [22, 16]}), "pad.size[0] must be within [0, 0.1], got 22"),
    "text for a number": (at("opening", "wide"), "opening must be a finite number, got 'wide'"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_in_one_line_that_names_the_key(tmp_path, case):
    change, words = WRONG[case]
    path = variant(tmp_path, change=change)
    with pytest.raises(ConfigError) as error:
        Robot.load(path)
    line = str(error.value)
    assert words in line and line.startswith(str(path)) and "\n" not in line and len(line) < 600


# What a robot may be and the program cannot use, or a scenario has no use for.
USELESS = {
    "home that touches": (
        [at("arms.left.home", [0, -1.2, 0, 0, 0, 0]), at("arms.right.home", [0, 1.2, 0, 0, 0, 0])],
        [],
        "arms.left.home and arms.right.home must be free of all: left_",
    ),
    "hands too small for the valve": ([at("opening", 0.03)], [], "opening must be at least 0.055: valve.handles.width"),
    "a handle that open fingers are too near to": (
        [],
        ["valve.model=''", "valve.handles=[{xyz: [0.15, 0, 0], width: 0.056}, {xyz: [-0.15, 0, 0]}]"],
        "opening must be at least 0.086: valve.handles.width and 0.015 to either side (collision.padding), "
        "or the handles at most 0.055 wide, got 0.085",
    ),
    "a selector that shuts the hands": ([], ["command_selector.gripper_high=0.08"], "opening must be at most command_"),
}


@pytest.mark.parametrize("case", USELESS)
def test_a_robot_that_the_program_cannot_use_is_refused_in_one_line(tmp_path, case):
    changes, overrides, words = USELESS[case]
    path = variant(tmp_path, change=lambda given: [change(given) for change in changes])
    with pytest.raises(ConfigError) as error:
        make_blocks(load(None, [f"robot={path}", *overrides]))
    assert words in str(error.value) and str(error.value).startswith(str(path)) and "\n" not in str(error.value)


NAMED = {
    "no calibration": (at("head_calibration", ""), "head_calibration must be given: `valve-drake calibrate stereo`"),
    "a calibration that is not there": (
        at("head_calibration", "head.yaml"),
        "robot.yaml: head_calibration: no such file: ",
    ),
    "a calibration in no package": (
        at("head_calibration", "package://pr9/head.yaml"),
        "robot.yaml: head_calibration: no package 'pr9'",
    ),
    "a calibration that is none": (at("head_calibration", "robot.yaml"), "robot.yaml lacks X_LR, left, right and has"),
    "nothing taught": (at("taught", ""), "taught must be given: `valve-drake teach` makes it"),
    "references that are not there": (at("taught", "hands.yaml"), "robot.yaml: taught: no such file: "),
    "references that are none": (at("taught", "robot.yaml"), "robot.yaml: no taught references: must be a mapping of"),
}  # fmt: skip


@pytest.mark.parametrize("case", NAMED)
def test_a_file_that_a_robot_names_and_that_is_none_is_refused_in_one_line(tmp_path, case):
    change, words = NAMED[case]
    path = variant(tmp_path, change=change)
    with pytest.raises(ConfigError) as error:
        make_blocks(load(None, [f"robot={path}"]))
    assert words in str(error.value) and str(path) in str(error.value) and "\n" not in str(error.value)


def test_files_of_a_robot_lie_beside_its_own_and_a_scenarios_go_before_them(tmp_path):
    path = variant(tmp_path / "robot", change=lambda given: given.update(head_calibration="head.yaml"))
    head = path.with_name("head.yaml")
    head.write_bytes((resources.models() / "calibration" / "head.yaml").read_bytes())
    scenario = load(None, [f"robot={path}"])
    assert named_files.find(scenario, "head_calibration") == head
    assert named_files.find(scenario, "taught") == resources.models() / "taught" / "hands.yaml"
    assert description.load(OURS).taught == "package://valve_drake_models/taught/hands.yaml"
    other = load(None, [f"robot={path}", "head_calibration=calibration/head.yaml"])
    assert named_files.find(other, "head_calibration") == resources.models() / "calibration" / "head.yaml"


@pytest.mark.parametrize(
    ("joint", "upper", "key", "chosen", "clipped"),
    [
        ("waist", 0.3, "sweep_waist", 0.4, 0.3),
        ("neck_pitch", 1.0, "pitch_high", 1.02, 1.0),
        ("neck_pitch", 0.3, "pitches", [0.2, 0.31], [0.15, 0.3, -0.05]),
        ("neck_yaw", 1.2, "yaw_limit", 1.5, 1.2),
        ("neck_yaw", 1.2, "sweep_yaw", 1.3, 1.2),
    ],
)
def test_a_gaze_is_planned_within_the_robots_joints(tmp_path, joint, upper, key, chosen, clipped):
    """Our defaults are clipped, and a line says so; what somebody has chosen is refused."""
    path = variant(tmp_path, lambda model: put(part(model, "joint", joint), "axis/limit/upper", str(upper)))
    scenario = load(None, [f"robot={path}"])
    search, lines = gaze_of(scenario)
    assert getattr(search, key) == pytest.approx(clipped)
    assert any(line.startswith(f"valve_search.{key}: ") for line in lines)
    used = next(block for block in make_blocks(scenario) if block.get_name() == "valve_search")
    assert getattr(used.config, key) == pytest.approx(clipped)
    with pytest.raises(ConfigError, match=rf"valve_search\.{key} must be within what the robot's joint can do"):
        make_blocks(load(None, [f"robot={path}", f"valve_search.{key}={chosen}"]))


def test_a_head_that_does_not_turn_looks_where_it_is_mounted(tmp_path):
    """One line for each joint that there is not, whatever is configured; a value that was chosen is refused."""
    path = variant(tmp_path, lambda model: stiff_neck(model, 0.4), without_gaze)
    scenario = load(None, [f"robot={path}"])
    robot = Robot.load(path)
    assert robot.gaze.joints == (0, None, None) and robot.torso.names == ("waist",) and robot.groups.absent == ()
    assert robot.held(np.array([0.3])).tolist() == [0.3]
    search, lines = gaze_of(scenario)
    assert (search.pitches, search.pitch_high, search.yaw_limit, search.sweep_yaw) == ([0.0], 0.0, 0.0, 0.0)
    assert search.sweep_waist == scenario.valve_search.sweep_waist
    assert [line.split(":")[0] for line in lines] == ["gaze.tilt", "gaze.pan"]
    make_blocks(scenario)
    with pytest.raises(ConfigError, match=r"pitches must be within what the robot's joint can do, \[0, 0\]"):
        make_blocks(load(None, [f"robot={path}", "valve_search.pitches=[0.1]"]))


def test_eyes_that_nothing_turns_aside_have_to_look_ahead(tmp_path):
    def aside(model):
        stiff_neck(model, 0.4)
        pose = part(model, "link", "head").find("pose")
        pose.text = pose.text.rsplit(maxsplit=1)[0] + " 0.2"

    with pytest.raises(ConfigError, match="gaze.pan must be a joint, or the left eye has to look ahead .* 0.20 rad l"):
        Robot.load(variant(tmp_path, aside, without_gaze))


def test_a_torso_without_joints_is_a_device_that_the_robot_does_not_have(tmp_path):
    def edit(model):
        without_base_joints(model)
        stiff_neck(model, 0.6, waist=False)

    path = variant(tmp_path, edit, lambda given: (fixed(given), without_waist(given)))
    robot = Robot.load(path)
    assert robot.groups.absent == ("base", "torso") and robot.held(np.zeros(0)).shape == (0,)
    assert not any(row.key.startswith(("torso.", "base.")) for row in present(COMMANDS + REPORTS, robot.groups))
    start = "simulation.start={distance: 0.77, bearing: 0, heading: 0}"
    scenario = resolve(load(None, [f"robot={path}", start, "simulation.valve.height=1.0"]))
    diagram = make_diagram(scenario).diagram
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.05)
    station = make_station(scenario)
    context = station.CreateDefaultContext()
    assert station.GetOutputPort("torso.position_measured").Eval(context).shape == (0,)
    assert "torso" not in station.GetOutputPort("health").Eval(context).devices


def test_our_own_robot_looks_as_configured():
    assert gaze_of(load()) == (load().valve_search, [])


def test_a_grippers_effort_may_be_another_than_the_models(tmp_path):
    def stronger(given):
        given["grippers"]["left"]["effort"] = 123.0

    robot = Robot.load(variant(tmp_path, change=stronger))
    efforts = [robot.model.plant.GetJointActuatorByName(robot.grippers[side].joint).effort_limit() for side in SIDES]
    ours = ROBOT.model.plant.GetJointActuatorByName(ROBOT.grippers[RIGHT].joint).effort_limit()
    assert efforts == [123.0, ours] and ours != 123.0


def test_sizes_and_names_of_the_whole_program_follow_the_robot(tmp_path):
    robot = Robot.load(variant(tmp_path, seven_joints, with_roll))
    assert vectors(robot.groups)["left_arm.position_command"] == 7
    assert "left_arm_roll.position" in commanded(robot.groups)["left_arm.position_command"]
    system = make_diagram(resolve(load(None, [f"robot={tmp_path / 'robot.yaml'}"])))
    check_contract(system.station, robot.groups)


def test_an_arm_of_seven_joints_follows_its_commands_though_its_file_has_no_gains_for_one(tmp_path):
    """Its servo comes of its effort; upper arm and forearm, which overlap at the roll, do not push each other away."""
    variant(tmp_path, seven_joints, with_roll)
    scenario = resolve(load(None, [f"robot={tmp_path / 'robot.yaml'}"]))
    station = make_station(scenario)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    commands = initial_commands(scenario)
    for port, value in commands.items():
        station.GetInputPort(port).FixValue(context, value)
    simulator.AdvanceTo(0.5)
    moved = commands["left_arm.position_command"] + [0, 0, 0.1, 0, 0, 0, 0]
    station.GetInputPort("left_arm.position_command").FixValue(context, moved)
    simulator.AdvanceTo(1.0)
    for side, asked in ((LEFT, moved), (RIGHT, commands["right_arm.position_command"])):
        arm = station.GetOutputPort(f"{side}_arm.position_measured").Eval(context)
        np.testing.assert_allclose(arm, asked, atol=2e-3)


def test_a_run_with_a_wrong_robot_ends_at_once_and_leaves_nothing(tmp_path, capsys):
    path = variant(tmp_path / "robot", change=at("gaze.pan", "neck"))
    log = tmp_path / "log.mcap"
    assert cli.main(["run", "--set", f"robot={path}", "--log", str(log), "--no-html"]) == 2
    said = capsys.readouterr().err.strip()
    assert re.search(r"robot.yaml: gaze.pan must be a joint of the model, got 'neck'", said.replace("\n", " "))
    assert not log.exists()


def test_no_key_of_our_file_is_left_at_a_default_by_mistake():
    given = yaml_file.read(OURS)
    assert {"model", "base", "gaze", "arms", "grippers", "opening", "cameras"} <= set(given)
    assert len(OURS.read_text().splitlines()) < 80


def literals(path: Path) -> set[str]:
    """All texts of a module but its docstrings; of an f-string, the parts between its fields."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    documents = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    texts = (n for n in nodes if isinstance(n, ast.Constant) and isinstance(n.value, str))
    return {node.value for node in texts if id(node) not in documents}


def test_no_joint_or_frame_of_our_robot_is_named_in_the_program():
    """But for what robot.yaml's schema asks for (left_grip, right_grip) and the base joints that a model gets."""
    model = ElementTree.parse(description.find(description.OURS).with_name("robot.sdf"))
    names = {element.get("name") for kind in ("joint", "frame") for element in model.iter(kind)}
    devices = {f"{side}_wrist_sensor" for side in SIDES}  # of the station, whatever the robot calls them
    keys = {"waist", "base_x", "base_y", "base_yaw", "B", "H", *(f"{side}_grip" for side in SIDES)}
    ours = names - devices - keys
    assert len(ours) > 20
    parts = re.compile(r"_arm_\d|_arm_$|_finger_|_wrist_camera|head_(left|right)_camera|neck_(yaw|pitch)$")
    root = Path(description.__file__).parent.parent
    found = [
        f"{path.relative_to(root)}: {text!r}"
        for path in sorted(root.rglob("*.py"))
        for text in literals(path)
        if text in ours or (parts.search(text) and "\n" not in text and " " not in text)
    ]
    assert found == []
