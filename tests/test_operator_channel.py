"""operator_channel: who commands, what was said, and what comes of it, whatever arrives."""

import dataclasses as dc
import math

import numpy as np
import pytest
from helpers import Rig, ports

from valve_drake.checks import ConfigError
from valve_drake.messages import (
    HandleMarks,
    Health,
    Mode,
    ModeState,
    OperatorCommand,
    OperatorPacket,
    OperatorPackets,
    RectangleEstimate,
    SelectorReport,
    Status,
)
from valve_drake.operator.operator_channel import OperatorChannelConfig, State, seen, step, tag
from valve_drake.operator.operator_channel_system import OperatorChannelSystem
from valve_drake.supervisor import supervisor
from valve_drake.supervisor.supervisor import HOLDS
from valve_drake.task.modes import RUNNING, TABLE, TERMINAL

DT = 1 / 32
ADA, BOB = 0xA0A, 0xB0B
QUARTER = math.pi / 2


class Desk:
    """Makes packets, with a clock of its own: 1000 s ahead."""

    def __init__(self, number=ADA, ahead=1000.0):
        self.number, self.ahead, self.sequence = number, ahead, 0
        self.words, self.said, self.score, self.typed = "", 0.0, 0.9, False

    def say(self, words, time, score=0.9, typed=False):
        self.sequence += 1
        self.words, self.said, self.score, self.typed = words, time + self.ahead, score, typed

    def packet(self, time):
        sent = time + self.ahead
        return OperatorPacket(
            self.number, sent, self.sequence, self.words, self.score, self.said, self.said, self.said, self.typed
        )


class Bench:
    """Channel and supervisor in a loop, with behaviours that succeed when `succeeds` says so, and a wire to cut."""

    def __init__(self, **config):
        self.config = OperatorChannelConfig(wire="lcm", **config)
        self.state, self.supervisor, self.time = State(), supervisor.State(), 0.0
        self.desks, self.delay, self.count = [Desk()], 0.02, 0
        self.wire: list[tuple[float, OperatorPacket]] = []  # (arrival, packet)
        self.local, self.turned, self.cut, self.faults = OperatorCommand(), 0.0, False, ()
        self.succeeds, self.commands = set(), []
        self._ticks = 0

    @property
    def mode(self):
        return self.supervisor.mode

    @property
    def shown(self):
        return self.state.shown

    def message(self):
        return self.supervisor.message(self.time, supervisor.SupervisorConfig())

    def tick(self):
        self.time += DT
        if self._ticks % 4 == 0 and not self.cut:
            self.wire += [(self.time + self.delay, desk.packet(self.time)) for desk in self.desks]
        self._ticks += 1
        arrived = tuple(packet for when, packet in self.wire if when <= self.time)
        self.wire = [(when, packet) for when, packet in self.wire if when > self.time]
        self.count += bool(arrived)
        packets = OperatorPackets(self.time, self.count, arrived)
        turning = Status(value=self.turned)
        before = self.state.command
        self.state = step(
            self.config, QUARTER, 12.6, self.state, self.time, packets, self.local, self.message(), turning, ""
        )
        if self.state.command is not before:
            self.commands.append(self.state.command.command)
        s = self.supervisor
        statuses = {}
        if s.mode in self.succeeds and TABLE[s.mode].owner:
            statuses = {TABLE[s.mode].owner: Status(activation=s.activation, state="succeeded")}
        health = Health(time=self.time, faults=self.faults)
        self.supervisor = supervisor.step(
            supervisor.SupervisorConfig(),
            s,
            self.time,
            statuses,
            health,
            self.state.command,
            SelectorReport(time=self.time),
        )

    def run(self, seconds=0.3):
        for _ in range(math.ceil(seconds / DT)):
            self.tick()
        return self

    def say(self, words, desk=0, **facts):
        self.desks[desk].say(words, self.time, **facts)
        return self.run()

    def to(self, mode):
        """Lets the behaviours succeed until the robot has come to `mode`."""
        self.succeeds = set(RUNNING) - {mode}
        for _ in range(1000):
            if self.mode == mode:
                return self
            self.tick()
        raise AssertionError(f"in {self.mode}, not in {mode}")

    def opening(self, mode=Mode.SEARCH):
        self.run()
        self.say("robot open the valve")
        self.say("confirm")
        return self.to(mode)


# ---------------------------------------------------------------- words to commands


