"""What an operator may say: a closed grammar, and the conversation that leads to a command.

    robot, open the valve            -> "open by 90 degrees: say confirm"
    confirm                          -> the command is given
    stop                             -> at once, in every state, without the wake phrase

What moves the robot is read back first and waits for `confirm`; a wrong number of degrees is noticed there.
`converse` is one pure function, which a log's words can be put through again. A recogniser of speech gives `Heard`; it
need not know more of this page than `PHRASES`.

    wake phrase     robot; first in a sentence, or alone and the sentence within `LISTENING`; typed words need none
    move            (open | close) [the] [valve] [half [way] | [by] N [degrees]]; N: 1 to 720, in digits or in words
    its correction  half [way] | by N [degrees], while a move waits for `confirm`
    other           confirm | cancel | status | reset | stop | halt; `please` and `now` may stand anywhere
"""

import dataclasses as dc
import enum
import math
import re
from typing import Literal

WAKE = "robot"
LISTENING = 5.0  # from the wake phrase alone to the sentence; raise it for slow speakers [s]
WAITING = 12.0  # from the read-back to `confirm`; what is said later begins anew [s]
SURE = 0.5  # a recogniser's score from which it believes what it heard; each scales its evidence so [0..1]
LEAST, MOST = 1.0, 720.0  # that can be asked for; the robot's own limit may be lower [deg]
LONGEST = 120  # characters of a sentence


class Kind(enum.StrEnum):
    """What a sentence means; UNKNOWN: it is not of the grammar."""

    UNKNOWN = ""
    WAKE = "wake"  # the wake phrase alone
    OPEN = "open"
    CLOSE = "close"
    AMOUNT = "amount"  # another angle for the move that waits
    CONFIRM = "confirm"
    CANCEL = "cancel"
    STATUS = "status"
    RESET = "reset"
    STOP = "stop"
    RESUME = "go on"  # no sentence: `confirm` while the turn is held


MOVES = (Kind.OPEN, Kind.CLOSE)

# What a recogniser listens for. <N> is a number of degrees: those of NUMBERS at least.
PHRASES: dict[str, Kind] = {
    "robot": Kind.WAKE,
    "open": Kind.OPEN,
    "open the valve": Kind.OPEN,
    "open half": Kind.OPEN,
    "open by <N> degrees": Kind.OPEN,
    "close": Kind.CLOSE,
    "close the valve": Kind.CLOSE,
    "close half": Kind.CLOSE,
    "close by <N> degrees": Kind.CLOSE,
    "half": Kind.AMOUNT,
    "by <N> degrees": Kind.AMOUNT,
    "confirm": Kind.CONFIRM,
    "cancel": Kind.CANCEL,
    "status": Kind.STATUS,
    "reset": Kind.RESET,
    "stop": Kind.STOP,
}
NUMBERS = (10, 15, 20, 30, 45, 60, 75, 90, 120, 135, 150, 180, 270, 360)  # that speech needs; text takes all of them


@dc.dataclass(frozen=True)
class Heard:
    """One utterance.

    text: what was understood, in any spelling. score: how sure its recogniser is, 0 to 1 (SURE: it believes it).
    begin, end: of the sound [s of the speaker's clock]. typed: by keys or a script, not by ear.
    """

    text: str
    score: float = 1.0
    begin: float = 0.0
    end: float = 0.0
    typed: bool = False


@dc.dataclass(frozen=True)
class Intent:
    """What a sentence means. angle: of a move, above 0 [rad]. awake: it began with the wake phrase."""

    kind: Kind
    angle: float = 0.0
    awake: bool = False

    def words(self) -> str:
        """For people: "open by 90 degrees"."""
        if self.kind == Kind.RESET:
            return "reset, the arms go home"
        return f"{self.kind.value} by {_degrees(self.angle)}" if self.kind in MOVES else self.kind.value


def _degrees(angle: float) -> str:
    degrees = round(math.degrees(angle), 1)
    return f"{degrees:g} degree{'' if degrees == 1 else 's'}"


