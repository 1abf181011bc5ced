"""Hand-eye calibration: the arm's noise and the corners' told apart, and poses that belong elsewhere refused."""

import json
import re

import boards
import numpy as np
import pytest

from valve_drake import frames
from valve_drake.analysis import hand_eye_experiment as experiment
from valve_drake.camera import hand_eye, hand_eye_mistakes, hand_eye_report
from valve_drake.camera.board import Board
from valve_drake.camera.calibration_file import save_camera
from valve_drake.camera.calibration_report import Pictures
from valve_drake.camera.hand_eye_mistakes import _euler, _reordered
from valve_drake.camera.hand_eye_poses import read_poses
from valve_drake.camera.lens import Lens
from valve_drake.checks import ConfigError
from valve_drake.cli import main

BOARD = Board(9, 6, 0.025, 0.025)
PAPER = Lens(4.2e-7, 3.7e-7, 620.0, 610.0, 324.6, 248.3)
X_EC = frames.make(frames.rotation(np.array([0.1, -0.2, 1.5])), np.array([0.05, -0.02, 0.08]))
X_BT = frames.make(frames.rotation(np.array([3.0, 0.1, 0.2])), np.array([0.6, 0.1, 0.02]))


def hand_poses(n: int = 8, axes: tuple[int, int, int] = (1, 1, 1)) -> list[np.ndarray]:
    """X_BE that keep the board in view."""
    rng, out = np.random.default_rng(21), []
    for _ in range(n):
        X_CT = frames.make(
            frames.rotation(rng.uniform(-0.5, 0.5, 3) * axes), np.array([*rng.uniform(-0.05, 0.05, 2), 0.4])
        )
        out.append(frames.compose(X_BT, frames.inverse(X_CT), frames.inverse(X_EC)))
    return out


def board_seen(X_BE: np.ndarray, sigma: float = 0.0, rng: np.random.Generator | None = None) -> np.ndarray:
    X_CT = frames.compose(frames.inverse(X_EC), frames.inverse(X_BE), X_BT)
    px = boards.corners(PAPER, X_CT, BOARD.points())
    return px if rng is None else px + rng.normal(0, sigma, px.shape)


def scattered(poses: list[np.ndarray], deg: float, mm: float, rng: np.random.Generator) -> list[np.ndarray]:
    """The poses with random rotation and position errors, about and along each axis."""
    turns = rng.normal(0, np.radians(deg), (len(poses), 3))
    shifts = rng.normal(0, mm / 1e3, (len(poses), 3))
    return [frames.make(X[:, :3] @ frames.rotation(w), X[:, 3] + p) for X, w, p in zip(poses, turns, shifts)]


# ---------------------------------------------------------------- the estimate


def test_exact_poses_give_the_exact_camera():
    X_BE = hand_poses()
    X_CT = [frames.compose(frames.inverse(X_EC), frames.inverse(X), X_BT) for X in X_BE]
    np.testing.assert_allclose(hand_eye.closed_hand_eye(X_BE, X_CT), X_EC, atol=1e-9)
    result = hand_eye.hand_eye(PAPER, BOARD.points(), [board_seen(X) for X in X_BE], X_BE)
    np.testing.assert_allclose(result.X, X_EC, atol=1e-8)
    np.testing.assert_allclose(result.X_target, X_BT, atol=1e-8)
    assert result.position_mm.max() < 1e-5 and result.left_out_deg.max() < 1e-5 and result.used == tuple(range(8))


def test_a_camera_beside_the_robot_is_given_in_the_base():
    # The board in the hand and the camera on the base: the same relation with base and hand exchanged.
    X_BE = [frames.inverse(X) for X in hand_poses()]
    corners = [board_seen(frames.inverse(X)) for X in X_BE]
    result = hand_eye.hand_eye(PAPER, BOARD.points(), corners, X_BE, to_hand=True)
    np.testing.assert_allclose(result.X, X_EC, atol=1e-8)


@pytest.mark.parametrize("to_hand", [False, True])
def test_jacobians_are_those_of_the_differences(to_hand):
    rng = np.random.default_rng(3)
    X_BE = [frames.inverse(X) for X in hand_poses(4)] if to_hand else hand_poses(4)
    corners = [board_seen(frames.inverse(X) if to_hand else X) for X in X_BE]
    seen = hand_eye.observe(PAPER, BOARD.points(), corners, X_BE, to_hand)
    X = frames.stepped(X_EC, rng.normal(0, 1e-3, 6))
    e, J, _ = hand_eye._arm_errors(X, X_BT, seen)
    for k in range(12):
        step = np.zeros(12)
        step[k] = 1e-6
        there = hand_eye._arm_errors(frames.stepped(X, step[:6]), frames.stepped(X_BT, step[6:]), seen)[0]
        np.testing.assert_allclose((there - e) / 1e-6, J[:, :, k], atol=2e-5)


