"""`valve-drake replay`: the same blocks on what a log holds, compared with what was recorded."""

import argparse
import json
import sys
from pathlib import Path

from valve_drake.checks import ConfigError
from valve_drake.commands.common import DAMAGED, FAILED, OK, Subcommands, display


def add(commands: Subcommands) -> None:
    p = commands.add_parser("replay", help="the same blocks on what a log holds: is all as it was recorded?")
    p.add_argument("log", type=Path)
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="another value, on the old data")
    p.add_argument("--log", type=Path, dest="copy", metavar="FILE", help="writes what the replay makes as a log")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake.recording.reader import LogReader
    from valve_drake.recording.writer import LogError
    from valve_drake.runner import replay

    log = LogReader(options.log)
    try:
        with display(not options.json) as show:
            result = replay(log, options.set, copy=options.copy, show=show)
    except LogError as error:
        print(f"valve-drake: {error}", file=sys.stderr)
        return FAILED
    except ConfigError as error:
        if not log.damage:
            raise
        print(f"valve-drake: {error} ({log.damage[0]})", file=sys.stderr)
        return DAMAGED
    if options.json:
        print(json.dumps(result.as_json()))
    else:
        _print_replay(result)
    if result.damage:
        return DAMAGED
    return OK if result.comparison.identical or options.set else FAILED


def _print_replay(result: object) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console, found = Console(highlight=False, soft_wrap=True), result.comparison
    console.width = max(console.width, 120)  # of the table, also in a pipe
    for line in (*(f"damaged log: {line}" for line in result.damage), *(f"note: {note}" for note in result.notes)):
        console.print(line, markup=False)
    total = sum(topic.replayed for topic in found.topics.values())
    console.print(
        f"{result.end:.1f} s replayed in {result.wall_time:.1f} s (x{result.real_time_factor:.1f} real time), "
        f"{total} messages of {len(found.topics)} topics"
    )
    if found.identical:
        console.print("[bold green]identical[/] to the recorded ones, to the bit")
        return
    console.print(f"[bold red]different[/] from t = {found.first.time:.4f} s:", end=" ")
    console.print(str(found.first), markup=False)
    columns = ("topic", "recorded", "replayed", "equal", "first [s]", "largest difference")
    table = Table(*columns, box=None, header_style="dim")
    for name, topic in found.topics.items():
        if not topic.identical:
            counts = (str(n) for n in (topic.recorded, topic.replayed, topic.equal))
            largest = f"{topic.max_difference:.3g} {topic.largest.field}" if topic.largest else ""
            table.add_row(name, *counts, f"{topic.first.time:.3f}", escape(largest))
    console.print(table)
