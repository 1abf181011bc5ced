"""Calibration: what is put in comes out within its own standard deviations, what cannot be known is refused."""

import dataclasses as dc
import json
import pathlib
import re

import boards
import cv2
import numpy as np
import pytest
import yaml

from valve_drake import frames
from valve_drake.camera import calibration as cal
from valve_drake.camera.board import Board, find_corners, find_images, natural, pair_images, parse_board
from valve_drake.camera.calibration_file import load_calibration, save_camera
from valve_drake.camera.lens import KNOWN, Lens, OpenCvLens, StereoHead, load_head, save_head
from valve_drake.checks import ConfigError
from valve_drake.cli import main
from valve_drake.messages import MarkerEdges, QuadEdges
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig, estimate

DATA = pathlib.Path(__file__).parents[2] / "shared" / "data"
BOARD = Board(9, 6, 0.025, 0.025)
SIZE = (640, 480)
PAPER = Lens(4.2e-7, 3.7e-7, 620.0, 610.0, 324.6, 248.3)
OPENCV = OpenCvLens(np.array([[600, 0, 318], [0, 605, 243], [0, 0, 1]]), np.array([-0.2, 0.08, 1e-3, -5e-4, 0.02]))
X_LR = frames.make(frames.rotation(np.array([0.01, -0.03, 0.005])), np.array([0.09, 0.001, -0.002]))


def needs(folder: str) -> pathlib.Path:
    path = DATA / folder
    if not path.is_dir():
        pytest.skip(f"photographs of ../shared/data/{folder} are not on this machine")
    return path


def views(lenses, poses, sigma: float, seed: int, rigid: bool = False, points=None) -> list[cal.View]:
    """Views of boards at X_LT, their corners with noise sigma [px]."""
    rng, out = np.random.default_rng(seed), []
    for k, X_LT in enumerate(poses):
        mine = BOARD.points() if points is None else points[k]
        X_CT = (X_LT, frames.compose(frames.inverse(X_LR), X_LT))
        px = [boards.corners(lens, X, mine) for lens, X in zip(lenses, X_CT)]
        px = tuple(one + rng.normal(0, sigma, one.shape) for one in px)
        out.append(cal.View((f"{k}",) * len(px), mine, px, 0 if rigid else k))
    return out


def deviations(fit: cal.Fit, lenses) -> np.ndarray:
    """(estimated - true) / standard deviation of all lens parameters."""
    truth = cal.parameters(dc.replace(fit, lenses=tuple(lenses)))
    sigma = fit.sigmas()
    return np.array(
        [(value - truth[name]) / sigma[name] for name, value in cal.parameters(fit).items() if name in sigma]
    )


# ---------------------------------------------------------------- boards and names


def test_corners_of_a_drawn_board_are_found_in_the_order_of_its_colours():
    lens = dc.replace(PAPER, k_x=310.0, k_y=305.0, u_0=160.0, v_0=122.0, width=320, height=240)
    for turn in (0.3, 0.3 + np.pi, -1.4):
        R = frames.rot_z(turn) @ frames.rotation(np.array([0.3, -0.2, 0.0]))
        X_CT = frames.make(R, np.array([0.01, 0.0, 0.42]))
        found = find_corners(boards.draw(lens, X_CT, BOARD), BOARD)
        assert np.abs(found - boards.corners(lens, X_CT, BOARD.points())).max() < 0.15
    assert find_corners(np.full((240, 320), 128, np.uint8), BOARD) is None


def test_a_square_board_is_taken_with_x_to_the_right():
    board = Board(5, 5, 0.03, 0.04)
    lens = dc.replace(PAPER, k_x=310.0, k_y=305.0, u_0=160.0, v_0=122.0, width=320, height=240)
    X_CT = frames.make(frames.rot_z(0.1), np.array([0.0, 0.0, 0.5]))
    found = find_corners(boards.draw(lens, X_CT, board), board)
    assert np.abs(found - boards.corners(lens, X_CT, board.points())).max() < 0.15


def test_names_are_paired_by_their_numbers(tmp_path):
    names = ["b_120cm.png", "b_60cm.png", "b_9cm.png", "a_10.png"]
    for name in names:
        (tmp_path / name).write_bytes(b"")
    found = [path.name for path in find_images([str(tmp_path / "*.png")], "--images")]
    assert found == ["a_10.png", "b_9cm.png", "b_60cm.png", "b_120cm.png"] == sorted(names, key=natural)