def test_noise_of_arm_and_corners_is_told_apart():
    rng, found = np.random.default_rng(5), []
    for _ in range(8):
        true = hand_poses(20)
        corners = [board_seen(X, 0.2, rng) for X in true]
        seen = hand_eye.observe(PAPER, BOARD.points(), corners, scattered(true, 0.3, 3.0, rng))
        fit = hand_eye.solve(seen)
        found.append([np.degrees(np.sqrt(fit.variances[0])), 1e3 * np.sqrt(fit.variances[1]), seen.px])
    np.testing.assert_allclose(np.mean(found, 0), [0.3, 3.0, 0.2], rtol=0.1)


def test_position_error_of_the_arm_is_not_paid_in_rotation():
    # All error put into the image would turn the camera by more than a degree here.
    rng, off = np.random.default_rng(6), []
    for _ in range(5):
        true = hand_poses(10)
        corners = [board_seen(X, 0.2, rng) for X in true]
        fit = hand_eye.solve(hand_eye.observe(PAPER, BOARD.points(), corners, scattered(true, 0.05, 5.0, rng)))
        off.append(np.degrees(np.linalg.norm(frames.rotation_vector(X_EC[:, :3].T @ fit.X[:, :3]))))
    assert max(off) < 0.3


@pytest.mark.system
def test_no_published_method_is_better_and_the_covariance_is_honest():
    rows = experiment.hand_eye(seed=0, trials=4, deg=(0.2,), mm=(0.0, 1.0))["rows"]
    assert len(rows) == 4
    for what in ("rotation [deg]", "position [mm]"):
        assert sum(row[what] for row in rows) < 0.9 * sum(row[f"best {what}"] for row in rows)
    assert 0.7 < np.mean([row["NEES/6"] for row in rows]) < 1.3


def test_a_small_board_is_taken_with_the_tilt_that_suits_the_arm():
    # Of a board of 8 cm at 0.9 m, noise of half a pixel now and then makes the mirrored tilt the better fit.
    small, rng = Board(5, 4, 0.02, 0.02), np.random.default_rng(9)
    true = hand_poses(20)
    back = frames.make(np.eye(3), np.array([0, 0, 0.5]))
    far = [frames.compose(X, X_EC, frames.inverse(back), frames.inverse(X_EC)) for X in true]
    corners = []
    for X in far:
        X_CT = frames.compose(frames.inverse(X_EC), frames.inverse(X), X_BT)
        px = boards.corners(PAPER, X_CT, small.points())
        corners.append(px + rng.normal(0, 0.5, px.shape))
    seen = hand_eye.observe(PAPER, small.points(), corners, far)
    wanted = np.array([frames.compose(frames.inverse(X_EC), frames.inverse(X), X_BT) for X in far])
    tilted = [np.abs(one.board[:, :, 2] - wanted[:, :, 2]).max(1) > 0.3 for one in (seen, hand_eye.settled(seen))]
    assert tilted[0].any() and not tilted[1].any()


def test_a_blunder_is_left_out_and_named():
    rng, true = np.random.default_rng(7), hand_poses(10)
    given = scattered(true, 0.1, 1.0, rng)
    given[3] = frames.make(given[3][:, :3] @ frames.rotation(np.array([0.2, 0, 0])), given[3][:, 3])
    result = hand_eye.hand_eye(PAPER, BOARD.points(), [board_seen(X, 0.2, rng) for X in true], given)
    assert set(range(10)) - set(result.used) == {3} and result.off[3] > hand_eye.STANDS_OUT
    assert np.abs((result.X[:, 3] - X_EC[:, 3]) * 1e3 / result.sigma_mm).max() < 4


@pytest.mark.parametrize("seed", range(3))
def test_poses_of_no_arm_at_all_are_refused_in_one_line(seed):
    rng = np.random.default_rng(seed)
    corners = [board_seen(X) for X in hand_poses(6)]
    far = [frames.make(frames.rotation(rng.normal(0, 2, 3)), rng.normal(0, 1000, 3)) for _ in corners]
    seen = hand_eye.observe(PAPER, BOARD.points(), corners, far)
    with pytest.raises(ConfigError, match="^hand-eye: ") as error:
        hand_eye_mistakes.refuse_scatter(hand_eye.from_seen(seen, PAPER, BOARD.points(), corners), seen, poses_of(far))
    assert "\n" not in str(error.value)


