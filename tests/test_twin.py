"""twin: the robot at the other end of the wire, its guard, its faults, and whole runs against it."""

import dataclasses as dc
import json
import math
import os
import shutil
import subprocess
import sys
import time as wall
from types import SimpleNamespace

import numpy as np
import pytest
from bad_messages import bad_messages, on
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from robot_facts import SIZES
from robot_variants import fixed, variant, without_base_joints

from valve_drake import diagram, rehearsal, runner
from valve_drake import scenario as scenarios
from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.messages import CAMERAS, Mode, OperatorCommand
from valve_drake.pace import Pacer
from valve_drake.perception.color_segmentation_system import ColorSegmentationSystem
from valve_drake.ports import SLOT, TICK
from valve_drake.recording.reader import LogReader
from valve_drake.stations.bus import BadMessage, Bus
from valve_drake.stations.camera_rate import CameraRate, limits
from valve_drake.stations.camera_rig import Capture
from valve_drake.stations.faults import FaultConfig, Faults, Wire
from valve_drake.stations.hardware import RobotLink
from valve_drake.stations.lcm_channels import (
    CHANNELS,
    COMMANDS,
    CONTROLLER,
    LOCKSTEP_TIME,
    REPORTS,
    REQUEST,
    ROBOT,
    STATE,
    SYNC,
    HardwareConfig,
)
from valve_drake.stations.reports import Senders
from valve_drake.stations.twin import OVERDUE, Guard, RobotClock

BASE = CHANNELS["base.command"]
ARM = "left_arm.position_command"
SPEED = {"torso": np.full(3, 2.0), "left_arm": np.full(6, 1.5), "right_arm": np.full(6, 2.5)}
START = {port: np.full(size, 0.02) for port, size in SIZES.items() if "command" in port or "limit" in port}
MEASURED = {port: np.full(size, 0.01) for port, size in SIZES.items() if "measured" in port}
LATE = [{"kind": "latency", "delay": 0.02, "jitter": 0.01}, {"kind": "loss", "share": 0.01}]


def ask(guard, time, **changes):
    """A full set of commands; `changes` by port with _ for the dot."""
    said = START | {port.replace("__", "."): np.asarray(value, float) for port, value in changes.items()}
    for row in COMMANDS:
        guard.take(row.key, {port: said[port] for port in row.read(row.encode(0, said))}, MEASURED, time)


# ---------------------------------------------------------------- the guard


def test_fresh_commands_pass():
    guard = Guard(START, 0.1, SPEED)
    ask(guard, 1.0, base__twist_command=[0.3, 0.1])
    targets = guard.targets(MEASURED, False, 1.09)
    assert targets.keys() == START.keys() and not guard.faults(1.09)
    np.testing.assert_array_equal(targets["base.twist_command"], [0.3, 0.1])
    np.testing.assert_array_equal(targets[ARM], START[ARM])


def test_commands_older_than_100_ms_stop_the_joints_where_they_are_and_the_base():
    guard = Guard(START, 0.1, SPEED)
    ask(guard, 1.0, base__twist_command=[0.3, 0.1])
    targets = guard.targets(MEASURED, False, 1.0 + 0.1 + 1e-9)
    np.testing.assert_array_equal(targets["base.twist_command"], 0)
    np.testing.assert_array_equal(targets[ARM], MEASURED["left_arm.position_measured"])
    np.testing.assert_array_equal(targets["left_gripper.force_limit"], START["left_gripper.force_limit"])
    assert "left_arm.command late" in guard.faults(1.2)
    moved = {port: value + 0.1 for port, value in MEASURED.items()}
    assert guard.targets(moved, False, 1.3)[ARM][0] == 0.01, "held where it stopped, not where it sags to"


def test_a_joint_that_was_stopped_goes_slowly_to_its_new_commands():
    guard = Guard(START, 0.1, SPEED)
    ask(guard, 1.0)
    guard.targets(MEASURED, False, 1.2)
    path = []
    for k in range(60):
        ask(guard, 1.4 + k * TICK, left_arm__position_command=[0.11] * 6)
        path.append(guard.targets(MEASURED, False, 1.4 + k * TICK)[ARM][0])
    steps = np.diff([0.01, *path])
    assert np.all(steps >= 0) and steps.max() <= 0.3 * TICK + 1e-12 and path[-1] == 0.11


