"""Robots that are built otherwise than ours: their base's frame, coupled joints, arms that differ, limits off zero."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from robot_facts import ROBOT
from robot_variants import fixed, part, put, seven_joints, variant, without_base_joints

from valve_drake.checks import ConfigError
from valve_drake.collision import CollisionModel
from valve_drake.diagram import make_blocks, make_diagram
from valve_drake.frames import compose, inverse, make, planar, rot_z
from valve_drake.messages import LEFT, RIGHT, SIDES
from valve_drake.robot.robot import Robot
from valve_drake.scenario import load, resolve
from valve_drake.stations.contract import check_contract

# ---------------------------------------------------------------- the base's frame

X_LINK = make(rot_z(0.2), np.array([0.1, -0.05, -0.3]))  # where the test puts the base's frame on the root link


def off_root(given):
    given["frames"] = {"footprint": {"link": "B", "xyz": X_LINK[:, 3].tolist(), "rpy": [0.0, 0.0, 0.2]}}
    given["base"]["frame"] = "footprint"


def base_pose(robot, place=()):
    """X_WB of the model with its base's joints there."""
    plant = robot.model.plant
    context = plant.CreateDefaultContext()
    q = np.array(plant.GetPositions(context))
    q[robot.slots(robot.base.names)] = place
    plant.SetPositions(context, q)
    frame = plant.GetFrameByName(robot.description.base.frame)
    return frame.CalcPoseInWorld(context).GetAsMatrix34()


def test_added_base_joints_move_the_bases_frame_and_not_the_root(tmp_path):
    """Its odometry tells where the frame is, which stands on the floor whatever link hangs above it."""
    robot = Robot.load(variant(tmp_path, without_base_joints, off_root))
    assert base_pose(robot, [1.0, 2.0, 0.5]) == pytest.approx(planar(1.0, 2.0, 0.5))
    hand = ROBOT.forward(LEFT, np.zeros(6))
    assert robot.forward(LEFT, np.zeros(6)) == pytest.approx(compose(inverse(X_LINK), hand))


def test_a_bolted_robot_stands_with_its_bases_frame_on_the_floor(tmp_path):
    robot = Robot.load(variant(tmp_path, without_base_joints, lambda given: (fixed(given), off_root(given))))
    assert base_pose(robot) == pytest.approx(np.eye(3, 4), abs=1e-12)


def below_a_weld(model):
    """The root is a link that carries B turned and raised: a `base_link` above its `base_footprint`."""
    without_base_joints(model)
    model.append(
        ElementTree.fromstring("""<link name="chassis"><pose relative_to="B">0.1 0 0.2 0 0 0.3</pose><inertial>
        <mass>1</mass><inertia><ixx>1e-2</ixx><iyy>1e-2</iyy><izz>1e-2</izz></inertia></inertial></link>""")
    )
    model.append(
        ElementTree.fromstring('<joint name="mount" type="fixed"><parent>chassis</parent><child>B</child></joint>')
    )


def test_welds_may_lie_between_the_root_and_the_bases_frame(tmp_path):
    robot = Robot.load(variant(tmp_path, below_a_weld))
    assert base_pose(robot, [1.0, 2.0, 0.5]) == pytest.approx(planar(1.0, 2.0, 0.5))
    assert robot.forward(LEFT, np.zeros(6)) == pytest.approx(ROBOT.forward(LEFT, np.zeros(6)))


def sideways_first(model):
    put(part(model, "joint", "base_x"), "axis/xyz", "0 1 0")
    put(part(model, "joint", "base_y"), "axis/xyz", "1 0 0")


def welded_to_the_world(model):
    without_base_joints(model)
    model.append(
        ElementTree.fromstring('<joint name="bolts" type="fixed"><parent>world</parent><child>B</child></joint>')
    )


def limits(joint, low, high):
    def edit(model):
        put(part(model, "joint", joint), "axis/limit/lower", str(low))
        put(part(model, "joint", joint), "axis/limit/upper", str(high))

    return edit


def slides_for_ever(model):
    part(model, "joint", "left_arm_2").set("type", "prismatic")
    limits("left_arm_2", -1e17, 1e17)(model)


def at_zero(given):
    for name in ("home", "work"):
        given["arms"]["left"][name][3] = 0.0


