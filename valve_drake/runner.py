"""One run of the system: build it, advance it until the supervisor has ended, log everything, say what happened.

`replay` runs the same diagram once more on what a log holds, and compares.
"""

import contextlib
import dataclasses as dc
import functools
import gc
import json
import math
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.analysis import Simulator

from valve_drake import config, halves, named_files, outputs, profiling, yaml_file
from valve_drake.analysis.comparison import Comparison
from valve_drake.analysis.metrics import Summary, figures, summarize
from valve_drake.behaviors.taught import load_taught
from valve_drake.camera.lens import load_head
from valve_drake.checks import ConfigError, OperationFailed, require
from valve_drake.config import key_names
from valve_drake.diagram import System, command, deliver, gaze_of, listens, make_diagram, plant_of, rig_of, robot_of
from valve_drake.messages import Mode, ModeState, OperatorCommand, OperatorPackets, Verdict
from valve_drake.operator.operator_link import OperatorLink
from valve_drake.pace import PACE, Pace, Pacer
from valve_drake.player import Player
from valve_drake.ports import SLOT, TICK
from valve_drake.processor import goes_first
from valve_drake.recording import foxglove, layout
from valve_drake.recording.reader import LogReader
from valve_drake.recording.recorder_system import RecorderSystem, Signal, Sink, Tee
from valve_drake.recording.robot_frames import RobotFrames, pinholes
from valve_drake.recording.signals import signals
from valve_drake.recording.writer import LogError, LogWriter
from valve_drake.robot import description as descriptions
from valve_drake.robot.robot import Robot
from valve_drake.scenario import (
    RETIRED,
    TAGS,
    Scenario,
    dump,
    former_names,
    parse,
    resolve,
    split_override,
    with_overrides,
)
from valve_drake.stations.bus import Bus
from valve_drake.stations.camera_workers import CameraWorkers
from valve_drake.stations.hardware import AHEAD, RobotLink
from valve_drake.stations.mishaps import InterruptingOperator
from valve_drake.stations.replay import Recording
from valve_drake.stations.reports import listed
from valve_drake.task.modes import TERMINAL
from valve_drake.teaching import prepared
from valve_drake.versions import versions

STEP = 1 / 32  # between two looks at the mode [s]
TAIL = 1.5  # recorded after the end: a stopped base takes a second to stand [s]
TAIL_DONE = 0.5  # the same of a run that is done: its base stands already [s]
VIEW_PORT = 7000  # that Drake's 3D view tries first
# Of the files that a scenario names: what reads one, and raises ConfigError.
READERS: dict[str, Callable[[Path], object]] = {
    "robot": Robot.load,
    "head_calibration": load_head,
    "taught": load_taught,
}
FILES = {key: f"{key}.yaml" for key in READERS}  # the same, as attached to its log
WORLD = ("simulation", "hardware", "faults")
RECORDED = (
    "seed",
    "station",
    "command",
    "angle",
    "time_limit",
    "operator_channel.wire",
    *WORLD,
)  # keys that a replay cannot change


@dc.dataclass(frozen=True)
class Progress:
    """What a display shows while the run goes on."""

    mode: ModeState
    sim_time: float  # [s]
    wall_time: float


@dc.dataclass(frozen=True)
class Result:
    """What a run came to."""

    summary: Summary  # its outcome and verdict are the supervisor's, its numbers those of what was logged
    wall_time: float  # of the run itself [s]
    name: Path  # of the log; what belongs to it has the same name with another suffix
    log: Path | None  # where the log is; None if it was removed
    html: Path | None
    log_error: str  # why logging stopped; `say` was told
    troubles: tuple[str, ...]  # what else went wrong, in lines for the user
    spent: profiling.Spent  # processor time, by kind of work
    pace: Pace | None  # how real time was kept, where it was

    def as_json(self) -> dict[str, Any]:
        """The object of `run --json`."""
        s = self.summary
        return {
            "outcome": s.outcome,
            "verdict": s.verdict,
            "reason": s.reason,
            "mode_durations_s": {mode: round(t, 4) for mode, t in s.mode_durations().items()},
            "last_mode": s.last_mode,
            **figures(s),
            "wall_time_s": self.wall_time,
            "real_time_factor": s.sim_time_s / max(self.wall_time, 1e-9),
            "processor_s": self.spent.as_json(),
            "pace": self.pace and self.pace.as_json(),
            "log": str(self.log) if self.log else None,
            "log_error": self.log_error,
            "recording": str(self.html) if self.html else None,
        }


