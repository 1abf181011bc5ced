"""`valve-drake teach`: reference images and image Jacobians of the hands."""

import argparse
from pathlib import Path

from valve_drake.commands.common import OK, Subcommands, check_rendering
from valve_drake.console import say


def add(commands: Subcommands) -> None:
    p = commands.add_parser("teach", help="reference images and image Jacobians of the hands")
    p.add_argument("scenario", nargs="?")
    p.add_argument("--out", type=Path, help="folder (default: models/taught/)")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    check_rendering()
    from valve_drake import outputs, resources, teaching
    from valve_drake import scenario as scenarios

    scenario = scenarios.load(options.scenario)
    out = resources.models() / "taught" if options.out is None else options.out
    folder = outputs.check_folder(out, "--out", teaching.FILES, made_before=teaching.made_before)
    teaching.write(scenario, folder)
    say(folder / teaching.REFERENCES)
    return OK
