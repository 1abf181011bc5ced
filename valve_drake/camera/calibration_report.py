"""From folders of images to calibrations: what `calibrate` reports as JSON, and as one HTML page."""

import contextlib
import dataclasses as dc
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from valve_drake import frames, outputs
from valve_drake.camera import calibration as cal
from valve_drake.camera import calibration_page as pages
from valve_drake.camera.board import Board, Pairs, find_corners, find_images, pair_images
from valve_drake.camera.calibration_file import save_camera
from valve_drake.camera.image_file import read_image
from valve_drake.camera.lens import KNOWN, save_head
from valve_drake.checks import ConfigError, require
from valve_drake.console import console


@dc.dataclass(frozen=True)
class Report:
    """The result of a calibration: numbers for JSON, an HTML page, and the main lines for a terminal."""

    numbers: dict[str, Any]
    page: str
    text: list[str]

    def lines(self) -> list[str]:
        """The text for a terminal, with the warnings."""
        return self.text + [f"note: {text}" for text in self.numbers["warnings"]]


@dc.dataclass(frozen=True)
class Pictures:
    """The board in the images of one camera, or of two."""

    paths: list[tuple[Path, ...]]  # of each view, one for each camera
    corners: list[tuple[np.ndarray | None, ...]]  # the same, (n, 2) in the order of Board.points [px]; None: not found
    size: tuple[int, int]  # width, height of every image [px]
    pairs: Pairs | None = None  # of two cameras

    def missed(self) -> list[str]:
        """Names of the images in which no board was found."""
        return [p.name for paths, px in zip(self.paths, self.corners) for p, one in zip(paths, px) if one is None]


def intrinsics(
    images: Sequence[str], board: Board, out: Path, kind: str = "opencv", distances: Sequence[float] | None = None
) -> Report:
    """One camera from the images of a glob; distances [m] make the boards one rigid target. Writes `out`.

    kind: opencv, paper or best. Raises ConfigError naming the option or file, OperationFailed if `out` cannot be
    written.
    """
    pictures = look(board, (images,), ("--images",), distances)
    result = calibrated(pictures, board, kind, distances)
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
    """The stereo head from two globs, paired by the numbers in the names. Writes `out`. As `intrinsics`."""
    pictures = look(board, (left, right), ("--left", "--right"), distances)
    result = calibrated(pictures, board, kind, distances)
    save_head(result.fit.head(), out, _comment(result))
    return _report("stereo", result, pictures, board, out)


# ---------------------------------------------------------------- reading


def look(
    board: Board, patterns: Sequence[Sequence[str]], keys: Sequence[str], distances: Sequence[float] | None = None
) -> Pictures:
    """Finds the board in all images of one camera, or of two in pairs. Raises ConfigError naming the file or option."""
    found = [find_images(pattern, key) for pattern, key in zip(patterns, keys)]
    pairs = pair_images(*found) if len(found) == 2 else None
    paths: list[tuple[Path, ...]] = list(pairs.paths) if pairs else [(path,) for path in found[0]]
    if distances is not None:
        if pairs and pairs.alone:
            raise ConfigError(f"--distances needs a partner for every image, {some(_names(pairs.alone))} has none")
        wanted = f"{len(paths)} numbers, one for each image"
        require(len(distances) == len(paths), "--distances", wanted, len(distances))
        require(len(set(distances)) > 1, "--distances", "different from one another", list(distances))
    corners, size = _corners(paths, board)
    if not any(all(px is not None for px in pair) for pair in corners):
        raise ConfigError(f"no board of {board.columns} x {board.rows} inner corners in any of {len(corners)} image(s)")
    return Pictures(paths, corners, size, pairs)


def _corners(
    paths: Sequence[tuple[Path, ...]], board: Board
) -> tuple[list[tuple[np.ndarray | None, ...]], tuple[int, int]]:
    """The corners in every image, and the size that all images have. One image at a time is held in memory."""
    corners: list[tuple[np.ndarray | None, ...]] = []
    first: tuple[int, ...] = ()  # height and width of the first image
    with console(stderr=True).status("") if sys.stderr.isatty() else contextlib.nullcontext() as status:
        for k, pair in enumerate(paths):
            px = []
            for path in pair:
                if status is not None:
                    status.update(f"looking for the board in {path.name} ({k + 1} of {len(paths)})")
                image = read_image(path, cv2.IMREAD_GRAYSCALE)
                first = first or image.shape
                if image.shape != first:
                    (h, w), (height, width) = image.shape, first
                    raise ConfigError(f"image {path}: {w} x {h}, but {paths[0][0].name} is {width} x {height}")
                px.append(find_corners(image, board))
            corners.append(tuple(px))
    return corners, (first[1], first[0])


