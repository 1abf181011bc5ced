"""Sub-pixel sides on drawn images, where the true side is known, and the block."""

import dataclasses as dc
import pathlib

import cv2
import numpy as np
import pytest
from drawn_scene import PLATE, RED, Drawing, draw_valve, facing
from helpers import Rig, ports, same

from valve_drake import frames
from valve_drake.analysis.drawn_images import Canvas, draw_bar
from valve_drake.camera.lens import load_head
from valve_drake.checks import ConfigError
from valve_drake.messages import CameraFrame, Segmentation, SegmentationPair
from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segment
from valve_drake.perception.line_fitting import LineFittingConfig, _even_light, fit_pair, fit_quads
from valve_drake.perception.line_fitting_system import LineFittingSystem
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import StereoPositioningConfig
from valve_drake.perception.quadrilateral import meet, side_lines

HEAD = load_head(pathlib.Path(__file__).parents[1] / "models" / "calibration" / "head.yaml")
MARKER, CONFIG = Marker(), LineFittingConfig()


def quad_image(X, rng, blur=0.7, noise=2.0, occluder=None):
    drawing = Drawing(HEAD.left)
    drawing.shape(X, PLATE, (0.09, 0.09))
    drawing.shape(X, RED, (0.049, 0.05))
    if occluder is not None:
        X_VO = frames.make(np.eye(3), np.array([*occluder, -0.001]))
        drawing.shape(frames.compose(X, X_VO), (40, 40, 45), (0.008, 0.03))
    return drawing.finish(rng, blur=blur, noise=noise)


def true_quad(X):
    P = frames.apply(X, MARKER.corners())
    return HEAD.left.project(P[:, :2] / P[:, 2:])


def distances(quad, X):
    """Signed distance of each fitted point from its true side [px], positive to the side's right."""
    P = frames.apply(X, MARKER.corners())
    h = np.column_stack([P[:, :2] / P[:, 2:], np.ones(4)])
    line = np.cross(h, np.roll(h, -1, 0))
    line /= np.linalg.norm(line[:, :2], axis=1, keepdims=True)
    xy = HEAD.left.normalize(quad.points)
    return (np.column_stack([xy, np.ones(len(xy))]) * line[quad.side]).sum(1) * HEAD.left.focal()


def fit(image, corners, config=CONFIG):
    return fit_quads([image], [corners], config)[0]


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("blur", [0.5, 0.8, 1.2])
def test_sides_without_noise_are_true_to_a_few_hundredths(z, blur):
    rng = np.random.default_rng(0)
    for turn in (0.0, 0.02, 0.4, 0.785):
        X = facing(z, 0.3, -0.25, turn, 0.03, 0.02)
        quad = fit(quad_image(X, None, blur=blur), true_quad(X) + rng.uniform(-0.7, 0.7, (4, 2)))
        assert quad.reason == ""
        off = distances(quad, X)
        assert np.sqrt(np.mean(off**2)) < 0.045  # JPEG and rounding of grey values alone
        assert max(abs(off[quad.side == k].mean()) for k in range(4)) < 0.03


def test_noise_is_near_its_lower_bound_and_sigma_is_honest():
    rng = np.random.default_rng(1)
    X = facing(1.0, 0.2, 0.3, 0.3)
    squares, claims = [], []
    for _ in range(10):
        quad = fit(quad_image(X, rng, noise=3.0), true_quad(X))
        squares.append(np.mean(distances(quad, X) ** 2))
        claims.append(quad.sigma)
    seen = np.sqrt(np.mean(squares))
    assert 0.85 < seen / np.mean(claims) < 1.15
    # anchors/vision.md 2.3: sigma >= 1.88 sqrt(s) sigma_n / A; A is the length of the colour step.
    contrast = np.linalg.norm(np.subtract(RED, PLATE))
    bound = 1.88 * np.sqrt(np.hypot(0.7, 0.29)) * 3.0 / contrast
    assert seen < 1.35 * bound


def test_points_of_one_image_have_independent_errors():
    rng = np.random.default_rng(2)
    X = facing(0.8, 0.2, 0.1, 0.6)
    products = []
    for _ in range(6):
        quad = fit(quad_image(X, rng, noise=6.0), true_quad(X))
        for k in range(4):
            off = distances(quad, X)[quad.side == k]
            products.append(np.corrcoef(off[:-1], off[1:])[0, 1])
    assert abs(np.mean(products)) < 0.12