def test_words_read_back_and_confirmed_begin_a_run_and_its_verdict_is_told():
    bench = Bench().run()
    assert bench.shown.linked and bench.shown.speaker == ADA
    bench.say("robot open by thirty degrees")
    assert (bench.shown.outcome, bench.shown.says, bench.mode) == (
        "asked",
        "open by 30 degrees: say confirm",
        Mode.IDLE,
    )
    bench.say("confirm")
    assert (bench.shown.outcome, bench.shown.heard, bench.shown.task) == ("given", 2, 2)
    assert bench.mode == Mode.SEARCH and bench.supervisor.turn_angle == pytest.approx(math.radians(30))
    assert not bench.shown.done
    bench.to(Mode.DONE).run()
    assert (bench.shown.done, bench.shown.verdict) == (True, "turned")
    assert bench.shown.says.startswith("turned: ")


@pytest.mark.parametrize("mode", RUNNING)
def test_stop_is_obeyed_in_every_mode_within_a_tenth_of_a_second(mode):
    bench = Bench().opening(mode)
    bench.desks[0].say("stop", bench.time)
    bench.wire += [(bench.time, bench.desks[0].packet(bench.time + 1e-3))]  # as the desk does: at once
    bench.run(0.1)
    assert bench.commands[-1] == "stop"
    assert bench.mode == Mode.STOPPED or bench.supervisor.after_release == Mode.STOPPED
    bench.succeeds = set(RUNNING)
    bench.run(3.0)
    assert (bench.mode, bench.shown.verdict) == (Mode.STOPPED, "stopped")


def test_after_a_stop_or_a_success_a_new_move_needs_no_reset():
    bench = Bench().opening(Mode.TURN)
    bench.say("stop")
    bench.to(Mode.STOPPED).run()
    bench.succeeds = set()
    bench.say("robot close")
    bench.say("confirm").run(0.2)
    assert bench.commands == ["open", "stop", "reset", "close"]
    assert bench.mode == Mode.FOLD and bench.supervisor.turn_angle == -QUARTER
    assert bench.to(Mode.SEARCH).supervisor.entered == (Mode.FOLD, Mode.RETREAT, Mode.SEARCH)
    bench.to(Mode.DONE).run()
    bench.succeeds = set()
    bench.say("robot open")
    assert bench.say("confirm").run(0.2).mode == Mode.SEARCH


def test_after_a_failure_only_reset_leads_on_and_it_is_confirmed_too():
    bench = Bench().opening()
    bench.faults = ("no power",)
    bench.run(0.1)
    bench.faults = ()
    assert bench.run().mode == Mode.FAILED and bench.shown.verdict == "fault"
    bench.say("robot open")
    assert bench.shown.outcome == "refused" and "say reset" in bench.shown.says
    bench.say("confirm")
    assert bench.mode == Mode.FAILED
    bench.say("robot reset")
    assert bench.mode == Mode.FAILED
    assert bench.say("confirm").mode == Mode.IDLE


@pytest.mark.parametrize("mode", RUNNING)
def test_no_second_move_begins_while_one_is_under_way(mode):
    bench = Bench().opening(mode)
    entered = bench.supervisor.activation
    bench.say("robot close")
    assert bench.shown.outcome == "refused" and f"{mode} is under way" in bench.shown.says
    bench.say("confirm")
    assert bench.commands == ["open"] and bench.supervisor.activation == entered


def test_stop_between_confirm_and_the_reset_that_goes_before_its_move_leaves_the_robot_still():
    bench = Bench().opening()
    bench.say("stop").run()
    bench.say("robot close")
    bench.desks[0].say("confirm", bench.time)
    first = bench.desks[0].packet(bench.time)
    bench.desks[0].say("stop", bench.time)
    second = dc.replace(bench.desks[0].packet(bench.time), sent=first.sent + 1e-3)
    bench.wire += [(bench.time, first), (bench.time, second)]
    bench.run(1.0)
    assert bench.commands[-1] == "stop" and "close" not in bench.commands
    assert bench.mode == Mode.STOPPED


def test_more_than_the_robot_can_turn_is_refused():
    config = OperatorChannelConfig(wire="lcm")
    desk = Desk()
    desk.say("robot open by 100 degrees", 0.0)
    packets = OperatorPackets(0.1, 1, (desk.packet(0.1),))
    state = step(config, QUARTER, 1.5, State(), 0.1, packets, OperatorCommand(), ModeState(), Status(), "")
    assert (state.shown.outcome, state.shown.says) == ("refused", "not now: it can turn by 86 degrees at most")


