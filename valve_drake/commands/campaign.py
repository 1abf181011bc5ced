"""`valve-drake campaign`: many runs, each with its own seed, and what may be said of them; `valve-drake runs`."""

import argparse
import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from valve_drake import outputs
from valve_drake.checks import ConfigError
from valve_drake.commands.common import FAILED, OK, Subcommands, check_rendering
from valve_drake.console import complain, say
from valve_drake.console import console as make_console

if TYPE_CHECKING:
    from valve_drake.campaign.campaign import Progress

REPORT, TABLE, FAILURES = "report.html", "runs.csv", "failures.yaml"


def add(commands: Subcommands) -> None:
    p = commands.add_parser("campaign", help="many runs, each with its own seed: the success rate and its interval")
    p.add_argument(
        "scenario",
        nargs="*",
        help="files, or names in diagrams/ (default: simulated.scenario.yaml); or: compare A B, two campaigns' folders",
    )
    p.add_argument("--runs", type=int, metavar="N", help="of each scenario (default: 20; of --again: its whole list)")
    p.add_argument("--first-seed", type=int, default=1, metavar="S", help="seeds S, S+1, ... (default: 1)")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="overrides any key of the scenarios")
    p.add_argument("--hunt", action="store_true", help="choose what is drawn where runs fail or nearly do")
    p.add_argument("--again", type=Path, metavar="FILE", help="run the failures of a list (failures.yaml) again")
    p.add_argument("--jobs", type=int, default=1, help="runs at a time (default: 1)")
    p.add_argument("--out", type=Path, metavar="FOLDER", help="of the records (default: logs/campaign-<scenario>-<S>)")
    p.add_argument("--backend", choices=("local", "dask"), default="local", help="where the runs are made")
    p.add_argument("--scheduler", metavar="ADDRESS", help="of Dask, e.g. tcp://127.0.0.1:8786 (default: its own)")
    p.add_argument("--logs", choices=("all", "failed", "none"), default="failed", help="which are kept: see docs")
    p.add_argument("--time-out", type=float, default=900.0, metavar="SECONDS", help="of one run (default: 900)")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=command, default=p.get_default)
    r = commands.add_parser("runs", help="a table of all logs in a folder")
    r.add_argument("folder", type=Path, help="with logs, or of a campaign")
    r.add_argument("--html", type=Path, metavar="FILE", help="the page (default: FOLDER/report.html)")
    r.add_argument("--json", action="store_true", help="print one JSON object; no page unless --html")
    r.set_defaults(command=runs)


def command(options: argparse.Namespace) -> int:
    if options.scenario[:1] == ["compare"]:
        return compare(options)
    check_rendering()
    from valve_drake.campaign import campaign as campaigns
    from valve_drake.campaign import failures, report
    from valve_drake.campaign.executors import executor
    from valve_drake.scenario import DEFAULT

    given = tuple(options.scenario) or (DEFAULT,)
    kind, runs = ("hunt" if options.hunt else "campaign"), options.runs
    again: tuple[failures.Failure, ...] = ()
    if options.again is not None:
        if options.hunt or options.scenario:
            raise ConfigError("--again goes with no scenario and no --hunt: its list names them")
        if runs is not None and runs < 1:
            raise ConfigError(f"--runs must be 1 or more, got {runs}")
        again = failures.read(options.again)[:runs]
        kind, given, runs = "again", (str(options.again),), 1
    out = options.out or Path("logs") / f"{kind}-{campaigns.name_of(given[0])}-{options.first_seed}"
    wanted = campaigns.Campaign(
        given,
        20 if runs is None else runs,
        options.first_seed,
        tuple(options.set),
        out,
        options.logs,
        options.time_out,
        options.hunt,
        again,
    )
    wanted.check()  # what is wrong is said before anything is begun
    with _display(not options.json) as show, executor(options.backend, options.jobs, options.scheduler) as pool:
        records = campaigns.run(wanted, pool, show, complain)
    outputs.write(out / TABLE, report.table(records))
    outputs.write(out / REPORT, report.page(records, out))
    failures.write(out / FAILURES, campaigns.failures(records))
    numbers = campaigns.summary(records)
    if options.json:
        print(outputs.json_text(numbers))
    else:
        _print(numbers)
        say(f"report {out / REPORT}, table {out / TABLE}, failures {out / FAILURES}")
    if options.hunt:
        return OK  # to find failures is what it is for
    return OK if numbers["turned"] == numbers["runs"] else FAILED


