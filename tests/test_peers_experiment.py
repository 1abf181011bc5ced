"""The drawn tag for other detectors is exact, and its bound and their covariance are right."""

import cv2
import numpy as np
import pytest

from valve_drake import frames
from valve_drake.analysis import experiments
from valve_drake.analysis import peers_experiment as mut
from valve_drake.analysis.drawn_images import Canvas

LENS = mut.own_lens(mut.pinhole_head().left)
K = mut.camera_matrix(LENS)


def pose(z=2.0):
    return frames.make(frames.rot_y(0.3) @ frames.rot_x(-0.25) @ frames.rot_z(0.3), np.array([0.06, 0.0, z]))


def corners(X):
    P = frames.apply(X, mut.model())
    return LENS.project(P[:, :2] / P[:, 2:])


def test_a_pixel_of_the_tag_is_the_blurred_area_of_its_cells():
    X, fine, blur, pad = pose(), 16, 0.7, 5
    dark, box = mut._darkness(Canvas(LENS, blur), X)
    v, u = ((np.arange((s.start - pad) * fine, (s.stop + pad) * fine) + 0.5) / fine - 0.5 for s in box)
    xy = LENS.normalize(np.stack(np.meshgrid(u, v), -1))
    q = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], -1) @ np.linalg.inv(np.delete(X, 2, 1)).T
    column, row = (np.floor((q[..., k] / q[..., 2] / mut.SIZE + 0.5) * 8).astype(int) for k in (0, 1))
    inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < 8)
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    printed = cv2.aruco.generateImageMarker(tags, mut.ID, 8) == 0
    black = (inside & printed[np.clip(row, 0, 7), np.clip(column, 0, 7)]).astype(float)
    soft = cv2.GaussianBlur(black, (0, 0), blur * fine)
    counted = soft.reshape(len(v) // fine, fine, len(u) // fine, fine).mean((1, 3))[pad:-pad, pad:-pad]
    assert np.abs(dark - counted).max() < 3e-3  # of which the counting makes the most


def test_the_cells_inside_tell_more_than_the_outer_square_alone():
    F, outer = mut.tag_information(pose(), LENS, 2.0)
    assert (np.linalg.eigvalsh(F - outer) > -1e-6 * np.abs(F).max()).all()


def test_least_squares_from_ippe_finds_the_pose_of_exact_corners():
    X = pose(1.0)
    assert np.linalg.norm(experiments.pose_error(mut.pose_of(corners(X), K, X), X)) < 1e-6


def test_covariance_of_corners_is_their_scatter():
    X, rng, noise = pose(0.6), np.random.default_rng(0), 0.02
    errors = [
        experiments.pose_error(mut.pose_of(corners(X) + noise * rng.standard_normal((4, 2)), K, X), X)
        for _ in range(400)
    ]
    squares = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(mut.covariance_of(X, K, noise)), errors)
    assert np.mean(squares) / 6 == pytest.approx(1.0, abs=0.1)  # four standard errors


@pytest.mark.parametrize("name", ["ArUco subpix", "ArUco apriltag", "napa-vision", "locus-tag"])
def test_detectors_count_pixels_alike(name):
    """From the centre of the first pixel, corners clockwise from the upper left: half a pixel would be 5 to 50 times
    what they scatter by."""
    if name in mut.missing():
        pytest.skip(f"{name} is not installed: pip install 'valve-drake[peers]'")
    X = pose(1.0)
    canvas = Canvas(LENS)
    mut.draw_tag(canvas, X)
    seen = mut.detectors(LENS)[name](mut.grey(canvas, np.random.default_rng(0), 2.0))
    assert np.abs((seen.corners - corners(X)).mean(0)).max() < 0.1
    assert np.abs(seen.corners - corners(X)).max() < 0.5


@pytest.mark.parametrize("name", ["napa-vision, own pose", "locus-tag, own pose"])
def test_poses_of_other_libraries_are_in_our_axes(name):
    if name.split(",")[0] in mut.missing():
        pytest.skip(f"{name.split(',')[0]} is not installed: pip install 'valve-drake[peers]'")
    X = pose(1.0)
    canvas = Canvas(LENS)
    mut.draw_tag(canvas, X)
    own = mut.detectors(LENS)[name](mut.grey(canvas, None, 0.0)).own
    assert min(np.linalg.norm(experiments.pose_error(one, X)) for one, _ in own) < 0.01


@pytest.mark.system
def test_experiment_says_what_is_not_installed_and_measures_the_rest(monkeypatch):
    monkeypatch.setattr(mut.importlib.util, "find_spec", lambda name: None)
    result = mut.peers(trials=4, distances=(2.0,))
    rows = {row["detector"]: row for row in result["rows"]}
    assert set(rows) == {"refined", "ArUco subpix", "ArUco apriltag"}
    assert result["totals"]["not installed"].startswith("napa-vision, locus-tag: ")
    assert all(row["found"] == "4/4" for row in rows.values())
    assert rows["refined"]["over bound"] < 2 < 10 < rows["ArUco subpix"]["over bound"]
    assert rows["ArUco subpix"]["NEES/6"] is None and rows["ArUco subpix"]["NEES/6, corners"] > 1
