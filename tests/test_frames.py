"""frames: rotations, poses and angles against their definitions."""

import numpy as np
import pytest

from valve_drake import frames
from valve_drake.frames import apply, compose, cross, inverse, make, planar, rotation, rotation_vector, skew, wrap


def random_pose(rng) -> np.ndarray:
    return make(rotation(rng.normal(size=3)), rng.normal(size=3))


def series(w: np.ndarray) -> np.ndarray:
    """exp([w]x) by its power series."""
    out, term = np.eye(3), np.eye(3)
    for k in range(1, 40):
        term = term @ skew(w) / k
        out = out + term
    return out


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-7, 1e-4, 0.3, 1.5, 3.1])
def test_rotation_is_the_matrix_exponential(angle):
    rng = np.random.default_rng(1)
    for _ in range(5):
        axis = rng.normal(size=3)
        w = angle * axis / np.linalg.norm(axis)
        assert rotation(w) == pytest.approx(series(w), abs=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-6, 0.5, 2.0, np.pi - 1e-3, np.pi - 1e-6])
def test_rotation_vector_inverts_rotation(angle):
    rng = np.random.default_rng(2)
    for _ in range(20):
        axis = rng.normal(size=3)
        w = angle * axis / np.linalg.norm(axis)
        assert rotation_vector(rotation(w)) == pytest.approx(w, abs=1e-8)


def test_half_a_turn_has_an_axis_of_length_pi_about_any_direction():
    rng = np.random.default_rng(3)
    for axis in (*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))):
        w = np.pi * axis / np.linalg.norm(axis)
        found = rotation_vector(2 * np.outer(w, w) / np.pi**2 - np.eye(3))
        assert min(np.linalg.norm(found - w), np.linalg.norm(found + w)) < 1e-6  # its sign is free


def test_cross_and_skew_are_the_cross_product():
    rng = np.random.default_rng(4)
    for a, b in rng.normal(size=(10, 2, 3)):
        assert np.array_equal(cross(a, b), np.cross(a, b))
        assert skew(a) @ b == pytest.approx(np.cross(a, b))


@pytest.mark.parametrize("turn, axis", [(frames.rot_x, 0), (frames.rot_y, 1), (frames.rot_z, 2)])
def test_axis_rotations_are_right_handed(turn, axis):
    assert turn(0.7) == pytest.approx(rotation(0.7 * np.eye(3)[axis]))


def test_poses_compose_invert_and_move_points_as_4x4_matrices_do():
    rng = np.random.default_rng(5)
    A, B, C = (random_pose(rng) for _ in range(3))

    def full(X):
        return np.vstack([X, [0, 0, 0, 1]])

    assert full(compose(A, B, C)) == pytest.approx(full(A) @ full(B) @ full(C))
    assert full(inverse(A)) == pytest.approx(np.linalg.inv(full(A)))
    points = rng.normal(size=(2, 4, 3))
    moved = apply(A, points)
    assert moved.shape == points.shape
    assert moved[1, 2] == pytest.approx((full(A) @ np.append(points[1, 2], 1))[:3])
    assert np.array_equal(compose(A), A)


def test_a_base_on_the_floor_looks_along_its_heading():
    X = planar(1.0, -2.0, 0.4)
    assert apply(X, np.array([3.0, 0, 0])) == pytest.approx([1 + 3 * np.cos(0.4), -2 + 3 * np.sin(0.4), 0])
    assert X[:, 2] == pytest.approx([0, 0, 1])


def test_wrap_keeps_the_angle_modulo_the_period_and_within_half_of_it():
    for period in (2 * np.pi, np.pi, np.pi / 2):
        for angle in np.linspace(-9, 9, 181):
            out = wrap(angle, period)
            assert -period / 2 <= out < period / 2
            assert np.sin(np.pi * (out - angle) / period) == pytest.approx(0, abs=1e-12)
    assert wrap(np.pi) == -np.pi
    assert wrap(0.3) == pytest.approx(0.3, abs=1e-15)
