"""Whether poses belong to the images at all, and if not, which usual mistake explains it.

No arm scatters by several degrees, so poses that disagree with the boards by so much are refused. Usual mistakes are
tried before, so that the refusal can name one: the inverse, the other mount, transposed rotations, quaternions or Euler
angles in the other order, millimetres, the neighbour's image, exchanged poses.
"""

import dataclasses as dc
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np

from valve_drake import frames
from valve_drake.camera.hand_eye import (
    MIN_VIEWS,
    STANDS_OUT,
    HandEye,
    Seen,
    deviations,
    disagreement,
    majority,
    solve,
)
from valve_drake.checks import ConfigError

MAX_SCATTER_DEG, MAX_SCATTER_MM = 3.0, 50.0  # of the arm: more is no arm, the poses are wrong
LARGE_SCATTER_DEG, LARGE_SCATTER_MM = 1.0, 10.0  # more than most arms: worth a warning
_BETTER = 4.0  # a mistake explains the disagreement if undoing it makes it smaller by this factor
_FINE_DEG, _FINE_MM = 1.0, 10.0  # views that disagree by less are not suspected
_REACH = 5.0  # positions farther apart are taken for millimetres [m]
_FEWEST = 4  # least number of views with which mistakes are tried
_SHIFTS = (1, -1, 2, -2, 3, -3)  # by so many images the poses may be shifted


@dc.dataclass(frozen=True)
class Poses:
    """All poses that were given, also those of images without a board, in the natural order of the names."""

    names: tuple[str, ...]
    X_BE: np.ndarray  # (N, 3, 4)
    used: tuple[int, ...]  # index in X_BE of each view


def refuse_mistakes(seen: Seen, poses: Poses) -> None:
    """Raises ConfigError where a usual mistake explains that the views disagree."""
    size = disagreement(seen)
    if size[0] > _FINE_DEG or size[1] > _FINE_MM:
        mistake = _better(seen, poses, size) or _exchanged(seen, poses)
        if mistake:
            raise ConfigError(f"{_misfit_text(size)}, but fit {mistake}")


def refuse_scatter(result: HandEye, seen: Seen, poses: Poses) -> None:
    """Raises ConfigError where the views disagree by more than any arm scatters."""
    if result.arm_deg > MAX_SCATTER_DEG or result.arm_mm > MAX_SCATTER_MM:
        worst = [poses.names[poses.used[k]] for k in np.argsort(-result.rotation_deg, kind="stable")[:3]]
        raise ConfigError(
            f"{_misfit_text(disagreement(seen))}, more than any arm scatters, and no usual mistake explains it: does "
            f"each pose belong to its image, are board and pitch right? The most off: {', '.join(worst)}"
        )


def _misfit_text(size: np.ndarray) -> str:
    """The beginning of a refusal; size: of `disagreement` [deg, mm]."""
    return f"hand-eye: the poses do not fit the images (they disagree by {size[0]:.1f} deg, {size[1]:.0f} mm rms)"


def warnings(result: HandEye, names: Sequence[str]) -> list[str]:
    """What is doubtful about a result that was not refused; names of all views."""
    out = []
    for k in range(len(names)):
        if k not in result.used:
            out.append(
                f"{names[k]} is left out: its pose is {result.rotation_deg[k]:.1f} deg, {result.position_mm[k]:.0f} mm "
                f"off where the other views have it, {result.off[k]:.0f} standard deviations"
            )
    if result.arm_deg > LARGE_SCATTER_DEG or result.arm_mm > LARGE_SCATTER_MM:
        out.append(
            f"the arm scatters by {result.arm_deg:.2f} deg, {result.arm_mm:.1f} mm: more than most arms; were poses "
            "and images taken at the same moment, standing?"
        )
    return out


def _better(seen: Seen, poses: Poses, size: np.ndarray) -> str:
    """The mistake without which the views agree best, or "" if none makes a difference."""
    found: list[tuple[float, str]] = []
    for text, views in _hypotheses(seen, poses):
        if len(views) < max(_FEWEST, 0.7 * len(seen)):
            continue
        reach = float(np.ptp(views.arm[:, :, 3], axis=0).max())
        for factor, unit in ((1.0, ""), (1e-3, "millimetres"))[: 2 if reach > _REACH else 1]:
            arm = views.arm.copy()
            arm[:, :, 3] *= factor
            try:
                other = disagreement(dc.replace(views, arm=arm))
            except ConfigError:
                continue
            gain = (size * _freedom(seen) + 1e-9) / (other * _freedom(views) + 1e-9)
            fits = gain.max() > _BETTER and gain.min() > 0.8
            fits = fits and other[0] < 3 * MAX_SCATTER_DEG and other[1] < 3 * MAX_SCATTER_MM
            if fits and (text or unit):
                score = float(np.log(gain).sum())
                what = text.format(unit and f" and in {unit}") if text else "as millimetres: X_BE is in m"
                found.append((score, f"{gain.max():.0f} times better {what}"))
    return max(found, default=(0.0, ""))[1]


