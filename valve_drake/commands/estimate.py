"""`valve-drake estimate`: the pose of a red rectangle in one photograph, or a stereo pair."""

import argparse
import json
from pathlib import Path

from valve_drake.checks import ConfigError
from valve_drake.commands.common import FAILED, OK, Subcommands


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
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    import time

    import numpy as np

    from valve_drake import frames
    from valve_drake.camera.board import parse_pair
    from valve_drake.camera.calibration_file import load_calibration
    from valve_drake.camera.image_file import read_image
    from valve_drake.camera.lens import StereoHead
    from valve_drake.perception.photograph import look

    size = parse_pair(options.marker, "--marker", "98x100 (mm)")
    if not all(5 <= length <= 2000 for length in size):
        raise ConfigError(f"--marker must be two lengths within 5..2000 mm, got {options.marker!r}")
    if len(options.calibration) > 2:
        raise ConfigError(f"--calibration must be one file, or the two of a ROS pair, got {len(options.calibration)}")
    cameras = load_calibration(options.calibration)
    head = isinstance(cameras, StereoHead)
    if options.right is not None and not head:
        raise ConfigError(f"calibration {options.calibration[0]}: of one camera, but there are two images")
    paths = [path for path in (options.left, options.right) if path is not None]
    sides = ["left", "right"] if len(paths) == 2 else [options.camera]
    if len(paths) == 1 and head:
        cameras = getattr(cameras, options.camera)
    images = [np.ascontiguousarray(read_image(path)[:, :, ::-1]) for path in paths]
    for _ in range(2):  # the first look also loads and allocates: the second is what a robot would wait for
        start = time.perf_counter()
        seen = look(images, cameras, (size[0] / 1e3, size[1] / 1e3), options.method)
        took = time.perf_counter() - start
    found = seen.estimate
    corners: dict[str, list | None] = {"left": None, "right": None}
    corners |= {side: None if px is None else px.tolist() for side, px in zip(sides, seen.corners_px)}
    if options.draw:
        from valve_drake.perception.overlay import overlay

        lenses = cameras.lenses() if len(paths) == 2 else [cameras]
        X_CL = [np.eye(3, 4), frames.inverse(cameras.X_LR)] if len(paths) == 2 else [np.eye(3, 4)]
        _write_image(options.draw, overlay(seen, lenses, X_CL, (size[0] / 1e3, size[1] / 1e3)))
    if options.json:
        out = {
            "found": found.found,
            "method": options.method,
            "camera": sides[0],
            "X_CV": found.X_LV.tolist() if found.found else None,
            "covariance": found.covariance.tolist() if found.found else None,
            "corners_px": corners,
            "ambiguity": found.ambiguity if found.found else None,
            "residual_px": found.residual_px if found.found else None,
            "epipolar_px": seen.epipolar_px if len(paths) == 2 and found.found else None,
            "time_ms": 1e3 * took,
            "reason": found.reason,
        }
        print(json.dumps(out))
    elif found.found:
        x, y, z = 1e3 * found.X_LV[:, 3]
        sigma = np.sqrt(np.diag(found.covariance))
        print(f"found by {options.method} in the {sides[0]} camera's frame, {1e3 * took:.1f} ms")
        print(f"position  {x:.2f} {y:.2f} {z:.2f} mm  +- {' '.join(f'{1e3 * s:.2f}' for s in sigma[3:])}")
        turn, spread = np.degrees([frames.rotation_vector(found.X_LV[:, :3]), sigma[:3]])
        print(f"rotation  {' '.join(f'{a:.3f}' for a in turn)} deg  +- {' '.join(f'{s:.3f}' for s in spread)}")
        print(f"residual  {found.residual_px:.2f} px, mirrored pose worse by chi2 {found.ambiguity:.1f}")
    else:
        print(f"not found: {found.reason}")
        for side, one in zip(sides, seen.seen):
            for candidate in one.candidates:
                u, v = candidate.center
                print(f"  {side} ({u:.0f}, {v:.0f}) {candidate.area:.0f} px^2: {candidate.rejected or 'may be'}")
    return OK if found.found else FAILED


def _write_image(path: Path, image: object) -> None:
    import cv2

    try:
        ok, data = cv2.imencode(path.suffix, image)
        if ok:
            path.write_bytes(data.tobytes())
    except cv2.error:
        ok = False
    except OSError as error:
        raise ConfigError(f"--draw {path}: cannot be written ({type(error).__name__})") from error
    if not ok:
        raise ConfigError(f"--draw {path}: unknown kind of image, name it .png or .jpg")
