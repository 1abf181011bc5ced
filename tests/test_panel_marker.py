"""A marker on the panel: its pose is measured by the rectangle, the valve's angle by the green marks."""

import dataclasses as dc
import math
import pathlib

import numpy as np
import pytest
from drawn_scene import edge_points, facing
from helpers import Rig
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from robot_facts import ROBOT

from valve_drake import frames
from valve_drake import scenario as scenarios
from valve_drake.behaviors.kinematic_approach import KinematicApproach, KinematicApproachConfig
from valve_drake.camera.lens import load_head
from valve_drake.messages import GraspPlan, ModeState, RectangleEstimate, RobotState, TurnState
from valve_drake.perception.ambiguity import Track
from valve_drake.perception.fusion import fuse
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, estimate
from valve_drake.perception.rectangle_estimator_system import RectangleEstimatorSystem
from valve_drake.recording.robot_frames import RobotFrames
from valve_drake.robot import description
from valve_drake.robot.robot import Robot
from valve_drake.valve.model import add_valve, marker_frame
from valve_drake.valve.valve import Valve, angle_turned, turned

HEAD = load_head(pathlib.Path(__file__).parents[1] / "models" / "calibration" / "head.yaml")
CONFIG = RectangleEstimatorConfig(side_bias=0.0)  # synthetic points have no bias
BAR = "{xyz: [0.15, 0, 0]}, {xyz: [-0.15, 0, 0]}"
UNEVEN = "{xyz: [0.15, 0, 0]}, {xyz: [-0.075, 0.13, 0]}, {xyz: [0, -0.12, 0]}"


def valve(handles: str = BAR, marker: str = "xyz: [0, -0.225, 0.085]") -> Valve:
    text = f"valve: {{model: '', marker: {{carrier: panel, size: [0.06, 0.06], {marker}}}, handles: [{handles}]}}"
    scenario = scenarios.parse(text, "a file")
    scenario.check()
    return scenario.valve


def look(shape: Valve, X_LV, angle, track=None, *, first=0) -> RectangleEstimate:
    """What is found of the marker at X_LV, the valve turned by `angle`, with a plant beside it."""
    marker = shape.target()
    X_LA = turned(frames.compose(X_LV, shape.X_VA()), angle)
    edges, quads = edge_points(X_LV, HEAD, marker, 0.05, first=first), []
    for quad, X_CL in ((edges.left, np.eye(3, 4)), (edges.right, frames.inverse(HEAD.X_LR))):
        up = [0, 0, -shape.marker.mark_height]
        P = frames.apply(frames.compose(X_CL, X_LA), np.array([np.add(h.xyz, up) for h in shape.handles]))
        spots = np.vstack([P[:, :2] / P[:, 2:], [[0.21, -0.2]]])
        quads.append(dc.replace(quad, green=spots))
    return estimate(dc.replace(edges, left=quads[0], right=quads[1]), HEAD, marker, CONFIG, track)


@pytest.mark.parametrize("angle", [-2.8, -1.0, 0.0, 0.7, 1.5, 3.0])
def test_the_marks_tell_the_angle_wherever_on_their_circles_they_are(angle):
    shape = valve(UNEVEN)
    for X in (facing(2.0, 0.2, 0.3, 0.05, 0.0, -0.1), facing(1.1, -0.1, 0.35, -0.1, 0.0, -0.12)):
        found = look(shape, X, angle)
        assert found.found and found.angle_seen and found.axis_known
        assert found.X_LV == pytest.approx(X, abs=1e-6)  # the marker has not turned
        assert math.cos(found.angle - angle) == pytest.approx(1.0, abs=1e-9)
        assert 0 < found.angle_sigma < 0.02


def test_a_bar_that_looks_the_same_after_half_a_turn_is_followed_from_image_to_image():
    shape, X = valve(), facing(1.3, -0.1, 0.35, 0.0, 0.0, -0.16)
    angle, track = 0.0, None
    for true in np.arange(0.0, 7.0, 0.5):
        found = look(shape, X, true, track)
        angle, track = found.angle, Track(found.X_LV, found.axis_known, found.angle)
        assert angle == pytest.approx(true, abs=1e-6)
    assert shape.repeats(True) == pytest.approx(math.pi)
    assert valve(UNEVEN).repeats(False) == pytest.approx(2 * math.pi)
    even = "{xyz: [0.15, 0, 0]}, {xyz: [-0.075, 0.1299, 0]}, {xyz: [-0.075, -0.1299, 0]}"
    assert valve(even).repeats(True) == pytest.approx(2 * math.pi / 3)