def touch(folder: pathlib.Path, *names: str) -> list[pathlib.Path]:
    folder.mkdir(exist_ok=True, parents=True)
    for name in names:
        (folder / name).write_bytes(b"")
    return [folder / name for name in names]


def test_a_name_that_exists_is_taken_as_it_is_and_one_that_does_not_is_refused(tmp_path):
    odd = touch(tmp_path, "r [1].png", "r [2].png", "a*.png", "ab.png")
    inside = touch(tmp_path / "set [left]", "1.png", "2.png")
    assert set(find_images([str(path) for path in odd[:3]], "--images")) == set(odd[:3])
    assert find_images([str(tmp_path / "set [left]" / "*.png")], "--images") == inside
    assert find_images([str(tmp_path / "r*.png")], "--images") == odd[:2]
    for names in (("none.png",), ("none*.png",), ("ab.png", "none.png"), ("ab.png", "none*.png"), ("a\0b",), (".",)):
        with pytest.raises(ConfigError, match=r"--images '.*': no such image") as error:
            find_images([str(tmp_path / name) for name in names], "--images")
        assert "\n" not in str(error.value)


def names_of(pairs) -> list[tuple[str, str]]:
    return [(a.name, b.name) for a, b in pairs.paths]


@pytest.mark.parametrize(
    ("left", "right", "paired", "alone"),
    [
        (["l1", "l2", "l3", "l5"], ["r1", "r2", "r3", "r4"], 3, ["l5", "r4"]),
        (["cam1_8", "cam1_9", "cam1_10"], ["cam2_8", "cam2_9", "cam2_10"], 3, []),
        (["camera_1_60cm", "camera_1_70cm"], ["camera_2_60cm", "camera_2_70cm"], 2, []),
        (["l01", "l02", "l03"], ["r1", "r2", "r3"], 3, []),
        (["a", "b", "c"], ["a", "b", "c"], 3, []),
    ],
)
def test_pairs_are_made_by_the_numbers_in_the_names(tmp_path, left, right, paired, alone):
    sides = [touch(tmp_path / side, *names) for side, names in (("left", left), ("right", right))]
    pairs = pair_images(*sides)
    assert len(pairs.paths) == paired and [path.name for path in pairs.alone] == alone and not pairs.by_order
    assert all(natural(a.name)[-1] == natural(b.name)[-1] or int(a.name[1:]) == int(b.name[1:]) for a, b in pairs.paths)


def test_names_that_tell_no_pairs_are_taken_in_order_and_said_so(tmp_path):
    left, right = touch(tmp_path, "a_17", "a_21"), touch(tmp_path, "b_18", "b_22")
    pairs = pair_images(left, right)
    assert names_of(pairs) == [("a_17", "b_18"), ("a_21", "b_22")] and pairs.by_order
    with pytest.raises(ConfigError, match="must pair up"):
        pair_images(left, right[:1])
    # Images of one name each, in folders that tell them apart.
    left, right = ([touch(tmp_path / f"set{k}", f"{side}.png")[0] for k in (8, 9, 10)] for side in ("left", "right"))
    assert [a.parent == b.parent for a, b in pair_images(left, right[1:] + right[:1]).paths] == [True] * 3


@pytest.mark.system
@pytest.mark.parametrize("scale", [1, 2.2])
@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_corners_of_a_large_noisy_image_are_found_in_a_reduced_one_and_refined_in_it(scale, noise, monkeypatch):
    searched = []
    for name in ("findChessboardCorners", "findChessboardCornersSB"):
        find = getattr(cv2, name)
        monkeypatch.setattr(
            cv2, name, lambda image, *a, find=find, **b: (searched.append(max(image.shape)), find(image, *a, **b))[1]
        )
    lens = dc.replace(PAPER, k_u=5e-8, k_v=5e-8, k_x=2000, k_y=1990, u_0=1310, v_0=960, width=2600, height=1950)
    X_CT = frames.make(frames.rotation(np.array([0.3, -0.25, 0.2])), np.array([0.02, 0.0, 0.45 * scale]))
    image = cv2.GaussianBlur(boards.draw(lens, X_CT, BOARD, 1), (0, 0), 2.0).astype(float)
    image = (image + np.random.default_rng(4).normal(0, noise, image.shape)).clip(0, 255).round().astype(np.uint8)
    error = find_corners(image, BOARD) - boards.corners(lens, X_CT, BOARD.points())
    assert np.sqrt((error**2).sum(1).mean()) < 0.1 and max(searched) == 1300