def test_the_programs_own_stop_needs_no_ear():
    bench = Bench().opening()
    bench.local = OperatorCommand(sequence=1, command="stop")
    assert bench.run(0.1).mode == Mode.STOPPED


def test_status_says_mode_and_angle():
    bench = Bench().opening(Mode.TURN)
    bench.turned = math.radians(42.3)
    bench.run()
    bench.say("robot status")
    assert bench.shown.says.startswith("turn, ") and "42 degrees turned" in bench.shown.says


# ---------------------------------------------------------------- the wire: lost, doubled, late, said again


def moved_on(bench, seconds=1.4):
    bench.cut = True
    return bench.run(seconds)


@pytest.mark.parametrize("mode", RUNNING)
@pytest.mark.parametrize("on_loss", ["finish", "hold", "stop"])
def test_a_lost_link_in_a_run_leads_where_the_scenario_says(mode, on_loss):
    bench = Bench(on_loss=on_loss).opening(mode)
    moved_on(bench)
    assert bench.state.lost and not bench.shown.linked
    if TABLE[mode].ending or on_loss == "finish":
        assert (bench.commands, bench.mode) == (["open"], mode)
    elif on_loss == "hold" and mode in HOLDS:
        assert bench.commands == ["open", "hold"]
        assert (bench.mode, bench.supervisor.held) == (mode, True)
    else:
        assert bench.commands == ["open", "stop"]
        assert bench.shown.says.startswith("the link is lost") or bench.shown.done
        bench.run(0.2)
        assert bench.mode == Mode.STOPPED
        assert (Mode.RELEASE in bench.supervisor.entered) == TABLE[mode].contact


def test_a_desk_that_leaves_gives_the_ear_back_at_once_and_loses_its_link():
    bench = Bench().opening(Mode.TURN)
    bench.cut = True
    last = dc.replace(bench.desks[0].packet(bench.time + DT), words="", leaves=True)
    bench.wire.append((bench.time, last))
    bench.run(0.1)
    assert bench.commands == ["open", "hold"] and bench.shown.says == "the operator has left: the grasp is held"
    bench.desks, bench.cut = [Desk(BOB)], False
    assert bench.run(0.2).shown.speaker == BOB
    assert bench.say("confirm").commands[-1] == "resume"


def test_the_way_off_the_valve_leads_to_no_new_search_or_grasp_while_the_link_is_lost():
    """Here: of a run that begins near the valve."""
    bench = Bench().opening(Mode.MEASURE)
    bench.say("stop").run()
    bench.succeeds = set()
    bench.say("robot close")
    bench.say("confirm").run()
    assert bench.to(Mode.RETREAT).supervisor.clearing
    moved_on(bench)
    assert bench.mode == Mode.RETREAT and bench.state.lost
    bench.succeeds = set(RUNNING)
    assert bench.run(0.5).mode == Mode.STOPPED and Mode.ROUGH_APPROACH not in bench.supervisor.entered


def test_a_short_gap_is_no_loss():
    bench = Bench().opening(Mode.TURN)
    moved_on(bench, 0.8).cut = False
    assert not bench.run().state.lost and bench.commands == ["open"]


def test_a_held_turn_goes_on_by_confirm_or_ends_by_stop_and_no_deadline_runs_meanwhile():
    for words, command in (("confirm", "resume"), ("stop", "stop")):
        bench = Bench().opening(Mode.TURN)
        moved_on(bench, 100.0)
        assert bench.mode == Mode.TURN and bench.supervisor.held  # its deadline is 60 s and 20 s a radian
        bench.cut = False
        bench.run()
        assert "say confirm to go on" in bench.shown.says
        bench.say("the weather")
        assert bench.commands == ["open", "hold"]
        bench.say(words)
        assert bench.commands[-1] == command
        bench.succeeds = set(RUNNING)
        end = Mode.DONE if words == "confirm" else Mode.STOPPED
        assert bench.run(3.0).mode == end


def test_a_turn_that_is_held_for_too_long_is_let_go():
    bench = Bench().opening(Mode.TURN)
    moved_on(bench, supervisor.SupervisorConfig().hold_time + 1.5)
    assert bench.run().mode == Mode.STOPPED and bench.supervisor.entered[-2:] == (Mode.RELEASE, Mode.STOPPED)


