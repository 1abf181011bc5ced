"""From folders of images to calibrations: the three commands, what they report as JSON, and as one HTML page."""

import dataclasses as dc
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake import frames
from valve_drake.camera import calibration as cal
from valve_drake.camera import calibration_page as pages
from valve_drake.camera.board import Board, find_corners, find_images, read_images
from valve_drake.camera.calibration_file import load_calibration, save_camera
from valve_drake.camera.lens import StereoHead, save_head
from valve_drake.checks import ConfigError, require


@dc.dataclass(frozen=True)
class Report:
    """What a calibration has to say: numbers for programs, a page for people."""

    numbers: dict[str, Any]
    page: str

    def lines(self) -> list[str]:
        """The most important of it for a terminal."""
        n = self.numbers
        out = [f"{n['out']}: {len(n['per_view'])} views, rms {n['rms_px']:.3f} px"]
        if n["command"] == "hand-eye":
            out.append(f"the views disagree by {n['residual_deg']:.3f} deg, {n['residual_mm']:.2f} mm rms")
        else:
            sigmas = n["standard_deviations"]
            out += [f"  {name:<13} {value:12.6g} +- {sigmas[name]:.2g}" for name, value in n["parameters"].items()]
            lenses = ", ".join(f"{k} lens {v['rms_px']:.3f} px" for k, v in n["lenses"].items())
            out.append(f"{lenses}; better: {n['better_lens']}")
        if n["command"] == "stereo":
            out.append(f"baseline {n['baseline_mm']:.2f} mm")
            half = n["split_half_mm"] or {}
            out += [f"split-half difference at {z} m: {mm:.1f} mm" for z, mm in half.items()]
        return out + [f"note: {text}" for text in n["warnings"]]


@dc.dataclass(frozen=True)
class _Pictures:
    paths: list[tuple[Path, ...]]
    corners: list[tuple[np.ndarray | None, ...]]
    size: tuple[int, int]

    def missed(self) -> list[str]:
        return [p.name for paths, px in zip(self.paths, self.corners) for p, one in zip(paths, px) if one is None]


def intrinsics(
    images: Sequence[str], board: Board, out: Path, kind: str = "opencv", distances: Sequence[float] | None = None
) -> Report:
    """One camera from the images of a glob; distances [m] make the boards one rigid target. Writes `out`."""
    pictures = _look(board, (images,), ("--images",), distances)
    result = _calibrate(pictures, board, kind, distances)
    save_camera(result.fit.lenses[0], out, _comment(result))
    return _report("intrinsics", result, pictures, board, out)


def stereo(
    left: Sequence[str],
    right: Sequence[str],
    board: Board,
    out: Path,
    kind: str = "opencv",
    distances: Sequence[float] | None = None,
) -> Report:
    """The stereo head from two globs, paired by the natural order of the names. Writes `out`."""
    pictures = _look(board, (left, right), ("--left", "--right"), distances)
    result = _calibrate(pictures, board, kind, distances)
    save_head(result.fit.head(), out, _comment(result))
    return _report("stereo", result, pictures, board, out)


def hand_eye(
    images: Sequence[str], poses: Path, board: Board, out: Path, camera: Path | None = None, to_hand: bool = False
) -> Report:
    """The camera on the hand (X_EC), or beside the robot (X_BC), from images and hand poses paired by name."""
    X_BE = _read_poses(poses)
    pictures = _look(board, (images,), ("--images",))
    lens = load_calibration([camera]) if camera else _calibrate(pictures, board, "opencv", None).fit.lenses[0]
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
    result = cal.hand_eye(lens, board.points(), corners, [X_BE[names[k]] for k in used], to_hand)
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
        "parameters": _named(frames.rotation_vector(result.X[:, :3]), result.X[:, 3]),
        "standard_deviations": _named(np.radians(result.sigma_deg), result.sigma_mm / 1e3),
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
        "warnings": _board_warnings(board, hand=True),
    }
    return Report(_finite(numbers), pages.hand_eye(numbers, corners, pictures.size))


# ---------------------------------------------------------------- reading


def _look(
    board: Board, patterns: Sequence[Sequence[str]], keys: Sequence[str], distances: Sequence[float] | None = None
) -> _Pictures:
    paths = [find_images(pattern, key) for pattern, key in zip(patterns, keys)]
    if len(paths) == 2 and len(paths[0]) != len(paths[1]):
        raise ConfigError(f"{keys[0]} has {len(paths[0])} images, {keys[1]} {len(paths[1])}: they must pair up")
    if distances is not None:
        wanted = f"{len(paths[0])} numbers, one for each image"
        require(len(distances) == len(paths[0]), "--distances", wanted, len(distances))
        require(len(set(distances)) > 1, "--distances", "different from one another", list(distances))
    images = [read_images(one) for one in paths]
    for one, key in zip(images[1:], keys[1:]):
        if one[0].shape != images[0][0].shape:
            raise ConfigError(f"{key}: images of {one[0].shape[1]} x {one[0].shape[0]}, unlike those of {keys[0]}")
    corners = [tuple(find_corners(image, board) for image in pair) for pair in zip(*images)]
    if not any(all(px is not None for px in pair) for pair in corners):
        raise ConfigError(f"no board of {board.columns} x {board.rows} inner corners in any of {len(corners)} image(s)")
    return _Pictures(list(zip(*paths)), corners, images[0][0].shape[::-1])


