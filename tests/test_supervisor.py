"""supervisor: the way through the modes; from every mode every mishap ends the run safely, in time, with a verdict."""

import dataclasses as dc

import numpy as np
import pytest
from helpers import Rig, assert_clones_are_independent, assert_holds_between_updates, ports

from valve_drake.checks import ConfigError
from valve_drake.messages import Cause, Health, Mode, ModeState, OperatorCommand, SelectorReport, Status, Verdict
from valve_drake.supervisor.supervisor import (
    FAILURES,
    HOLDS,
    State,
    SupervisorConfig,
    deadline,
    find_fault,
    step,
)
from valve_drake.supervisor.supervisor_system import SupervisorSystem
from valve_drake.task.modes import FIXED, RUNNING, TABLE, TERMINAL, WATCHED

DT = 1 / 32
CONFIG = SupervisorConfig()
OPEN = OperatorCommand(sequence=0, command="open", angle=1.5)
STOP = OperatorCommand(sequence=1, command="stop")
OWNER = {mode: TABLE[mode].owner for mode in RUNNING}
CONTACT = [mode for mode in RUNNING if TABLE[mode].contact]


class Bench:
    """The supervisor with behaviours that answer by a script: script(state) -> {block: Status fields}."""

    def __init__(self, state: State | None = None, time: float = 0.0):
        self.state, self.time = state or State(), time
        self.operator = OPEN
        self.modes = [self.state.mode]
        self.health: dict = {}
        self.selector: dict = {}
        self.health_delay = 0.0

    def tick(self, script=lambda state: {}, dt: float = DT) -> State:
        self.time += dt
        statuses = {
            block: Status(time=self.time, **{"activation": self.state.activation, **fields})
            for block, fields in script(self.state).items()
        }
        self.state = step(
            CONFIG,
            self.state,
            self.time,
            statuses,
            Health(time=self.time - self.health_delay, **self.health),
            self.operator,
            SelectorReport(time=self.time, **self.selector),
        )
        if self.state.activation != getattr(self, "_seen", None):
            self.modes.append(self.state.mode)
            self._seen = self.state.activation
        return self.state

    def until_end(self, script=lambda state: {}, dt: float = DT, limit: float = 2000.0) -> State:
        start = self.time
        while self.state.mode not in TERMINAL:
            self.tick(script, dt)
            assert self.time - start < limit, f"still in {self.state.mode} after {limit} s"
        return self.state


def succeed(state: State) -> dict:
    return {OWNER[state.mode]: {"state": "succeeded"}} if state.mode in OWNER else {}


def fail_in(mode: Mode, verdict="", detail="", times=99, cause=""):
    """All succeed but the owner of `mode`, which fails so many times."""
    left = [times]

    def script(state: State) -> dict:
        if state.mode == mode and left[0] > 0:
            left[0] -= 1
            return {OWNER[mode]: {"state": "failed", "verdict": verdict, "detail": detail, "cause": cause}}
        return succeed(state)

    return script


def bring_to(mode: Mode) -> Bench:
    """A run that has come to `mode` without mishap (idle and the final modes too)."""
    bench = Bench()
    if mode == Mode.IDLE:
        bench.state = dc.replace(bench.state, sequence=0)
    elif mode == Mode.STOPPED:
        bench.operator = STOP
        bench.tick()
    elif mode == Mode.FAILED:
        bench.until_end(fail_in(Mode.SEARCH, Verdict.NOT_FOUND))
    else:
        while bench.state.mode != mode:
            bench.tick(succeed)
    assert bench.state.mode == mode
    return bench


# ---------------------------------------------------------------- the way through


def test_a_run_without_mishap_goes_through_all_modes_and_ends_done_and_turned():
    bench = Bench()
    state = bench.until_end(succeed)
    assert bench.modes[1:] == [
        Mode.SEARCH,
        Mode.ROUGH_APPROACH,
        Mode.FINE_APPROACH,
        Mode.MEASURE,
        Mode.REACH,
        Mode.SERVO,
        Mode.GRASP,
        Mode.TURN,
        Mode.RELEASE,
        Mode.FOLD,
        Mode.VERIFY,
        Mode.RETREAT,
        Mode.DONE,
    ]
    assert (state.mode, state.verdict) == (Mode.DONE, Verdict.TURNED)


def test_idle_waits_for_the_operator_and_does_not_mind_faults():
    bench = Bench()
    bench.operator = None
    bench.health = {"estop": True}
    for _ in range(1000):
        bench.tick()
    assert bench.state.mode == Mode.IDLE


@pytest.mark.parametrize("command, sign", [("open", 1), ("close", -1)])
def test_the_command_gives_the_turn_its_sign(command, sign):
    bench = Bench()
    bench.operator = OperatorCommand(sequence=5, command=command, angle=0.7)
    bench.tick()
    assert bench.state.turn_angle == sign * 0.7
    assert bench.state.message(1.0, CONFIG).turn_angle == sign * 0.7