def test_start_two_pixels_off_ends_at_the_same_sides():
    X = facing(1.0, 0.2, 0.3, 0.2)
    image = quad_image(X, np.random.default_rng(3))
    good = fit(image, true_quad(X))
    for shift in ([2, 2], [-2, 1], [0, -2]):
        quad = fit(image, true_quad(X) + np.array(shift))
        assert quad.reason == ""
        np.testing.assert_allclose(
            meet(side_lines(quad.points, quad.side)[0]), meet(side_lines(good.points, good.side)[0]), atol=0.03
        )


def test_something_across_a_side_is_left_out():
    X = facing(0.8, 0.1, 0.1, 0.2)
    quad = fit(quad_image(X, np.random.default_rng(4), occluder=(0.0, -0.05)), true_quad(X))
    assert quad.reason == ""
    off = distances(quad, X)
    assert np.abs(off).max() < 0.25
    assert abs(off[quad.side == 0].mean()) < 0.02


@pytest.mark.parametrize("factor", [0.5, 0.7])
def test_a_shadow_across_the_marker_moves_no_side(factor):
    rng = np.random.default_rng(8)
    for z, turn in ((0.6, 0.3), (1.0, 1.4), (1.6, 2.6), (2.0, -0.8)):
        X = facing(z, 0.2, 0.3, 0.2)
        canvas = Canvas(HEAD.left)
        draw_bar(canvas, X, MARKER)
        canvas.shade(frames.compose(X, frames.make(frames.rot_z(turn), np.zeros(3))), factor, 2.0)
        quad = fit(canvas.finish(rng, 2.0), true_quad(X) + rng.uniform(-0.7, 0.7, (4, 2)))
        assert quad.reason == ""
        off = distances(quad, X)
        assert np.sqrt(np.mean(off**2)) < 2 * quad.sigma
        assert max(abs(off[quad.side == k].mean()) for k in range(4)) < 0.03


def test_something_straight_across_the_marker_is_not_taken_for_a_shadow():
    X = facing(0.8, 0.1, 0.1, 0.2)
    canvas = Canvas(HEAD.left)
    draw_bar(canvas, X, MARKER)
    canvas.rectangle(frames.compose(X, frames.make(np.eye(3), np.array([0.06, 0, -0.01]))), (40, 42, 45), (0.06, 0.2))
    mask = np.zeros((480, 640), np.uint8)
    cv2.fillConvexPoly(mask, true_quad(X).round().astype(np.int32), 255)
    image = canvas.finish(np.random.default_rng(0), 2.0).astype(np.float32)
    assert _even_light(image, image, mask, 1)[0] is image
    canvas = Canvas(HEAD.left)
    draw_bar(canvas, X, MARKER)
    canvas.shade(X, 0.3, 2.0)
    image = canvas.finish(np.random.default_rng(0), 2.0).astype(np.float32)
    even, _ = _even_light(image, image, mask, 1)
    inside = cv2.erode(mask, np.ones((9, 9))) > 0
    assert image[inside][:, 0].std() > 50 and even[inside][:, 0].std() < 8


def test_gamma_of_an_ordinary_camera_is_undone():
    X = facing(0.8, 0.1, 0.1, 0.2)
    encoded = (255 * (quad_image(X, None, blur=1.2) / 255.0) ** (1 / 2.2)).round().astype(np.uint8)
    straight = fit(encoded, true_quad(X), dc.replace(CONFIG, gamma=2.2))
    wrong = fit(encoded, true_quad(X))
    inward = [[np.mean(distances(q, X)[q.side == k]) for k in range(4)] for q in (straight, wrong)]
    assert np.abs(inward[0]).max() < 0.02 < np.abs(inward[1]).max()


@pytest.mark.parametrize("kind", ["disc", "flat", "outside"])
def test_what_is_no_quadrilateral_is_refused_with_a_reason(kind):
    X = facing(1.0)
    drawing = Drawing(HEAD.left)
    if kind == "disc":
        drawing.shape(X, RED, (0.049, 0.05), "disc")
    corners = true_quad(X) + (5000 if kind == "outside" else 0)
    assert fit(drawing.finish(np.random.default_rng(0)), corners).reason


@pytest.mark.parametrize("blur", [0.7, 2.2])  # which is fitted once more, to longer profiles
def test_two_images_in_one_pass_give_the_same_as_one_by_one(blur):
    rng = np.random.default_rng(5)
    poses = [facing(0.7, 0.1, 0.1, 0.2), facing(2.5, -0.4, 0.3, 1.0)]
    images = [quad_image(X, rng, blur=blur) for X in poses]
    corners = [true_quad(X) for X in poses]
    together = fit_quads(images, corners, CONFIG)
    for image, corner, quad in zip(images, corners, together):
        alone = fit(image, corner)
        np.testing.assert_allclose(quad.points, alone.points, atol=2e-3)


