"""`valve-drake teach`: reference images and image Jacobians of the hands."""

import argparse
from pathlib import Path

from valve_drake.commands.common import OK, Subcommands, check_rendering


def add(commands: Subcommands) -> None:
    p = commands.add_parser("teach", help="reference images and image Jacobians of the hands")
    p.add_argument("scenario", nargs="?")
    p.add_argument("--out", type=Path, help="folder (default: models/taught/)")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    check_rendering()
    from valve_drake import resources, teaching
    from valve_drake import scenario as scenarios

    folder = options.out or resources.models() / "taught"
    teaching.write(scenarios.load(options.scenario), folder)
    print(folder / "hands.yaml")
    return OK