def test_a_marker_that_stands_still_is_known_again_after_a_long_gap():
    shape, X = valve(), facing(1.3, 0.1, 0.35, 0.0, 0.0, -0.12)
    marker, edges = shape.target(), edge_points(X, HEAD, shape.target(), 0.05)
    P = frames.apply(X, marker.marks)
    seen = dc.replace(edges, left=dc.replace(edges.left, green=P[:, :2] / P[:, 2:]))
    block = RectangleEstimatorSystem(CONFIG, HEAD, lambda base, torso: np.eye(3, 4), marker)
    dut = Rig(block, edges=dc.replace(seen, sequence=0, time=0.0), robot_state=RobotState(), mode=ModeState())
    assert dut.run(0.1).read("estimate").axis_known
    again = edge_points(X, HEAD, marker, 0.05, first=1)  # a corner later, and no mark
    dut.fix(edges=dc.replace(again, sequence=1, time=60.0))
    found = dut.run(0.3).read("estimate")
    assert found.axis_known and found.X_LV == pytest.approx(X, abs=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 0.5 * math.pi, -0.5 * math.pi, 3.0])
def test_the_side_on_which_the_marks_turn_tells_the_axes_of_the_marker(yaw):
    shape = valve(marker=f"xyz: [0, -0.225, 0.085], rpy: [0, 0, {yaw}]")
    X = frames.compose(facing(1.3, 0.1, 0.35, 0.0, 0.0, -0.12), frames.make(frames.rot_z(yaw), np.zeros(3)))
    for first in range(4):
        found = look(shape, X, 0.4, first=first)
        assert found.axis_known and found.X_LV == pytest.approx(X, abs=1e-6)
        assert found.angle == pytest.approx(0.4, abs=1e-6)


def test_a_mark_that_the_image_cuts_off_does_not_count_and_none_is_no_angle():
    shape = valve()
    marker = shape.target()
    for room, seen in ((60.0, True), (10.0, False)):  # a mark is 39 px long here
        X = frames.make(np.eye(3), np.array([0.0, -0.12, 1.1]))
        at_border = HEAD.left.normalize(np.array([[639.0 - room, 300.0]]))[0, 0]
        mark = marker.marks[0]
        X[0, 3] = at_border * (X[2, 3] + mark[2]) - mark[0]
        P = X[:, 3] + mark
        edges = edge_points(X, HEAD, marker, 0.05)
        found = estimate(dc.replace(edges, left=dc.replace(edges.left, green=P[None, :2] / P[2])), HEAD, marker, CONFIG)
        assert found.found and found.angle_seen == seen
    assert not shape.seen_by(found) and Valve().seen_by(found)
    assert shape.seen_by(look(shape, facing(1.1, -0.1, 0.35, 0.0, 0.0, -0.12), 0.2))


@pytest.mark.parametrize(
    "angle, room, seen", [(0.0, 15.0, True), (0.0, 7.0, False), (0.5, 15.0, False), (0.5, 24.0, True)]
)
def test_a_mark_near_the_border_counts_as_long_as_it_is_whole_whichever_way_it_lies(angle, room, seen):
    """A mark is 39 px long here and 21 high: of a level bar it ends 11 px below its middle."""
    shape = valve()
    marker = shape.target()
    X = frames.make(np.eye(3), np.array([-0.1, -0.12, 1.1]))
    p = marker.marks[0]
    axis = shape.X_VA()
    mark = frames.apply(frames.compose(axis, frames.make(frames.rot_z(-angle), np.zeros(3)), frames.inverse(axis)), p)
    at_border = HEAD.left.normalize(np.array([[320.0, 479.0 - room]]))[0, 1]
    X[1, 3] = at_border * (X[2, 3] + mark[2]) - mark[1]
    P = X[:, 3] + mark
    edges = edge_points(X, HEAD, marker, 0.05)
    found = estimate(dc.replace(edges, left=dc.replace(edges.left, green=P[None, :2] / P[2])), HEAD, marker, CONFIG)
    assert found.found and found.angle_seen == seen
    assert not seen or math.sin(found.angle - angle) == pytest.approx(0.0, abs=1e-6)


