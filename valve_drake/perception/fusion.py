"""The mean of several estimates of a marker that is at rest."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np

from valve_drake import frames
from valve_drake.messages import RectangleEstimate
from valve_drake.perception.ambiguity import HALF_TURN


@dc.dataclass(frozen=True)
class FusedPose:
    """The mean of several estimates, in the common frame O."""

    found: bool
    X_OV: np.ndarray = dc.field(default_factory=lambda: np.eye(3, 4))
    covariance: np.ndarray = dc.field(default_factory=lambda: np.zeros((6, 6)))  # theta in V, p in O [rad^2, m^2]
    spread: np.ndarray = dc.field(default_factory=lambda: np.zeros(6))  # standard deviation over the frames [rad, m]
    used: int = 0  # frames that took part
    axis_known: bool = False
    reason: str = ""
    angle: float = 0.0  # of a marker on the panel: how far the valve is turned, by the frames that show it [rad]


MOVING = (0.005, 0.01)  # error of a camera's place in O between frames of a base that drives or turns [rad, m]


def fuse(
    estimates: Sequence[RectangleEstimate],
    common: float = 0.2,
    gate: float = 4.0,
    apart: tuple[float, float] = (0.0, 0.0),
) -> FusedPose:
    """Mean pose of estimates, each weighted by its covariance, outliers dropped.

    common: share of an estimate's variance that all frames have in common (lens, pixel phase: the robot stands
    still), which no mean removes. gate: an estimate further than this from the median is dropped [sigma]. apart:
    standard deviation of each frame's own error of its place, zero at rest, else MOVING [rad, m]. An estimate knows its
    angles and its place together far better than each alone: frames that are a little apart, weighted by that, would
    have a mean that is centimetres from all of them.
    """
    good = [e for e in estimates if e.found]
    if not good:
        return FusedPose(found=False, reason=estimates[-1].reason if estimates else "no estimate")
    poses = [frames.compose(e.X_OL, e.X_LV) for e in good]
    reference = next((k for k, e in enumerate(good) if e.axis_known), 0)
    R0, p0 = poses[reference][:, :3], poses[reference][:, 3]
    offsets, spreads = [], []
    for e, X in zip(good, poses):
        R, sign = X[:, :3], np.ones(6)
        if R[:, 0] @ R0[:, 0] < 0:  # the bar's two ends look alike
            R, sign[:2] = R @ HALF_TURN, -1
        to_O = np.eye(6)
        to_O[3:, 3:] = e.X_OL[:, :3]
        C = to_O @ e.covariance @ to_O.T + np.diag(np.repeat(np.square(apart), 3))
        spreads.append(C * np.outer(sign, sign))
        offsets.append(np.append(frames.rotation_vector(R0.T @ R), X[:, 3] - p0))
    errors, covariances = np.array(offsets), np.array(spreads)
    off = errors - np.median(errors, axis=0)
    scatter = 1.48 * np.median(np.abs(off), axis=0)
    scale = np.maximum(np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)), scatter)
    keep = (np.abs(off) < gate * scale).all(1)
    if not keep.any():
        return FusedPose(found=False, reason="the estimates disagree")
    information = np.linalg.inv(covariances[keep])
    total = np.linalg.inv(information.sum(0))
    mean = total @ np.einsum("kij,kj->i", information, errors[keep])
    n = int(keep.sum())
    left = errors[keep] - mean
    inflation = 1.0
    if n > 1:
        inflation = max(1.0, float(np.einsum("ki,kij,kj->", left, information, left)) / (6 * (n - 1)))
    return FusedPose(
        found=True,
        X_OV=frames.make(R0 @ frames.rotation(mean[:3]), p0 + mean[3:]),
        covariance=total * ((1 - common) * inflation + common * n),
        spread=left.std(0, ddof=1) if n > 1 else np.zeros(6),
        used=n,
        axis_known=any(e.axis_known for e, k in zip(good, keep) if k),
        angle=_mean_angle([e for e in good if e.angle_seen]),
    )


def _mean_angle(seen: Sequence[RectangleEstimate]) -> float:
    """Of the valve [rad]; the estimator has followed it from frame to frame. Far from the median a mark was another."""
    if not seen:
        return 0.0
    angles = np.array([e.angle for e in seen])
    off = np.abs(angles - np.median(angles))
    weights = (off <= max(0.01, 4 * float(np.median(off)))) / np.array([e.angle_sigma**2 + 1e-6 for e in seen])
    return float(weights @ angles / weights.sum())
