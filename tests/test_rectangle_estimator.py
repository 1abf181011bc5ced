"""The marker's pose: the paper's closed form against its tables, least squares against the Cramer-Rao bound."""

import dataclasses as dc
import pathlib

import numpy as np
import pytest
import yaml
from drawn_scene import Drawing, draw_valve, edge_points, facing, pose_error
from helpers import Rig, ports, same

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.checks import ConfigError
from valve_drake.messages import MarkerEdges, ModeState, QuadEdges, RectangleEstimate, RobotState
from valve_drake.perception import estimate_rectangle
from valve_drake.perception.joint_fit import NODES
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.matching import epipolar_offset
from valve_drake.perception.quadrilateral import meet, side_lines
from valve_drake.perception.rectangle_estimator import (
    RectangleEstimatorConfig,
    Track,
    _linearize,
    _moments,
    _views,
    _weights,
    estimate,
    fuse,
)
from valve_drake.perception.rectangle_estimator_system import RectangleEstimatorSystem

ROOT = pathlib.Path(__file__).parents[1]
HEAD = load_head(ROOT / "models" / "calibration" / "head.yaml")
TABLES = ROOT.parent / "shared" / "paper" / "tables.yaml"
MARKER = Marker()
CONFIG = RectangleEstimatorConfig(side_bias=0.0)  # synthetic points have no bias
PAPER = dc.replace(CONFIG, method="paper")
POSES = [facing(0.5, 0.3, 0.2, 0.3, 0.02, 0.03), facing(1.0, -0.4, 0.1, -0.5), facing(2.0, 0.35, 0.3, 0.6, -0.2, 0.1)]
HALF_TURN = frames.make(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))


def table_2():
    """T_e, T_c, T_w of the six samples and T_m [m], rotations made orthonormal."""
    if not TABLES.is_file():
        pytest.skip("needs the paper's tables in ../shared/paper, which are not part of the project")
    data = yaml.safe_load(TABLES.read_text())

    def rigid(rows):
        T = np.array(rows)
        u, _, v = np.linalg.svd(T[:, :3])
        return frames.make(u @ v, T[:, 3] / 1000)

    samples = data["table_2_verification"]["samples"]
    T_m = rigid(data["eq_26_T_m"]["matrix"])
    return T_m, [{name: rigid(sample[name]) for name in ("T_e", "T_c", "T_w")} for sample in samples]


def nees(error, covariance):
    return float(error @ np.linalg.solve(covariance, error)) / 6


# ---------------------------------------------------------------- the paper's method


def test_table_2_is_consistent():
    T_m, samples = table_2()
    for sample in samples:
        X = frames.compose(sample["T_e"], T_m, sample["T_c"])
        assert np.abs(X[:, 3] - sample["T_w"][:, 3]).max() < 0.2e-3
        assert np.abs(X[:, :3] - sample["T_w"][:, :3]).max() < 3e-4


@pytest.mark.parametrize("cameras", ["left", "both"])
def test_paper_has_the_known_bias_of_its_fine_step_and_the_exact_step_none(cameras):
    T_m, samples = table_2()
    bias = [-0.83, -1.58, -0.58, -0.35, -1.07, -1.15]  # of p_z [mm]
    world = []
    for sample, expected in zip(samples, bias):
        X = sample["T_c"]
        edges = edge_points(X, HEAD, MARKER, 0.05, cameras=cameras)
        found = estimate(edges, HEAD, MARKER, PAPER)
        assert found.found, found.reason
        np.testing.assert_allclose(found.X_LV[:, :3], X[:, :3], atol=1e-9)  # n, o, a are exact
        assert round((found.X_LV[2, 3] - X[2, 3]) * 1000, 2) == expected
        for step in ("exact", "none"):
            exact = estimate(edges, HEAD, MARKER, dc.replace(PAPER, fine_step=step))
            np.testing.assert_allclose(exact.X_LV, X, atol=1e-10)
        there, truth = (frames.compose(sample["T_e"], T_m, x) for x in (found.X_LV, X))
        world.append(1000 * (there[:, 3] - truth[:, 3]))
    # Carried through T_e T_m, the bias alone makes most of the spread that the paper prints (0.80, 0.91, 1.63 mm).
    spread = np.linalg.norm(np.std(world, axis=0, ddof=1))
    assert 0.3 < spread < 2.5