def make_recorder(sink: Sink, scenario: Scenario) -> RecorderSystem:
    """The recorder with all topics of the program."""
    return RecorderSystem(sink, _table(scenario))


def _table(scenario: Scenario) -> list[Signal]:
    """The recorder's table."""
    head = load_head(named_files.find(scenario, "head_calibration"))
    robot = robot_of(scenario)
    frames = RobotFrames(robot, head)
    return signals(robot.groups, frames, frames.scene, pinholes(head))


def run(
    scenario: Scenario,
    log: Path,
    *,
    overwrite: bool = False,
    recording: bool = False,
    meshcat: bool = False,
    truth: bool = True,
    duration: float | None = None,
    live: Sink | None = None,
    link: RobotLink | None = None,
    operators: OperatorLink | None = None,
    show: Callable[[Progress], None] = lambda progress: None,
    say: Callable[[str], None] = lambda line: None,
    stop: Callable[[], bool] = lambda: False,
) -> Result:
    """Runs a scenario (distributions and all) and writes its log.

    log: its name; the next free one is taken if it exists (recording/active.py). overwrite: it may be replaced.
    recording: puts a 3D recording beside the log. meshcat: serves it live. truth: records the truth ports.
    duration: stop then, whatever the mode [s]. live: also gets all that is logged. link: to the robot of
    station `hardware`, operators: to those of `operator_channel`, else made of the scenario.
    show: called every STEP. say: told what the user should know.
    stop: True makes the operator's stop.
    Where operators are listened to, the run waits for their words, may hold many turns, and ends by `stop`.
    Raises ConfigError or OperationFailed before the first message is logged, and leaves no file then. Later failures
    are in the result.
    """
    scenario = resolve(scenario)
    scenario.check()
    require(scenario.station != "replay", "station", "one that runs (a log is replayed by `replay LOG`)", "replay")
    cv2.setNumThreads(1)  # the same bits on any machine, and the renderer wants the cores
    for line in gaze_of(scenario)[1]:
        say(line)
    named = prepared(scenario, say)  # the log has the scenario as it was given, and the files that were used
    files = _read_files(named)  # before anything is opened: a scenario that cannot be run leaves no trace
    if scenario.station == "hardware":
        recording = meshcat = False  # 3D views exist in simulation only
    troubles = []
    with contextlib.ExitStack() as stack:
        profile = stack.enter_context(profiling.measure())
        workers = physics = plant_beside = None
        if scenario.station == "hardware":
            link = link or RobotLink(Bus(scenario.hardware), robot_of(scenario).groups, stop=stop)
        else:
            workers = stack.enter_context(
                CameraWorkers(*rig_of(scenario))
            )  # before view and writer, which start threads
            physics = plant_of(named)
            plant_beside = stack.enter_context(physics.beside())
        if listens(scenario) and operators is None:
            shared = link.bus if link is not None and scenario.station == "hardware" else None
            operators = OperatorLink(shared or Bus(scenario.hardware), alone=shared is None)
            operators.claim(stop)
            say(f"operators are heard on {scenario.hardware.lcm_url}: valve-drake operator")
        view = _make_view(say if meshcat else None) if recording or meshcat else None
        writer = LogWriter(log, companions=(".json", ".html") if recording else (".json",), overwrite=overwrite)
        stack.enter_context(_log_kept(writer))
        if writer.note:
            say(writer.note)
        _begin_log(writer, scenario, files)
        sink = writer if live is None else Tee(writer, live)
        recorder = make_recorder(sink, scenario)
        system = make_diagram(named, recorder, meshcat=view, workers=workers, link=link, physics=physics, truth=truth)
        simulator = Simulator(system.diagram)
        if recording and view is not None:
            view.StartRecording(frames_per_second=16.0, set_visualizations_while_recording=meshcat)
        profile.ends(profiling.START_UP)
        begin = time.perf_counter()
        paced = scenario.station == "hardware" and not scenario.hardware.lockstep
        pacer = Pacer(idle=link.pass_time) if paced and link is not None else None

        def advance(until: float) -> None:
            with profiling.advance():
                simulator.AdvanceTo(until)

        go = advance if pacer is None else _in_real_time(simulator, advance, pacer, sink)
        if operators is not None:
            go = _heard(go, operators, system, simulator, sink, in_real_time=pacer is not None)
        last, told = Progress(ModeState(), 0.0, 0.0), False

        def watch(progress: Progress) -> None:
            nonlocal last, told
            last = progress
            show(progress)
            if writer.error and not told:
                told = True
                say(writer.error)

        try:
            with goes_first(scenario.hardware.priority if paced else 0):
                mode = _advance(system, simulator, scenario, duration, go, link, watch, stop, begin)
            if operators is not None and operators.dropped:
                say(f"bad messages of operators were dropped: {listed(operators.dropped)}")
        except OperationFailed as error:
            if writer.empty:
                raise
            mode = dc.replace(last.mode, mode=Mode.FAILED, verdict=Verdict.FAULT, reason=str(error))
            troubles.append(str(error))
        wall, end = time.perf_counter() - begin, simulator.get_context().get_time()
        profile.writing = writer.spent
        profile.ends(profiling.ADVANCES)
        if workers is not None:
            profile.renderers_start_up, profile.rendering = workers.spent
        if plant_beside is not None:
            profile.plant_beside = plant_beside.spent
        writer.write_metadata("result", _result_metadata(mode, end))
    if writer.error and not told:
        say(writer.error)
    html = _write_recording(view, writer, troubles) if recording else None
    pace = pacer.report(mode.time) if pacer else None
    summary = _summary(writer, mode, end)
    profile.ends(profiling.END)
    return Result(
        summary,
        wall,
        writer.path,
        writer.where,
        html,
        writer.error,
        tuple(troubles),
        profile.spent(),
        pace,
    )


