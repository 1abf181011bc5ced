"""Points from their images in both cameras of the head."""

import dataclasses as dc
import pathlib

import numpy as np
import pytest

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.camera.triangulation import triangulate, triangulate_all

HEAD = load_head(pathlib.Path(__file__).parents[1] / "models" / "calibration" / "head.yaml")
VIEWS = ((HEAD.left, np.eye(3, 4)), (HEAD.right, frames.inverse(HEAD.X_LR)))


def seen(p_L):
    """Raw px of a point in both cameras."""
    P = [frames.apply(X, p_L) for _, X in VIEWS]
    return [lens.project(q[:2] / q[2]) for (lens, _), q in zip(VIEWS, P)]


@pytest.mark.parametrize("p", [[0.0, 0.0, 0.5], [0.3, -0.2, 2.0], [-0.5, 0.5, 5.0]])
def test_triangulation_is_exact_without_noise(p):
    found, _, off = triangulate(*seen(np.array(p)), HEAD, 0.3)
    np.testing.assert_allclose(found, p, atol=1e-9)
    assert off < 1e-7


def test_covariance_is_that_of_noisy_pixels():
    rng = np.random.default_rng(0)
    p = np.array([0.2, -0.1, 2.0])
    left, right = seen(p)
    errors = np.array(
        [triangulate(left + rng.normal(0, 0.4, 2), right + rng.normal(0, 0.4, 2), HEAD, 0.4)[0] - p for _ in range(400)]
    )
    C = triangulate(left, right, HEAD, 0.4)[1]
    nees = np.einsum("ki,ij,kj->k", errors, np.linalg.inv(C), errors) / 3
    assert 0.85 < nees.mean() < 1.15


def test_yaw_error_of_the_head_is_in_the_covariance():
    p, yaw = np.array([0.0, 0.0, 2.0]), 0.001
    wrong = dc.replace(HEAD, X_LR=frames.compose(HEAD.X_LR, frames.make(frames.rot_y(yaw), np.zeros(3))))
    moved = triangulate(*seen(p), wrong, 1e-4)[0] - p
    C = triangulate(*seen(p), HEAD, 1e-4, yaw_sigma=yaw)[1]
    np.testing.assert_allclose(np.sqrt(C[2, 2]), abs(moved[2]), rtol=0.05)


def test_rays_that_do_not_meet_give_nan_not_an_error():
    p, C, _ = triangulate(np.array([100.0, 200.0]), np.array([600.0, 250.0]), HEAD, 0.3)
    assert np.isnan(p).all() and np.isinf(C).all()


@pytest.mark.parametrize("p", [[0.0, 0.0, 0.5], [0.3, -0.2, 2.0]])
def test_mid_points_of_exact_rays_are_the_points(p):
    px = [one[None] for one in seen(np.array(p))]
    np.testing.assert_allclose(triangulate_all(HEAD, *px), [p], atol=1e-9)
