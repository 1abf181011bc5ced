"""Which mode the robot is in, and why: one pure transition function over the table of modes (task/modes.py).

One block owns each mode: its Status, carrying this activation's number, ends it. What else can end a mode:

    a failure that the mode's row retries       -> as the row says, so often in a run
    any other failure or a missed deadline      -> the run will fail with this verdict, off the valve first:
        hands at the handles                       -> release -> fold -> verify -> retreat -> failed
        hands near them (reach)                    -> fold -> retreat -> failed
        elsewhere                                  -> failed
    fault or operator's stop                    -> hands at the handles: release, then failed or stopped;
                                                   elsewhere at once, the robot held still

A run that was stopped near the valve leaves the robot there. The next one begins with fold -> retreat -> search: from
close by the marker may be out of the cameras' view, and the arms may be out. A marker that is lost near the valve is
searched in the same way.

In grasp and turn the operator may `hold`: the turn stands still, the grasp is kept and no deadline runs, until `resume`
or, after hold_time, a stop.

Retries are counted over the run and bounded; every mode has a deadline, and so has the run (a robot whose odometry is
wrong could search and drive for minutes within those of its modes). `verify` decides `turned` by camera, even if the
turn itself had ended with another verdict; otherwise the first verdict stays. A release that fails ends the run at
once: command_selector opens the hands in failed and stopped.
"""

import dataclasses as dc
import math
from collections.abc import Mapping
from typing import Any

from valve_drake.config import Config, number, table
from valve_drake.memory import changed
from valve_drake.messages import (
    CAMERAS,
    DEVICES,
    Cause,
    Health,
    Mode,
    ModeState,
    OperatorCommand,
    SelectorReport,
    Status,
    Verdict,
)
from valve_drake.task.modes import DEADLINES, FIXED, HEAD_EVERY, MODES, RETRIES, TABLE, TERMINAL, WATCHED, WRIST_EVERY

HOLDS = tuple(mode for mode, row in TABLE.items() if row.owner == "hybrid_rotation" and not row.ending)

# What a behaviour may give as the reason of its failure; anything else is a fault of the program.
FAILURES = tuple(v for v in Verdict if v not in (Verdict.NONE, Verdict.TURNED, Verdict.STOPPED))


@dc.dataclass
class SupervisorConfig(Config):
    """Scenario key `supervisor`. The upper bounds of ages are those that docs/hardware.md promises."""

    KEY = "supervisor"
    deadline: dict[str, float] = table(DEADLINES, 1.0, 600.0, "of each mode [s]", tuple(DEADLINES), complete=True)
    turn_allowance: float = number(20.0, 1.0, 200.0, "added to the deadlines of turn and of the run [s/rad]")
    run_deadline: float = number(
        160.0, 1.0, 3600.0, "from the operator's command until the run gives up; a good one takes 60 s [s]"
    )
    retries: dict[str, int] = table(RETRIES, 0, 20, "in a run, by what failed", tuple(RETRIES), complete=True)
    head_every: dict[str, int] = table(
        HEAD_EVERY, 0, 1000, "in each mode: perception looks at every n-th pair of the head's images, 0: at none", MODES
    )
    wrist_every: dict[str, int] = table(
        WRIST_EVERY, 0, 1000, "in each mode: it looks at every n-th of the wrists' images, 0: at none", MODES
    )
    max_age: dict[str, float] = table(
        dict.fromkeys(CAMERAS, 1.0),
        0.05,
        dict.fromkeys(DEVICES, 0.25) | dict.fromkeys(CAMERAS, 1.0),
        "a device that is silent for longer is a fault [s]",
        DEVICES,
    )
    other_age: float = number(0.25, 0.05, 0.25, "the same for all devices not named in max_age [s]")
    report_age: float = number(0.25, 0.05, 0.25, "the same for the health and selector reports themselves [s]")
    hold_time: float = number(120.0, 1.0, 3600.0, "a turn that is held for longer is stopped [s]")
    angle_limit: float = number(12.6, 0.01, 12.6, "largest turn that an operator may ask for [rad]")

    def oldest(self, device: str) -> float:
        """How old the last report of a device may be [s]."""
        return self.max_age.get(device, self.other_age)


