"""Calibration of one camera and of the stereo head, from images of a chessboard.

Zhang's method: OpenCV gives the initial values; one bundle adjustment (Levenberg-Marquardt, analytic Jacobian) refines
both lens models on the same corners, so that they can be compared:

    opencv  K and of the distortion k1, k2, p1, p2, k3 those terms that the corners determine, the others 0
    paper   eq. (1), (2): k_x, k_y, u_0, v_0, k_u, k_v

A term is fitted if it lowers the residuals by more than chance would (Schwarz's Bayesian criterion), and only if the
lens then maps the whole image one to one. A lens also carries `sigma_px`, its standard deviation over the image: terms
that were not fitted count as unknown there, so that it is large where no board was.

The root mean square of the residuals does not tell whether a calibration is good. The standard deviations do, and so
does `split_half`: the difference between points that two calibrations, each from every second view, triangulate.

Frames: L, R cameras; C one camera; T board. Lengths in m, pixels as in lens.py.
"""

import dataclasses as dc
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.camera.board import Board
from valve_drake.camera.lens import KNOWN, Lens, OpenCvLens, StereoHead, check_baseline
from valve_drake.camera.projection import divided, transform
from valve_drake.camera.triangulation import triangulate_all
from valve_drake.checks import ConfigError
from valve_drake.least_squares import minimize

KINDS = ("opencv", "paper")
RANGES = (0.5, 1.0, 2.0)  # at which points are triangulated [m]
MIN_VIEWS = 3  # of boards in any pose: fewer do not determine a lens
_MAX_FOCAL_SIGMA = 0.02  # relative standard deviation of a focal length that is accepted; raise it for coarse work
_MIN_TILT = 8.0  # some board must be tilted by this against the camera's axis, and by this against another [deg]
_TILT = "tilt it by up to 45 deg to all sides, or give --distances"
_OUTLIER = 2.5  # a view with more than this times the median view's rms is reported; raise it if good views are
_APART = 0.15  # a pair whose X_LR differs by more is reported: rotation [rad] + shift / distance of the boards
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
# Sets of distortion terms, as indices of _COEFFICIENTS: k3 never without k2, nor k2 without k1. The first is the start.
_TERMS = ((0, 1, 2, 3, 4), (0, 1, 2, 3), (0, 2, 3), (2, 3), (0, 1, 4), (0, 1), (0,), ())
_FRONTAL_TERMS = ((0,), ())
_POWER = (2, 4, 1, 1, 6)  # the power of the radius with which each term acts
# Standard deviation of what an unfitted term may do at the image's corner, relative to the radius there; raise the
# first for wide-angle lenses, which distort more.
_PRIOR = (0.2, 0.1, 2e-3, 2e-3, 0.05)
_MAP = (7, 9)  # rows and columns of the map of standard deviations
_FISHEYE_RMS = 0.2  # a fisheye model is tried if a camera's corners have a larger rms than this [px]
_FISHEYE = 0.6  # the images are a fisheye's if its model leaves less than this share of the pinhole's rms
_WORSE = 1.2  # factor by which the rms may rise when terms are dropped because the lens would fold back
_MISFIT = 10.0  # pairs are refused if the rms of both cameras together exceeds 1 px + this times that of each alone


@dc.dataclass(frozen=True)
class View:
    """The corners of one board, in one or two cameras.

    Views with the same `body` are one rigid target (boards at known distances): `points` are in its frame.
    """

    names: tuple[str, ...]  # of the images, one for each camera
    points: np.ndarray  # (n, 3) [m]
    px: tuple[np.ndarray, ...]  # (n, 2) for each camera
    body: int


