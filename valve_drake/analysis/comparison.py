"""Compares messages with the recorded ones, tick by tick: bit-equal, or where they differ and by how much."""

import collections
import dataclasses as dc
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto

from valve_drake.messages import Message
from valve_drake.pace import PACE
from valve_drake.recording import schemas
from valve_drake.recording.foxglove import AUDIO, NANO, nanoseconds
from valve_drake.recording.reader import LogReader, Record

UNCOMPARED = (
    "/truth/",
    PACE,
    AUDIO,
)  # prefixes of topics that no block writes: they come from the simulator, the wall clock and a microphone
LONGEST = 60  # values in a report are cut to this [characters]


class Divergence(NamedTuple):
    """Where two messages differ. field "": one of the two does not exist, and its value is None."""

    time: float  # [s]
    topic: str
    field: str
    recorded: Any
    replayed: Any

    def __str__(self) -> str:
        change = f"{_short(self.recorded)} -> {_short(self.replayed)}"
        if not self.field:
            change = "only in the replay" if self.recorded is None else "not in the replay"
        return f"{self.topic} {self.field} {change}".replace("  ", " ")

    def as_json(self) -> dict[str, Any]:
        """The object of `replay --json`."""
        plain = {key: _plain(value) for key, value in self._asdict().items()}
        return {"time_s": plain.pop("time")} | plain


@dc.dataclass
class TopicDifference:
    """The differences in one topic; messages of the same time are compared."""

    recorded: int = 0
    replayed: int = 0
    equal: int = 0
    first: Divergence | None = None
    largest: Divergence | None = None  # of all numbers

    @property
    def identical(self) -> bool:
        return self.recorded == self.replayed == self.equal

    @property
    def max_difference(self) -> float:
        return 0.0 if self.largest is None else abs(self.largest.recorded - self.largest.replayed)