WRONG = {
    "a base that goes sideways first": (
        sideways_first,
        None,
        "base.frame must be one that base_x, base_y, base_yaw move along x, along y and about z, from the world's "
        "origin, got 'B'",
    ),
    "a base's frame off what its joints move": (None, off_root, "base.frame must be one that base_x, base_y, base_yaw"),
    "a base that is welded to the world, and drives": (
        welded_to_the_world,
        None,
        "base.drive must be fixed for a model that is welded to the world",
    ),
    "an arm's joint without room": (
        limits("left_arm_4", 0, 0),
        at_zero,
        "arms.left.joints[3] must be a joint with room between its limits, [0, 0], got 'left_arm_4'",
    ),
    "a neck without room": (
        limits("neck_yaw", 0, 0),
        None,
        "gaze.pan must be a joint with room between its limits, [0, 0], got 'neck_yaw'",
    ),
    "an arm's joint that slides for ever": (
        slides_for_ever,
        None,
        "arms.left.joints[1] must be a joint with limits, since it slides, got 'left_arm_2'",
    ),
    "arms that differ, and one list of speeds": (
        seven_joints,
        lambda given: uneven(given, []),
        "arms.left.speed must be given, 7 values: arm_speed is that of arms with as many joints, got []",
    ),
    "too few speeds of one arm": (
        seven_joints,
        lambda given: uneven(given, [1.0] * 6),
        "arms.left.speed must be one value for each of 7 joints, got [",
    ),
    "one arm faster than its model": (
        seven_joints,
        lambda given: uneven(given, [1.2, 1.2, 2.6, 1, 1, 1, 1]),
        "arms.left.speed[2] must be at most 2.5, left_arm_roll's limit, got 2.6",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_no_robot_can_be_is_refused_in_one_line_that_names_the_key(tmp_path, case):
    edit, change, words = WRONG[case]
    path = variant(tmp_path, edit or (lambda model: None), change or (lambda given: None))
    with pytest.raises(ConfigError) as error:
        Robot.load(path)
    line = str(error.value)
    assert words in line and line.startswith(str(path)) and "\n" not in line


# ---------------------------------------------------------------- arms that differ


def uneven(given, speed):
    """The left arm has seven joints, the right one six."""
    left = given["arms"]["left"]
    left["joints"].insert(2, "left_arm_roll")
    for name in ("home", "work"):
        left[name].insert(2, 0.0)
    left["speed"] = speed
    given["weld"] = ["right_arm_roll"]
    given["collision"] = {"ignore": "touching_at_home"}


def test_two_arms_of_different_numbers_of_joints_make_one_system(tmp_path):
    path = variant(tmp_path, seven_joints, lambda given: uneven(given, [1.0] * 7))
    robot = Robot.load(path)
    assert [len(robot.arms[side]) for side in SIDES] == [7, 6] and len(robot.home) == 13
    assert robot.arms[LEFT].speed.tolist() == [1.0] * 7
    assert robot.arms[RIGHT].speed.tolist() == ROBOT.arms[RIGHT].speed.tolist()
    for side in SIDES:
        X = robot.forward(side, robot.arms[side].work)
        q = robot.inverse(side, X)
        assert q is not None and robot.forward(side, q) == pytest.approx(X, abs=1e-5)
    system = make_diagram(resolve(load(None, [f"robot={path}"])))
    check_contract(system.station, robot.groups)


# ---------------------------------------------------------------- joints that follow others


def link(name):
    return ElementTree.fromstring(f"""<link name="{name}"><inertial><mass>1</mass>
        <inertia><ixx>1e-2</ixx><iyy>1e-2</iyy><izz>1e-2</izz></inertia></inertial></link>""")


def stage(name, parent, child, mimic=""):
    return ElementTree.fromstring(f"""<joint name="{name}" type="prismatic"><parent>{parent}</parent>
        <child>{child}</child><axis><xyz>0 0 1</xyz>{mimic}<limit><lower>0</lower><upper>0.3</upper>
        <effort>5000</effort><velocity>0.3</velocity></limit></axis></joint>""")


def telescope(model):
    """A lift of three stages below the waist: the second follows the first, the third the second."""
    waist = part(model, "joint", "waist")
    below = waist.findtext("parent")
    for k in (1, 2, 3):
        model.append(link(f"stage_{k}"))
        mimic = f'<mimic joint="lift_{k - 1}"><multiplier>0.5</multiplier><offset>0</offset></mimic>' if k > 1 else ""
        model.append(stage(f"lift_{k}", below if k == 1 else f"stage_{k - 1}", f"stage_{k}", mimic))
    put(waist, "parent", "stage_3")


def with_lift(given):
    given["lift"] = {"joints": ["lift_1"], "home": [0.0], "speed": [0.2]}


def test_a_telescope_lifts_hands_eyes_and_shapes_with_all_its_stages(tmp_path):
    robot = Robot.load(variant(tmp_path, telescope, with_lift))
    up, rise = np.array([0.2, 0.0]), np.array([0.0, 0.0, 0.35])  # 0.2 + 0.1 + 0.05
    for side in SIDES:
        work = robot.arms[side].work
        low, high = (robot.forward(side, work, posture)[:, 3] for posture in (None, up))
        assert high - low == pytest.approx(rise)
        found = robot.inverse(side, robot.forward(side, work, up), work, up)
        assert found == pytest.approx(work, abs=1e-5)
    eyes = [robot.X_BL(np.array([lift, 0.0, 0.0, 0.0]))[:, 3] for lift in (0.0, 0.2)]
    assert eyes[1] - eyes[0] == pytest.approx(rise)
    named = robot.named(torso=np.array([0.2, 0.0, 0.0, 0.0]))
    assert [named[f"lift_{k}"] for k in (1, 2, 3)] == pytest.approx([0.2, 0.1, 0.05])
    model = CollisionModel(robot)
    model.is_free(None, robot.home, up)
    place = model._plant.GetFrameByName("left_grip").CalcPoseInWorld(model._context).translation()
    assert place == pytest.approx(robot.forward(LEFT, robot.arms[LEFT].home, up)[:, 3])


def coupled(model):
    """A roll in each upper arm that follows the shoulder."""
    seven_joints(model)
    for side in SIDES:
        mimic = f'<mimic joint="{side}_arm_2"><multiplier>-0.5</multiplier><offset>0.1</offset></mimic>'
        axis = part(model, "joint", f"{side}_arm_roll").find("axis")
        assert axis is not None
        axis.append(ElementTree.fromstring(mimic))


def test_an_arms_jacobian_has_the_joints_in_it_that_follow_its_own(tmp_path):
    change = {"collision": {"ignore": "touching_at_home"}}
    robot = Robot.load(variant(tmp_path, coupled, lambda given: given.update(change)))
    q, step = robot.arms[LEFT].work, 1e-6
    J = robot.jacobian(LEFT, q)
    for k, one in enumerate(np.eye(6)):
        there, back = (robot.forward(LEFT, q + sign * step * one)[:, 3] for sign in (1, -1))
        assert J[3:, k] == pytest.approx((there - back) / (2 * step), abs=1e-6)
    plant = robot.model.plant
    context = plant.CreateDefaultContext()
    for name, value in robot.named(arms={LEFT: q}).items():
        plant.GetJointByName(name).set_angle(context, value)
    X = plant.GetFrameByName("left_grip").CalcPoseInWorld(context).GetAsMatrix34()
    assert robot.forward(LEFT, q) == pytest.approx(X)
    assert plant.GetJointByName("left_arm_roll").get_angle(context) == pytest.approx(0.1 - 0.5 * q[1])


# ---------------------------------------------------------------- limits off zero


@pytest.mark.parametrize(
    ("joint", "low", "high", "place", "home"),
    [("waist", 0.1, 0.5, 0, 0.1), ("neck_pitch", 0.1, 1.0, 1, 0.1), ("neck_yaw", -1.0, -0.2, 2, -0.2)],
)
def test_a_joint_of_the_torso_that_cannot_be_zero_is_at_home_where_it_is_nearest(
    tmp_path, joint, low, high, place, home
):
    robot = Robot.load(variant(tmp_path, limits(joint, low, high)))
    assert robot.torso.home[place] == home and robot.torso.within(robot.torso.home)


def test_a_waist_that_turns_to_one_side_only_takes_no_part_in_the_sweep(tmp_path):
    path = variant(tmp_path, limits("waist", 0.0, 0.5))
    search = next(b for b in make_blocks(load(None, [f"robot={path}"])) if b.get_name() == "valve_search")
    assert search.config.sweep_waist == 0.0


def test_the_seventh_joint_of_an_arm_may_be_stuck_in_a_rehearsal(tmp_path):
    path = variant(tmp_path, seven_joints, lambda given: uneven(given, [1.0] * 7))
    stuck = "faults=[{kind: stuck, device: left_arm, joint: 6}]"
    assert load("hardware.scenario.yaml", [f"robot={path}", stuck]).faults[0].joint == 6
