"""`valve-drake twin`: the simulated robot as a process of its own, for station `hardware`."""

import argparse
import math

from valve_drake import outputs
from valve_drake.commands.common import OK, Subcommands, check_rendering, scenario_overrides, stopper


def add(commands: Subcommands) -> None:
    p = commands.add_parser("twin", help="the simulated robot as a process of its own, for station `hardware`")
    p.add_argument("scenario", nargs="?", help="the one that is run (default: hardware.scenario.yaml)")
    p.add_argument("--seed", type=int, help="draws its world, noise, errors and the chances of its faults")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="overrides any key of the scenario")
    p.add_argument("--lockstep", action="store_true", help="waits for the program's every tick, instead of the clock")
    p.add_argument("--duration", type=float, metavar="SECONDS", help="end after this time (default: with the program)")
    p.add_argument("--json", action="store_true", help="print one JSON object at the end, with the valve's true angle")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    check_rendering()
    from valve_drake import scenario as scenarios
    from valve_drake.rehearsal import run_twin

    name = "hardware.scenario.yaml" if options.scenario is None else options.scenario
    scenario = scenarios.load(name, scenario_overrides(options))
    with stopper() as stop:
        result = run_twin(scenario, duration=options.duration, stop=stop)
    if options.json:
        print(outputs.json_text(result.as_json()))
    else:
        turned = math.degrees(result.valve_end - result.valve_start)
        print(f"{result.time:.1f} s; the valve was turned by {turned:.2f} deg")
    return OK
