"""The green mark in a wrist image: accuracy of the feature, the border, other green things, and the block."""

import dataclasses as dc

import numpy as np
import pytest
from drawn_scene import GREEN, METAL, Drawing, facing
from helpers import Rig, ports, same

from valve_drake import frames
from valve_drake.camera.lens import Lens
from valve_drake.checks import ConfigError
from valve_drake.messages import CameraFrame, ModeState
from valve_drake.perception import channel
from valve_drake.perception.edges import SidesConfig
from valve_drake.perception.handle_marker import HandleMarkerConfig, find_mark
from valve_drake.perception.handle_marker_system import HandleMarkerSystem

WRIST = Lens(k_u=1.0e-07, k_v=1.0e-07, k_x=500.0, k_y=500.0, u_0=320.0, v_0=240.0)
CONFIG = HandleMarkerConfig()
HALF = (0.020, 0.011)


def wrist_image(X_AM, rng, others=(), blur=0.7, noise=2.0):
    drawing = Drawing(WRIST, (140, 140, 138))
    for X, half, kind in others:
        drawing.shape(X, GREEN, half, kind)
    drawing.shape(frames.compose(X_AM, frames.make(np.eye(3), np.array([0, 0, 0.001]))), METAL, (0.09, 0.0125))
    drawing.shape(X_AM, GREEN, HALF)
    return drawing.finish(rng, blur=blur, noise=noise)


def truth(X_AM):
    """Image of the mark's centre, and area of its true quadrilateral."""
    P = frames.apply(X_AM, np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*HALF, 0])
    px = WRIST.project(P[:, :2] / P[:, 2:])
    x, y = px[:, 0], px[:, 1]
    return WRIST.project(X_AM[:2, 3] / X_AM[2, 3]), abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


@pytest.mark.parametrize("z", [0.10, 0.15, 0.25, 0.35])
def test_centre_and_area_are_those_of_the_true_mark(z):
    rng = np.random.default_rng(0)
    for turn in (0.0, 0.5, -1.2):
        X = facing(z, 0.35, 0.2, turn, 0.01, 0.01)
        mark = find_mark(wrist_image(X, rng), CONFIG)
        assert mark.found, mark.reason
        center, area = truth(X)
        np.testing.assert_allclose(mark.center, center, atol=0.15)
        # The area gives the depth: half of its relative error.
        assert abs(mark.area / area - 1) < 0.008
        np.testing.assert_allclose(mark.feature, np.append(mark.center, 1) / np.sqrt(mark.area), rtol=1e-12)
        assert mark.corners.shape == (4, 2)


def test_area_does_not_depend_on_light():
    X = facing(0.2, 0.3, 0.2, 0.4)
    areas = []
    for light in ((1, 1, 1), (0.5, 0.5, 0.5), (1.2, 0.9, 0.7)):
        drawing = Drawing(WRIST, (140, 140, 138))
        drawing.shape(X, METAL, (0.09, 0.0125))
        drawing.shape(X, GREEN, HALF)
        areas.append(find_mark(drawing.finish(np.random.default_rng(0), light=light), CONFIG).area)
    assert np.ptp(areas) / np.mean(areas) < 0.004


def test_a_handle_whose_red_and_blue_are_clipped_leaves_the_mark_in_its_place():
    """Green alone tells brightness: a mark of the wall's own green would be lost before it, and beside a dark hub."""
    for z in (0.15, 0.2, 0.3):
        X = facing(z, 0.3, 0.2, 0.0)
        drawing = Drawing(WRIST, (190, 183, 210))
        drawing.shape(frames.compose(X, frames.make(np.eye(3), np.array([-0.06, 0, 0.002]))), (8, 8, 8), (0.05, 0.03))
        drawing.shape(
            frames.compose(X, frames.make(np.eye(3), np.array([0, 0, 0.001]))), (255, 232, 252), (0.09, 0.0125)
        )
        drawing.shape(X, (18, 182, 51), HALF)
        mark = find_mark(drawing.finish(np.random.default_rng(0), blur=0.7, noise=2.0), CONFIG)
        assert mark.found, mark.reason
        center, area = truth(X)
        np.testing.assert_allclose(mark.center, center, atol=0.15)
        assert abs(mark.area / area - 1) < 0.008


def test_a_clipped_colour_has_no_weight_and_the_others_no_common_brightness():
    core, ring = np.array([20.0, 180, 50]), np.array([255.0, 230, 250])
    for clipped in range(3):
        colors = np.arange(3) != clipped
        weights = channel._between(core, ring, colors, SidesConfig(color_only=True))
        assert weights[clipped] == 0 and abs(weights.sum()) < 1e-9 and np.abs(weights).max() > 10
    assert not channel._between(core, ring, np.arange(3) == 1, SidesConfig(color_only=True)).any()
    assert channel._between(core, ring, np.full(3, True), SidesConfig(color_only=False)) == pytest.approx(core - ring)