@pytest.mark.system
def test_pure_noise_is_given_up_without_the_search_that_takes_minutes(monkeypatch):
    quick, find = [], cv2.findChessboardCorners
    monkeypatch.setattr(
        cv2, "findChessboardCorners", lambda image, *a, **b: (quick.append(image.shape), find(image, *a, **b))[1]
    )
    assert find_corners(np.random.default_rng(5).integers(0, 256, (400, 1400)).astype(np.uint8), BOARD) is None
    assert quick == [(371, 1300)]


def test_a_defocused_board_is_refined_with_a_window_that_holds_its_blurred_edges():
    X_CT = frames.make(frames.rotation(np.array([0.3, -0.25, 0.2])), np.array([0.02, 0.0, 0.3]))
    image = cv2.GaussianBlur(boards.draw(PAPER, X_CT, BOARD, 2), (0, 0), 4.0).astype(float)
    image = (image + np.random.default_rng(6).normal(0, 1, image.shape)).clip(0, 255).round().astype(np.uint8)
    error = find_corners(image, BOARD) - boards.corners(PAPER, X_CT, BOARD.points())
    assert np.sqrt((error**2).sum(1).mean()) < 0.1


@pytest.mark.parametrize(
    ("size", "pitch"), [("9", "25x25"), ("9x6", "25"), ("2x6", "25x25"), ("9x6", "0x25"), ("9x6", "nanx5")]
)
def test_bad_board_is_one_clear_line(size, pitch):
    with pytest.raises(ConfigError, match="--board|--pitch"):
        parse_board(size, pitch)


# ---------------------------------------------------------------- intrinsics and stereo


@pytest.mark.parametrize("kind", ["opencv", "paper"])
@pytest.mark.parametrize("cameras", [1, 2])
def test_analytic_jacobian_is_the_numeric_one(kind, cameras):
    model = {"opencv": cal._OpenCvKind(range(5)), "paper": cal._PaperKind()}[kind]
    lens = {"opencv": OPENCV, "paper": PAPER}[kind]
    poses = boards.tilted(2, np.random.default_rng(1))
    problem = cal._Problem(views((lens,) * cameras, poses, 1.0, 2), model, SIZE)
    fit = cal.Fit(kind, (lens,) * cameras, X_LR, tuple(poses), 0.0, np.eye(1), (), problem.names())
    state = cal._State(tuple(cal.kind_parameters(fit)), X_LR if cameras == 2 else None, tuple(poses))
    cost, H, g, _ = problem(state)
    scale = np.sqrt(np.diag(H))
    numeric = np.empty(len(g))
    for k in range(len(g)):
        step = np.zeros(len(g))
        step[k] = 1e-3 / scale[k]
        numeric[k] = (problem(problem.moved(state, step))[0] - problem(problem.moved(state, -step))[0]) / (
            4e-3 / scale[k]
        )
    np.testing.assert_allclose(g / scale, numeric / scale, atol=1e-4 * np.sqrt(cost))


def test_agrees_with_opencv_on_its_own_model():
    seen = views((OPENCV,), boards.tilted(8, np.random.default_rng(3)), 0.2, 4)
    model = cal._OpenCvKind(range(5))  # all terms, also what these few boards do not determine
    start = cal._start(seen, SIZE, model, False, None)
    state = cal._State(tuple(model.start(*lens) for lens in start.lenses), None, start.poses)
    fit = cal._solve(seen, model, "opencv", state, SIZE)
    points = [view.points.astype(np.float32) for view in seen]
    px = [view.px[0].astype(np.float32) for view in seen]
    theirs = cv2.calibrateCameraExtended(points, px, SIZE, None, None, criteria=(3, 500, 1e-12))
    assert fit.rms == pytest.approx(theirs[0], rel=1e-5)
    mine, sigma = cal.parameters(fit), fit.sigmas()
    assert mine["fx"] == pytest.approx(theirs[1][0, 0], abs=0.05 * sigma["fx"])
    assert [sigma[name] for name in ("fx", "fy", "cx", "cy", "k1")] == pytest.approx(theirs[5].ravel()[:5], rel=0.02)


@pytest.mark.parametrize(("lens", "kind"), [(OPENCV, "opencv"), (PAPER, "paper")])
def test_either_lens_is_recovered_within_its_standard_deviations(lens, kind):
    result = cal.calibrate(views((lens,), boards.tilted(16, np.random.default_rng(5), 0.35), 0.15, 6), SIZE, kind)
    off = deviations(result.fit, (lens,))
    assert np.abs(off).max() < 4 and np.sqrt((off**2).mean()) < 2
    assert result.fit.rms == pytest.approx(0.15 * np.sqrt(2), rel=0.1)
    assert result.better == kind and result.other.kind != kind