_UNITS = ("zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen sixteen "
          "seventeen eighteen nineteen").split()  # fmt: skip
_TENS = "twenty thirty forty fifty sixty seventy eighty ninety".split()
_VALUES = {word: n for n, word in enumerate(_UNITS)} | {word: 10 * n for n, word in enumerate(_TENS, 2)}
_AMOUNT = r"(?:(?P<half>half)(?: way)?|(?P<by>by )?(?P<number>[0-9]{1,4}(?:\.[0-9]{1,3})?)(?P<unit> degrees?)?)"
_MOVE = re.compile(rf"(?P<verb>open|close)(?: the)?(?: valve)?(?: {_AMOUNT})?")
_CORRECTION = re.compile(_AMOUNT)
_OTHERS = {
    "": Kind.WAKE,
    "confirm": Kind.CONFIRM,
    "cancel": Kind.CANCEL,
    "status": Kind.STATUS,
    "reset": Kind.RESET,
}
_STOPS = {"stop", "halt"}


def spoken(number: int) -> str:
    """A whole number from 1 to 999 in words, as PHRASES has them: "one hundred twenty"."""
    if number >= 100:
        rest = spoken(number % 100) if number % 100 else ""
        return f"{_UNITS[number // 100]} hundred {rest}".strip()
    if number < 20:
        return _UNITS[number]
    return f"{_TENS[number // 10 - 2]} {_UNITS[number % 10] if number % 10 else ''}".strip()


def normal(text: str) -> str:
    """Small letters, numbers in digits, one space between words, nothing else."""
    text = text[:LONGEST].lower().replace("°", " degrees ")
    words = re.findall(r"[0-9]+(?:\.[0-9]+)?|[^\W\d_]+", text)
    return " ".join(_in_digits([word for word in words if word not in ("please", "now")]))


def _in_digits(words: list[str]) -> list[str]:
    """The words with every number that is spelt out in digits."""
    out: list[str] = []
    k = 0
    while k < len(words):
        length, value = _number(words[k:])
        out.append(str(value) if length else words[k])
        k += max(length, 1)
    return out


def _number(words: list[str]) -> tuple[int, int]:
    """How many words at the beginning are a number below 1000, and which; 0, 0: none."""
    begun, hundreds = 0, 0
    if words[:1] == ["hundred"]:
        begun, hundreds = 1, 100
    elif words[1:2] == ["hundred"] and (words[0] == "a" or 0 < _VALUES.get(words[0], 0) < 10):
        begun, hundreds = 2, 100 * _VALUES.get(words[0], 1)
    joined = int(begun > 0 and words[begun : begun + 1] == ["and"])
    length, value = _below_100(words[begun + joined :])
    if begun and not value:
        return begun, hundreds
    return begun + joined + length, hundreds + value


def _below_100(words: list[str]) -> tuple[int, int]:
    if not words or words[0] not in _VALUES:
        return 0, 0
    value = _VALUES[words[0]]
    if value >= 20 and len(words) > 1 and 0 < _VALUES.get(words[1], 0) < 10:
        return 2, value + _VALUES[words[1]]
    return 1, value


def parse(text: str, full: float = math.pi / 2) -> Intent:
    """The meaning of a sentence. full: what `open` alone asks for [rad]. A sentence with `stop` in it is a stop."""
    words = normal(text).split()
    if _STOPS & set(words):
        return Intent(Kind.STOP, awake=True)
    awake = words[:1] == [WAKE]
    rest = " ".join(words[awake:])
    if rest in _OTHERS and (rest or awake):
        return Intent(_OTHERS[rest], awake=awake)
    found, kind = _MOVE.fullmatch(rest), Kind.AMOUNT
    if found is not None:
        kind = Kind(found["verb"])
    else:
        found = _CORRECTION.fullmatch(rest)
    angle = None if found is None else _angle(found, full)
    return Intent(Kind.UNKNOWN, awake=awake) if angle is None else Intent(kind, angle, awake)


