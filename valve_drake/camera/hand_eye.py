"""Hand-eye calibration: where a camera sits on the hand, or beside the robot, from boards and the arm's poses.

Two things are noisy: the corners, and the arm, whose reported pose is not its true one. A fit of the corners alone
(bundle adjustment with the arm's poses taken as exact) turns the arm's position error into an error of the camera's
rotation. Here each view gives the arm's pose twice: from its corners, and as the arm reports it. The difference of the
two, in rotation w and position t, has the covariance

    V = G P G^T + diag(a I, b I)

P of the board's pose by the corners' noise, a [rad^2] and b [m^2] the variances of the arm. Generalised least squares
finds the camera and the board for given a, b. Restricted likelihood (REML) rates how well a, b explain the views; the
result is the mean over all a, b by that likelihood, so that its covariance includes that a, b are estimates.

Frames: B robot base, E hand, C camera, T board. Lengths in m, pixels as in lens.py. On the hand (the board stands):
X = X_EC, Y = X_BT. Beside the robot (the hand holds the board): X = X_BC, Y = X_ET.
"""

import dataclasses as dc
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, ParamSpec, TypeAlias, TypeVar

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.camera.lens import LensModel
from valve_drake.camera.projection import divided, transform
from valve_drake.checks import ConfigError

Poses: TypeAlias = Sequence[np.ndarray] | np.ndarray  # (n, 3, 4)