def test_what_waits_for_confirm_is_forgotten_when_the_link_is_lost():
    bench = Bench().run()
    bench.say("robot open")
    moved_on(bench, 1.5).cut = False
    bench.run()
    bench.say("confirm")
    assert bench.commands == [] and bench.mode == Mode.IDLE


def test_packets_that_are_doubled_or_overtaken_count_once():
    rng = np.random.default_rng(5)
    bench = Bench().run()
    for words in ("robot open", "confirm", "stop", "robot close", "confirm"):
        bench.desks[0].say(words, bench.time)
        for _ in range(12):
            bench.tick()
            copies = [bench.wire[int(k)] for k in rng.integers(len(bench.wire), size=3)] if bench.wire else []
            bench.wire += [(when + float(rng.uniform(0, 0.3)), packet) for when, packet in copies]
            rng.shuffle(bench.wire)
    assert bench.commands == ["open", "stop", "reset", "close"]


def test_old_packets_said_again_move_nothing():
    """A confirm of long ago, with or without a desk, and after another one took over."""
    bench = Bench().run()
    bench.say("robot open")
    bench.desks[0].say("confirm", bench.time)
    old = [bench.desks[0].packet(bench.time)]
    bench.run()
    bench.say("stop").run()
    bench.say("robot close")
    bench.wire += [(bench.time, packet) for packet in old]
    bench.run()
    assert bench.commands == ["open", "stop"]
    moved_on(bench, 5.0)
    bench.desks = [Desk(BOB)]
    bench.cut = False
    bench.run()
    bench.say("robot close")
    bench.wire += [(bench.time, packet) for packet in old]
    bench.run()
    assert bench.commands == ["open", "stop"] and bench.shown.speaker == BOB


def test_words_that_come_late_are_refused_but_a_stop_is_obeyed():
    bench = Bench().run(2.0)
    bench.desks[0].say("robot open", bench.time - 2.0)  # the desk could not send them before
    bench.run()
    assert bench.shown.outcome == "refused" and "say it again" in bench.shown.says
    bench = Bench().opening()
    bench.desks[0].say("stop", bench.time - 5.0)
    assert bench.run().commands[-1] == "stop"


def test_a_wire_that_becomes_three_seconds_late_is_a_lost_link():
    bench = Bench().opening(Mode.ROUGH_APPROACH)
    bench.delay = 3.0
    bench.run(5.0)
    assert bench.mode == Mode.STOPPED and bench.state.lost


def test_clocks_may_be_apart_and_drift():
    for ahead in (-1e6, 0.0, 1e9):
        bench = Bench()
        bench.desks = [Desk(ahead=ahead)]
        bench.run()
        for _ in range(20):
            bench.desks[0].ahead -= 0.004  # 2e-4 of 20 s
            bench.run(20.0)
        bench.say("robot open")
        assert bench.say("confirm").mode == Mode.SEARCH


# ---------------------------------------------------------------- two operators


def test_a_second_operator_is_refused_by_name_and_told_so_but_may_stop():
    bench = Bench().opening()
    bench.desks.append(Desk(BOB, ahead=-50.0))
    bench.run()
    bench.say("robot close", desk=1)
    assert bench.shown.says == f"operator {tag(BOB)} is refused, operator {tag(ADA)} commands"
    assert (bench.shown.other, bench.shown.speaker) == (BOB, ADA)
    bench.say("confirm", desk=1)
    assert bench.commands == ["open"]
    bench.say("stop", desk=1)
    assert bench.commands == ["open", "stop"]
    assert bench.run(1.0).commands == ["open", "stop"]  # once


def test_a_stop_of_anybody_forgets_what_waits_for_confirm():
    for stop in ("other", "local"):
        bench = Bench().run()
        bench.desks.append(Desk(BOB))
        bench.say("robot open")
        if stop == "other":
            bench.say("stop", desk=1)
        else:
            bench.local = OperatorCommand(sequence=1, command="stop")
            bench.run()
        bench.say("confirm")
        assert bench.commands == ["stop"]


def test_a_second_operators_confirm_does_not_confirm_the_firsts_move():
    bench = Bench().run()
    bench.desks.append(Desk(BOB))
    bench.say("robot open")
    bench.say("confirm", desk=1)
    assert bench.commands == []
    assert bench.say("confirm").commands == ["open"]


