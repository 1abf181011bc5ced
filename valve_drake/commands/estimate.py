"""`valve-drake estimate`: the pose of a red rectangle in one photograph, or a stereo pair."""

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valve_drake.checks import ConfigError
from valve_drake.commands.common import FAILED, OK, Subcommands

if TYPE_CHECKING:  # imported where they are used: numpy and OpenCV take longer to load than the parser may
    import numpy as np

    from valve_drake.camera.lens import LensModel, StereoHead
    from valve_drake.perception.photograph import Look


def add(commands: Subcommands) -> None:
    p = commands.add_parser("estimate", help="the pose of a red rectangle in one photograph, or a stereo pair")
    p.add_argument("left", type=Path, metavar="LEFT")
    p.add_argument("right", type=Path, metavar="RIGHT", nargs="?")
    p.add_argument(
        "--calibration", type=Path, required=True, action="append", metavar="FILE", help="twice for a ROS stereo pair"
    )
    p.add_argument("--marker", required=True, metavar="98x100", help="width and height of the rectangle [mm]")
    p.add_argument("--method", choices=("refined", "paper"), default="refined")
    p.add_argument("--camera", choices=("left", "right"), default="left", help="of a head, that a single image is from")
    p.add_argument("--draw", type=Path, metavar="FILE", help="the photographs with all that was seen")
    p.add_argument("--overwrite", action="store_true", help="--draw may replace a file")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake import outputs
    from valve_drake.perception.photograph import look, look_for_others

    size = _marker_size(options.marker)
    paths = [path for path in (options.left, options.right) if path is not None]
    drawing = None
    if options.draw:
        inputs = [*paths, *options.calibration]
        drawing = outputs.check(options.draw, "--draw", inputs=inputs, overwrite=options.overwrite)
        _check_image_kind(options.draw)
    cameras = _cameras(options, single=len(paths) == 1)
    sides = ["left", "right"] if len(paths) == 2 else [options.camera]
    images = _images(paths)
    look(images, cameras, size, options.method)  # loads and allocates; a robot waits for what comes after it
    start = time.perf_counter()
    seen = look(images, cameras, size, options.method)
    time_ms = 1e3 * (time.perf_counter() - start)
    others = look_for_others(seen, cameras, size, options.method) if seen.estimate.found else []
    if drawing is not None:
        outputs.write(drawing, _drawn(options.draw, seen, cameras, size))
    if options.json:
        print(outputs.json_text(_as_json(seen, others, sides, options.method, time_ms)))
    else:
        print(_as_text(seen, others, sides, options.method, time_ms))
    return OK if seen.estimate.found else FAILED


def _marker_size(text: str) -> tuple[float, float]:
    """Width and height [m]."""
    from valve_drake.camera.board import parse_pair

    width, height = parse_pair(text, "--marker", "98x100 (mm)")
    if not all(5 <= length <= 2000 for length in (width, height)):
        raise ConfigError(f"--marker must be two lengths within 5..2000 mm, got {text!r}")
    return width / 1e3, height / 1e3


def _cameras(options: argparse.Namespace, single: bool) -> "StereoHead | LensModel":
    """The head of two images; of a single image its lens."""
    from valve_drake.camera.calibration_file import load_calibration
    from valve_drake.camera.lens import StereoHead

    if len(options.calibration) > 2:
        raise ConfigError(f"--calibration must be one file, or the two of a ROS pair, got {len(options.calibration)}")
    cameras = load_calibration(options.calibration)
    if not isinstance(cameras, StereoHead):
        if not single:
            raise ConfigError(f"calibration {options.calibration[0]}: of one camera, but there are two images")
        return cameras
    if not single:
        return cameras
    return cameras.left if options.camera == "left" else cameras.right


def _images(paths: list[Path]) -> "list[np.ndarray]":
    """(H, W, 3) uint8 RGB each."""
    import numpy as np

    from valve_drake.camera.image_file import read_image

    return [np.ascontiguousarray(read_image(path)[:, :, ::-1]) for path in paths]


def _check_image_kind(path: Path) -> None:
    import cv2

    if not cv2.haveImageWriter(str(path)):
        raise ConfigError(f"--draw {path}: unknown kind of image, name it .png or .jpg")