class Comparison:
    """A recorder's sink: what is written is compared with what a log holds up to `end` [s], UNCOMPARED left out.

    topics: TopicDifference by name, complete after `finish`. first: the first difference in time; of those in one tick,
    the one whose topic was the first in the log. That is the order of the recorder's table, in which data flows.
    of: which topics are compared, by name, of those that are not UNCOMPARED.
    """

    def __init__(self, log: LogReader, end: float, of: Callable[[str], bool] = lambda topic: True):
        names = (name for name in log.topics if not name.startswith(UNCOMPARED) and of(name))
        self.topics = {name: TopicDifference() for name in names}
        self.first: Divergence | None = None
        self._log = log
        self._kinds: dict[str, type[Proto]] = {}  # that were written, by topic
        self._recorded = log.instants(self.topics, end)
        self._next = next(self._recorded, None)
        self._time, self._when = 0.0, 0  # of the last messages that were written [s, ns]
        self._replayed: list[tuple[str, bytes]] = []  # at that time
        self._alike: collections.Counter[tuple[str, ...]] = collections.Counter()  # instants, by what was equal in them

    @property
    def identical(self) -> bool:
        return all(topic.identical for topic in self.topics.values())

    @property
    def max_difference(self) -> float:
        return max((topic.max_difference for topic in self.topics.values()), default=0.0)

    def write(self, topic: str, message: schemas.Loggable, time: float) -> None:
        """Takes a message at `time` [s]; it is compared when all of its instant are there."""
        if topic.startswith(UNCOMPARED):
            return
        if time != self._time and (when := nanoseconds(time)) != self._when:
            self._settle()
            self._time, self._when = time, when
        self._kinds[topic], data = message if isinstance(message, schemas.Encoded) else schemas.serialized(message)
        self._replayed.append((topic, data))

    def flush(self) -> None:
        """Does nothing: no message is buffered."""

    def finish(self) -> None:
        """Compares what is left when all has been written."""
        self._settle()
        while self._next is not None:
            self._compare_next([])
        for names, instants in self._alike.items():
            for topic in map(self.topics.__getitem__, names):
                topic.recorded += instants
                topic.replayed += instants
                topic.equal += instants
        self._alike.clear()

    def _settle(self) -> None:
        """Compares all up to the time of the last messages that were written."""
        while self._next is not None and self._next[0] < self._when:
            self._compare_next([])
        if self._next is not None and self._next[0] == self._when:
            self._compare_next(self._replayed)
        else:
            self._compare(self._when, [], self._replayed)
        self._replayed = []

    def _compare_next(self, replayed: list[tuple[str, bytes]]) -> None:
        assert self._next is not None
        when, recorded = self._next
        self._compare(when, recorded, replayed)
        self._next = next(self._recorded, None)

    def _compare(self, when: int, recorded: list[tuple[str, bytes]], replayed: list[tuple[str, bytes]]) -> None:
        if recorded == replayed:
            self._alike[tuple([topic for topic, _ in recorded])] += 1
            return
        for topic, _ in recorded:
            self.topics[topic].recorded += 1
        for topic, _ in replayed:
            self.topics.setdefault(topic, TopicDifference()).replayed += 1
        touched = {topic for topic, _ in itertools.chain(recorded, replayed)}
        for topic in (name for name in self.topics if name in touched):
            pairs = itertools.zip_longest(_of(topic, recorded), _of(topic, replayed))
            for before, after in pairs:
                if before == after:
                    self.topics[topic].equal += 1
                else:
                    self._note(when, topic, before, after)

    def _note(self, when: int, topic: str, before: bytes | None, after: bytes | None) -> None:
        """Records the differences of two messages."""
        total = self.topics[topic]
        if before is None or after is None:
            found = [("", None if before is None else "", None if after is None else "")]
        else:
            replayed = schemas.parsed(schemas.Encoded(self._kinds[topic], after))
            found = differences(self._log.decode(Record(topic, when, 0, before)), replayed)
            if not found and self._canonical(topic, before) == self._canonical(topic, after):
                total.equal += 1
                return
            found = found or [("(encoding)", "", "")]  # by a program that had other fields
        for field, a, b in found:
            change = Divergence(when / NANO, topic, field, a, b)
            self.first = self.first or change
            total.first = total.first or change
            if isinstance(a, float) and isinstance(b, float) and abs(a - b) > total.max_difference:
                total.largest = change

    def _canonical(self, topic: str, data: bytes) -> bytes | None:
        """The message in protobuf's own encoding, so that bytes can be compared: there are several (refilled.py).

        None for the message of a program whose type of that name had other fields.
        """
        try:
            return self._kinds[topic].FromString(data).SerializeToString(deterministic=True)
        except DecodeError:
            return None


def differences(a: Any, b: Any, path: str = "") -> list[tuple[str, Any, Any]]:
    """(path, value in a, value in b) of every field that differs in any bit; None where a message lacks it."""
    if isinstance(a, Message) and isinstance(b, Message):
        names = {**vars(a), **vars(b)}
    elif isinstance(a, Proto) and isinstance(b, Proto):
        names = {**a.DESCRIPTOR.fields_by_name, **b.DESCRIPTOR.fields_by_name}
    elif isinstance(a, np.ndarray) and isinstance(b, np.ndarray) and a.shape == b.shape:
        if a.tobytes() == b.tobytes():
            return []
        values = zip(np.ndindex(a.shape), a.ravel().tolist(), b.ravel().tolist())
        return [(f"{path}{list(k)}", x, y) for k, x, y in values if repr(x) != repr(y)]
    elif _is_list(a) and _is_list(b) and len(a) == len(b):
        return _all(differences(x, y, f"{path}[{k}]") for k, (x, y) in enumerate(zip(a, b)))
    elif a is b or repr(a) == repr(b):
        return []
    else:
        return [(path, a, b)]
    prefix = f"{path}." if path else ""
    return _all(differences(getattr(a, name, None), getattr(b, name, None), prefix + name) for name in names)


def _all(parts: Iterable[list[tuple[str, Any, Any]]]) -> list[tuple[str, Any, Any]]:
    return list(itertools.chain.from_iterable(parts))


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def _of(topic: str, messages: list[tuple[str, bytes]]) -> Iterator[bytes]:
    return (data for name, data in messages if name == topic)


def _plain(value: Any) -> Any:
    """A value as JSON has it."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, bool | int | float) else _short(value)


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else " ".join(repr(value).split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."
