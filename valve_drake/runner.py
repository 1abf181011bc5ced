"""One run of the system: build it, advance it until the supervisor has ended, log everything, say what happened."""

import contextlib
import dataclasses as dc
import importlib.metadata
import json
import platform
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator

from valve_drake import resources
from valve_drake.analysis.metrics import Summary, summarize
from valve_drake.camera.lens import load_head
from valve_drake.diagram import System, command, make_diagram
from valve_drake.messages import Mode, ModeState, OperatorCommand
from valve_drake.ports import profile
from valve_drake.recording import layout
from valve_drake.recording.container import active
from valve_drake.recording.recorder_system import RecorderSystem
from valve_drake.recording.robot_frames import RobotFrames, pinholes
from valve_drake.recording.signals import signals
from valve_drake.recording.writer import LogError, LogWriter
from valve_drake.scenario import Scenario, dump, resolve

STEP = 1 / 32  # between two looks at the mode [s]
TAIL = 1.5  # recorded after the end: a stopped base takes a second to stand [s]
TERMINAL = (Mode.DONE, Mode.FAILED, Mode.STOPPED)


@dc.dataclass(frozen=True)
class Progress:
    """What a display shows while the run goes on."""

    mode: ModeState
    sim_time: float  # [s]
    wall_time: float


@dc.dataclass(frozen=True)
class Result:
    """What a run came to."""

    summary: Summary
    wall_time: float  # of the run itself [s]
    log: Path
    html: Path | None
    log_error: str
    shares: dict[str, float]  # of the wall time, by kind of work

    def as_json(self) -> dict:
        """The object of `run --json`."""
        s = self.summary
        return {
            "outcome": s.outcome,
            "verdict": s.verdict,
            "reason": s.reason,
            "mode_durations_s": {mode: round(t, 4) for mode, t in s.mode_durations().items()},
            "valve_angle_command_rad": s.command_rad,
            "valve_angle_estimated_rad": s.angle_camera_rad,
            "valve_angle_hands_rad": s.angle_hands_rad,
            "valve_angle_true_rad": s.angle_true_rad,
            "sim_time_s": s.sim_time_s,
            "wall_time_s": self.wall_time,
            "real_time_factor": s.sim_time_s / max(self.wall_time, 1e-9),
            "peak_hand_force_N": s.peak_hand_force_N,
            "turn_peak_hand_force_N": s.turn_peak_hand_force_N,
            "turn_mean_hand_force_N": s.turn_mean_hand_force_N,
            "turn_mean_stem_force_N": s.turn_mean_stem_force_N,
            "turn_share_left": s.turn_share_left,
            "shares": {kind: round(share, 4) for kind, share in self.shares.items()},
            "log": str(self.log),
            "log_error": self.log_error,
            "recording": str(self.html) if self.html else None,
        }


def versions() -> dict[str, str]:
    """What the run's numbers may depend on; nothing of the day or the machine's names."""
    names = ("valve-drake", "drake", "numpy", "opencv-python-headless", "mcap", "protobuf")
    out = {"python": platform.python_version(), "machine": platform.machine()}
    for name in names:
        try:
            out[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            out[name] = "unknown"
    try:
        here = Path(__file__).resolve().parent
        git = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40"], cwd=here, capture_output=True, text=True, timeout=5
        )
        out["commit"] = git.stdout.strip() if git.returncode == 0 else "unknown"
    except (OSError, subprocess.SubprocessError):
        out["commit"] = "unknown"
    return out


def make_recorder(writer: LogWriter, scenario: Scenario) -> RecorderSystem:
    """The recorder with all topics of the program."""
    head = load_head(resources.find(scenario.head_calibration, resources.models()))
    frames = RobotFrames(head, scenario.marker)
    return RecorderSystem(writer, signals(frames, frames.scene, pinholes(head)))


def run(
    scenario: Scenario,
    log: Path,
    *,
    html: Path | None = None,
    meshcat_port: int | None = None,
    truth: bool = True,
    duration: float | None = None,
    show: Callable[[Progress], None] = lambda progress: None,
    stop: Callable[[], bool] = lambda: False,
) -> Result:
    """Runs a scenario (distributions and all) and writes its log.

    html: where to put the 3D recording. meshcat_port: also serve it live there. truth: record the truth ports.
    duration: stop then, whatever the mode [s]. show: called every STEP. stop: True makes the operator's stop.
    """
    scenario = resolve(scenario)
    scenario.check()
    cv2.setNumThreads(1)  # the same bits on any machine, and the renderer wants the cores
    meshcat = None
    if html is not None or meshcat_port is not None:
        meshcat = Meshcat(MeshcatParams(host="localhost", port=meshcat_port))
    profile.seconds.clear()
    writer = LogWriter(log)
    with _log_kept(writer):
        writer.write_metadata(
            "run", {"scenario": dump(scenario), "seed": str(scenario.seed), "station": scenario.station, **versions()}
        )
        writer.attach(layout.NAME, layout.MEDIA_TYPE, json.dumps(layout.layout(), indent=1).encode())
        system = make_diagram(scenario, make_recorder(writer, scenario), meshcat=meshcat, truth=truth)
        simulator = Simulator(system.diagram)
        if html is not None:
            meshcat.StartRecording(frames_per_second=16.0, set_visualizations_while_recording=meshcat_port is not None)
        begin = time.perf_counter()
        mode = _advance(system, simulator, scenario, duration, show, stop, begin)
        wall = time.perf_counter() - begin
        writer.write_metadata("result", _result_metadata(mode, simulator.get_context().get_time()))
    if html is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
        html.write_text(meshcat.StaticHtml(), encoding="utf-8")
    shares = {kind: seconds / wall for kind, seconds in profile.seconds.items()}
    shares["physics"] = 1.0 - sum(shares.values())
    written = log if not writer.error else active(log)
    return Result(summarize(written), wall, written, html, writer.error, shares)


@contextlib.contextmanager
def _log_kept(writer: LogWriter) -> Iterator[None]:
    """Completes the log at the end, however that comes; a disk that failed ends the log and not the run."""
    try:
        with writer:
            yield
    except LogError:
        pass  # writer.error says why; the caller reports it


def _advance(
    system: System,
    simulator: Simulator,
    scenario: Scenario,
    duration: float | None,
    show: Callable[[Progress], None],
    stop: Callable[[], bool],
    begin: float,
) -> ModeState:
    context = simulator.get_mutable_context()
    command(system, context, OperatorCommand(sequence=0, command=scenario.command, angle=scenario.angle))
    simulator.Initialize()
    port = system.supervisor.GetOutputPort("mode")
    inner = system.supervisor.GetMyContextFromRoot(context)
    end = scenario.time_limit if duration is None else min(duration, scenario.time_limit)
    stopped = False
    while True:
        now = context.get_time()
        mode = port.Eval(inner)
        show(Progress(mode, now, time.perf_counter() - begin))
        if mode.mode in TERMINAL and duration is None:
            end = min(end, mode.since + TAIL)
        if now >= end:
            return mode
        if stop() and not stopped:
            stopped = True
            command(system, context, OperatorCommand(sequence=1, command="stop"))
        simulator.AdvanceTo(min(now + STEP, end))


def _result_metadata(mode: ModeState, sim_time: float) -> dict[str, str]:
    finished = mode.mode in TERMINAL
    return {
        "outcome": mode.mode if finished else "unfinished",
        "verdict": mode.verdict,
        "reason": mode.reason,
        "sim_time_s": repr(float(np.round(sim_time, 9))),
    }