@pytest.mark.parametrize("angle", [0.0, -1.0, float("nan"), float("inf"), 100.0])
def test_an_impossible_angle_is_refused_with_the_reason(angle):
    bench = Bench()
    bench.operator = OperatorCommand(sequence=0, command="open", angle=angle)
    bench.tick()
    assert bench.state.mode == Mode.IDLE and "angle" in bench.state.reason


@pytest.mark.parametrize("command", ["", "dance", "reset"])
def test_other_words_in_idle_do_nothing(command):
    bench = Bench()
    bench.operator = OperatorCommand(sequence=0, command=command)
    bench.tick()
    assert bench.state == State(sequence=0)


def test_one_request_starts_one_run():
    """The same sequence number is the same request, however long it stays on the port."""
    bench = Bench()
    bench.until_end(succeed)
    bench.operator = OperatorCommand(sequence=1, command="reset")
    bench.tick()
    assert bench.state.mode == Mode.IDLE and bench.state.verdict == Verdict.NONE
    for _ in range(100):
        bench.tick(succeed)
    assert bench.state.mode == Mode.IDLE
    bench.operator = OperatorCommand(sequence=2, command="close")
    assert bench.until_end(succeed).mode == Mode.DONE
    assert bench.state.turn_angle < 0


@pytest.mark.parametrize("mode", TERMINAL)
def test_only_reset_leaves_a_final_mode(mode):
    bench = bring_to(mode)
    state = bench.state
    bench.health = {"estop": True}
    for k, command in enumerate(("open", "close", "stop", "nonsense")):
        bench.operator = OperatorCommand(sequence=100 + k, command=command)
        bench.tick(lambda state: {block: {"state": "failed"} for block in OWNER.values()})
        assert (bench.state.mode, bench.state.verdict) == (state.mode, state.verdict)
    bench.operator = OperatorCommand(sequence=200, command="reset")
    bench.tick()
    assert bench.state.mode == Mode.IDLE and bench.state.activation == state.activation + 1


@pytest.mark.parametrize("mode", RUNNING)
def test_a_status_of_another_activation_or_another_block_is_ignored(mode):
    bench = bring_to(mode)
    state = bench.state
    stale = {"activation": state.activation - 1, "state": "succeeded"}
    bench.tick(lambda s: {OWNER[mode]: stale})
    bench.tick(lambda s: {OWNER[mode]: stale | {"state": "failed"}})
    bench.tick(lambda s: {"valve_search": stale | {"state": "failed", "verdict": "marker_lost"}})
    others = {block: {"state": "succeeded"} for block in OWNER.values() if block != OWNER[mode]}
    bench.tick(lambda s: others)
    assert bench.state == state


def test_every_entry_into_a_mode_is_a_new_activation():
    bench, rng = Bench(), np.random.default_rng(0)
    activations = {bench.state.activation: bench.state.mode}
    while bench.state.mode not in TERMINAL:
        bench.tick(succeed if rng.random() < 0.5 else lambda state: {})
        assert activations.setdefault(bench.state.activation, bench.state.mode) == bench.state.mode
    assert sorted(activations) == list(range(len(activations)))


# ---------------------------------------------------------------- retries


@pytest.mark.parametrize(
    "mode, verdict, cause, again, retries",
    [
        (Mode.MEASURE, "reach_limit", "stance", [Mode.FINE_APPROACH], 2),
        (Mode.MEASURE, "marker_lost", "", [Mode.FOLD, Mode.RETREAT, Mode.SEARCH], 2),
        (Mode.ROUGH_APPROACH, "marker_lost", "", [Mode.SEARCH], 2),
        (Mode.SERVO, "marker_lost", "", [Mode.REACH], 2),
        (Mode.GRASP, "grasp_missed", "", [Mode.RELEASE, Mode.FOLD, Mode.MEASURE, Mode.REACH], 2),
        (Mode.REACH, "marker_lost", "moved", [Mode.FOLD, Mode.MEASURE, Mode.REACH], 2),
        (Mode.SERVO, "marker_lost", "moved", [Mode.RELEASE, Mode.FOLD, Mode.MEASURE, Mode.REACH], 2),
        (Mode.VERIFY, "slip", "", [Mode.MEASURE, Mode.REACH, Mode.SERVO, Mode.GRASP, Mode.TURN], 2),
    ],
)
def test_what_may_be_tried_again_is_tried_again_and_only_so_often(mode, verdict, cause, again, retries):
    for failures in range(1, retries + 1):  # it works in the end
        bench = Bench()
        state = bench.until_end(fail_in(mode, verdict, times=failures, cause=cause))
        assert (state.mode, state.verdict) == (Mode.DONE, Verdict.TURNED)
        assert bench.modes.count(mode) == failures + 1
        first = bench.modes.index(mode)
        assert bench.modes[first + 1 : first + 1 + len(again)] == again
    bench = Bench()
    state = bench.until_end(fail_in(mode, verdict, cause=cause))
    assert bench.modes.count(mode) == retries + 1
    # Here all others succeed, verify too; but nothing was turned, so it has no say.
    assert (state.mode, state.verdict) == (Mode.FAILED, verdict)


