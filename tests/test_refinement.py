"""Least squares on the known rectangle: exact, at the bound, and honest about it."""

import dataclasses as dc
import pathlib

import numpy as np
import pytest
from drawn_scene import edge_points, facing, nees, off_the_epipolar_line, pose_error, with_information

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.perception.marker import Marker
from valve_drake.perception.moments import moments_of, robust_weights
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, Track, estimate
from valve_drake.perception.refinement import linearize
from valve_drake.perception.views import views_of

ROOT = pathlib.Path(__file__).parents[1]
HEAD = load_head(ROOT / "models" / "calibration" / "head.yaml")
MARKER = Marker()
CONFIG = RectangleEstimatorConfig(side_bias=0.0)  # synthetic points have no bias
POSES = [facing(0.5, 0.3, 0.2, 0.3, 0.02, 0.03), facing(1.0, -0.4, 0.1, -0.5), facing(2.0, 0.35, 0.3, 0.6, -0.2, 0.1)]


@pytest.mark.parametrize("cameras", ["left", "right", "both"])
@pytest.mark.parametrize("k", range(3))
def test_refined_is_exact_without_noise_whatever_corner_comes_first(cameras, k):
    for first in range(4):
        edges = edge_points(POSES[k], HEAD, MARKER, 0.05, cameras=cameras, first=first)
        track = Track(POSES[k], True)
        found = estimate(edges, HEAD, MARKER, CONFIG, track)
        assert found.found, found.reason
        np.testing.assert_allclose(found.X_LV, POSES[k], atol=1e-8)
        assert found.cameras == (2 if cameras == "both" else 1)
        assert found.residual_px < 1e-6


@pytest.mark.parametrize("told", ["points", "information", "information of one"])
def test_jacobian_equals_finite_differences(told):
    X = facing(0.9, 0.4, -0.3, 0.5, 0.1, 0.05)
    edges = edge_points(X, HEAD, MARKER, 0.1, np.random.default_rng(0))
    config = dc.replace(CONFIG, yaw_sigma=0.02)
    informed = with_information(edges)
    edges = {"points": edges, "information": informed}.get(told, dc.replace(informed, left=edges.left))
    views, _ = views_of(edges, HEAD, config)
    moments = moments_of(views, [v.trust for v in views], config)
    model, yaw, e = MARKER.corners(), 0.01, 1e-6
    R, p = frames.rotation(np.array([0.02, -0.01, 0.03])) @ X[:, :3], X[:, 3] + 0.003

    def residual(d):
        return linearize(moments, model, R @ frames.rotation(d[:3]), p + d[3:6], yaw + d[6])[0]

    numeric = np.stack([(residual(e * d) - residual(-e * d)) / (2 * e) for d in np.eye(7)], -1)
    analytic = linearize(moments, model, R, p, yaw)[1]
    np.testing.assert_allclose(analytic, numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max())


def cramer_rao(X, sigma, cameras):
    """Bound of the pose's covariance from the point residuals themselves, by finite differences."""
    lines = []
    for lens, X_CL, name in ((HEAD.left, np.eye(3, 4), "left"), (HEAD.right, frames.inverse(HEAD.X_LR), "right")):
        if cameras in ("both", name):
            lines.append((lens, X_CL, getattr(edge_points(X, HEAD, MARKER, sigma, cameras=cameras), name)))

    def residual(d):
        out = []
        moved = frames.make(X[:, :3] @ frames.rotation(d[:3]), X[:, 3] + d[3:])
        for lens, X_CL, quad in lines:
            P = frames.apply(frames.compose(X_CL, moved), MARKER.corners())
            P = np.column_stack([P[:, :2] / P[:, 2:], np.ones(4)])
            h = np.cross(P, np.roll(P, -1, 0))[quad.side.astype(int)]
            A = lens.normalize_jacobian(lens.project(quad.points))
            stretch = np.linalg.norm(np.einsum("nij,ni->nj", A, h[:, :2]), axis=1)
            out.append(((h[:, :2] * quad.points).sum(1) + h[:, 2]) / stretch / sigma)
        return np.concatenate(out)

    J = np.stack([(residual(1e-6 * d) - residual(-1e-6 * d)) / 2e-6 for d in np.eye(6)], -1)
    return np.linalg.inv(J.T @ J)


