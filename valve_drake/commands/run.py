"""`valve-drake run`: the whole work, from search to the turned valve."""

import argparse
import contextlib
import dataclasses as dc
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from valve_drake import outputs
from valve_drake.checks import OperationFailed, require_in
from valve_drake.commands.common import (
    FAILED,
    OK,
    Subcommands,
    check_log,
    check_rendering,
    display,
    print_summary,
    scenario_overrides,
    stopper,
)
from valve_drake.console import complain, console, say

if TYPE_CHECKING:
    from valve_drake import runner
    from valve_drake.profiling import Spent
    from valve_drake.recording.recorder_system import Sink


def add(commands: Subcommands) -> None:
    p = commands.add_parser("run", help="the whole work, from search to the turned valve")
    p.add_argument("scenario", nargs="?", help="a file, or a name in diagrams/ (default: simulated.scenario.yaml)")
    p.add_argument("--seed", type=int, help="draws the scenario's distributions, noise and errors")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="overrides any key of the scenario")
    p.add_argument("--command", choices=("open", "close"), dest="request", help="what to do with the valve")
    p.add_argument("--log", type=Path, metavar="FILE.mcap", help="the log (default: logs/run-<seed>.mcap, or the next)")
    p.add_argument("--overwrite", action="store_true", help="--log may exist, and what lies beside it: it is replaced")
    p.add_argument("--meshcat", action="store_true", help="live 3D view, on this machine only")
    p.add_argument("--operator", action="store_true", help="waits for an operator's words: `valve-drake operator`")
    p.add_argument("--lockstep", action="store_true", help="station `hardware`: in lock-step with a twin that is, too")
    p.add_argument("--live", action="store_true", help="serve the log's topics to Foxglove, on this machine only")
    p.add_argument(
        "--live-port", type=int, default=8765, metavar="PORT", help="port for --live (default: 8765; 0: any)"
    )
    p.add_argument("--no-html", action="store_true", help="no 3D recording beside the log")
    p.add_argument("--no-truth", action="store_true", help="leave the simulation's truth out of the log")
    p.add_argument("--duration", type=float, metavar="SECONDS", help="end after this simulated time")
    p.add_argument("--profile", action="store_true", help="print where the processor time went")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=command)


def command(options: argparse.Namespace) -> int:
    check_rendering()
    from valve_drake import scenario as scenarios
    from valve_drake.runner import run

    overrides = scenario_overrides(options)
    if options.request:
        overrides.append(f"command={options.request}")
    if options.operator:
        overrides.append("operator_channel.wire=lcm")
    require_in(options.live_port, 0, 65535, "--live-port")
    scenario = scenarios.load(options.scenario, overrides)
    recording = not options.no_html and scenario.station != "hardware"
    if options.log is None:
        log = Path("logs") / f"run-{scenario.seed}.mcap"
    else:
        names = (options.scenario, scenario.robot, scenario.head_calibration, scenario.taught)
        inputs = [Path(name) for name in names if name]
        companions = (".json", ".html") if recording else (".json",)
        log = check_log(options.log, "--log", options.overwrite, inputs, companions)
    imports = time.process_time()
    with stopper() as stop, _live(options) as live, display(not options.json) as show:
        result = run(
            scenario,
            log,
            overwrite=options.log is not None and (options.overwrite or os.path.lexists(log)),  # it was checked
            recording=recording,
            meshcat=options.meshcat,
            truth=not options.no_truth,
            duration=options.duration,
            live=live,
            show=show,
            say=complain,
            stop=stop,
        )
    result = dc.replace(result, spent=dc.replace(result.spent, imports=imports))
    numbers = result.as_json()
    troubles = [*result.troubles]
    try:
        outputs.write(result.name.with_suffix(".json"), outputs.json_text(numbers, indent=1) + "\n")
    except OperationFailed as error:
        if not result.log_error:  # else the disk has been complained of
            troubles.append(str(error))
    if options.json:
        print(outputs.json_text(numbers))
    else:
        _print_result(result)
    if options.profile and not options.json:
        _print_spent(result.spent)
    for line in troubles:
        complain(line)
    cut_short = options.duration is not None and not result.summary.outcome
    ends = ("done", "stopped") if scenario.operator_channel.wire != "none" else ("done",)  # an operator's end is a stop
    good = (cut_short or result.summary.outcome in ends) and not (troubles or result.log_error)
    return OK if good else FAILED


@contextlib.contextmanager
def _live(options: argparse.Namespace) -> Iterator["Sink | None"]:
    """The live view, if it is asked for."""
    if not options.live:
        yield None
        return
    from valve_drake.recording.live import LiveView

    with LiveView(options.live_port) as view:
        complain(f"live at ws://127.0.0.1:{view.port} (Foxglove: open connection)")
        yield view


def _print_result(result: "runner.Result") -> None:
    s = result.summary
    print_summary(console(), s)
    factor = s.sim_time_s / max(result.wall_time, 1e-9)
    say(f"{s.sim_time_s:.1f} s simulated in {result.wall_time:.1f} s (x{factor:.2f} real time)")
    if result.log_error:
        say("these numbers are of what was logged; the verdict is the run's")
    if result.log is not None:
        say(f"log {result.log}" + (f"  3D recording {result.html}" if result.html else ""))


def _print_spent(spent: "Spent") -> None:
    """Processor seconds, the dearest first; below, those of the stages block by block."""
    for name, seconds in sorted(spent.parts().items(), key=lambda item: -item[1]):
        print(f"{seconds:9.3f} s  {100 * seconds / spent.total:5.1f} %  {name}")
    print(f"{spent.total:9.3f} s of processor time; besides, {spent.waited:.2f} s of waiting for images")
    for block, seconds in sorted(spent.stages.items(), key=lambda item: -item[1]):
        print(f"{seconds:9.3f} s  {100 * seconds / spent.total:5.1f} %  stage {block}")
