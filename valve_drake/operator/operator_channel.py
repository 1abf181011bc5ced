"""The operators' channel: who commands, what was said, and what comes of it. One pure step.

One operator has the robot's ear: who speaks first, until it leaves or was silent for `lease`. Others are refused by
their number, but a `stop` is obeyed whoever says it. A packet that was said again or overtaken counts as none; words
that come more than `late` after they were said are refused, as is what is not of the grammar (grammar.py). An
operator's clock is placed on this one by the least delay that its packets had.

What is given goes to the supervisor as OperatorCommand. A new move after a run that is done or was stopped needs no
`reset`; after one that has failed it does. When the link is lost, `on_loss` says what becomes of a run that is on its
way to the valve or at it; the way off it always goes on:

    on_loss  towards the valve  grasp, turn
    finish   goes on            goes on
    hold     stops              the grasp is held; whoever takes the ear says `confirm` (it goes on) or `stop`
    stop     stops              the hands let go, then all stands still
"""

import dataclasses as dc
import math

from valve_drake.config import Config, choice, number
from valve_drake.memory import changed
from valve_drake.messages import (
    SIDES,
    HandleMarks,
    Mode,
    ModeState,
    OperatorCommand,
    OperatorPacket,
    OperatorPackets,
    OperatorState,
    RectangleEstimate,
    Status,
)
from valve_drake.operator.grammar import MOVES, SURE, Decision, Heard, Intent, Kind, Talk, converse, parse
from valve_drake.supervisor.supervisor import HOLDS
from valve_drake.task.modes import RUNNING, TABLE, TERMINAL

DRIFT = 1e-3  # that two clocks may differ by, per second; a quartz has a twentieth of it
SPEAKERS = 8  # that are remembered


@dc.dataclass
class OperatorChannelConfig(Config):
    """Scenario key `operator_channel`."""

    KEY = "operator_channel"
    wire: str = choice("none", ("none", "lcm"), "where operators are heard; none: nowhere, the run begins by itself")
    on_loss: str = choice("hold", ("finish", "hold", "stop"), "when the operator's link is lost in a run")
    lease: float = number(1.0, 0.3, 10.0, "an operator that was silent for longer has lost its link and the ear [s]")
    late: float = number(1.5, 0.3, 10.0, "words that come later after they were said are refused, but for stop [s]")


@dc.dataclass(frozen=True)
class Speaker:
    """What is known of one desk. Times: of this clock [s], but `sent` of its own."""

    number: int
    sent: float = -math.inf  # of its last packet
    last: float = -math.inf  # when that came
    least: float = math.inf  # delay, the difference of the clocks included
    heard: int = 0  # sequence of its last words


@dc.dataclass(frozen=True)
class State:
    """The channel's memory."""

    speakers: tuple[Speaker, ...] = ()  # the last one heard at the end
    holder: int = 0  # who has the ear
    lost: bool = False  # it was silent for too long, or has left
    why: str = ""  # which of both
    talk: Talk = Talk()
    packets: int = 0  # count of the last batch
    local: int = -1  # sequence of the last command of the program itself
    command: OperatorCommand = OperatorCommand()  # the last one given
    stopped: bool = False  # in this step: nothing else is given then
    follows: OperatorCommand | None = None  # is given when the reset has led to idle
    began_at: int = 0  # the activation in which the task's command was given
    shown: OperatorState = OperatorState()


def tag(number: int) -> str:
    """A desk's number, for people."""
    return f"{number & 0xFFFF:04x}"


def step(
    config: OperatorChannelConfig,
    full: float,
    most: float,
    state: State,
    time: float,
    packets: OperatorPackets,
    local: OperatorCommand,
    mode: ModeState,
    turning: Status,
    sees: str,
) -> State:
    """One step. full, most: what `open` alone asks for, and the largest turn [rad]. local: the program's own command,
    which needs no ear. turning: of the block that turns the valve. sees: what the cameras make of their images."""
    s = changed(state, stopped=False)
    if local.sequence != s.local:
        s = _give(changed(s, local=local.sequence), local.command, local.angle)
    if packets.count != s.packets:
        s = changed(s, packets=packets.count)
        for packet in packets.packets:
            s = _hear(config, full, most, s, packets.time, packet, mode)
    s = _watch(config, s, time, mode)
    if s.follows is not None and mode.mode == Mode.IDLE and not s.stopped:
        move = s.follows
        s = _give(changed(s, follows=None, began_at=mode.activation), move.command, move.angle)
    ended = mode.mode in TERMINAL and mode.activation > s.began_at and s.follows is None
    if not s.shown.done and ended:
        s = _answer(
            changed(s, shown=dc.replace(s.shown, done=True, verdict=mode.verdict)), f"{mode.verdict}: {mode.reason}"
        )
    return _show(s, time, mode, turning, sees)


