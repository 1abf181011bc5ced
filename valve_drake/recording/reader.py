"""The log's reader: MCAP files of every program; whole, unfinished, cut off and damaged ones through one path.

Opening a log reads it once from end to end and checks every CRC (contents.py). It does not stop at damage: what cannot
be read is listed in `damage`, one line each, and everything else can be read.
"""

import dataclasses as dc
import functools
import mmap
import os
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from google.protobuf.message import Message as Proto
from mcap.records import Attachment, Channel
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap_protobuf.decoder import DecoderFactory

from valve_drake.checks import ConfigError
from valve_drake.messages import Message
from valve_drake.recording import schemas
from valve_drake.recording.container import RECOVERED, active
from valve_drake.recording.contents import Contents
from valve_drake.recording.foxglove import NANO
from valve_drake.recording.records import HEAD, ROW, Buffer, Frame, attachment, attachment_to
from valve_drake.recording.tables import Table, table

LONGEST = 200  # a reason in an error line is cut to this [characters]

_Decoder: TypeAlias = tuple[type[Message] | None, Callable[[bytes], Proto]]  # the program's class, if it is one; parser
_OTHERS = {b"#ROSBAG": "a ROS 1 bag", b"SQLite format 3": "a ROS 2 bag", b"RRF": "a Rerun recording"}
_DATA = ROW.itemsize  # of a message, from the beginning of its record [bytes]


class Record(NamedTuple):
    """One message, not decoded."""

    topic: str
    when: int  # logged [ns]
    sequence: int  # counts the topic's messages from 0 in logs of this program
    data: bytes
    published: int | None = None  # [ns]; None: when it was logged
    channel: int = 0  # which of the topic's channels it came by: 0 unless it has several

    @property
    def time(self) -> float:
        return self.when / NANO


@dc.dataclass
class Topic:
    """What a log holds of one topic."""

    schema: str  # several names if its channels differ, "" if none is known
    count: int = 0
    start: float = 0.0  # the earliest message [s]
    end: float = 0.0  # the latest [s]