def test_attempt_counts_the_retries_of_a_mode():
    bench = Bench()
    attempts = []

    script = fail_in(Mode.SERVO, "marker_lost", times=2)
    while bench.state.mode not in TERMINAL:
        bench.tick(script)
        if bench.state.mode == Mode.SERVO:
            attempts.append(bench.state.message(0.0, CONFIG).attempt)
    assert attempts == [0, 1, 2]


@pytest.mark.parametrize("turn, attempts", [("succeeded", [0, 0, 0]), ("failed", [0, 1, 2])])
def test_a_further_grasp_that_a_long_turn_needs_is_no_retry_and_one_after_a_lost_hold_is(turn, attempts):
    bench, left, seen = bring_to(Mode.TURN), [2], [0]

    def each(s):
        if s.mode == Mode.TURN and turn == "failed" and left[0] > 0:
            return {OWNER[s.mode]: {"state": "failed", "verdict": "slip"}}
        if s.mode == Mode.VERIFY and left[0] > 0:
            left[0] -= 1
            return {OWNER[s.mode]: {"state": "failed", "verdict": "reach_limit", "cause": "regrasp"}}
        return {OWNER[s.mode]: {"state": "succeeded"}}

    while bench.state.mode not in TERMINAL:
        bench.tick(each)
        if bench.state.mode == Mode.TURN:
            seen.append(bench.state.message(0.0, CONFIG).attempt)
    assert seen == attempts and bench.state.verdict == Verdict.TURNED


@pytest.mark.parametrize("mode", WATCHED)
def test_a_marker_lost_on_the_way_is_searched_again(mode):
    bench = bring_to(mode)
    bench.tick(lambda s: {"valve_search": {"state": "failed", "verdict": "marker_lost", "detail": "not seen"}})
    assert "not seen" in bench.state.reason
    if mode != Mode.ROUGH_APPROACH:  # near the valve it backs off first: from there it may see the marker again
        assert bench.state.mode == Mode.FOLD
        bench.tick(succeed)
        assert bench.state.mode == Mode.RETREAT
        bench.tick(succeed)
    assert bench.state.mode == Mode.SEARCH
    state = bench.until_end(succeed)
    assert (state.mode, state.verdict) == (Mode.DONE, Verdict.TURNED)


@pytest.mark.parametrize("mode", FIXED)
def test_a_valve_that_was_moved_while_the_hands_were_on_their_way_is_measured_again(mode):
    bench = bring_to(mode)
    lost = {"state": "failed", "verdict": "marker_lost", "cause": "moved", "detail": "100 mm"}
    bench.tick(lambda s: {"valve_search": lost})
    assert "100 mm" in bench.state.reason
    assert bench.state.mode == (Mode.RELEASE if mode in CONTACT else Mode.FOLD)
    state = bench.until_end(succeed)
    assert bench.modes.count(Mode.MEASURE) == 2 and bench.modes.count(Mode.VERIFY) == 1
    assert (state.mode, state.verdict) == (Mode.DONE, Verdict.TURNED)


@pytest.mark.parametrize("times, verdict", [(1, Verdict.TURNED), (2, Verdict.UNVERIFIED)])
def test_a_marker_that_is_not_seen_after_the_turn_is_looked_for_from_farther_back_once(times, verdict):
    bench = Bench()
    state = bench.until_end(fail_in(Mode.VERIFY, "unverified", cause="unseen", times=times))
    after = bench.modes[bench.modes.index(Mode.VERIFY) :]
    assert after[:-1] == [Mode.VERIFY, Mode.RETREAT, Mode.VERIFY, Mode.RETREAT]
    assert state.verdict == verdict and not state.near


@pytest.mark.parametrize("mode", [m for m in RUNNING if m not in (*WATCHED, *FIXED, Mode.SEARCH)])
def test_elsewhere_valve_search_has_no_say(mode):
    bench = bring_to(mode)
    bench.tick(lambda s: {"valve_search": {"state": "failed", "verdict": "marker_lost"}})
    assert bench.state.mode == mode


# ---------------------------------------------------------------- verdicts