def _read_files(scenario: Scenario) -> dict[str, bytes]:
    """The files that a scenario names, by the name under which a log holds them. Raises ConfigError unless each is
    what it should be: nothing else of a user's files gets into a log."""
    files = {}
    blind = robot_of(scenario).description.servo != "camera"
    for key, load in READERS.items():
        if key == "taught" and blind:  # nothing reads it
            continue
        path = named_files.find(scenario, key)
        load(path)
        files[FILES[key]] = descriptions.text(path) if key == "robot" else path.read_bytes()
    return files


def _make_view(say: Callable[[str], None] | None) -> Meshcat:
    """Drake's 3D view at the first free port; `say` tells which."""
    try:
        view = Meshcat(MeshcatParams(host="localhost", port=None))
    except RuntimeError as error:
        raise OperationFailed(f"the 3D view finds no free port: {str(error).splitlines()[0]}") from error
    view.SetCameraPose(np.array([-5.2, -3.6, 2.7]), np.array([-1.4, 0.1, 0.8]))  # start and valve in view
    if say is not None:
        taken = "" if view.port() == VIEW_PORT else f" (port {VIEW_PORT} is taken)"
        say(f"3D view at {view.web_url()}{taken}")
    return view


def _write_recording(view: Meshcat, writer: LogWriter, troubles: list[str]) -> Path | None:
    """The 3D recording beside the log; None if it cannot be written."""
    view.StopRecording()
    view.PublishRecording()
    path = writer.path.with_suffix(".html")
    try:
        outputs.write(path, view.StaticHtml())
    except OperationFailed as error:
        if not writer.error:  # else the disk has been complained of
            troubles.append(str(error))
        return None
    return path


def _summary(writer: LogWriter, mode: ModeState, end: float) -> Summary:
    """The log's numbers, and how the run ended: also where the log, cut off, does not know it."""
    try:
        summary = summarize(writer.where) if writer.where else Summary()
    except ConfigError:  # there is too little of it
        summary = Summary()
    summary.outcome = mode.mode if mode.mode in TERMINAL else ""
    summary.verdict, summary.reason = mode.verdict, mode.reason
    if writer.error:
        summary.sim_time_s = end
    return summary


