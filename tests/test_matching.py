"""Which red area is the marker."""

import dataclasses as dc
import pathlib

import numpy as np
import pytest
from drawn_scene import facing

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.checks import ConfigError
from valve_drake.messages import MarkerCandidate
from valve_drake.perception.marker import Marker
from valve_drake.perception.matching import Match, StereoPositioningConfig, match, single, wrong_size

HEAD = load_head(pathlib.Path(__file__).parents[1] / "models" / "calibration" / "head.yaml")
MARKER, CONFIG = Marker(), StereoPositioningConfig()
VIEWS = ((HEAD.left, np.eye(3, 4)), (HEAD.right, frames.inverse(HEAD.X_LR)))


def candidates_of(*things):
    """The ideal candidates of rectangles (X_LV, width, height) in both images."""
    both = []
    for lens, X_CL in VIEWS:
        one = []
        for X, width, height in things:
            P = frames.apply(frames.compose(X_CL, X), Marker(size=[width, height]).corners())
            px = lens.project(P[:, :2] / P[:, 2:])
            x, y = px[:, 0], px[:, 1]
            area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
            one.append(MarkerCandidate(corners=px, center=px.mean(0), area=area, score=1.0))
        both.append(tuple(one))
    return both


def test_marker_is_chosen_among_red_rectangles_of_other_sizes():
    things = [
        (facing(2.0, 0.4, x=-0.3), 0.2, 0.2),
        (facing(2.0, 0.2, 0.3, 0.4, x=0.1), 0.098, 0.100),
        (facing(3.0, x=0.3, y=-0.2), 0.05, 0.06),
        (facing(4.0, x=-0.6, y=0.3), 0.3, 0.3),
    ]
    left, right = candidates_of(*things)
    assert match(left, right, HEAD, MARKER, CONFIG) == Match(left=1, right=1)
    assert match(left[::-1], right, HEAD, MARKER, CONFIG) == Match(left=2, right=1)


@pytest.mark.parametrize(
    ("things", "says"),
    [
        ([(facing(2.0), 0.2, 0.2)], "size"),
        ([(facing(2.0), 0.098, 0.300)], "size"),
        ([(facing(9.0), 0.098, 0.100)], "distance"),
    ],
)
def test_no_pair_has_a_reason(things, says):
    assert says in match(*candidates_of(*things), HEAD, MARKER, CONFIG).reason


def test_quadrilateral_that_no_rectangle_projects_to_is_no_marker():
    left, right = (
        tuple(dc.replace(c, corners=c.corners + [[20, 0], [0, 0], [0, 0], [0, -20]]) for c in one)
        for one in candidates_of((facing(2.0), 0.098, 0.100))
    )
    assert "shape" in match(left, right, HEAD, MARKER, CONFIG).reason


def test_candidates_on_different_rows_are_no_pair():
    left, right = candidates_of((facing(2.0), 0.098, 0.100))
    right = (dc.replace(right[0], center=right[0].center + [0, 12], corners=right[0].corners + [0, 12]),)
    assert "epipolar" in match(left, right, HEAD, MARKER, CONFIG).reason


def test_rejected_candidates_take_no_part():
    left, right = candidates_of((facing(2.0), 0.098, 0.100))
    left = (dc.replace(left[0], rejected="fill: 0.5"),)
    assert match(left, right, HEAD, MARKER, CONFIG).reason == "no candidate in the left image"
    assert single(left, HEAD.left, MARKER, CONFIG)[0] == -1
    assert single(right, HEAD.right, MARKER, CONFIG) == (0, "")


def test_two_to_one_marker_is_matched_whichever_way_it_hangs():
    marker = Marker(size=[0.12, 0.06])
    for roll in (0.0, 0.8, 1.57, 3.0):
        pair = candidates_of((facing(2.0, 0.5, 0.3, roll), 0.12, 0.06))
        assert match(*pair, HEAD, marker, CONFIG).reason == ""


def ideal(X, width, height, turn=0):
    """Ideal corners of a rectangle in both cameras; the right one's counted from another corner."""
    P = [frames.apply(frames.compose(X_CL, X), Marker(size=[width, height]).corners()) for _, X_CL in VIEWS]
    left, right = (p[:, :2] / p[:, 2:] for p in P)
    return left, np.roll(right, turn, axis=0)


@pytest.mark.parametrize("z", [0.6, 1.2, 2.4])
def test_a_long_box_that_one_camera_takes_for_the_slanted_marker_is_of_wrong_size(z):
    rng = np.random.default_rng(1)
    for pan in (0.6, 0.8):
        for size in ((0.14, 0.04), (0.13, 0.06), (0.13, 0.13), (0.07, 0.07)):
            corners = [c + rng.normal(0, 0.1 / 1075, (4, 2)) for c in ideal(facing(z, pan), *size, turn=1)]
            assert wrong_size(*corners, HEAD, MARKER, CONFIG).startswith("sides: ")
        for turn in range(4):
            corners = [c + rng.normal(0, 0.1 / 1075, (4, 2)) for c in ideal(facing(z, pan), 0.098, 0.100, turn)]
            assert wrong_size(*corners, HEAD, MARKER, CONFIG) == ""


def test_an_oblong_marker_has_its_size_whichever_corner_comes_first():
    left, right = ideal(facing(1.5, 0.4, 0.2, 0.3), 0.12, 0.08)
    for turn in range(4):
        assert wrong_size(np.roll(left, turn, axis=0), right, HEAD, Marker(size=[0.12, 0.08]), CONFIG) == ""


def test_what_the_calibration_does_not_know_does_not_count_against_a_side():
    corners = ideal(facing(1.5, 0.4), 0.12, 0.12)
    assert wrong_size(*corners, HEAD, MARKER, CONFIG)
    assert wrong_size(*corners, dc.replace(HEAD, rms_px=1.4), MARKER, CONFIG) == ""


def test_rays_that_are_parallel_have_no_size():
    corners = ideal(facing(2.0), 0.098, 0.100)[0]
    parallel = dc.replace(HEAD, X_LR=frames.make(np.eye(3), HEAD.X_LR[:, 3]))
    assert wrong_size(corners, corners, parallel, MARKER, CONFIG)


@pytest.mark.parametrize("bad", [{"center_sigma": 0.0}, {"max_distance": 0.1}, {"yaw_sigma": -0.1}])
def test_bad_config_is_refused(bad):
    with pytest.raises(ConfigError, match=f"stereo_positioning.{next(iter(bad))}"):
        dc.replace(CONFIG, **bad).check()


def test_a_small_oblong_marker_is_found_although_its_sides_could_be_exchanged():
    """At 28 x 19 px a tilted 120 x 80 mm rectangle looks like one with its sides exchanged, at another distance."""
    oblong = Marker(size=[0.12, 0.08])
    rng = np.random.default_rng(7)
    for _ in range(200):
        X = facing(rng.uniform(3.5, 5.0), rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3), x=0.1, y=0.1)
        pair = [
            tuple(dc.replace(c, corners=c.corners + rng.normal(0, 0.7, (4, 2))) for c in side)
            for side in candidates_of((X, 0.12, 0.08))
        ]
        assert match(*pair, HEAD, oblong, CONFIG).reason == ""