@pytest.mark.parametrize("verdict", ["stuck", "end_stop", "slip"])
def test_a_turn_that_fails_lets_go_looks_backs_off_and_keeps_its_verdict(verdict):
    bench = bring_to(Mode.TURN)
    bench.state = dc.replace(bench.state, retried=("slip",) * CONFIG.retries["slip"])
    seen = {
        Mode.TURN: {"state": "failed", "verdict": verdict, "detail": "12 N m"},
        Mode.VERIFY: {"state": "failed", "verdict": "slip" if verdict == "stuck" else "stuck"},
    }
    state = bench.until_end(lambda s: {OWNER[s.mode]: seen.get(s.mode, {"state": "succeeded"})})
    assert bench.modes[-5:] == [Mode.RELEASE, Mode.FOLD, Mode.VERIFY, Mode.RETREAT, Mode.FAILED]
    assert (state.verdict, state.reason) == (verdict, "hybrid_rotation: 12 N m")


def test_a_turn_longer_than_one_grasp_reaches_goes_back_to_measure_until_the_camera_has_seen_it():
    bench, left = bring_to(Mode.TURN), [3]

    def each(s):
        if s.mode != Mode.VERIFY or left[0] == 0:
            return {OWNER[s.mode]: {"state": "succeeded"}}
        left[0] -= s.mode == Mode.VERIFY
        return {OWNER[s.mode]: {"state": "failed", "verdict": "reach_limit", "cause": "regrasp"}}

    state = bench.until_end(each)
    once = [Mode.RELEASE, Mode.FOLD, Mode.VERIFY]
    again = [*once, Mode.MEASURE, Mode.REACH, Mode.SERVO, Mode.GRASP, Mode.TURN]
    assert bench.modes[-len(again) * 3 - 5 :] == [*again * 3, *once, Mode.RETREAT, Mode.DONE]
    assert (state.mode, state.verdict) == (Mode.DONE, Verdict.TURNED)


def test_arms_at_their_limit_in_a_turn_let_go_and_take_hold_again():
    bench = bring_to(Mode.TURN)
    bench.tick(lambda s: {OWNER[s.mode]: {"state": "failed", "verdict": "reach_limit"}})
    assert (bench.state.mode, bench.state.verdict) == (Mode.RELEASE, Verdict.NONE)
    bench.tick(lambda s: {OWNER[s.mode]: {"state": "succeeded"}})
    assert bench.state.mode == Mode.FOLD


def test_a_grip_that_is_lost_lets_go_looks_and_grasps_again_and_only_so_often():
    lost = {"state": "failed", "verdict": "slip", "detail": "left hand carries 0 %"}
    half = {"state": "failed", "verdict": "reach_limit", "cause": "regrasp", "detail": "camera sees 45 deg"}

    def so_often(times):
        left = [times]

        def each(s):
            if s.mode == Mode.TURN and left[0] > 0:
                return {OWNER[s.mode]: lost}
            if s.mode == Mode.VERIFY and left[0] > 0:
                left[0] -= 1
                return {OWNER[s.mode]: half}
            return {OWNER[s.mode]: {"state": "succeeded"}}

        return each

    for times in (1, 2):
        bench = bring_to(Mode.TURN)
        state = bench.until_end(so_often(times))
        again = [Mode.RELEASE, Mode.FOLD, Mode.VERIFY, Mode.MEASURE, Mode.REACH, Mode.SERVO, Mode.GRASP, Mode.TURN]
        first = bench.modes.index(Mode.TURN)
        assert bench.modes[first + 1 : first + 1 + len(again)] == again
        assert bench.modes.count(Mode.TURN) == times + 1
        assert (state.mode, state.verdict) == (Mode.DONE, Verdict.TURNED)
    bench = bring_to(Mode.TURN)
    state = bench.until_end(
        lambda s: {OWNER[s.mode]: {Mode.TURN: lost, Mode.VERIFY: half}.get(s.mode, {"state": "succeeded"})}
    )
    assert bench.modes.count(Mode.TURN) == 3
    assert (state.mode, state.verdict) == (Mode.FAILED, Verdict.SLIP)
    assert bench.modes[-5:] == [Mode.RELEASE, Mode.FOLD, Mode.VERIFY, Mode.RETREAT, Mode.FAILED]


def test_a_run_that_fails_takes_no_other_grasp():
    bench = bring_to(Mode.TURN)
    seen = {
        Mode.TURN: {"state": "failed", "verdict": "end_stop", "detail": "at 60 deg"},
        Mode.VERIFY: {"state": "failed", "verdict": "reach_limit", "cause": "regrasp"},
    }
    state = bench.until_end(lambda s: {OWNER[s.mode]: seen.get(s.mode, {"state": "succeeded"})})
    assert bench.modes[-2:] == [Mode.RETREAT, Mode.FAILED] and state.verdict == "end_stop"


@pytest.mark.parametrize("opening, request_, sign", [(1.0, "open", 1), (-1.0, "open", -1), (-1.0, "close", 1)])
def test_the_sense_that_opens_is_the_valves(opening, request_, sign):
    state = step(CONFIG, State(), 1.0, {}, Health(time=1.0), OperatorCommand(1, request_, 0.5), None, opening)
    assert state.turn_angle == sign * 0.5


