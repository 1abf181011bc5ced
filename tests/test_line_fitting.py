"""Edges of the marker in both head images: which pairs are refused, and the block."""

import dataclasses as dc

import numpy as np
import pytest
from drawn_quads import CONFIG, HEAD, MARKER
from drawn_scene import Drawing, draw_valve, facing
from helpers import Rig, ports, same

from valve_drake import frames
from valve_drake.checks import ConfigError
from valve_drake.messages import CameraFrame, Segmentation, SegmentationPair
from valve_drake.perception.color_segmentation import ColorSegmentationConfig, segment
from valve_drake.perception.line_fitting import fit_pair
from valve_drake.perception.line_fitting_system import LineFittingSystem
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import StereoPositioningConfig


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
