"""What both ends of the wire do with what they hear: judge stamps, count bad messages, notice a second sender.

Each class keeps numbers only, so that a rehearsal can copy and restore it.
"""

import collections
import dataclasses as dc
import math
from collections.abc import Iterator, Mapping
from typing import Any

from valve_drake.ports import TICK

RESTART = 0.5  # a stamp that goes back by more is a clock begun anew [s]
AHEAD = 1.0  # a stamp may run ahead of the receiver's clock by so much; more is no clock's [s]
PATIENCE = 2 * TICK  # a device that has no good message for longer after a bad one is a fault; some have more [s]
MANY = 16  # bad messages of a device within a second that are a fault though good ones come too
SHOWN = 0.5  # a fault is reported for so long after its last cause [s]
PRESENT = 0.5  # a sender that has not said that it is there for longer has gone [s]


class Stamps:
    """Which messages of each channel are news, by their senders' stamps.

    quiet: how long a channel must have been silent before a sender whose clock begins anew is believed [s].
    """

    NEWS, OLD, STRANGE, RESTARTED = "news", "old", "strange", "restarted"

    def __init__(self, quiet: float = 0.0):
        self._quiet = quiet
        self._last: dict[str, tuple[int, float]] = {}  # channel -> stamp [us], arrival [s]
        self._strange: dict[str, tuple[int, float]] = {}  # the same of one that may have begun a new clock

    def judge(self, key: str, stamp: int, time: float) -> str:
        """A message at `time` of the receiver's clock.

        NEWS: to be taken. OLD: a duplicate, or overtaken on the way. STRANGE: its stamp cannot be of the same clock as
        the last one. RESTARTED: as NEWS, but it is the second one by a new clock.
        """
        last = self._last.get(key)
        if last is None or _follows(last, stamp, time):
            verdict = self.NEWS
        elif 0 <= last[0] - stamp < 1e6 * RESTART:
            return self.OLD
        else:
            first = self._strange.get(key)
            if first is None or not _follows(first, stamp, time) or time - last[1] <= self._quiet:
                if first is None or first[0] != stamp:
                    self._strange[key] = (stamp, time)
                return self.STRANGE
            verdict = self.RESTARTED
        self._strange.pop(key, None)
        self._last[key] = (stamp, time)
        return verdict


def _follows(before: tuple[int, float], stamp: int, time: float) -> bool:
    return 0 < stamp - before[0] <= 1e6 * (time - before[1] + AHEAD)


@dc.dataclass
class _Record:
    """Of one device."""

    words: str = ""
    since: float = math.inf  # the first bad message after the last good one [s]
    last: float = -math.inf  # the last one that was part of a fault [s]
    recent: collections.deque[float] = dc.field(default_factory=lambda: collections.deque(maxlen=MANY))
    count: int = 0


class BadMessages:
    """Messages that were dropped, by device: a single one is counted, but one after another is a fault."""

    def __init__(self, patience: Mapping[str, float]):
        """patience: of a device, how long it may have no good message after a bad one before that is a fault [s]."""
        self._patience = dict(patience)
        self._records: dict[str, _Record] = {}

    @property
    def counts(self) -> dict[str, int]:
        """How many were dropped so far."""
        return {device: record.count for device, record in self._records.items()}

    @property
    def words(self) -> dict[str, str]:
        """What was wrong with the last one of each device."""
        return {device: record.words for device, record in self._records.items()}

    def bad(self, device: str, words: str, time: float, at_once: bool = False) -> None:
        """A message was dropped. at_once: it is a fault by itself."""
        record = self._records.setdefault(device, _Record())
        record.words, record.since = words, min(record.since, time)
        record.recent.append(time)
        record.count += 1
        if at_once or (len(record.recent) == MANY and time - record.recent[0] <= 1.0):
            record.last = time

    def good(self, device: str, time: float) -> None:
        """A message was taken."""
        record = self._records.get(device)
        if record is not None and record.since < math.inf:
            if time - record.since > self._patience.get(device, PATIENCE):
                record.last = max(record.last, record.recent[-1])
            record.since = math.inf

    def faults(self, time: float) -> Iterator[str]:
        """What is wrong now."""
        for device, record in self._records.items():
            patience = self._patience.get(device, PATIENCE)
            goes_on = time - record.since > patience and time - record.recent[-1] <= max(SHOWN, 2 * patience)
            if goes_on or time - record.last <= SHOWN:
                yield record.words


def listed(counts: Mapping[str, int]) -> str:
    """For people: "torso 3, head_left 1"."""
    return ", ".join(f"{device} {count}" for device, count in counts.items())


class Senders:
    """Who speaks for a role ("robot", "controller"): every process says its own random number."""

    def __init__(self) -> None:
        self._last_heard: dict[str, dict[float, float]] = collections.defaultdict(dict)  # role -> number -> when

    def hear(self, role: str, instance: float, time: float) -> None:
        """Somebody has said that it is there."""
        here = self._last_heard[role]
        here[instance] = time
        for gone in [number for number, when in here.items() if time - when > PRESENT]:
            del here[gone]

    def present(self, role: str, time: float) -> int:
        """How many there are now."""
        return sum(time - when <= PRESENT for when in self._last_heard[role].values())


class LeastDelay:
    """Where a sender's stamps lie on the receiver's clock: by the least delay that its messages had of late."""

    KEPT = 2.0  # the least delay is taken over this long [s]

    def __init__(self) -> None:
        self._delays: collections.deque[tuple[float, float]] = collections.deque()  # (time, least of a tick)
        self._now = math.inf

    def add(self, delay: float) -> None:
        """Of one message of this tick [s]; the two clocks' difference is part of it."""
        self._now = min(self._now, delay)

    def close(self, time: float) -> None:
        """Ends a tick."""
        if math.isfinite(self._now):
            self._delays.append((time, self._now))
        while self._delays and time - self._delays[0][0] > self.KEPT:
            self._delays.popleft()
        self._now = math.inf

    def forget(self) -> None:
        """The sender's clock has begun anew."""
        self._delays.clear()

    def least(self) -> float | None:
        """[s]; None while nothing is known."""
        return min((delay for _, delay in self._delays), default=None)


class Lockstep:
    """One end's count of the ticks: one is complete when as many messages have come as the other end says it sent."""

    def __init__(self) -> None:
        self.tick: int | None = None  # that the other end has announced last; None: it does not run in lock-step
        self._announced = 0  # messages since the start, by the other end's count
        self._received = 0  # the same as counted here
        self._sent_before = 0

    def hear(self, message: Any) -> bool:
        """The other end's announcement -> whether it is one."""
        if message.dim != 2 or not all(abs(v) < 2**53 and v == int(v) for v in message.val):
            return False
        self.tick, self._announced = (int(v) for v in message.val)
        if self.tick < 0:  # what comes before the start does not count
            self._received = 0
        return True

    def count(self) -> None:
        """A message of the table has come."""
        self._received += 1

    def begin(self, sent: int) -> None:
        """What was sent, `sent` messages, and heard before the start does not count."""
        self._sent_before, self._received = sent, 0

    def complete(self, tick: int) -> bool:
        """Whether all messages of a tick are here. What came beyond them is no longer counted."""
        if self.tick != tick or self._received < self._announced:
            return False
        self._received = self._announced
        return True

    def announcement(self, tick: int, sent: int) -> dict[str, float]:
        """What this end says after its last message of a tick. sent: messages since its bus was opened."""
        return {"tick": tick, "messages": sent - self._sent_before}

    def progress(self) -> str:
        """For people: how far the tick has come."""
        return f"at tick {self.tick} with {self._received} of {self._announced} messages"
