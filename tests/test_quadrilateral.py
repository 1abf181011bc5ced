"""Geometry of quadrilaterals in one image plane."""

import numpy as np
from drawn_scene import facing

from valve_drake import frames
from valve_drake.perception.marker import Marker
from valve_drake.perception.quadrilateral import corner_offset, from_outline, meet, middle, side_lines, through_corners

QUAD = np.array([[10.0, 12.0], [80.0, 5.0], [90.0, 70.0], [15.0, 60.0]])


def test_quadrilateral_turns_clockwise_and_a_triangle_is_none():
    square = np.array([[10, 10], [10, 60], [70, 60], [70, 10]])  # counter-clockwise as seen
    corners = from_outline(square)
    d = np.roll(corners, -1, 0) - corners
    assert (d[:, 0] * np.roll(d, -1, 0)[:, 1] - d[:, 1] * np.roll(d, -1, 0)[:, 0] > 0).all()
    assert from_outline(np.array([[0, 0], [60, 0], [30, 50]])) is None


def test_a_covered_corner_is_where_its_sides_would_meet():
    square = np.array([[10, 10], [110, 20], [100, 120], [5, 105]])
    for k in range(4):
        before, corner, after = square[k - 1], square[k], square[(k + 1) % 4]
        cut = [corner + 0.2 * (before - corner), corner + 0.3 * (after - corner)]
        outline = np.vstack([square[:k], cut, square[k + 1 :]])
        off = np.linalg.norm(from_outline(outline)[:, None] - square, axis=2).min(0)
        assert off.max() < 2
    assert from_outline(np.array([[0, 0], [60, 0], [80, 57], [30, 92], [-20, 57]])) is None  # no corner of a pentagon


def test_diagonals_meet_in_the_image_of_the_centre():
    X = facing(0.4, 0.7, 0.2, 0.3)
    P = frames.apply(X, Marker().corners())
    np.testing.assert_allclose(middle(P[:, :2] / P[:, 2:]), X[:2, 3] / X[2, 3], atol=1e-12)


def test_sides_through_corners_meet_in_them_and_are_positive_inside():
    lines = through_corners(QUAD)
    np.testing.assert_allclose(meet(lines), QUAD, atol=1e-9)
    assert (lines[:, :2] @ QUAD.mean(0) + lines[:, 2] > 0).all()


def test_lines_through_points_on_the_sides_are_the_sides():
    share = np.linspace(0.1, 0.9, 7)
    points = QUAD[:, None] + share[:, None] * (np.roll(QUAD, -1, 0) - QUAD)[:, None]
    lines, scatter = side_lines(points.reshape(-1, 2), np.repeat(np.arange(4), 7))
    np.testing.assert_allclose(meet(lines), QUAD, atol=1e-9)
    assert scatter < 1e-9


def test_offset_of_the_first_corner_is_found():
    for k in range(4):
        assert corner_offset(QUAD, np.roll(QUAD, k, axis=0) + [30.0, 1.0]) == k
