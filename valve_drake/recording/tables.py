"""Messages that differ in numbers only as one array, which is read in a twentieth of the time of its messages.

The first message makes a template (refilled.py). Messages whose bytes fit it are read all at once; others, of another
program or of changing fields, one by one.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message as Proto

from valve_drake.recording.refilled import STAMP, Refilled, slot

BATCH = 1024  # messages that are copied together; raise it if a table is made too slowly [messages]


class Table(NamedTuple):
    """All numbers of protobuf type double of some messages.

    columns: of each number, by its path. An element of a repeated field is called by its field `name` if it has one,
    else by its number: "joints.waist.position", "values.3". They are those of the first message.
    values: (n, columns). gaps: paths that some messages do not have; they are NaN there.
    """

    columns: dict[str, int]
    values: np.ndarray
    gaps: frozenset[str] = frozenset()


def table(messages: Sequence[bytes], parse: Callable[[bytes], Proto]) -> Table:
    """The numbers of messages of one type, of which there is at least one."""
    form = parse(messages[0])
    numbers = list(_numbers(form))
    columns = {number.path: k for k, number in enumerate(numbers)}
    if len(columns) == len(numbers):  # else two elements have one name
        for k, number in enumerate(numbers):
            number.put(slot(k))
        _stamp(form)
        template = Refilled(form, len(numbers))
        parts = []
        for start in range(0, len(messages), BATCH):
            part = template.read(messages[start : start + BATCH])
            if part is None:
                break
            parts.append(part)
        else:
            return Table(columns, np.concatenate(parts))
    return _one_by_one(messages, parse, {path: k for k, path in enumerate(columns)})


def _one_by_one(messages: Sequence[bytes], parse: Callable[[bytes], Proto], columns: dict[str, int]) -> Table:
    values = np.full((len(messages), len(columns)), np.nan)
    gaps: set[str] = set()
    for row, data in zip(values, messages):
        found = {number.path: number.value for number in _numbers(parse(data))}
        gaps |= columns.keys() - found.keys()
        for path in columns.keys() & found.keys():
            row[columns[path]] = found[path]
    return Table(columns, values, frozenset(gaps))


class _Number(NamedTuple):
    """A double in a message."""

    path: str
    owner: Any  # the message, or the repeated field
    key: str | int

    @property
    def value(self) -> float:
        return getattr(self.owner, self.key) if isinstance(self.key, str) else self.owner[self.key]

    def put(self, value: float) -> None:
        if isinstance(self.key, str):
            setattr(self.owner, self.key, value)
        else:
            self.owner[self.key] = value


def _numbers(message: Proto, prefix: str = "") -> Iterator[_Number]:
    """Every double of a message but for the optional ones that are not there."""
    for field in message.DESCRIPTOR.fields:
        path, value = prefix + field.name, getattr(message, field.name)
        repeated = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        if field.type == FieldDescriptor.TYPE_DOUBLE:
            if repeated:
                yield from (_Number(f"{path}.{k}", value, k) for k in range(len(value)))
            elif not field.has_presence or message.HasField(field.name):
                yield _Number(path, message, field.name)
        elif field.type == FieldDescriptor.TYPE_MESSAGE:
            if repeated:
                for k, element in enumerate(value):
                    yield from _numbers(element, f"{path}.{getattr(element, 'name', '') or k}.")
            elif isinstance(value, Proto) and message.HasField(field.name):
                yield from _numbers(value, f"{path}.")


def _stamp(message: Proto) -> None:
    """Puts the template's time wherever a message has one."""
    for field, value in message.ListFields():
        if field.type != FieldDescriptor.TYPE_MESSAGE:
            continue
        for part in value if isinstance(value, Sequence) else (value,):
            if not isinstance(part, Proto):  # a map
                continue
            if part.DESCRIPTOR.full_name == STAMP.DESCRIPTOR.full_name:
                part.MergeFromString(STAMP.SerializeToString())
            else:
                _stamp(part)
