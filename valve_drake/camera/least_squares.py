"""Levenberg-Marquardt, and the derivatives of rigid transforms and of the pinhole that calibrations need."""

import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.checks import ConfigError


def minimize(
    problem: Callable[..., Any], state: Any, moved: Callable[..., Any], steps: int = 200
) -> tuple[Any, tuple[Any, ...]]:
    """Levenberg-Marquardt from `state` until no step is expected to matter -> the best state, problem(state)."""
    at = problem(state)
    if not math.isfinite(at[0]):
        raise ConfigError("the calibration has no start: do the images, and the poses, belong together?")
    damping = 1e-4
    for _ in range(steps):
        cost, H, g = at[:3]
        scale = np.sqrt(np.diag(H)) + 1e-150  # a lens's k_u is 1e-7, its k_x 1e3
        scaled, slope = H / np.outer(scale, scale), g / scale
        step = -np.linalg.solve(scaled + damping * np.eye(len(g)), slope)
        gain = -2 * (slope @ step) - step @ scaled @ step
        trial_state = moved(state, step / scale)
        trial = problem(trial_state)
        if trial[0] <= cost:
            state, at, damping = trial_state, trial, max(damping / 10, 1e-12)
        else:
            damping = max(damping * 10, 1e-9)
        if gain <= 1e-12 * cost + 1e-24 or damping > 1e10:
            break
    return state, at


def stepped(X: np.ndarray, step: np.ndarray) -> np.ndarray:
    """X (3, 4) turned about its own axes by step[:3] [rad], and displaced by step[3:] [m]."""
    return frames.make(X[:, :3] @ frames.rotation(step[:3]), X[:, 3] + step[3:])


def skew(v: np.ndarray) -> np.ndarray:
    """[v]x of (n, 3) -> (n, 3, 3)."""
    S = np.zeros((len(v), 3, 3))
    S[:, 0, 1], S[:, 0, 2], S[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return S - S.transpose(0, 2, 1)


def divided(xy: np.ndarray, z: np.ndarray) -> np.ndarray:
    """d (x / z, y / z) / d (x, y, z) at x / z, y / z = xy (n, 2) -> (n, 2, 3)."""
    return np.concatenate([np.broadcast_to(np.eye(2), (len(xy), 2, 2)), -xy[:, :, None]], 2) / z[:, None, None]


def transform(rvec: np.ndarray, tvec: np.ndarray) -> np.ndarray:
    return frames.make(cv2.Rodrigues(rvec)[0], tvec.ravel())
