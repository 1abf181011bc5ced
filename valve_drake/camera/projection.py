"""Derivatives of the pinhole, and OpenCV's poses as ours, for the calibrations."""

import cv2
import numpy as np

from valve_drake import frames


def divided(xy: np.ndarray, z: np.ndarray) -> np.ndarray:
    """d (x / z, y / z) / d (x, y, z) at x / z, y / z = xy (n, 2) -> (n, 2, 3)."""
    return np.concatenate([np.broadcast_to(np.eye(2), (len(xy), 2, 2)), -xy[:, :, None]], 2) / z[:, None, None]


def transform(rvec: np.ndarray, tvec: np.ndarray) -> np.ndarray:
    """OpenCV's rotation vector and translation -> (3, 4)."""
    return frames.make(cv2.Rodrigues(rvec)[0], tvec.ravel())