@dc.dataclass(frozen=True)
class State:
    """The supervisor's memory."""

    mode: Mode = Mode.IDLE
    activation: int = 0
    since: float = 0.0  # [s]
    began: float = 0.0  # when the operator's command was taken [s]
    turn_angle: float = 0.0  # [rad]
    verdict: Verdict = Verdict.NONE
    reason: str = ""
    sequence: int = -1  # of the last operator command taken
    after_release: Mode = Mode.FOLD  # where release leads
    entered: tuple[Mode, ...] = ()  # modes of this run, in order
    grasp: int = 0  # which of them the present grasp begins with; a further one that a long turn needs is no retry
    lost: bool = False  # the last turn failed: then the next grasp is a retry
    retried: tuple[str, ...] = ()  # what failed and was tried again in this run
    held_at: float = math.inf  # since when the operator holds the turn; infinite: he does not [s]
    held_for: float = 0.0  # for how long he did so in this mode, before [s]
    near: bool = False  # the robot has come up to the valve and has not backed off since; it outlives a reset
    clearing: bool = False  # it backs off first, and only then looks for the valve: its arms may be out

    @property
    def held(self) -> bool:
        return self.held_at < math.inf

    def message(self, time: float, config: "SupervisorConfig") -> ModeState:
        return ModeState(
            time=time,
            mode=self.mode.value,
            activation=self.activation,
            since=self.since,
            attempt=max(self.entered[self.grasp :].count(self.mode) - 1, 0),
            turn_angle=self.turn_angle,
            verdict=self.verdict.value,
            reason=self.reason,
            head_every=config.head_every.get(self.mode.value, 0),
            wrist_every=config.wrist_every.get(self.mode.value, 0),
            afresh=TABLE[self.mode].afresh,
            held=self.held,
        )


def step(
    config: SupervisorConfig,
    state: State,
    time: float,
    statuses: Mapping[str, Status | None],
    health: Health | None,
    operator: OperatorCommand | None,
    selector: SelectorReport | None,
    opening: float = 1.0,
) -> State:
    """One step -> new state. statuses: block name -> Status; None: that port is open.

    opening: 1 if the valve opens counter-clockwise, -1 if clockwise."""
    s = state
    request = ""
    if operator is not None and operator.sequence != s.sequence:
        request = operator.command
        s = changed(s, sequence=operator.sequence)
    if s.mode in TERMINAL:
        return _reset(s, time) if request == "reset" else s
    if request == "stop" and not _aborting(s):
        return _abort(s, time, Mode.STOPPED, Verdict.STOPPED, "stopped by the operator")
    fault = find_fault(config, time, health, selector)
    if s.mode == Mode.IDLE:
        if operator is None or not request:
            return s
        return _begin(config, s, time, request, operator.angle, fault, opening)
    if fault and not _aborting(s):
        return _abort(s, time, Mode.FAILED, Verdict.FAULT, fault)
    if s.mode in HOLDS:
        s = _held(s, time, request)
        if time - s.held_at > config.hold_time:
            words = f"held for more than {config.hold_time:.0f} s"
            return _abort(s, time, Mode.STOPPED, Verdict.STOPPED, words)

    owner = TABLE[s.mode].owner
    status = statuses.get(owner)
    if status is not None and status.activation == s.activation:
        if status.state == "succeeded":
            return _succeed(s, time, status)
        if status.state == "failed":
            return _fail(config, s, time, owner, status)
    watch = statuses.get("valve_search")
    if (
        (s.mode in WATCHED or s.mode in FIXED)
        and watch is not None
        and watch.activation == s.activation
        and watch.state == "failed"
    ):
        return _fail(config, s, time, "valve_search", watch)
    if s.held:
        return s
    if time - s.since - s.held_for > deadline(config, s):
        return _give_up(s, time, Verdict.TIMEOUT, f"{s.mode.value} took more than {deadline(config, s):.0f} s")
    limit = config.run_deadline + config.turn_allowance * abs(s.turn_angle)
    if not TABLE[s.mode].ending and time - s.began > limit:
        return _give_up(s, time, Verdict.TIMEOUT, f"the run took more than {limit:.0f} s")
    return s


def deadline(config: SupervisorConfig, state: State) -> float:
    """Seconds that the present mode may take; infinite for idle and the final modes."""
    extra = config.turn_allowance * abs(state.turn_angle) if state.mode == Mode.TURN else 0.0
    return config.deadline.get(state.mode.value, math.inf) + extra


def find_fault(config: SupervisorConfig, time: float, health: Health | None, selector: SelectorReport | None) -> str:
    """The first reason not to go on, or "". Comparisons are written so that NaN counts as a fault."""
    if health is None or not time - health.time <= config.report_age:
        return "no health report"
    if health.estop:
        return "emergency stop"
    if health.faults:
        return "fault: " + ", ".join(health.faults)
    for device, age in zip(health.devices, health.ages):
        if not age <= config.oldest(device):
            return f"{device} silent for {age:.2f} s"
    if selector is not None:
        if not time - selector.time <= config.report_age:
            return "no report from command_selector"
        if selector.tripped:
            return "force above the trip or not known: " + ", ".join(f"{side} hand" for side in selector.tripped)
        if selector.astray:
            return ", ".join(selector.astray) + " does not follow the command"
    return ""


# ---------------------------------------------------------------- transitions


def _enter(s: State, time: float, mode: Mode, reason: str, **changes: Any) -> State:
    """A new activation."""
    if mode == Mode.FINE_APPROACH:
        changes = {"near": True} | changes
    if mode == Mode.TURN:
        changes = {"lost": False} | changes
    if s.held:
        began = s.began + time - s.held_at  # the run's own deadline did not run either
        changes = {"began": began, "held_at": time if mode in HOLDS else math.inf} | changes
    return changed(
        s,
        mode=mode,
        activation=s.activation + 1,
        since=time,
        reason=reason,
        entered=(*s.entered, mode),
        held_for=0.0,
        **changes,
    )