def test_a_reach_that_fails_folds_the_arms_and_backs_off_though_nothing_was_turned():
    bench = bring_to(Mode.REACH)
    state = bench.until_end(fail_in(Mode.REACH, "reach_limit", "no path"))
    assert bench.modes[-3:] == [Mode.FOLD, Mode.RETREAT, Mode.FAILED]
    assert (state.verdict, state.reason) == (Verdict.REACH_LIMIT, "kinematic_approach: no path")


def test_a_turn_that_failed_counts_as_turned_if_the_camera_says_so():
    bench = bring_to(Mode.TURN)
    state = bench.until_end(fail_in(Mode.TURN, "end_stop"))
    assert (state.mode, state.verdict) == (Mode.DONE, Verdict.TURNED)


def test_a_turn_that_succeeded_fails_if_the_camera_says_so():
    state = bring_to(Mode.TURN).until_end(fail_in(Mode.VERIFY, "slip", "camera sees 40 deg"))
    assert (state.mode, state.verdict) == (Mode.FAILED, Verdict.SLIP)
    assert "40 deg" in state.reason


@pytest.mark.parametrize("verdict", ["end_stop", "stuck"])
def test_a_run_that_fails_anyhow_is_not_turned_on_because_the_camera_sees_another_angle(verdict):
    bench = bring_to(Mode.TURN)
    bench.tick(lambda s: {OWNER[s.mode]: {"state": "failed", "verdict": verdict}})
    state = bench.until_end(fail_in(Mode.VERIFY, "slip", "camera sees 40 deg"))
    assert (state.mode, state.verdict) == (Mode.FAILED, verdict)
    assert bench.modes.count(Mode.VERIFY) == bench.modes.count(Mode.TURN) == 1


def test_a_retreat_that_fails_after_turning_fails_the_run():
    state = bring_to(Mode.RETREAT).until_end()
    assert (state.mode, state.verdict) == (Mode.FAILED, Verdict.TIMEOUT)


@pytest.mark.parametrize("verdict", ["", "turned", "stopped", "gibberish"])
def test_a_failure_without_a_usable_verdict_is_a_fault(verdict):
    state = bring_to(Mode.ROUGH_APPROACH).until_end(fail_in(Mode.ROUGH_APPROACH, verdict))
    assert (state.mode, state.verdict) == (Mode.FAILED, Verdict.FAULT)


# ---------------------------------------------------------------- every mode x every mishap


def _fault(**health):
    def happen(bench: Bench) -> None:
        bench.health = health

    return happen


def _trip(bench: Bench) -> None:
    bench.selector = {"tripped": ("left",)}


def _silent_station(bench: Bench) -> None:
    bench.health_delay = CONFIG.report_age + 0.1


def _stop(bench: Bench) -> None:
    bench.operator = STOP


MISHAPS = {
    "fault": (_fault(faults=("left_arm: over temperature",)), Verdict.FAULT),
    "estop": (_fault(estop=True), Verdict.FAULT),
    "stale": (_fault(devices=("base", "left_arm"), ages=np.array([0.0, 0.5])), Verdict.FAULT),
    "nan_age": (_fault(devices=("left_arm",), ages=np.array([np.nan])), Verdict.FAULT),
    "silent_station": (_silent_station, Verdict.FAULT),
    "trip": (_trip, Verdict.FAULT),
    "stop": (_stop, Verdict.STOPPED),
    "timeout": (lambda bench: None, Verdict.TIMEOUT),
}
AFTERWARDS = {
    "all_silent": lambda state: {},
    "all_succeed": succeed,
    "all_fail": lambda state: {OWNER[state.mode]: {"state": "failed"}},
}


@pytest.mark.parametrize("after", AFTERWARDS)
@pytest.mark.parametrize("mishap", MISHAPS)
@pytest.mark.parametrize("mode", RUNNING)
def test_from_every_mode_every_mishap_ends_in_a_final_mode_in_time_with_its_verdict(mode, mishap, after):
    bench = bring_to(mode)
    happen, verdict = MISHAPS[mishap]
    happen(bench)
    start = bench.time
    if mishap == "timeout":
        entered = bench.state.activation
        while bench.state.activation == entered:
            bench.tick()
        assert bench.time - start < deadline(CONFIG, dc.replace(bench.state, mode=mode)) + 2 * DT
    else:
        bench.tick(AFTERWARDS[after])
    aborted = mishap != "timeout"
    assert bench.state.mode != mode or mode == Mode.RELEASE
    path = [bench.state.mode]
    if aborted and mode in CONTACT:
        assert path == [Mode.RELEASE]  # hands off the valve first
    elif aborted and mode != Mode.RELEASE:
        assert path[0] in TERMINAL  # held still at once
    begun = bench.time
    bench.until_end(AFTERWARDS[after])
    state = bench.state
    slowest = sum(CONFIG.deadline[m] for m in ("release", "fold", "verify", "retreat"))
    assert bench.time - begun <= slowest + 4 * DT
    turned = after == "all_succeed" and mishap == "timeout" and mode == Mode.TURN
    if turned:  # verify has the last word
        assert (state.mode, state.verdict) == (Mode.DONE, Verdict.TURNED)
    else:
        assert state.verdict == verdict
        assert state.mode == (Mode.STOPPED if mishap == "stop" else Mode.FAILED)
    assert state.reason


