"""`valve-drake calibrate`: cameras from images of a chessboard."""

import argparse
import math
from pathlib import Path

from valve_drake import outputs
from valve_drake.checks import ConfigError
from valve_drake.commands.common import OK, Parser, Subcommands


def add(commands: Subcommands) -> None:
    kinds = commands.add_parser("calibrate", help="cameras from images of a chessboard").add_subparsers(
        required=True, metavar="WHAT", parser_class=Parser
    )
    for name, what in (
        ("intrinsics", "one camera"),
        ("stereo", "the stereo head"),
        ("hand-eye", "a camera on the hand, or beside the robot"),
    ):
        p = kinds.add_parser(name, help=what)
        for key in ("--left", "--right") if name == "stereo" else ("--images",):
            p.add_argument(key, required=True, nargs="+", metavar="GLOB")
        if name == "hand-eye":
            p.add_argument("--poses", type=Path, required=True, help='JSON: [{"image": name, "X_BE": 4x4, m}, ...]')
            p.add_argument("--camera", type=Path, metavar="FILE", help="its lens (default: from the same images)")
            p.add_argument("--eye-to-hand", action="store_true", help="the camera stands, the hand holds the board")
        else:
            p.add_argument("--distances", metavar="MM,...", help="of boards that all face the camera, in order")
            p.add_argument("--lens", choices=("opencv", "paper", "best"), default="opencv", help="what to write")
        p.add_argument("--board", required=True, metavar="9x6", help="inner corners, x by y")
        p.add_argument("--pitch", required=True, metavar="25x25", help="of the corners, x by y [mm]")
        p.add_argument("--out", type=Path, required=True, metavar="FILE", help="the calibration, YAML")
        p.add_argument("--html", type=Path, metavar="FILE", help="the report as a page")
        p.add_argument("--json", action="store_true", help="print the report as one JSON object")
        p.set_defaults(command=command, kind=name)


def command(options: argparse.Namespace) -> int:
    from valve_drake.camera import calibration_report as reports
    from valve_drake.camera.board import parse_board

    board = parse_board(options.board, options.pitch)
    _check_outputs(options)
    if options.kind == "hand-eye":
        from valve_drake.camera import hand_eye_report

        report = hand_eye_report.hand_eye(
            options.images, options.poses, board, options.out, options.camera, options.eye_to_hand
        )
    else:
        distances = None if options.distances is None else _millimetres(options.distances)
        if options.kind == "stereo":
            report = reports.stereo(options.left, options.right, board, options.out, options.lens, distances)
        else:
            report = reports.intrinsics(options.images, board, options.out, options.lens, distances)
    if options.html:
        outputs.write(options.html, report.page)
    print(outputs.json_text(report.numbers) if options.json else "\n".join(report.lines()))
    return OK


def _check_outputs(options: argparse.Namespace) -> None:
    """Refuses, before the work, files that must not be written over. Raises ConfigError."""
    from valve_drake.camera.board import find_images
    from valve_drake.camera.calibration_file import is_own
    from valve_drake.camera.calibration_page import is_page

    keys = ("left", "right") if options.kind == "stereo" else ("images",)
    inputs = [path for key in keys for path in find_images(getattr(options, key), f"--{key}")]
    if options.kind == "hand-eye":
        inputs += [options.poses, *([options.camera] if options.camera else [])]
    outputs.check(options.out, "--out", inputs, made_before=is_own)
    if options.html:
        outputs.check(options.html, "--html", [*inputs, options.out], made_before=is_page)


def _millimetres(text: str) -> list[float]:
    try:
        values = [float(part) / 1e3 for part in text.split(",")]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) and value > 0 for value in values):
        raise ConfigError(f"--distances must be numbers > 0 in mm, like 600,700,800, got {text!r}")
    return values
