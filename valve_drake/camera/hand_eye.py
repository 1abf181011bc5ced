"""Hand-eye calibration: where a camera sits on the hand, or beside the robot, from boards and the arm's poses.

Frames: B robot base, E hand, C camera, T board. Lengths in m, pixels as in lens.py.
"""

import dataclasses as dc
import math
from collections.abc import Sequence

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.camera.least_squares import divided, minimize, skew, stepped, transform
from valve_drake.camera.lens import LensModel
from valve_drake.checks import ConfigError


@dc.dataclass(frozen=True)
class HandEye:
    """The camera in what carries it: X_EC on a hand (the board stands), X_BC beside the robot (the hand holds it)."""

    X: np.ndarray  # (3, 4) X_EC, or X_BC
    X_target: np.ndarray  # (3, 4) the board: X_BT, or X_ET
    sigma_deg: np.ndarray  # (3,) jackknife, about the camera's axes
    sigma_mm: np.ndarray  # (3,)
    rotation_deg: np.ndarray  # (n,) residual of each view: the board's pose against X_target
    position_mm: np.ndarray  # (n,)
    left_out_deg: np.ndarray  # (n,) the same for a fit without that view
    left_out_mm: np.ndarray
    view_rms: np.ndarray  # (n,) of the corners [px]
    rms: float  # [px]