def _angle(found: "re.Match[str]", full: float) -> float | None:
    """What a move or a correction asks for [rad]; None: no number of degrees that can be meant."""
    if found["half"]:
        return full / 2
    if found["number"] is None:
        return full
    degrees = float(found["number"])
    if not (found["by"] or found["unit"]) or not LEAST <= degrees <= MOST:
        return None
    return math.radians(degrees)


# ---------------------------------------------------------------- the conversation


@dc.dataclass(frozen=True)
class Talk:
    """Where a conversation stands. The next one is made by `converse`."""

    waiting: Intent | None = None  # what was read back and waits for `confirm`
    since: float = -math.inf  # when that was [s]
    called: float = -math.inf  # when the wake phrase was heard alone [s]


Outcome = Literal["ignored", "listening", "asked", "answered", "refused", "given"]


@dc.dataclass(frozen=True)
class Decision:
    """What came of one utterance.

    outcome: ignored: it was not for the robot, or not heard well; listening: it was called; asked: read back, waits
    for `confirm`; answered: nothing but an answer; refused: understood and not done; given: `intent` is now commanded.
    says: the robot's answer, for the screen and the log; "" if it says nothing.
    """

    outcome: Outcome
    intent: Intent
    says: str = ""


def converse(
    talk: Talk,
    heard: Heard,
    time: float,
    *,
    full: float = math.pi / 2,
    status: str = "",
    refusal: str = "",
    faulty: bool = False,
    held: bool = False,
) -> tuple[Talk, Decision]:
    """One utterance at `time` [s] -> the conversation after it, and what came of it.

    full: what `open` alone asks for [rad]. status: the answer to `status`. refusal: why no move can begin now; "": one
    can. faulty: the last run has failed, which only `reset` leads out of. held: a turn waits, and goes on by `confirm`.
    """
    intent = parse(heard.text, full)
    if not heard.score >= SURE:
        return talk, Decision("ignored", intent)
    if intent.kind == Kind.STOP:
        return Talk(), Decision("given", intent, "stop")
    pending = talk.waiting if time - talk.since <= WAITING else None
    talk = dc.replace(talk, waiting=pending)
    if held and pending is None:
        pending = Intent(Kind.RESUME)
    called = heard.typed or intent.awake or time - talk.called <= LISTENING
    if not called and pending is None:
        return talk, Decision("ignored", intent)
    match intent.kind:
        case Kind.WAKE:
            return dc.replace(talk, called=time), Decision("listening", intent, "yes?")
        case Kind.CONFIRM:
            if pending is None:
                return Talk(), Decision("refused", intent, "there is nothing to confirm")
            if refusal and pending.kind in MOVES:
                return Talk(), Decision("refused", pending, f"not now: {refusal}")
            return Talk(), Decision("given", pending, pending.words())
        case Kind.CANCEL:
            there = talk.waiting is not None
            return Talk(), Decision("answered", intent, "cancelled" if there else "there is nothing to cancel")
        case Kind.AMOUNT if pending is not None and pending.kind in MOVES:
            return _ask(dc.replace(pending, angle=intent.angle), time)
        case Kind.OPEN | Kind.CLOSE if called:
            if refusal:
                return Talk(), Decision("refused", intent, f"not now: {refusal}")
            return _ask(intent, time)
        case Kind.STATUS if called:
            return dc.replace(talk, called=-math.inf), Decision("answered", intent, status)
        case Kind.RESET if called:
            return _ask(intent, time) if faulty else (Talk(), Decision("answered", intent, "there is nothing to reset"))
    if called:  # it was meant for the robot
        return dc.replace(talk, called=-math.inf), Decision("refused", intent, "not understood")
    return talk, Decision("ignored", intent)


def _ask(intent: Intent, time: float) -> tuple[Talk, Decision]:
    return Talk(waiting=intent, since=time), Decision("asked", intent, f"{intent.words()}: say confirm")