def segmented(X_LV, rng):
    seen = []
    for lens, X_CL in ((HEAD.left, np.eye(3, 4)), (HEAD.right, frames.inverse(HEAD.X_LR))):
        drawing = Drawing(lens)
        draw_valve(drawing, frames.compose(X_CL, X_LV), MARKER)
        image = drawing.finish(rng)
        candidates, green = segment(image, ColorSegmentationConfig())
        seen.append(Segmentation(frame=CameraFrame(image=image), candidates=candidates, green=green))
    return SegmentationPair(time=0.0, sequence=0, left=seen[0], right=seen[1])


def test_pair_gives_undistorted_points_corners_and_marks():
    X = facing(1.2, 0.2, 0.1, 0.3, 0.05)
    edges = fit_pair(segmented(X, np.random.default_rng(6)), HEAD, MARKER, CONFIG, StereoPositioningConfig())
    for quad, lens, X_CL in (
        (edges.left, HEAD.left, np.eye(3, 4)),
        (edges.right, HEAD.right, frames.inverse(HEAD.X_LR)),
    ):
        assert quad.found and quad.reason == ""
        P = frames.apply(frames.compose(X_CL, X), MARKER.corners())
        xy = P[:, :2] / P[:, 2:]
        nearest = np.linalg.norm(quad.corners[:, None] - xy[None], axis=2).min(1)
        assert nearest.max() * lens.focal() < 0.1
        np.testing.assert_allclose(lens.project(quad.corners), quad.corners_px, atol=1e-9)
        assert len(quad.green) == 2


def test_one_camera_alone_is_used_only_if_asked_for():
    pair = segmented(facing(1.2, 0.2, 0.1, 0.3), np.random.default_rng(6))
    pair = dc.replace(pair, right=Segmentation())
    matching = StereoPositioningConfig()
    refused = fit_pair(pair, HEAD, MARKER, CONFIG, matching)
    assert not refused.left.found and refused.left.reason == "no candidate in the right image"
    used = fit_pair(pair, HEAD, MARKER, dc.replace(CONFIG, single_camera=True), matching)
    assert used.left.found and not used.right.found


def test_a_camera_that_sees_no_sides_leaves_the_other_alone_only_if_asked_for():
    pair = segmented(facing(1.2, 0.2, 0.1, 0.3), np.random.default_rng(6))
    grey = CameraFrame(image=np.full((480, 640, 3), 120, np.uint8))
    pair = dc.replace(pair, right=dc.replace(pair.right, frame=grey))
    refused = fit_pair(pair, HEAD, MARKER, CONFIG, StereoPositioningConfig())
    assert not refused.left.found and refused.left.reason == refused.right.reason == "contrast: 0"
    used = fit_pair(pair, HEAD, MARKER, dc.replace(CONFIG, single_camera=True), StereoPositioningConfig())
    assert used.left.found and not used.right.found


def test_sides_of_another_length_are_refused_in_both_images():
    pair = segmented(facing(1.2, 0.2, 0.1, 0.3), np.random.default_rng(6))
    matching = StereoPositioningConfig(size_gate=1.0)
    edges = fit_pair(pair, HEAD, Marker(size=[0.098, 0.13]), CONFIG, matching)
    assert edges.left.reason.startswith("sides: ") and edges.left.reason == edges.right.reason
    assert not edges.left.found and not edges.right.found


def test_block():
    assert ports(LineFittingSystem(CONFIG, HEAD)) == {"segmentation": "in abstract", "edges": "out abstract"}
    pair = segmented(facing(1.2, 0.2, 0.1, 0.3), np.random.default_rng(6))
    dut = Rig(LineFittingSystem(CONFIG, HEAD))
    assert dut.run(0.1).read("edges").sequence == -1  # nothing connected
    dut.fix(segmentation=pair)
    edges = dut.run(0.2).read("edges")
    assert edges.left.found and edges.right.found and edges.time == pair.time
    assert dut.run(0.5).read("edges") is edges  # nothing new
    clone = dut.context.Clone()
    dut.fix(segmentation=SegmentationPair(sequence=1, time=1.0))
    assert not dut.run(0.8).read("edges").left.found and dut.read("edges", clone) is not None
    again = Rig(LineFittingSystem(CONFIG, HEAD), segmentation=pair).run(0.1).read("edges")
    assert same(again, edges) and same(dut.read("edges", clone), edges)


@pytest.mark.parametrize("bad", [{"half_window": 0}, {"gamma": -1.0}, {"iterations": 1}, {"min_share": float("nan")}])
def test_bad_config_is_refused(bad):
    with pytest.raises(ConfigError, match=f"line_fitting.{next(iter(bad))}"):
        dc.replace(CONFIG, **bad).check()
