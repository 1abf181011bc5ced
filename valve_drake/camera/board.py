"""The chessboard that calibrations look at: its size, its images by name and in pairs, and its inner corners."""

import dataclasses as dc
import math
import re
from collections.abc import Sequence
from glob import escape, glob, has_magic
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from valve_drake.checks import ConfigError, require, shown

# Of the sub-pixel search: the most steps, and a step that is small enough [px].
_DONE = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
_QUICK = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
# The sector-based search finds boards whose outer squares are cut off, or with things in front of their rim.
_THOROUGH = (cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE, cv2.CALIB_CB_EXHAUSTIVE, 0)
# Longer sides [px] to which an image is reduced for the search; the second one finds boards that are small in it.
# A search of that size takes at most half a second, also in pure noise, where one at full size takes minutes and
# cannot be interrupted.
_SEARCHED = (1300, 2000)
_TILE = 1300  # side of the overlapping parts in which a larger image is searched last [px]
_OVERLAP = 400  # of such parts; raise it for boards that are larger in the image and lie across two [px]
_MIN_PAIRS = 3  # pairs by names, if other images have no partner; fewer names may agree by chance
_WINDOW = 24  # largest half window of the sub-pixel search [px]


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
        """Whether it looks the same after half a turn, so that images alone do not tell which way it is up."""
        return (self.columns + self.rows) % 2 == 0

    def turns(self) -> tuple[int, ...]:
        """Quarter turns after which the board looks the same."""
        if not self.symmetric():
            return (0,)
        return (0, 1, 2, 3) if self.columns == self.rows else (0, 2)

    def turned(self, px: np.ndarray, quarters: int) -> np.ndarray:
        """Corners (rows * columns, 2) as they are numbered on the board turned by one of `turns`."""
        return np.rot90(px.reshape(self.rows, self.columns, 2), quarters).reshape(-1, 2)


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


# ---------------------------------------------------------------- files