def some(names: Sequence[str]) -> str:
    """The first six of the names, and how many more there are."""
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def _names(paths: Sequence[Path]) -> list[str]:
    return [path.name for path in paths]


def calibrated(pictures: Pictures, board: Board, kind: str, distances: Sequence[float] | None) -> cal.Calibration:
    """The calibration from pictures. kind, distances [m]: as `intrinsics` has them. Raises ConfigError."""
    names = [tuple(path.name for path in paths) for paths in pictures.paths]
    return cal.calibrate(cal.board_views(board, names, pictures.corners, distances), pictures.size, kind, board)


# ---------------------------------------------------------------- numbers


def _report(command: str, result: cal.Calibration, pictures: Pictures, board: Board, out: Path) -> Report:
    fit, both = result.fit, len(result.fit.lenses) == 2
    values, sigmas, outliers = cal.parameters(fit), fit.sigmas(), fit.outliers()
    X_LR = fit.X_LR
    if X_LR is not None:
        pose = named(frames.rotation_vector(X_LR[:, :3]), X_LR[:, 3])
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
        "lens_unknown": list(result.unknown),
        "per_view": per_view,
        "not_found": pictures.missed(),
    }
    warnings: list[str] = []
    if pictures.pairs is not None:
        numbers["without_partner"] = _names(pictures.pairs.alone)
        if pictures.pairs.alone:
            warnings.append(f"left out for want of a partner: {some(_names(pictures.pairs.alone))}")
        if pictures.pairs.by_order:
            left, right = pictures.paths[0]
            warnings.append(f"the names do not tell the pairs: taken in their order, {left.name} with {right.name}")
        if board.symmetric():
            warnings.append(
                "the board looks the same after half a turn: its corners are numbered so that the pairs agree; "
                "one with an odd and an even number of corners leaves no doubt"
            )
    if X_LR is not None:
        n = len(sigmas)
        spread = np.sqrt(np.diag(fit.covariance))[n - 6 :]
        numbers |= {
            "X_LR": X_LR.tolist(),
            "X_LR_sigma": {"rotation_deg": np.degrees(spread[:3]).tolist(), "position_mm": (1e3 * spread[3:]).tolist()},
            "baseline_mm": 1e3 * float(np.linalg.norm(X_LR[:, 3])),
            "split_half_mm": None,
            "depth_sigma_mm": {f"{z:g}": 1e3 * s for z, s in result.depth_sigma.items()},
        }
        if result.pitch is not None:
            mean, deviation = result.pitch
            numbers["triangulated_pitch"] = {"mean": mean, "standard_deviation": deviation}
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
    if max(result.unknown) > 0:
        warnings.append(
            f"the lens is known to worse than {KNOWN:g} px in {100 * max(result.unknown):.0f} % of the image: "
            "show the board there, or keep the marker where the boards were"
        )
    if pictures.missed():
        warnings.append(f"no board found in {', '.join(pictures.missed())}")
    numbers["warnings"] = warnings
    return Report(outputs.finite(numbers), pages.cameras(numbers, result, pictures.size), _text(numbers))


def _text(n: dict[str, Any]) -> list[str]:
    out = [f"{n['out']}: {len(n['per_view'])} views, rms {n['rms_px']:.3f} px"]
    sigmas = n["standard_deviations"]
    out += [f"  {name:<13} {value:12.6g} +- {sigmas[name]:.2g}" for name, value in n["parameters"].items()]
    lenses = ", ".join(f"{k} lens {v['rms_px']:.3f} px" for k, v in n["lenses"].items())
    out.append(f"{lenses}; better: {n['better_lens']}")
    if n["command"] == "stereo":
        out.append(f"baseline {n['baseline_mm']:.2f} mm")
        out += [f"split-half difference at {z} m: {mm:.1f} mm" for z, mm in (n["split_half_mm"] or {}).items()]
    return out


def named(theta: np.ndarray, p: np.ndarray) -> dict[str, float]:
    """A transform's rotation vector [rad] and position [m] by name."""
    names = [f"{what}_{axis}" for what in ("theta", "p") for axis in "xyz"]
    return dict(zip(names, [*theta.tolist(), *p.tolist()]))


def _coverage(camera: int, views: Sequence[cal.View], size: tuple[int, int]) -> float:
    """Share of the image's cells that hold a corner."""
    return float(pages.cells(np.vstack([view.px[camera] for view in views]), size).mean())


def _comment(result: cal.Calibration) -> str:
    fit = result.fit
    text = f"{fit.kind} lens, {len(result.views)} views, rms {fit.rms:.3f} px"
    if result.split_half:
        halves = ", ".join(f"{1e3 * d:.1f} mm at {z:g} m" for z, d in result.split_half.items())
        text += f"; split-half difference {halves}"
    return text
