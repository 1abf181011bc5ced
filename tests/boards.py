"""Chessboards for the calibration tests: their corners by projection, and images of them drawn through a lens."""

import numpy as np

from valve_drake import frames
from valve_drake.camera.board import Board
from valve_drake.camera.lens import LensModel


def tilted(n: int, rng: np.random.Generator, distance: float = 0.45, tilt: float = 0.6) -> list[np.ndarray]:
    """X_CT of n boards, each tilted another way, spread over the view."""
    out = []
    for k in range(n):
        angle = 2 * np.pi * k / n
        R = frames.rotation(tilt * np.array([np.cos(angle), np.sin(angle), 0.0])) @ frames.rot_z(rng.uniform(-0.4, 0.4))
        z = distance * rng.uniform(0.9, 1.3)
        out.append(frames.make(R, np.array([*(z * rng.uniform(-0.1, 0.1, 2)), z])))
    return out


def corners(lens: LensModel, X_CT: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Raw px (n, 2) of points (n, 3) in T."""
    P = frames.apply(X_CT, points)
    return lens.project(P[:, :2] / P[:, 2:])


def draw(lens: LensModel, X_CT: np.ndarray, board: Board, fine: int = 4) -> np.ndarray:
    """The board as this lens sees it, (H, W) uint8: squares all round the inner corners, the first one dark."""
    sub = (np.arange(fine) + 0.5) / fine - 0.5
    v, u = np.meshgrid(*((np.arange(n)[:, None] + sub).ravel() for n in (lens.height, lens.width)), indexing="ij")
    xy = lens.normalize(np.stack([u, v], -1))
    H = np.linalg.inv(np.column_stack([X_CT[:, 0], X_CT[:, 1], X_CT[:, 3]]))
    q = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], -1) @ H.T
    x = q[..., 0] / q[..., 2] / board.pitch_x + (board.columns - 1) / 2
    y = q[..., 1] / q[..., 2] / board.pitch_y + (board.rows - 1) / 2
    dark = (np.floor(x) + np.floor(y)) % 2 == 0
    on = (x > -1) & (x < board.columns) & (y > -1) & (y < board.rows)
    light = np.where(on & dark, 30.0, 225.0)
    return np.rint(light.reshape(lens.height, fine, lens.width, fine).mean((1, 3))).astype(np.uint8)
