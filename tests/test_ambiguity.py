"""Mirrored tilts, and which axis of the rectangle is X."""

import dataclasses as dc
import pathlib

import numpy as np
import pytest
from drawn_scene import edge_points, facing, pose_error, with_information

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.perception.marker import Marker
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, Track, estimate

ROOT = pathlib.Path(__file__).parents[1]
HEAD = load_head(ROOT / "models" / "calibration" / "head.yaml")
MARKER = Marker()
CONFIG = RectangleEstimatorConfig(side_bias=0.0)  # synthetic points have no bias
POSES = [facing(0.5, 0.3, 0.2, 0.3, 0.02, 0.03), facing(1.0, -0.4, 0.1, -0.5), facing(2.0, 0.35, 0.3, 0.6, -0.2, 0.1)]
HALF_TURN = frames.make(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


def test_two_tilts_that_nothing_decides_between_are_both_within_the_covariance():
    X, far = facing(3.0, 0.15, 0.05, 0.1), 0.0
    for seed in range(20):
        edges = edge_points(X, HEAD, MARKER, 0.3, np.random.default_rng(seed), cameras="left")
        found = estimate(edges, HEAD, MARKER, CONFIG)
        far = max(far, float((np.abs(pose_error(found.X_LV, X)) / np.sqrt(np.diag(found.covariance)))[:2].max()))
    assert far < 4


def test_mirror_image_is_reported_with_how_much_worse_it_fits():
    X = facing(1.0, 0.25, 0.1, 0.2)
    close = estimate(edge_points(X, HEAD, MARKER, 0.1, cameras="left"), HEAD, MARKER, CONFIG)
    far = estimate(edge_points(facing(3.0, 0.25, 0.1, 0.2), HEAD, MARKER, 0.1, cameras="left"), HEAD, MARKER, CONFIG)
    both = estimate(edge_points(X, HEAD, MARKER, 0.1), HEAD, MARKER, CONFIG)
    assert both.ambiguity > close.ambiguity > far.ambiguity > 0
    # The mirrored tilt is about twice the tilt away.
    between = np.linalg.norm(frames.rotation_vector(far.X_LV[:, :3].T @ far.X_LV_other[:, :3]))
    assert 0.3 < between < 0.7


def test_track_decides_between_mirror_images_that_fit_alike():
    X = facing(4.0, 0.12, 0.05, 0.1)
    wrong = {"track": 0, "none": 0}
    for seed in range(20):
        edges = edge_points(X, HEAD, MARKER, 0.3, np.random.default_rng(seed), cameras="left")
        for name, track in (("track", Track(X)), ("none", None)):
            found = estimate(edges, HEAD, MARKER, CONFIG, track)
            wrong[name] += found.X_LV[0, 2] < 0
    assert wrong["none"] > 2 and wrong["track"] < wrong["none"] / 2


def with_marks(edges, X, along=0):
    """Adds the green marks on V's x axis (along = 0), or its y axis, as both cameras see them."""
    quads = []
    for quad, X_CL in ((edges.left, np.eye(3, 4)), (edges.right, frames.inverse(HEAD.X_LR))):
        places = np.zeros((2, 3))
        places[:, along], places[:, 2] = [0.15, -0.15], 0.028
        P = frames.apply(frames.compose(X_CL, X), places)
        green = np.vstack([P[:, :2] / P[:, 2:], [[0.2, 0.1]]])  # and a plant
        quads.append(dc.replace(quad, green=green))
    return dc.replace(edges, left=quads[0], right=quads[1])


@pytest.mark.parametrize(
    ("seed", "rotation_vector", "p"),
    [
        (1956, [0.20351, -0.09661, -0.07136], [-0.171777, 0.006274, 2.427088]),
        (3803, [0.25215, 0.00923, -0.27364], [0.098238, -0.200883, 2.373454]),
    ],
)
def test_a_tilt_is_not_lost_where_the_sides_are_first_counted_by_the_wrong_length(seed, rotation_vector, p):
    """The right eye stands 0.15 mrad off, the image's first corner is the model's last: both starts fit badly at first,
    and the better start of the two may be the one whose minimum is the worse."""
    off = frames.make(frames.rotation(np.array([0.45e-4, 1.5e-4, 0.45e-4])), np.zeros(3))
    head = dc.replace(HEAD, X_LR=frames.compose(HEAD.X_LR, off))
    X = frames.make(frames.rotation(np.array(rotation_vector)), np.array(p))
    points = edge_points(X, HEAD, MARKER, 0.09, np.random.default_rng(seed), first=3)
    found = estimate(with_information(with_marks(points, X)), head, MARKER, CONFIG)
    assert np.degrees(np.arccos(found.X_LV[:, 2] @ X[:, 2])) < 6
    assert found.ambiguity > CONFIG.ambiguity_gate


@pytest.mark.parametrize("roll", [-1.5, -1.0, -0.3, 0.3, 0.79, 1.2, 1.5])
def test_green_marks_fix_the_x_axis(roll):
    X = facing(1.5, 0.3, 0.2, roll)
    for first in range(4):
        found = estimate(with_marks(edge_points(X, HEAD, MARKER, 0.05, first=first), X), HEAD, MARKER, CONFIG)
        assert found.axis_known
        np.testing.assert_allclose(found.X_LV, X, atol=1e-8)


def test_without_marks_or_track_x_is_the_most_level_axis_and_not_called_known():
    for roll in (0.2, 1.2, 2.5, -2.0):
        found = estimate(edge_points(facing(1.0, 0.1, 0.1, roll), HEAD, MARKER, 0.05), HEAD, MARKER, CONFIG)
        assert not found.axis_known
        assert found.X_LV[0, 0] > 0.68


def test_sizes_fix_the_x_axis_of_a_clear_rectangle():
    marker = Marker(size=[0.12, 0.08])
    for roll in (0.3, 1.2):
        X = facing(1.0, 0.3, 0.2, roll)
        for first in range(4):
            found = estimate(edge_points(X, HEAD, marker, 0.05, first=first), HEAD, marker, CONFIG)
            assert found.axis_known
            np.testing.assert_allclose(found.X_LV, X, atol=1e-8)


def test_track_carries_the_axis_past_ninety_degrees():
    track = None
    for roll in np.arange(0.0, 3.2, 0.2):
        X = facing(0.9, 0.1, 0.2, roll)
        found = estimate(with_marks(edge_points(X, HEAD, MARKER, 0.05), X), HEAD, MARKER, CONFIG, track)
        np.testing.assert_allclose(found.X_LV, X, atol=1e-8)
        track = Track(found.X_LV, found.axis_known)


def test_covariance_turns_with_the_axis():
    """Half a turn of V about z must carry the covariance of theta along."""
    X = facing(1.0, 0.4, 0.1, 0.3)
    other = frames.compose(X, HALF_TURN)
    edges = edge_points(X, HEAD, MARKER, 0.1)
    a, b = (estimate(edges, HEAD, MARKER, CONFIG, Track(x)) for x in (X, other))
    np.testing.assert_allclose(b.X_LV, other, atol=1e-8)
    T = np.diag([-1.0, -1, 1, 1, 1, 1])
    np.testing.assert_allclose(b.covariance, T @ a.covariance @ T, rtol=1e-5, atol=1e-16)