def _begin_log(writer: LogWriter, scenario: Scenario, files: Mapping[str, bytes], **facts: str) -> None:
    """What every log begins with; `files`: what the scenario names, to attach."""
    about = {"scenario": dump(scenario), "seed": str(scenario.seed), "station": scenario.station}
    writer.write_metadata("run", about | versions() | facts)
    writer.attach(
        layout.NAME, layout.MEDIA_TYPE, json.dumps(layout.layout(robot_of(scenario).groups), indent=1).encode()
    )
    for name, data in files.items():
        writer.attach(name, "application/yaml", data)


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
    go: Callable[[float], object],
    link: RobotLink | None,
    show: Callable[[Progress], None],
    stop: Callable[[], bool],
    begin: float,
) -> ModeState:
    """go: advances the simulator to a time."""
    context = simulator.get_mutable_context()
    waits = system.operator_channel is not None  # for its operators
    interrupting: InterruptingOperator | None = None
    if waits:
        command(system, context, OperatorCommand())
        deliver(system, context, OperatorPackets())
    else:
        first = OperatorCommand(sequence=0, command=scenario.command, angle=scenario.angle)
        command(system, context, first)
        if scenario.station == "simulated":
            interrupting = InterruptingOperator(scenario.simulation.mishap, first)
    with profiling.advance():
        simulator.Initialize()
    port = system.supervisor.GetOutputPort("mode")
    inner = system.supervisor.GetMyContextFromRoot(context)
    limit = math.inf if waits else scenario.time_limit
    end = limit if duration is None else min(duration, limit)
    stopped = False
    while True:
        now = context.get_time()
        mode = port.Eval(inner)
        show(Progress(mode, now, time.perf_counter() - begin))
        if link is not None:
            link.tell(mode.mode, mode.activation)
        if interrupting is not None and (said := interrupting.say(now, mode)) is not None:
            command(system, context, said)
        more = waits or (interrupting is not None and interrupting.waits)
        if mode.mode in TERMINAL and duration is None and (stopped or not more):
            end = min(end, mode.since + (TAIL_DONE if mode.mode == Mode.DONE else TAIL))
        if now >= end:
            if link is not None:
                link.leave()
            return mode
        if stop() and not stopped:
            stopped, interrupting = True, None
            command(system, context, OperatorCommand(sequence=1, command="stop"))
        go(min(now + STEP, end))


def _heard(
    go: Callable[[float], object],
    operators: OperatorLink,
    system: System,
    simulator: Simulator,
    sink: Sink,
    in_real_time: bool,
) -> Callable[[float], None]:
    """AdvanceTo that hands over what operators have sent, and answers them. in_real_time: `go` keeps to the wall's
    clock; else it is held to that here (it may be slower), so that the operators' times are those of the run."""
    channel = system.operator_channel
    assert channel is not None
    port, context = channel.GetOutputPort("state"), simulator.get_mutable_context()
    inner = channel.GetMyContextFromRoot(context)
    free = in_real_time or operators.bus.lcm.get_lcm_url().startswith("memq")
    begin = time.monotonic() - context.get_time()

    def advance(until: float) -> None:
        nonlocal begin
        now = context.get_time()
        operators.tell(port.Eval(inner))
        packets = operators.take(now)
        if packets is not None:
            deliver(system, context, packets)
        for sound in operators.sounds():
            sink.write(foxglove.AUDIO, foxglove.audio(now, sound.rate, sound.samples), now)
        go(until)
        while not free and (left := begin + until - time.monotonic()) > 0:
            operators.pass_time(left)
        begin = max(begin, time.monotonic() - until)  # what is lost is not made up for

    return advance


def _in_real_time(
    simulator: Simulator, advance: Callable[[float], None], pacer: Pacer, sink: Sink
) -> Callable[[float], None]:
    """AdvanceTo, paced by the wall clock, in two parts a tick: the first ends when the commands are sent, at the start
    of slot 3; the second is slot 3, whose slow work delays no command."""
    gc.collect()
    gc.freeze()  # a garbage collection that walks the whole diagram would take several ticks
    context = simulator.get_context()

    def go(until: float) -> None:
        while True:
            tick = int(context.get_time() / TICK + 1 / 4) * TICK
            commands, rest = (functools.partial(advance, tick + end) for end in (3 * SLOT, TICK - AHEAD))
            pacer.tick(commands, rest)
            now = context.get_time()
            if int(tick) != int(tick + TICK):
                sink.write(PACE, pacer.report(now), now)
            if now + TICK > until + SLOT:
                return

    return go


def _result_metadata(mode: ModeState, sim_time: float) -> dict[str, str]:
    finished = mode.mode in TERMINAL
    return {
        "outcome": mode.mode if finished else "unfinished",
        "verdict": mode.verdict,
        "reason": mode.reason,
        "sim_time_s": repr(float(np.round(sim_time, 9))),
    }


# ---------------------------------------------------------------- replay


