"""`valve-drake scenario`: every key of a scenario with its value, its unit and its bounds."""

import argparse

from valve_drake.commands.common import OK, Subcommands


def add(commands: Subcommands) -> None:
    p = commands.add_parser("scenario", help="all keys of a scenario with values, units and bounds, as YAML")
    p.add_argument("scenario", nargs="?", help="a file, or a name in diagrams/ (default: simulated.scenario.yaml)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="override a key of the scenario")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake import config
    from valve_drake import scenario as scenarios

    scenario = scenarios.load(options.scenario, options.set)
    print("\n".join(config.describe(scenario)))
    return OK
