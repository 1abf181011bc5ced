"""From a folder of images and the arm's poses to a hand-eye calibration, and what it reports."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from valve_drake import frames
from valve_drake.camera import hand_eye as solver
from valve_drake.camera import hand_eye_page
from valve_drake.camera.board import Board
from valve_drake.camera.calibration_file import load_calibration, save_camera
from valve_drake.camera.calibration_report import Report, calibrated, finite, look, named
from valve_drake.camera.lens import StereoHead
from valve_drake.checks import ConfigError, require


def hand_eye(
    images: Sequence[str], poses: Path, board: Board, out: Path, camera: Path | None = None, to_hand: bool = False
) -> Report:
    """The camera on the hand (X_EC), or beside the robot (X_BC), from images and hand poses paired by name."""
    X_BE = _read_poses(poses)
    pictures = look(board, (images,), ("--images",))
    lens = load_calibration([camera]) if camera else calibrated(pictures, board, "opencv", None).fit.lenses[0]
    if isinstance(lens, StereoHead):
        raise ConfigError(f"--camera {camera}: a stereo head, need one camera")
    if (lens.width, lens.height) != pictures.size:
        (w, h), (width, height) = pictures.size, (lens.width, lens.height)
        raise ConfigError(f"--camera {camera}: for {width} x {height}, but the images are {w} x {h}")
    names = [paths[0].name for paths in pictures.paths]
    used = [k for k, name in enumerate(names) if name in X_BE and pictures.corners[k][0] is not None]
    if not used:
        raise ConfigError(f"--poses {poses}: no pose belongs to an image with the board in it, such as {names[0]}")
    corners = [pictures.corners[k][0] for k in used]
    result = solver.hand_eye(lens, board.points(), corners, [X_BE[names[k]] for k in used], to_hand)
    key = "X_BC" if to_hand else "X_EC"
    X = np.vstack([result.X, [0, 0, 0, 1]])
    where = "the base" if to_hand else "the hand"
    save_camera(lens, out, f"{key}: the camera in {where} (rows of [R | p; 0 0 0 1], m)", **{key: X})
    numbers = {
        "command": "hand-eye",
        "out": str(out),
        "eye_to_hand": to_hand,
        "rms_px": result.rms,
        "X_EC": X.tolist(),  # the camera in what carries it
        **({"X_BC": X.tolist()} if to_hand else {}),
        ("X_ET" if to_hand else "X_BT"): np.vstack([result.X_target, [0, 0, 0, 1]]).tolist(),
        "residual_deg": _rms(result.rotation_deg),
        "residual_mm": _rms(result.position_mm),
        "left_out_deg": _rms(result.left_out_deg),
        "left_out_mm": _rms(result.left_out_mm),
        "parameters": named(frames.rotation_vector(result.X[:, :3]), result.X[:, 3]),
        "standard_deviations": named(np.radians(result.sigma_deg), result.sigma_mm / 1e3),
        "X_EC_sigma": {"rotation_deg": result.sigma_deg.tolist(), "position_mm": result.sigma_mm.tolist()},
        "per_view": [
            {
                "image": names[k],
                "rms_px": float(result.view_rms[i]),
                "residual_deg": float(result.rotation_deg[i]),
                "residual_mm": float(result.position_mm[i]),
                "left_out_deg": float(result.left_out_deg[i]),
                "left_out_mm": float(result.left_out_mm[i]),
            }
            for i, k in enumerate(used)
        ],
        "not_used": [name for k, name in enumerate(names) if k not in used] + sorted(set(X_BE) - set(names)),
        "warnings": _warnings(board),
    }
    text = [
        f"{out}: {len(used)} views, rms {result.rms:.3f} px",
        f"the views disagree by {numbers['residual_deg']:.3f} deg, {numbers['residual_mm']:.2f} mm rms",
    ]
    return Report(finite(numbers), hand_eye_page.page(numbers, corners, pictures.size), text)


def _read_poses(path: Path) -> dict[str, np.ndarray]:
    """Image name -> X_BE (3, 4) from a list of {"image": name, "X_BE": 4x4}."""
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"--poses {path}: cannot be read ({type(error).__name__})") from error
    except ValueError as error:
        raise ConfigError(f"--poses {path}: not JSON") from error
    require(isinstance(rows, list) and len(rows) > 0, f"--poses {path}", "a list of {image, X_BE}", type(rows).__name__)
    out: dict[str, np.ndarray] = {}
    for k, row in enumerate(rows):
        key = f"--poses {path}[{k}]"
        require(isinstance(row, dict) and {"image", "X_BE"} <= set(row), key, "{image, X_BE}", row)
        name = Path(str(row["image"])).name
        try:
            X = np.array(row["X_BE"], float)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{key}.X_BE must be 4 rows of 4 numbers") from error
        ok = X.shape == (4, 4) and np.isfinite(X).all() and np.abs(X[3] - [0, 0, 0, 1]).max() < 1e-6
        ok = ok and np.abs(X[:3, :3] @ X[:3, :3].T - np.eye(3)).max() < 1e-3 and np.linalg.det(X[:3, :3]) > 0
        require(bool(ok), f"{key}.X_BE", "a 4x4 rigid transform [m]", row["X_BE"])
        require(name not in out, f"{key}.image", "named once", name)
        U, _, Vt = np.linalg.svd(X[:3, :3])  # a few printed digits are no exact rotation
        out[name] = frames.make(U @ Vt, X[:3, 3])
    return out


def _warnings(board: Board) -> list[str]:
    if board.symmetric():
        return ["the board looks the same turned by half a turn: take one with an odd and an even number of corners"]
    return []


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