def test_paper_lens_with_unequal_factors_is_better_than_opencvs_and_chosen_as_best():
    lens = dc.replace(PAPER, k_u=9e-7, k_v=2e-7)
    result = cal.calibrate(views((lens,), boards.tilted(12, np.random.default_rng(7)), 0.1, 8), SIZE, "best")
    assert result.better == result.fit.kind == "paper" and result.other.rms > 1.02 * result.fit.rms


@pytest.mark.system
def test_standard_deviations_are_those_of_many_noisy_trials():
    poses, off = boards.tilted(6, np.random.default_rng(9)), []
    for seed in range(12):
        off.append(deviations(cal.calibrate(views((PAPER,), poses, 0.2, seed), SIZE, "paper").fit, (PAPER,)))
    assert 0.75 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_stereo_head_is_recovered_and_the_halves_agree_as_the_covariance_says():
    poses = boards.tilted(12, np.random.default_rng(11), 0.5)
    result = cal.calibrate(views((PAPER, PAPER), poses, 0.1, 12), SIZE, "paper", BOARD)
    fit = result.fit
    error = np.append(frames.rotation_vector(X_LR[:, :3].T @ fit.X_LR[:, :3]), fit.X_LR[:, 3] - X_LR[:, 3])
    assert np.abs(error / np.sqrt(np.diag(fit.covariance))[-6:]).max() < 4
    assert np.abs(deviations(fit, (PAPER, PAPER))).max() < 4
    assert set(result.split_half) == {0.5, 1.0, 2.0}
    for distance, difference in result.split_half.items():
        assert difference < 6 * result.depth_sigma[distance] < 0.1 * distance
    assert result.depth_sigma[2.0] > 3 * result.depth_sigma[0.5]
    assert result.pitch[0] == pytest.approx(1, abs=2e-3)


def test_a_pair_that_moved_between_the_exposures_is_an_outlier():
    seen = views((PAPER, PAPER), boards.tilted(9, np.random.default_rng(13)), 0.1, 14)
    seen[4] = dc.replace(seen[4], px=(seen[4].px[0], seen[4].px[1] + [0, 3.0]))
    fit = cal.calibrate(seen, SIZE, "paper").fit
    assert 4 in fit.outliers() and int(np.argmax(fit.view_rms().sum(1))) == 4 and len(fit.outliers()) < 4


@pytest.mark.parametrize("shape", [(8, 6), (6, 6)])
def test_a_symmetric_board_is_numbered_alike_in_both_images(shape):
    board = Board(*shape, 0.025, 0.025)
    poses = boards.tilted(9, np.random.default_rng(41), 0.5)
    truth = views((PAPER, PAPER), poses, 0.1, 42, points=[board.points()] * 9)
    turned = [
        dc.replace(view, px=(view.px[0], board.turned(view.px[1], board.turns()[k % len(board.turns())])))
        for k, view in enumerate(truth)
    ]
    assert any(np.abs(a.px[1] - b.px[1]).max() > 10 for a, b in zip(truth, turned))
    result = cal.calibrate(turned, SIZE, "paper", board)
    assert result.fit.rms == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    np.testing.assert_allclose(result.fit.X_LR[:, 3], X_LR[:, 3], atol=1e-3)
    for view, true in zip(result.views, truth):
        np.testing.assert_array_equal(view.px[1], true.px[1])


@pytest.mark.system
def test_pairs_of_other_moments_are_said_to_be_no_pairs_and_not_a_vague_focal_length():
    seen = views((PAPER, PAPER), boards.tilted(5, np.random.default_rng(43), 0.45), 0.1, 44)
    others = [dc.replace(view, px=(view.px[0], seen[k - 1].px[1])) for k, view in enumerate(seen)]
    with pytest.raises(ConfigError, match="pairs do not fit one another") as error:
        cal.calibrate(others, SIZE)
    assert "focal" not in str(error.value) and "no two" in str(error.value)
    two = others[:2] + seen[2:]
    with pytest.raises(ConfigError, match="look at 0 with 0, 1 with 1;"):
        cal.calibrate(two, SIZE)


