"""Following the edges of one quadrilateral: exact, independent, and honest about its noise."""

import numpy as np
import pytest
from drawn_quads import CONFIG, HEAD, distances, fit, quad_image, true_quad
from drawn_scene import PLATE, RED, Drawing, facing

from valve_drake.perception.line_fitting import fit_quads
from valve_drake.perception.quadrilateral import meet, side_lines


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