def _print(numbers: dict[str, Any]) -> None:
    low, high = numbers["interval_95"]
    say(f"{numbers['turned']} of {numbers['runs']} turned; 95 % interval {100 * low:.1f} to {100 * high:.1f} %")
    for row in numbers["failures"]:
        verdict = row["verdict"] or row["outcome"]
        say(f"  {row['scenario']} seed {row['seed']}: {verdict} in {row['mode'] or '-'}: {row['reason']}")


@contextlib.contextmanager
def _display(wanted: bool) -> Iterator["Callable[[Progress], None]"]:
    """The running count, rate and lower bound: a live line on a terminal, else now and then a line."""
    console = make_console(stderr=True)
    begun, counted, last = time.monotonic(), None, 0.0

    def words(progress: "Progress") -> str:
        nonlocal counted
        if counted is None:
            counted = progress.done  # there already
        rate = 60 * (progress.done - counted) / max(time.monotonic() - begun, 1e-9)
        bound = f", at least {100 * progress.low:.1f} % at 95 %" if progress.done else ""
        return f"{progress.done} of {progress.total}: {progress.turned} turned{bound}; {rate:.1f} runs a minute"

    if not wanted or not console.is_terminal:

        def line(progress: "Progress") -> None:
            nonlocal last
            if wanted and (time.monotonic() - last > 60 or progress.done == progress.total):
                last = time.monotonic()
                complain(words(progress))

        yield line
        return
    with console.status("starting") as status:
        yield lambda progress: status.update(words(progress))


def compare(options: argparse.Namespace) -> int:
    from valve_drake.campaign import comparison

    if len(options.scenario) != 3:
        raise ConfigError(f"campaign compare takes the folders of two campaigns, got {len(options.scenario) - 1}")
    others = vars(options).keys() - {"scenario", "json", "command", "default"}
    for name in sorted(name for name in others if getattr(options, name) != options.default(name)):
        raise ConfigError(f"campaign compare takes no --{name.replace('_', '-')}: its runs have been made")
    found = comparison.compare(*map(Path, options.scenario[1:]))
    if options.json:
        print(outputs.json_text(found))
        return OK
    pairs = found["pairs"]
    say(f"{pairs} seeds in both: {found['turned_a']} turned in A, {found['turned_b']} in B")
    say(f"only B turned {found['better']}, only A {found['worse']}; McNemar's exact p = {found['p']:.3g}")
    more = "" if found["more"] is None else f": some {found['more']} more runs would tell at the present rates"
    say(f"B is {found['verdict']}{more}" if found["verdict"] != "cannot tell yet" else f"cannot tell yet{more}")
    step = found["step"]
    if step is None:
        say("the sequential test STEP is not installed: pip install 'valve-drake[step]'")
    else:
        told = f"B is {step['verdict']}, told by {step['pairs']} runs"
        if step["verdict"] == "cannot tell yet":
            told = "cannot tell yet"
            told += "" if step["more"] is None else f": some {step['more']} more runs would tell at the present rates"
        say(f"STEP, which may be asked after every run: {told}")
    for name, row in found["differences"].items():
        say(f"  {name}: B minus A {row['mean']:+.4g}, 95 % interval {row['low']:+.4g} to {row['high']:+.4g}")
    return OK


def runs(options: argparse.Namespace) -> int:
    from valve_drake.campaign import campaign as campaigns
    from valve_drake.campaign import report

    if not os.path.isdir(options.folder):
        raise ConfigError(f"runs: {str(options.folder)!r} is not a folder")
    html = options.html or (None if options.json else options.folder / REPORT)
    if html is not None:
        html = outputs.check(html, "--html", (), report.was_made)
    is_campaign = os.path.lexists(options.folder / campaigns.PLAN)
    records = campaigns.read_all(options.folder) if is_campaign else report.records_of_logs(options.folder)
    if html is not None:
        outputs.write(html, report.page(records, html.parent, options.folder))
    if options.json:
        print(outputs.json_text(campaigns.summary(records) | {"html": str(html) if html else None}))
    else:
        _print(campaigns.summary(records))
        say(f"page {html}")
    return FAILED if any(record["outcome"] == "unreadable" for record in records) else OK
