"""The commands. Exit 0 success, 1 the operation failed, 2 bad input or scenario, 3 damaged log; errors are one line."""

import argparse
import contextlib
import json
import math
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn

from valve_drake.checks import ConfigError

OK, FAILED, BAD_INPUT, DAMAGED = 0, 1, 2, 3


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ConfigError(message)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command -> exit code."""
    try:
        options = _parser().parse_args(arguments)
        return options.command(options)
    except ConfigError as error:
        print(f"valve-drake: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("valve-drake: interrupted", file=sys.stderr)
        return FAILED


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="valve-drake", description="A robot finds, grasps and turns a valve by colour and shape.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    p = commands.add_parser("run", help="the whole work, from search to the turned valve")
    p.add_argument("scenario", nargs="?", help="a file, or a name in diagrams/ (default: simulated.scenario.yaml)")
    p.add_argument("--seed", type=int, help="draws the scenario's distributions, noise and errors")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="overrides any key of the scenario")
    p.add_argument("--command", choices=("open", "close"), dest="request", help="what to do with the valve")
    p.add_argument("--log", type=Path, help="the MCAP log (default: logs/run-<seed>.mcap)")
    p.add_argument("--meshcat", action="store_true", help="live 3D view on localhost")
    p.add_argument("--no-html", action="store_true", help="no 3D recording beside the log")
    p.add_argument("--no-truth", action="store_true", help="leave the simulation's truth out of the log")
    p.add_argument("--duration", type=float, metavar="SECONDS", help="end after this simulated time")
    p.add_argument("--profile", action="store_true", help="print the shares of physics, rendering, stages and logging")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=_run)

    p = commands.add_parser("draw", help="wiring list and drawing of a scenario's diagram")
    p.add_argument("scenario", nargs="?")
    p.add_argument("--out", type=Path, help="folder (default: diagrams/)")
    p.set_defaults(command=_draw)

    p = commands.add_parser("teach", help="reference images and image Jacobians of the hands")
    p.add_argument("scenario", nargs="?")
    p.add_argument("--out", type=Path, help="folder (default: models/taught/)")
    p.set_defaults(command=_teach)

    p = commands.add_parser("recover", help="a whole log from a truncated or damaged one")
    p.add_argument("log", type=Path)
    p.add_argument("-o", "--out", type=Path, required=True)
    p.set_defaults(command=_recover)
    return parser


def _check_rendering() -> None:
    """Cameras are rendered through EGL; its absence would otherwise be a long trace from deep inside."""
    import ctypes

    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        raise ConfigError("libEGL.so.1 is missing: install it (Debian, Ubuntu: apt-get install libegl1)") from None


# ---------------------------------------------------------------- run


def _run(options: argparse.Namespace) -> int:
    _check_rendering()
    from valve_drake import scenario as scenarios
    from valve_drake.runner import run

    overrides = list(options.set)
    if options.seed is not None:
        overrides.append(f"seed={options.seed}")
    if options.request:
        overrides.append(f"command={options.request}")
    if options.duration is not None and not (math.isfinite(options.duration) and options.duration > 0):
        raise ConfigError(f"--duration must be a finite number > 0, got {options.duration}")
    scenario = scenarios.load(options.scenario, overrides)
    log = options.log or Path("logs") / f"run-{scenario.seed}.mcap"
    html = None if options.no_html else log.with_suffix(".html")
    with _stopper() as stop, _display(not options.json) as show:
        result = run(
            scenario,
            log,
            html=html,
            meshcat_port=7000 if options.meshcat else None,
            truth=not options.no_truth,
            duration=options.duration,
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
    if result.log_error:
        print(f"valve-drake: {result.log_error}", file=sys.stderr)
        return FAILED
    if options.duration is not None:
        return OK
    return OK if result.summary.outcome == "done" else FAILED


@contextlib.contextmanager
def _stopper() -> Iterator[Callable[[], bool]]:
    """Ctrl-C once is the operator's stop (the robot lets go and stands still), twice breaks off."""
    count = [0]

    def handle(*_: object) -> None:
        count[0] += 1
        if count[0] > 1:
            raise KeyboardInterrupt

    old = signal.signal(signal.SIGINT, handle)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # leaves through the log's context manager
    try:
        yield lambda: count[0] > 0
    finally:
        signal.signal(signal.SIGINT, old)


@contextlib.contextmanager
def _display(wanted: bool) -> Iterator[Callable]:
    """A line that shows mode, simulated time and real-time factor, on a terminal only."""
    from rich.console import Console

    console = Console(stderr=True)
    if not wanted or not console.is_terminal:
        yield lambda progress: None
        return
    with console.status("starting") as status:
        last = [""]

        def show(progress: object) -> None:
            mode = progress.mode
            factor = progress.sim_time / max(progress.wall_time, 1e-9)
            status.update(f"[bold]{mode.mode}[/]  {progress.sim_time:6.2f} s  x{factor:.2f} real time")
            if mode.mode != last[0]:
                console.print(f"{mode.since:7.2f} s  [bold]{mode.mode:<15}[/] {mode.reason}", highlight=False)
                last[0] = mode.mode

        yield show


def _print_result(result: object) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    s = result.summary
    table = Table("mode", "start [s]", "time [s]", "why", box=None, header_style="dim")
    for span in s.spans:
        table.add_row(span.mode, f"{span.start:.2f}", f"{span.end - span.start:.2f}", span.reason)
    console.print(table)
    color = "green" if s.outcome == "done" else "red"
    console.print(f"[bold {color}]{s.outcome or 'unfinished'}[/]  verdict [bold]{s.verdict or '-'}[/]  {s.reason}")
    angles = {"commanded": s.command_rad, "camera": s.angle_camera_rad, "hands": s.angle_hands_rad, "true": s.angle_true_rad}
    console.print("turned: " + "  ".join(f"{k} {math.degrees(v):.2f} deg" for k, v in angles.items() if v is not None))
    if s.turn_peak_hand_force_N:
        console.print(
            f"while turning: peak {s.turn_peak_hand_force_N:.1f} N a hand, mean {s.turn_mean_hand_force_N:.1f} N, "
            f"stem beyond the couple {s.turn_mean_stem_force_N:.1f} N mean"
        )
    factor = s.sim_time_s / max(result.wall_time, 1e-9)
    console.print(f"{s.sim_time_s:.1f} s simulated in {result.wall_time:.1f} s (x{factor:.2f} real time)")
    console.print(f"log {result.log}" + (f"  3D recording {result.html}" if result.html else ""))


# ---------------------------------------------------------------- others


def _draw(options: argparse.Namespace) -> int:
    from valve_drake import drawing, resources
    from valve_drake import scenario as scenarios

    scenario = scenarios.load(options.scenario)
    name = Path(options.scenario or scenarios.DEFAULT).name.removesuffix(".scenario.yaml")
    for path in drawing.write(scenario, name, options.out or resources.diagrams()):
        print(path)
    return OK


def _teach(options: argparse.Namespace) -> int:
    _check_rendering()
    from valve_drake import resources, teaching
    from valve_drake import scenario as scenarios

    folder = options.out or resources.models() / "taught"
    teaching.write(scenarios.load(options.scenario), folder)
    print(folder / "hands.yaml")
    return OK


def _recover(options: argparse.Namespace) -> int:
    from valve_drake.recording.reader import recover

    source = recover(options.log, options.out)
    count = sum(topic.count for topic in source.topics.values())
    print(f"{options.out}: {count} messages up to {source.end:.3f} s")
    for line in source.damage:
        print(f"  {line}")
    return DAMAGED if source.damage else OK
