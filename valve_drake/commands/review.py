"""`valve-drake review`: one page of a log, or of two compared; or one topic as a table."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from valve_drake import outputs
from valve_drake.checks import ConfigError
from valve_drake.commands.common import DAMAGED, OK, Subcommands, print_summary
from valve_drake.console import console as make_console
from valve_drake.console import say, styled

if TYPE_CHECKING:
    from valve_drake.analysis.report import Review, SideBySide

MOST_TOPICS = 30  # of another program's log, on the terminal


def add(commands: Subcommands) -> None:
    p = commands.add_parser("review", help="one page of a log: what happened, is it whole; or of two, compared")
    p.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="one log, or two to compare")
    p.add_argument("--html", type=Path, metavar="FILE", help="the page (default: LOG with .review.html, beside it)")
    p.add_argument("--json", action="store_true", help="print the same facts as one JSON object; no page unless --html")
    p.add_argument("--export", choices=("csv", "npz"), help="write --topic as a table instead")
    p.add_argument("--topic", help="what to export")
    p.add_argument("--out", type=Path, metavar="FILE", help="of the export (default: beside the log)")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    from valve_drake.analysis import report

    if len(options.logs) > 2:
        raise ConfigError(f"review takes one log or two, got {len(options.logs)}")
    if options.export or options.topic or options.out:
        return _export(options)
    name = "-".join(log.stem for log in options.logs)
    html = options.html or (None if options.json else options.logs[0].parent / f"{name}.review.html")
    if html is not None:
        html = outputs.check(html, "--html", options.logs, report.was_made)
    found = [report.review(log) for log in options.logs]
    both = report.compare(*found) if len(found) == 2 else None
    if html is not None:
        beside = html.parent.resolve()
        outputs.write(html, report.comparison_page(both, beside) if both else report.page(found[0], beside))
    if options.json:
        facts = report.comparison_facts(both) if both else report.facts(found[0])
        print(outputs.json_text(facts | {"html": str(html) if html else None}))
    else:
        for one in found:
            _print_review(one, str(one.log.path) if both else "")
        if both:
            _print_parting(both)
        say(f"page {html}")
    return OK if all(one.integrity.sound for one in found) else DAMAGED


def _print_review(one: "Review", name: str) -> None:
    """What is known of one log; `name` heads it if there are two."""
    from valve_drake.analysis import report

    console = make_console()
    if name:
        console.print(f"{name}:")
    if one.log.own or one.summary.spans:
        print_summary(console, one.summary)
    if not one.log.own:
        console.print(f"{one.log.path} was {report.writer(one.log)}")
        for topic in one.integrity.topics[:MOST_TOPICS]:
            console.print(f"  {topic.topic}  {topic.schema or '-'}  {topic.count}")
        if len(one.integrity.topics) > MOST_TOPICS:
            console.print(f"  and {len(one.integrity.topics) - MOST_TOPICS} more")
    for line in one.integrity.troubles:
        console.print(f"damaged: {line}")
    for row in one.integrity.late[:10]:
        missing = sum(gap.missing for gap in row.gaps)
        console.print(f"gaps: {row.topic} {len(row.gaps)}, {missing} messages missing")
    whole = "whole" if one.integrity.sound else "not whole"
    console.print(f"the log is {whole}: {one.integrity.messages} messages, {len(one.integrity.topics)} topics")


def _print_parting(both: "SideBySide") -> None:
    """Where two logs part."""
    from valve_drake.analysis import report

    console, first = make_console(), both.first
    if first is None:
        word = ("identical", "bold green") if both.sound else "no difference"
        console.print(styled(word, ": what both hold is equal to the bit"))
        return
    a, b = report.parting_values(first)
    words = f"{first.field}: {a} and {b}" if first.field else f"only in {(both.a if b is None else both.b).log.path}"
    console.print(f"they part at t = {first.time:.6f} s, {first.topic} {words}")


def _export(options: argparse.Namespace) -> int:
    from valve_drake.analysis import export
    from valve_drake.recording.reader import LogReader

    if not (options.export and options.topic):
        raise ConfigError("an export wants both --export csv|npz and --topic")
    if len(options.logs) != 1:
        raise ConfigError(f"an export is of one log, got {len(options.logs)}")
    name = f"{options.logs[0].stem}{options.topic.replace('/', '.')}.{options.export}"
    out = outputs.check(options.out or options.logs[0].parent / name, "--out", options.logs, export.was_made)
    log = LogReader(options.logs[0])
    count = export.write(log, options.topic, options.export, out)
    if options.json:
        print(outputs.json_text({"topic": options.topic, "messages": count, "out": str(out), "damage": log.damage}))
    else:
        say(f"{out}: {count} messages of {options.topic}")
        for line in log.damage:
            say(f"  {line}")
    return DAMAGED if log.damage else OK
