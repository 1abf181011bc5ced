"""The operator's desk: what it shows, and what its keys say. It knows no terminal; commands/operator.py has one."""

import dataclasses as dc
import re
import time as wall
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from valve_drake.console import styled
from valve_drake.operator.desk_link import DeskLink
from valve_drake.operator.ear import Beside, Recogniser
from valve_drake.operator.grammar import SURE, Heard, Kind, parse
from valve_drake.operator.operator_channel import tag
from valve_drake.operator.wire import RATE
from valve_drake.task.modes import RUNNING, TABLE

if TYPE_CHECKING:
    from rich.console import RenderableType

KEYS = {
    " ": "stop",
    "x": "stop",
    "o": "open",
    "c": "close",
    "h": "half",
    "y": "confirm",
    "n": "cancel",
    "s": "status",
    "r": "reset",
}
TYPE, LEAVE, ENTER, ERASE, ESCAPE = "t", "q", "\r\n", "\x7f\b", "\x1b"
LATE = 1.0  # of sound that waits to be heard, from which the page says so [s]
NOTHING = np.zeros(0, np.int16)
MOST_LINES = 500  # of the conversation that are kept
COLORS = {"you": "cyan", "robot": "bold", "desk": "yellow"}


# What a terminal sends for a key without a character (arrows, function keys), and the beginning of such.
_SEQUENCE = re.compile(r"\x1b(?:\[[0-?]*[ -/]*[@-~]|O[ -~])")
_BEGINNING = re.compile(r"\x1b(?:\[[0-?]*[ -/]*|O)\Z")


def keys_of(text: str) -> tuple[str, str]:
    """The keys that a terminal's text stands for, and what of it belongs to the text that comes next.

    Keys without a character are left out, and nothing else: a stop that comes with an arrow is a stop.
    """
    text = _SEQUENCE.sub("", text)
    rest = _BEGINNING.search(text)
    return (text, "") if rest is None else (text[: rest.start()], rest[0])


@dc.dataclass(frozen=True)
class Line:
    """One line of the conversation. who: you, robot or desk."""

    time: float  # [s]
    who: str
    text: str


