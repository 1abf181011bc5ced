"""The marker's pose from its edges: what is refused, what the covariance covers, whole images, and the block."""

import dataclasses as dc
import pathlib

import numpy as np
import pytest
from drawn_scene import (
    Drawing,
    draw_valve,
    edge_points,
    facing,
    nees,
    off_the_epipolar_line,
    pose_error,
    with_information,
)
from helpers import Rig, ports, same

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.checks import ConfigError
from valve_drake.messages import MarkerEdges, ModeState, QuadEdges, RobotState
from valve_drake.perception import estimate_rectangle
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import epipolar_offset
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, Track, estimate
from valve_drake.perception.rectangle_estimator_system import RectangleEstimatorSystem

ROOT = pathlib.Path(__file__).parents[1]
HEAD = load_head(ROOT / "models" / "calibration" / "head.yaml")
MARKER = Marker()
CONFIG = RectangleEstimatorConfig(side_bias=0.0)  # synthetic points have no bias
PAPER = dc.replace(CONFIG, method="paper")
POSES = [facing(0.5, 0.3, 0.2, 0.3, 0.02, 0.03), facing(1.0, -0.4, 0.1, -0.5), facing(2.0, 0.35, 0.3, 0.6, -0.2, 0.1)]


def test_points_are_not_believed_better_than_min_sigma_with_their_information_either():
    edges = with_information(edge_points(POSES[1], HEAD, MARKER, 0.02))
    plain, careful = (
        estimate(edges, HEAD, MARKER, dc.replace(CONFIG, min_sigma=s), Track(POSES[1])) for s in (0.01, 0.04)
    )
    np.testing.assert_allclose(careful.covariance, 4 * plain.covariance, rtol=0.02)


@pytest.mark.parametrize("told", ["points", "information", "information of one"])
@pytest.mark.parametrize("method", ["refined", "paper"])
@pytest.mark.parametrize("px", [-2.0, 0.02, 0.3, 1.0, 2.0, 3.0, 3.9, 5.0])
def test_a_right_image_that_lies_lower_is_within_the_covariance_or_refused_with_its_size(told, method, px):
    X = facing(1.0, 0.0, 0.02, 0.0, -0.25, 0.1)
    edges = edge_points(X, HEAD, MARKER, 0.03, np.random.default_rng(0))
    informed = with_information(edges)
    edges = {"points": edges, "information": informed}.get(told, dc.replace(informed, left=edges.left))
    config = dc.replace(CONFIG, method=method, max_residual=1.2)
    found = estimate(off_the_epipolar_line(edges, px, HEAD), HEAD, MARKER, config, Track(X))
    if found.found:
        assert abs(px) < 4
        assert (np.linalg.eigvalsh(found.covariance) > 0).all()
        assert (np.abs(pose_error(found.X_LV, X)) < 4 * np.sqrt(np.diag(found.covariance))).all()
        assert abs(pose_error(found.X_LV, X)[4]) < 0.01
    else:
        assert abs(px) > 1 and found.reason == f"epipolar: {abs(px):.1f} px"


def test_an_oblique_marker_near_converging_cameras_is_on_its_epipolar_line():
    """The mean of the corners is not the image of the centre: here it is 2 px off."""
    X = facing(0.3, 0.1, 0.75, 0.6)
    eyes = dc.replace(HEAD, X_LR=frames.make(frames.rot_y(-0.36), HEAD.X_LR[:, 3]))
    for k in range(4):
        edges = edge_points(frames.compose(X, frames.make(frames.rot_z(k * 0.7), np.zeros(3))), eyes, MARKER, 0.05)
        off = epipolar_offset(edges.left.corners, edges.right.corners, eyes.X_LR)
        assert np.linalg.norm(off) * HEAD.right.focal() < 1e-6