def _give(s: State, command: str, angle: float = 0.0) -> State:
    """A command for the supervisor. A stop goes before all others of its step, and forgets what waits for `confirm`."""
    if s.stopped or not command:
        return s
    given = OperatorCommand(sequence=s.command.sequence + 1, command=command, angle=angle)
    if command == "stop":
        return changed(s, command=given, stopped=True, follows=None, talk=Talk())
    return changed(s, command=given)


def _answer(s: State, says: str, **shown: object) -> State:
    return changed(s, shown=dc.replace(s.shown, answers=s.shown.answers + 1, says=says, **shown))  # type: ignore[arg-type]


# ---------------------------------------------------------------- who speaks


def _hear(
    config: OperatorChannelConfig,
    full: float,
    most: float,
    s: State,
    time: float,
    packet: OperatorPacket,
    mode: ModeState,
) -> State:
    """One packet."""
    known = next((one for one in s.speakers if one.number == packet.speaker), Speaker(packet.speaker))
    if not packet.sent > known.sent:  # said again, or overtaken
        return s
    delay = time - packet.sent
    drift = DRIFT * (time - known.last) if known.last > -math.inf else 0.0
    least = min(known.least + drift, delay)
    in_time = delay - least <= config.late
    new = bool(packet.words) and packet.sequence > known.heard
    known = Speaker(
        packet.speaker, packet.sent, time if in_time else known.last, least, max(packet.sequence, known.heard)
    )
    others = tuple(one for one in s.speakers if one.number != packet.speaker)
    kept = (
        tuple(one for one in others if one.number == s.holder)
        + tuple(one for one in others if one.number != s.holder)[-(SPEAKERS - 2) :]
    )
    s = changed(s, speakers=(*kept, known))
    if packet.leaves:
        return changed(_lose(s, "the operator has left"), holder=0) if packet.speaker == s.holder else s
    if in_time and (s.holder == 0 or s.lost):
        s = _take_ear(s, packet.speaker, mode)
    if not new:
        return s
    heard = Heard(packet.words, packet.score, packet.begin, packet.end, packet.typed)
    stop = heard.score >= SURE and parse(heard.text).kind == Kind.STOP
    if packet.speaker != s.holder:
        if stop:
            s = _give(s, "stop")
        words = f"operator {tag(packet.speaker)} is refused, operator {tag(s.holder)} commands"
        return _answer(s, f"stop; {words}" if stop else words, other=packet.speaker)
    age = time - least - packet.said
    told = {"heard": packet.sequence, "words": heard.text, "score": heard.score}
    if not age <= config.late and not stop:
        return _answer(s, f"said {age:.1f} s ago: say it again", outcome="refused", **told)
    s, decision = _converse(s, heard, time, full, most, mode)
    s = changed(s, shown=dc.replace(s.shown, outcome=decision.outcome, **told))  # type: ignore[arg-type]
    if decision.says:
        s = _answer(s, decision.says)
    return _obey(s, packet.sequence, decision.intent, mode) if decision.outcome == "given" else s


def _take_ear(s: State, speaker: int, mode: ModeState) -> State:
    begun = changed(s, holder=speaker, lost=False, talk=Talk())
    if speaker != s.holder:
        begun = changed(begun, shown=dc.replace(begun.shown, heard=0, words="", score=0.0, outcome="", other=0, task=0))
    held = "the grasp is held: say confirm to go on, or stop" if mode.held else "at your service"
    return _answer(begun, held)