@pytest.mark.parametrize("mode", RUNNING)
@pytest.mark.parametrize("verdict", FAILURES)
def test_from_every_mode_every_failed_status_ends_in_time_with_a_verdict(mode, verdict):
    bench = bring_to(mode)
    bench.tick(lambda s: {OWNER[mode]: {"state": "failed", "verdict": verdict.value}})
    state = bench.until_end(dt=0.25)  # all silent from here: only deadlines help
    assert state.mode == Mode.FAILED
    assert state.verdict in (verdict, Verdict.TIMEOUT)
    left = bench.modes[bench.modes.index(mode) + 1 :]
    if mode == Mode.SERVO:
        assert left[0] == Mode.REACH  # the hands are open: a retry needs no release
    elif mode in CONTACT:
        assert left[0] == Mode.RELEASE


@pytest.mark.parametrize("mode", CONTACT)
def test_hands_that_may_hold_the_valve_always_go_through_release(mode):
    """No final mode, no folding of the arms, no driving straight after grasp or turn, whatever happens."""
    rng = np.random.default_rng(11)
    for _ in range(60):
        bench = bring_to(mode)
        for _ in range(4000):
            before = bench.state.mode
            draw = rng.random()
            if draw < 0.002:
                bench.operator = OperatorCommand(sequence=int(rng.integers(1 << 30)), command="stop")
            bench.health = {"estop": bool(draw > 0.999)}
            bench.tick(lambda s: _random_status(rng, s), dt=0.2)
            if before in (Mode.GRASP, Mode.TURN) and bench.state.mode != before:
                assert bench.state.mode in (Mode.RELEASE, TABLE[before].next)
            if bench.state.mode in TERMINAL:
                break
        assert bench.state.mode in TERMINAL


def _random_status(rng: np.random.Generator, state: State) -> dict:
    draw = rng.random()
    if draw < 0.9 or state.mode not in OWNER:
        return {}
    if draw < 0.95:
        return succeed(state)
    verdict, cause = rng.choice(list(Verdict)), rng.choice(list(Cause))
    return {OWNER[state.mode]: {"state": "failed", "verdict": str(verdict), "cause": str(cause)}}


def test_whatever_the_behaviours_say_a_run_ends_within_its_bounds():
    """300 random stories: always a final mode, always a verdict, never more retries than allowed."""
    rng = np.random.default_rng(4)
    for _ in range(300):
        bench = Bench()
        state = bench.until_end(lambda s: _random_status(rng, s), dt=0.5, limit=1500)
        assert state.verdict != Verdict.NONE and state.reason
        assert (state.verdict == Verdict.TURNED) == (state.mode == Mode.DONE)
        for cause, allowed in CONFIG.retries.items():
            assert state.retried.count(cause) <= allowed


def test_a_fault_that_persists_does_not_keep_release_from_ending():
    bench = bring_to(Mode.TURN)
    bench.health = {"estop": True}
    start = bench.time
    state = bench.until_end()  # nobody answers
    assert (state.mode, state.verdict) == (Mode.FAILED, Verdict.FAULT)
    assert bench.time - start <= CONFIG.deadline["release"] + 3 * DT


def test_the_first_of_fault_and_stop_gives_the_verdict():
    for first, second, mode, verdict in (
        (_fault(estop=True), _stop, Mode.FAILED, Verdict.FAULT),
        (_stop, _fault(estop=True), Mode.STOPPED, Verdict.STOPPED),
    ):
        bench = bring_to(Mode.TURN)
        first(bench)
        bench.tick()
        second(bench)
        state = bench.until_end()
        assert (state.mode, state.verdict) == (mode, verdict)


def test_stop_during_a_release_that_was_part_of_a_retry_ends_the_run_after_it():
    bench = bring_to(Mode.GRASP)
    bench.tick(fail_in(Mode.GRASP, "grasp_missed", times=1))
    assert bench.state.mode == Mode.RELEASE
    bench.operator = STOP
    bench.tick()
    assert bench.state.mode == Mode.RELEASE
    assert bench.until_end(succeed).mode == Mode.STOPPED


def test_a_start_with_a_fault_present_fails_at_once():
    bench = Bench()
    bench.health = {"faults": ("base: no power",)}
    bench.tick()
    assert (bench.state.mode, bench.state.verdict) == (Mode.FAILED, Verdict.FAULT)
    assert "no power" in bench.state.reason


