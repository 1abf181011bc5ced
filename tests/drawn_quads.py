"""One red quadrilateral on a light plate, its true sides, and what is fitted to them; shared by the tests of edges."""

import pathlib

import numpy as np
from drawn_scene import PLATE, RED, Drawing

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.perception.line_fitting import LineFittingConfig, fit_quads
from valve_drake.perception.marker import Marker

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
