"""`valve-drake check-robot`: what a robot can do of the work, and what is missing, before its first run."""

import argparse
from pathlib import Path

from valve_drake import outputs
from valve_drake.commands.common import FAILED, OK, Subcommands, check_rendering
from valve_drake.console import say


def add(commands: Subcommands) -> None:
    p = commands.add_parser(
        "check-robot",
        help="what a robot can do of the work, and what is missing",
        description="One page: names and limits, home free of collision, eyes free of the folded arms, from where it "
        "turns a valve at which height and with what effort, grippers, servos, and what each stage lacks. Exit code 0: "
        "usable, 1: something is missing.",
    )
    p.add_argument("robot", metavar="ROBOT.yaml", help="a path, one below models/, or a package:// URL")
    p.add_argument("--scenario", metavar="FILE", help="whose valve it is to turn (default: simulated.scenario.yaml)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="overrides any key of the scenario")
    p.add_argument("--html", type=Path, metavar="FILE", help="the report as a page, with pictures")
    p.add_argument("--json", action="store_true", help="print the report as one JSON object")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    check_rendering()
    from valve_drake import robot_check, robot_check_page
    from valve_drake import scenario as scenarios

    scenario = scenarios.load(options.scenario, options.set)
    scenario.robot = options.robot
    if options.html is not None:
        outputs.check(options.html, "--html", [Path(options.robot)], robot_check_page.is_page)
    report = robot_check.check(scenario, options.robot, pictures=options.html is not None)
    if options.html is not None:
        outputs.write(options.html, robot_check_page.page(report))
    if options.json:
        print(outputs.json_text(report.as_json()))
    else:
        for line in robot_check_page.lines(report):
            say(line)
    return OK if report.usable else FAILED
