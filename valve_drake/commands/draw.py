"""`valve-drake draw`: wiring list and drawing of a scenario's diagram."""

import argparse
from pathlib import Path

from valve_drake.commands.common import OK, Subcommands
from valve_drake.console import say


def add(commands: Subcommands) -> None:
    p = commands.add_parser("draw", help="wiring list and drawing of a scenario's diagram")
    p.add_argument("scenario", nargs="?")
    p.add_argument("--out", type=Path, help="folder (default: diagrams/)")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake import drawing, outputs, resources
    from valve_drake import scenario as scenarios

    scenario = scenarios.load(options.scenario, ["hardware.lcm_url=memq://"])  # to be looked at, not to speak
    name = Path(options.scenario or scenarios.DEFAULT).name.removesuffix(".scenario.yaml")
    out = resources.diagrams() if options.out is None else options.out
    folder = outputs.check_folder(out, "--out", drawing.files(name), made_before=drawing.made_before)
    for path in drawing.write(scenario, name, folder):
        say(path)
    return OK
