"""`valve-drake replay`: the same blocks on what a log holds, compared with what was recorded."""

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from valve_drake import outputs
from valve_drake.checks import ConfigError
from valve_drake.commands.common import DAMAGED, FAILED, OK, Subcommands, check_log, display
from valve_drake.console import complain, styled
from valve_drake.console import console as make_console

if TYPE_CHECKING:
    from valve_drake import runner


def add(commands: Subcommands) -> None:
    p = commands.add_parser("replay", help="the same blocks on what a log holds: is all as it was recorded?")
    p.add_argument("log", type=Path)
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="another value, on the old data")
    p.add_argument("--log", type=Path, dest="copy", metavar="FILE.mcap", help="writes what the replay makes as a log")
    p.add_argument("--overwrite", action="store_true", help="that --log may exist: it is replaced")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake.recording.reader import LogReader
    from valve_drake.runner import replay

    log = LogReader(options.log)
    copy, overwrite = None, False
    if options.copy is not None:
        copy = check_log(options.copy, "--log", options.overwrite, [options.log])
        overwrite = options.overwrite or os.path.lexists(copy)  # it was checked
    try:
        with display(not options.json) as show:
            result = replay(log, options.set, copy=copy, overwrite=overwrite, show=show, say=complain)
    except ConfigError as error:
        if not log.damage:
            raise
        complain(f"{error} ({log.damage[0]})")
        return DAMAGED
    if options.json:
        print(outputs.json_text(result.as_json()))
    else:
        _print_replay(result)
    if result.log_error:
        complain(result.log_error)
        return FAILED
    if result.damage:
        return DAMAGED
    return OK if result.comparison.identical or options.set else FAILED


def _print_replay(result: "runner.Replay") -> None:
    from rich.table import Table

    console, found = make_console(), result.comparison
    console.width = max(console.width, 120)  # of the table, also in a pipe
    for line in (*(f"damaged log: {line}" for line in result.damage), *(f"note: {note}" for note in result.notes)):
        console.print(line)
    total = sum(topic.replayed for topic in found.topics.values())
    console.print(
        f"{result.end:.1f} s replayed in {result.wall_time:.1f} s (x{result.real_time_factor:.1f} real time), "
        f"{total} messages of {len(found.topics)} topics"
    )
    if found.identical:
        console.print(styled(("identical", "bold green"), " to the recorded ones, to the bit"))
    else:
        parting = f" from t = {found.first.time:.4f} s: {found.first}" if found.first else ""
        console.print(styled(("different", "bold red"), parting))
        columns = ("topic", "recorded", "replayed", "equal", "first [s]", "largest difference")
        table = Table(*columns, box=None, header_style="dim")
        for name, topic in found.topics.items():
            if not topic.identical:
                counts = (str(n) for n in (topic.recorded, topic.replayed, topic.equal))
                largest = f"{topic.max_difference:.3g} {topic.largest.field}" if topic.largest else ""
                table.add_row(name, *counts, f"{topic.first.time:.3f}" if topic.first else "", largest)
        console.print(table)
    if result.log is not None and not result.log_error:
        console.print(f"log {result.log}")