class Desk:
    """What one operator sees and says.

    ear: makes words of sound, of a piece at once or later (ear.Beside). send_sound: what it hears goes to the robot's
    log.
    """

    def __init__(
        self,
        link: DeskLink,
        ear: Recogniser | None = None,
        send_sound: bool = True,
        clock: Callable[[], float] = wall.monotonic,
    ):
        self.link = link
        self.lines: list[Line] = []
        self.typing: str | None = None  # a sentence under way
        self.left = False
        self._ear, self._send_sound, self._clock = ear, send_sound, clock
        self._begun = clock()
        self._answers = self._program = 0
        self._asked_to_leave = False
        self._begin: float | None = None  # of the first sample [s]
        self._level = 0.0

    # ------------------------------------------------------------ what is said
    def say(self, heard: Heard) -> None:
        """Words, by key, script or ear. Those that are not believed are said too: the robot ignores and logs them."""
        score = "" if heard.typed else f" ({heard.score:.2f})"
        unclear = "" if heard.score >= SURE else "not clear: "
        self._add("you", f"{unclear}{heard.text}{score}")
        self.link.say(heard)

    def sound(self, samples: np.ndarray) -> None:
        """A piece of sound (n,) int16 at RATE that was heard just now."""
        begin = self._clock() - len(samples) / RATE
        if self._begin is None:
            self._begin = begin
        self._level = float(np.sqrt(np.mean((samples / 2**15) ** 2))) if len(samples) else 0.0
        if self._send_sound:
            self.link.sound(samples)
        self._hear(samples)

    def _hear(self, samples: np.ndarray) -> None:
        if self._ear is None or self._begin is None:
            return
        for heard in self._ear.push(samples):
            self.say(dc.replace(heard, begin=self._begin + heard.begin, end=self._begin + heard.end))

    def press(self, key: str) -> None:
        """One key."""
        if self.typing is not None:
            self._type(key)
        elif key == TYPE:
            self.typing = ""
        elif key == LEAVE:
            self._leave()
        elif key.lower() in KEYS or key in ENTER:
            self.say(Heard(KEYS.get(key.lower(), "confirm"), typed=True))
        self._asked_to_leave = key == LEAVE and not self.left

    def _type(self, key: str) -> None:
        assert self.typing is not None
        if key in ENTER:
            text, self.typing = self.typing.strip(), None
            if text:
                self.say(Heard(text, typed=True))
        elif key == ESCAPE:
            self.typing = None
        elif key in ERASE:
            self.typing = self.typing[:-1]
        elif key.isprintable():
            self.typing = (self.typing + key)[:100]
        if self.typing and parse(self.typing).kind == Kind.STOP:  # needs no Enter
            self.typing = None
            self.say(Heard("stop", typed=True))

    def _leave(self) -> None:
        if self.moving and self.link.commanding and not self._asked_to_leave:
            self._add("desk", "the robot is under way: leaving now loses its link. q again leaves")
        else:
            self.left = True

    # ------------------------------------------------------------ what is answered
    @property
    def moving(self) -> bool:
        """A run is under way."""
        return self.link.linked and self.link.state.mode in RUNNING

    def poll(self) -> None:
        """Listens and speaks on the wire; to be called some 50 times a second."""
        self._hear(NOTHING)
        self.link.poll()
        state = self.link.state
        if self.link.program != self._program:  # what it said before was not for this desk
            self._program, self._answers = self.link.program, state.answers
        if state.answers != self._answers:
            self._answers = state.answers
            if state.says:
                self._add("robot", state.says)
        for note in self.link.notes:
            self._add("desk", note)
        self.link.notes.clear()

    def _add(self, who: str, text: str) -> None:
        self.lines.append(Line(self._clock() - self._begun, who, text))
        del self.lines[:-MOST_LINES]

    # ------------------------------------------------------------ what is shown
    def shown(self, height: int = 24) -> "RenderableType":
        """The whole page, of so many lines."""
        from rich.console import Group
        from rich.panel import Panel

        head = [self._where(), self._what(), self._sees()]
        room = max(height - len(head) - 8, 3)
        talk = [
            styled((f"{line.time:7.1f} s  ", "dim"), (f"{line.who:<6}", COLORS[line.who]), line.text)
            for line in self.lines[-room:]
        ]
        talk += [styled("")] * (room - len(talk))
        return Group(
            Panel(Group(*head), title="robot", title_align="left"),
            Panel(Group(*talk), title="said", title_align="left"),
            self._keys(),
        )

    def _where(self) -> "RenderableType":
        link, state = self.link, self.link.state
        if not link.linked:
            return styled(("no program is heard", "bold red"), " (valve-drake run --operator)")
        if not link.commanding:
            other = f"operator {tag(state.speaker)} commands" if state.speaker else "nobody commands yet"
            return styled((other, "bold yellow"), f"; you are {tag(link.number)}")
        return styled(("you command", "green"), f"; you are {tag(link.number)}, the program {tag(link.program)}")

    def _what(self) -> "RenderableType":
        state = self.link.state
        if not self.link.linked:
            return styled("")
        color = {"done": "bold green", "failed": "bold red", "stopped": "bold yellow"}.get(state.mode, "bold")
        what = next((row.what for mode, row in TABLE.items() if mode == state.mode), "")
        turned = f"  {abs(state.turned):.0f} deg turned" if state.turned else ""
        held = ("  HELD", "bold yellow") if state.held else ""
        return styled((f"{state.mode:<15}", color), state.reason or what, turned, held)

    def _sees(self) -> "RenderableType":
        state = self.link.state
        ear = f"   ear {'#' * min(int(40 * self._level), 20):<20}" if self._ear is not None else ""
        late = self._ear.late if isinstance(self._ear, Beside) else 0.0
        slow = f" hears {late:.1f} s late" if late > LATE else ""
        sees = f"{state.sees or '-':<40}" if self.link.linked else ""
        return styled(("sees ", "dim"), sees, (ear, "dim"), (slow, "bold red"))

    def _keys(self) -> "RenderableType":
        if self.typing is not None:
            return styled(("say: ", "bold"), self.typing, ("_", "blink"), ("   Enter says it, Esc does not", "dim"))
        return styled(
            ("SPACE stop", "bold red"),
            "  o open  c close  h half  ",
            ("y confirm", "bold green"),
            "  n cancel  s status  r reset  t type a sentence  q leave",
        )


def transcript(lines: Sequence[Line]) -> list[str]:
    """The conversation as plain lines, for scripts."""
    return [f"{line.who}: {line.text}" for line in lines]