def test_before_the_first_command_nothing_is_late():
    guard = Guard(START, 0.1, SPEED)
    np.testing.assert_array_equal(guard.targets(MEASURED, False, 50.0)[ARM], START[ARM])
    assert not guard.faults(50.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"left_arm__position_command": [math.nan] * 6}, "left_arm.command refused: not finite"),
        ({"left_arm__position_command": [0.9] + [0.0] * 5}, "left_arm.command refused: 0.89 rad off"),
        ({"torso__position_command": [0, math.inf, 0]}, "torso.command refused: not finite"),
        ({"base__twist_command": [9.0, 0.0]}, "base.command refused: too fast"),
        ({"left_gripper__position_command": [3.0]}, "left_gripper.command refused: out of range"),
        ({"left_gripper__force_limit": [-1.0]}, "left_gripper.command refused: out of range"),
    ],
)
def test_a_broken_or_absurd_command_is_refused_and_reported(change, words):
    guard = Guard(START, 0.1, SPEED)
    ask(guard, 1.0)
    ask(guard, 1.05, **change)
    port = next(iter(change)).replace("__", ".")
    np.testing.assert_array_equal(guard.targets(MEASURED, False, 1.05)[port], START[port])
    assert any(fault.startswith(words) for fault in guard.faults(1.05))


def test_an_emergency_stop_leaves_the_fingers_to_their_commands():
    guard = Guard(START, 0.1, SPEED)
    ask(guard, 1.0, base__twist_command=[0.3, 0.1])
    assert guard.targets(MEASURED, True, 1.0)[ARM][0] == 0.01
    ask(guard, 1.01, left_gripper__position_command=[0.07])
    moved = {port: value + 0.1 for port, value in MEASURED.items()}
    targets = guard.targets(moved, True, 1.01)
    assert targets[ARM][0] == 0.01 and targets["left_gripper.position_command"][0] == 0.07
    np.testing.assert_array_equal(targets["base.twist_command"], 0)


@pytest.mark.parametrize(("device", "fastest"), [("left_arm", 1.5), ("right_arm", 2.5), ("torso", 2.0)])
def test_no_joint_is_faster_than_the_robot_allows_however_far_ahead_its_commands_are(device, fastest):
    guard = Guard(START, 0.1, SPEED)
    port = f"{device}.position_command"
    path, measured = [START[port]], dict(MEASURED)
    for k in range(128):
        measured[f"{device}.position_measured"] = path[-1]
        guard.take(f"{device}.command", {port: path[-1] + 0.45}, measured, k * TICK)
        path.append(guard.targets(measured, False, k * TICK)[port])
    speeds = np.diff(path, axis=0) / TICK
    assert speeds.max() == pytest.approx(fastest) and np.all(speeds <= fastest + 1e-9)
    assert f"{device}.command faster than the joints may move" in guard.faults(1.0)


def test_commands_within_the_joints_speed_pass_to_the_bit():
    guard = Guard(START, 0.1, SPEED)
    rng = np.random.default_rng(3)
    command = START[ARM].copy()
    for k in range(50):
        command = command + rng.uniform(-1, 1, 6) * 1.5 * TICK * 0.999
        guard.take("left_arm.command", {ARM: command}, MEASURED, k * TICK)
        np.testing.assert_array_equal(guard.targets(MEASURED, False, k * TICK)[ARM], command)
    assert not any("faster" in fault for fault in guard.faults(50 * TICK))


# ---------------------------------------------------------------- faults


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("{kind: gremlin}", ["faults[0].kind", "gremlin"]),
        ("{kind: nan, device: nose}", ["faults[0].device", "nose"]),
        ("{kind: nan, mode: dance}", ["faults[0].mode", "dance"]),
        ("{kind: loss, share: 2}", ["faults[0].share", "2"]),
        ("{kind: latency, delay: 0.01, jitter: 0.02}", ["faults[0].jitter"]),
        ("{kind: restart, device: base}", ["faults[0].duration"]),
        ("{kind: stuck, device: base}", ["faults[0].device", "torso"]),
    ],
)
def test_bad_faults_give_one_line(entry, words):
    with pytest.raises(ConfigError) as caught:
        scenarios.load("hardware.scenario.yaml", [f"faults=[{entry}]"])
    assert all(word in str(caught.value) for word in words) and "\n" not in str(caught.value)


def test_a_stuck_joint_that_the_robot_does_not_have_gives_one_line():
    scenario = scenarios.load("hardware.scenario.yaml", ["faults=[{kind: stuck, device: torso, joint: 3}]"])
    with pytest.raises(ConfigError, match=r"^faults\[0\]\.joint must be within \[0, 2\], got 3$"):
        rehearsal.make_twin(scenarios.resolve(scenario))