def test_paper_depth_bias_grows_with_equal_tilt_about_both_axes():
    for degrees, expected in ((10, -0.1), (20, -1.1), (30, -5.0), (40, -15.6)):
        tilt = np.radians(degrees) / np.sqrt(2)
        X = facing(0.96, tilt, tilt)
        found = estimate(edge_points(X, HEAD, MARKER, 0.05, cameras="left"), HEAD, MARKER, PAPER)
        assert abs((found.X_LV[2, 3] - 0.96) * 1000 - expected) < 0.1 + 0.03 * abs(expected)


def test_paper_takes_its_second_case_when_the_camera_is_square_to_the_target():
    X = facing(0.8)
    found = estimate(edge_points(X, HEAD, MARKER, 0.05), HEAD, MARKER, PAPER)
    np.testing.assert_allclose(found.X_LV, X, atol=1e-9)


def test_paper_covariance_is_honest():
    rng = np.random.default_rng(0)
    exact = dc.replace(PAPER, fine_step="exact")
    for X in POSES[:2]:
        values = []
        for _ in range(30):
            found = estimate(edge_points(X, HEAD, MARKER, 0.05, rng), HEAD, MARKER, exact)
            values.append(nees(pose_error(found.X_LV, X), found.covariance))
        assert 0.75 < np.mean(values) < 1.3


# ---------------------------------------------------------------- refined


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
    views, _ = _views(edges, HEAD, config)
    moments = _moments(views, [v.trust for v in views], config)
    model, yaw, e = MARKER.corners(), 0.01, 1e-6
    R, p = frames.rotation(np.array([0.02, -0.01, 0.03])) @ X[:, :3], X[:, 3] + 0.003

    def residual(d):
        return _linearize(moments, model, R @ frames.rotation(d[:3]), p + d[3:6], yaw + d[6])[0]

    numeric = np.stack([(residual(e * d) - residual(-e * d)) / (2 * e) for d in np.eye(7)], -1)
    analytic = _linearize(moments, model, R, p, yaw)[1]
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


def with_information(edges, turn=0):
    """The same edges as corners and the information of two nodes on each side; the right image's sides counted anew."""
    quads = []
    for quad, k in ((edges.left, 0), (edges.right, turn)):
        side = quad.side.astype(int)
        corners = meet(side_lines(quad.points, side)[0])
        along = corners[NEXT] - corners
        share = ((quad.points - corners[side]) * along[side]).sum(1) / (along[side] ** 2).sum(1)
        second = (share - NODES[0]) / (NODES[1] - NODES[0])
        information = np.zeros((8, 8))
        for n in range(4):
            rows = np.column_stack([1 - second, second])[side == n] / quad.sigma
            information[2 * n : 2 * n + 2, 2 * n : 2 * n + 2] = rows.T @ rows
        order = (np.arange(8) + 2 * k) % 8
        quads.append(
            dc.replace(
                quad,
                side=(side - k) % 4,
                corners=np.roll(corners, -k, axis=0),
                information=information[np.ix_(order, order)],
            )
        )
    return dc.replace(edges, left=quads[0], right=quads[1])


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
        moments = _moments(_views(edges, HEAD, CONFIG)[0], [], CONFIG)
        for pan in (-0.3, 0.3):
            found = estimate(edges, HEAD, MARKER, CONFIG, Track(facing(1.2, pan, 0.0, 0.0)))
            r, J = _linearize(moments, marker, found.X_LV[:, :3], found.X_LV[:, 3], 0.0)
            g = J.T @ r
            assert g @ np.linalg.solve(J.T @ J, g) < 1e-3  # of chi^2, that a step would gain


def test_moments_of_one_view_do_not_depend_on_how_the_other_is_told():
    edges = edge_points(POSES[0], HEAD, MARKER, 0.1, np.random.default_rng(0))
    informed = with_information(edges)
    both, mixed = (
        _moments(views, [view.trust for view in views], CONFIG).B
        for views in (_views(e, HEAD, CONFIG)[0] for e in (informed, dc.replace(informed, left=edges.left)))
    )
    np.testing.assert_allclose(mixed[1], both[1], rtol=1e-12)
    assert not np.allclose(mixed[0], both[0])