def _watch(config: OperatorChannelConfig, s: State, time: float, mode: ModeState) -> State:
    """Notices that the link is lost; while it is, does what the scenario says."""
    if s.holder != 0 and not s.lost:
        last = next(one.last for one in s.speakers if one.number == s.holder)
        if time - last > config.lease:
            s = _lose(s, "the link is lost")
    if not s.lost or config.on_loss == "finish":
        return s
    # The way off the valve goes on; what it leads to, another search or grasp, does not.
    if mode.mode not in RUNNING or TABLE[Mode(mode.mode)].ending or mode.held:
        return s
    if config.on_loss == "hold" and mode.mode in HOLDS:
        return _answer(_give(s, "hold"), f"{s.why}: the grasp is held")
    return _answer(_give(s, "stop"), f"{s.why}: stop")


def _lose(s: State, why: str) -> State:
    return _answer(changed(s, lost=True, why=why, talk=Talk(), follows=None), why)


# ---------------------------------------------------------------- what was said


def _converse(s: State, heard: Heard, time: float, full: float, most: float, mode: ModeState) -> tuple[State, Decision]:
    asked = max(parse(heard.text, full).angle, s.talk.waiting.angle if s.talk.waiting else 0.0)
    refusal = _busy(s, mode)
    if not refusal and asked > most:
        refusal = f"it can turn by {math.degrees(most):.0f} degrees at most"
    talk, decision = converse(
        s.talk,
        heard,
        time,
        full=full,
        status=_status(s, mode),
        refusal=refusal,
        faulty=mode.mode == Mode.FAILED,
        held=mode.held,
    )
    return changed(s, talk=talk), decision


def _busy(s: State, mode: ModeState) -> str:
    """Why no move can begin now; "": one can."""
    if mode.mode == Mode.FAILED:
        return f"the last run has failed ({mode.verdict}), say reset"
    if mode.mode in RUNNING or s.follows is not None:
        return f"{mode.mode} is under way, say stop first"
    return ""


def _status(s: State, mode: ModeState) -> str:
    turned = f", {abs(s.shown.turned):.0f} degrees turned" if mode.mode == Mode.TURN else ""
    held = ", held: say confirm to go on, or stop" if mode.held else ""
    reason = f", {mode.reason}" if mode.reason and not mode.held else ""
    return f"{mode.mode}{reason}{turned}{held}"


def _obey(s: State, sequence: int, intent: Intent, mode: ModeState) -> State:
    if intent.kind not in MOVES:
        command = {Kind.STOP: "stop", Kind.RESET: "reset", Kind.RESUME: "resume"}[intent.kind]
        return _give(s, command)
    s = changed(s, shown=dc.replace(s.shown, task=sequence, done=False, verdict=""), began_at=mode.activation)
    if mode.mode == Mode.IDLE:
        return _give(s, intent.kind.value, intent.angle)
    follows = OperatorCommand(command=intent.kind.value, angle=intent.angle)
    return _give(changed(s, follows=follows), "reset")


# ---------------------------------------------------------------- what is shown


def seen(mode: ModeState, estimate: RectangleEstimate, marks: HandleMarks) -> str:
    """What the cameras that the mode looks at make of their last images; "": it looks at none."""
    parts = []
    if mode.head_every:
        distance = math.sqrt(float(estimate.X_LV[:, 3] @ estimate.X_LV[:, 3]))
        why = f": {estimate.reason}" if estimate.reason else ""
        parts.append(f"marker at {distance:.2f} m" if estimate.found else f"no marker{why}")
    if mode.wrist_every:
        found = [side for side in SIDES if getattr(marks, side).found]
        parts.append(f"green marks: {' and '.join(found) or 'none'}")
    return "; ".join(parts)


def _show(s: State, time: float, mode: ModeState, turning: Status, sees: str) -> State:
    turned = round(math.degrees(turning.value)) if mode.mode == Mode.TURN else s.shown.turned
    shown = dc.replace(
        s.shown,
        time=time,
        speaker=s.holder,
        linked=s.holder != 0 and not s.lost,
        mode=mode.mode,
        reason=mode.reason,
        held=mode.held,
        turned=float(turned) if mode.mode != Mode.IDLE else 0.0,
        sees=sees,
    )
    before, after = (vars(one) | {"time": 0.0} for one in (s.shown, shown))
    return s if before == after else changed(s, shown=shown)