def test_a_fault_of_a_device_that_the_robot_does_not_have_gives_one_line(tmp_path):
    path = variant(tmp_path, without_base_joints, fixed)
    scenario = scenarios.load("hardware.scenario.yaml", [f"robot={path}", "faults=[{kind: dead, device: base}]"])
    with pytest.raises(ConfigError, match=r"^faults\[0\]\.device must be one that the robot has, got 'base'$"):
        rehearsal.make_twin(scenarios.resolve(scenario))


def test_a_torso_without_joints_is_neither_late_nor_faster_than_it_may_move():
    none = {f"torso.position_{what}": np.zeros(0) for what in ("command", "measured")}
    guard = Guard(START | {"torso.position_command": np.zeros(0)}, 0.1, SPEED | {"torso": np.zeros(0)})
    targets = guard.targets(MEASURED | none, False, 0.0)
    assert targets["torso.position_command"].shape == (0,) and guard.faults(0.0) == []


def test_a_fault_begins_with_its_mode_and_lasts_for_its_duration():
    faults = Faults([FaultConfig("nan", "left_arm", "turn", start=1.0, duration=2.0)], seed=1)
    assert not faults.acts("nan", "left_arm", 50.0)
    faults.enter("turn", 60.0)
    faults.enter("turn", 62.5)  # again: it is the first entry that counts
    acting = [time for time in (60.9, 61.0, 62.9, 63.0) if faults.acts("nan", "left_arm", time)]
    assert acting == [61.0, 62.9] and not faults.acts("nan", "right_arm", 61.0)


def test_a_joint_that_sticks_again_does_so_where_it_is_then():
    first = FaultConfig(kind="stuck", device="left_arm", joint=1, start=1.0, duration=1.0)
    faults = Faults([first, dc.replace(first, start=5.0)], 0)

    def joint(time, measured):
        return faults.stuck("left_arm", time, np.full(3, 9.0), np.full(3, measured)).tolist()

    assert joint(1.0, 0.3) == joint(1.5, 0.4) == [9.0, 0.3, 9.0]
    assert joint(3.0, 0.5) == [9.0, 9.0, 9.0]
    assert joint(5.0, 0.7) == joint(5.5, 0.8) == [9.0, 0.7, 9.0]


def test_a_restarted_device_is_silent_and_then_its_clock_begins_anew():
    faults = Faults([FaultConfig("restart", "torso", start=5.0, duration=1.0)], seed=1)
    assert faults.silent("torso", 5.5) and not faults.silent("torso", 6.0) and not faults.silent("base", 5.5)
    assert faults.clock("torso", 5.5) == 5.5 and faults.clock("torso", 6.25) == 0.25
    assert faults.clock("base", 6.25) == 6.25


def deliver(faults, ticks=400, newest_only=False):
    got = []
    wire = Wire(faults, lambda key, message: got.append((round(now / TICK), message)), newest_only)
    for k in range(ticks + 20):
        now = k * TICK
        if k < ticks:
            wire.put("torso.status", k, now)
        wire.pass_on(now)
    return got


def test_a_whole_wire_delivers_everything_at_once_and_in_order():
    assert deliver(Faults([], 1)) == [(k, k) for k in range(400)]


def test_latency_is_within_its_bounds_and_overtakes():
    got = deliver(Faults([FaultConfig("latency", delay=0.02, jitter=0.01)], 1))
    late = np.array([when - sent for when, sent in got])
    assert len(got) == 400 and late.min() == 2 and late.max() == 4
    assert any(b[1] < a[1] for a, b in zip(got, got[1:]))


def test_loss_duplicates_and_reordering_have_their_share():
    assert 300 < len(deliver(Faults([FaultConfig("loss", share=0.1)], 1))) < 390
    assert 410 < len(deliver(Faults([FaultConfig("duplicate", share=0.1)], 1))) < 490
    order = [sent for _, sent in deliver(Faults([FaultConfig("reorder", share=0.1)], 1))]
    assert sorted(order) == list(range(400)) and order != sorted(order)


def test_chance_is_the_seeds():
    def lost(seed):
        return deliver(Faults([FaultConfig("loss", share=0.1)], seed))

    assert lost(1) == lost(1) != lost(2)


def test_a_wire_into_a_receiver_with_room_for_one_brings_the_newest():
    got = deliver(Faults([FaultConfig("duplicate", share=1.0)], 1), newest_only=True)
    assert got == [(k, k) for k in range(400)]


# ---------------------------------------------------------------- pace


