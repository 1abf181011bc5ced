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

from valve_drake.checks import ConfigError, OperationFailed

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
    except OperationFailed as error:
        print(f"valve-drake: {error}", file=sys.stderr)
        return FAILED
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
    p.add_argument("--lockstep", action="store_true", help="station `hardware`: in lock-step with a twin that is, too")
    p.add_argument("--live", action="store_true", help="serve the log's topics to Foxglove, on this machine only")
    p.add_argument("--live-port", type=int, default=8765, metavar="PORT", help="of --live (default: 8765)")
    p.add_argument("--no-html", action="store_true", help="no 3D recording beside the log")
    p.add_argument("--no-truth", action="store_true", help="leave the simulation's truth out of the log")
    p.add_argument("--duration", type=float, metavar="SECONDS", help="end after this simulated time")
    p.add_argument("--profile", action="store_true", help="print the shares of physics, rendering, stages and logging")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=_run)

    p = commands.add_parser("twin", help="the simulated robot as a process of its own, for station `hardware`")
    p.add_argument("scenario", nargs="?", help="the one that is run (default: hardware.scenario.yaml)")
    p.add_argument("--seed", type=int, help="draws its world, noise, errors and the chances of its faults")
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="overrides any key of the scenario")
    p.add_argument("--lockstep", action="store_true", help="waits for the program's every tick, instead of the clock")
    p.add_argument("--duration", type=float, metavar="SECONDS", help="end after this time (default: with the program)")
    p.add_argument("--json", action="store_true", help="print one JSON object at the end, with the valve's true angle")
    p.set_defaults(command=_twin)

    p = commands.add_parser("draw", help="wiring list and drawing of a scenario's diagram")
    p.add_argument("scenario", nargs="?")
    p.add_argument("--out", type=Path, help="folder (default: diagrams/)")
    p.set_defaults(command=_draw)

    p = commands.add_parser("teach", help="reference images and image Jacobians of the hands")
    p.add_argument("scenario", nargs="?")
    p.add_argument("--out", type=Path, help="folder (default: models/taught/)")
    p.set_defaults(command=_teach)

    p = commands.add_parser("review", help="one page of a log: what happened, is it whole; or of two, compared")
    p.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="one log, or two to compare")
    p.add_argument("--html", type=Path, metavar="FILE", help="the page (default: LOG with .review.html, beside it)")
    p.add_argument("--json", action="store_true", help="print the same facts as one JSON object; no page unless --html")
    p.add_argument("--export", choices=("csv", "npz"), help="write --topic as a table instead")
    p.add_argument("--topic", help="what to export")
    p.add_argument("--out", type=Path, metavar="FILE", help="of the export (default: beside the log)")
    p.set_defaults(command=_review)

    p = commands.add_parser("experiment", help="the paper's tables, the bound, robustness, on drawn images")
    p.add_argument("name", choices=("table2", "table3", "bound", "robustness"))
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--trials", type=int, metavar="N", help="images a row (table2: runs of six poses)")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.add_argument("--out", type=Path, metavar="DIR", help="write NAME.json there, and the plot of the bound")
    p.set_defaults(command=_experiment)

    p = commands.add_parser("replay", help="the same blocks on what a log holds: is all as it was recorded?")
    p.add_argument("log", type=Path)
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="another value, on the old data")
    p.add_argument("--log", type=Path, dest="copy", metavar="FILE", help="writes what the replay makes as a log")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=_replay)

    p = commands.add_parser("recover", help="a whole log from a truncated or damaged one")
    p.add_argument("log", type=Path)
    p.add_argument("-o", "--out", type=Path, required=True)
    p.set_defaults(command=_recover)

    p = commands.add_parser("estimate", help="the pose of a red rectangle in one photograph, or a stereo pair")
    p.add_argument("left", type=Path, metavar="LEFT")
    p.add_argument("right", type=Path, metavar="RIGHT", nargs="?")
    p.add_argument(
        "--calibration", type=Path, required=True, action="append", metavar="FILE", help="twice for a ROS stereo pair"
    )
    p.add_argument("--marker", required=True, metavar="98x100", help="width and height of the rectangle [mm]")
    p.add_argument("--method", choices=("refined", "paper"), default="refined")
    p.add_argument("--camera", choices=("left", "right"), default="left", help="of a head, that a single image is from")
    p.add_argument("--draw", type=Path, metavar="FILE", help="the photographs with all that was seen")
    p.add_argument("--json", action="store_true", help="print one JSON object")
    p.set_defaults(command=_estimate)

    kinds = commands.add_parser("calibrate", help="cameras from images of a chessboard").add_subparsers(
        required=True, metavar="WHAT", parser_class=_Parser
    )
    for name, what in (
        ("intrinsics", "one camera"),
        ("stereo", "the stereo head"),
        ("hand-eye", "a camera on the hand, or beside the robot"),
    ):
        p = kinds.add_parser(name, help=what)
        for key in ("--left", "--right") if name == "stereo" else ("--images",):
            p.add_argument(key, required=True, nargs="+", metavar="GLOB")
        if name == "hand-eye":
            p.add_argument("--poses", type=Path, required=True, help='JSON: [{"image": name, "X_BE": 4x4, m}, ...]')
            p.add_argument("--camera", type=Path, metavar="FILE", help="its lens (default: from the same images)")
            p.add_argument("--eye-to-hand", action="store_true", help="the camera stands, the hand holds the board")
        else:
            p.add_argument("--distances", metavar="MM,...", help="of boards that all face the camera, in order")
            p.add_argument("--lens", choices=("opencv", "paper", "best"), default="opencv", help="what to write")
        p.add_argument("--board", required=True, metavar="9x6", help="inner corners, x by y")
        p.add_argument("--pitch", required=True, metavar="25x25", help="of the corners, x by y [mm]")
        p.add_argument("--out", type=Path, required=True, metavar="FILE", help="the calibration, YAML")
        p.add_argument("--html", type=Path, metavar="FILE", help="the report as a page")
        p.add_argument("--json", action="store_true", help="print the report as one JSON object")
        p.set_defaults(command=_calibrate, kind=name)
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

    overrides = _overrides(options)
    if options.request:
        overrides.append(f"command={options.request}")
    scenario = scenarios.load(options.scenario, overrides)
    log = options.log or Path("logs") / f"run-{scenario.seed}.mcap"
    html = None if options.no_html or scenario.station == "hardware" else log.with_suffix(".html")
    with _stopper() as stop, _live(options) as live, _display(not options.json) as show:
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