def _held(s: State, time: float, request: str) -> State:
    if request == "hold" and not s.held:
        return changed(s, held_at=time)
    if request == "resume" and s.held:
        length = time - s.held_at
        return changed(s, held_at=math.inf, held_for=s.held_for + length, began=s.began + length)
    return s


def _reset(s: State, time: float) -> State:
    idle = State(mode=Mode.IDLE, activation=s.activation + 1, since=time, reason="reset")
    return changed(idle, sequence=s.sequence, near=s.near)


def _begin(
    config: SupervisorConfig, s: State, time: float, request: str, angle: float, fault: str, opening: float
) -> State:
    if request not in ("open", "close"):
        return s
    if not 0 < angle <= config.angle_limit:
        return changed(s, reason=f"refused: angle must be within (0, {config.angle_limit:g}] rad, got {angle}")
    if fault:
        return _enter(s, time, Mode.FAILED, fault, verdict=Verdict.FAULT)
    sign = opening if request == "open" else -opening
    first = Mode.FOLD if s.near else Mode.SEARCH
    return _enter(s, time, first, f"operator: {request}", turn_angle=sign * angle, began=time, clearing=s.near)


def _aborting(s: State) -> bool:
    return s.mode == Mode.RELEASE and s.after_release in TERMINAL


def _abort(s: State, time: float, end: Mode, verdict: Verdict, reason: str) -> State:
    """Fault or stop: hands off the valve first, everything else stands still at once."""
    if s.mode == Mode.RELEASE:  # it goes on, but nothing comes after it
        return changed(s, after_release=end, verdict=verdict, reason=reason)
    if TABLE[s.mode].contact:
        return _enter(s, time, Mode.RELEASE, reason, verdict=verdict, after_release=end)
    return _enter(s, time, end, reason, verdict=verdict)


def _succeed(s: State, time: float, status: Status) -> State:
    reason = status.detail or f"{s.mode.value} succeeded"
    if s.verdict and s.mode != Mode.VERIFY:
        reason = s.reason  # the verdict's; what comes after it changes neither
    if s.mode == Mode.RELEASE:
        return _enter(s, time, s.after_release, reason)
    if s.clearing:
        back = s.mode == Mode.FOLD
        return _enter(s, time, Mode.RETREAT if back else Mode.SEARCH, reason, clearing=back, near=back)
    if s.mode == Mode.FOLD:
        if Mode.TURN in s.entered:
            return _enter(s, time, Mode.VERIFY, reason)
        return _enter(s, time, Mode.RETREAT if s.verdict else Mode.MEASURE, reason)  # there is nothing to verify
    if s.mode == Mode.RETREAT and not s.verdict:
        return _enter(s, time, Mode.VERIFY, reason, near=False)
    if s.mode == Mode.RETREAT:
        return _enter(s, time, Mode.DONE if s.verdict == Verdict.TURNED else Mode.FAILED, s.reason, near=False)
    turned = {"verdict": Verdict.TURNED} if s.mode == Mode.VERIFY else {}
    after = TABLE[s.mode].next
    assert after is not None
    return _enter(s, time, after, reason, after_release=Mode.FOLD, **turned)


def _fail(config: SupervisorConfig, s: State, time: float, block: str, status: Status) -> State:
    """A behaviour gave up: try again, or end the run."""
    verdict = Verdict(status.verdict) if status.verdict in FAILURES else Verdict.FAULT
    reason = f"{block}: {status.detail or verdict.value}"
    retry = TABLE[s.mode].retry_of(status.cause, verdict)
    if retry is None or s.verdict or s.retried.count(retry.limit) >= config.retries[retry.limit]:
        return _give_up(s, time, verdict, reason)
    s = changed(s, retried=(*s.retried, retry.limit), lost=s.lost or s.mode == Mode.TURN)
    if status.cause == Cause.REGRASP and not s.lost:
        s = changed(s, grasp=len(s.entered))
    if retry.mode == Mode.SEARCH and s.near:  # from close by the marker may be out of the cameras' view
        return _enter(s, time, Mode.FOLD, reason, clearing=True)
    return _enter(s, time, retry.mode, reason, after_release=retry.after_release or Mode.FOLD)


def _give_up(s: State, time: float, verdict: Verdict, reason: str) -> State:
    """This run will fail. The first verdict stays, unless it was `turned` and the retreat then went wrong."""
    if s.verdict not in (Verdict.NONE, Verdict.TURNED):
        verdict, reason = s.verdict, s.reason
    end = s.after_release if _aborting(s) else TABLE[s.mode].off
    after = s.after_release if _aborting(s) else Mode.FOLD
    return _enter(s, time, end, reason, verdict=verdict, after_release=after, clearing=False)