def test_points_are_not_believed_better_than_min_sigma_with_their_information_either():
    edges = with_information(edge_points(POSES[1], HEAD, MARKER, 0.02))
    plain, careful = (
        estimate(edges, HEAD, MARKER, dc.replace(CONFIG, min_sigma=s), Track(POSES[1])) for s in (0.01, 0.04)
    )
    np.testing.assert_allclose(careful.covariance, 4 * plain.covariance, rtol=0.02)


def test_cameras_that_are_not_as_calibrated_make_the_covariance_larger():
    X = POSES[1]
    edges = with_information(edge_points(X, HEAD, MARKER, 0.02, np.random.default_rng(0)))
    turned = frames.compose(HEAD.X_LR, frames.make(frames.rot_x(0.0005), np.zeros(3)))  # half a pixel
    right, wrong = (estimate(edges, head, MARKER, CONFIG, Track(X)) for head in (HEAD, dc.replace(HEAD, X_LR=turned)))
    assert right.found and wrong.found
    assert (np.diag(wrong.covariance) > 4 * np.diag(right.covariance)).all()
    assert wrong.ambiguity < right.ambiguity


def off_the_epipolar_line(edges: MarkerEdges, px: float) -> MarkerEdges:
    """The right image's points, moved down by `px`."""
    down = np.array([0.0, px / HEAD.right.focal()])
    right = dc.replace(edges.right, points=edges.right.points + down, corners=edges.right.corners + down)
    return dc.replace(edges, right=right)


@pytest.mark.parametrize("told", ["points", "information", "information of one"])
@pytest.mark.parametrize("method", ["refined", "paper"])
@pytest.mark.parametrize("px", [-2.0, 0.02, 0.3, 1.0, 2.0, 3.0, 3.9, 5.0])
def test_a_right_image_that_lies_lower_is_within_the_covariance_or_refused_with_its_size(told, method, px):
    X = facing(1.0, 0.0, 0.02, 0.0, -0.25, 0.1)
    edges = edge_points(X, HEAD, MARKER, 0.03, np.random.default_rng(0))
    informed = with_information(edges)
    edges = {"points": edges, "information": informed}.get(told, dc.replace(informed, left=edges.left))
    config = dc.replace(CONFIG, method=method, max_residual=1.2)
    found = estimate(off_the_epipolar_line(edges, px), HEAD, MARKER, config, Track(X))
    if found.found:
        assert abs(px) < 4
        assert (np.linalg.eigvalsh(found.covariance) > 0).all()
        assert (np.abs(pose_error(found.X_LV, X)) < 4 * np.sqrt(np.diag(found.covariance))).all()
        assert abs(pose_error(found.X_LV, X)[4]) < 0.01
    else:
        assert abs(px) > 1 and found.reason == f"epipolar: {abs(px):.1f} px"


def test_an_oblique_marker_near_converging_cameras_is_on_its_epipolar_line():
    """The mean of the corners is not the image of the centre: here it is 2 px off."""
    X = facing(0.3, 0.1, 0.75, 0.6)
    eyes = dc.replace(HEAD, X_LR=frames.make(frames.rot_y(-0.36), HEAD.X_LR[:, 3]))
    for k in range(4):
        edges = edge_points(frames.compose(X, frames.make(frames.rot_z(k * 0.7), np.zeros(3))), eyes, MARKER, 0.05)
        off = epipolar_offset(edges.left.corners, edges.right.corners, eyes.X_LR)
        assert np.linalg.norm(off) * HEAD.right.focal() < 1e-6


def test_robust_weights_leave_every_side_most_of_its_own():
    X = facing(1.0, 0.0, 0.02, 0.0, -0.25, 0.1)
    edges = off_the_epipolar_line(edge_points(X, HEAD, MARKER, 0.03, np.random.default_rng(0)), 2.5)
    views, _ = _views(edges, HEAD, CONFIG)
    for view in views:
        off = np.where(view.side % 2 == 0, 3.0, 0.01)  # two sides lie off as a whole
        weight = _weights(view, off, CONFIG)
        assert (np.bincount(view.side, weight, 4) > 0.4 * np.bincount(view.side, minlength=4)).all()


