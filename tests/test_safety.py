"""What docs/hardware.md promises, row by row; and every fault at a random time in every mode."""

import ast
import copy
import dataclasses as dc
import re
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import InitializeParams, Simulator
from test_twin import near

from valve_drake import diagram, rehearsal
from valve_drake import scenario as scenarios
from valve_drake.messages import SIDES, Mode, OperatorCommand, Verdict
from valve_drake.stations.faults import FaultConfig, Faults

TESTS = Path(__file__).resolve().parent
DOCS = TESTS.parent / "docs" / "hardware.md"
STEP = 1 / 32
TERMINAL = (Mode.DONE, Mode.FAILED, Mode.STOPPED)
TRIP, MARGIN = 90.0, 20.0  # command_selector.trip_force, and what a hand may feel beyond it while it is let go [N]
STILL = 0.03  # [rad/s, m/s]


# ---------------------------------------------------------------- the table of promises


def promises():
    text = DOCS.read_text(encoding="utf-8")
    return re.findall(r"^\|.*\| (test_\w+\.py::test_\w+) \|$", text, re.MULTILINE)


def test_every_promise_names_a_test_that_exists():
    found = promises()
    assert len(found) >= 14
    for name in found:
        file, test = name.split("::")
        names = {n.name for n in ast.walk(ast.parse((TESTS / file).read_text())) if isinstance(n, ast.FunctionDef)}
        assert test in names, name


# ---------------------------------------------------------------- every fault in every mode

FAULTS = [
    FaultConfig("nan", "left_wrist_sensor"),
    FaultConfig("frozen", "right_wrist_sensor"),
    FaultConfig("dead", "left_wrist_sensor"),
    FaultConfig("nan", "right_arm"),
    FaultConfig("frozen", "left_arm"),
    FaultConfig("dead", "right_arm"),
    FaultConfig("restart", "left_arm", duration=0.15),
    FaultConfig("stuck", "left_arm", joint=1),
    FaultConfig("stuck", "torso", joint=2),
    FaultConfig("frozen", "base"),
    FaultConfig("dead", "left_gripper"),
    FaultConfig("dead", "robot"),
    FaultConfig("estop", "robot"),
    FaultConfig("dead", "head_right"),
    FaultConfig("frozen", "head_left"),
    FaultConfig("dead", "left_wrist"),
    FaultConfig("latency", delay=0.02, jitter=0.01),
    FaultConfig("loss", share=0.01),
    FaultConfig("duplicate", share=0.1),
    FaultConfig("reorder", share=0.1),
]
HARMLESS = ("latency", "loss", "duplicate", "reorder")
MODES = [mode for mode in Mode if mode not in (*TERMINAL, Mode.IDLE)]
OUTSIDE = {"bus", "_config", "_idle", "station", "simulator", "context", "faults", "_hardware", "_camera", "_images",
           "_bus", "_in", "_out", "clock"}  # of link and twin: what is not their memory  # fmt: skip


@dc.dataclass
class Seen:
    """What the robot did after a fault; times from the fault on [s]."""

    mode: str = ""  # at the end
    verdict: str = ""
    reason: str = ""
    left: float | None = None  # when the mode was left
    ended: float | None = None  # when the run was over
    moved: float = 0.0  # when base, arm or torso moved last
    force: float = 0.0  # most that a wrist truly felt [N]


