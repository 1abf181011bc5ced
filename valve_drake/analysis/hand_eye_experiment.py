"""The hand-eye calibration against five published ones, on arms that scatter by known amounts.

Boards are seen by projection, their corners with noise; each method gets the same views. Every trial has its own
camera mount, board, number of views (10 to 25) and arm poses.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from valve_drake import frames
from valve_drake.camera import hand_eye as solver
from valve_drake.camera.board import Board
from valve_drake.camera.lens import OpenCvLens

BOARD = Board(9, 6, 0.025, 0.025)
LENS = OpenCvLens(np.array([[600.0, 0, 318], [0, 605, 243], [0, 0, 1]]), np.array([-0.2, 0.08, 1e-3, -5e-4, 0.02]))
CORNER_NOISE = 0.2  # [px]
DEG, MM = (0.0, 0.05, 0.1, 0.2, 0.5), (0.0, 0.5, 1.0, 2.0, 5.0)  # the arm's scatter about and along each axis
VIEWS = (10, 25)
_DISTANCES, _TILT, _MARGIN = (0.3, 0.6), 0.6, 5.0  # of the boards [m], about each axis [rad], to the border [px]


def hand_eye(seed: int = 0, trials: int = 40, deg: Sequence[float] = DEG, mm: Sequence[float] = MM) -> dict[str, Any]:
    """Mean errors of this program and of the best published method, for each scatter of the arm and both mounts.

    `best` takes, for each number by itself, the method that turned out best in that row. NEES/6 is the mean of the
    squared error over what the covariance promises: 1 for an honest one.
    """
    rows = []
    for to_hand in (False, True):
        for position in mm:
            for rotation in deg:
                rng = np.random.default_rng([seed, int(to_hand), round(1e3 * position), round(1e3 * rotation)])
                rows.append(_row(to_hand, rotation, position, trials, rng))
    settings = {
        "trials a row": trials,
        "views": f"{VIEWS[0]}..{VIEWS[1]}",
        "corner noise [px]": CORNER_NOISE,
        "board": f"{BOARD.columns}x{BOARD.rows}, {1e3 * BOARD.pitch_x:g} mm",
        "seed": seed,
    }
    nees = [row["NEES/6"] for row in rows]
    return {
        "experiment": "hand-eye",
        "settings": settings,
        "rows": rows,
        "totals": {"NEES/6 of all rows": round(float(np.mean(nees)), 3)},
    }


def _row(to_hand: bool, deg: float, mm: float, trials: int, rng: np.random.Generator) -> dict[str, Any]:
    errors: dict[str, list[np.ndarray]] = {name: [] for name in ("this one", *solver.METHODS)}
    nees = []
    for _ in range(trials):
        n = int(rng.integers(VIEWS[0], VIEWS[1] + 1))
        X, seen = scene(rng, n, to_hand, math.radians(deg), mm / 1e3)
        fit = solver.solve(solver.settled(seen))
        off = _off(fit.X, X)
        errors["this one"].append(off)
        nees.append(float(off @ np.linalg.solve(fit.covariance[:6, :6], off)) / 6)
        for name, method in solver.METHODS.items():
            errors[name].append(_off(solver.published(seen.carriers(), seen.board, method), X))
    rotation = {name: math.degrees(np.linalg.norm(np.array(e)[:, :3], axis=1).mean()) for name, e in errors.items()}
    position = {name: 1e3 * float(np.linalg.norm(np.array(e)[:, 3:], axis=1).mean()) for name, e in errors.items()}
    return {
        "mount": "beside the robot" if to_hand else "on the hand",
        "arm [deg]": deg,
        "arm [mm]": mm,
        "rotation [deg]": rotation.pop("this one"),
        "best rotation [deg]": min(rotation.values()),
        "position [mm]": position.pop("this one"),
        "best position [mm]": min(position.values()),
        "NEES/6": float(np.mean(nees)),
        "of": f"{min(rotation, key=rotation.__getitem__)}, {min(position, key=position.__getitem__)}",
    }


def scene(rng: np.random.Generator, n: int, to_hand: bool, turn: float, shift: float) -> tuple[np.ndarray, solver.Seen]:
    """The camera X (3, 4), and n views by an arm that scatters by turn [rad], shift [m] about and along each axis."""
    near, far = (0.5, 0.1) if to_hand else (0.06, 0.5)
    X = frames.make(frames.rotation(rng.normal(0, 1, 3)), rng.normal(0, near, 3))
    Y = frames.make(frames.rotation(rng.normal(0, 1, 3)), rng.normal(0, far, 3))
    points = BOARD.points()
    arm: list[np.ndarray] = []
    corners: list[np.ndarray] = []
    while len(arm) < n:
        z = rng.uniform(*_DISTANCES)
        Z = frames.make(frames.rotation(rng.uniform(-_TILT, _TILT, 3)), np.array([*rng.uniform(-0.15, 0.15, 2) * z, z]))
        P = frames.apply(Z, points)
        px = LENS.project(P[:, :2] / P[:, 2:])
        if (px < _MARGIN).any() or (px > np.array([LENS.width, LENS.height]) - _MARGIN).any():
            continue
        one = (X, Z, frames.inverse(Y)) if to_hand else (Y, frames.inverse(Z), frames.inverse(X))
        true = frames.compose(*one)
        by = frames.rotation(rng.normal(0, turn, 3))
        arm.append(frames.make(true[:, :3] @ by, true[:, 3] + rng.normal(0, shift, 3)))
        corners.append(px + rng.normal(0, CORNER_NOISE, px.shape))
    return X, solver.observe(LENS, points, corners, arm, to_hand)


def _off(X: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(6,) turn about the camera's axes [rad], position [m]."""
    return np.concatenate([frames.rotation_vector(true[:, :3].T @ X[:, :3]), X[:, 3] - true[:, 3]])