def _overrides(options: argparse.Namespace) -> list[str]:
    """--set, --seed and --lockstep as overrides; --duration is checked."""
    overrides = list(options.set)
    if options.seed is not None:
        overrides.append(f"seed={options.seed}")
    if options.lockstep:
        overrides.append("hardware.lockstep=true")
    if options.duration is not None and not (math.isfinite(options.duration) and options.duration > 0):
        raise ConfigError(f"--duration must be a finite number > 0, got {options.duration}")
    return overrides


def _twin(options: argparse.Namespace) -> int:
    _check_rendering()
    from valve_drake import scenario as scenarios
    from valve_drake.rehearsal import run_twin

    scenario = scenarios.load(options.scenario or "hardware.scenario.yaml", _overrides(options))
    with _stopper() as stop:
        result = run_twin(scenario, duration=options.duration, stop=stop)
    if options.json:
        print(json.dumps(result.as_json()))
    else:
        turned = math.degrees(result.valve_end - result.valve_start)
        print(f"{result.time:.1f} s; the valve was turned by {turned:.2f} deg")
    return OK


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
def _live(options: argparse.Namespace) -> Iterator[object | None]:
    """The live view, if it is asked for."""
    if not options.live:
        yield None
        return
    from valve_drake.recording.live import LiveView

    with LiveView(options.live_port) as view:
        print(f"live at ws://127.0.0.1:{view.port} (Foxglove: open connection)", file=sys.stderr)
        yield view


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

    console = Console(highlight=False)
    s = result.summary
    _print_summary(console, s)
    factor = s.sim_time_s / max(result.wall_time, 1e-9)
    console.print(f"{s.sim_time_s:.1f} s simulated in {result.wall_time:.1f} s (x{factor:.2f} real time)")
    console.print(f"log {result.log}" + (f"  3D recording {result.html}" if result.html else ""))