class Rehearsal:
    """Program and twin in one process, without a log; `Rehearsal` can return to a snapshot."""

    def __init__(self, scenario):
        self._beside = rehearsal.beside(scenario)
        self.link, self.twin = self._beside.__enter__()
        scenario = scenarios.resolve(scenario)
        self.system = diagram.make_diagram(scenario, link=self.link)
        self.simulator = Simulator(self.system.diagram)
        diagram.command(self.system, self.simulator.get_mutable_context(), OperatorCommand(0, scenario.command))
        self.simulator.Initialize()
        self.motion: list[tuple[float, float, float]] = []  # time, greatest speed, greatest force
        move = self.twin.move

        def watched():
            speeds = [self.twin.read(f"{side}_arm.velocity_measured") for side in SIDES]
            base = self.twin.read("base.odometry")[3:]
            forces = [np.linalg.norm(self.twin.read(f"{side}_wrist.wrench")[3:]) for side in SIDES]
            self.motion.append((self.twin.time, float(np.abs(np.concatenate([*speeds, base])).max()), max(forces)))
            move()

        self.twin.move = watched

    def close(self):
        self._beside.__exit__(None, None, None)

    @property
    def mode(self):
        context = self.simulator.get_context()
        return self.system.supervisor.GetOutputPort("mode").Eval(self.system.supervisor.GetMyContextFromRoot(context))

    def step(self):
        self.simulator.AdvanceTo(self.simulator.get_context().get_time() + STEP)

    def save(self):
        memory = [{k: v for k, v in vars(o).items() if k not in OUTSIDE | {"move"}} for o in (self.link, self.twin)]
        return (
            self.simulator.get_context().Clone(),
            self.twin.context.Clone(),
            copy.deepcopy(memory),
            (self.link.bus.sent, self.twin._bus.sent),
        )

    def restore(self, saved):
        program, robot, memory, sent = saved
        quiet = InitializeParams(suppress_initialization_events=True)  # or the station would wait for its robot anew
        for simulator, context in ((self.simulator, program), (self.twin.simulator, robot)):
            simulator.reset_context(context.Clone())
            simulator.Initialize(quiet)
        self.twin.context = self.twin.simulator.get_mutable_context()
        for thing, values in zip((self.link, self.twin), copy.deepcopy(memory)):
            vars(thing).update(values)
        self.link.bus.sent, self.twin._bus.sent = sent
        self.faults([])
        for wire in (self.twin._in, self.twin._out):  # what a slow wire still held belongs to the branch that was left
            wire._waiting.clear()
        self.motion.clear()

    def faults(self, faults):
        self.twin.faults = self.twin._in._faults = self.twin._out._faults = Faults(faults, seed=1)

    def suffer(self, fault, longest=4.0):
        """Starts a fault -> what the robot did until a second after the run's end, or for `longest` seconds."""
        begin, mode = self.twin.time, self.mode
        self.faults([dc.replace(fault, start=begin)])
        seen = Seen()
        while self.twin.time < begin + longest and (seen.ended is None or self.twin.time < begin + seen.ended + 1.0):
            self.step()
            now = self.mode
            if seen.left is None and now.activation != mode.activation:
                seen.left = self.twin.time - begin
            if seen.ended is None and now.mode in TERMINAL:
                seen.ended = self.twin.time - begin
        seen.mode, seen.verdict, seen.reason = now.mode, now.verdict, now.reason
        seen.moved = max((time - begin for time, speed, _ in self.motion if speed > STILL), default=0.0)
        seen.force = max(force for _, _, force in self.motion)
        return seen


@pytest.fixture(scope="module")
def at_modes():
    """A run to its end, and snapshots of it at a random time in every mode."""
    robot = Rehearsal(near())
    rng, saved, wait = np.random.default_rng(7), {}, None
    while robot.mode.mode not in TERMINAL:
        robot.step()
        mode = robot.mode
        if wait is None or wait[0] != mode.activation:
            wait = mode.activation, rng.uniform(0.1, 1.0)
        if mode.mode in MODES and mode.mode not in saved and robot.twin.time - mode.since >= wait[1]:
            saved[mode.mode] = robot.save()
    assert robot.mode.verdict == Verdict.TURNED and saved.keys() == set(MODES)
    yield robot, saved
    robot.close()


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_whatever_fails_in_whatever_mode_the_robot_comes_to_rest_and_no_hand_is_overloaded(at_modes, mode):
    robot, saved = at_modes
    for fault in FAULTS:
        robot.restore(saved[mode])
        seen = robot.suffer(fault)
        assert seen.force < TRIP + MARGIN, (fault, seen)
        if seen.ended is not None:
            assert seen.verdict in set(Verdict) - {Verdict.NONE}, (fault, seen)
            assert seen.moved < seen.ended + 1.0, (fault, seen)
        if fault.kind in HARMLESS:
            assert seen.verdict in ("", Verdict.TURNED), (fault, seen)
        elif fault.kind in ("nan", "estop") or fault.device in ("left_wrist_sensor", "right_wrist_sensor"):
            assert mode == Mode.RELEASE or (seen.left is not None and seen.left < 0.25), (fault, seen)
            assert seen.ended is None or seen.verdict in (Verdict.FAULT, Verdict.TURNED), (fault, seen)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [Mode.SERVO, Mode.GRASP, Mode.TURN])
def test_the_operators_stop_with_the_hands_at_the_valve_opens_them_and_ends_the_run(at_modes, mode):
    robot, saved = at_modes
    robot.restore(saved[mode])
    diagram.command(robot.system, robot.simulator.get_mutable_context(), OperatorCommand(1, "stop"))
    seen = robot.suffer(FaultConfig("loss", share=0.0), longest=8.0)
    assert (seen.mode, seen.verdict) == (Mode.STOPPED, Verdict.STOPPED)
    assert seen.force < TRIP + MARGIN and seen.moved < seen.ended + 1.0
    for side in SIDES:
        assert robot.twin.read(f"{side}_gripper.position_measured")[0] > 0.07