@dc.dataclass(frozen=True)
class Fit:
    """One lens model fitted to all views."""

    kind: str
    lenses: tuple[Lens | OpenCvLens, ...]
    X_LR: np.ndarray | None  # (3, 4), stereo only
    poses: tuple[np.ndarray, ...]  # X_LT of each body
    rms: float  # over corners, sqrt(mean(du^2 + dv^2)) as OpenCV has it [px]
    covariance: np.ndarray  # (G, G) of what all views share: the lenses, then (theta, p) of X_LR
    residuals: tuple[tuple[np.ndarray, ...], ...]  # [view][camera] -> (n, 2) predicted - seen [px]
    names: tuple[str, ...]  # of the G shared parameters

    def head(self) -> StereoHead:
        """The stereo head. With one camera both sides are that camera and X_LR is the identity."""
        X_LR = np.eye(3, 4) if self.X_LR is None else self.X_LR
        return StereoHead(self.lenses[0], self.lenses[-1], X_LR, rms_px=self.rms)

    def view_rms(self) -> np.ndarray:
        """(views, cameras) [px]."""
        return np.array([[_rms(r) for r in view] for view in self.residuals])

    def outliers(self) -> list[int]:
        """Views whose residuals stand out from the median view's."""
        rms = np.sqrt((self.view_rms() ** 2).mean(1))
        return [k for k, value in enumerate(rms) if value > _OUTLIER * np.median(rms)]

    def sigmas(self) -> dict[str, float]:
        """Standard deviation of each shared parameter."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist()))


@dc.dataclass(frozen=True)
class Calibration:
    """Both lens models on the same corners; `fit` is the chosen one."""

    fit: Fit
    other: Fit
    better: str  # the kind that explains the corners better for its number of parameters
    views: tuple[View, ...]
    split_half: dict[float, float] | None  # range [m] -> difference [m], stereo only
    depth_sigma: dict[float, float]  # range [m] -> standard deviation by the covariance [m], stereo only
    pitch: tuple[float, float] | None  # triangulated pitch over the true one: mean, standard deviation
    unknown: tuple[float, ...]  # share of each image in which the lens is known to worse than KNOWN


# ---------------------------------------------------------------- lens models with their derivatives


class _Kind(Protocol):
    """A lens model whose m parameters are fitted."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""

    def start(self, K: np.ndarray, dist: np.ndarray) -> np.ndarray:
        """Parameters (m,) of about the same lens as OpenCV's K (3, 3) [px] and dist (5,)."""

    def lens(self, p: np.ndarray, size: tuple[int, int]) -> Lens | OpenCvLens:
        """The lens of parameters (m,); size: width, height [px]."""

    def project(self, lens: Any, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """px (n, 2), d px / d xy (n, 2, 2), d px / d parameters (n, 2, m) of ideal xy (n, 2)."""


class _OpenCvKind:
    """OpenCV's model. Of k1, k2, p1, p2, k3 those with their index in `free` are fitted, the others are 0."""

    def __init__(self, free: Sequence[int]):
        self.free = list(free)
        self.names = ("fx", "fy", "cx", "cy", *(_COEFFICIENTS[k] for k in self.free))

    def start(self, K: np.ndarray, dist: np.ndarray) -> np.ndarray:
        return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *dist[self.free]])

    def lens(self, p: np.ndarray, size: tuple[int, int]) -> OpenCvLens:
        dist = np.zeros(5)
        dist[self.free] = p[4:]
        return OpenCvLens(np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1]]), dist, *size)

    def project(self, lens: OpenCvLens, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """px (n, 2), d px / d xy (n, 2, 2), d px / d parameters (n, 2, m)."""
        points = np.column_stack([xy, np.ones(len(xy))])
        px, J = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.K, lens.dist)
        J = J.reshape(len(xy), 2, -1)  # rvec, tvec, f, c, dist
        return px[:, 0], J[:, :, 3:5], J[:, :, [6, 7, 8, 9, *(10 + k for k in self.free)]]