def test_edges_that_determine_no_pose_are_refused():
    edges = with_information(edge_points(POSES[1], HEAD, MARKER, 0.05))
    nothing = np.zeros((8, 8))
    nothing[0, 0] = 1.0
    one = dc.replace(edges, left=dc.replace(edges.left, information=nothing), right=QuadEdges(reason="not used"))
    found = estimate(one, HEAD, MARKER, CONFIG)
    assert not found.found and found.reason == "the sides do not determine a pose"


@pytest.mark.parametrize(
    ("X", "marker", "says"),
    [
        (facing(0.2, 0.2), MARKER, "distance"),
        (facing(7.0, 0.2), MARKER, "distance"),
        (facing(1.0, np.radians(80)), MARKER, "tilt"),
        (facing(1.0, 0.2), Marker.of([0.2, 0.2], 0.3), "size|residual"),
    ],
)
def test_implausible_pose_is_refused(X, marker, says):
    # The edges are those of MARKER; the last estimator believes in a larger one.
    found = estimate(edge_points(X, HEAD, MARKER, 0.05), HEAD, marker, dc.replace(CONFIG, max_distance=6.0))
    assert not found.found and any(word in found.reason for word in says.split("|"))


def test_no_edges_no_pose():
    edges = MarkerEdges(left=QuadEdges(reason="no candidate in the left image"))
    found = estimate(edges, HEAD, MARKER, CONFIG)
    assert not found.found and found.reason == "no candidate in the left image"


def test_sides_in_disorder_are_refused():
    edges = edge_points(POSES[0], HEAD, MARKER, 0.05)
    twisted = dc.replace(edges.left, side=np.array([0, 2, 1, 3])[edges.left.side.astype(int)])
    assert not estimate(dc.replace(edges, left=twisted), HEAD, MARKER, CONFIG).found
    lacking = dc.replace(edges.left, side=np.minimum(edges.left.side, 2))
    assert not estimate(dc.replace(edges, left=lacking), HEAD, MARKER, CONFIG).found


def images(X_LV, rng, noise=2.0):
    out = []
    for lens, X_CL in ((HEAD.left, np.eye(3, 4)), (HEAD.right, frames.inverse(HEAD.X_LR))):
        drawing = Drawing(lens)
        draw_valve(drawing, frames.compose(X_CL, X_LV), MARKER)
        out.append(drawing.finish(rng, noise=noise))
    return out


@pytest.mark.parametrize(("z", "degrees", "mm"), [(0.8, 0.05, 0.1), (1.0, 0.1, 0.2), (2.0, 0.3, 1.0), (4.0, 1.0, 8.0)])
def test_pose_from_drawn_images(z, degrees, mm):
    rng = np.random.default_rng(0)
    for roll in (0.3, -0.9):
        X = facing(z, 0.3, -0.25, roll, 0.03 * z, 0.03 * z)
        found = estimate_rectangle(*images(X, rng), HEAD)
        assert found.found and found.axis_known and found.cameras == 2, found.reason
        error = pose_error(found.X_LV, X)
        assert np.degrees(np.linalg.norm(error[:3])) < degrees
        assert 1000 * np.linalg.norm(error[3:]) < mm
        assert nees(error, found.covariance) < 5
        assert found.corners_left.shape == found.corners_right.shape == (4, 2)


@pytest.mark.parametrize("degrees", [66, 70])
def test_a_marker_at_the_edge_of_what_is_drawn_is_measured(degrees):
    # The base starts up to 60 deg aside of a panel that leans by up to 10 deg, and looks down on it.
    rng = np.random.default_rng(1)
    X = facing(1.9, np.radians(degrees), -0.1, 0.1, 0.03, 0.1)
    found = estimate_rectangle(*images(X, rng), HEAD)
    assert found.found, found.reason
    error = pose_error(found.X_LV, X)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.3 and 1000 * np.linalg.norm(error[3:]) < 3


