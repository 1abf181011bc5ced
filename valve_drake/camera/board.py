"""The chessboard that calibrations look at: its size, and its inner corners in an image."""

import dataclasses as dc
import math
import re
from collections.abc import Sequence
from glob import glob
from pathlib import Path

import cv2
import numpy as np

from valve_drake.camera.image_file import read_image
from valve_drake.checks import ConfigError, require

_DONE = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
_QUICK = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
# The sector-based search stands outer squares that are cut off and things that hang before the board.
_THOROUGH = (cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE, cv2.CALIB_CB_EXHAUSTIVE, 0)


@dc.dataclass(frozen=True)
class Board:
    """Inner corners along the board's x and y, and their pitch [m]. Board frame T: x right, y down, z away."""

    columns: int
    rows: int
    pitch_x: float
    pitch_y: float

    def points(self) -> np.ndarray:
        """Corners (rows * columns, 3) in T, row by row, the middle of the board at the origin [m]."""
        x = (np.arange(self.columns) - (self.columns - 1) / 2) * self.pitch_x
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.pitch_y
        xx, yy = np.meshgrid(x, y)
        return np.stack([xx, yy, np.zeros_like(xx)], -1).reshape(-1, 3)

    def symmetric(self) -> bool:
        """Whether it looks the same turned by half a turn, so that images alone do not tell which way it is up."""
        return (self.columns + self.rows) % 2 == 0


def parse_board(size: str, pitch: str) -> Board:
    """A board from "9x6" (inner corners, x by y) and "25x25" (pitch in mm, x by y). Raises ConfigError."""
    counts = parse_pair(size, "--board", "9x6 (inner corners, x by y)")
    lengths = parse_pair(pitch, "--pitch", "25x25 (mm, x by y)")
    ok = all(n == int(n) and 3 <= n <= 100 for n in counts)
    require(ok, "--board", "two whole numbers of inner corners within 3..100, e.g. 9x6", size)
    require(all(0.1 <= p <= 1000 for p in lengths), "--pitch", "two lengths within 0.1..1000 mm, e.g. 25x25", pitch)
    return Board(int(counts[0]), int(counts[1]), lengths[0] / 1e3, lengths[1] / 1e3)


def parse_pair(text: str, key: str, example: str) -> tuple[float, float]:
    """Two finite numbers from "98x100". Raises ConfigError naming `key`."""
    parts = text.lower().replace("×", "x").split("x")
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = []
    require(len(values) == 2 and all(map(math.isfinite, values)), key, f"like {example}", text)
    return values[0], values[1]


def natural(name: str) -> list:
    """Sort key by which image_9 comes before image_10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def find_images(patterns: Sequence[str], key: str) -> list[Path]:
    """The files of globs (a shell may have expanded them already), in natural order. Raises ConfigError if none."""
    names = {name for pattern in patterns for name in glob(pattern) if Path(name).is_file()}
    if not names:
        raise ConfigError(f"{key} {' '.join(patterns)}: no such image")
    return sorted(map(Path, names), key=lambda path: (natural(path.name), str(path)))


def read_images(paths: Sequence[Path]) -> list[np.ndarray]:
    """Grey images, all of one size. Raises ConfigError naming the file that differs."""
    images = [read_image(path, cv2.IMREAD_GRAYSCALE) for path in paths]
    for path, image in zip(paths, images):
        if image.shape != images[0].shape:
            (h, w), (height, width) = image.shape, images[0].shape
            raise ConfigError(f"image {path}: {w} x {h}, but {paths[0].name} is {width} x {height}")
    return images


def find_corners(gray: np.ndarray, board: Board) -> np.ndarray | None:
    """Sub-pixel corners (rows * columns, 2) in the order of `Board.points`, or None [px].

    The order follows the colours of the squares. A symmetric board is taken with x as far to the right as it goes.
    """
    size = (board.columns, board.rows)
    ok, corners = cv2.findChessboardCorners(gray, size, flags=_QUICK)
    for flags in _THOROUGH:
        if ok:
            break
        ok, corners = cv2.findChessboardCornersSB(gray, size, flags=flags)
    if not ok:
        return None
    coarse = corners.reshape(board.rows, board.columns, 2)
    pitch = min(np.linalg.norm(np.diff(coarse, axis=axis), axis=2).min() for axis in (0, 1))
    # A window that reaches the next corner, or much of the lens's curvature, moves the corner.
    half = int(np.clip(0.35 * pitch, 2, 5))
    fine = cv2.cornerSubPix(gray, corners.reshape(-1, 1, 2).astype(np.float32), (half, half), (-1, -1), _DONE)
    grid = fine.reshape(coarse.shape).astype(float)
    if np.abs(grid - coarse).max() > 0.5 * pitch:
        return None
    return _ordered(grid, gray, board).reshape(-1, 2)


def _ordered(grid: np.ndarray, gray: np.ndarray, board: Board) -> np.ndarray:
    x, y = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if x[0] * y[1] - x[1] * y[0] < 0:  # x to y must turn clockwise as seen
        grid = grid[::-1]
    if board.symmetric():
        turns = range(4) if board.columns == board.rows else (0, 2)
        return max((np.rot90(grid, k) for k in turns), key=lambda g: float((g[:, -1] - g[:, 0])[:, 0].sum()))
    middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    at = np.clip(middle.round().astype(int), 0, [gray.shape[1] - 1, gray.shape[0] - 1])
    light = gray[at[..., 1], at[..., 0]].astype(float)
    sign = (-1.0) ** np.add.outer(np.arange(board.rows - 1), np.arange(board.columns - 1))
    first = (light * (sign > 0)).sum() / (sign > 0).sum() - (light * (sign < 0)).sum() / (sign < 0).sum()
    return grid if first < 0 else grid[::-1, ::-1]  # the first square is dark
