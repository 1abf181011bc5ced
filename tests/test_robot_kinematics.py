"""Kinematics of any arm: our six joints, seven with one to spare, and a wrist whose axes do not meet."""

import copy

import numpy as np
import pytest
from robot_facts import ROBOT
from robot_variants import crooked_wrist, seven_joints, variant, with_roll

from valve_drake.frames import compose, make, rot_x, rotation, rotation_vector
from valve_drake.messages import LEFT, RIGHT, SIDES
from valve_drake.robot import kinematics
from valve_drake.robot.kinematics import Arm
from valve_drake.robot.robot import Robot
from valve_drake.valve.valve import Valve, turned

FACING = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # R_BV of a valve straight ahead
CLOSE = 1e-6  # of a pose [rad, m]


@pytest.fixture(scope="module", params=["ours", "seven joints", "crooked wrist"])
def robot(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    if request.param == "seven joints":
        return Robot.load(variant(folder, seven_joints, with_roll))
    return Robot.load(variant(folder, crooked_wrist)) if request.param == "crooked wrist" else ROBOT


def poses(robot: Robot, count: int, least: float = 0.2):
    """Side and joints of poses that are no worse than a margin, from all over the arms' limits."""
    rng = np.random.default_rng(3)
    while count:
        side = SIDES[count % 2]
        arm = robot.arms[side]
        q = arm.low + (arm.high - arm.low) * rng.uniform(0.05, 0.95, len(arm))
        if robot.margin(side, q) > least:
            yield side, q
            count -= 1


def off(X: np.ndarray, Y: np.ndarray) -> float:
    """The largest of rotation [rad] and distance [m] between two poses."""
    return max(np.linalg.norm(rotation_vector(X[:, :3].T @ Y[:, :3])), np.linalg.norm(X[:, 3] - Y[:, 3]))


def test_a_neighbours_inverse_is_the_pose_asked_for_within_the_limits_and_near_it(robot):
    rng = np.random.default_rng(0)
    for side, q in poses(robot, 60):
        near = q + rng.uniform(-0.05, 0.05, len(q))
        X = robot.forward(side, q)
        found = robot.inverse(side, X, near)
        assert found is not None and robot.arms[side].within(found)
        assert off(robot.forward(side, found), X) < CLOSE
        assert np.abs(found - near).max() < 0.4


def test_nearly_every_pose_is_found_without_a_neighbour(robot):
    cases = list(poses(robot, 60))
    found = [robot.inverse(side, robot.forward(side, q)) for side, q in cases]
    assert sum(q is not None for q in found) >= 0.93 * len(cases)
    for (side, wanted), q in zip(cases, found):
        if q is not None:
            assert robot.arms[side].within(q) and off(robot.forward(side, q), robot.forward(side, wanted)) < CLOSE


def test_the_jacobian_is_the_derivative_of_the_pose(robot):
    h = 1e-6
    for side, q in poses(robot, 6):
        J = robot.jacobian(side, q)
        for k in range(len(q)):
            X0, X1 = (robot.forward(side, q + s * h * np.eye(len(q))[k]) for s in (-1, 1))
            w = rotation_vector(X1[:, :3] @ X0[:, :3].T) / (2 * h)
            assert [*w, *(X1[:, 3] - X0[:, 3]) / (2 * h)] == pytest.approx(J[:, k], abs=1e-8)


def test_along_a_turn_the_joints_move_in_small_steps(robot):
    X_BA, valve = make(FACING @ rot_x(0.05), np.array([0.68, 0.0, 1.0])), Valve()
    for side in SIDES:
        handle = next(k for k, one in enumerate(valve.handles) if (one.xyz[0] < 0) == (side == LEFT))
        X_AG = valve.grasp(handle, 1.0 if side == LEFT else -1.0)
        q = robot.inverse(side, compose(X_BA, X_AG))
        assert q is not None
        for angle in np.linspace(0, np.pi / 2, 200)[1:]:
            X = compose(turned(X_BA, angle), X_AG)
            new = robot.inverse(side, X, q)
            assert new is not None and np.abs(new - q).max() < 0.06 and off(robot.forward(side, new), X) < CLOSE
            q = new
        assert robot.margin(side, q) > 0.1


def test_what_is_out_of_reach_or_no_number_has_no_inverse(robot):
    for side in SIDES:
        q = robot.arms[side].work
        X = robot.forward(side, q)
        far = make(X[:, :3], X[:, 3] + [1.5, 0, 0])
        assert robot.inverse(side, far) is None
        assert robot.inverse(side, far, q) is None
        assert robot.inverse(side, np.full((3, 4), np.nan)) is None
        assert robot.inverse(side, X, np.full(len(q), np.nan)) is None


def test_answers_depend_on_the_question_alone(robot):
    """The same bits, whatever was asked in between: of the other arm, of another posture, of nothing there is."""
    side, q = next(poses(robot, 1))
    X = robot.forward(side, q)

    def ask():
        found = robot.inverse(side, X, q + 0.02)
        return [
            robot.forward(side, q).tobytes(),
            robot.jacobian(side, q).tobytes(),
            None if found is None else found.tobytes(),
            robot.margin(side, q),
            robot.X_BL(robot.torso.home).tobytes(),
        ]

    first = ask()
    robot.forward(RIGHT, robot.arms[RIGHT].home, np.array([0.4]))
    robot.X_BL(np.array([0.3, 0.2, 0.1]))
    robot.inverse(LEFT, np.full((3, 4), np.nan))
    robot.inverse(LEFT, make(np.eye(3), np.array([0.0, 0, 9])))
    assert ask() == first
    assert copy.deepcopy(robot) is robot


def test_the_margin_falls_to_zero_at_a_limit_and_below_it_beyond(robot):
    for side in SIDES:
        arm = robot.arms[side]
        assert robot.margin(side, arm.work) > 0.5
        for k in range(len(arm)):
            for limit, inwards in ((arm.low, 1), (arm.high, -1)):
                q = arm.work.copy()
                q[k] = limit[k]
                assert robot.margin(side, q) <= 1e-9
                q[k] = limit[k] - inwards * 0.05
                assert robot.margin(side, q) < 0
        if len(arm) > 6:
            continue  # its joint to spare helps out
        q = arm.work.copy()
        q[-3:] = 0.0  # a straight wrist: its first and its last axis are one
        assert robot.margin(side, q) < 0.35 * robot.margin(side, arm.work)


def test_a_joint_to_spare_is_drawn_to_the_working_posture(tmp_path):
    robot = Robot.load(variant(tmp_path, seven_joints, with_roll))
    arm = robot.arms[LEFT]
    X = robot.forward(LEFT, arm.work)
    q = robot.inverse(LEFT, X, arm.work)
    away = arm.work + 0.5 * np.linalg.svd(robot.jacobian(LEFT, q))[2][-1]  # along the arm's own free motion
    start = robot.inverse(LEFT, X, away)
    before = np.abs(start - arm.work).max()
    assert before > 0.1
    q = start
    for k in range(400):  # the hand sways a little
        q = robot.inverse(LEFT, make(X[:, :3], X[:, 3] + [0, 0.02 * np.sin(0.2 * k), 0]), q)
    assert np.abs(robot.inverse(LEFT, X, q) - arm.work).max() < 0.6 * before


def test_a_continuous_joint_costs_no_margin():
    arm = kinematics.Arm(("a",), np.array([-np.inf]), np.array([np.inf]), np.ones(1), np.zeros(1), np.zeros(1))
    assert kinematics.margin(np.array([50.0]), np.ones((6, 1)) * 0, arm) < 0  # singular, and a number
    J = np.eye(6)
    six = kinematics.Arm(("a",) * 6, np.full(6, -np.inf), np.full(6, np.inf), np.ones(6), np.zeros(6), np.zeros(6))
    assert kinematics.margin(np.full(6, 50.0), J, six) == 1.0


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.05, 0.2, 3.0])
def test_the_error_between_poses_is_the_motion_that_leads_from_one_to_the_other(angle):
    w = angle * np.array([0.6, -0.8, 0.0])
    X = make(rotation(np.array([0.3, 0.2, -0.4])), np.array([1.0, 2, 3]))
    goal = make(rotation(w) @ X[:, :3], X[:, 3] + [0.1, 0, -0.2])
    assert kinematics.pose_error(X, goal) == pytest.approx([*w, 0.1, 0, -0.2], abs=1e-7 * (1 + angle))


def test_a_search_begins_all_over_the_range_of_a_joint_whose_limits_are_off_zero():
    low, high = np.array([3.5, -6.0, 0.8, -np.inf, 2.0, -2.0]), np.array([6.0, -3.5, 5.4, np.inf, np.inf, 2.0])
    arm = Arm(("a", "b", "c", "d", "e", "f"), low, high, np.ones(6), np.clip(0.0, low, high), np.clip(0.0, low, high))
    tried = np.array(kinematics.seeds(arm))
    assert (tried >= low).all() and (tried <= high).all()
    wide = np.array([2.5, 2.5, 4.6, 2 * np.pi, 2 * np.pi, 4.0])
    assert (np.ptp(tried, axis=0) > 0.5 * wide).all() and (np.ptp(tried, axis=0) <= wide).all()