class _PaperKind:
    names = ("k_x", "k_y", "u_0", "v_0", "k_u", "k_v")

    def start(self, K: np.ndarray, dist: np.ndarray) -> np.ndarray:
        k = -dist[0] / (K[0, 0] * K[1, 1])  # eq. (1) is the inverse of OpenCV's k1, to first order
        return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], k, k])

    def lens(self, p: np.ndarray, size: tuple[int, int]) -> Lens:
        k_x, k_y, u_0, v_0, k_u, k_v = map(float, p)
        return Lens(k_u, k_v, k_x, k_y, u_0, v_0, *size)

    def project(self, lens: Lens, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """By the implicit function: normalize(px; parameters) = xy."""
        px = lens.project(xy)
        A = np.linalg.inv(lens.normalize_jacobian(px))
        d = px - [lens.u_0, lens.v_0]
        r2 = (d * d).sum(-1)
        J = np.zeros((len(xy), 2, 6))
        J[:, :, 0], J[:, :, 1] = A[:, :, 0] * (xy[:, :1] / lens.k_x), A[:, :, 1] * (xy[:, 1:] / lens.k_y)
        J[:, 0, 2] = J[:, 1, 3] = 1.0
        J[:, :, 4] = A[:, :, 0] * (-d[:, 0] * r2 / lens.k_x)[:, None]
        J[:, :, 5] = A[:, :, 1] * (-d[:, 1] * r2 / lens.k_y)[:, None]
        return px, A, J


# ---------------------------------------------------------------- bundle adjustment


@dc.dataclass(frozen=True)
class _State:
    lenses: tuple[np.ndarray, ...]  # parameters of each
    X_LR: np.ndarray | None
    poses: tuple[np.ndarray, ...]


class _Problem:
    """Sum of squares of all corners' residuals, as a function of the lenses, X_LR and the bodies' poses."""

    def __init__(self, views: Sequence[View], kind: _Kind, size: tuple[int, int]):
        self.views, self.kind, self.size = views, kind, size
        self.cameras = len(views[0].px)
        self.bodies = max(view.body for view in views) + 1
        self.m = len(kind.names)
        self.shared = self.m * self.cameras + (6 if self.cameras == 2 else 0)

    def __call__(self, state: _State) -> tuple[float, np.ndarray, np.ndarray, list[list[np.ndarray]]]:
        """Cost, its Gauss-Newton Hessian and gradient (halved), and the residuals."""
        n = self.shared + 6 * self.bodies
        H, g, cost = np.zeros((n, n)), np.zeros(n), 0.0
        residuals: list[list[np.ndarray]] = []
        lenses = [self.kind.lens(p, self.size) for p in state.lenses]
        for view in self.views:
            X_LT = state.poses[view.body]
            P = frames.apply(X_LT, view.points)
            dP = np.concatenate(
                [-X_LT[:, :3] @ frames.skew(view.points), np.broadcast_to(np.eye(3), (len(P), 3, 3))], 2
            )
            mine = slice(self.shared + 6 * view.body, self.shared + 6 * view.body + 6)
            residuals.append([])
            for c, (lens, px) in enumerate(zip(lenses, view.px)):
                Q, dQ, dX = P, dP, None
                if c == 1 and state.X_LR is not None:
                    R = state.X_LR[:, :3]
                    Q, dQ = (P - state.X_LR[:, 3]) @ R, R.T @ dP
                    dX = np.concatenate([frames.skew(Q), np.broadcast_to(-R.T, (len(Q), 3, 3))], 2)
                if not (Q[:, 2] > 1e-6).all():
                    return math.inf, H, g, residuals
                xy = Q[:, :2] / Q[:, 2:]
                predicted, D, own = self.kind.project(lens, xy)
                D = D @ divided(xy, Q[:, 2])
                r = predicted - px
                columns = [np.arange(c * self.m, (c + 1) * self.m), np.arange(mine.start, mine.stop)]
                blocks = [own, D @ dQ]
                if dX is not None:
                    columns.append(np.arange(self.shared - 6, self.shared))
                    blocks.append(D @ dX)
                at = np.concatenate(columns)
                J = np.concatenate(blocks, 2).reshape(-1, len(at))
                H[np.ix_(at, at)] += J.T @ J
                g[at] += J.T @ r.ravel()
                cost += float((r * r).sum())
                residuals[-1].append(r)
        return (cost if np.isfinite(cost) else math.inf), H, g, residuals

    def moved(self, state: _State, step: np.ndarray) -> _State:
        lenses = tuple(p + step[c * self.m : (c + 1) * self.m] for c, p in enumerate(state.lenses))
        X_LR = None if state.X_LR is None else frames.stepped(state.X_LR, step[self.shared - 6 : self.shared])
        poses = step[self.shared :].reshape(-1, 6)
        return _State(lenses, X_LR, tuple(frames.stepped(X, s) for X, s in zip(state.poses, poses)))

    def names(self) -> tuple[str, ...]:
        if self.cameras == 1:
            return self.kind.names
        out = [f"{side}.{name}" for side in ("left", "right") for name in self.kind.names]
        return (*out, *(f"X_LR.{name}" for name in ("theta_x", "theta_y", "theta_z", "p_x", "p_y", "p_z")))


def _solve(views: Sequence[View], kind: _Kind, name: str, start: _State, size: tuple[int, int]) -> Fit:
    problem = _Problem(views, kind, size)
    state, (cost, H, _, residuals) = minimize(problem, start, problem.moved)
    if not math.isfinite(cost):
        raise ConfigError("the calibration has no start: do the images, and the poses, belong together?")
    corners = sum(len(r) for view in residuals for r in view)
    scale = np.sqrt(np.diag(H)) + 1e-150
    # A direction that the corners do not determine gets a huge standard deviation instead of an error.
    inverse = np.linalg.pinv(H / np.outer(scale, scale), rcond=1e-15, hermitian=True) / np.outer(scale, scale)
    covariance = inverse[: problem.shared, : problem.shared] * cost / max(2 * corners - len(H), 1)
    return Fit(
        kind=name,
        lenses=tuple(kind.lens(p, size) for p in state.lenses),
        X_LR=state.X_LR,
        poses=state.poses,
        rms=math.sqrt(cost / corners),
        covariance=covariance,
        residuals=tuple(tuple(view) for view in residuals),
        names=problem.names(),
    )


# ---------------------------------------------------------------- intrinsics and stereo


class _Alone(NamedTuple):
    """OpenCV's calibration of one camera by itself."""

    rms: float  # [px]
    K: np.ndarray  # (3, 3) [px]
    dist: np.ndarray  # (5,)
    poses: tuple[np.ndarray, ...]  # X_CT of each body


@dc.dataclass(frozen=True)
class _Start:
    """OpenCV's calibration of each camera alone, and the initial X_LR that follows from both."""

    views: tuple[View, ...]  # right corners renumbered so that both cameras agree
    lenses: list[tuple[np.ndarray, np.ndarray]]  # (K, dist) of each camera
    X_LR: np.ndarray | None
    poses: tuple[np.ndarray, ...]  # X_LT of each body
    alone: tuple[float, ...]  # rms of the corners of each camera [px]
    misfits: list[tuple[str, ...]]  # names of the pairs whose X_LR differs from that of most pairs


def board_views(
    board: Board,
    names: Sequence[tuple[str, ...]],
    corners: Sequence[tuple[np.ndarray | None, ...]],
    distances: Sequence[float] | None = None,
) -> list[View]:
    """Views of the boards that were found in every camera's image; with distances [m] all are one rigid target."""
    views: list[View] = []
    for k, (name, corners_of_each) in enumerate(zip(names, corners)):
        px = tuple(found for found in corners_of_each if found is not None)
        if len(px) < len(corners_of_each):
            continue
        points, body = board.points(), len(views)
        if distances is not None:
            points, body = points + [0, 0, distances[k] - np.mean(distances)], 0
        views.append(View(name, points, px, body))
    return views


def calibrate(
    views: Sequence[View], size: tuple[int, int], kind: str = "opencv", board: Board | None = None
) -> Calibration:
    """One camera or the stereo head (as many cameras as the views have), `size` = width, height [px].

    kind: opencv, paper, or best (the better of the two). Raises ConfigError for views that do not determine a camera.
    """
    rigid = len(views) > 1 and views[0].body == views[-1].body
    least = 2 if rigid else MIN_VIEWS
    if len(views) < least:
        raise ConfigError(f"the board was found in {len(views)} view(s): a calibration needs at least {least}")
    # Boards that all face the camera determine at most k1.
    sets = _FRONTAL_TERMS if rigid else _TERMS
    start = _start(views, size, _OpenCvKind(sets[0]), rigid, board)
    views = start.views
    kinds: dict[str, _Kind] = {"opencv": _OpenCvKind(sets[0]), "paper": _PaperKind()}
    fits: dict[str, Fit] = {}
    for name, model in kinds.items():
        lenses = tuple(model.start(K, dist) for K, dist in start.lenses)
        try:
            fits[name] = _solve(views, model, name, _State(lenses, start.X_LR, start.poses), size)
        except np.linalg.LinAlgError as error:
            raise ConfigError(f"degenerate: the boards do not determine a camera: {_TILT}") from error
    _refuse_misfits(fits["opencv"], start)
    if start.X_LR is not None:
        check_baseline(fits["opencv"].head(), "--left and --right: X_LR")
    _refuse_fisheye(start, size)
    fits["opencv"] = _determined(fits["opencv"], views, sets, size)
    kinds["opencv"] = _OpenCvKind(_free(fits["opencv"]))
    _refuse_vague(fits["opencv"], rigid)
    better = min(fits, key=lambda name: _information(fits[name]))
    fit = fits[better if kind == "best" else kind]
    maps = _sigma_maps(fits["opencv"], fit, views, size)
    fit = dc.replace(fit, lenses=tuple(dc.replace(lens, sigma_px=m.tolist()) for lens, m in zip(fit.lenses, maps)))
    for side, lens in zip(("left", "right"), fit.lenses):
        lens.check(side if len(fit.lenses) == 2 else "camera")
    stereo = fit.X_LR is not None
    return Calibration(
        fit=fit,
        other=fits[KINDS[1 - KINDS.index(fit.kind)]],
        better=better,
        views=tuple(views),
        split_half=_split_half(fit, views, kinds[fit.kind], size, least) if stereo else None,
        depth_sigma=_depth_sigma(fit, kinds[fit.kind], size) if stereo else {},
        pitch=_pitch(fit, views, board) if stereo and board else None,
        unknown=tuple(float((m > KNOWN).mean()) for m in maps),
    )


def _free(fit: Fit) -> list[int]:
    """The distortion terms that an OpenCV fit has."""
    own = {name.split(".")[-1] for name in fit.names}
    return [k for k, name in enumerate(_COEFFICIENTS) if name in own]


def _opencv_lenses(fit: Fit) -> list[OpenCvLens]:
    return [lens for lens in fit.lenses if isinstance(lens, OpenCvLens)]


def _folds(fit: Fit) -> bool:
    """Whether some lens of an OpenCV fit does not map its whole image one to one."""
    return any(reach < corner for reach, corner in (lens.radial_reach() for lens in _opencv_lenses(fit)))


def _determined(full: Fit, views: Sequence[View], sets: Sequence[Sequence[int]], size: tuple[int, int]) -> Fit:
    """The fit, of those with each set of terms, that explains the corners best for its number of parameters.

    Raises ConfigError if all lenses fold back inside the image.
    """
    values, names = parameters(full), list(full.names)
    sides = ("left.", "right.") if len(full.lenses) == 2 else ("",)

    def without(free: Sequence[int]) -> float:
        """The criterion of a fit with these terms only, predicted from `full` to first order without a new fit."""
        out = [side + _COEFFICIENTS[k] for side in sides for k in sets[0] if k not in free]
        at = [names.index(name) for name in out]
        value = np.array([values[name] for name in out])
        more = value @ np.linalg.pinv(full.covariance[np.ix_(at, at)], hermitian=True) @ value if at else 0.0
        return _criterion(full, more, len(names) - len(at))

    for free in sorted(sets, key=without):
        fit = full
        if len(free) < len(sets[0]):
            model = _OpenCvKind(free)
            lenses = tuple(np.array([values[side + name] for name in model.names]) for side in sides)
            fit = _solve(views, model, "opencv", _State(lenses, full.X_LR, full.poses), size)
        if not _folds(fit) and fit.rms < _WORSE * full.rms:
            return fit
    raise ConfigError(
        f"degenerate: the lens that fits the corners (rms {full.rms:.2f} px) folds back inside the image, none that "
        "does not fits them: show boards up to the image's corners, or is it a fisheye's?"
    )


def _refuse_fisheye(start: _Start, size: tuple[int, int]) -> None:
    """Raises ConfigError where a fisheye's model explains the corners of a camera much better than a pinhole's."""
    views = start.views
    for c, rms in enumerate(start.alone):
        if rms < _FISHEYE_RMS:
            continue
        bodies = sorted({view.body for view in views})
        groups = [[view for view in views if view.body == body] for body in bodies]
        points = [np.vstack([view.points for view in group]).reshape(-1, 1, 3) for group in groups]
        px = [np.vstack([view.px[c] for view in group]).reshape(-1, 1, 2) for group in groups]
        flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
        flags |= cv2.fisheye.CALIB_USE_INTRINSIC_GUESS
        try:
            other = cv2.fisheye.calibrate(points, px, size, start.lenses[c][0].copy(), np.zeros(4), flags=flags)[0]
        except cv2.error:  # no initial values were found
            continue
        if math.isfinite(other) and other < _FISHEYE * rms:
            raise ConfigError(
                f"the images are a fisheye's: its model leaves {other:.2f} px of the corners, a pinhole's with "
                f"distortion {rms:.2f} px; this program has no fisheye lens"
            )


def _sigma_maps(opencv: Fit, fit: Fit, views: Sequence[View], size: tuple[int, int]) -> list[np.ndarray]:
    """`sigma_px` of each lens of `fit`: the standard deviation of its mapping on a grid over the image (_MAP) [px].

    It is computed from the corners with all distortion terms free; those that `opencv` leaves out have the prior
    `_PRIOR`. A rotation of the whole camera is no error of its lens: the rotation that fits best at the corners is
    removed. If `fit` is another model than `opencv`, the difference of the two is added.
    """
    kind = _OpenCvKind(range(5))
    problem = _Problem(views, kind, size)
    lenses = _opencv_lenses(opencv)
    fitted = [np.concatenate([np.diag(lens.K)[:2], lens.K[:2, 2], lens.dist]) for lens in lenses]
    cost, H, _, residuals = problem(_State(tuple(fitted), opencv.X_LR, opencv.poses))
    corners = sum(len(r) for view in residuals for r in view)
    H = H / max(cost / max(2 * corners - len(H), 1), 1e-12)
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, _MAP[1]), np.linspace(0, size[1] - 1, _MAP[0]))
    grid = np.stack([u, v], -1).reshape(-1, 2)
    free = _free(opencv)
    for c, lens in enumerate(lenses):
        reach = np.linalg.norm(lens.normalize(np.array([[0.0, 0.0], size])), axis=1).max()
        for k in set(range(5)) - set(free):
            at = c * len(kind.names) + 4 + k
            H[at, at] += 1 / (_PRIOR[k] / reach ** _POWER[k]) ** 2
    scale = np.sqrt(np.diag(H)) + 1e-150
    inverse = np.linalg.pinv(H / np.outer(scale, scale), rcond=1e-15, hermitian=True) / np.outer(scale, scale)
    maps = []
    for c, (lens, chosen) in enumerate(zip(lenses, fit.lenses)):
        own = slice(c * len(kind.names), (c + 1) * len(kind.names))
        C = inverse[own, own]
        corner_px = np.vstack([view.px[c] for view in views])
        corner_px = corner_px[:: max(len(corner_px) // 500, 1)]
        J, turn, other = [], [], []
        for px in (corner_px, grid):
            xy = lens.normalize(px)
            _, D, by_lens = kind.project(lens, xy)
            rays = np.column_stack([xy, np.ones(len(xy))])
            J.append(by_lens)
            turn.append(D @ divided(xy, np.ones(len(xy))) @ -frames.skew(rays))
            other.append((chosen.project(xy) - px)[..., None])
        back = np.linalg.pinv(turn[0].reshape(-1, 3))
        J_left = J[1] - turn[1] @ (back @ J[0].reshape(-1, len(kind.names)))
        difference = other[1] - turn[1] @ (back @ other[0].reshape(-1, 1))
        variance = np.einsum("nij,jk,nik->n", J_left, C, J_left) + (difference**2).sum((1, 2))
        maps.append(np.round(np.sqrt(np.maximum(variance, 0)).reshape(_MAP), 3).clip(0, 1e5))
    return maps


def _start(views: Sequence[View], size: tuple[int, int], kind: _OpenCvKind, rigid: bool, board: Board | None) -> _Start:
    groups = [[view for view in views if view.body == b] for b in range(views[-1].body + 1)]
    points = [np.vstack([view.points for view in group]).astype(np.float32) for group in groups]
    flags = 0
    for k, name in ((0, "K1"), (1, "K2"), (4, "K3")):
        flags |= 0 if k in kind.free else getattr(cv2, f"CALIB_FIX_{name}")
    flags |= 0 if 2 in kind.free else cv2.CALIB_ZERO_TANGENT_DIST
    alone: list[_Alone] = []
    for c in range(len(views[0].px)):
        px = [np.vstack([view.px[c] for view in group]).astype(np.float32) for group in groups]
        # OpenCV needs an initial K for a target that is not flat: three focal lengths are tried, the best fit is kept.
        guesses = [f * size[0] for f in (0.7, 1.4, 2.8)] if rigid else [None]
        best: _Alone | None = None
        for guess in guesses:
            K, more = None, 0
            if guess is not None:
                K, more = np.array([[guess, 0, (size[0] - 1) / 2], [0, guess, (size[1] - 1) / 2], [0, 0, 1.0]]), 1
            try:
                rms, K, dist, rvecs, tvecs, *_ = cv2.calibrateCameraExtended(
                    points, px, size, K, np.zeros(5), flags=flags | (cv2.CALIB_USE_INTRINSIC_GUESS if more else 0)
                )
            except cv2.error:
                continue
            if np.isfinite(rms) and (best is None or rms < best.rms):
                poses = tuple(transform(rvec, tvec) for rvec, tvec in zip(rvecs, tvecs))
                best = _Alone(rms, K, dist.ravel(), poses)
        if best is None:
            raise ConfigError(f"degenerate: the boards do not determine a camera: {_TILT}")
        if not rigid:
            _refuse_frontal([X_CT[:, 2] for X_CT in best.poses])
        alone.append(best)
    lenses = [(camera.K, camera.dist) for camera in alone]
    each_rms = tuple(camera.rms for camera in alone)
    if len(alone) == 1:
        return _Start(tuple(views), lenses, None, alone[0].poses, each_rms, [])
    turns = board.turns() if board and not rigid else (0,)
    X_LR, chosen, off = _one_right_camera(alone[0].poses, alone[1].poses, turns)
    if board:
        views = [
            dc.replace(view, px=(view.px[0], board.turned(view.px[1], chosen[view.body])))
            if chosen[view.body]
            else view
            for view in views
        ]
    misfits = [view.names for view in views if off[view.body]]
    return _Start(tuple(views), lenses, X_LR, alone[0].poses, each_rms, misfits)


def _one_right_camera(
    X_LT: Sequence[np.ndarray], X_RT: Sequence[np.ndarray], turns: Sequence[int]
) -> tuple[np.ndarray, list[int], list[bool]]:
    """X_LR on which most pairs agree, the quarter turns by which each right board is renumbered, which pairs disagree.

    A board that looks the same after a turn may be numbered from another corner in the right image. Every numbering
    of every pair gives a candidate for X_LR; the candidate nearest to all pairs is chosen.
    """

    def distance(A: np.ndarray, B: np.ndarray, scale: float) -> float:
        turn = np.linalg.norm(frames.rotation_vector(A[:, :3].T @ B[:, :3]))
        return float(turn + np.linalg.norm(A[:, 3] - B[:, 3]) / scale)

    scale = float(np.median([np.linalg.norm(X[:, 3]) for X in X_LT]))
    candidates = []
    for left, right in zip(X_LT, X_RT):
        turned = [frames.compose(right, frames.make(frames.rot_z(k * math.pi / 2), np.zeros(3))) for k in turns]
        candidates.append([frames.compose(left, frames.inverse(X)) for X in turned])
    best: tuple[float, np.ndarray] | None = None
    for X in (X for of_pair in candidates for X in of_pair):
        nearest = [min(distance(X, other, scale) for other in of_pair) for of_pair in candidates]
        # If all boards lie alike, every numbering fits; prefer the one by which both cameras look the same way.
        cost = float(np.minimum(nearest, _APART).sum()) + 1e-3 * distance(np.eye(3, 4), X, scale)
        if best is None or cost < best[0]:
            best = cost, X
    assert best is not None  # there is a board in each view
    X_LR = best[1]
    off = [[distance(X_LR, other, scale) for other in of_pair] for of_pair in candidates]
    return X_LR, [turns[int(np.argmin(of_pair))] for of_pair in off], [min(of_pair) > _APART for of_pair in off]


def _refuse_frontal(normals: Sequence[np.ndarray]) -> None:
    """Raises ConfigError where all boards face the camera, or are parallel: normals (3,) in the camera."""
    n = np.array(normals)
    tilt = math.degrees(math.acos(float(np.clip(np.abs(n[:, 2]).min(), 0, 1))))
    between = math.degrees(math.acos(float(np.clip((n @ n.T).min(), -1, 1))))
    if min(tilt, between) < _MIN_TILT:
        how = "faces the camera" if tilt < _MIN_TILT else "lies the same way"
        raise ConfigError(
            f"degenerate: the board {how} in every image (within {min(tilt, between):.0f} deg), so that its "
            f"distance and the focal length cannot be told apart: {_TILT}"
        )


def _refuse_misfits(fit: Fit, start: _Start) -> None:
    """Raises ConfigError where each camera alone fits its corners, but the pairs do not fit one another."""
    alone = math.sqrt(np.mean(np.square(start.alone)))
    if fit.X_LR is None or fit.rms < 1 + _MISFIT * alone:
        return
    pairs = ", ".join(" with ".join(names) for names in start.misfits[:6])
    which = f"look at {pairs}" if 0 < len(start.misfits) <= len(start.views) / 2 else "no two of them agree"
    raise ConfigError(
        f"the pairs do not fit one another (rms {fit.rms:.1f} px, each camera alone {alone:.2f} px): {which}; "
        "are they images of one moment, left with left?"
    )


def _refuse_vague(fit: Fit, rigid: bool) -> None:
    """Raises ConfigError where the corners hardly determine the focal length."""
    sigma = fit.sigmas()
    focal = max(sigma[name] / value for name, value in parameters(fit).items() if name.split(".")[-1] in ("fx", "fy"))
    if not focal < _MAX_FOCAL_SIGMA:
        advice = "the distances must be those of the images, in their order" if rigid else _TILT
        raise ConfigError(f"degenerate: the focal length is known to {100 * focal:.0f} % only: {advice}")


def tilts(fit: Fit) -> list[float]:
    """Angle of each body's normal against the left camera's axis [rad]."""
    return [math.acos(float(np.clip(abs(X[2, 2]), 0, 1))) for X in fit.poses]


def _information(fit: Fit) -> float:
    """Schwarz's Bayesian criterion: smaller is better, for the residuals and the number of parameters together."""
    return _criterion(fit, 0.0, len(fit.names))


def _criterion(fit: Fit, more: float, parameters: int) -> float:
    """Schwarz's criterion if the sum of squares were larger than that of `fit`, by `more` times a corner's variance."""
    n = 2 * sum(len(r) for view in fit.residuals for r in view)
    return n * math.log(max(fit.rms, 1e-9) ** 2 * (1 + more / n)) + math.log(n) * parameters


def parameters(fit: Fit) -> dict[str, float]:
    """Value of each lens parameter, named as in `Fit.names`."""
    out: dict[str, float] = {}
    for side, lens in zip(("left.", "right.") if len(fit.lenses) == 2 else ("",), fit.lenses):
        if isinstance(lens, Lens):
            values = {name: getattr(lens, name) for name in _PaperKind.names}
        else:
            K = lens.K
            values = dict(zip(("fx", "fy", "cx", "cy"), (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))
            values |= {name: value for name, value in zip(_COEFFICIENTS, lens.dist)}
        out |= {side + name: float(value) for name, value in values.items()}
    return out


# ---------------------------------------------------------------- what matters: triangulated points


def _sights(fit: Fit, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Raw px in both cameras of nine points at `distance`, 0.1 of it apart, about the middle of what both look at.

    Points that a camera does not see are left out.
    """
    X_LR = fit.head().X_LR
    R, p = X_LR[:, :3], X_LR[:, 3]
    ahead = (np.array([0, 0, 1]) + R[:, 2]) / np.linalg.norm(np.array([0, 0, 1]) + R[:, 2])
    side, up = np.meshgrid([-0.1, 0, 0.1], [-0.1, 0, 0.1])
    P = p / 2 + distance * (ahead + np.stack([side, up, 0 * up], -1).reshape(-1, 3))
    visible, px = np.ones(len(P), bool), []
    for lens, Q in zip(fit.lenses, (P, (P - p) @ R)):
        xy = Q[:, :2] / Q[:, 2:]
        px.append(lens.project(xy))
        visible &= (Q[:, 2] > 0) & ((px[-1] >= 0) & (px[-1] <= [lens.width - 1, lens.height - 1])).all(1)
        # Outside the image a lens model may fold back: such points project into the image but are not seen there.
        visible &= np.linalg.norm(lens.normalize(px[-1]) - xy, axis=1) < 1e-3
    return px[0][visible], px[1][visible]


def _split_half(
    fit: Fit, views: Sequence[View], kind: _Kind, size: tuple[int, int], least: int
) -> dict[float, float] | None:
    """Rms difference of the distances triangulated by the calibrations from the odd and from the even views [m].

    Distances from the left camera, since a turn of both cameras together is no error of theirs.
    """
    heads = []
    for first in (0, 1):
        half = views[first::2]
        if len(half) < least:
            return None
        bodies = sorted({view.body for view in half})
        half = [dc.replace(view, body=bodies.index(view.body)) for view in half]
        state = _State(tuple(kind_parameters(fit)), fit.X_LR, tuple(fit.poses[b] for b in bodies))
        heads.append(_solve(half, kind, fit.kind, state, size).head())
    out = {}
    for distance in RANGES:
        px = _sights(fit, distance)
        if len(px[0]):
            far = [np.linalg.norm(triangulate_all(head, *px), axis=1) for head in heads]
            out[distance] = float(np.sqrt(((far[0] - far[1]) ** 2).mean()))
    return out


def kind_parameters(fit: Fit) -> list[np.ndarray]:
    """Parameter vectors of the fit's lenses, in the order of `Fit.names`."""
    values = parameters(fit)
    names = [name for name in fit.names if not name.startswith("X_LR")]
    return list(np.array([values[name] for name in names]).reshape(len(fit.lenses), -1))


def _depth_sigma(fit: Fit, kind: _Kind, size: tuple[int, int]) -> dict[float, float]:
    """Standard deviation of the depth of a point in the middle of the common view, by the covariance [m]."""
    problem = _Problem([View(("", ""), np.zeros((0, 3)), (np.zeros((0, 2)),) * 2, 0)], kind, size)
    state = _State(tuple(kind_parameters(fit)), fit.X_LR, (np.eye(3, 4),))
    sigma = np.sqrt(np.diag(fit.covariance))
    out = {}
    for distance in RANGES:
        px = _sights(fit, distance)
        if not len(px[0]):
            continue
        middle = [points[[len(points) // 2]] for points in px]
        J = []
        for k, s in enumerate(sigma):
            depth = []
            for sign in (-1e-3, 1e-3):
                step = np.zeros(problem.shared + 6)
                step[k] = sign * s
                there = problem.moved(state, step)
                left, right = (kind.lens(p, size) for p in there.lenses)
                assert there.X_LR is not None
                head = StereoHead(left, right, there.X_LR)
                depth.append(triangulate_all(head, *middle)[0, 2])
            J.append((depth[1] - depth[0]) / (2e-3 * s) if s > 0 else 0.0)
        out[distance] = float(np.sqrt(np.array(J) @ fit.covariance @ np.array(J)))
    return out


def _pitch(fit: Fit, views: Sequence[View], board: Board) -> tuple[float, float]:
    """Triangulated distances of neighbouring corners along x over the true pitch: mean and standard deviation."""
    head, ratios = fit.head(), []
    for view in views:
        grid = triangulate_all(head, *view.px).reshape(board.rows, board.columns, 3)
        ratios.append(np.linalg.norm(np.diff(grid, axis=1), axis=2).ravel() / board.pitch_x)
    return float(np.mean(ratios)), float(np.std(ratios))


def _rms(residuals: np.ndarray) -> float:
    return float(np.sqrt((residuals * residuals).sum(1).mean()))