@dc.dataclass(frozen=True)
class Replay:
    """What came out of a replay."""

    comparison: Comparison
    end: float  # of the log, or of what could be replayed of it [s]
    wall_time: float  # [s]
    damage: list[str]  # of the log, in lines
    notes: list[str]  # what may explain a difference
    log: Path | None  # the replay's own, if it was asked for
    log_error: str  # why its writing stopped

    @property
    def real_time_factor(self) -> float:
        return self.end / max(self.wall_time, 1e-9)

    def as_json(self) -> dict[str, Any]:
        """The object of `replay --json`."""
        found = self.comparison
        return {
            "identical": found.identical,
            "replayed_s": self.end,
            "wall_time_s": self.wall_time,
            "real_time_factor": self.real_time_factor,
            "topics_compared": len(found.topics),
            "messages_compared": sum(max(topic.recorded, topic.replayed) for topic in found.topics.values()),
            "first_divergence": found.first and found.first.as_json(),
            "max_difference": found.max_difference,
            "differences": {
                name: {
                    "recorded": topic.recorded,
                    "replayed": topic.replayed,
                    "equal": topic.equal,
                    "max_difference": topic.max_difference,
                    "first": topic.first and topic.first.as_json(),
                    "largest": topic.largest and topic.largest.as_json(),
                }
                for name, topic in found.topics.items()
                if not topic.identical
            },
            "damage": self.damage,
            "notes": self.notes,
            "log": str(self.log) if self.log else None,
            "log_error": self.log_error,
        }


def replay(
    log: LogReader,
    overrides: Sequence[str] = (),
    *,
    copy: Path | None = None,
    overwrite: bool = False,
    show: Callable[[Progress], None] = lambda progress: None,
    say: Callable[[str], None] = lambda line: None,
) -> Replay:
    """Runs all blocks on what the log's station showed them, and compares what comes out with what was recorded.

    overrides: other values of the log's scenario, as `key=value`. copy: writes the replay's own log there, or under the
    next free name; overwrite, show, say: as of `run`.
    Raises ConfigError if this version of the program cannot replay the log, or `copy` cannot be made.
    """
    recorded, notes = _recorded_scenario(log)
    changed = [split_override(override)[0] for override in overrides]
    for key in changed:
        if key in RECORDED or key.partition(".")[0] in RECORDED:
            raise ConfigError(f"--set {key}: it is recorded; a replay can change the blocks' keys only")
    scenario = with_overrides(dc.replace(recorded, station="replay"), overrides)
    cv2.setNumThreads(1)  # as in the run
    with contextlib.ExitStack() as stack:
        files = stack.enter_context(_files_of(log, scenario, changed))
        data = _read_files(files)
        recording = Recording(log, robot_of(files).groups)
        begin = time.perf_counter()
        comparison = None if changed or copy is not None else _in_halves(log, files, recording, show)
        writer = None
        if comparison is None:
            comparison = Comparison(log, recording.end)
            sink: Sink = comparison
            if copy is not None:
                writer = LogWriter(copy, overwrite=overwrite)
                stack.enter_context(_log_kept(writer))
                if writer.note:
                    say(writer.note)
                _begin_log(writer, scenario, data, replay_of=log.path.name)
                sink = Tee(comparison, writer)
            player = Player(files, recording, make_recorder(sink, files))
            mode = _feed(player, recording, _timed(show, begin))
            comparison.finish()
            if writer is not None:
                writer.write_metadata("result", _result_metadata(mode, recording.end))
        wall = time.perf_counter() - begin
    where, error = (writer.where, writer.error) if writer is not None else (None, "")
    notes += _notes(log, recorded, recording, changed, data)
    return Replay(comparison, recording.end, wall, log.damage, notes, where, error)


