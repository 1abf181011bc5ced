"""`valve-drake recover`: a whole log from a truncated or damaged one."""

import argparse
from pathlib import Path

from valve_drake.commands.common import DAMAGED, OK, Subcommands
from valve_drake.console import say


def add(commands: Subcommands) -> None:
    p = commands.add_parser("recover", help="a whole log from a truncated or damaged one")
    p.add_argument("log", type=Path)
    p.add_argument("-o", "--out", type=Path, required=True, metavar="FILE")
    p.add_argument("--overwrite", action="store_true", help="FILE may exist: it is replaced")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake.recording.recovery import recover

    log = recover(options.log, options.out, options.overwrite)
    count = sum(topic.count for topic in log.topics.values())
    say(f"{options.out}: {count} messages up to {log.end:.3f} s")
    for line in log.damage:
        say(f"  {line}")
    return DAMAGED if log.losses else OK
