"""One trial: a run of a scenario with a seed in a fresh process, and the record of what it came to.

A record is a plain JSON object. What depends on the machine stands in its `times`, so that two records of one program,
scenario and seed are equal but for that.
"""

import contextlib
import dataclasses as dc
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, TypeAlias

from valve_drake import outputs
from valve_drake.analysis.metrics import Summary, figures
from valve_drake.recording.active import is_being_written
from valve_drake.recording.container import active

Record: TypeAlias = dict[str, Any]

PROGRAM = (sys.executable, "-m", "valve_drake")
AT_ANGLE = math.radians(3.0)  # nearer than that a valve is where it was asked to be: the camera's tolerance and error
# Outcomes beside those of a run: its process died, did not end, or it ended at its time limit.
CRASHED, TIMED_OUT, UNFINISHED = "crashed", "timed_out", "unfinished"
# What a run's process does before it becomes the program: if this one is killed, so is the run, and a resumed campaign
# does not find it still writing. By itself, since nothing but exec is safe in the copy of a process that has threads.
_TIED = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG, which exec keeps
if os.getppid() == int(sys.argv[1]):  # else it is dead already
    os.execv(sys.argv[2], sys.argv[2:])
"""
_running: "set[subprocess.Popen[bytes]]" = set()  # in this process
# Taken over from `run --json` as they are; those of `_TIMES` depend on the machine.
_FIGURES = tuple(figures(Summary()))
_TIMES = ("wall_time_s", "real_time_factor", "processor_s")


@dc.dataclass(frozen=True)
class Trial:
    """scenario: a file, or a name in diagrams/. draws: the resolved values of its distributions, by key."""

    name: str  # of the scenario, without folder and suffixes
    scenario: str
    seed: int
    overrides: tuple[str, ...]
    draws: tuple[tuple[str, float], ...]
    log: Path
    time_out: float  # of the wall clock [s]
    folder: str = "."  # that its names are relative to: a worker may be in another one

    @property
    def key(self) -> str:
        """Names the trial within its campaign."""
        return f"{self.name}-{self.seed}"

    def command(self) -> list[str]:
        """What a user would type to run it again."""
        given = [word for override in self.overrides for word in ("--set", override)]
        return ["valve-drake", "run", self.scenario, "--seed", str(self.seed), *given]


def perform(trial: Trial) -> Record:
    """Runs a trial to its end -> its record. A crash and a time-out are records, too: failures with their reason."""
    _clear(trial.log)
    program = [sys.executable, "-I", "-S", "-c", _TIED, str(os.getpid()), *PROGRAM, *trial.command()[1:]]
    options = ["--no-html", "--json", "--overwrite", "--log", str(trial.log)]
    began = time.monotonic()
    process = subprocess.Popen(
        program + options,
        cwd=trial.folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,  # one signal reaches the run and its image processes, and Ctrl-C none of them
    )
    late = False
    _running.add(process)
    try:
        out, errors = process.communicate(timeout=trial.time_out)
    except subprocess.TimeoutExpired:
        late = True
        _kill(process)
        out, errors = process.communicate()
    except BaseException:
        _kill(process)
        raise
    finally:
        _running.discard(process)
    wall = time.monotonic() - began
    record = _begun(trial)
    numbers = None if late else _numbers(out)
    if numbers is None:
        lines = errors.decode("utf-8", "replace").strip().splitlines()
        said = lines[-1][:300] if lines else "it said nothing"
        reason = f"not ended after {trial.time_out:g} s" if late else f"exit code {process.returncode}: {said}"
        record |= {"outcome": TIMED_OUT if late else CRASHED, "reason": reason, "log": _log(trial.log)}
        return record | {"times": {"wall_time_s": wall}}
    record |= {key: numbers[key] for key in ("outcome", "verdict", "reason")}
    record["outcome"] = record["outcome"] or UNFINISHED
    reached = [mode for mode in numbers["mode_durations_s"] if mode != numbers["outcome"]]
    last = numbers.get("last_mode", reached[-1] if reached else "")
    record |= {"mode": last, "mode_durations_s": numbers["mode_durations_s"]}
    record |= {key: numbers.get(key) for key in _FIGURES}
    record |= {"log": _log(Path(numbers.get("log") or trial.log))}
    return record | {"times": {key: numbers.get(key) for key in _TIMES}}


def _clear(log: Path) -> None:
    """Removes what a run of this trial that was killed has left: the next one could not have the log's name."""
    with contextlib.suppress(OSError):
        if not is_being_written(log):
            active(log).unlink()


def _log(log: Path) -> str | None:
    """The name of the log that a run has left, whole or not; None: there is none."""
    return next((path.name for path in (log, active(log)) if path.exists()), None)


def files_of(log: Path) -> list[Path]:
    """A run's log and what lies beside it."""
    return [log, log.with_name(log.name.removesuffix(".active")).with_suffix(".json")]


def _begun(trial: Trial) -> Record:
    """A record with what is known before the run."""
    return {
        "scenario": trial.name,
        "seed": trial.seed,
        "command": trial.command(),
        "draws": dict(trial.draws),
        "outcome": "",
        "verdict": "",
        "reason": "",
        "mode": "",  # the last one before the end
    }


def turned(record: Record) -> bool:
    """Whether a trial is a success."""
    return record["outcome"] == "done" and record["verdict"] == "turned"


def _numbers(out: bytes) -> dict[str, Any] | None:
    """The object that `run --json` prints; None if there is none."""
    try:
        numbers = outputs.parse_json(out)
    except ValueError:
        return None
    return numbers if isinstance(numbers, dict) and "outcome" in numbers else None


def break_off() -> None:
    """Ends all trials that this process is waiting for; their records are of no use."""
    for process in tuple(_running):
        _kill(process)


def _kill(process: "subprocess.Popen[bytes]") -> None:
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:  # it has just ended
        pass