def test_feature_moves_linearly_with_the_hand():
    """The point of (u, v, 1) / sqrt(area): one Jacobian for the whole workspace."""

    def feature(x, y, z):
        return find_mark(wrist_image(facing(z, 0.3, 0.2, 0.2, x, y), None), CONFIG).feature

    near, far = feature(0.0, 0.0, 0.15), feature(0.02, -0.01, 0.30)
    middle = feature(0.01, -0.005, 0.225)
    np.testing.assert_allclose(middle[2], (near[2] + far[2]) / 2, rtol=0.02)
    np.testing.assert_allclose(middle[:2], (near[:2] + far[:2]) / 2, rtol=0.03)


@pytest.mark.parametrize("x", [-0.11, 0.11])
def test_mark_at_the_border_is_not_found_but_located(x):
    mark = find_mark(wrist_image(facing(0.15, x=x), np.random.default_rng(0)), CONFIG)
    assert not mark.found and mark.reason == "border"
    assert (mark.center[0] < 60) if x < 0 else (mark.center[0] > 580)
    assert mark.area > 500


def test_near_mark_is_taken_before_other_green_things():
    others = (
        (facing(0.45, 0.2, 0.1, 0.3, 0.15, 0.05), HALF, "box"),
        (facing(1.5, x=-0.6, y=-0.4), (0.3, 0.3), "disc"),
        (facing(0.8, x=0.3, y=-0.25), (0.06, 0.03), "box"),
    )
    X = facing(0.2, 0.2, 0.1, 0.3, -0.02, 0.01)
    mark = find_mark(wrist_image(X, np.random.default_rng(0), others), CONFIG)
    assert mark.found
    np.testing.assert_allclose(mark.center, truth(X)[0], atol=0.2)


def test_no_mark_has_a_reason():
    drawing = Drawing(WRIST, (140, 140, 138))
    assert find_mark(drawing.finish(np.random.default_rng(0)), CONFIG).reason == "no green region"
    drawing.shape(facing(0.5), GREEN, (0.08, 0.08), "disc")
    mark = find_mark(drawing.finish(np.random.default_rng(0)), CONFIG)
    assert not mark.found and mark.reason.split(":")[0] in ("fill", "corners")


def frame(image, k):
    return CameraFrame(time=k / 16, sequence=k, image=image)


def rig(every=1):
    rng = np.random.default_rng(0)
    left, right = wrist_image(facing(0.2, 0.2), rng), wrist_image(facing(0.3, -0.2), rng)
    dut = Rig(HandleMarkerSystem(CONFIG), mode=ModeState(wrist_every=every))
    dut.fix(left_wrist_image=frame(left, 0), right_wrist_image=frame(right, 0))
    return dut, left, right


def test_ports():
    assert ports(HandleMarkerSystem(CONFIG)) == {
        "left_wrist_image": "in abstract",
        "right_wrist_image": "in abstract",
        "mode": "in abstract",
        "marks": "out abstract",
    }


def test_block_looks_at_both_hands_and_holds():
    dut, left, _ = rig()
    marks = dut.run(0.05).read("marks")
    assert marks.left.found and marks.right.found and marks.left.area > marks.right.area
    assert marks.left.frame.sequence == 0
    assert dut.run(0.2).read("marks") is marks
    clone = dut.context.Clone()
    dut.fix(left_wrist_image=frame(left, 4))
    later = dut.run(0.3).read("marks")
    assert later.left.sequence == 4 and later.right is marks.right and later.time == 0.25
    assert dut.read("marks", clone) is marks
    assert same(rig()[0].run(0.05).read("marks"), marks)


def test_block_reads_no_image_in_modes_that_need_none():
    dut, *_ = rig(every=0)
    dut.fix(left_wrist_image=ModeState())  # reading it would raise
    assert dut.run(0.3).read("marks").left.sequence == -1


def test_block_works_with_one_camera():
    _, left, _ = rig()
    dut = Rig(HandleMarkerSystem(CONFIG), mode=ModeState(wrist_every=1), left_wrist_image=frame(left, 0))
    marks = dut.run(0.1).read("marks")
    assert marks.left.found and not marks.right.found


@pytest.mark.parametrize(
    ("bad", "key"),
    [({"min_fill": 0.0}, "min_fill"), ({"max_aspect": 0.5}, "max_aspect")],
)
def test_bad_config_is_refused(bad, key):
    with pytest.raises(ConfigError, match=f"handle_marker.{key}"):
        dc.replace(CONFIG, **bad).check()