@pytest.mark.system
@pytest.mark.parametrize("cameras", ["left", "both"])
@pytest.mark.parametrize("k", range(3))
def test_refined_reaches_the_cramer_rao_bound_and_says_so(cameras, k):
    X, rng, sigma, n = POSES[k], np.random.default_rng(k), 0.1, 60
    bound = cramer_rao(X, sigma, cameras)
    errors, values = [], []
    for _ in range(n):
        found = estimate(edge_points(X, HEAD, MARKER, sigma, rng, cameras), HEAD, MARKER, CONFIG, Track(X))
        errors.append(pose_error(found.X_LV, X))
        values.append(nees(errors[-1], found.covariance))
    scale = np.sqrt(np.diag(bound))
    np.testing.assert_allclose(found.covariance / np.outer(scale, scale), bound / np.outer(scale, scale), atol=0.25)
    allowed = 4 * np.sqrt(2 / (6 * n))
    assert abs(np.mean(values) - 1) < allowed
    efficiency = np.mean([nees(e, bound) for e in errors])
    assert abs(efficiency - 1) < allowed


def test_two_nodes_on_each_side_say_what_all_points_say():
    rng = np.random.default_rng(0)
    for k, X in enumerate(POSES):
        edges = edge_points(X, HEAD, MARKER, 0.05, rng)
        points, nodes = (estimate(e, HEAD, MARKER, CONFIG, Track(X)) for e in (edges, with_information(edges, turn=k)))
        scale = np.sqrt(np.diag(points.covariance))
        assert np.abs(pose_error(nodes.X_LV, points.X_LV) / scale).max() < 0.1
        np.testing.assert_allclose(
            nodes.covariance / np.outer(scale, scale), points.covariance / np.outer(scale, scale), atol=0.05
        )
        biased = dc.replace(CONFIG, side_bias=0.02)
        points, nodes = (estimate(e, HEAD, MARKER, biased, Track(X)) for e in (edges, with_information(edges)))
        assert np.trace(points.covariance[:3, :3]) > 1.2 * np.sum(scale[:3] ** 2)
        np.testing.assert_allclose(np.diag(nodes.covariance), np.diag(points.covariance), rtol=0.25)


def test_refined_ends_in_a_minimum_whichever_tilt_the_track_prefers():
    """In a frontal view by one camera a second minimum may not exist, and the track may prefer the side without one."""
    rng, marker = np.random.default_rng(3), MARKER.corners()
    for _ in range(20):
        X = facing(1.2, *rng.uniform(-0.02, 0.02, 2), rng.uniform(-0.5, 0.5))
        edges = edge_points(X, HEAD, MARKER, 0.1, rng, cameras="left")
        edges = dc.replace(with_information(dc.replace(edges, right=edges.left)), right=edges.right)
        moments = moments_of(views_of(edges, HEAD, CONFIG)[0], [], CONFIG)
        for pan in (-0.3, 0.3):
            found = estimate(edges, HEAD, MARKER, CONFIG, Track(facing(1.2, pan, 0.0, 0.0)))
            r, J = linearize(moments, marker, found.X_LV[:, :3], found.X_LV[:, 3], 0.0)
            g = J.T @ r
            assert g @ np.linalg.solve(J.T @ J, g) < 1e-3  # of chi^2, that a step would gain


def test_moments_of_one_view_do_not_depend_on_how_the_other_is_told():
    edges = edge_points(POSES[0], HEAD, MARKER, 0.1, np.random.default_rng(0))
    informed = with_information(edges)
    both, mixed = (
        moments_of(views, [view.trust for view in views], CONFIG).B
        for views in (views_of(e, HEAD, CONFIG)[0] for e in (informed, dc.replace(informed, left=edges.left)))
    )
    np.testing.assert_allclose(mixed[1], both[1], rtol=1e-12)
    assert not np.allclose(mixed[0], both[0])


def test_cameras_that_are_not_as_calibrated_make_the_covariance_larger():
    X = POSES[1]
    edges = with_information(edge_points(X, HEAD, MARKER, 0.02, np.random.default_rng(0)))
    turned = frames.compose(HEAD.X_LR, frames.make(frames.rot_x(0.0005), np.zeros(3)))  # half a pixel
    right, wrong = (estimate(edges, head, MARKER, CONFIG, Track(X)) for head in (HEAD, dc.replace(HEAD, X_LR=turned)))
    assert right.found and wrong.found
    assert (np.diag(wrong.covariance) > 4 * np.diag(right.covariance)).all()
    assert wrong.ambiguity < right.ambiguity


def test_robust_weights_leave_every_side_most_of_its_own():
    X = facing(1.0, 0.0, 0.02, 0.0, -0.25, 0.1)
    edges = off_the_epipolar_line(edge_points(X, HEAD, MARKER, 0.03, np.random.default_rng(0)), 2.5, HEAD)
    views, _ = views_of(edges, HEAD, CONFIG)
    for view in views:
        off = np.where(view.side % 2 == 0, 3.0, 0.01)  # two sides lie off as a whole
        weight = robust_weights(view, off, CONFIG)
        assert (np.bincount(view.side, weight, 4) > 0.4 * np.bincount(view.side, minlength=4)).all()