def _print_summary(console: object, s: object) -> None:
    """What happened in a run: a line for each mode, the verdict, angles and forces."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("mode", "start [s]", "time [s]", "why", box=None, header_style="dim")
    for span in s.spans:
        retry = f" (retry {span.attempt})" if span.attempt else ""
        table.add_row(span.mode + retry, f"{span.start:.2f}", f"{span.duration:.2f}", escape(span.reason))
    console.print(table)
    color = "green" if s.outcome == "done" else "red"
    verdict = s.verdict or "-"
    console.print(f"[bold {color}]{s.outcome or 'unfinished'}[/]  verdict [bold]{verdict}[/]  {escape(s.reason)}")
    angles = {"commanded": s.command_rad, "camera": s.angle_camera_rad}
    angles |= {"hands": s.angle_hands_rad, "true": s.angle_true_rad}
    known = [f"{k} {round(math.degrees(v), 2) + 0.0:.2f} deg" for k, v in angles.items() if v is not None]
    if known:
        console.print("turned: " + "  ".join(known))
    if s.turn_peak_hand_force_N:
        console.print(
            f"while turning: peak {s.turn_peak_hand_force_N:.1f} N a hand, mean {s.turn_mean_hand_force_N:.1f} N, "
            f"stem beyond the couple {s.turn_mean_stem_force_N:.1f} N mean"
        )


# ---------------------------------------------------------------- review


def _review(options: argparse.Namespace) -> int:
    from valve_drake.analysis import report

    if len(options.logs) > 2:
        raise ConfigError(f"review takes one log or two, got {len(options.logs)}")
    if options.export or options.topic or options.out:
        return _export(options)
    found = [report.review(log) for log in options.logs]
    if len(found) == 1:
        subject, facts, page, name = found[0], report.facts, report.page, options.logs[0].stem
    else:
        subject, facts, page = report.compare(*found), report.comparison_facts, report.comparison_page
        name = "-".join(log.stem for log in options.logs)
    html = options.html or (None if options.json else options.logs[0].with_name(f"{name}.review.html"))
    if html is not None:
        _keep_apart("--html", html, options.logs)
        try:
            html.write_text(page(subject, html.parent.resolve()), encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{html} cannot be written: {error.strerror}") from None
    if options.json:
        print(json.dumps(facts(subject) | {"html": str(html) if html else None}))
    else:
        _print_review(found, subject)
        print(f"page {html}")
    return OK if all(one.integrity.sound for one in found) else DAMAGED


def _keep_apart(option: str, path: Path, logs: Sequence[Path]) -> None:
    if path.resolve() in [log.resolve() for log in logs]:
        raise ConfigError(f"{option} must be another file than the log, got {path}")


def _print_review(found: list, subject: object) -> None:
    from rich.console import Console

    from valve_drake.analysis.report import parting_values

    console = Console(highlight=False, soft_wrap=True)
    for one in found:
        if len(found) > 1:
            console.print(f"{one.log.path}:", markup=False)
        _print_summary(console, one.summary)
        for line in one.integrity.troubles:
            console.print(f"damaged: {line}", markup=False)
        for row in one.integrity.late[:10]:
            missing = sum(gap.missing for gap in row.gaps)
            console.print(f"gaps: {row.topic} {len(row.gaps)}, {missing} messages missing", markup=False)
        whole = "whole" if one.integrity.sound else "not whole"
        console.print(f"the log is {whole}: {one.integrity.messages} messages, {len(one.integrity.topics)} topics")
    if len(found) == 1:
        return
    first = subject.first
    if first is None:
        word = "[bold green]identical[/]" if subject.sound else "no difference"
        console.print(f"{word}: what both hold is equal to the bit")
        return
    a, b = parting_values(first)
    words = f"{first.field}: {a} and {b}" if first.field else f"only in {found[0 if b is None else 1].log.path}"
    console.print(f"they part at t = {first.time:.6f} s, {first.topic} {words}", markup=False)


def _export(options: argparse.Namespace) -> int:
    from valve_drake.analysis import export
    from valve_drake.recording.reader import LogReader

    if not (options.export and options.topic):
        raise ConfigError("an export wants both --export csv|npz and --topic")
    if len(options.logs) != 1:
        raise ConfigError(f"an export is of one log, got {len(options.logs)}")
    log = LogReader(options.logs[0])
    name = f"{options.logs[0].stem}{options.topic.replace('/', '.')}.{options.export}"
    out = options.out or options.logs[0].with_name(name)
    _keep_apart("--out", out, options.logs)
    count = export.write(log, options.topic, options.export, out)
    if options.json:
        print(json.dumps({"topic": options.topic, "messages": count, "out": str(out), "damage": log.damage}))
    else:
        print(f"{out}: {count} messages of {options.topic}")
        for line in log.damage:
            print(f"  {line}")
    return DAMAGED if log.damage else OK


# ---------------------------------------------------------------- experiment


def _experiment(options: argparse.Namespace) -> int:
    from valve_drake.analysis import experiments

    if options.out and not options.out.is_dir():
        raise ConfigError(f"--out must be a folder, got {options.out}")
    result = experiments.run(options.name, options.seed, options.trials)
    if options.out:
        (options.out / f"{options.name}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
        if options.name == "bound":
            experiments.plot_bound(result, options.out / "estimator_bound.svg")
    if options.json:
        print(json.dumps(result))
    else:
        _print_experiment(result)
    return OK


def _print_experiment(result: dict) -> None:
    from rich.console import Console
    from rich.table import Table

    def shown(value: object) -> str:
        return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)

    console = Console(highlight=False, soft_wrap=True)
    console.width = max(console.width, 140)  # of the table, also in a pipe
    columns = list(dict.fromkeys(key for row in result["rows"] for key in row))
    table = Table(*columns, box=None, header_style="dim")
    for row in result["rows"]:
        table.add_row(*(shown(row.get(key)) for key in columns))
    console.print(f"{result['experiment']}: {result['settings']}", markup=False)
    console.print(table)
    for name, value in result.get("totals", {}).items():
        console.print(f"{name}: {value}", markup=False)


# ---------------------------------------------------------------- replay


def _replay(options: argparse.Namespace) -> int:
    from valve_drake.recording.reader import LogReader
    from valve_drake.recording.writer import LogError
    from valve_drake.runner import replay

    log = LogReader(options.log)
    try:
        with _display(not options.json) as show:
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


# ---------------------------------------------------------------- others


def _draw(options: argparse.Namespace) -> int:
    from valve_drake import drawing, resources
    from valve_drake import scenario as scenarios

    scenario = scenarios.load(options.scenario, ["hardware.lcm_url=memq://"])  # to be looked at, not to speak
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


# ---------------------------------------------------------------- photographs


def _estimate(options: argparse.Namespace) -> int:
    import time

    import numpy as np

    from valve_drake import frames
    from valve_drake.camera.board import parse_pair, read_image
    from valve_drake.camera.calibration_file import load_calibration
    from valve_drake.camera.lens import StereoHead
    from valve_drake.perception.photograph import look

    size = parse_pair(options.marker, "--marker", "98x100 (mm)")
    if not all(5 <= length <= 2000 for length in size):
        raise ConfigError(f"--marker must be two lengths within 5..2000 mm, got {options.marker!r}")
    if len(options.calibration) > 2:
        raise ConfigError(f"--calibration must be one file, or the two of a ROS pair, got {len(options.calibration)}")
    cameras = load_calibration(options.calibration)
    head = isinstance(cameras, StereoHead)
    if options.right is not None and not head:
        raise ConfigError(f"calibration {options.calibration[0]}: of one camera, but there are two images")
    paths = [path for path in (options.left, options.right) if path is not None]
    sides = ["left", "right"] if len(paths) == 2 else [options.camera]
    if len(paths) == 1 and head:
        cameras = getattr(cameras, options.camera)
    images = [np.ascontiguousarray(read_image(path)[:, :, ::-1]) for path in paths]
    for _ in range(2):  # the first look also loads and allocates: the second is what a robot would wait for
        start = time.perf_counter()
        seen = look(images, cameras, (size[0] / 1e3, size[1] / 1e3), options.method)
        took = time.perf_counter() - start
    found = seen.estimate
    corners: dict[str, list | None] = {"left": None, "right": None}
    corners |= {side: None if px is None else px.tolist() for side, px in zip(sides, seen.corners_px)}
    if options.draw:
        from valve_drake.perception.overlay import overlay

        lenses = cameras.lenses() if len(paths) == 2 else [cameras]
        X_CL = [np.eye(3, 4), frames.inverse(cameras.X_LR)] if len(paths) == 2 else [np.eye(3, 4)]
        _write_image(options.draw, overlay(seen, lenses, X_CL, (size[0] / 1e3, size[1] / 1e3)))
    if options.json:
        out = {
            "found": found.found,
            "method": options.method,
            "camera": sides[0],
            "X_CV": found.X_LV.tolist() if found.found else None,
            "covariance": found.covariance.tolist() if found.found else None,
            "corners_px": corners,
            "ambiguity": found.ambiguity if found.found else None,
            "residual_px": found.residual_px if found.found else None,
            "epipolar_px": seen.epipolar_px if len(paths) == 2 and found.found else None,
            "time_ms": 1e3 * took,
            "reason": found.reason,
        }
        print(json.dumps(out))
    elif found.found:
        x, y, z = 1e3 * found.X_LV[:, 3]
        sigma = np.sqrt(np.diag(found.covariance))
        print(f"found by {options.method} in the {sides[0]} camera's frame, {1e3 * took:.1f} ms")
        print(f"position  {x:.2f} {y:.2f} {z:.2f} mm  +- {' '.join(f'{1e3 * s:.2f}' for s in sigma[3:])}")
        turn, spread = np.degrees([frames.rotation_vector(found.X_LV[:, :3]), sigma[:3]])
        print(f"rotation  {' '.join(f'{a:.3f}' for a in turn)} deg  +- {' '.join(f'{s:.3f}' for s in spread)}")
        print(f"residual  {found.residual_px:.2f} px, mirrored pose worse by chi2 {found.ambiguity:.1f}")
    else:
        print(f"not found: {found.reason}")
        for side, one in zip(sides, seen.seen):
            for candidate in one.candidates:
                u, v = candidate.center
                print(f"  {side} ({u:.0f}, {v:.0f}) {candidate.area:.0f} px^2: {candidate.rejected or 'may be'}")
    return OK if found.found else FAILED


def _calibrate(options: argparse.Namespace) -> int:
    from valve_drake.camera import calibration_report as reports
    from valve_drake.camera.board import parse_board

    board = parse_board(options.board, options.pitch)
    if options.kind == "hand-eye":
        report = reports.hand_eye(
            options.images, options.poses, board, options.out, options.camera, options.eye_to_hand
        )
    else:
        distances = None if options.distances is None else _millimetres(options.distances)
        if options.kind == "stereo":
            report = reports.stereo(options.left, options.right, board, options.out, options.lens, distances)
        else:
            report = reports.intrinsics(options.images, board, options.out, options.lens, distances)
    if options.html:
        try:
            options.html.write_text(report.page, encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"--html {options.html}: cannot be written ({type(error).__name__})") from error
    print(json.dumps(report.numbers) if options.json else "\n".join(report.lines()))
    return OK


def _millimetres(text: str) -> list[float]:
    try:
        values = [float(part) / 1e3 for part in text.split(",")]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) and value > 0 for value in values):
        raise ConfigError(f"--distances must be numbers > 0 in mm, like 600,700,800, got {text!r}")
    return values


def _write_image(path: Path, image: object) -> None:
    import cv2

    try:
        ok, data = cv2.imencode(path.suffix, image)
        if ok:
            path.write_bytes(data.tobytes())
    except cv2.error:
        ok = False
    except OSError as error:
        raise ConfigError(f"--draw {path}: cannot be written ({type(error).__name__})") from error
    if not ok:
        raise ConfigError(f"--draw {path}: unknown kind of image, name it .png or .jpg")
