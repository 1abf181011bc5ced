"""Colours mixed to one linear channel, with shadows evened."""

import dataclasses as dc

import cv2
import numpy as np
import pytest
from drawn_quads import CONFIG, HEAD, MARKER, distances, fit, quad_image, true_quad
from drawn_scene import facing

from valve_drake import frames
from valve_drake.analysis.drawn_images import Canvas, draw_bar
from valve_drake.perception.channel import even_light


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
    assert even_light(image, image, mask, 1)[0] is image
    canvas = Canvas(HEAD.left)
    draw_bar(canvas, X, MARKER)
    canvas.shade(X, 0.3, 2.0)
    image = canvas.finish(np.random.default_rng(0), 2.0).astype(np.float32)
    even, _ = even_light(image, image, mask, 1)
    inside = cv2.erode(mask, np.ones((9, 9))) > 0
    assert image[inside][:, 0].std() > 50 and even[inside][:, 0].std() < 8


def test_gamma_of_an_ordinary_camera_is_undone():
    X = facing(0.8, 0.1, 0.1, 0.2)
    encoded = (255 * (quad_image(X, None, blur=1.2) / 255.0) ** (1 / 2.2)).round().astype(np.uint8)
    straight = fit(encoded, true_quad(X), dc.replace(CONFIG, gamma=2.2))
    wrong = fit(encoded, true_quad(X))
    inward = [[np.mean(distances(q, X)[q.side == k]) for k in range(4)] for q in (straight, wrong)]
    assert np.abs(inward[0]).max() < 0.02 < np.abs(inward[1]).max()


@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_a_colour_that_is_not_clipped_counts_by_its_contrast_beside_the_sides(turn):
    """In bright light a plate is as red as the marker, and the other colours are clipped; the wall behind is not."""
    X = facing(1.9, 0.2, 0.2, turn)
    canvas = Canvas(HEAD.left)
    canvas.rectangle(X, (155, 175, 195), (0.4, 0.4))
    canvas.disc(X, (231, 256, 262), (0.07, 0.07))
    canvas.rectangle(X, (237, 18, 17), (0.049, 0.05))
    quad = fit(canvas.finish(np.random.default_rng(0), 2.0), true_quad(X))
    assert quad.reason == ""
    off = distances(quad, X)
    # What clipping moves the edges by is what is claimed of it.
    assert quad.bias.min() > 0.02
    assert max(abs(off[quad.side == k].mean()) for k in range(4)) < 3 * quad.bias.max()
