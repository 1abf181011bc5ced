"""`valve-drake teach`: reference images and image Jacobians of the hands."""

import argparse
from pathlib import Path

from valve_drake.commands.common import OK, Subcommands, check_rendering, stopper
from valve_drake.console import say


def add(commands: Subcommands) -> None:
    p = commands.add_parser("teach", help="reference images and image Jacobians of the hands")
    p.add_argument("scenario", nargs="?", help="a file, or a name in diagrams/ (default: simulated.scenario.yaml)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="overrides any key of the scenario")
    p.add_argument("--lockstep", action="store_true", help="station `hardware`: in lock-step with a twin that is, too")
    p.add_argument("--out", type=Path, help="folder (default: where robot.yaml's `taught` leads, or taught/)")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    check_rendering()
    from valve_drake import outputs, teaching
    from valve_drake import scenario as scenarios

    overrides = [*options.set, *["hardware.lockstep=true"] * options.lockstep]
    scenario = scenarios.load(options.scenario, overrides)
    out, key = teaching.place_of(scenario)
    folder = outputs.check_folder(options.out or out, "--out", teaching.FILES, made_before=teaching.made_before)
    with stopper() as stop:
        teaching.write(scenario, folder, stop)
    say(folder / teaching.REFERENCES)
    if key and options.out is None:
        say(f"add to {scenario.robot}: taught: {key}")
    return OK
