"""The operator's end of the wire: says words until the program has heard them, and keeps what the robot answers.

What waits is said one after the other; `stop` goes before all of it. The program is silent, or does not answer, is
said to the operator in the robot's stead (`notes`).
"""

import dataclasses as dc
import time as wall
from collections.abc import Callable
from typing import Any

import numpy as np

from valve_drake.messages import OperatorPacket, OperatorState
from valve_drake.operator.grammar import SURE, Heard, Kind, parse
from valve_drake.operator.operator_channel import tag
from valve_drake.operator.wire import RATE, News, Tail, read_report, read_sound, sound_message, words_message
from valve_drake.stations.bus import ANNOUNCED, BadMessage, Bus
from valve_drake.stations.lcm_channels import AUDIO, CONTROLLER, OPERATOR, WORDS, WrongMessage
from valve_drake.stations.reports import PRESENT

SILENT = 3.0  # a program that was not heard for longer is gone; raise it for one that often waits for a processor [s]
STAMP = 2e-6  # stamps are of microseconds [s]
MOST = 64  # messages that are taken in at once
PATIENCE = 3.0  # words that were not taken within this time are given up [s]


class DeskLink:
    """One desk. clock: of its stamps [s]. Use `claim`, then `say`, and `poll` some 50 times a second."""

    def __init__(self, bus: Bus, clock: Callable[[], float] = wall.monotonic):
        self.bus = bus
        self.clock = clock
        self.program = 0  # its number; 0: none was heard
        self.state = OperatorState()  # what the robot answered last
        self.notes: list[str] = []  # for the operator, to be fetched
        self.dropped = 0  # bad messages
        self.unheard = 0  # sentences that were given up
        self._heard_at = float("-inf")
        self._current: OperatorPacket | None = None  # is said until the program has heard it
        self._queue: list[tuple[float, Heard]] = []  # when it was said, and what
        self._sequence = 0
        self._sent_at = self._stamp = float("-inf")
        self._refused = False
        self._tail = Tail()
        self._told_others = False
        self._stranger_at = float("-inf")  # when another program than ours was heard last
        bus.listen(CONTROLLER, self._hear, between=OPERATOR)

    @property
    def number(self) -> int:
        """This desk's own."""
        return self.bus.instance

    @property
    def linked(self) -> bool:
        """The program is heard."""
        return self.silence <= SILENT

    @property
    def silence(self) -> float:
        """Since the program was heard last [s]."""
        return self.clock() - self._heard_at

    @property
    def commanding(self) -> bool:
        """The robot listens to this desk."""
        return self.linked and self.state.speaker == self.number

    @property
    def waiting(self) -> bool:
        """Something is still to be said."""
        return self._current is not None or bool(self._queue)

    def claim(self) -> Callable[[], bool]:
        """As Bus.claim, for the operator's role."""
        return self.bus.claim(OPERATOR)

    def say(self, heard: Heard) -> None:
        """Words for the robot."""
        if heard.score >= SURE and parse(heard.text).kind == Kind.STOP:
            self._queue, self._current = [], None
            self._begin(self.clock(), heard)
        else:
            self._queue.append((self.clock(), heard))
        self.poll()

    def listen(self, take: Callable[[np.ndarray], None]) -> None:
        """Hands the sound that others put on the bus to `take` (n,) int16, as `poll` finds it."""

        news = News()

        def hear(key: str, message: Any) -> None:
            if key != AUDIO:
                return
            try:
                if isinstance(message, BadMessage):
                    raise WrongMessage(message.words)
                sound = news.take(read_sound(message))
            except WrongMessage:
                self.dropped += 1
                return
            if sound is not None:
                take(sound.samples)

        self.bus.listen(OPERATOR, hear, between=OPERATOR)

    def sound(self, samples: np.ndarray) -> None:
        """Sound (n,) int16 at RATE that was heard just now, for the robot's log and who else listens."""
        self.bus.send(AUDIO, sound_message(self._tail.add(samples, self.clock() - len(samples) / RATE)))

    def poll(self) -> None:
        """Takes in what has arrived, and says what is due."""
        for _ in range(MOST):
            if not self.bus.pump():
                break
        now = self.clock()
        if self.program and not self.linked:
            self.program = 0
            self.notes.append("the program is not heard any more")
        if self._current is not None and now - self._current.said > PATIENCE:
            self._give_up(self._current.words)
            self._current = None
        while self._queue and now - self._queue[0][0] > PATIENCE:
            self._give_up(self._queue.pop(0)[1].text)
        if self._current is None and self._queue and self.program:
            self._begin(*self._queue.pop(0))
        self.bus.announce(OPERATOR)
        others = self.bus.others(OPERATOR) > 0
        if others and not self._told_others:
            self.notes.append("another operator's desk is on the bus: one of you has to leave")
        self._told_others = others
        if now - self._sent_at >= ANNOUNCED:
            self._send(now)

    def _give_up(self, words: str) -> None:
        self.unheard += 1
        self.notes.append(f"not heard by the robot: {words}")

    def leave(self) -> None:
        """Gives the robot's ear back: the end of this desk."""
        now = self.clock()
        self._put(OperatorPacket(speaker=self.number, said=now, leaves=True), now)

    def _begin(self, said: float, heard: Heard) -> None:
        self._sequence += 1
        self._current = OperatorPacket(
            speaker=self.number,
            sequence=self._sequence,
            words=heard.text,
            score=heard.score,
            said=said,
            begin=heard.begin,
            end=heard.end,
            typed=heard.typed,
        )
        self._send(self.clock())

    def _send(self, now: float) -> None:
        self._sent_at = now
        idle = OperatorPacket(speaker=self.number, said=now)
        self._put(self._current or idle, now)

    def _put(self, packet: OperatorPacket, now: float) -> None:
        self._stamp = max(now, self._stamp + STAMP)  # each is later than the one before
        self.bus.send(WORDS, words_message(dc.replace(packet, sent=self._stamp), self.program))

    def _hear(self, key: str, message: Any) -> None:
        try:
            if isinstance(message, BadMessage):
                raise WrongMessage(message.words)
            program, state = read_report(message)
        except WrongMessage:
            self.dropped += 1
            return
        if self.program not in (0, program):
            now = self.clock()
            if now - self._heard_at <= PRESENT:
                if now - self._stranger_at > SILENT:  # else it has been told
                    self.notes.append(f"a second program answers on this bus ({tag(program)}): it is not listened to")
                self._stranger_at = now
                return
            self._queue, self._current = [], None  # what was meant for the other one
        self.program, self.state, self._heard_at = program, state, self.clock()
        current = self._current
        if current is not None and state.speaker == self.number and state.heard >= current.sequence:
            self._current = None
        refused = state.other == self.number and state.speaker != self.number
        if refused and not self._refused:
            self.notes.append(f"refused: operator {tag(state.speaker)} commands this robot")
            self._current, self._queue = None, []
        self._refused = refused