def board_pose(lens: LensModel, points: np.ndarray, px: np.ndarray) -> np.ndarray:
    """X_CT (3, 4) of a planar board by its corners' least squares."""
    xy = lens.normalize(px)
    _, rvec, tvec = cv2.solvePnP(points, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    rvec, tvec = cv2.solvePnPRefineLM(points, xy, np.eye(3), None, rvec, tvec)
    return transform(rvec, tvec)


def closed_hand_eye(X_BE: Sequence[np.ndarray], X_CT: Sequence[np.ndarray]) -> np.ndarray:
    """X_EC (3, 4) from hand poses and board poses (3, 4) each, by Park's method.

    Raises ConfigError unless the hand turned about two axes: about one alone, the camera's place along it is free.
    """
    if len(X_BE) < 3:
        raise ConfigError(f"hand-eye: {len(X_BE)} usable pose(s), needs at least 3")
    turns = [frames.rotation_vector(a[:, :3].T @ b[:, :3]) for k, a in enumerate(X_BE) for b in X_BE[k + 1 :]]
    second = float(np.linalg.svd(np.array(turns))[1][1] / math.sqrt(len(turns)))
    if second < math.radians(2):
        raise ConfigError(
            f"hand-eye: the hand turned about one axis only ({math.degrees(second):.1f} deg about any other): "
            "turn it about two axes, by 30 deg or more"
        )
    R, t = cv2.calibrateHandEye(
        [X[:, :3] for X in X_BE],
        [X[:, 3] for X in X_BE],
        [X[:, :3] for X in X_CT],
        [X[:, 3] for X in X_CT],
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        raise ConfigError("hand-eye: no solution; do the poses belong to the images?")
    return frames.make(R, t.ravel())


def hand_eye(
    lens: LensModel,
    points: np.ndarray,
    corners: Sequence[np.ndarray],
    X_BE: Sequence[np.ndarray],
    to_hand: bool = False,
) -> HandEye:
    """Hand-eye calibration: Park's method, then least squares of all corners' residuals.

    points (n, 3) in T, corners [(n, 2)] raw px, X_BE (3, 4) for each. to_hand: the camera stands beside the robot and
    the hand holds the board; the answer is then X_BC.
    """
    # Beside the robot, base and hand change places.
    X_BE = [frames.inverse(X) if to_hand else np.asarray(X, float) for X in X_BE]
    X_CT = [board_pose(lens, points, px) for px in corners]
    xy = [lens.normalize(px) for px in corners]
    X, X_target = _refined_hand_eye(lens, points, xy, X_BE, X_CT)
    rotation, position = _board_residuals(X, X_target, X_BE, X_CT)
    everything = range(len(X_BE))
    turned, moved, left_out = [], [], []
    for k in everything if len(X_BE) > 3 else ():
        rest = [i for i in everything if i != k]
        try:
            one = _refined_hand_eye(lens, points, *([of[i] for i in rest] for of in (xy, X_BE, X_CT)))
        except ConfigError:  # the view that alone brought a second axis
            left_out.append((math.nan, math.nan))
            continue
        turned.append(frames.rotation_vector(X[:, :3].T @ one[0][:, :3]))
        moved.append(one[0][:, 3])
        left_out.append([float(v[0]) for v in _board_residuals(*one, [X_BE[k]], [X_CT[k]])])
    n = len(turned)
    spread = [np.full(3, math.nan)] * 2
    if n > 1:
        spread = [np.sqrt((n - 1) / n * ((v - np.mean(v, 0)) ** 2).sum(0)) for v in (np.array(turned), np.array(moved))]
    square = []
    for X_i, seen in zip(X_BE, xy):
        P = frames.apply(frames.compose(frames.inverse(X), frames.inverse(X_i), X_target), points)
        square.append((((P[:, :2] / P[:, 2:] - seen) * lens.focal()) ** 2).sum(1))
    out = np.array(left_out or [(math.nan, math.nan)] * len(X_BE))
    return HandEye(
        X=X,
        X_target=X_target,
        sigma_deg=np.degrees(spread[0]),
        sigma_mm=1e3 * spread[1],
        rotation_deg=rotation,
        position_mm=position,
        left_out_deg=out[:, 0],
        left_out_mm=out[:, 1],
        view_rms=np.array([math.sqrt(s.mean()) for s in square]),
        rms=math.sqrt(np.mean(square)),
    )


def _board_residuals(
    X: np.ndarray, X_target: np.ndarray, X_BE: Sequence[np.ndarray], X_CT: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """How far each view puts the board from where it is [deg], [mm]."""
    boards = [frames.compose(X_i, X, X_j) for X_i, X_j in zip(X_BE, X_CT)]
    turn = [np.degrees(np.linalg.norm(frames.rotation_vector(X_target[:, :3].T @ B[:, :3]))) for B in boards]
    return np.array(turn), np.array([1e3 * np.linalg.norm(B[:, 3] - X_target[:, 3]) for B in boards])


def _refined_hand_eye(
    lens: LensModel,
    points: np.ndarray,
    xy: Sequence[np.ndarray],
    X_BE: Sequence[np.ndarray],
    X_CT: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """X_EC and X_BT from all corners together, started by the closed form."""
    X = closed_hand_eye(X_BE, X_CT)
    boards = [frames.compose(X_i, X, X_j) for X_i, X_j in zip(X_BE, X_CT)]
    R0 = boards[0][:, :3]
    turn = np.mean([frames.rotation_vector(R0.T @ B[:, :3]) for B in boards], axis=0)
    X_BT = frames.make(R0 @ frames.rotation(turn), np.mean([B[:, 3] for B in boards], axis=0))
    S, focal = skew(points), lens.focal()

    def problem(state: tuple[np.ndarray, np.ndarray]) -> tuple[float, np.ndarray, np.ndarray]:
        X_EC, X_BT = state
        H, g, cost = np.zeros((12, 12)), np.zeros(12), 0.0
        for X_i, seen in zip(X_BE, xy):
            R = (X_i[:, :3] @ X_EC[:, :3]).T  # R_CB
            P = frames.apply(frames.compose(frames.inverse(X_EC), frames.inverse(X_i), X_BT), points)
            if not (P[:, 2] > 1e-6).all():
                return math.inf, H, g
            at = P[:, :2] / P[:, 2:]
            D = focal * divided(at, P[:, 2])
            dP = np.concatenate(
                [
                    skew(P),
                    np.broadcast_to(-X_EC[:, :3].T, S.shape),
                    -R @ X_BT[:, :3] @ S,
                    np.broadcast_to(R, S.shape),
                ],
                2,
            )
            J, r = (D @ dP).reshape(-1, 12), focal * (at - seen).ravel()
            H, g, cost = H + J.T @ J, g + J.T @ r, cost + float(r @ r)
        return cost, H, g

    def moved(state: tuple[np.ndarray, np.ndarray], step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return stepped(state[0], step[:6]), stepped(state[1], step[6:])

    return minimize(problem, (X, X_BT), moved)[0]