def test_the_deadline_of_turn_grows_with_the_angle():
    turn = State(mode=Mode.TURN, turn_angle=-np.pi)
    assert deadline(CONFIG, turn) == pytest.approx(CONFIG.deadline["turn"] + CONFIG.turn_allowance * np.pi)
    assert deadline(CONFIG, State()) == np.inf


def test_a_run_that_loses_its_way_within_all_deadlines_of_its_modes_ends_as_a_timeout():
    """Search and approach alternate, each within its own deadline (3 s a mode), and no retry is counted."""
    bench = bring_to(Mode.ROUGH_APPROACH)
    bench.state = dc.replace(bench.state, since=bench.time)
    while bench.state.mode not in TERMINAL:
        bench.tick()
        bench.state = dc.replace(bench.state, since=bench.time)
        assert bench.time < 2 * CONFIG.run_deadline, "it goes on for ever"
    assert bench.state.verdict == Verdict.TIMEOUT and "the run took more than" in bench.state.reason
    assert bench.time == pytest.approx(CONFIG.run_deadline + CONFIG.turn_allowance * OPEN.angle, abs=1.0)


def test_the_way_off_the_valve_is_not_cut_short_by_the_runs_deadline():
    bench = bring_to(Mode.VERIFY)
    bench.time += 10 * CONFIG.run_deadline
    bench.state = dc.replace(bench.state, since=bench.time)
    assert bench.until_end(succeed).verdict == Verdict.TURNED


def test_what_does_not_follow_its_command_is_a_fault():
    report = SelectorReport(time=0.0, astray=("left_arm",))
    assert find_fault(CONFIG, 0.0, Health(), report) == "left_arm does not follow the command"
    assert find_fault(CONFIG, 0.0, Health(), SelectorReport()) == ""


def test_ages_are_judged_by_device():
    def fault(device, age):
        health = Health(time=5.0, devices=(device,), ages=np.array([age]))
        return find_fault(CONFIG, 5.0, health, None)

    assert fault("left_arm", CONFIG.other_age) == ""
    assert "left_arm silent" in fault("left_arm", CONFIG.other_age + 0.01)
    for camera in ("head_left", "left_wrist"):
        assert fault(camera, 0.9) == "" and fault(camera, 1.1)
    assert find_fault(CONFIG, 5.0, None, None)
    assert find_fault(CONFIG, 5.0, Health(time=5.0), SelectorReport(time=4.0)) == "no report from command_selector"


# ---------------------------------------------------------------- another run after one that ended near the valve


def again(bench: Bench, command: str = "close") -> Bench:
    for word in ("reset", command):
        bench.operator = OperatorCommand(sequence=bench.operator.sequence + 1, command=word)
        bench.tick()
    return bench


@pytest.mark.parametrize("mode", RUNNING)
def test_after_a_stop_near_the_valve_the_next_run_backs_off_before_it_looks(mode):
    bench = bring_to(mode)
    bench.operator = STOP
    bench.until_end(succeed)
    again(bench)
    away = mode in (Mode.SEARCH, Mode.ROUGH_APPROACH)
    assert bench.state.mode == (Mode.SEARCH if away else Mode.FOLD)
    assert bench.until_end(succeed).verdict == Verdict.TURNED
    first = [Mode.SEARCH] if away else [Mode.FOLD, Mode.RETREAT, Mode.SEARCH]
    assert list(bench.state.entered[: len(first)]) == first
    assert not bench.state.near


def test_a_run_that_ended_with_its_own_retreat_leaves_nothing_to_clear():
    bench = Bench()
    bench.until_end(succeed)
    assert again(bench).state.mode == Mode.SEARCH


@pytest.mark.parametrize("mode", [Mode.FOLD, Mode.RETREAT])
def test_a_robot_that_cannot_back_off_does_not_look_for_the_valve(mode):
    bench = bring_to(Mode.MEASURE)
    bench.operator = STOP
    bench.until_end()
    again(bench)
    while bench.state.mode != mode:
        bench.tick(succeed)
    bench.until_end(fail_in(mode, Verdict.REACH_LIMIT))
    assert (bench.state.mode, bench.state.verdict) == (Mode.FAILED, Verdict.REACH_LIMIT)
    assert Mode.SEARCH not in bench.state.entered


# ---------------------------------------------------------------- held by the operator


def ask(bench: Bench, command: str) -> None:
    bench.operator = OperatorCommand(sequence=bench.operator.sequence + 1, command=command)
    bench.tick()


def test_grasp_and_turn_can_be_held_and_nothing_else():
    assert HOLDS == (Mode.GRASP, Mode.TURN)
    for mode in (*RUNNING, *TERMINAL, Mode.IDLE):
        bench = bring_to(mode)
        before = bench.state.activation
        ask(bench, "hold")
        assert bench.state.held == bench.state.message(bench.time, CONFIG).held == (mode in HOLDS)
        assert (bench.state.mode, bench.state.activation) == (mode, before)