def test_edges_that_determine_no_pose_are_refused():
    edges = with_information(edge_points(POSES[1], HEAD, MARKER, 0.05))
    nothing = np.zeros((8, 8))
    nothing[0, 0] = 1.0
    one = dc.replace(edges, left=dc.replace(edges.left, information=nothing), right=QuadEdges(reason="not used"))
    found = estimate(one, HEAD, MARKER, CONFIG)
    assert not found.found and found.reason == "the sides do not determine a pose"


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


def test_two_tilts_that_nothing_decides_between_are_both_within_the_covariance():
    X, far = facing(3.0, 0.15, 0.05, 0.1), 0.0
    for seed in range(20):
        edges = edge_points(X, HEAD, MARKER, 0.3, np.random.default_rng(seed), cameras="left")
        found = estimate(edges, HEAD, MARKER, CONFIG)
        far = max(far, float((np.abs(pose_error(found.X_LV, X)) / np.sqrt(np.diag(found.covariance)))[:2].max()))
    assert far < 4


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


# ---------------------------------------------------------------- the mirrored tilt, and which axis is X


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


# ---------------------------------------------------------------- gates


@pytest.mark.parametrize(
    ("X", "marker", "says"),
    [
        (facing(0.2, 0.2), MARKER, "distance"),
        (facing(7.0, 0.2), MARKER, "distance"),
        (facing(1.0, np.radians(80)), MARKER, "tilt"),
        (facing(1.0, 0.2), Marker(size=[0.2, 0.2], handle_radius=0.3), "size|residual"),
    ],
)
def test_implausible_pose_is_refused(X, marker, says):
    # The edges are those of MARKER; the last estimator believes in a larger one.
    found = estimate(edge_points(X, HEAD, MARKER, 0.05), HEAD, marker, dc.replace(CONFIG, max_distance=6.0))
    assert not found.found and any(word in found.reason for word in says.split("|"))


def test_no_edges_no_pose():
    edges = MarkerEdges(left=QuadEdges(reason="no candidate in the left image"))
    found = estimate(edges, HEAD, MARKER, CONFIG)
    assert not found.found and found.reason == "no candidate in the left image"


def test_sides_in_disorder_are_refused():
    edges = edge_points(POSES[0], HEAD, MARKER, 0.05)
    twisted = dc.replace(edges.left, side=np.array([0, 2, 1, 3])[edges.left.side.astype(int)])
    assert not estimate(dc.replace(edges, left=twisted), HEAD, MARKER, CONFIG).found
    lacking = dc.replace(edges.left, side=np.minimum(edges.left.side, 2))
    assert not estimate(dc.replace(edges, left=lacking), HEAD, MARKER, CONFIG).found


# ---------------------------------------------------------------- several frames


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


def test_fusion_of_nothing_has_a_reason():
    assert fuse([]).reason and not fuse([]).found
    assert fuse([RectangleEstimate(reason="border")]).reason == "border"


# ---------------------------------------------------------------- from images


def images(X_LV, rng, noise=2.0):
    out = []
    for lens, X_CL in ((HEAD.left, np.eye(3, 4)), (HEAD.right, frames.inverse(HEAD.X_LR))):
        drawing = Drawing(lens)
        draw_valve(drawing, frames.compose(X_CL, X_LV), MARKER)
        out.append(drawing.finish(rng, noise=noise))
    return out


@pytest.mark.parametrize(("z", "degrees", "mm"), [(0.8, 0.05, 0.1), (1.0, 0.1, 0.2), (2.0, 0.3, 1.0), (4.0, 1.0, 8.0)])
def test_pose_from_drawn_images(z, degrees, mm):
    rng = np.random.default_rng(0)
    for roll in (0.3, -0.9):
        X = facing(z, 0.3, -0.25, roll, 0.03 * z, 0.03 * z)
        found = estimate_rectangle(*images(X, rng), HEAD)
        assert found.found and found.axis_known and found.cameras == 2, found.reason
        error = pose_error(found.X_LV, X)
        assert np.degrees(np.linalg.norm(error[:3])) < degrees
        assert 1000 * np.linalg.norm(error[3:]) < mm
        assert nees(error, found.covariance) < 5
        assert found.corners_left.shape == found.corners_right.shape == (4, 2)


