"""Several estimates made one."""

import dataclasses as dc
import pathlib

import numpy as np
from drawn_scene import edge_points, facing, nees, pose_error

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.messages import RectangleEstimate
from valve_drake.perception.fusion import MOVING, fuse
from valve_drake.perception.marker import Marker
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, Track, estimate

ROOT = pathlib.Path(__file__).parents[1]
HEAD = load_head(ROOT / "models" / "calibration" / "head.yaml")
MARKER = Marker()
CONFIG = RectangleEstimatorConfig(side_bias=0.0)  # synthetic points have no bias
HALF_TURN = frames.make(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


def estimates(X_OV, n, rng, sigma=0.1):
    out = []
    for k in range(n):
        X_OL = frames.make(frames.rot_y(0.02 * k), np.array([0.01 * k, 0, 0]))
        X_LV = frames.compose(frames.inverse(X_OL), X_OV)
        found = estimate(edge_points(X_LV, HEAD, MARKER, sigma, rng), HEAD, MARKER, CONFIG, Track(X_LV))
        out.append(dc.replace(found, X_OL=X_OL, axis_known=True))
    return out


def test_fusion_is_better_than_one_frame_and_honest():
    rng, X = np.random.default_rng(0), facing(1.0, 0.3, 0.2, 0.3)
    values, single = [], []
    for _ in range(12):
        seen = estimates(X, 8, rng)
        fused = fuse(seen, common=0.0)
        assert fused.found and fused.used >= 7
        values.append(nees(pose_error(fused.X_OV, X), fused.covariance))
        single.append(np.diag(seen[0].covariance) / np.diag(fused.covariance))
    assert 0.6 < np.mean(values) < 1.5
    assert 4 < np.mean(single) < 9
    careful = fuse(seen, common=1.0)
    assert (np.diag(careful.covariance) > 0.75 * np.diag(seen[0].covariance)).all()


def test_fusion_drops_outliers_and_half_turns():
    rng, X = np.random.default_rng(1), facing(1.0, 0.3, 0.2, 0.3)
    seen = estimates(X, 8, rng)
    seen[3] = dc.replace(seen[3], X_LV=frames.compose(seen[3].X_LV, frames.make(frames.rot_x(0.2), np.zeros(3))))
    seen[5] = dc.replace(seen[5], X_LV=frames.compose(seen[5].X_LV, HALF_TURN))
    fused = fuse(seen)
    assert fused.used == 7
    assert np.abs(pose_error(fused.X_OV, X)[:3]).max() < 0.002
    assert (fused.spread > 0).all() and fused.spread[:3].max() < 0.002


def test_frames_of_a_base_that_drives_have_their_mean_among_them():
    """Its odometry goes astray by millimetres from frame to frame, and each estimate is sure of a line through its
    angles and its place: where those lines would meet is far from all of them."""
    rng, worst, naive = np.random.default_rng(2), [], []
    for tilt in (0.3, 0.8, 1.2):
        X = facing(1.5, tilt, 0.2, 0.1)
        for _ in range(6):
            seen = estimates(X, 5, rng)
            drift = rng.normal(size=(5, 2)).cumsum(axis=0) * [0.002, 0.003]  # yaw, aside
            seen = [
                dc.replace(e, X_OL=frames.compose(frames.make(frames.rot_y(yaw), np.array([aside, 0, 0])), e.X_OL))
                for e, (yaw, aside) in zip(seen, drift)
            ]
            places = np.array([frames.compose(e.X_OL, e.X_LV)[:, 3] for e in seen])
            for out, apart in ((naive, (0.0, 0.0)), (worst, MOVING)):
                mean = fuse(seen, apart=apart).X_OV[:, 3]
                out.append(np.maximum(places.min(0) - mean, mean - places.max(0)).max())
    assert max(worst) < 0.001 and max(naive) > 0.005


def test_fusion_of_nothing_has_a_reason():
    assert fuse([]).reason and not fuse([]).found
    assert fuse([RectangleEstimate(reason="border")]).reason == "border"
