"""`valve-drake run`: the whole work, from search to the turned valve."""

import argparse
import contextlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

from valve_drake.commands.common import (
    FAILED,
    OK,
    Subcommands,
    check_rendering,
    display,
    print_summary,
    scenario_overrides,
    stopper,
)


def add(commands: Subcommands) -> None:
    p = commands.add_parser("run", help="the whole work, from search to the turned valve")
    p.add_argument("scenario", nargs="?", help="a file, or a name in diagrams/ (default: simulated.scenario.yaml)")
    p.add_argument("--seed", type=int, help="draws the scenario's distributions, noise and errors")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="overrides any key of the scenario")
    p.add_argument("--command", choices=("open", "close"), dest="request", help="what to do with the valve")
    p.add_argument("--log", type=Path, help="the MCAP log (default: logs/run-<seed>.mcap)")
    p.add_argument("--meshcat", action="store_true", help="live 3D view on localhost")
    p.add_argument("--lockstep", action="store_true", help="station `hardware`: in lock-step with a twin that is, too")
    p.add_argument("--live", action="store_true", help="serve the log's topics to Foxglove, on this machine only")
    p.add_argument("--live-port", type=int, default=8765, metavar="PORT", help="of --live (default: 8765)")
    p.add_argument("--no-html", action="store_true", help="no 3D recording beside the log")
    p.add_argument("--no-truth", action="store_true", help="leave the simulation's truth out of the log")
    p.add_argument("--duration", type=float, metavar="SECONDS", help="end after this simulated time")
    p.add_argument("--profile", action="store_true", help="print the shares of physics, rendering, stages and logging")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    check_rendering()
    from valve_drake import scenario as scenarios
    from valve_drake.runner import run

    overrides = scenario_overrides(options)
    if options.request:
        overrides.append(f"command={options.request}")
    scenario = scenarios.load(options.scenario, overrides)
    log = options.log or Path("logs") / f"run-{scenario.seed}.mcap"
    html = None if options.no_html or scenario.station == "hardware" else log.with_suffix(".html")
    with stopper() as stop, _live(options) as live, display(not options.json) as show:
        result = run(
            scenario,
            log,
            html=html,
            meshcat_port=7000 if options.meshcat else None,
            truth=not options.no_truth,
            duration=options.duration,
            live=live,
            show=show,
            stop=stop,
        )
    log.with_suffix(".json").write_text(json.dumps(result.as_json(), indent=1) + "\n", encoding="utf-8")
    if options.json:
        print(json.dumps(result.as_json()))
    else:
        _print_result(result)
    if options.profile and not options.json:
        for kind, share in sorted(result.shares.items(), key=lambda item: -item[1]):
            print(f"{kind:>10}  {100 * share:5.1f} %  {share * result.wall_time:6.2f} s")
        print(f"{result.beside:.2f} s of rendering on other processors; above, what the run waited for")
    if result.log_error:
        print(f"valve-drake: {result.log_error}", file=sys.stderr)
        return FAILED
    if options.duration is not None:
        return OK
    return OK if result.summary.outcome == "done" else FAILED


@contextlib.contextmanager
def _live(options: argparse.Namespace) -> Iterator[object | None]:
    """The live view, if it is asked for."""
    if not options.live:
        yield None
        return
    from valve_drake.recording.live import LiveView

    with LiveView(options.live_port) as view:
        print(f"live at ws://127.0.0.1:{view.port} (Foxglove: open connection)", file=sys.stderr)
        yield view


def _print_result(result: object) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    s = result.summary
    print_summary(console, s)
    factor = s.sim_time_s / max(result.wall_time, 1e-9)
    console.print(f"{s.sim_time_s:.1f} s simulated in {result.wall_time:.1f} s (x{factor:.2f} real time)")
    console.print(f"log {result.log}" + (f"  3D recording {result.html}" if result.html else ""))