def test_the_axis_turns_by_the_marks_angle_and_looks_are_fused_so():
    shape, X = valve(), frames.make(np.eye(3), np.array([0.0, 0.0, 1.0]))
    assert angle_turned(shape.place(X, 0.0), shape.place(X, 0.6)) == pytest.approx(0.6)
    assert Valve().place(X, 0.6) == pytest.approx(frames.compose(X, Valve().X_VA()))
    one = RectangleEstimate(found=True, X_LV=X, covariance=1e-6 * np.eye(6), angle_seen=True, angle_sigma=0.003)
    looks = [dc.replace(one, angle=a) for a in (0.301, 0.300, 0.299, 0.302, 0.9)]  # the last took another mark
    assert fuse(looks).angle == pytest.approx(0.3005, abs=1e-9)
    assert fuse([dc.replace(one, angle=5.0, angle_seen=False)]).angle == 0.0


def test_a_spot_that_is_no_mark_does_not_turn_the_axes_of_a_marker_that_stands_still():
    shape, X = valve(), facing(1.3, 0.1, 0.35, 0.0, 0.0, -0.12)
    marker, edges = shape.target(), edge_points(X, HEAD, shape.target(), 0.05)
    aside = frames.compose(X, frames.make(frames.rot_z(np.pi / 2), np.zeros(3)), shape.X_VA())  # as if it were turned
    P = frames.apply(aside, np.array([[0.15, 0.0, -0.013]]))
    spot = dc.replace(edges, left=dc.replace(edges.left, green=P[:, :2] / P[:, 2:]))
    assert estimate(spot, HEAD, marker, CONFIG).X_LV[:, 0] @ X[:, 0] < 0.1
    found = estimate(spot, HEAD, marker, CONFIG, Track(X, axis_known=True))
    assert found.axis_known and found.X_LV == pytest.approx(X, abs=1e-6)


def test_the_head_looks_between_marker_and_axis():
    look = valve().look()
    assert np.linalg.norm(look) == pytest.approx(0.12) and look / 0.12 == pytest.approx(
        np.array([0.0, 0.225, -0.085]) / math.hypot(0.225, 0.085)
    )
    assert Valve().look() is None
    assert valve().target().reach() == pytest.approx((0.225 + 0.15) / 0.06)


def test_its_frame_and_picture_do_not_turn_with_the_wheel():
    shape = valve()
    plant, _ = AddMultibodyPlantSceneGraph(DiagramBuilder(), 0.01)
    model = add_valve(plant, shape)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    poses = []
    for angle in (0.0, 1.0):
        plant.GetJointByName("stem", model).set_angle(context, angle)
        axis, marker = plant.GetFrameByName("valve_axis", model), marker_frame(plant, model)
        poses.append(plant.CalcRelativeTransform(context, axis, marker).GetAsMatrix34())
    expected = frames.compose(frames.inverse(shape.X_AP()), shape.X_AV())
    assert poses[0] == pytest.approx(expected) and poses[1] == pytest.approx(expected)


def test_the_log_shows_it_with_the_panel_and_the_wheel_as_the_hands_turned_it():
    shape = valve()
    show = RobotFrames(Robot.load(description.find(description.OURS), shape), HEAD)
    X_OL = frames.make(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.0, 0.0, 1.4]))
    X_LV = frames.make(np.eye(3), np.array([0.0, 0.3, 0.8]))
    estimate = RectangleEstimate(found=True, X_LV=X_LV, X_OL=X_OL, angle=0.3, angle_seen=True)
    X_OV = frames.compose(X_OL, X_LV)
    state = RobotState(torso=np.zeros(3), left_arm=np.zeros(6), right_arm=np.zeros(6))
    plan = GraspPlan(number=1, found=True, X_BA=shape.place(X_OV, 0.3))
    for turn, angle in ((TurnState(), 0.3), (TurnState(number=1, angle=0.5), 0.8)):
        found = {child: X for _, child, X in show(state, estimate, plan, turn)}
        assert found["marker"] == pytest.approx(X_OV)
        assert found["valve::panel"] == pytest.approx(frames.compose(X_OV, shape.X_VA(), shape.X_AP()))
        assert found["valve::wheel"] == pytest.approx(frames.compose(shape.place(X_OV, angle), shape.X_AP()))


def test_the_turn_is_counted_by_the_marks_and_the_hands_tell_what_looks_the_same():
    X_OA = frames.make(np.eye(3), np.array([2.0, 0.0, 1.0]))
    for handles, off in ((BAR, 1.4), (UNEVEN, 3.0)):
        law = KinematicApproach(KinematicApproachConfig(), ROBOT, valve(handles), {"left": 1.0, "right": 1.0})
        for true in (0.3, 2.0, 6.0, 12.5):
            seen = law.seen_angle(X_OA, turned(X_OA, true), False, true + off)
            assert seen == pytest.approx(true)