def test_a_held_grasp_goes_on_to_a_held_turn_and_a_held_turn_can_succeed_fail_or_be_stopped():
    bench = bring_to(Mode.GRASP)
    ask(bench, "hold")
    bench.tick(succeed)
    assert (bench.state.mode, bench.state.held) == (Mode.TURN, True)
    for script in (succeed, fail_in(Mode.TURN, Verdict.SLIP)):
        bench = bring_to(Mode.TURN)
        ask(bench, "hold")
        bench.tick(script)
        assert (bench.state.mode, bench.state.held) == (Mode.RELEASE, False)
    bench = bring_to(Mode.TURN)
    ask(bench, "hold")
    ask(bench, "stop")
    assert (bench.state.mode, bench.state.held, bench.state.after_release) == (Mode.RELEASE, False, Mode.STOPPED)


def test_a_fault_ends_a_held_turn():
    bench = bring_to(Mode.TURN)
    ask(bench, "hold")
    bench.health = {"faults": ("left_arm: hot",)}
    assert bench.tick().mode == Mode.RELEASE


def test_no_deadline_runs_while_the_turn_is_held_and_all_do_afterwards():
    bench = bring_to(Mode.TURN)
    begun, bound = bench.time, deadline(CONFIG, bench.state)
    for _ in range(2):
        ask(bench, "hold")
        bench.time += CONFIG.hold_time - 1.0
        assert bench.tick().mode == Mode.TURN
        ask(bench, "resume")
    while bench.state.mode == Mode.TURN:
        bench.tick()
    held = 2 * (CONFIG.hold_time - 1.0)
    assert bench.time - begun - held == pytest.approx(bound, abs=8 * DT)
    assert bench.state.verdict == Verdict.TIMEOUT


def test_the_runs_deadline_does_not_run_while_the_turn_is_held():
    bench = bring_to(Mode.TURN)
    began = bench.state.began
    ask(bench, "hold")
    bench.time += 50.0
    ask(bench, "resume")
    assert bench.state.began - began == pytest.approx(50.0, abs=3 * DT)
    bench = bring_to(Mode.TURN)
    ask(bench, "hold")
    bench.time += 50.0
    bench.tick(succeed)
    assert bench.state.began - began == pytest.approx(50.0, abs=3 * DT)


def test_a_turn_that_is_held_for_too_long_is_stopped():
    bench = bring_to(Mode.TURN)
    ask(bench, "hold")
    bench.time += CONFIG.hold_time + 0.1
    state = bench.tick()
    assert (state.mode, state.verdict, state.after_release) == (Mode.RELEASE, Verdict.STOPPED, Mode.STOPPED)
    assert "held for more than" in state.reason


# ---------------------------------------------------------------- block


def rig(**inputs) -> Rig:
    return Rig(SupervisorSystem(CONFIG), **{"health": Health(time=0.0), "operator": OPEN} | inputs)


def test_ports():
    blocks = ("valve_search", "base_approach", "kinematic_approach", "image_servo", "hybrid_rotation")
    assert ports(SupervisorSystem(CONFIG)) == {
        "operator": "in abstract",
        "health": "in abstract",
        "selector": "in abstract",
        **dict.fromkeys(blocks, "in abstract"),
        "mode": "out abstract",
    }


def test_block_takes_its_owners_status():
    dut = rig(valve_search=Status(activation=1, state="succeeded")).run(0.1)
    assert dut.read("mode").mode == "rough_approach"
    assert dut.read("mode").activation == 2


def test_block_reports_the_mode_at_every_step_and_holds_it_between():
    assert_holds_between_updates(rig(), "mode", slot=3, period=1 / 32)


def test_block_without_operator_stays_idle_and_without_health_does_not_start():
    dut = Rig(SupervisorSystem(CONFIG)).run(1.0)
    assert dut.read("mode").mode == "idle"
    dut = Rig(SupervisorSystem(CONFIG), operator=OPEN).run(0.1)
    assert (dut.read("mode").mode, dut.read("mode").verdict) == ("failed", "fault")


def test_block_clones_are_independent():
    assert_clones_are_independent(rig, {"operator": STOP}, ("mode",))


def test_block_refuses_a_wrong_message():
    with pytest.raises(TypeError, match="want Status"):
        rig(image_servo=ModeState()).run(0.1)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"deadline": {"search": 1.0}}, "supervisor.deadline"),
        ({"deadline": CONFIG.deadline | {"turn": 0.0}}, "supervisor.deadline.turn"),
        ({"retries": CONFIG.retries | {"servo": -1}}, "supervisor.retries.servo"),
        ({"max_age": {"base": float("nan")}}, "supervisor.max_age.base"),
        ({"other_age": 0.0}, "supervisor.other_age"),
    ],
)
def test_bad_config_is_refused_by_name(changes, words):
    with pytest.raises(ConfigError, match=words):
        SupervisorSystem(SupervisorConfig(**changes))
