"""The log's reader: whole, unfinished, cut off and damaged logs through one path.

Opening a log reads it once from end to end, checks every CRC and notes where each sound message is. It never gives
up: what cannot be read is named in `damage`, one line each, and everything else is there. Every record
proves its own end, so a damaged one costs only itself: reading goes on at the next that is sound.
"""

import collections
import dataclasses as dc
import mmap
import os
import re
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, Footer, Header, McapRecord, Metadata, Schema, Statistics
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap_protobuf.decoder import DecoderFactory

from valve_drake.checks import ConfigError
from valve_drake.messages import Message
from valve_drake.recording import schemas
from valve_drake.recording.container import CHUNK_SIZE, McapFile, active, open_active, publish
from valve_drake.recording.container import Chunk as NewChunk
from valve_drake.recording.foxglove import NANO
from valve_drake.recording.writer import LogError

_HEAD = struct.Struct("<BQ")  # opcode, length of the body
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_INDEX = struct.Struct("<HI")  # channel, size of the index
_FOOTER_SIZE = _HEAD.size + 20
_KINDS: dict[int, type[McapRecord]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
_BEGINNING = re.compile(rb"(?s)(?=[\x06\x09\x0c\x0f].{4}\x00{4})")  # perhaps a chunk, attachment, metadata, end of data
_OTHERS = {b"#ROSBAG": "a ROS 1 bag", b"SQLite format 3": "a ROS 2 bag", b"RRF": "a Rerun recording"}


class Record(NamedTuple):
    """One message as it stands in the file."""

    topic: str
    when: int  # [ns]
    sequence: int  # counts the topic's messages from 0
    data: bytes

    @property
    def time(self) -> float:
        return self.when / NANO


@dc.dataclass
class Topic:
    """What a log holds of one topic."""

    schema: str
    count: int = 0
    start: float = 0.0  # of the first message [s]
    end: float = 0.0  # of the last [s]


class _Row(NamedTuple):
    """A message within its chunk: where its bytes are."""

    start: int
    end: int
    when: int
    sequence: int


class _Chunk(NamedTuple):
    """A sound chunk: where it is, its span of time, its messages by channel."""

    offset: int
    start: int  # [ns]
    end: int
    rows: dict[int, list[_Row]]


class LogReader:
    """Reads a log, whatever has happened to it.

    damage: what could not be read, in lines for people; empty for a whole log.
    topics: Topic by name. metadata: by name, then by key. attachments: by name. start, end [s].
    Raises ConfigError if the file is no MCAP log at all.
    """

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self.damage: list[str] = []
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, Attachment] = {}
        self._data = _open(self.path)
        self._ended = False  # the file has its closing magic
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._statistics: Statistics | None = None
        self._chunks: list[_Chunk] = []
        self._decoders: dict[str, Callable[[bytes], Message | Proto]] = {}
        if self._data[: len(MAGIC)] != MAGIC:
            self.damage.append("the file's first bytes are damaged")
        self._read_data(self._read_summary())
        self.topics = self._collect_topics()
        filled = [topic for topic in self.topics.values() if topic.count > 0]
        self.start = min((topic.start for topic in filled), default=0.0)
        self.end = max((topic.end for topic in filled), default=0.0)

    def records(
        self, topics: Iterable[str] | None = None, start: float = -np.inf, end: float = np.inf
    ) -> Iterator[Record]:
        """The messages of `topics` (None: all) with start <= time <= end [s], in the order of the file."""
        names = self.topics.keys() if topics is None else set(topics)
        for name in names - self.topics.keys():
            raise ConfigError(f"{self.path} has no topic {name}")
        wanted = {channel.id for channel in self._channels.values() if channel.topic in names}
        return self._select(wanted, start, end)

    def messages(
        self, topics: Iterable[str] | None = None, start: float = -np.inf, end: float = np.inf
    ) -> Iterator[tuple[str, float, Message | Proto]]:
        """As `records`, decoded: topic, time [s], and a message of the program or a foxglove protobuf message."""
        return ((record.topic, record.time, self.decode(record)) for record in self.records(topics, start, end))

    def decode(self, record: Record) -> Message | Proto:
        """The message in a record of this log; ConfigError if this version of the program cannot hold it."""
        try:
            return self._decoder(record.topic)(record.data)
        except (DecodeError, TypeError, ValueError) as error:
            reason = f"{self.path}: {record.topic} was not recorded by this version of the program: {error}"
            raise ConfigError(reason) from error

    def series(self, topic: str, fields: Iterable[str]) -> dict[str, np.ndarray]:
        """One topic as arrays: "time" (N,) [s] and every field (N, ...); a dotted name reaches into nested messages.

        A field of repeated messages gives (N, n). None becomes NaN. Rows of different shapes make an array of objects.
        """
        names = list(fields)
        times: list[float] = []
        columns: dict[str, list] = {name: [] for name in names}
        for _, time, message in self.messages([topic]):
            times.append(time)
            for name, column in columns.items():
                column.append(_reach(message, name.split(".")))
        return {"time": np.array(times)} | {name: _stack(column) for name, column in columns.items()}

    def copy_to(self, file: IO[bytes]) -> None:
        """Writes all that could be read as a new MCAP file."""
        mcap, chunk = McapFile(file), NewChunk()
        for definition in (*self._schemas.values(), *self._channels.values()):
            chunk.define(definition)
        for part in self.attachments.values():
            mcap.add_attachment(part)
        ids = {channel.topic: channel.id for channel in self._channels.values()}
        for record in self.records():
            chunk.add(ids[record.topic], record.when, record.sequence, record.data)
            if chunk.size > CHUNK_SIZE:
                mcap.add_chunk(chunk)
                chunk = NewChunk()
        if chunk.index:
            mcap.add_chunk(chunk)
        count = sum(topic.count for topic in self.topics.values())
        recovered = {"messages": str(count), "damage": "; ".join(self.damage)}
        for name, facts in (self.metadata | {"recovered": recovered}).items():
            mcap.add_metadata(name, facts)
        mcap.finish()

    # ---- the file's records

    def _read_summary(self) -> int:
        """Definitions from the summary that a finished file ends with -> where the data section ends."""
        size = len(self._data)
        footer_at = size - len(MAGIC) - _FOOTER_SIZE
        self._ended = self._data[size - len(MAGIC) :] == MAGIC and footer_at >= len(MAGIC)
        if not self._ended:
            return size
        footer = Footer.read(ReadDataStream(BytesIO(self._data[footer_at + _HEAD.size : size])))
        if footer.summary_start == 0:
            return footer_at
        if footer.summary_crc not in (0, self._crc(footer.summary_start, size - len(MAGIC) - 4)):
            self.damage.append("the summary is damaged; the messages were read without it")
            return size
        position = footer.summary_start
        while position < footer_at:
            opcode, length = _HEAD.unpack_from(self._data, position)
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS):
                self._take(self._record(position)[0], position)
            position += _HEAD.size + length
        return footer.summary_start

    def _read_data(self, limit: int) -> None:
        """Takes all sound records before `limit` and says what is missing between them."""
        gaps: list[tuple[int, int]] = []  # sound chunks before, bytes
        position, complete = len(MAGIC), False
        while position < limit and not complete:
            try:
                record, after = self._record(position)
                self._take(record, position)
            except Exception:  # damaged bytes can fail in any way while they are parsed
                after = self._next_sound(position + 1, limit)
                gaps.append((len(self._chunks), after - position))
            else:
                complete = isinstance(record, DataEnd)
                if complete and not gaps and record.data_section_crc not in (0, self._crc(0, position)):
                    self.damage.append("bytes outside the messages are damaged: the CRC of the whole does not match")
            position = after
        if not self._ended and not complete and gaps and position == limit:
            gaps.pop()  # the torso of the last record
        for chunks, size in gaps:
            before = f"after t = {self._chunks[chunks - 1].end / NANO:.3f} s" if chunks > 0 else "at the beginning"
            after = ""
            if chunks < len(self._chunks):
                after = f", sound again from t = {self._chunks[chunks].start / NANO:.3f} s"
            self.damage.append(f"{size} bytes are damaged {before}{after}")
        if not self._ended:
            last = f"t = {self._chunks[-1].end / NANO:.3f} s" if self._chunks else "its beginning"
            self.damage.append(f"the log breaks off after {last}: killed, cut off or still being written")

    def _record(self, position: int) -> tuple[McapRecord | None, int]:
        """The record at `position` (None: an index, not needed), and where the next begins; raises if not sound."""
        opcode, length = _HEAD.unpack_from(self._data, position)
        start = position + _HEAD.size
        end = start + length
        if opcode == Opcode.MESSAGE_INDEX and length == _INDEX.size + _INDEX.unpack_from(self._data, start)[1]:
            return None, end
        if opcode not in _KINDS or end > len(self._data):
            raise ValueError("no record")
        stream = ReadDataStream(BytesIO(self._data[start:end]))
        record = _KINDS[opcode].read(stream)
        if stream.count != length:
            raise ValueError("a record's length does not match its content")
        stored = int.from_bytes(self._data[end - 4 : end], "little")
        if opcode == Opcode.ATTACHMENT and stored != self._crc(start, end - 4):
            raise ValueError("an attachment's CRC does not match")
        return record, end

    def _next_sound(self, position: int, limit: int) -> int:
        """Where the next record that can be proved sound begins; `limit` if there is none."""
        for found in _BEGINNING.finditer(self._data, position, limit):
            try:
                record, _ = self._record(found.start())
                if isinstance(record, Chunk):
                    _content(record)
            except Exception:  # no record, or a damaged one
                continue
            return found.start()
        return limit

    def _take(self, record: McapRecord | None, position: int) -> None:
        """Keeps what a sound record says."""
        match record:
            case Schema():
                self._schemas.setdefault(record.id, record)
            case Channel():
                self._channels.setdefault(record.id, record)
            case Chunk():
                rows = self._index(_content(record))
                times = [row.when for found in rows.values() for row in found]
                self._chunks.append(_Chunk(position, min(times, default=0), max(times, default=0), rows))
            case Attachment():
                self.attachments[record.name] = record
            case Metadata():
                self.metadata[record.name] = record.metadata
            case Statistics():
                self._statistics = record

    def _index(self, content: bytes) -> dict[int, list[_Row]]:
        """Where the messages of a chunk's content are; takes the definitions in it."""
        rows: dict[int, list[_Row]] = collections.defaultdict(list)
        position = 0
        while position < len(content):
            opcode, length = _HEAD.unpack_from(content, position)
            start = position + _HEAD.size
            position = start + length
            if opcode == Opcode.MESSAGE:
                channel, sequence, when, _ = _MESSAGE.unpack_from(content, start)
                rows[channel].append(_Row(start + _MESSAGE.size, position, when, sequence))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._take(_KINDS[opcode].read(ReadDataStream(BytesIO(content[start:position]))), start)
        return dict(rows)

    def _collect_topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        orphans = total = 0
        for channel in self._channels.values():
            schema = self._schemas.get(channel.schema_id)
            topics[channel.topic] = Topic(schema.name if schema else "")
        for chunk in self._chunks:
            for channel_id, rows in chunk.rows.items():
                total += len(rows)
                if channel_id not in self._channels:
                    orphans += len(rows)
                    continue
                topic = topics[self._channels[channel_id].topic]
                topic.start = topic.start if topic.count > 0 else rows[0].when / NANO
                topic.end = rows[-1].when / NANO
                topic.count += len(rows)
        if orphans > 0:
            self.damage.append(f"{orphans} messages cannot be read: their topics' definitions are lost")
        if self._statistics is not None and self._statistics.message_count != total:
            missing = self._statistics.message_count - total
            self.damage.append(f"{missing} of {self._statistics.message_count} messages are missing")
        return topics

    def _select(self, wanted: set[int], start: float, end: float) -> Iterator[Record]:
        for chunk in self._chunks:
            if chunk.start / NANO > end or chunk.end / NANO < start:
                continue
            found = sorted((row, channel) for channel in wanted & chunk.rows.keys() for row in chunk.rows[channel])
            if not found:
                continue
            content = _content(self._record(chunk.offset)[0])
            for row, channel in found:
                if start <= row.when / NANO <= end:
                    yield Record(self._channels[channel].topic, row.when, row.sequence, content[row.start : row.end])

    def _decoder(self, topic: str) -> Callable[[bytes], Message | Proto]:
        if topic not in self._decoders:
            channel = next(c for c in self._channels.values() if c.topic == topic)
            schema = self._schemas.get(channel.schema_id)
            parse = DecoderFactory().decoder_for(channel.message_encoding, schema)
            if parse is None:
                raise ValueError(f"its messages are {channel.message_encoding!r}, not protobuf")
            kind = schemas.kind_named(schema.name)
            self._decoders[topic] = parse if kind is None else lambda data: schemas.from_proto(kind, parse(data))
        return self._decoders[topic]

    def _crc(self, start: int, end: int) -> int:
        with memoryview(self._data) as view:
            return zlib.crc32(view[start:end])


