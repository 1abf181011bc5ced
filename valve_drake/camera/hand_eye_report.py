"""From a folder of images and the arm's poses to a hand-eye calibration, and what it reports."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake import frames, outputs
from valve_drake.camera import hand_eye as solver
from valve_drake.camera import hand_eye_mistakes as mistakes
from valve_drake.camera import hand_eye_page
from valve_drake.camera.board import Board, find_images, natural
from valve_drake.camera.calibration_file import load_calibration, save_camera
from valve_drake.camera.calibration_report import Report, calibrated, look, named, some
from valve_drake.camera.hand_eye_poses import read_poses
from valve_drake.camera.lens import StereoHead
from valve_drake.checks import ConfigError

_SYMMETRIC = "the board looks the same turned by half a turn: take one with an odd and an even number of corners"
_VAGUE_MM, _VAGUE_DEG = 20.0, 2.0  # a standard deviation above which a result is hardly one


def hand_eye(
    images: Sequence[str],
    poses: Path,
    board: Board,
    out: Path,
    camera: Path | None = None,
    to_hand: bool = False,
) -> Report:
    """The camera on the hand (X_EC), or beside the robot (X_BC), from images and hand poses paired by name.

    Writes `out`. Raises ConfigError, and writes nothing, for poses that do not belong to the images.
    """
    X_BE = read_poses(poses)
    of_name: dict[str, Path] = {}
    for path in find_images(images, "--images"):
        if (other := of_name.setdefault(path.name, path)) != path:
            raise ConfigError(f"--images must be of different names, by which they get their poses: {other} and {path}")
    pictures = look(board, (images,), ("--images",))
    lens = load_calibration([camera]) if camera else calibrated(pictures, board, "opencv", None).fit.lenses[0]
    if isinstance(lens, StereoHead):
        raise ConfigError(f"--camera {camera}: a stereo head, need one camera")
    if (lens.width, lens.height) != pictures.size:
        (w, h), (width, height) = pictures.size, (lens.width, lens.height)
        raise ConfigError(f"--camera {camera}: for {width} x {height}, but the images are {w} x {h}")
    found = {paths[0].name: px[0] for paths, px in zip(pictures.paths, pictures.corners)}
    names = [name for name, px in found.items() if name in X_BE and px is not None]
    if not names:
        one = next(iter(found))
        raise ConfigError(f"--poses {poses}: no pose belongs to an image with the board in it, such as {one}")
    corners = [px for name, px in found.items() if name in names and px is not None]
    seen = solver.observe(lens, board.points(), corners, [X_BE[name] for name in names], to_hand)
    every = tuple(sorted(X_BE, key=natural))
    given = mistakes.Poses(every, np.array([X_BE[name] for name in every]), tuple(every.index(name) for name in names))
    try:
        mistakes.refuse_mistakes(seen, given)
        result = solver.from_seen(seen, lens, board.points(), corners)
        mistakes.refuse_scatter(result, seen, given)
    except ConfigError as error:
        raise ConfigError(f"{error}; {_SYMMETRIC}" if board.symmetric() else str(error)) from error
    notes = mistakes.warnings(result, names) + _warnings(result, board)
    missing = {
        "no board in": [name for name, px in found.items() if px is None],
        "no pose for": [name for name in found if name not in X_BE],
        "no image for the pose of": [name for name in every if name not in found],
    }
    notes += [f"{what} {some(which)}" for what, which in missing.items() if which]
    key = "X_BC" if to_hand else "X_EC"
    X = np.vstack([result.X, [0, 0, 0, 1]])
    where = "the base" if to_hand else "the hand"
    numbers = _numbers(result, names, to_hand, out)
    numbers |= {"not_used": sorted({name for which in missing.values() for name in which}), "warnings": notes}
    report = Report(outputs.finite(numbers), hand_eye_page.page(numbers, corners, pictures.size), _text(numbers))
    save_camera(lens, out, f"{key}: the camera in {where} (rows of [R | p; 0 0 0 1], m)", **{key: X})
    return report


def _numbers(result: solver.HandEye, names: Sequence[str], to_hand: bool, out: Path) -> dict[str, Any]:
    X, used = np.vstack([result.X, [0, 0, 0, 1]]), list(result.used)
    return {
        "command": "hand-eye",
        "out": str(out),
        "eye_to_hand": to_hand,
        "rms_px": result.rms,
        "X_EC": X.tolist(),  # the camera in what carries it
        **({"X_BC": X.tolist()} if to_hand else {}),
        ("X_ET" if to_hand else "X_BT"): np.vstack([result.X_target, [0, 0, 0, 1]]).tolist(),
        "residual_deg": _rms(result.rotation_deg[used]),
        "residual_mm": _rms(result.position_mm[used]),
        "left_out_deg": _rms(result.left_out_deg[used]),
        "left_out_mm": _rms(result.left_out_mm[used]),
        "noise": {"arm_deg": result.arm_deg, "arm_mm": result.arm_mm, "corner_px": result.corner_px},
        "parameters": named(frames.rotation_vector(result.X[:, :3]), result.X[:, 3]),
        "standard_deviations": named(np.radians(result.sigma_deg), result.sigma_mm / 1e3),
        "X_EC_sigma": {"rotation_deg": result.sigma_deg.tolist(), "position_mm": result.sigma_mm.tolist()},
        "covariance": result.covariance.tolist(),  # turn about the camera's axes [rad], position [m]
        "methods": {
            name: {
                "apart_deg": one.apart_deg,
                "apart_mm": one.apart_mm,
                "left_out_deg": one.left_out_deg,
                "left_out_mm": one.left_out_mm,
            }
            for name, one in result.methods.items()
        },
        "per_view": [
            {
                "image": name,
                "rms_px": float(result.view_rms[k]),
                "residual_deg": float(result.rotation_deg[k]),
                "residual_mm": float(result.position_mm[k]),
                "left_out_deg": float(result.left_out_deg[k]),
                "left_out_mm": float(result.left_out_mm[k]),
                "deviations": float(result.off[k]),
                "outlier": k not in used,
            }
            for k, name in enumerate(names)
        ],
    }


def _text(n: dict[str, Any]) -> list[str]:
    noise, spread = n["noise"], n["standard_deviations"]
    used = sum(not view["outlier"] for view in n["per_view"])
    out = [f"{n['out']}: {used} views, the board is {n['residual_deg']:.3f} deg, {n['residual_mm']:.2f} mm off (rms)"]
    out.append(
        f"noise: the arm {noise['arm_deg']:.3f} deg, {noise['arm_mm']:.2f} mm about each axis, "
        f"the corners {noise['corner_px']:.3f} px"
    )
    out += [f"  {name:<8} {value:10.6f} +- {spread[name]:.2g}" for name, value in n["parameters"].items()]
    if math.isfinite(n["left_out_deg"]):
        out.append(
            f"a view left out is foretold within {n['left_out_deg']:.3f} deg, {n['left_out_mm']:.2f} mm (rms); by"
        )
        out += [
            f"  {name:<11} {m['left_out_deg']:.3f} deg, {m['left_out_mm']:.2f} mm; "
            f"its result is {m['apart_deg']:.3f} deg, {m['apart_mm']:.2f} mm from this one"
            for name, m in n["methods"].items()
        ]
    return out


def _warnings(result: solver.HandEye, board: Board) -> list[str]:
    out = [_SYMMETRIC] if board.symmetric() else []
    if result.sigma_mm.max() > _VAGUE_MM or result.sigma_deg.max() > _VAGUE_DEG:
        out.append(
            f"the camera is known within {result.sigma_deg.max():.1f} deg, {result.sigma_mm.max():.0f} mm only: "
            "more views, turned by 30 deg or more about two axes"
        )
    return out


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