def test_images_of_one_camera_and_cameras_above_one_another_are_no_head():
    poses = boards.tilted(5, np.random.default_rng(45), 0.45)
    one = views((PAPER,), poses, 0.1, 46)
    twice = [dc.replace(view, names=view.names * 2, px=view.px * 2) for view in one]
    swapped = [dc.replace(view, px=view.px[::-1]) for view in views((PAPER, PAPER), poses, 0.1, 46)]
    below = views(
        (PAPER,), [frames.compose(frames.make(np.eye(3), np.array([0, -0.1, 0.02])), X) for X in poses], 0.1, 47
    )
    vertical = [dc.replace(a, names=a.names * 2, px=(*a.px, *b.px)) for a, b in zip(one, below)]
    for seen, says in ((twice, "0.001 to 10 m apart"), (swapped, "on the right"), (vertical, "one camera is above")):
        with pytest.raises(ConfigError, match=says) as error:
            cal.calibrate(seen, SIZE)
        assert "\n" not in str(error.value)


def in_the_middle(lens, n: int = 12) -> list[np.ndarray]:
    """Poses whose boards fill the middle of the image only."""
    return [frames.make(X[:, :3], X[:, 3] * [0.3, 0.3, 1.6]) for X in boards.tilted(n, np.random.default_rng(51), 0.45)]


def test_terms_that_the_corners_do_not_determine_are_not_fitted_and_the_lens_is_known_where_the_boards_were():
    true = OpenCvLens(OPENCV.K, [-0.12, 0.05, 0, 0, 0])
    result = cal.calibrate(views((true,), in_the_middle(true), 0.1, 52), SIZE)
    assert [name for name in result.fit.names if name[0] in "kp"] == ["k1"]
    assert np.abs(deviations(result.fit, (true,))).max() < 4
    lens, corners = result.fit.lenses[0], np.array([[0.0, 0.0], [639, 0], [0, 479], [639, 479]])
    inside, outside = lens.sigma(np.array([[320.0, 240.0], [380, 200]])), lens.sigma(corners)
    assert inside.max() < 0.3 < KNOWN < 3 < outside.min() and 0.2 < result.unknown[0] < 0.9
    # The map says how far off the lens is, up to a turn of the camera.
    off = true.project(lens.normalize(corners)) - corners
    middle = np.array([[300.0, 220], [340, 260], [340, 220], [300, 260]])
    off = off - (true.project(lens.normalize(middle)) - middle).mean(0)
    assert (np.linalg.norm(off, axis=1) < 4 * outside).all()


def test_terms_that_the_corners_determine_are_fitted():
    poses = [
        frames.make(X[:, :3], X[:, 3] * [2.5, 2.0, 0.8]) for X in boards.tilted(24, np.random.default_rng(53), 0.4)
    ]
    true = OpenCvLens(OPENCV.K, [-0.2, 0.08, 2e-3, -1e-3, 0])
    result = cal.calibrate(views((true,), poses, 0.05, 54), SIZE)
    assert {"k1", "k2", "p1", "p2"} <= set(result.fit.names) and np.abs(deviations(result.fit, (true,))).max() < 4


def test_terms_by_which_the_lens_would_fold_back_inside_its_image_are_not_taken(monkeypatch):
    seen = views((OpenCvLens(OPENCV.K, [-0.12, 0.05, 0, 0, 0]),), in_the_middle(OPENCV), 0.1, 52)
    monkeypatch.setattr(cal, "_TERMS", ((0, 1, 4), (0, 1)))
    reach, fits = OpenCvLens.radial_reach, []

    def folded(lens: OpenCvLens) -> tuple[float, float]:
        fits.append(lens.dist[4] != 0)
        return (100.0, 400.0) if lens.dist[4] else reach(lens)

    monkeypatch.setattr(OpenCvLens, "radial_reach", folded)
    monkeypatch.setattr(cal, "_criterion", lambda fit, more, parameters: -parameters)  # most terms first
    assert cal.calibrate(seen, SIZE).fit.lenses[0].dist[4] == 0 and fits[0]
    monkeypatch.setattr(OpenCvLens, "radial_reach", lambda lens: (100.0, 400.0))
    with pytest.raises(ConfigError, match="folds back inside the image"):
        cal.calibrate(seen, SIZE)


def test_boards_of_a_fisheye_are_named_as_such():
    seen = []
    for k, X in enumerate(boards.tilted(12, np.random.default_rng(55), 0.16)):
        X = frames.make(X[:, :3], X[:, 3] * [9.0, 7.0, 1.0])
        K = np.array([[210.0, 0, 318], [0, 211, 242], [0, 0, 1]])
        px = cv2.fisheye.projectPoints(
            BOARD.points().reshape(-1, 1, 3), cv2.Rodrigues(X[:, :3])[0], X[:, 3], K, np.array([0.02, -0.01, 0.0, 0.0])
        )[0][:, 0]
        seen.append(cal.View((f"{k}",), BOARD.points(), (px + np.random.default_rng(k).normal(0, 0.1, px.shape),), k))
    with pytest.raises(ConfigError, match="the images are a fisheye's") as error:
        cal.calibrate(seen, SIZE)
    assert "\n" not in str(error.value)


