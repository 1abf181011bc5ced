"""What a rectangle leaves open: the mirrored tilt, which of its axes is X, and which end of X is which.

A small rectangle seen from afar looks nearly the same at a tilt and at its mirror image about the line of sight. Both
minima are found (`candidates`), and the one that fits better, or that the track prefers, comes first. Which side is
which is settled last (`settle_axis`): green marks, else sizes, else the track, else n_x > 0.
If the marks turn about another axis than the marker does, they count wherever they are on their circles.
"""

import dataclasses as dc
import math

import cv2
import numpy as np

from valve_drake import frames
from valve_drake.perception.mark_angle import mark_angle
from valve_drake.perception.marker import NEXT, Marker
from valve_drake.perception.moments import Moments
from valve_drake.perception.paper import closed_form
from valve_drake.perception.quadrilateral import COUNTED_FROM
from valve_drake.perception.rectangle_config import RectangleEstimatorConfig
from valve_drake.perception.refinement import Fit, linearize, refine
from valve_drake.perception.views import View

_PRUNE_CHI2 = 1000.0  # beside a fit of a smaller chi^2, a start that is so much worse is not refined
_TURNS = [frames.rot_z(-k * np.pi / 2) for k in range(4)]
_QUARTER = frames.rot_z(-np.pi / 2)  # the image's corner 0 is the model's corner 1: V turns back against the image
HALF_TURN = np.diag([-1.0, -1.0, 1.0])


@dc.dataclass(frozen=True)
class Track:
    """What is known from earlier: where the marker should be now."""

    X_LV: np.ndarray  # (3, 4) predicted
    axis_known: bool = False  # its X axis was settled by marks or sizes
    angle: float = 0.0  # of a marker on the panel: how far the valve was turned [rad]


def candidates(
    views: list[View], moments: Moments, marker: Marker, config: RectangleEstimatorConfig
) -> tuple[list[Fit], int]:
    """The distinct minima, best first: from both poses of IPPE, else the closed form; then the mirrored tilt.

    And the model's corner that the image's first one is taken for: 0, or 1 where the green marks say so.
    """
    view, model, turn = views[0], marker.corners(), 0
    starts = []
    # V's z points away from the camera: with z towards it IPPE's answers are wrong.
    ok, rvecs, tvecs, _ = cv2.solvePnPGeneric(
        model, view.corners[:, None, :], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
    )
    for rvec, tvec in zip(rvecs, tvecs) if ok else ():
        starts.append(_to_left(view, cv2.Rodrigues(rvec)[0], tvec.ravel()))
    if any(_along_y(_mark_votes(views, R, p, marker)) for R, p in starts):
        starts, model, turn = [(R @ _QUARTER, p) for R, p in starts], model[NEXT], 1
    fits, pruned = _distinct(moments, model, starts, config, [])
    if not fits:
        closed = closed_form([v.corners for v in views], [v.X_CL for v in views], model, "exact")
        fits, pruned = _distinct(moments, model, [closed] if closed is not None else [], config, [])
    return _with_the_other(moments, model, fits, pruned, config), turn


def _with_the_other(
    moments: Moments,
    model: np.ndarray,
    fits: list[Fit],
    pruned: list[tuple[float, np.ndarray]],
    config: RectangleEstimatorConfig,
) -> list[Fit]:
    """The fits, and where it is only one, that of the mirrored tilt, or of what was left out. See `_distinct`."""
    if len(fits) == 1 and not pruned:
        mirrored = _mirrored(fits[0].R, fits[0].p)
        fits, pruned = _distinct(moments, model, [mirrored], config, fits)
        if len(fits) == 1 and not pruned:
            pruned = [(_moved_to_fit(moments, model, *mirrored), mirrored[0])]
    if len(fits) == 1 and math.isfinite(pruned[0][0]):
        # If the mirrored tilt has no minimum of its own, its best translation is the alternative.
        cost, R = pruned[0]
        fits.append(dc.replace(fits[0], R=R, cost=max(cost, fits[0].cost), gradient=None))
    return fits


def _distinct(
    moments: Moments,
    model: np.ndarray,
    starts: list[tuple[np.ndarray, np.ndarray]],
    config: RectangleEstimatorConfig,
    known: list[Fit],
) -> tuple[list[Fit], list[tuple[float, np.ndarray]]]:
    """`known` and the fits from `starts` that end elsewhere, best first; and chi^2 and R of those before the cameras
    that were so much worse than a known one that they were left."""
    fits, pruned = list(known), []
    for R, p in starts:
        if not (np.isfinite(R).all() and np.isfinite(p).all()):
            continue
        if fits:
            cost = _moved_to_fit(moments, model, R, p)
            # A worse fit explains the sides as little as the start does, and may be a minimum that leads nowhere.
            if fits[0].cost < _PRUNE_CHI2 < cost - fits[0].cost:
                if math.isfinite(cost):
                    pruned.append((cost, R))
                continue
        fit = refine(moments, model, R, p, 0.0, config, enough=0.05)
        if fit is not None and fit.R[2, 2] > 0 and _is_new(fit, fits):
            fits.append(fit)
    return sorted(fits, key=lambda fit: fit.cost), pruned


