"""What several commands share: exit codes, options, the operator's stop, the live line, the table of a run."""

import argparse
import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn, TypeAlias

from valve_drake import outputs
from valve_drake.checks import ConfigError, require
from valve_drake.console import console as make_console
from valve_drake.console import styled

if TYPE_CHECKING:
    from rich.console import Console

    from valve_drake.analysis.metrics import Summary
    from valve_drake.runner import Progress

OK, FAILED, BAD_INPUT, DAMAGED = 0, 1, 2, 3  # exit codes
REFRESH = 0.1  # of the live line; raise it for a slow terminal [s]
ECHO = 0.3  # a signal repeated within this time counts once: a closing terminal and `timeout` send two [s]
Subcommands: TypeAlias = "argparse._SubParsersAction[Parser]"


class Parser(argparse.ArgumentParser):
    """Bad arguments are bad input like any other: one line, exit code 2."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(message)


def check_rendering() -> None:
    """Cameras are rendered through EGL; its absence would otherwise be a long trace from deep inside."""
    import ctypes

    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        raise ConfigError("libEGL.so.1 is missing: install it (Debian, Ubuntu: apt-get install libegl1)") from None


def scenario_overrides(options: argparse.Namespace) -> list[str]:
    """--set, --seed and --lockstep as overrides; --duration is checked."""
    overrides = list(options.set)
    if options.seed is not None:
        overrides.append(f"seed={options.seed}")
    if options.lockstep:
        overrides.append("hardware.lockstep=true")
    if options.duration is not None and not (math.isfinite(options.duration) and options.duration > 0):
        raise ConfigError(f"--duration must be a finite number > 0, got {options.duration}")
    return overrides


def check_log(
    path: Path, option: str, overwrite: bool, inputs: Iterable[Path] = (), companions: Sequence[str] = ()
) -> Path:
    """The log to write for a name that the user gave: FILE.mcap, so that what lies beside it has another suffix.

    companions: suffixes of files that will be written beside it. Raises ConfigError as outputs.check does.
    """
    inputs = tuple(inputs)
    log = outputs.check(path, option, inputs, overwrite=overwrite, new_folders=True)
    require(log.suffix == ".mcap", option, "a file name that ends in .mcap", path)
    for suffix in companions:
        outputs.check(log.with_suffix(suffix), f"{option} with {suffix}", inputs, overwrite=overwrite, new_folders=True)
    return log


class Interrupted(KeyboardInterrupt):
    """A signal ends the command; what is open is completed on the way out."""

    def __init__(self, number: int):
        super().__init__(number)
        self.exit_code = FAILED if number == signal.SIGINT else 128 + number


@contextlib.contextmanager
def signals(handle: Callable[[int], None]) -> Iterator[None]:
    """SIGINT, SIGTERM and SIGHUP call `handle` with their number; but not SIGHUP where `nohup` has turned it off."""
    if threading.current_thread() is not threading.main_thread():  # Python hands signals to that one only
        yield
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    old = {number: signal.signal(number, lambda number, frame: handle(number)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


def break_off(number: int) -> None:
    """What a signal does by default: it ends the command, but through its context managers: no half file stays."""
    raise Interrupted(number)


@contextlib.contextmanager
def stopper() -> Iterator[Callable[[], bool]]:
    """Ctrl-C, SIGTERM or SIGHUP once is the operator's stop (the robot lets go and stands still), twice breaks off.

    Before somebody has looked whether a stop is asked for, the first signal breaks off: nobody would heed it.
    """
    looked = broken = False
    first: float | None = None  # signal, when [s]

    def handle(number: int) -> None:
        nonlocal first, broken
        now = time.monotonic()
        if broken or (first is not None and now - first < ECHO):
            return
        again, first = first is not None, first or now
        if again or not looked:
            broken = True  # only once: nothing must interrupt the log's completion
            raise Interrupted(number)

    def stop() -> bool:
        nonlocal looked
        looked = True
        return first is not None

    with signals(handle):
        yield stop


@contextlib.contextmanager
def display(wanted: bool) -> Iterator[Callable[["Progress"], None]]:
    """A line that shows mode, simulated time and real-time factor, on a terminal only."""
    console = make_console(stderr=True)
    if not wanted or not console.is_terminal:
        yield lambda progress: None
        return
    from rich.live import Live
    from rich.spinner import Spinner

    spinner = Spinner("dots", "starting")
    # Without rich's thread, beside which this process could not be copied (beside.py).
    with Live(spinner, console=console, auto_refresh=False, transient=True) as live:
        mode, shown = "", 0.0

        def show(progress: "Progress") -> None:
            nonlocal mode, shown
            if progress.mode.mode != mode:
                mode = progress.mode.mode
                since, reason = f"{progress.mode.since:7.2f} s  ", f" {progress.mode.reason}"
                console.print(styled(since, (f"{mode:<15}", "bold"), reason))
            now = time.monotonic()
            if now - shown > REFRESH:
                factor = progress.sim_time / max(progress.wall_time, 1e-9)
                times = f"  {progress.sim_time:6.2f} s  x{factor:.2f} real time"
                spinner.update(text=styled((mode, "bold"), times))
                live.refresh()
                shown = now

        yield show


def print_summary(console: "Console", s: "Summary") -> None:
    """What happened in a run: a line for each mode, the verdict, angles and forces."""
    from rich.table import Table

    table = Table("mode", "start [s]", "time [s]", "why", box=None, header_style="dim")
    for span in s.spans:
        retry = f" (retry {span.attempt})" if span.attempt else ""
        table.add_row(span.mode + retry, f"{span.start:.2f}", f"{span.duration:.2f}", span.reason)
    console.print(table)
    color = "green" if s.outcome == "done" else "red"
    verdict = s.verdict or "-"
    outcome = (s.outcome or "unfinished", f"bold {color}")
    console.print(styled(outcome, "  verdict ", (verdict, "bold"), f"  {s.reason}"))
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
    if s.contact_honesty is not None and s.slips is not None:
        held = ", ".join(f"{side} {100 * share:.1f} %" for side, share in s.contact_honesty.items())
        console.print(
            f"held by both pads, of the valve's way: {held}; slips {sum(s.slips.values())}, "
            f"internal force at most {s.peak_internal_force_N or 0.0:.1f} N"
        )
    for found in s.collided:
        console.print(
            styled(("collision", "red"), f" {found.bodies} at {found.time_s:.2f} s, {found.peak_force_N:.1f} N at most")
        )