def natural(name: str) -> list[tuple[int, int, str]]:
    """Sort key by which image_9 comes before image_10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name) if part]


def find_images(patterns: Sequence[str], key: str) -> list[Path]:
    """The files of these names, in natural order; a name that is no file is taken as a pattern of names.

    Raises ConfigError naming the first that leads to no file.
    """
    found: set[Path] = set()
    for pattern in patterns:
        files = _files(pattern)
        if not files:
            raise ConfigError(f"{key} {shown(pattern)}: no such image")
        found.update(files)
    return sorted(found, key=lambda path: (natural(path.name), str(path)))


def _files(pattern: str) -> list[Path]:
    try:
        if Path(pattern).is_file():
            return [Path(pattern)]
        if not has_magic(pattern):
            return []
        # A folder that exists is taken as it is called, though its name may read as a pattern.
        folder, rest = Path(), list(Path(pattern).parts)
        while rest and (folder / rest[0]).exists():
            folder /= rest.pop(0)
        names = glob(str(Path(escape(str(folder)), *rest))) or glob(pattern)
    except (OSError, ValueError):  # a name that is too long, or with a null character
        return []
    return [Path(name) for name in names if Path(name).is_file()]


@dc.dataclass(frozen=True)
class Pairs:
    """Images of two cameras, paired."""

    paths: list[tuple[Path, Path]]  # left, right
    alone: list[Path]  # without a partner
    by_order: bool  # the names do not tell; paired as they are sorted


def pair_images(left: Sequence[Path], right: Sequence[Path]) -> Pairs:
    """Pairs by what varies in the names within one camera: left_9.png and right_9.png, cam1_9.png and cam2_9.png.

    Raises ConfigError if the names do not tell and the counts differ.
    """
    for of in (lambda path: path.stem, str):
        keys = _varying_parts([of(path) for path in left], [of(path) for path in right])
        if keys is None:
            continue
        sides = [dict(zip(side_keys, side)) for side_keys, side in zip(keys, (left, right))]
        common = [key for key in sides[0] if key in sides[1]]
        alone = [path for side in sides for key, path in side.items() if key not in common]
        if alone and 0 < len(common) < _MIN_PAIRS:
            names = ", ".join(path.name for path in alone[:6])
            raise ConfigError(
                f"--left has {len(left)} images, --right {len(right)}: they must pair up by the numbers in their "
                f"names, but {len(common)} does, and {names} has no partner"
            )
        if common:
            return Pairs([(sides[0][key], sides[1][key]) for key in common], alone, by_order=False)
    if len(left) != len(right):
        raise ConfigError(
            f"--left has {len(left)} images, --right {len(right)}: they must pair up, and the names do not tell how"
        )
    return Pairs(list(zip(left, right)), [], by_order=True)


def _varying_parts(left: Sequence[str], right: Sequence[str]) -> list[list[tuple[Any, ...]]] | None:
    """The parts (texts, numbers) of each name that are not the same in all names of its side; None if not unique."""
    parts = [[natural(name) for name in names] for names in (left, right)]
    if len({len(name) for side in parts for name in side}) != 1:
        return None
    places = range(len(parts[0][0]))
    varying = [k for k in places if any(len({name[k] for name in side}) > 1 for side in parts)]
    keys = [[tuple(name[k] for k in varying) for name in side] for side in parts]
    return keys if all(len(set(side)) == len(side) for side in keys) else None


# ---------------------------------------------------------------- corners


def find_corners(gray: np.ndarray, board: Board) -> np.ndarray | None:
    """Sub-pixel corners (rows * columns, 2) in the order of `Board.points`, or None [px]; gray (H, W) uint8.

    The order follows the colours of the squares. A symmetric board is taken with x as far to the right as it goes.
    """
    grid = _search(gray, board)
    return None if grid is None else _ordered(grid, gray, board).reshape(-1, 2)


def _search(gray: np.ndarray, board: Board) -> np.ndarray | None:
    """The grid (rows, columns, 2) in the image reduced step by step less, then in parts of it [px]."""
    longer = max(gray.shape)
    for side in _SEARCHED:
        scale = min(side / longer, 1.0)
        first = side == _SEARCHED[0]
        reduced = gray if scale == 1 else cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        coarse = _found(reduced, board, quick=first, thorough=_THOROUGH if first else _THOROUGH[2:])
        coarse = None if coarse is None else _refined(coarse, reduced)
        if coarse is not None and scale < 1:
            # Pixel (0, 0) is the centre of the first pixel, also of the reduced image.
            at = (coarse + 0.5) / (np.array(reduced.shape[::-1]) / gray.shape[::-1]) - 0.5
            coarse = _refined(at, gray)
        if coarse is not None or scale == 1:
            return coarse
    return _search_parts(gray, board)


def _search_parts(gray: np.ndarray, board: Board) -> np.ndarray | None:
    height, width = gray.shape
    for top in range(0, max(height - _OVERLAP, 1), _TILE - _OVERLAP):
        for left in range(0, max(width - _OVERLAP, 1), _TILE - _OVERLAP):
            part = np.ascontiguousarray(gray[top : top + _TILE, left : left + _TILE])
            coarse = _found(part, board, quick=False, thorough=_THOROUGH[2:])
            if coarse is not None:
                return _refined(coarse + [left, top], gray)
    return None


def _found(gray: np.ndarray, board: Board, quick: bool, thorough: Sequence[int]) -> np.ndarray | None:
    size, ok, corners = (board.columns, board.rows), False, None
    if min(gray.shape) < 16:
        return None
    if quick:
        ok, corners = cv2.findChessboardCorners(gray, size, flags=_QUICK)
    for flags in thorough:
        if ok:
            break
        ok, corners = cv2.findChessboardCornersSB(gray, size, flags=flags)
    return np.asarray(corners, float).reshape(board.rows, board.columns, 2) if ok else None


def _refined(coarse: np.ndarray, gray: np.ndarray) -> np.ndarray | None:
    """The corners at the nearest saddle points of brightness; None if one moves by more than half a pitch."""
    pitch = min(np.linalg.norm(np.diff(coarse, axis=axis), axis=2).min() for axis in (0, 1))
    # A large window averages noise and must hold the whole blurred edge; one that reaches the next corner, or much of
    # the lens's curvature, moves the corner. In a larger image a line is less curved from pixel to pixel.
    largest = np.clip(max(5, max(gray.shape) / 128, 3.5 * _blur(coarse, gray)), 5, _WINDOW)
    half = int(np.clip(0.35 * pitch, 2, largest))
    seeds = coarse.reshape(-1, 1, 2).astype(np.float32)
    grid = cv2.cornerSubPix(gray, seeds, (half, half), (-1, -1), _DONE).reshape(coarse.shape).astype(float)
    return None if np.abs(grid - coarse).max() > 0.5 * pitch else grid


def _blur(grid: np.ndarray, gray: np.ndarray) -> float:
    """Standard deviation of the blur across the edges between neighbouring corners, the median [px]."""
    a, b = grid[:, :-1].reshape(-1, 2), grid[:, 1:].reshape(-1, 2)
    along = b - a
    normal = np.stack([-along[:, 1], along[:, 0]], -1)  # as long as the edge
    steps = np.linspace(-0.4, 0.4, 41)
    at = ((a + b) / 2)[:, None] + steps[:, None] * normal[:, None]
    profile = cv2.remap(gray, at.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = cv2.blur(profile.astype(np.float32), (3, 1))
    contrast = np.abs(profile[:, :8].mean(1) - profile[:, -8:].mean(1))
    slope = np.abs(np.diff(profile, axis=1)).max(1) / (np.linalg.norm(along, axis=1) * (steps[1] - steps[0]))
    return float(np.median(contrast / np.maximum(slope, 1e-9))) / math.sqrt(2 * math.pi)


def _ordered(grid: np.ndarray, gray: np.ndarray, board: Board) -> np.ndarray:
    x, y = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if x[0] * y[1] - x[1] * y[0] < 0:  # x to y must turn clockwise as seen
        grid = grid[::-1]
    if board.symmetric():
        return max((np.rot90(grid, k) for k in board.turns()), key=lambda g: float((g[:, -1] - g[:, 0])[:, 0].sum()))
    middle = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    at = np.clip(middle.round().astype(int), 0, [gray.shape[1] - 1, gray.shape[0] - 1])
    light = gray[at[..., 1], at[..., 0]].astype(float)
    sign = (-1.0) ** np.add.outer(np.arange(board.rows - 1), np.arange(board.columns - 1))
    first = (light * (sign > 0)).sum() / (sign > 0).sum() - (light * (sign < 0)).sum() / (sign < 0).sum()
    return grid if first < 0 else grid[::-1, ::-1]  # the first square is dark