def _is_new(fit: Fit, fits: list[Fit]) -> bool:
    return not any(np.linalg.norm(frames.rotation_vector(fit.R.T @ other.R)) < 1e-3 for other in fits)


def _moved_to_fit(moments: Moments, model: np.ndarray, R: np.ndarray, p: np.ndarray) -> float:
    """chi^2 of this orientation at the position that suits it best; infinite behind a camera."""
    at = linearize(moments, model, R, p, 0.0)
    if at is None:
        return math.inf
    J, r = at[1][:, 3:6], at[0]
    g = J.T @ r
    return float(r @ r - g @ cv2.solve(J.T @ J, g, flags=cv2.DECOMP_CHOLESKY)[1][:, 0])


def _to_left(view: View, R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    X = frames.compose(frames.inverse(view.X_CL), frames.make(R, p))
    return X[:, :3], X[:, 3]


def _mirrored(R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same marker with its tilt against the line of sight mirrored."""
    d = p / np.linalg.norm(p)
    axis = frames.cross(R[:, 2], d)
    angle = math.atan2(float(np.linalg.norm(axis)), float(R[:, 2] @ d))
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    return frames.rotation(2 * angle * axis) @ R, p


def settle_axis(
    views: list[View],
    moments: Moments,
    fits: list[Fit],
    turn: int,
    marker: Marker,
    config: RectangleEstimatorConfig,
    track: Track | None,
) -> tuple[int, bool, list[Fit]]:
    """How many corners the image's first one lies ahead of the model's (0..3), whether that is sure, the fits so.

    turn: what the fits take it for.
    """
    swapped, known = None, True
    model = marker.corners()[COUNTED_FROM[turn + 1]]
    votes = _mark_votes(views, fits[0].R, fits[0].p, marker)
    if marker.X_VA is not None and track is not None and track.axis_known:
        votes = [0, 0, 0, 0]  # it stands still: hands before the marks cannot tell otherwise
    if votes[0] + votes[2] != votes[1] + votes[3]:
        quarter = int(_along_y(votes))
    elif marker.aspect() > 1 + config.square_tolerance:
        swapped = _quarter_turned(moments, model, fits, config)
        quarter = int(bool(swapped) and swapped[0].cost < fits[0].cost)
    else:
        angles = fits[0].R.T @ track.X_LV[:, 0] if track is not None else fits[0].R[0]
        quarter = int(abs(angles[1]) > abs(angles[0]))
        known = track is not None and track.axis_known
    if quarter:
        fits = swapped or _quarter_turned(moments, model, fits, config) or fits
    ends = votes[quarter] - votes[quarter + 2]  # the marks of most valves look the same from both ends
    n = fits[0].R[:, 0]
    ahead = float(ends) if ends else n @ track.X_LV[:, 0] if track is not None else n[0]
    if ahead < 0:
        fits = [_half_turned(fit) for fit in fits]
    return (turn + quarter + 2 * int(ahead < 0)) % 4, known, fits


def _along_y(votes: list[int]) -> bool:
    return votes[1] + votes[3] > votes[0] + votes[2]


def _mark_votes(views: list[View], R: np.ndarray, p: np.ndarray, marker: Marker) -> list[int]:
    """Green marks found where they should be if V were this pose turned back by 0, 1, 2, 3 quarters -> 4."""
    if marker.X_VA is not None:
        found = [mark_angle(views, R @ turn, p, marker) for turn in _TURNS]
        return [0 if one is None else one.marks for one in found]
    places = np.vstack([*(marker.marks @ turn.T for turn in _TURNS), np.zeros((1, 3))])
    votes = np.zeros(4, int)
    for view in views:
        P = (places @ R.T + p) @ view.X_CL[:, :3].T + view.X_CL[:, 3]
        if len(view.green) == 0 or not (P[:, 2] > 1e-3).all():
            continue
        xy = P[:, :2] / P[:, 2:]
        off, far = view.green[None] - xy[:-1, None], xy[:-1] - xy[-1]
        found = (off * off).sum(2).min(1) < 0.04 * (far * far).sum(1)
        votes += found.reshape(4, -1).sum(1)
    return [int(vote) for vote in votes]


def _quarter_turned(
    moments: Moments, model: np.ndarray, fits: list[Fit], config: RectangleEstimatorConfig
) -> list[Fit]:
    """The fits with the image's first corner one further along, which `model` begins with."""
    turned: list[Fit] = []
    for fit in fits[:2]:
        one = refine(moments, model, fit.R @ _QUARTER, fit.p, fit.yaw, config)
        if one is not None and _is_new(one, turned):
            turned.append(one)
    # By the other side's length the tilts were wrong, and may both have led here to the same one.
    return _with_the_other(moments, model, sorted(turned, key=lambda fit: fit.cost), [], config)


def _half_turned(fit: Fit) -> Fit:
    sign = np.ones(len(fit.information))
    sign[:2] = -1  # theta is in V
    gradient = None if fit.gradient is None else fit.gradient * sign
    information = fit.information * np.outer(sign, sign)
    return dc.replace(fit, R=fit.R @ HALF_TURN, information=information, gradient=gradient)