def _drawn(path: Path, seen: "Look", cameras: "StereoHead | LensModel", size: tuple[float, float]) -> bytes:
    """The overlay as an image file of the kind that the path's suffix names."""
    import cv2
    import numpy as np

    from valve_drake import frames
    from valve_drake.camera.lens import StereoHead
    from valve_drake.perception.overlay import overlay

    if isinstance(cameras, StereoHead):
        image = overlay(seen, cameras.lenses(), [np.eye(3, 4), frames.inverse(cameras.X_LR)], size)
    else:
        image = overlay(seen, [cameras], [np.eye(3, 4)], size)
    try:
        ok, data = cv2.imencode(path.suffix, image)
    except cv2.error:  # a kind that has no room for the image, as WebP beyond 16383 px
        ok = False
    if not ok:
        raise ConfigError(f"--draw {path}: the drawing cannot be such an image, name it .png or .jpg")
    return data.tobytes()


def _pose(seen: "Look", sides: list[str]) -> dict[str, Any]:
    """What is known of one rectangle that was found, as plain numbers."""
    found = seen.estimate
    corners: dict[str, list[list[float]] | None] = {"left": None, "right": None}
    corners |= {side: None if px is None else px.tolist() for side, px in zip(sides, seen.corners_px)}
    return {
        "X_CV": found.X_LV.tolist() if found.found else None,
        "covariance": found.covariance.tolist() if found.found else None,
        "corners_px": corners,
        "ambiguity": found.ambiguity if found.found else None,
        "residual_px": found.residual_px if found.found else None,
        "epipolar_px": seen.epipolar_px if len(sides) == 2 and found.found else None,
        "lens_sigma_px": seen.lens_px if found.found else None,
    }


def _as_json(seen: "Look", others: "list[Look]", sides: list[str], method: str, time_ms: float) -> dict[str, Any]:
    return {
        "found": seen.estimate.found,
        "method": method,
        "camera": sides[0],
        **_pose(seen, sides),
        "others": [_pose(other, sides) for other in others],
        "time_ms": time_ms,
        "reason": seen.estimate.reason,
    }


def _as_text(seen: "Look", others: "list[Look]", sides: list[str], method: str, time_ms: float) -> str:
    from valve_drake.camera.lens import KNOWN

    found = seen.estimate
    if not found.found:
        lines = [f"not found: {found.reason}"]
        for side, one in zip(sides, seen.seen):
            for candidate in one.candidates:
                u, v = candidate.center
                lines.append(f"  {side} ({u:.0f}, {v:.0f}) {candidate.area:.0f} px^2: {candidate.rejected or 'may be'}")
        return "\n".join(lines)
    lines = [f"found by {method} in the {sides[0]} camera's frame, {time_ms:.1f} ms", *_pose_lines(seen)]
    lines.append(f"residual  {found.residual_px:.2f} px, mirrored pose worse by chi2 {found.ambiguity:.1f}")
    if seen.lens_px > KNOWN:
        lines.append(f"the calibration knows the lens here to {seen.lens_px:.1f} px only: no board was there")
    if others:
        count = f"{len(others) + 1} red rectangles of this shape"
        lines.append(f"{count}: the one above fits best, but any of them may be the marker")
        for other in others:
            lines += ["another", *_pose_lines(other)]
    return "\n".join(lines)


def _pose_lines(seen: "Look") -> list[str]:
    import numpy as np

    from valve_drake import frames

    found = seen.estimate
    x, y, z = 1e3 * found.X_LV[:, 3]
    sigma = np.sqrt(np.diag(found.covariance))
    turn, spread = np.degrees([frames.rotation_vector(found.X_LV[:, :3]), sigma[:3]])
    return [
        f"position  {x:.2f} {y:.2f} {z:.2f} mm  +- {' '.join(f'{1e3 * s:.2f}' for s in sigma[3:])}",
        f"rotation  {' '.join(f'{a:.3f}' for a in turn)} deg  +- {' '.join(f'{s:.3f}' for s in spread)}",
    ]