def test_a_lens_that_folds_back_inside_its_image_is_refused():
    K = np.array([[400.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    OpenCvLens(K, [-0.12, 0, 0, 0, 0]).check()
    OpenCvLens(K, [-0.3, 0.1, 0, 0, 0, 0.0, 0, 0]).check()
    for dist in ([-0.4, 0, 0, 0], [0.0, 0, 0, 0, -0.6], [0.1, 0, 0, 0, 0, 2.0, 0, 0]):
        with pytest.raises(ConfigError, match="folds back .* inside the image"):
            OpenCvLens(K, dist).check()


FRONTAL = [frames.make(frames.rot_z(0.02 * k), np.array([0.02, -0.01, 0.5 + 0.1 * k])) for k in range(7)]


@pytest.mark.parametrize("sigma", [0.0, 0.2])
@pytest.mark.parametrize("cameras", [1, 2])
def test_boards_that_all_face_the_camera_are_refused(sigma, cameras):
    with pytest.raises(ConfigError, match="degenerate") as error:
        cal.calibrate(views((PAPER,) * cameras, FRONTAL, sigma, 15), SIZE)
    assert "\n" not in str(error.value)


def test_boards_that_are_all_parallel_are_refused():
    R = frames.rotation(np.array([0.5, 0.1, 0.0]))
    poses = [frames.make(R, np.array([0.03 * k - 0.1, 0.0, 0.5 + 0.05 * k])) for k in range(7)]
    with pytest.raises(ConfigError, match="degenerate"):
        cal.calibrate(views((PAPER,), poses, 0.2, 16), SIZE)


def test_two_views_are_too_few():
    with pytest.raises(ConfigError, match="at least 3"):
        cal.calibrate(views((PAPER,), boards.tilted(2, np.random.default_rng(0)), 0.1, 17), SIZE)


def test_frontal_boards_at_known_distances_are_one_target():
    lens = OpenCvLens(OPENCV.K, [-0.2, 0, 0, 0, 0])
    depths = 0.1 * np.arange(7)
    points = [BOARD.points() + [0, 0, z - depths.mean()] for z in depths]
    X_LT = frames.make(frames.rotation(np.array([0.03, 0.02, 0.01])), np.array([0.01, 0.02, 0.85]))
    seen = views((lens, lens), [X_LT] * 7, 0.2, 18, rigid=True, points=points)
    fit = cal.calibrate(seen, SIZE).fit
    truth = OPENCV.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    for side in ("left", "right"):
        values, sigma = cal.parameters(fit), fit.sigmas()
        found = np.array([values[f"{side}.{name}"] for name in ("fx", "fy", "cx", "cy")])
        spread = np.array([sigma[f"{side}.{name}"] for name in ("fx", "fy", "cx", "cy")])
        assert np.abs((found - truth) / spread).max() < 4 and spread.max() < 10
    assert np.linalg.norm(fit.X_LR[:, 3]) == pytest.approx(np.linalg.norm(X_LR[:, 3]), rel=0.02)


X_EC = frames.make(frames.rotation(np.array([0.1, -0.2, 1.5])), np.array([0.05, -0.02, 0.08]))
X_BT = frames.make(frames.rotation(np.array([3.0, 0.1, 0.2])), np.array([0.6, 0.1, 0.02]))

# ---------------------------------------------------------------- files


def test_one_camera_survives_the_file_bit_for_bit(tmp_path):
    for lens in (PAPER, OPENCV):
        save_camera(lens, tmp_path / "camera.yaml", "a comment", X_EC=np.eye(4))
        back = load_calibration([tmp_path / "camera.yaml"])
        assert (
            type(back) is type(lens)
            and back.project(np.array([0.2, -0.1])).tolist() == lens.project(np.array([0.2, -0.1])).tolist()
        )


def test_the_head_keeps_the_residual_of_its_calibration(tmp_path):
    save_head(StereoHead(PAPER, OPENCV, X_LR, rms_px=0.3), tmp_path / "head.yaml")
    assert load_head(tmp_path / "head.yaml").rms_px == load_calibration([tmp_path / "head.yaml"]).rms_px == 0.3


# ---------------------------------------------------------------- the commands


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> pathlib.Path:
    """Drawn images of a small stereo head, 320 x 240, and hand poses for the left ones."""
    path = tmp_path_factory.mktemp("boards")
    small = dc.replace(PAPER, k_u=1.6e-6, k_v=1.5e-6, k_x=310.0, k_y=305.0, u_0=162.0, v_0=124.0, width=320, height=240)
    poses = []
    for k, X in enumerate(boards.tilted(7, np.random.default_rng(31), 0.45, 0.5)):
        for side, X_CT in (("left", X), ("right", frames.compose(frames.inverse(X_LR), X))):
            cv2.imwrite(str(path / f"{side}_{k + 7}.png"), boards.draw(small, X_CT, BOARD, 3))
        X_BE = frames.compose(X_BT, frames.inverse(X), frames.inverse(X_EC))
        poses.append({"image": f"left_{k + 7}.png", "X_BE": np.vstack([X_BE, [0, 0, 0, 1]]).tolist()})
    (path / "poses.json").write_text(json.dumps(poses[::-1]))
    return path


def run(capsys, *arguments: str) -> tuple[int, dict, str]:
    code = main(list(arguments))
    out, err = capsys.readouterr()
    return code, json.loads(out) if out.startswith("{") else {}, err


SIZES = ("--board", "9x6", "--pitch", "25x25", "--json")


def test_stereo_command_from_images_to_head_and_page(folder, tmp_path, capsys):
    sides = ("--left", str(folder / "left_*.png"), "--right", str(folder / "right_*.png"))
    out, page = tmp_path / "head.yaml", tmp_path / "report.html"
    code, said, _ = run(
        capsys, "calibrate", "stereo", *sides, *SIZES, "--lens", "paper", "--out", str(out), "--html", str(page)
    )
    assert code == 0 and said["rms_px"] < 0.15
    head = load_head(out)
    np.testing.assert_array_equal(np.array(said["X_LR"]), head.X_LR)
    assert np.linalg.norm(head.X_LR[:, 3] - X_LR[:, 3]) < 1e-3
    assert set(said["split_half_mm"]) == {"0.5", "1", "2"} and set(said["lenses"]) == {"opencv", "paper"}
    assert [view["left"] for view in said["per_view"]][:4] == ["left_7.png", "left_8.png", "left_9.png", "left_10.png"]
    assert said["parameters"].keys() == said["standard_deviations"].keys()
    text = page.read_text()
    assert "split-half" in text and not re.search(r"https?://|<script|src=", text)


def test_intrinsics_then_hand_eye_from_images(folder, tmp_path, capsys):
    images, camera, out = str(folder / "left_*.png"), tmp_path / "camera.yaml", tmp_path / "hand.yaml"
    code, said, _ = run(
        capsys, "calibrate", "intrinsics", "--images", images, *SIZES, "--lens", "paper", "--out", str(camera)
    )
    assert code == 0 and said["parameters"]["k_x"] == pytest.approx(310, abs=1.5)
    poses = ("--poses", str(folder / "poses.json"))
    for more in ((), ("--camera", str(camera))):
        html = tmp_path / "hand.html"
        code, said, _ = run(
            capsys,
            "calibrate",
            "hand-eye",
            "--images",
            images,
            *poses,
            *SIZES,
            *more,
            "--out",
            str(out),
            "--html",
            str(html),
        )
        assert code == 0 and len(said["per_view"]) == 7 and "X_EC" in html.read_text()
        assert np.linalg.norm(np.array(said["X_EC"])[:3, 3] - X_EC[:, 3]) < 2e-3
        assert said["residual_mm"] < 1 and said["residual_deg"] < 0.3
    np.testing.assert_array_equal(yaml.safe_load(out.read_text())["X_EC"], said["X_EC"])
    assert load_calibration([out]).width == 320


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("intrinsics", "--images", "{0}/none*.png"), "no such image"),
        (("intrinsics", "--images", "{0}/left_*.png", "--board", "11x8"), "no board of 11 x 8"),
        (("intrinsics", "--images", "{0}/left_7.png", "{0}/left_8.png"), "at least 3"),
        (("intrinsics", "--images", "{0}/left_*.png", "--pitch", "0x25"), "--pitch"),
        (("intrinsics", "--images", "{0}/left_*.png", "--distances", "600,700"), "--distances must be 7 numbers"),
        (("intrinsics", "--images", "{0}/left_*.png", "--distances", "600,nan"), "--distances must be numbers"),
        (("intrinsics", "--images", "{0}/poses.json"), "not an image"),
        (("stereo", "--left", "{0}/left_*.png", "--right", "{0}/right_7.png"), "must pair up"),
        (("hand-eye", "--images", "{0}/left_*.png", "--poses", "{0}/left_7.png"), "not JSON|cannot be read"),
        (("hand-eye", "--images", "{0}/right_*.png", "--poses", "{0}/poses.json"), "no pose belongs"),
        (("intrinsics", "--images", "{0}/left_*.png", "--out", "{0}/no/such/folder.yaml"), "--out must be in a folder"),
    ],
)
def test_bad_input_of_calibrate_is_one_line(folder, tmp_path, capsys, arguments, says):
    given = [argument.format(folder) for argument in arguments]
    rest = [] if "--board" in given else ["--board", "9x6"]
    rest += [] if "--pitch" in given else ["--pitch", "25x25"]
    rest += [] if "--out" in given else ["--out", str(tmp_path / "out.yaml")]
    code, _, err = run(capsys, "calibrate", *given, *rest)
    assert code == 2 and re.search(says, err) and err.count("\n") == 1
    assert not (tmp_path / "out.yaml").exists()