def poses_of(X_BE):
    return hand_eye_mistakes.Poses(tuple(f"{k}.png" for k in range(len(X_BE))), np.array(X_BE), tuple(range(len(X_BE))))


def test_a_hand_that_turned_about_one_axis_is_refused():
    X_BE = hand_poses(axes=(1, 0, 0))
    with pytest.raises(ConfigError, match="one axis only"):
        hand_eye.hand_eye(PAPER, BOARD.points(), [board_seen(X) for X in X_BE], X_BE)


# ---------------------------------------------------------------- the command, on corners


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Runs `calibrate hand-eye` on corners given in place of twelve images -> exit code, JSON, standard error."""
    rng, true = np.random.default_rng(8), hand_poses(12)
    corners = [board_seen(X, 0.2, rng) for X in true]
    given = scattered(true, 0.1, 1.0, rng)
    paths = [(tmp_path / f"{k}.png",) for k in range(12)]
    for (path,) in paths:
        path.touch()
    monkeypatch.setattr(
        hand_eye_report, "look", lambda *_: Pictures(paths, [(px,) for px in corners], (PAPER.width, PAPER.height))
    )
    save_camera(PAPER, tmp_path / "camera.yaml")

    def run(change=lambda X: X, *more: str, board: str = "9x6") -> tuple[int, dict, str]:
        poses = change(given)
        rows = [{"image": f"{k}.png", "X_BE": np.vstack([X, [0, 0, 0, 1]]).tolist()} for k, X in enumerate(poses)]
        (tmp_path / "poses.json").write_text(json.dumps(rows))
        files = {"--images": "*.png", "--poses": "poses.json", "--camera": "camera.yaml"}
        given_files = [str(word) for key, name in files.items() for word in (key, tmp_path / name)]
        sizes = ["--board", board, "--pitch", "25x25", "--out", str(tmp_path / "hand.yaml"), "--json", *more]
        code = main(["calibrate", "hand-eye", *given_files, *sizes])
        out, err = capsys.readouterr()
        return code, json.loads(out) if out else {}, err

    return run


def exchanged(poses: list[np.ndarray]) -> list[np.ndarray]:
    return [poses[k] for k in (0, 1, 7, 3, 4, 5, 6, 2, *range(8, 12))]


MISTAKES = [
    (lambda poses: [frames.inverse(X) for X in poses], "times better inverted.*X_EB"),
    (lambda poses: [frames.make(X[:, :3].T, X[:, 3]) for X in poses], "rotations transposed"),
    (lambda poses: poses[1:] + poses[:1], "the pose of the previous one"),
    (lambda poses: poses[-2:] + poses[:-2], r"the one at \+2"),
    (lambda poses: poses[::-1], "reverse order"),
    (exchanged, r"2.png takes the pose of 7.png, 7.png takes the pose of 2.png"),
    (lambda poses: [frames.make(_reordered(X[:, :3], (3, 0, 1, 2)), X[:, 3]) for X in poses], "xyzw read as wxyz"),
    (lambda poses: [frames.make(_reordered(X[:, :3], (1, 2, 3, 0)), X[:, 3]) for X in poses], "wxyz read as xyzw"),
    (lambda poses: [frames.make(_euler(X[:, :3], "zyx"), X[:, 3]) for X in poses], "Euler"),
    (lambda poses: [frames.make(X[:, :3], 1e3 * X[:, 3]) for X in poses], "as millimetres"),
    (
        lambda poses: [frames.inverse(frames.make(X[:, :3], 1e3 * X[:, 3])) for X in poses],
        "inverted and in millimetres",
    ),
    (lambda poses: [poses[k] for k in np.random.default_rng(1).permutation(12)], "no usual mistake"),
]


@pytest.mark.system
@pytest.mark.parametrize(("change", "says"), MISTAKES)
def test_poses_of_a_usual_mistake_are_refused_with_its_name(command, tmp_path, change, says):
    code, _, err = command(change)
    assert code == 2 and re.search(says, err) and err.count("\n") == 1
    assert not (tmp_path / "hand.yaml").exists()


def test_the_other_mount_is_refused(command, tmp_path):
    code, _, err = command(lambda poses: poses, "--eye-to-hand")
    assert code == 2 and "leave out --eye-to-hand" in err and not (tmp_path / "hand.yaml").exists()


def test_two_images_of_one_name_are_refused_since_poses_are_told_apart_by_it(command, tmp_path):
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "3.png").touch()
    code, _, err = command(lambda poses: poses, "--images", str(tmp_path / "*.png"), str(tmp_path / "again" / "*.png"))
    assert code == 2 and "--images must be of different names" in err and "again/3.png" in err
    assert not (tmp_path / "hand.yaml").exists()


def test_a_blunder_does_not_hide_the_mistake(command):
    def change(poses: list[np.ndarray]) -> list[np.ndarray]:
        bad = frames.make(poses[4][:, :3], poses[4][:, 3] + 0.1)
        return [frames.inverse(X) for X in (*poses[:4], bad, *poses[5:])]

    code, _, err = command(change)
    assert code == 2 and "times better inverted:" in err


def test_the_report_has_noise_covariance_and_the_published_methods(command, tmp_path):
    code, said, _ = command(lambda poses: poses, "--html", str(tmp_path / "hand.html"))
    assert code == 0 and said["warnings"] == []
    assert said["noise"]["arm_deg"] == pytest.approx(0.1, rel=0.4)
    assert said["noise"]["arm_mm"] == pytest.approx(1.0, rel=0.4)
    assert said["noise"]["corner_px"] == pytest.approx(0.2, rel=0.1)
    spread = np.sqrt(np.diag(said["covariance"]))
    np.testing.assert_allclose(np.degrees(spread[:3]), said["X_EC_sigma"]["rotation_deg"])
    assert set(said["methods"]) == {"Tsai", "Park", "Horaud", "Andreff", "Daniilidis"}
    assert all(said["left_out_mm"] < 1.1 * one["left_out_mm"] for one in said["methods"].values())
    assert "Daniilidis" in (tmp_path / "hand.html").read_text()


def test_the_command_overwrites_its_own_calibration_and_nothing_else(command, tmp_path):
    same = lambda poses: poses  # noqa: E731
    assert command(same)[0] == 0 and command(same)[0] == 0
    for out in ("poses.json", "camera.yaml"):
        before = (tmp_path / "camera.yaml").read_bytes()
        code, _, err = command(same, "--out", str(tmp_path / out))
        assert code == 2 and "--out" in err and err.count("\n") == 1
        assert (tmp_path / "camera.yaml").read_bytes() == before and json.loads((tmp_path / "poses.json").read_text())
    code, _, err = command(same, "--html", str(tmp_path / "hand.yaml"))
    assert code == 2 and "--html" in err


def test_images_and_poses_without_a_partner_are_named(command):
    code, said, _ = command(lambda poses: poses[:11])
    assert code == 0 and said["not_used"] == ["11.png"] and said["warnings"] == ["no pose for 11.png"]


GOOD = np.eye(4).tolist()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("{}", "a list of"),
        ("[]", "a list of"),
        ("nonsense", "not JSON"),
        ("[" * 100_000, "nested too deeply|not JSON"),
        ("\ud800", "not JSON"),
        (json.dumps([1]), "image"),
        (json.dumps([{"image": 3, "X_BE": GOOD}]), r"\[0\].image must be the name"),
        (json.dumps([{"image": "/", "X_BE": GOOD}]), r"\[0\].image must be the name"),
        (json.dumps([{"image": "a.png", "X_BE": GOOD}, {"image": "b/a.png", "X_BE": GOOD}]), r"\[1\].image .*once"),
        (json.dumps([{"image": "a.png", "X_BE": [[1, 2], [3]]}]), "4 rows of 4 numbers"),
        (json.dumps([{"image": "a.png", "X_BE": [["1"] * 4] * 4}]), "4 rows of 4 numbers"),
        (json.dumps([{"image": "a.png", "X_BE": [[True] * 4] * 4}]), "4 rows of 4 numbers"),
        (json.dumps([{"image": "a.png", "X_BE": [[float("nan")] * 4] * 4}]), "finite"),
        (json.dumps([{"image": "a.png", "X_BE": [[10**400] * 4] * 4}]), "finite"),
        (json.dumps([{"image": "a.png", "X_BE": [[0] * 4] * 4}]), "0 0 0 1"),
        (json.dumps([{"image": "a.png", "X_BE": np.diag([2.0, 1, 1, 1]).tolist()}]), "a rotation in"),
        (json.dumps([{"image": "a.png", "X_BE": np.diag([-1.0, 1, 1, 1]).tolist()}]), "mirror"),
        (json.dumps([{"image": "a.png", "X_BE": (np.eye(4) + np.eye(4, k=-3)).tolist()}]), "transposed"),
    ],
)
def test_poses_that_are_none_are_one_line(tmp_path, text, says):
    path = tmp_path / "poses.json"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(ConfigError, match=says) as error:
        read_poses(path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 600