def _in_halves(
    log: LogReader, files: Scenario, recording: Recording, show: Callable[[Progress], None]
) -> Comparison | None:
    """The comparison of a replay in two processes (halves.py), if it finds everything identical and can be made."""

    table = _table(files)
    others = halves.topics_beside(table)

    def half(beside: bool, watch: Callable[[ModeState, float], None]) -> Comparison:
        def mine(topic: str) -> bool:
            return (topic in others) == beside

        def look(mode: ModeState, now: float) -> None:
            if comparison.first is not None:
                raise halves.Different
            watch(mode, now)

        comparison = Comparison(log, recording.end, mine)
        recorder = RecorderSystem(comparison, [row for row in table if mine(row.topic)])
        _feed(Player(files, recording, recorder, halves.plays(beside)), recording, look)
        comparison.finish()
        if not comparison.identical:
            raise halves.Different
        return comparison

    shown = _timed(show, time.perf_counter())
    try:
        with halves.beside(lambda: half(True, lambda mode, now: None).topics) as found:

            def watch(mode: ModeState, now: float) -> None:
                found(False)
                shown(mode, now)

            comparison = half(False, watch)
            topics = comparison.topics | found(True)
            comparison.topics = {name: topics[name] for name in log.topics if name in topics}
            return comparison
    except Exception:  # all blocks together will tell, or fail in the same way
        return None


def _timed(show: Callable[[Progress], None], begin: float) -> Callable[[ModeState, float], None]:
    """`show` as `_feed` calls it; begin: by the wall's clock."""
    return lambda mode, now: show(Progress(mode, now, time.perf_counter() - begin))


def _recorded_scenario(log: LogReader) -> tuple[Scenario, list[str]]:
    """The scenario of a log, and in which keys it and this program differ."""
    text = log.metadata.get("run", {}).get("scenario")
    if text is None:
        raise ConfigError(f"{log.path} cannot be replayed: it does not hold its scenario")
    unknown: list[str] = []
    scenario = parse(text, str(log.path), unknown=unknown)
    for key in unknown:
        if key not in RETIRED:
            raise ConfigError(f"{log.path} cannot be replayed: its scenario has the unknown key {key}")
    former = former_names()
    present = {former.get(key, key) for key in key_names(yaml_file.parse(text, str(log.path), TAGS))}
    missing = sorted(key_names(config.tree(scenario)) - present)
    notes = []
    if missing:
        notes.append(f"the log's scenario lacks keys of this program, their defaults stand in: {', '.join(missing)}")
    if unknown:
        notes.append(f"the log's scenario has keys that this program no longer has: {', '.join(unknown)}")
    return scenario, notes


@contextlib.contextmanager
def _files_of(log: LogReader, scenario: Scenario, changed: Collection[str]) -> Iterator[Scenario]:
    """The scenario with the log's own files, but for those whose keys are `changed`."""
    with tempfile.TemporaryDirectory() as folder:
        paths = {}
        for key, name in FILES.items():
            if key not in changed and name in log.attachments:
                paths[key] = Path(folder) / name
                paths[key].write_bytes(log.attachments[name].data)
        files: dict[str, Any] = {key: str(path) for key, path in paths.items()}
        yield dc.replace(scenario, **files)


def _feed(player: Player, recording: Recording, show: Callable[[ModeState, float], None]) -> ModeState:
    """Plays to the recording's end; the operator asks when he did in the run (stations/replay.py). show: is told the
    mode and the time, every STEP."""

    def advance(until: float) -> None:
        while player.time < until:
            player.advance(min(player.time + STEP, until))
            show(player.mode, player.time)

    given: list[tuple[float, Callable[[Any], None], Any]] = []
    given += [(when, player.command, value) for when, value in zip(recording.requests.times, recording.requests.values)]
    given += [(when, player.deliver, value) for when, value in zip(recording.packets.times, recording.packets.values)]
    given.sort(key=lambda event: event[0])
    begun = False
    for when, give, value in given:
        if when > 0 and not begun:
            player.begin()
            begun = True
        if when > 0:
            advance(min(when - TICK, recording.end))
        give(value)
    if not begun:
        player.begin()
    advance(recording.end)
    return player.mode


def _notes(
    log: LogReader, recorded: Scenario, recording: Recording, changed: Collection[str], read: Collection[str]
) -> list[str]:
    """What is not as it was when the log was written, and what of it is not replayed. read: the files that are, by the
    names under which a log holds them."""
    facts, now = log.metadata["run"], versions()
    notes = [f"{name} was {facts[name]}, is {now[name]}" for name in now if facts.get(name, now[name]) != now[name]]
    needed = {key: name for key, name in FILES.items() if key not in changed and name in read}
    for key in (key for key, name in needed.items() if name not in log.attachments):
        notes.append(
            f"the log does not hold its {key}: {getattr(recorded, key) or 'that of its robot'} of today stands in"
        )
    if recording.end < log.end:
        notes.append(f"replayed up to t = {recording.end:.3f} s: after that the log is incomplete")
    return notes