# ---------------------------------------------------------------- photographs


@pytest.fixture(scope="module")
def chess() -> tuple[cal.Calibration, Board]:
    path = needs("stereo_chess")
    sides = [find_images([str(path / f"{side}[0-9]*.jpg")], side) for side in ("left", "right")]
    found = [[find_corners(cv2.imread(str(p), cv2.IMREAD_GRAYSCALE), BOARD) for p in side] for side in sides]
    names = [(a.name, b.name) for a, b in zip(*sides)]
    return cal.calibrate(cal.board_views(BOARD, names, list(zip(*found))), SIZE, "opencv", BOARD), BOARD


def test_stereo_photographs_reproduce_the_reference_solution(chess):
    result, _ = chess
    assert len(result.views) == 13 and result.fit.rms == pytest.approx(0.215, abs=0.003)
    assert 1e3 * np.linalg.norm(result.fit.X_LR[:, 3]) == pytest.approx(83.2, abs=0.1)
    assert cal.parameters(result.fit)["left.fx"] == pytest.approx(533.4, abs=0.3)
    assert 25 * result.pitch[0] == pytest.approx(25.01, abs=0.02) and 25 * result.pitch[1] == pytest.approx(
        0.2, abs=0.03
    )
    reference = {0.5: 1.5, 1.0: 10.7, 2.0: 52.0}
    for distance, expected in reference.items():
        assert 1e3 * result.split_half[distance] == pytest.approx(expected, rel=0.15)
    assert result.better == "opencv"