def test_one_image_and_the_paper_method_work_too():
    X = facing(0.8, 0.3, -0.25, 0.3)
    left, right = images(X, np.random.default_rng(0))
    alone = estimate_rectangle(left, None, HEAD)
    left[0, 0] = left[0, 0]  # the caller's images stay the caller's
    assert alone.found and alone.cameras == 1
    assert np.degrees(np.linalg.norm(pose_error(alone.X_LV, X)[:3])) < 0.3
    paper = estimate_rectangle(left, right, HEAD, method="paper")
    assert paper.found and paper.method == "paper"
    assert 1000 * np.linalg.norm(pose_error(paper.X_LV, X)[3:]) < 8


def test_bad_arguments_are_refused():
    image = np.zeros((480, 640, 3), np.uint8)
    with pytest.raises(ConfigError, match="rectangle_estimator.method"):
        estimate_rectangle(image, image, HEAD, method="magic")
    with pytest.raises(ConfigError, match="marker.size"):
        estimate_rectangle(image, image, HEAD, (0.0, 0.1))
    with pytest.raises(ValueError, match="640 x 480"):
        estimate_rectangle(image[:100], image, HEAD)
    with pytest.raises(ConfigError, match="rectangle_estimator.loss_width"):
        dc.replace(CONFIG, loss_width=0.0).check()


def head_pose(odometry, torso):
    return frames.planar(*odometry)


def rig(edges, mode="search", activation=1):
    block = RectangleEstimatorSystem(CONFIG, HEAD, head_pose)
    return Rig(block, edges=edges, robot_state=RobotState(), mode=ModeState(mode=mode, activation=activation))


def at(edges, k):
    return dc.replace(edges, sequence=k, time=k / 8)


def test_ports():
    assert ports(RectangleEstimatorSystem(CONFIG, HEAD, head_pose)) == {
        "edges": "in abstract",
        "robot_state": "in abstract",
        "mode": "in abstract",
        "estimate": "out abstract",
    }


def test_block_holds_follows_the_axis_and_forgets_it_at_a_search():
    dut = rig(at(edge_points(facing(1.0, 0.1, 0.1, 0.5), HEAD, MARKER, 0.05), 0))
    first = dut.run(0.1).read("estimate")
    assert first.found and dut.run(0.2).read("estimate") is first
    clone = dut.context.Clone()
    for k, roll in enumerate((0.8, 1.1, 1.4, 1.7, 2.0), 1):
        X = facing(1.0, 0.1, 0.1, roll)
        dut.fix(edges=at(edge_points(X, HEAD, MARKER, 0.05), k))
        found = dut.run(0.2 + k / 8).read("estimate")
        np.testing.assert_allclose(found.X_LV, X, atol=1e-7)
    dut.fix(mode=ModeState(activation=2), edges=at(edge_points(X, HEAD, MARKER, 0.05), 8))
    np.testing.assert_allclose(dut.run(1.2).read("estimate").X_LV, X, atol=1e-7)  # another mode keeps the track
    dut.fix(mode=ModeState(afresh=True, activation=3), edges=at(edge_points(X, HEAD, MARKER, 0.05), 9))
    assert dut.run(1.4).read("estimate").X_LV[0, 0] > 0.6  # n_x > 0 again
    assert dut.read("estimate", clone) is first
    again = rig(at(edge_points(facing(1.0, 0.1, 0.1, 0.5), HEAD, MARKER, 0.05), 0)).run(0.1).read("estimate")
    assert same(again, first)


def test_block_does_not_follow_over_a_long_gap():
    dut = rig(at(edge_points(facing(1.0, 0.1, 0.1, 1.4), HEAD, MARKER, 0.05), 0))
    dut.run(0.1)
    X = facing(1.0, 0.1, 0.1, 2.2)
    dut.fix(edges=dc.replace(edge_points(X, HEAD, MARKER, 0.05), sequence=1, time=60.0))
    assert dut.run(0.3).read("estimate").X_LV[0, 0] > 0.6