def test_a_pacer_keeps_its_period_counts_what_is_late_and_makes_nothing_up(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("valve_drake.pace.wall.monotonic", lambda: clock[0])
    pacer = Pacer(0.01, idle=lambda left: clock.__setitem__(0, clock[0] + left))
    begun = []

    def work(took):
        begun.append(clock[0])
        clock[0] += took

    for took in (0.002, 0.003, 0.025, 0.001, 0.001):
        pacer.tick(lambda took=took: work(took))
    np.testing.assert_allclose(begun, [0, 0.01, 0.02, 0.045, 0.055])
    pace = pacer.report(7.0)
    assert (pace.ticks, pace.missed, pace.time) == (5, 1, 7.0)
    assert pace.lost == pytest.approx(0.015) and pace.longest == pytest.approx(0.025)
    assert pace.median == pytest.approx(0.002)


def test_what_follows_the_commands_is_not_of_a_ticks_time_but_can_make_the_next_one_late(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("valve_drake.pace.wall.monotonic", lambda: clock[0])
    pacer = Pacer(0.01, idle=lambda left: clock.__setitem__(0, clock[0] + left))

    def passes(seconds):
        clock[0] += seconds

    for after in (0.001, 0.012, 0.001):
        pacer.tick(lambda: passes(0.002), lambda after=after: passes(after))
    pace = pacer.report(0.0)
    assert pace.longest == pytest.approx(0.002)
    assert pace.missed == 1 and pace.lost == pytest.approx(0.004)
    assert clock[0] == pytest.approx(0.027)


def test_what_a_pacer_tells_of_days_is_right_and_made_within_a_tick(monkeypatch):
    """A run that waits for its operators has no end, and the report of all its ticks is made in one of them."""
    clock = [0.0]
    monkeypatch.setattr("valve_drake.pace.wall.monotonic", lambda: clock[0])
    pacer = Pacer(0.01, idle=lambda left: clock.__setitem__(0, clock[0] + left))
    times = np.random.default_rng(0).lognormal(np.log(0.002), 0.5, 20_000)
    for seconds in times.tolist():
        pacer.tick(lambda seconds=seconds: clock.__setitem__(0, clock[0] + seconds))
    pace = pacer.report(0.0)
    assert pace.median == pytest.approx(float(np.median(times)), rel=5e-3)
    assert pace.p99 == pytest.approx(float(np.quantile(times, 0.99)), rel=1e-2)
    assert pace.ticks == 20_000 and pace.longest == pytest.approx(times.max())
    assert sum(len(value) for value in vars(pacer).values() if hasattr(value, "__len__")) < 10_000  # however many ticks


# ---------------------------------------------------------------- the whole, in one process


def near(*overrides):
    """A start from which the valve is soon reached."""
    quick = ["simulation.start.distance=2.6", "simulation.start.bearing=0.1", "simulation.start.heading=0.1"]
    return scenarios.load("hardware.scenario.yaml", ["seed=1", "hardware.lockstep=true", *quick, *overrides])


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """One second of the program against its twin, without any network."""
    path = tmp_path_factory.mktemp("twin") / "short.mcap"
    scenario = near()
    with rehearsal.beside(scenario) as (link, twin):
        result = runner.run(scenario, path, link=link, duration=1.0)
        return result, path, twin


@pytest.mark.system
def test_the_program_drives_the_twin_through_lcm(short):
    result, path, twin = short
    assert result.summary.spans[1].mode == Mode.SEARCH and twin.tick == 128
    log = LogReader(path)
    assert log.damage == [] and log.topics["/head_left/image"].count > 0
    last = [m for _, _, m in log.messages(["/joint_states"])][-1]
    neck = {joint.name: joint.position for joint in last.joints}
    assert abs(neck["neck_yaw"]) > 0.01 or abs(neck["neck_pitch"]) > 0.01, "the gaze has moved"


@pytest.mark.system
def test_no_command_waits_for_an_image(monkeypatch):
    done = []
    send, look = RobotLink.send, ColorSegmentationSystem.step
    monkeypatch.setattr(RobotLink, "send", lambda *args: done.append("send") or send(*args))
    monkeypatch.setattr(ColorSegmentationSystem, "step", lambda *args: done.append("look") or look(*args))
    scenario = scenarios.resolve(near())
    with rehearsal.beside(scenario) as (link, _):
        system = diagram.make_diagram(scenario, link=link)
        simulator = Simulator(system.diagram)
        diagram.command(system, simulator.get_mutable_context(), OperatorCommand(0, scenario.command))
        simulator.Initialize()
        simulator.AdvanceTo(TICK + 2.9 * SLOT)  # the first look is due in tick 1
        assert done == ["send"]
        simulator.AdvanceTo(TICK + 3.4 * SLOT)
        assert done == ["send", "send", "look"]


@pytest.mark.system
def test_in_lock_step_all_devices_are_fresh_and_nothing_is_refused(short):
    log = LogReader(short[1])
    health = [log.decode(record) for record in log.records(["/health"])]
    assert len(health) > 30
    assert not any(h.faults or h.estop for h in health)
    assert max(np.max(h.ages[: len(REPORTS)]) for h in health) == 0


@pytest.mark.system
def test_the_same_seed_gives_the_same_log_to_the_byte(short, tmp_path):
    _, path, _ = short
    scenario = near()
    with rehearsal.beside(scenario) as (link, _):
        runner.run(scenario, tmp_path / "again.mcap", link=link, duration=1.0)
    assert (tmp_path / "again.mcap").read_bytes() == path.read_bytes()


@pytest.mark.system
def test_a_twin_that_lives_by_the_clock_sends_the_images_that_are_asked_for_and_no_others():
    scenario = scenarios.resolve(near("hardware.lockstep=false"))
    lcm, seen = DrakeLcm("memq://"), []
    bus = Bus(scenario.hardware, lcm)
    bus.listen(ROBOT, lambda key, message: seen.append(message.images[0].header) if key.endswith(".image") else None)
    with rehearsal.LiveImages(*rehearsal.rig_of(scenario)) as images:
        twin = rehearsal.make_twin(scenario, workers=images, lcm=lcm)
        begin = wall.monotonic()
        while len(seen) < 2:
            assert wall.monotonic() - begin < 60
            bus.say(REQUEST, 0, {camera: camera == "left_wrist" for camera in CAMERAS})
            twin.hear()
            twin.report()
            twin.move()
            while bus.pump():
                pass
    assert {header.frame_name for header in seen} == {"left_wrist"}
    assert 0 < seen[0].seq < seen[1].seq and seen[0].utime > 0


class SlowImages(rehearsal.LiveImages):
    """Images that never come."""

    def _ask(self, name, capture):
        self._asked[name][capture.sequence] = capture

    def _receive_all(self):
        pass


def test_images_are_begun_as_seldom_as_the_rate_allows_and_of_both_eyes(monkeypatch):
    clock, begun, images = [100.0], [], SlowImages()
    monkeypatch.setattr("valve_drake.stations.twin.wall.monotonic", lambda: clock[0])
    images.want({"head_left", "head_right"})
    images.period = lambda camera: 0.25
    for k in range(1, 9):
        clock[0] += 0.125
        for camera in CAMERAS:
            images.captured(camera, Capture(k * 0.125, k, np.zeros(1)))
        for camera in CAMERAS:  # what was begun is there at once
            begun += [(camera, sequence) for sequence in images._asked[camera]]
            images._asked[camera].clear()
    assert begun == [(eye, k) for k in (1, 3, 5, 7) for eye in ("head_left", "head_right")]


def test_a_renderer_that_does_not_get_its_share_goes_before_other_programs_until_its_image_is_there(monkeypatch):
    clock, hurried = [100.0], []
    monkeypatch.setattr("valve_drake.stations.twin.wall.monotonic", lambda: clock[0])
    monkeypatch.setattr("valve_drake.stations.twin.hurries", lambda *change: hurried.append(change))
    images = SlowImages()
    monkeypatch.setattr(images, "_worker", lambda name: SimpleNamespace(pid=7 if name.endswith("left") else 8))
    images.want({"head_left", "head_right"})
    images.captured("head_left", Capture(0.125, 1, np.zeros(1)))
    clock[0] += OVERDUE + 0.01
    images.ready()
    assert not hurried, "where the loops cannot go first, nobody goes before the program's loop"
    images.yield_to(True)
    for _ in range(3):
        images.ready()
        assert hurried == [(7, True)]
    images._asked["head_left"].clear()
    images.ready()
    assert hurried == [(7, True), (7, False)]


def test_a_camera_without_images_is_named_before_it_looks_dead(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("valve_drake.stations.twin.wall.monotonic", lambda: clock[0])
    scenario = scenarios.resolve(near("hardware.lockstep=false"))
    lcm, faults = DrakeLcm("memq://"), []
    rate = CameraRate(limits(scenario.simulation.camera, scenario.supervisor.max_age), lambda line: None)
    bus = Bus(scenario.hardware, lcm)
    bus.listen(ROBOT, lambda key, message: faults.append(message.coord) if key == STATE else None)
    twin = rehearsal.make_twin(scenario, workers=SlowImages(), rate=rate, lcm=lcm)
    while twin.time < 1.0:
        bus.say(REQUEST, 0, dict.fromkeys(CAMERAS, 1.0))
        clock[0] += TICK
        twin.hear()
        twin.report()
        twin.move()
        while bus.pump():
            pass
    words = "the twin has not made an image of "
    slow = [any(name.startswith(words) for name in names) for names in faults]
    assert not any(name.endswith("slower than real time") for name in faults[-1])
    rate.judge(0.6, {})
    for _ in range(5):
        twin.report()
        twin.move()
    bus.pump()
    assert "the twin is 60 % slower than real time" in faults[-1], "and the program is told why"
    first = slow.index(True) * scenario.hardware.robot_period
    assert all(slow[slow.index(True) :]) and first < scenario.supervisor.max_age["head_left"] - 0.1


def test_the_twins_clock_runs_on_when_its_time_does_not():
    clock = RobotClock()
    clock.fell_behind(1.0, 0.0)
    clock.fell_behind(2.0, 0.1)
    clock.fell_behind(3.0, 0.4)
    assert [clock.at(t) for t in (0.5, 1.99, 2.0, 2.5, 3.0, 4.0)] == pytest.approx([0.5, 1.99, 2.1, 2.6, 3.4, 4.4])


def test_in_lock_step_the_twin_ends_when_the_program_has_fallen_silent(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("valve_drake.stations.twin.wall.monotonic", lambda: clock[0])
    scenario = scenarios.resolve(near())
    lcm = DrakeLcm("memq://")
    twin = rehearsal.make_twin(scenario, lcm=lcm)
    clock[0] = 1000.0
    twin.poll()
    assert not twin.gone, "it waits for a program as long as it takes"
    Bus(scenario.hardware, lcm).say(SYNC[CONTROLLER], 0, {"tick": -1, "messages": 0})
    twin.poll()
    clock[0] += LOCKSTEP_TIME
    twin.poll()
    assert not twin.gone
    clock[0] += 1.0
    twin.poll()
    assert twin.gone


class Commanded:
    """A twin in this process whose base is commanded tick by tick."""

    def __init__(self):
        self.scenario = scenarios.resolve(near("hardware.lockstep=false"))
        self.lcm = DrakeLcm("memq://")
        self.twin = rehearsal.make_twin(self.scenario, lcm=self.lcm)
        self.bus = Bus(self.scenario.hardware, self.lcm)
        self.state = {}
        self.bus.listen(ROBOT, lambda key, message: self.state.update(state=message) if key == STATE else None)

    def drive(self, *commands):
        """A tick in which these arrive: (stamp [us], forward speed [m/s])."""
        self.twin.report()
        for stamp, forward in commands:
            self.bus.send("base.command", BASE.encode(stamp, {"base.twist_command": np.array([forward, 0.0])}))
            self.twin.hear()
        self.twin.move()

    def tick(self, count=1):
        for _ in range(count):
            self.twin.report()
            self.twin.move()
        while self.bus.pump():
            pass

    @property
    def told(self):
        """The base's forward speed that the twin's guard passes to the joints."""
        return float(self.twin._guard.targets(self.twin._measured, False, self.twin.time)["base.twist_command"][0])

    @property
    def faults(self):
        return set(self.state["state"].coord) - {"protocol", "estop", "torso", "left_arm", "right_arm"}


@pytest.fixture(scope="module")
def commanded():
    return Commanded()


def test_a_command_said_again_counts_as_none(commanded):
    c = commanded
    c.drive((1_000_000, 0.5))
    assert c.told == 0.5
    for _ in range(40):
        c.drive((1_000_000, 0.5))
    c.tick(4)
    assert c.told == 0.0 and "base.command late" in c.faults
    for _ in range(40):  # of another clock
        c.drive((500, 0.5))
    assert c.told == 0.0
    c.drive((10_000, 0.5))  # a program that began anew
    c.drive((20_000, 0.5))
    assert c.told == 0.5


def test_the_stamps_of_a_slow_twin_are_of_the_walls_clock():
    c = Commanded()
    c.tick(8)
    c.twin.fell_behind(0.25)
    c.tick(4)
    assert c.state["state"].timestamp == pytest.approx(1e6 * (c.twin.time + 0.25), abs=5e6 * TICK)


def test_a_second_programs_commands_are_refused_by_their_stamps_and_reported(commanded):
    c = commanded
    c.tick(20)
    for k in range(-2, 0):
        c.drive((100_000_000 + k * 7812, 0.1))
    for k in range(40):
        c.drive((100_000_000 + k * 7812, 0.1), (5_000_000_000 + k * 7812, 0.7))
    assert c.told == 0.1
    c.tick(4)
    assert "base.command refused: a stamp of another clock" in c.faults


def test_commands_count_as_none_while_two_programs_say_that_they_are_there(commanded):
    c = commanded
    c.tick(20)
    for bus in (Bus(c.scenario.hardware, c.lcm) for _ in range(2)):
        bus.announce(CONTROLLER)
    c.twin.hear()
    c.tick(20)
    c.drive((200_000_000, 0.5))
    c.tick(4)
    assert c.told == 0.0 and "base.command refused: two programs" in c.faults
    c.twin._bus.senders = Senders()


def test_another_robot_on_the_bus_is_reported(commanded):
    c = commanded
    Bus(c.scenario.hardware, c.lcm).announce(ROBOT)
    c.twin.hear()
    c.tick(4)
    assert "two robots on the bus" in c.faults
    with pytest.raises(OperationFailed, match="another robot or twin is on"):
        c.twin.claim(lambda: False)
    c.twin._bus.senders = Senders()


@pytest.mark.system
def test_whatever_is_sent_to_the_twin_it_goes_on_and_obeys_again(commanded):
    c = commanded
    for k, message in enumerate(bad_messages(np.random.default_rng(5), CONTROLLER, 1500)):
        on(c.bus, message)
        c.twin.hear()
        if k % 25 == 0:
            c.tick()
            assert np.all(np.isfinite(c.twin.read("base.odometry")))
    assert any("does not carry" in fault for fault in c.faults)
    for k in range(96):
        c.drive((900_000_000 + k * 7812, 0.25))
    c.tick(4)
    assert c.told == 0.25 and not {fault for fault in c.faults if not fault.endswith("late")}


def test_a_request_of_an_unknown_camera_is_none(commanded):
    c = commanded
    for names in ({"nose": 1.0}, {"head_left": math.nan}, {}):
        c.bus.say(REQUEST, 0, names)
        c.twin.hear()
        c.tick()
    assert c.twin._requested[1] == set()


def test_only_signed_commands_move_a_robot_with_a_key(tmp_path):
    (tmp_path / "key").write_text("a key that nobody else has")
    lcm, heard = DrakeLcm("memq://"), []
    signed = HardwareConfig(key_file=str(tmp_path / "key"))
    robot = Bus(signed, lcm)
    robot.listen(CONTROLLER, lambda key, message: heard.append((key, message)))
    message = BASE.encode(7, {"base.twist_command": np.array([0.5, 0.0])})
    packets = []
    lcm.Subscribe("VALVE_BASE_COMMAND", packets.append)
    Bus(HardwareConfig(), lcm).send("base.command", message)
    robot.pump()
    assert [type(m) for _, m in heard] == [BadMessage] and "not signed with hardware.key_file" in heard[0][1].words
    Bus(signed, lcm).send("base.command", message)
    robot.pump()
    assert BASE.read(heard[-1][1])["base.twist_command"][0] == 0.5
    lcm.Publish("VALVE_BASE_COMMAND", packets[-1])  # what somebody has recorded
    robot.pump()
    assert len(heard) == 2
    assert BASE.kind.decode(packets[-1]).timestamp == 7, "and it is still Drake's message to who only looks"


def test_first_images_that_take_long_are_told_and_can_be_stopped(monkeypatch):
    monkeypatch.setattr("valve_drake.stations.twin.STARTING", 0.05)
    images, told, stop = rehearsal.LiveImages(), [], iter([False] * 20 + [True])
    images.settle(lambda: next(stop), told.append)
    assert told == ["the twin waits for its renderers: no image yet of head_left, head_right, left_wrist, right_wrist"]


@pytest.mark.system
def test_a_hardware_log_replays_to_the_bit(short):
    result = runner.replay(LogReader(short[1]))
    assert result.comparison.identical, result.comparison.first


# ---------------------------------------------------------------- two processes

SPACE = ["unshare", "-rn", "sh", "-c", 'ip link set lo up && ip route add 224.0.0.0/4 dev lo && exec "$@"', "sh"]


def _space() -> str:
    """Why no network namespace can be made here; "" if one can."""
    if not all(map(shutil.which, ("unshare", "ip"))):
        return "no unshare or ip on this machine"
    tried = subprocess.run([*SPACE, "true"], capture_output=True, text=True)
    return "" if tried.returncode == 0 else f"no network namespace here: {tried.stderr.strip()}"


def two_processes(folder, run, twin, common=()):
    """Both commands in a network namespace of their own, so that nothing leaves the machine -> (run, twin) JSON."""
    (folder / "both.sh").write_text(
        'python=$1; "$python" -m valve_drake twin $TWIN $COMMON --json > twin.json & '
        '"$python" -m valve_drake run hardware.scenario.yaml $RUN $COMMON --log run.mcap --json > program.json; '
        "code=$?; wait $!; exit $code\n"
    )
    words = {"RUN": " ".join(run), "TWIN": " ".join(twin), "COMMON": " ".join(common)}
    done = subprocess.run(
        [*SPACE, "sh", "both.sh", sys.executable], cwd=folder, env=os.environ | words, capture_output=True, text=True
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done, [json.loads((folder / f"{name}.json").read_text()) for name in ("program", "twin")]


needs_space = pytest.mark.skipif(bool(_space()), reason=_space() or "-")


@needs_space
@pytest.mark.slow
@pytest.mark.parametrize("faults", [[], LATE], ids=["good wire", "20 ms late, 1 % lost"])
def test_the_whole_job_by_two_processes(tmp_path, faults):
    common = ["--lockstep", "--seed", "1", "--set", "hardware.answer_time=30"]
    twin = ["--set", f"faults={json.dumps(faults, separators=(',', ':'))}"] if faults else []
    done, (run, twin) = two_processes(tmp_path, [], twin, common)
    assert done.returncode == 0 and run["verdict"] == "turned"
    assert twin["valve_angle_true_rad"] == pytest.approx(run["valve_angle_estimated_rad"], abs=0.01)
    assert twin["valve_angle_true_rad"] == pytest.approx(math.pi / 2, abs=0.035)


@needs_space
@pytest.mark.slow
def test_real_time_is_kept_and_its_keeping_is_logged(tmp_path):
    common = ["--seed", "1", "--set", "hardware.answer_time=30"]
    _, (run, twin) = two_processes(tmp_path, ["--duration", "5"], [], common)
    assert run["sim_time_s"] == pytest.approx(5.0, abs=0.1)
    pace = run["pace"]
    assert pace["ticks"] == pytest.approx(640, abs=10) and pace["missed"] < 0.1 * pace["ticks"]
    logged = list(LogReader(tmp_path / "run.mcap").messages(["/pace"]))
    assert len(logged) >= 4 and twin["ticks"] > 640


@needs_space
@pytest.mark.slow
@pytest.mark.parametrize("name", ["INT", "TERM", "HUP"])
def test_a_signal_is_the_operators_stop_on_a_robot_too_and_the_log_is_complete(tmp_path, name):
    script = """
    "$0" -m valve_drake twin --lockstep --seed 1 --json > twin.json & twin=$!
    "$0" -m valve_drake run hardware.scenario.yaml --lockstep --seed 1 --log run.mcap --json > program.json & run=$!
    until [ "$(stat -c %s run.mcap.active 2> /dev/null || echo 0)" -gt 300000 ]; do sleep 0.1; done
    kill -$1 $run
    wait $run; code=$?
    wait $twin; exit $code
    """
    done = in_space(tmp_path, script.replace("$1", name))
    assert done.returncode == 1, done.stderr
    assert json.loads((tmp_path / "program.json").read_text())["verdict"] == "stopped"
    log = LogReader(tmp_path / "run.mcap")
    assert log.damage == [] and log.metadata["result"]["outcome"] == "stopped"
    twin = json.loads((tmp_path / "twin.json").read_text())
    assert twin["valve_angle_true_rad"] == pytest.approx(0, abs=1e-3)


def in_space(folder, script):
    """A script with `"$0" -m valve_drake` in a network of its own."""
    command = [*SPACE, "timeout", "120", "bash", "-c", script, sys.executable]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert "Traceback" not in done.stderr, done.stderr
    return done


@needs_space
@pytest.mark.slow
def test_a_twin_that_starts_late_is_waited_for(tmp_path):
    script = """
    "$0" -m valve_drake run hardware.scenario.yaml --lockstep --duration 0.2 --log run.mcap > run.txt & run=$!
    sleep 10
    "$0" -m valve_drake twin --lockstep > twin.txt & twin=$!
    wait $run; code=$?
    wait $twin; exit $code
    """
    done = in_space(tmp_path, script)
    assert done.returncode == 0, done.stderr
    assert "waiting up to 30 s for the robot: nothing yet on VALVE_BASE_STATUS" in done.stderr


@needs_space
@pytest.mark.slow
def test_a_second_twin_on_one_bus_is_refused_and_the_first_one_goes_on(tmp_path):
    script = """
    "$0" -m valve_drake twin --lockstep --duration 1000 > first.txt & first=$!
    sleep 15
    "$0" -m valve_drake twin --lockstep; code=$?
    kill -0 $first && kill -INT $first; wait $first
    exit $code
    """
    done = in_space(tmp_path, script)
    assert done.returncode == 1 and "another robot or twin is on udpm://" in done.stderr
    assert (tmp_path / "first.txt").read_text().startswith("0.0 s;")