def _calibrate(pictures: _Pictures, board: Board, kind: str, distances: Sequence[float] | None) -> cal.Calibration:
    names = [tuple(path.name for path in paths) for paths in pictures.paths]
    return cal.calibrate(cal.board_views(board, names, pictures.corners, distances), pictures.size, kind, board)


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


# ---------------------------------------------------------------- numbers


def _report(command: str, result: cal.Calibration, pictures: _Pictures, board: Board, out: Path) -> Report:
    fit, both = result.fit, len(result.fit.lenses) == 2
    values, sigmas, outliers = cal.parameters(fit), fit.sigmas(), fit.outliers()
    if both:
        pose = _named(frames.rotation_vector(fit.X_LR[:, :3]), fit.X_LR[:, 3])
        values |= {f"X_LR.{name}": value for name, value in pose.items()}
    rms = fit.view_rms()
    tilts = np.degrees(cal.tilts(fit))
    per_view = []
    for k, (view, residuals) in enumerate(zip(result.views, fit.residuals)):
        row: dict[str, Any] = dict(zip(("left", "right") if both else ("image",), view.names))
        row |= {"rms_px": float(np.sqrt((rms[k] ** 2).mean())), "outlier": k in outliers}
        if both:
            row |= {"left_rms_px": float(rms[k, 0]), "right_rms_px": float(rms[k, 1])}
        row["max_px"] = max(float(np.linalg.norm(r, axis=1).max()) for r in residuals)
        row["tilt_deg"] = float(tilts[view.body])
        per_view.append(row)
    numbers: dict[str, Any] = {
        "command": command,
        "out": str(out),
        "lens": fit.kind,
        "rms_px": fit.rms,
        "image_size": list(pictures.size),
        "parameters": {name: values[name] for name in sigmas},
        "standard_deviations": sigmas,
        "lenses": {one.kind: {"rms_px": one.rms, "parameters": len(one.names)} for one in (fit, result.other)},
        "better_lens": result.better,
        "coverage": [_coverage(c, result.views, pictures.size) for c in range(len(fit.lenses))],
        "per_view": per_view,
        "not_found": pictures.missed(),
    }
    warnings = _board_warnings(board)
    if both:
        n = len(sigmas)
        spread = np.sqrt(np.diag(fit.covariance))[n - 6 :]
        numbers |= {
            "X_LR": fit.X_LR.tolist(),
            "X_LR_sigma": {"rotation_deg": np.degrees(spread[:3]).tolist(), "position_mm": (1e3 * spread[3:]).tolist()},
            "baseline_mm": 1e3 * float(np.linalg.norm(fit.X_LR[:, 3])),
            "split_half_mm": None,
            "depth_sigma_mm": {f"{z:g}": 1e3 * s for z, s in result.depth_sigma.items()},
            "triangulated_pitch": {"mean": result.pitch[0], "standard_deviation": result.pitch[1]},
        }
        if result.split_half is None:
            warnings.append("too few pairs for the split-half difference")
        else:
            numbers["split_half_mm"] = {f"{z:g}": 1e3 * d for z, d in result.split_half.items()}
            warnings += [
                f"half the pairs and the other half disagree by {100 * d / z:.1f} % of the distance at {z:g} m"
                for z, d in result.split_half.items()
                if d > 0.02 * z
            ]
    if fit.rms > 0.5:
        warnings.append(f"rms {fit.rms:.2f} px: blurred images, a bent board, or distances that are not those given")
    if outliers:
        warnings.append("views that stand out: " + ", ".join(result.views[k].names[0] for k in outliers))
    if min(numbers["coverage"]) < 0.4:
        warnings.append(f"the boards cover {100 * min(numbers['coverage']):.0f} % of the image only")
    if pictures.missed():
        warnings.append(f"no board found in {', '.join(pictures.missed())}")
    numbers["warnings"] = warnings
    return Report(_finite(numbers), pages.cameras(numbers, result, pictures.size))


def _named(theta: np.ndarray, p: np.ndarray) -> dict[str, float]:
    """A transform's rotation vector [rad] and position [m] by name."""
    names = [f"{what}_{axis}" for what in ("theta", "p") for axis in "xyz"]
    return dict(zip(names, [*theta.tolist(), *p.tolist()]))


def _coverage(camera: int, views: Sequence[cal.View], size: tuple[int, int]) -> float:
    """Share of the image's cells that hold a corner."""
    return float(pages.cells(np.vstack([view.px[camera] for view in views]), size).mean())


def _board_warnings(board: Board, hand: bool = False) -> list[str]:
    if board.symmetric() and hand:
        return ["the board looks the same turned by half a turn: take one with an odd and an even number of corners"]
    return []


def _comment(result: cal.Calibration) -> str:
    fit = result.fit
    text = f"{fit.kind} lens, {len(result.views)} views, rms {fit.rms:.3f} px"
    if result.split_half:
        halves = ", ".join(f"{1e3 * d:.1f} mm at {z:g} m" for z, d in result.split_half.items())
        text += f"; split-half difference {halves}"
    return text


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _finite(value: Any) -> Any:
    """JSON has no NaN: what is not known becomes null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