def _freedom(seen: Seen) -> float:
    """Factor by which residuals are too small because the same views made the fit: three views fit nearly anything."""
    return math.sqrt(len(seen) / (len(seen) - 2))


def _hypotheses(seen: Seen, poses: Poses) -> list[tuple[str, Seen]]:
    """What to say, and the views with the mistake undone. {} stands for a second mistake."""
    mount = (
        "the camera is not beside the robot (leave out --eye-to-hand)"
        if seen.to_hand
        else "the camera stands beside the robot (say --eye-to-hand)"
    )
    inverse = np.array([frames.inverse(X) for X in seen.arm])
    out: list[tuple[str, Seen]] = [
        ("", seen),
        ("inverted{}: either they are X_EB instead of X_BE, or " + mount, dc.replace(seen, arm=inverse)),
        ("with the rotations transposed{}: X_BE holds the axes of E in its columns", _turned(seen, lambda R: R.T)),
    ]
    for text, order in (("wxyz read as xyzw", (3, 0, 1, 2)), ("xyzw read as wxyz", (1, 2, 3, 0))):
        again = _turned(seen, functools.partial(_reordered, order=order))
        out.append((f"with the quaternions in the other order{{}} (they look like {text})", again))
    for axes in ("xyz", "zyx"):
        again = _turned(seen, functools.partial(_euler, axes=axes))
        out.append((f"with the Euler angles applied in the other order{{}} (about {axes}, fixed or moving)", again))
    place, n = np.array(poses.used), len(poses.X_BE)
    for shift in _SHIFTS:
        ok = (place + shift >= 0) & (place + shift < n)
        moved = dc.replace(seen.only(np.flatnonzero(ok).tolist()), arm=poses.X_BE[place[ok] + shift])
        which = "the next one" if shift == 1 else "the previous one" if shift == -1 else f"the one at {shift:+d}"
        out.append((f"when each image takes the pose of {which}{{}}: names and poses are shifted", moved))
    out.append(("in the reverse order of the images{}", dc.replace(seen, arm=poses.X_BE[n - 1 - place])))
    return out


def _exchanged(seen: Seen, poses: Poses) -> str:
    """Views that fit another image's pose, or "": found where most views agree without them."""
    used = majority(seen)
    others = [k for k in range(len(seen)) if k not in used]
    if len(others) < 2 or len(used) < max(MIN_VIEWS, len(seen) / 2):
        return ""
    fit = solve(seen.only(used))
    if fit.variances[0] > math.radians(MAX_SCATTER_DEG) ** 2 or fit.variances[1] > (MAX_SCATTER_MM / 1e3) ** 2:
        return ""
    pairs = []
    for k in others:
        given = len(poses.X_BE)
        tried = dc.replace(seen.only([k] * given), arm=poses.X_BE)
        off = deviations(fit, tried)
        best = int(np.argmin(off))
        if off[best] < STANDS_OUT and best != poses.used[k]:
            pairs.append((poses.names[poses.used[k]], poses.names[best]))
    if len(pairs) < max(2, len(others) / 2):
        return ""
    shown = ", ".join(f"{image} takes the pose of {pose}" for image, pose in pairs[:6])
    return f"well when {shown}{' ...' if len(pairs) > 6 else ''}: exchange them"


# ---------------------------------------------------------------- rotations as people get them wrong


def _turned(seen: Seen, change: Callable[[np.ndarray], np.ndarray]) -> Seen:
    arm = seen.arm.copy()
    arm[:, :, :3] = [change(R) for R in seen.arm[:, :, :3]]
    return dc.replace(seen, arm=arm)


def _reordered(R: np.ndarray, order: tuple[int, ...]) -> np.ndarray:
    """R by its quaternion (w, x, y, z) with the numbers in another order."""
    w = frames.rotation_vector(R)
    angle = float(np.linalg.norm(w))
    axis = w / angle if angle > 0 else w
    q = np.array([math.cos(angle / 2), *(math.sin(angle / 2) * axis)])[list(order)]
    norm = float(np.linalg.norm(q[1:]))
    turn = 2 * math.atan2(norm, q[0])
    return frames.rotation(q[1:] * (turn / norm) if norm > 0 else np.zeros(3))


def _euler(R: np.ndarray, axes: str) -> np.ndarray:
    """R = A(a) B(b) C(c) about `axes`, as C(c) B(b) A(a)."""
    i, j, k = ("xyz".index(axis) for axis in axes)
    sign = 1.0 if axes == "xyz" else -1.0
    b = math.asin(float(np.clip(sign * R[i, k], -1, 1)))
    a = math.atan2(-sign * R[j, k], R[k, k])
    c = math.atan2(-sign * R[i, j], R[i, i])
    about = (frames.rot_x, frames.rot_y, frames.rot_z)
    out: np.ndarray = about[k](c) @ about[j](b) @ about[i](a)
    return out