class LogReader:
    """Reads a log, whatever has happened to it and whoever wrote it.

    damage: what could not be read, in lines for people; empty for a whole log. losses: those of them that mean
    that something recorded is gone; a log that only breaks off has none, for all that was written is there.
    lost_messages: how many are gone; None if that cannot be known.
    library, profile: the writer's, from the header. own: this program wrote it, or the header is lost.
    topics: Topic by name. metadata: by name, then by key; the last of a name. all_metadata: all records.
    attachments: by name, the last of a name, loaded when asked for. start, end: of all messages [s].
    Raises ConfigError if the file is no MCAP log at all.
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self._data = _open(self.path)
        self._contents = Contents(self._data)
        self.damage, self.losses = self._contents.damage, self._contents.losses
        self.lost_messages = self._contents.lost_messages
        self.library, self.own = self._contents.library, self._contents.own
        self.profile = self._contents.header.profile if self._contents.header else ""
        self.schemas = self._contents.schemas
        self.all_metadata = self._contents.metadata
        self.metadata = {record.name: record.metadata for record in self.all_metadata}
        self.attachments: Mapping[str, Attachment] = _Attachments(self._data, self._contents.attachments)
        self._by_topic: dict[str, list[int]] = {}  # ids of its channels
        self._decoders: dict[int, _Decoder] = {}
        self.topics = self._collect_topics()
        filled = [topic for topic in self.topics.values() if topic.count > 0]
        self.start = min((topic.start for topic in filled), default=0.0)
        self.end = max((topic.end for topic in filled), default=0.0)

    @property
    def past_damage(self) -> str:
        """The damage of the logs that this one was recovered from; "" if there was none."""
        return self.metadata.get(RECOVERED, {}).get("damage", "")

    def channels(self, topic: str) -> list[Channel]:
        """A topic's channels, in the order of Record.channel."""
        return [self._contents.channels[id] for id in self._by_topic[topic]]

    def records(
        self, topics: Iterable[str] | None = None, start: float = -np.inf, end: float = np.inf
    ) -> Iterator[Record]:
        """The messages of `topics` (None: all) with start <= time <= end [s], in the order of the file."""
        names = self.topics.keys() if topics is None else set(topics)
        for name in names - self.topics.keys():
            raise ConfigError(f"{self.path} has no topic {name}")
        wanted = {id for name in names for id in self._by_topic[name]}
        return self._select(wanted, start, end)

    def instants(self, topics: Iterable[str], end: float = np.inf) -> Iterator[tuple[int, list[tuple[str, bytes]]]]:
        """The messages of `topics` with time <= end [s], as they follow each other: time [ns], and topic and bytes of
        each of that time."""
        wanted = {id for name in topics for id in self._by_topic[name]}
        when = -1
        found: list[tuple[str, bytes]] = []
        for content, rows in self._rows(wanted, -np.inf, end):
            for position, length, channel, _, at, _ in rows:
                if at != when:
                    if found:
                        yield when, found
                    when, found = at, []
                found.append((self._name_of[channel][0], content[position + _DATA : position + HEAD.size + length]))
        if found:
            yield when, found

    def messages(
        self, topics: Iterable[str] | None = None, start: float = -np.inf, end: float = np.inf
    ) -> Iterator[tuple[str, float, Message | Proto]]:
        """As `records`, decoded: topic, time [s], and a message of the program or a foxglove protobuf message."""
        return ((record.topic, record.time, self.decode(record)) for record in self.records(topics, start, end))

    def decode(self, record: Record) -> Message | Proto:
        """The message in a record of this log; ConfigError if this version of the program cannot hold it."""
        try:
            kind, parse = self._decoder(record)
            proto = parse(record.data)
            return proto if kind is None else schemas.from_proto(kind, proto)
        except Exception as error:  # a schema of another program can fail in any way while it is built or used
            raise self._foreign(record, error) from error

    def parse(self, record: Record) -> Proto:
        """As `decode`, but always protobuf's message: made in a tenth of the time."""
        try:
            return self._decoder(record)[1](record.data)
        except Exception as error:
            raise self._foreign(record, error) from error

    def table(self, records: Sequence[Record]) -> Table:
        """The numbers in records of one topic, of which there is at least one; ConfigError as for `decode`."""
        try:
            return table([record.data for record in records], self._decoder(records[0])[1])
        except Exception as error:
            raise self._foreign(records[0], error) from error

    def _foreign(self, record: Record, error: Exception) -> ConfigError:
        words = f"was not recorded by this version of the program: {str(error)[:LONGEST]}"
        return ConfigError(f"{self.path}: {record.topic} {words}")

    def series(self, topic: str, fields: Iterable[str]) -> dict[str, np.ndarray]:
        """One topic as arrays: "time" (N,) [s] and every field (N, ...); a dotted name reaches into nested messages.

        A field of repeated messages gives (N, n). None becomes NaN. Rows of different shapes make an array of objects.
        Raises ConfigError if the log has no such topic, AttributeError if its messages have no such field.
        """
        names = list(fields)
        times: list[float] = []
        columns: dict[str, list[Any]] = {name: [] for name in names}
        for _, time, message in self.messages([topic]):
            times.append(time)
            for name, column in columns.items():
                column.append(_reach(message, name.split(".")))
        return {"time": np.array(times)} | {name: _stack(column) for name, column in columns.items()}

    def timing(self, topics: Iterable[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """When each message of these topics was logged (n,) [ns] and its number (n,), in the order of the file."""
        wanted = {topic: self._by_topic[topic] for topic in topics}
        ids_wanted = {id for ids in wanted.values() for id in ids}
        whens: dict[int, list[np.ndarray]] = {}
        numbers: dict[int, list[np.ndarray]] = {}
        for block in self._contents.blocks:
            rows = self._contents.rows(block)[1]
            order = np.argsort(rows["channel"], kind="stable")
            channels, when, number = (rows[name][order] for name in ("channel", "when", "sequence"))
            starts = np.flatnonzero(np.diff(channels, prepend=channels[:1] ^ 1))
            for first, end in zip(starts, [*starts[1:], len(rows)]):
                if (id := int(channels[first])) in ids_wanted:
                    whens.setdefault(id, []).append(when[first:end])
                    numbers.setdefault(id, []).append(number[first:end])
        found = {topic: [id for id in ids if id in whens] for topic, ids in wanted.items()}
        return {
            topic: (
                np.concatenate([np.empty(0, np.uint64), *(part for id in ids for part in whens[id])]),
                np.concatenate([np.empty(0, np.uint32), *(part for id in ids for part in numbers[id])]),
            )
            for topic, ids in found.items()
        }

    def load_attachments(self) -> Iterator[Attachment]:
        """All attachments in the order of the file, one at a time."""
        return (attachment(self._data, record) for record in self._contents.attachments)

    def _collect_topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for channel in self._contents.channels.values():
            known = self.schemas.get(channel.schema_id)
            name = known.name if known else ""
            topic = topics.setdefault(channel.topic, Topic(name))
            self._by_topic.setdefault(channel.topic, []).append(channel.id)
            if name not in topic.schema.split(", "):
                topic.schema = f"{topic.schema}, {name}"
            if count := int(self._contents.counts[channel.id]):
                first, last = int(self._contents.first[channel.id]) / NANO, int(self._contents.last[channel.id]) / NANO
                topic.start = min(topic.start, first) if topic.count else first
                topic.end = max(topic.end, last) if topic.count else last
                topic.count += count
        return topics

    def _select(self, wanted: set[int], start: float, end: float) -> Iterator[Record]:
        for content, rows in self._rows(wanted, start, end):
            for position, length, channel, sequence, when, published in rows:
                topic, k = self._name_of[channel]
                yield Record(
                    topic, when, sequence, content[position + _DATA : position + HEAD.size + length], published, k
                )

    @functools.cached_property
    def _name_of(self) -> dict[int, tuple[str, int]]:
        """Of each channel its topic, and which one of the topic's it is."""
        return {id: (topic, k) for topic, ids in self._by_topic.items() for k, id in enumerate(ids)}

    def _rows(self, wanted: set[int], start: float, end: float) -> Iterator[tuple[Buffer, Iterator[tuple[int, ...]]]]:
        """Block by block its content, and of the wanted messages in it: position, length, channel, sequence, time and
        time of publishing [ns]."""
        for block in self._contents.blocks:
            if block.first / NANO > end or block.last / NANO < start or wanted.isdisjoint(block.channels):
                continue
            positions, rows = self._contents.rows(block)
            if not wanted >= block.channels:
                here = wanted & block.channels
                match = rows["channel"] == here.pop() if len(here) == 1 else np.isin(rows["channel"], list(here))
                positions, rows = positions[match], rows[match]
            content = self._contents.content(block)
            columns = (rows[name].tolist() for name in ("length", "channel", "sequence", "when", "published"))
            found: Iterator[tuple[int, ...]] = zip(positions.tolist(), *columns)
            if not start <= block.first / NANO or not block.last / NANO <= end:
                found = (row for row in found if start <= row[4] / NANO <= end)
            yield content, found

    def _decoder(self, record: Record) -> _Decoder:
        id = self._by_topic[record.topic][record.channel]
        if id not in self._decoders:
            channel = self._contents.channels[id]
            schema = self.schemas.get(channel.schema_id)
            parse = DecoderFactory().decoder_for(channel.message_encoding, schema)
            if parse is None or schema is None:
                raise ValueError(f"its messages are {channel.message_encoding!r}, not protobuf")
            self._decoders[id] = schemas.kind_named(schema.name), parse
        return self._decoders[id]


class _Attachments(Mapping[str, Attachment]):
    """A log's attachments by name, the last of a name; each is loaded when it is asked for."""

    def __init__(self, data: mmap.mmap, records: Sequence[Frame]):
        self._data = data
        self._records = {attachment_to(data, record, load=False)[0].name: record for record in records}

    def __getitem__(self, name: str) -> Attachment:
        return attachment(self._data, self._records[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._records)

    def __len__(self) -> int:
        return len(self._records)


def _open(path: Path) -> mmap.mmap:
    try:
        with open(path, "rb", opener=_without_waiting) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise ConfigError(f"log {path} is a device, pipe or socket, not a file")
            begin = file.read(64)
            if not begin:
                raise ConfigError(f"log {path} is empty")
            for magic, name in _OTHERS.items():
                if begin.startswith(magic):
                    raise ConfigError(f"{path} is {name}, not an MCAP log")
            agreeing = sum(a == b for a, b in zip(begin, MAGIC))
            if agreeing < min(len(begin), len(MAGIC) - 1):  # one damaged byte is still a log
                raise ConfigError(f"{path} is not an MCAP log")
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError:
        unfinished = active(path)
        hint = f"; its run is still under way or was killed: see {unfinished}" if unfinished.exists() else ""
        raise ConfigError(f"there is no log {path}{hint}") from None
    except OSError as error:
        raise ConfigError(f"log {path} cannot be read: {error.strerror}") from None


def _without_waiting(path: str, flags: int) -> int:
    """An opener that does not wait for somebody to write into a pipe."""
    return os.open(path, flags | os.O_NONBLOCK)


def _reach(value: Any, names: list[str]) -> Any:
    """value.name.name..., taken of every element where there is a sequence."""
    for k, name in enumerate(names):
        if isinstance(value, Sequence):
            return [_reach(element, names[k:]) for element in value]
        value = getattr(value, name)
    return value


def _stack(column: list[Any]) -> np.ndarray:
    """Values as one array (N, ...): None as NaN of the others' shape; objects when shapes differ."""
    try:
        shapes = {np.shape(value) for value in column if value is not None}
        alike = len(shapes) <= 1
    except ValueError:  # lists of lists of different lengths have no shape
        alike = False
    if not alike:
        rows = np.empty(len(column), object)
        for k, value in enumerate(column):
            rows[k] = value
        return rows
    filler = np.full(next(iter(shapes), ()), np.nan)
    return np.array([filler if value is None else value for value in column])