def test_one_image_and_the_paper_method_work_too():
    X = facing(0.8, 0.3, -0.25, 0.3)
    left, right = images(X, np.random.default_rng(0))
    alone = estimate_rectangle(left, None, HEAD)
    left[0, 0] = left[0, 0]  # the caller's images stay the caller's
    assert alone.found and alone.cameras == 1
    assert np.degrees(np.linalg.norm(pose_error(alone.X_LV, X)[:3])) < 0.3
    paper = estimate_rectangle(left, right, HEAD, method="paper")
    assert paper.found and paper.method == "paper"
    assert 1000 * np.linalg.norm(pose_error(paper.X_LV, X)[3:]) < 8


def test_bad_arguments_are_refused():
    image = np.zeros((480, 640, 3), np.uint8)
    with pytest.raises(ConfigError, match="rectangle_estimator.method"):
        estimate_rectangle(image, image, HEAD, method="magic")
    with pytest.raises(ConfigError, match="marker.size"):
        estimate_rectangle(image, image, HEAD, (0.0, 0.1))
    with pytest.raises(ValueError, match="640 x 480"):
        estimate_rectangle(image[:100], image, HEAD)
    with pytest.raises(ConfigError, match="rectangle_estimator.loss_width"):
        dc.replace(CONFIG, loss_width=0.0).check()


# ---------------------------------------------------------------- the block


def head_pose(odometry, torso):
    return frames.planar(*odometry)


def rig(edges, mode="search", activation=1):
    block = RectangleEstimatorSystem(CONFIG, HEAD, head_pose)
    return Rig(block, edges=edges, robot_state=RobotState(), mode=ModeState(mode=mode, activation=activation))


def at(edges, k):
    return dc.replace(edges, sequence=k, time=k / 8)


def test_ports():
    assert ports(RectangleEstimatorSystem(CONFIG, HEAD, head_pose)) == {
        "edges": "in abstract",
        "robot_state": "in abstract",
        "mode": "in abstract",
        "estimate": "out abstract",
    }


def test_block_holds_follows_the_axis_and_forgets_it_at_a_search():
    dut = rig(at(edge_points(facing(1.0, 0.1, 0.1, 0.5), HEAD, MARKER, 0.05), 0))
    first = dut.run(0.1).read("estimate")
    assert first.found and dut.run(0.2).read("estimate") is first
    clone = dut.context.Clone()
    for k, roll in enumerate((0.8, 1.1, 1.4, 1.7, 2.0), 1):
        X = facing(1.0, 0.1, 0.1, roll)
        dut.fix(edges=at(edge_points(X, HEAD, MARKER, 0.05), k))
        found = dut.run(0.2 + k / 8).read("estimate")
        np.testing.assert_allclose(found.X_LV, X, atol=1e-7)
    dut.fix(mode=ModeState(afresh=True, activation=2), edges=at(edge_points(X, HEAD, MARKER, 0.05), 9))
    assert dut.run(1.4).read("estimate").X_LV[0, 0] > 0.6  # n_x > 0 again
    assert dut.read("estimate", clone) is first
    again = rig(at(edge_points(facing(1.0, 0.1, 0.1, 0.5), HEAD, MARKER, 0.05), 0)).run(0.1).read("estimate")
    assert same(again, first)


def test_block_does_not_follow_over_a_long_gap():
    dut = rig(at(edge_points(facing(1.0, 0.1, 0.1, 1.4), HEAD, MARKER, 0.05), 0))
    dut.run(0.1)
    X = facing(1.0, 0.1, 0.1, 2.2)
    dut.fix(edges=dc.replace(edge_points(X, HEAD, MARKER, 0.05), sequence=1, time=60.0))
    assert dut.run(0.3).read("estimate").X_LV[0, 0] > 0.6