def recover(source: str | os.PathLike, path: str | os.PathLike) -> LogReader:
    """Writes all that can be read of the log `source` to a new, sound log `path`; returns the reader of `source`.

    Metadata `recovered` of the new log tells the number of messages and the damage. Raises ConfigError if
    `source` is no log, LogError if the new one cannot be written.
    """
    log, path = LogReader(source), Path(path)
    if path.resolve() == log.path.resolve():
        raise ConfigError(f"{path} cannot be recovered onto itself")
    with open_active(path) as file:
        try:
            log.copy_to(file)
            publish(file, path)
        except OSError as error:
            raise LogError(f"{path} cannot be written: {error.strerror}") from error
    return log


def _open(path: Path) -> mmap.mmap:
    try:
        with open(path, "rb") as file:
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


def _content(chunk: Chunk) -> bytes:
    """A chunk's records, decompressed; raises unless its CRC matches."""
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    return stream.read(size)


def _reach(value: Any, names: list[str]) -> Any:
    """value.name.name..., taken of every element where there is a sequence."""
    for k, name in enumerate(names):
        if isinstance(value, Sequence):
            return [_reach(element, names[k:]) for element in value]
        value = getattr(value, name)
    return value


def _stack(column: list) -> np.ndarray:
    """Values as one array (N, ...): None as NaN of the others' shape; objects when shapes differ."""
    shapes = {np.shape(value) for value in column if value is not None}
    if len(shapes) > 1:
        rows = np.empty(len(column), object)
        rows[:] = column
        return rows
    filler = np.full(next(iter(shapes), ()), np.nan)
    return np.array([filler if value is None else value for value in column])