def test_the_ear_goes_to_another_operator_when_the_first_has_fallen_silent():
    bench = Bench().opening()
    bench.desks.append(Desk(BOB))
    ada = bench.desks.pop(0)
    bench.run(1.5)
    assert bench.shown.speaker == BOB and bench.mode == Mode.STOPPED
    bench.desks.append(ada)
    bench.run()
    assert bench.shown.speaker == BOB
    bench.say("robot close", desk=1)
    assert "is refused" in bench.shown.says


# ---------------------------------------------------------------- whatever comes


def test_whatever_arrives_nothing_moves_without_a_move_that_was_read_back_and_confirmed():
    rng = np.random.default_rng(1)
    wild = (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e300, 0.7)
    texts = (
        "",
        "robot",
        "open",
        "robot open",
        "robot close by 7000 degrees",
        "half",
        "reset",
        "robot reset",
        "\x00",
        "x" * 500,
    )
    bench = Bench()
    for _ in range(3000):
        packet = OperatorPacket(
            speaker=int(rng.choice([0, 1, ADA, BOB, 2**52])),
            sent=float(rng.choice([*wild, bench.time])),
            sequence=int(rng.integers(0, 2**40)),
            words=str(rng.choice(texts)),
            score=float(rng.choice([0.0, 0.3, 1.0, math.nan])),
            said=float(rng.choice([*wild, bench.time])),
            typed=bool(rng.integers(2)),
        )
        bench.wire.append((bench.time, packet))
        bench.tick()
        assert len(bench.state.speakers) <= 8
    assert "open" not in bench.commands and "close" not in bench.commands


def test_a_story_of_random_words_and_links_always_leaves_the_supervisor_in_a_known_state():
    rng = np.random.default_rng(2)
    words = ("robot open", "confirm", "stop", "robot close half", "robot reset", "cancel", "robot status", "noise")
    bench = Bench().run()
    for _ in range(800):
        if rng.random() < 0.5:
            bench.desks[0].say(str(rng.choice(words)), bench.time)
        bench.cut = bool(rng.random() < 0.2)
        bench.delay = float(rng.choice([0.0, 0.02, 0.3]))
        bench.succeeds = set(RUNNING) if rng.random() < 0.5 else set()
        bench.run(float(rng.uniform(0.1, 2.0)))
        assert not (bench.supervisor.held and bench.mode not in HOLDS)
    bench.cut, bench.delay, bench.succeeds = False, 0.02, set(RUNNING)
    bench.run(3.0)
    bench.say("stop")
    bench.run(10.0)
    assert bench.mode in TERMINAL and bench.shown.done


# ---------------------------------------------------------------- block


def test_what_the_cameras_see_is_told_of_those_that_the_mode_looks_at():
    estimate = RectangleEstimate(found=True, X_LV=np.column_stack([np.eye(3), [0.0, 0.6, 0.8]]))
    assert seen(ModeState(), estimate, HandleMarks()) == ""
    assert seen(ModeState(head_every=1), estimate, HandleMarks()) == "marker at 1.00 m"
    assert seen(ModeState(head_every=1), RectangleEstimate(reason="too small"), HandleMarks()) == "no marker: too small"
    assert seen(ModeState(wrist_every=1), estimate, HandleMarks()) == "green marks: none"


def test_ports_of_the_block_and_its_answer():
    config = OperatorChannelConfig(wire="lcm")
    inputs = dict.fromkeys(("packets", "local", "mode", "turning", "estimate", "marks"), "in abstract")
    block = OperatorChannelSystem(config, QUARTER, 12.6)
    assert ports(block) == inputs | {"command": "out abstract", "state": "out abstract"}
    desk = Desk(ahead=0.0)
    desk.say("stop", 0.0)
    rig = Rig(
        block,
        packets=OperatorPackets(0.0, 1, (desk.packet(0.0),)),
        mode=ModeState(),
        turning=Status(),
        estimate=RectangleEstimate(),
        marks=HandleMarks(),
    ).run(0.1)
    assert rig.read("command").command == "stop" and rig.read("state").outcome == "given"


@pytest.mark.parametrize("key, value", [("wire", "udp"), ("on_loss", "pray"), ("lease", 0.0), ("late", math.nan)])
def test_bad_config_is_refused_by_name(key, value):
    with pytest.raises(ConfigError, match=f"operator_channel.{key}"):
        OperatorChannelConfig(**{key: value}).check()