@pytest.mark.parametrize("change", ["yaw", "roll", "wider", "other size"])
def test_a_contradiction_between_the_cameras_is_within_the_covariance(change):
    """The head may be off its calibration or the marker of another size: the covariance must hold either error."""
    R, scale = np.eye(3), 1.0
    if change in ("yaw", "roll"):
        R = frames.rotation(np.radians(0.2) * np.array([0, 1, 0] if change == "yaw" else [0, 0, 1]))
    really = dc.replace(HEAD, X_LR=frames.compose(HEAD.X_LR, frames.make(R, np.zeros(3))))
    marker = Marker(size=[0.102, 0.104]) if change == "other size" else MARKER
    for k, X in enumerate(POSES[:2]):
        edges = edge_points(X, really, marker, 0.03, np.random.default_rng(k))
        if change == "wider":
            right = edges.right
            scale = np.array([1.01, 1.0])
            edges = dc.replace(
                edges, right=dc.replace(right, points=right.points * scale, corners=right.corners * scale)
            )
        found = estimate(edges, HEAD, MARKER, dc.replace(CONFIG, max_residual=5.0, epipolar_gate=9.0), Track(X))
        assert found.found, found.reason
        off = np.abs(pose_error(found.X_LV, X)) / np.sqrt(np.diag(found.covariance))
        assert off.max() < 4, off


def test_a_bias_of_all_sides_widens_the_distance_that_one_eye_tells():
    edges = with_information(edge_points(POSES[1], HEAD, MARKER, 0.05, cameras="left"))
    biased = dc.replace(edges, left=dc.replace(edges.left, bias=np.full(4, 0.4)))
    sure, unsure = (estimate(e, HEAD, MARKER, CONFIG, Track(POSES[1])) for e in (edges, biased))
    side = np.linalg.norm(np.diff(edges.left.corners_px, axis=0), axis=1).mean()
    assert unsure.covariance[5, 5] > 4 * sure.covariance[5, 5]
    assert np.sqrt(unsure.covariance[5, 5]) < 0.8 / side * 1.5  # of a metre: both sides by 0.4 px of the width


def test_covariance_is_honest_where_the_tilt_folds():
    """In a frontal view by one camera the image depends on the tilt's square: noise makes the marker seem tilted."""
    X, rng = facing(2.5, 0.0, 0.0, 0.3), np.random.default_rng(4)
    values = []
    for _ in range(150):
        found = estimate(edge_points(X, HEAD, MARKER, 0.04, rng, "left"), HEAD, MARKER, CONFIG, Track(X))
        values.append(nees(pose_error(found.X_LV, X), found.covariance))
    assert 0.8 < np.mean(values) < 1.4  # 2.0 if the tilt that is found is believed


def test_outliers_on_a_side_do_not_move_the_pose():
    rng = np.random.default_rng(3)
    X = POSES[1]
    edges = edge_points(X, HEAD, MARKER, 0.05, rng)
    points = np.array(edges.left.points)
    points[5:15] += 0.004  # a finger across ten points: 4 px
    bad = dc.replace(edges, left=dc.replace(edges.left, points=points))
    clean, robust = (estimate(e, HEAD, MARKER, CONFIG) for e in (edges, bad))
    none = estimate(bad, HEAD, MARKER, dc.replace(CONFIG, loss="none", max_residual=50.0))
    assert robust.found
    scale = np.sqrt(np.diag(clean.covariance))
    off, moved = (np.abs(pose_error(e.X_LV, clean.X_LV) / scale).max() for e in (robust, none))
    assert off < 2 < moved


def test_yaw_of_the_head_is_estimated_from_the_known_size():
    X, yaw = facing(1.0, 0.3, 0.2, 0.3), np.radians(0.05)
    really = dc.replace(HEAD, X_LR=frames.compose(HEAD.X_LR, frames.make(frames.rot_y(yaw), np.zeros(3))))
    edges = edge_points(X, really, MARKER, 0.02)
    trusting = estimate(edges, HEAD, MARKER, CONFIG, Track(X))
    estimating = estimate(edges, HEAD, MARKER, dc.replace(CONFIG, yaw_sigma=0.002), Track(X))
    wrong, right = (abs(e.X_LV[2, 3] - 1.0) for e in (trusting, estimating))
    assert wrong > 0.003 and right < 0.1 * wrong
    edges = edge_points(X, HEAD, MARKER, 0.02)
    sure, unsure = (estimate(edges, HEAD, MARKER, dc.replace(CONFIG, yaw_sigma=s)) for s in (0.0, 0.002))
    assert unsure.covariance[5, 5] > 2 * sure.covariance[5, 5]