def test_refined_pose_of_the_boards_rim_agrees_with_the_boards_own(chess):
    result, board = chess
    head, model = result.fit.head(), board.points().reshape(board.rows, board.columns, 3)
    marker = Marker.of(np.ptp(model[..., :2], axis=(0, 1)).tolist(), 0.2)
    config = RectangleEstimatorConfig(min_distance=0.1)
    for view, X_LT in zip(result.views, result.fit.poses):
        quads = [rim(px.reshape(board.rows, board.columns, 2), lens) for px, lens in zip(view.px, head.lenses())]
        found = estimate(MarkerEdges(left=quads[0], right=quads[1]), head, marker, config)
        assert found.found, found.reason
        X = found.X_LV if found.X_LV[:, 0] @ X_LT[:, 0] > 0 else found.X_LV * [-1, -1, 1, 1]
        turn = np.degrees(np.linalg.norm(frames.rotation_vector(X_LT[:, :3].T @ X[:, :3])))
        assert turn < 0.5 and np.linalg.norm(X[:, 3] - X_LT[:, 3]) < 1e-3


def rim(grid: np.ndarray, lens) -> QuadEdges:
    """The sides of the outermost corners as edges: straight lines through each side's corners, sampled."""
    xy = lens.normalize(grid)
    sides, points, side = (xy[0], xy[:, -1], xy[-1, ::-1], xy[::-1, 0]), [], []
    for k, corners in enumerate(sides):
        vx, vy, x0, y0 = cv2.fitLine(corners.astype(np.float32), cv2.DIST_L2, 0, 1e-6, 1e-6).ravel()
        along = (corners - [x0, y0]) @ [vx, vy]
        t = np.linspace(along[0], along[-1], 40)
        points.append(np.array([x0, y0]) + t[:, None] * [vx, vy])
        side += [k] * len(t)
    corners = np.array([sides[k][0] for k in range(4)])
    assert ((corners[NEXT] - corners) ** 2).sum() > 0
    return QuadEdges(found=True, points=np.vstack(points), side=side, sigma=0.2, corners=corners)