METHODS = {
    "Tsai": cv2.CALIB_HAND_EYE_TSAI,
    "Park": cv2.CALIB_HAND_EYE_PARK,
    "Horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "Andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "Daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
MIN_VIEWS = 3  # two turns about different axes
STANDS_OUT = 5.0  # a view farther off is a blunder; raise it if good views are left out [standard deviations]
_MAX_BLUNDERS = 0.25  # share of the views that may be left out
_MIN_PX = 1e-3  # least noise of the corners that is assumed, since drawn corners are exact [px]
_SURE = 30.0  # a board's second pose is dropped if its squared residuals are larger by this [variances of the noise]
_MAX_TURN = 0.3  # of one step [rad]
_STEPS = 10  # of each variance's grid
_VISIBLE = 0.1  # least variance of that grid, as a share of the variance by the corners
# An arm may well be too exact for the corners to tell; prior odds of that, in units of the prior of one e-fold of
# variance. Less makes the covariance too large for exact arms, more too small for arms that are just visible.
_EXACT_ARM = 20.0
_NO_SOLUTION = "hand-eye: no solution; do the poses belong to the images?"
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def _or_refused(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """The function, with ConfigError where a matrix is singular: its numbers are those of no board, or of no arm."""

    @functools.wraps(function)
    def called(*args: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
        try:
            with np.errstate(all="ignore"):  # a warning of numpy's would be a line of its own on the terminal
                return function(*args, **options)
        except np.linalg.LinAlgError as error:
            raise ConfigError(_NO_SOLUTION) from error

    return called


@dc.dataclass(frozen=True)
class Seen:
    """The measurements of n views: the arm's pose as it reports it, and the board's by its corners."""

    arm: np.ndarray  # (n, 3, 4) X_BE
    board: np.ndarray  # (n, 3, 4) X_CT
    covariance: np.ndarray  # (n, 6, 6) of the board: turn about its axes [rad], displacement in C [m]
    to_hand: bool  # the camera stands beside the robot, the hand holds the board
    px: float  # standard deviation of a corner's coordinate [px]
    # A small board tilted the other way may look nearly the same: the second pose, and by how much it is less likely.
    second: np.ndarray  # (n, 3, 4)
    second_covariance: np.ndarray  # (n, 6, 6)
    second_cost: np.ndarray  # (n,) squared residuals in units of the noise; inf where there is none

    def __len__(self) -> int:
        return len(self.arm)

    def only(self, views: Sequence[int]) -> "Seen":
        """These views alone."""
        at = list(views)
        names = ("arm", "board", "covariance", "second", "second_covariance", "second_cost")
        return dc.replace(self, **{name: getattr(self, name)[at] for name in names})

    def carriers(self) -> np.ndarray:
        """(n, 3, 4) pose of what the hand-eye methods call the gripper: beside the robot, base and hand swap."""
        return np.array([frames.inverse(X) for X in self.arm]) if self.to_hand else self.arm


@dc.dataclass(frozen=True)
class Fit:
    """The camera and the board from all views of a `Seen`."""

    X: np.ndarray  # (3, 4) X_EC, or X_BC
    Y: np.ndarray  # (3, 4) X_BT, or X_ET
    covariance: np.ndarray  # (12, 12) of X, Y: turn about their own axes [rad], displacement [m], each
    variances: np.ndarray  # (2,) of the arm: rotation [rad^2], position [m^2], about each axis


@dc.dataclass(frozen=True)
class HandEye:
    """The camera in what carries it: X_EC on a hand (the board stands), X_BC beside the robot (the hand holds it)."""

    X: np.ndarray  # (3, 4) X_EC, or X_BC
    X_target: np.ndarray  # (3, 4) the board: X_BT, or X_ET
    covariance: np.ndarray  # (6, 6) of X: turn about the camera's axes [rad], position [m]
    arm_deg: float  # the arm's scatter about each axis, standard deviation
    arm_mm: float  # along each axis
    corner_px: float  # the corners' noise, standard deviation of a coordinate
    rotation_deg: np.ndarray  # (n,) residual of each view: the board's pose against X_target
    position_mm: np.ndarray  # (n,)
    left_out_deg: np.ndarray  # (n,) the same for a fit without that view
    left_out_mm: np.ndarray
    off: np.ndarray  # (n,) how far each view is off, in standard deviations (rms of its six numbers)
    used: tuple[int, ...]  # the views that are not blunders
    view_rms: np.ndarray  # (n,) of the corners, with the arm at its reported pose [px]
    rms: float  # of the used views [px]
    methods: dict[str, "Method"]  # published ones, on the same views

    @property
    def sigma_deg(self) -> np.ndarray:
        """(3,) standard deviations about the camera's axes."""
        return np.degrees(np.sqrt(np.diag(self.covariance)[:3]))

    @property
    def sigma_mm(self) -> np.ndarray:
        """(3,) standard deviations of the position."""
        return 1e3 * np.sqrt(np.diag(self.covariance)[3:])


@dc.dataclass(frozen=True)
class Method:
    """A published method on the used views: how far from our X, and its error in predicting a view left out (rms)."""

    apart_deg: float
    apart_mm: float
    left_out_deg: float
    left_out_mm: float


# ---------------------------------------------------------------- from images to poses


class _BoardPose(NamedTuple):
    X: np.ndarray  # (3, 4) X_CT
    information: np.ndarray  # (6, 6) by corners with a noise of 1 px
    squares: float  # sum of squared residuals [px^2]


def _boards(lens: LensModel, points: np.ndarray, px: np.ndarray) -> list[_BoardPose]:
    """The one or two poses that explain the corners, the better one first. Raises ConfigError if there is none."""
    xy, S = lens.normalize(px), frames.skew(points)
    to_px = np.linalg.inv(lens.normalize_jacobian(px))  # the corners' noise is the same all over the raw image
    out = []
    for rvec, tvec in zip(*cv2.solvePnPGeneric(points, xy, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)[1:3]):
        X = transform(*cv2.solvePnPRefineLM(points, xy, np.eye(3), None, rvec, tvec))
        for _ in range(3):
            P = frames.apply(X, points)
            at = P[:, :2] / P[:, 2:]
            dP = np.concatenate([-X[:, :3] @ S, np.broadcast_to(np.eye(3), S.shape)], 2)
            J = (to_px @ divided(at, P[:, 2]) @ dP).reshape(-1, 6)
            r = (to_px @ (at - xy)[:, :, None]).ravel()
            H = J.T @ J
            X = frames.stepped(X, -np.linalg.solve(H, J.T @ r))
        if np.isfinite(X).all() and X[2, 3] > 0:
            out.append(_BoardPose(X, H, float(r @ r)))
    if not out:
        raise ConfigError("hand-eye: the corners are not those of a board seen through this lens")
    return sorted(out, key=lambda pose: pose.squares)


@_or_refused
def observe(
    lens: LensModel,
    points: np.ndarray,
    corners: Sequence[np.ndarray],
    X_BE: Sequence[np.ndarray],
    to_hand: bool = False,
) -> Seen:
    """points (m, 3) in T, corners [(m, 2)] raw px and X_BE (3, 4) of each view."""
    poses = [_boards(lens, points, px) for px in corners]
    first, second = [of_view[0] for of_view in poses], [of_view[-1] for of_view in poses]  # the same if there is one
    freedom = sum(2 * len(px) - 6 for px in corners)
    px = max(math.sqrt(sum(pose.squares for pose in first) / max(freedom, 1)), _MIN_PX)
    cost = np.array([(b.squares - a.squares) / px**2 for a, b in zip(first, second)])
    same = [np.abs(b.X - a.X).max() < 1e-6 for a, b in zip(first, second)]
    return Seen(
        arm=np.array(X_BE, float),
        board=np.array([pose.X for pose in first]),
        covariance=px**2 * np.linalg.inv(np.array([pose.information for pose in first])),
        to_hand=to_hand,
        px=px,
        second=np.array([pose.X for pose in second]),
        second_covariance=px**2 * np.linalg.inv(np.array([pose.information for pose in second])),
        second_cost=np.where(same | (cost > _SURE), np.inf, cost),
    )


@_or_refused
def settled(seen: Seen, used: Sequence[int] | None = None) -> Seen:
    """The views, each with that of its two board poses that agrees with the arm by the fit to the views `used`."""
    for _ in range(3):
        if not np.isfinite(seen.second_cost).any():
            break
        fit = solve(seen if used is None else seen.only(used))
        other = dc.replace(
            seen,
            board=seen.second,
            covariance=seen.second_covariance,
            second=seen.board,
            second_covariance=seen.covariance,
            second_cost=-seen.second_cost,
        )
        better = 6 * deviations(fit, other) ** 2 + seen.second_cost < 6 * deviations(fit, seen) ** 2
        if not better.any():
            break
        chosen = {}
        for name in ("board", "covariance", "second", "second_covariance", "second_cost"):
            mine, theirs = getattr(seen, name), getattr(other, name)
            chosen[name] = np.where(better.reshape(-1, *[1] * (mine.ndim - 1)), theirs, mine)
        seen = dc.replace(seen, **chosen)
    return seen


def _arm_errors(X: np.ndarray, Y: np.ndarray, seen: Seen) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The arm's pose by the corners against the reported one.

    Returns e (n, 6), turn about E's axes [rad] and displacement in B [m]; d e / d (X, Y) (n, 6, 12); and the
    covariance of e by the corners' noise (n, 6, 6).
    """
    R_X, p_X, R_Y, p_Y = X[:, :3], X[:, 3], Y[:, :3], Y[:, 3]
    R_Z, p_Z = seen.board[:, :, :3], seen.board[:, :, 3]
    n, one = len(seen), np.eye(3)
    if seen.to_hand:  # X_BE = X Z Y^-1
        hand = -R_Y.T @ p_Y  # E's origin in T, in C, in B
        at = R_Z @ hand + p_Z
        R, p = R_X @ R_Z @ R_Y.T, at @ R_X.T + p_X
        by_Z = (R_Y, -R_X @ R_Z @ frames.skew(hand), R_X)
        by_X = (R_Y @ _T(R_Z), -R_X @ frames.skew(at), one)
        by_Y = (-R_Y, R_X @ R_Z @ frames.skew(hand), -R)
    else:  # X_BE = Y Z^-1 X^-1
        hand = -R_X.T @ p_X  # E's origin in C, in T, in B
        at = (_T(R_Z) @ (hand - p_Z)[:, :, None])[:, :, 0]
        R, p = R_Y @ _T(R_Z) @ R_X.T, at @ R_Y.T + p_Y
        by_Z = (-R_X @ R_Z, R_Y @ frames.skew(at), -R_Y @ _T(R_Z))
        by_X = (-R_X, R_Y @ _T(R_Z) @ frames.skew(hand), -R)
        by_Y = (R_X @ R_Z, -R_Y @ frames.skew(at), one)
    w = np.array([frames.rotation_vector(mine.T @ other) for mine, other in zip(seen.arm[:, :, :3], R)])
    turn = np.eye(3) + frames.skew(w) / 2  # d log(exp(w) exp(d)) / d d, to first order in w

    def jacobian(ww: np.ndarray, tw: np.ndarray, tt: np.ndarray) -> np.ndarray:
        J = np.zeros((n, 6, 6))
        J[:, :3, :3], J[:, 3:, :3], J[:, 3:, 3:] = turn @ ww, tw, tt
        return J

    G = jacobian(*by_Z)
    e = np.concatenate([w, p - seen.arm[:, :, 3]], 1)
    return e, np.concatenate([jacobian(*by_X), jacobian(*by_Y)], 2), G @ seen.covariance @ _T(G)


# ---------------------------------------------------------------- the fit


@_or_refused
def solve(seen: Seen, X: np.ndarray | None = None) -> Fit:
    """The camera and the board from all views, from the start X or a closed form. Raises ConfigError."""
    X = closed_hand_eye(seen.carriers(), seen.board) if X is None else X
    Y = _mean_pose(_targets(X, seen))
    window = None
    for _ in range(20):
        e, B, V = _arm_errors(X, Y, seen)
        if window is None:
            window = _window(e, B, V, _window(e, B, V, None))
        steps, covariances, weights, variances = _gridded(e, B, V, window)
        step = weights @ steps
        if not np.isfinite(step).all():
            raise ConfigError(_NO_SOLUTION)
        # Poses of other images start far off: a step is limited to a rotation in which the problem is nearly linear.
        step *= min(1.0, _MAX_TURN / max(np.abs(step[[0, 1, 2, 6, 7, 8]]).max(), 1e-12))
        X, Y = frames.stepped(X, step[:6]), frames.stepped(Y, step[6:])
        covariance = np.tensordot(weights, covariances, 1) + (weights * (steps - step).T) @ (steps - step)
        if step @ np.linalg.solve(covariance, step) < 1e-6:
            break
        window = _window(e, B, V, window)
    return Fit(X, Y, covariance, (weights @ np.sqrt(variances)) ** 2)


def _solve_known(seen: Seen, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """X, Y for the arm's variances of `fit`, started there."""
    X, Y = fit.X, fit.Y
    for _ in range(10):
        e, B, V = _arm_errors(X, Y, seen)
        steps, covariances, _ = _least_squares(e, B, V, fit.variances[None])
        X, Y = frames.stepped(X, steps[0, :6]), frames.stepped(Y, steps[0, 6:])
        if steps[0] @ np.linalg.solve(covariances[0], steps[0]) < 1e-6:
            break
    return X, Y


def _least_squares(
    e: np.ndarray, B: np.ndarray, V: np.ndarray, variances: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For K pairs of the arm's variances (K, 2): steps (K, 12), covariances (K, 12, 12), -2 log likelihood (K,)."""
    noise = np.repeat(variances, 3, 1)[:, None, :, None] * np.eye(6)
    V = V + noise
    W = np.linalg.inv(V)
    WB = W @ B
    H = (_T(B) @ WB).sum(1)
    g = (_T(WB) @ e[:, :, None]).sum((1, 3))
    C = np.linalg.inv(H)
    steps = -(C @ g[:, :, None])[:, :, 0]
    cost = np.linalg.slogdet(V)[1].sum(1) + np.linalg.slogdet(H)[1]
    return steps, C, cost + (e * (W @ e[:, :, None])[..., 0]).sum((1, 2)) + (g * steps).sum(1)


def _gridded(
    e: np.ndarray, B: np.ndarray, V: np.ndarray, window: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Steps and covariances over a grid of the arm's variances within `window` (2, 2), with their weights (K,).

    The prior is flat in the logarithm of the arm's and the corners' variance together, and has a point mass at 0.
    """
    lines = [np.linspace(low, high, _STEPS) for low, high in window]
    floors = _VISIBLE * _corner_variances(V)
    each = [np.array([0.0, *np.maximum(np.exp(line) - floor, 0.0)]) for line, floor in zip(lines, floors)]
    variances = np.stack([one.ravel() for one in np.meshgrid(*each, indexing="ij")], 1)
    prior = [np.array([_EXACT_ARM, *np.full(_STEPS, line[1] - line[0])]) for line in lines]
    steps, covariances, cost = _least_squares(e, B, V, variances)
    weights = np.outer(*prior).ravel() * np.exp((cost.min() - cost) / 2)
    return steps, covariances, weights / weights.sum(), variances


def _window(e: np.ndarray, B: np.ndarray, V: np.ndarray, window: np.ndarray | None) -> np.ndarray:
    """Where the variances that explain the views lie, in the logarithm of `_gridded`: (2, 2)."""
    floors = _VISIBLE * _corner_variances(V)
    if window is None:
        size = np.array([(e[:, :3] ** 2).mean(), (e[:, 3:] ** 2).mean()])
        return np.log(np.stack([floors, 30 * size + 100 * floors], 1))
    weights = _gridded(e, B, V, window)[2].reshape(_STEPS + 1, _STEPS + 1)
    out = np.empty((2, 2))
    for k in (0, 1):
        share = weights.sum(1 - k)[1:]
        step = (window[k, 1] - window[k, 0]) / (_STEPS - 1)
        likely = np.flatnonzero(share >= 1e-4 * share.max())
        out[k] = window[k, 0] + step * np.array([likely[0] - 1, likely[-1] + 1])
        if out[k, 1] > window[k, 1]:  # no upper end was found yet
            out[k, 1] += 2 * step
    return np.maximum(out, np.log(floors)[:, None] + [0, 1])


def _corner_variances(V: np.ndarray) -> np.ndarray:
    """(2,) typical variance of the arm's pose by the corners, rotation [rad^2] and position [m^2]."""
    known = np.median(np.diagonal(np.linalg.inv(V), axis1=1, axis2=2), 0)
    return 1 / np.array([known[:3].mean(), known[3:].mean()])


def closed_hand_eye(carriers: Poses, boards: Poses, method: int = cv2.CALIB_HAND_EYE_PARK) -> np.ndarray:
    """X (3, 4) from the poses of what carries the camera (X_BE, beside the robot X_EB) and the boards' X_CT.

    Raises ConfigError unless the hand turned about two axes: about one alone, the camera's place along it is free.
    """
    if len(carriers) < MIN_VIEWS:
        raise ConfigError(f"hand-eye: {len(carriers)} usable pose(s), needs at least {MIN_VIEWS}")
    second = math.degrees(turns(carriers)[1])
    if second < 2:
        raise ConfigError(
            f"hand-eye: the hand turned about one axis only ({second:.1f} deg about any other): "
            "turn it about two axes, by 30 deg or more"
        )
    return published(carriers, boards, method)


def turns(carriers: Poses) -> np.ndarray:
    """(3,) rms turn between two poses about the axes of the most, the second and the least turning [rad]."""
    w = [frames.rotation_vector(a[:, :3].T @ b[:, :3]) for a, b in itertools.combinations(carriers, 2)]
    out: np.ndarray = np.linalg.svd(np.array(w))[1] / math.sqrt(len(w))
    return out


def published(carriers: Poses, boards: Poses, method: int) -> np.ndarray:
    """X (3, 4) by one of OpenCV's METHODS. Raises ConfigError if it finds none."""
    logging = cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)  # OpenCV would write to the terminal what the exception says
    try:
        R, t = cv2.calibrateHandEye(
            [X[:, :3] for X in carriers],
            [X[:, 3] for X in carriers],
            [X[:, :3] for X in boards],
            [X[:, 3] for X in boards],
            method=method,
        )
    except cv2.error as error:
        raise ConfigError(_NO_SOLUTION) from error
    finally:
        logging.setLogLevel(level)
    if not (np.isfinite(t).all() and np.abs(R @ R.T - np.eye(3)).max() < 1e-3):  # also false for NaN
        raise ConfigError(_NO_SOLUTION)
    return frames.make(R, t.ravel())


# ---------------------------------------------------------------- blunders


@_or_refused
def deviations(fit: Fit, seen: Seen, used: Sequence[int] = ()) -> np.ndarray:
    """(n,) how far each view is off the fit, in standard deviations (rms of six). `used`: those that made the fit."""
    e, B, V = _arm_errors(fit.X, fit.Y, seen)
    V = V + np.diag(np.repeat(fit.variances, 3))
    others = ~np.isin(np.arange(len(seen)), list(used))
    V[others] += (B @ fit.covariance @ _T(B))[others]  # not of the views that made the fit
    off: np.ndarray = np.sqrt(np.einsum("ni,nij,nj->n", e, np.linalg.inv(V), e) / 6)
    return off


def majority(seen: Seen, tries: int = 40) -> list[int]:
    """The views that agree with most others: the fit to three views with the least median deviation decides."""
    n, best, start = len(seen), math.inf, None
    if n < 6:
        return list(range(n))
    rng = np.random.default_rng(0)
    for _ in range(tries):
        three = rng.choice(n, 3, replace=False).tolist()
        try:
            X = closed_hand_eye(*(of[three] for of in (seen.carriers(), seen.board)))
        except ConfigError:
            continue
        Y = _mean_pose(_targets(X, seen.only(three)))
        turned, displaced = _apart(Y, _targets(X, seen))
        score = math.log(np.median(turned) + 1e-9) + math.log(np.median(displaced) + 1e-9)
        if score < best:
            worst = np.maximum(turned / (np.median(turned) + 1e-9), displaced / (np.median(displaced) + 1e-9))
            best, start = score, np.argsort(worst, kind="stable")[: (n + 1) // 2 + 1]
    if start is None:
        return list(range(n))
    used = sorted(start.tolist())
    for _ in range(6):
        try:
            fit = solve(seen.only(used))
        except ConfigError:
            return list(range(n))
        again = np.flatnonzero(deviations(fit, seen, used) < STANDS_OUT).tolist()
        if again == used or len(again) < MIN_VIEWS:
            break
        used = again
    return used


# ---------------------------------------------------------------- all together


def hand_eye(
    lens: LensModel,
    points: np.ndarray,
    corners: Sequence[np.ndarray],
    X_BE: Sequence[np.ndarray],
    to_hand: bool = False,
) -> HandEye:
    """Hand-eye calibration of all views but blunders, which may be a quarter of them at most.

    points (m, 3) in T, corners [(m, 2)] raw px, X_BE (3, 4) for each. to_hand: the camera stands beside the robot and
    the hand holds the board; the answer is then X_BC. Raises ConfigError for poses that do not determine the camera.
    Poses that do not belong to the images give a large `arm_deg`: see `hand_eye_mistakes`.
    """
    return from_seen(observe(lens, points, corners, X_BE, to_hand), lens, points, corners)


@_or_refused
def from_seen(seen: Seen, lens: LensModel, points: np.ndarray, corners: Sequence[np.ndarray]) -> HandEye:
    """As `hand_eye`, of views observed already."""
    closed_hand_eye(seen.carriers(), seen.board)  # refuses poses that do not determine the camera
    seen = settled(seen, majority(seen))
    used = majority(seen)
    if len(seen) - len(used) > _MAX_BLUNDERS * len(seen):
        used = list(range(len(seen)))
    mine = seen.only(used)
    fit = solve(mine)
    rotation, position = _apart(fit.Y, _targets(fit.X, seen))
    left_out = np.stack([rotation, position], 1)
    for i, k in enumerate(used):
        rest = [j for j in range(len(used)) if j != i]
        if len(rest) < MIN_VIEWS or math.degrees(turns(mine.only(rest).carriers())[1]) < 2:
            left_out[k] = math.nan  # the view that alone brought a second axis
            continue
        X, Y = _solve_known(mine.only(rest), fit)
        left_out[k] = [one[0] for one in _apart(Y, _targets(X, mine.only([i])))]
    square = []
    for X_CT, px in zip(predicted(fit.X, fit.Y, seen), corners):
        P = frames.apply(X_CT, points)
        xy = lens.normalize(px)
        off = np.linalg.inv(lens.normalize_jacobian(px)) @ (P[:, :2] / P[:, 2:] - xy)[:, :, None]
        square.append((off**2).sum((1, 2)))
    return HandEye(
        X=fit.X,
        X_target=fit.Y,
        covariance=fit.covariance[:6, :6],
        arm_deg=math.degrees(math.sqrt(fit.variances[0])),
        arm_mm=1e3 * math.sqrt(fit.variances[1]),
        corner_px=seen.px,
        rotation_deg=rotation,
        position_mm=position,
        left_out_deg=left_out[:, 0],
        left_out_mm=left_out[:, 1],
        off=deviations(fit, seen, used),
        used=tuple(used),
        view_rms=np.array([math.sqrt(s.mean()) for s in square]),
        rms=math.sqrt(np.concatenate([square[k] for k in used]).mean()),
        methods=_compared(mine, fit.X),
    )


def _compared(seen: Seen, X: np.ndarray) -> dict[str, Method]:
    """The published methods on the same views, judged by leaving out one view at a time."""
    out, n, carriers = {}, len(seen), seen.carriers()
    for name, method in METHODS.items():
        try:
            whole = published(carriers, seen.board, method)
            left_out = []
            for k in range(n) if n > MIN_VIEWS else ():
                rest = [i for i in range(n) if i != k]
                one = published(carriers[rest], seen.board[rest], method)
                Y = _mean_pose(_targets(one, seen.only(rest)))
                left_out.append([float(v[0]) for v in _apart(Y, _targets(one, seen.only([k])))])
        except ConfigError:
            continue
        turned, displaced = _apart(X, whole[None])
        rms = np.sqrt(np.mean(np.square(left_out), 0)) if left_out else np.full(2, math.nan)
        out[name] = Method(float(turned[0]), float(displaced[0]), *rms.tolist())
    return out


@_or_refused
def disagreement(seen: Seen) -> np.ndarray:
    """How far all views are apart about the closed form: (2,) rms [deg], [mm]. Raises ConfigError."""
    X = closed_hand_eye(seen.carriers(), seen.board)
    targets = _targets(X, seen)
    return np.array([math.sqrt((one**2).mean()) for one in _apart(_mean_pose(targets), targets)])


def predicted(X: np.ndarray, Y: np.ndarray, seen: Seen) -> list[np.ndarray]:
    """X_CT (3, 4) of each view by the arm's reported pose."""
    return [frames.compose(frames.inverse(X), frames.inverse(one), Y) for one in seen.carriers()]


def _targets(X: np.ndarray, seen: Seen) -> np.ndarray:
    """(n, 3, 4) where each view puts the board, in B (beside the robot: in E)."""
    return np.array([frames.compose(one, X, board) for one, board in zip(seen.carriers(), seen.board)])


def _apart(X: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far others (n, 3, 4) are from X (3, 4) [deg], [mm]."""
    turned = [np.degrees(np.linalg.norm(frames.rotation_vector(X[:, :3].T @ one[:, :3]))) for one in others]
    return np.array(turned), 1e3 * np.linalg.norm(others[:, :, 3] - X[:, 3], axis=1)


def _mean_pose(poses: np.ndarray) -> np.ndarray:
    """(n, 3, 4) -> (3, 4), the rotation by the mean matrix."""
    U, _, Vt = np.linalg.svd(poses[:, :, :3].mean(0))
    return frames.make(U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt, poses[:, :, 3].mean(0))


def _T(M: np.ndarray) -> np.ndarray:
    """Matrices (..., m, n) transposed."""
    return np.swapaxes(M, -1, -2)
