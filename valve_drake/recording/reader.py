"""The log's reader: MCAP files of every program; whole, unfinished, cut off and damaged ones through one path.

Opening a log reads it once from end to end, checks every CRC and notes where each sound message is. It never gives
up: what cannot be read is named in `damage`, one line each, and everything else is there. Every record
proves its own end, so a damaged one costs only itself: reading goes on at the next that is sound.

The summary is not needed: it is held against what was read. Definitions of topics are taken from wherever they stand:
the data, the summary, or a chunk that is damaged (and `damage` says so). Messages without a definition are kept under
topics /unknown/channel_N.
"""

import dataclasses as dc
import mmap
import os
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Footer, Header, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap_protobuf.decoder import DecoderFactory

from valve_drake.checks import ConfigError
from valve_drake.messages import Message
from valve_drake.recording import records as mcap_records
from valve_drake.recording import schemas
from valve_drake.recording.container import LIBRARY, RECOVERED, active
from valve_drake.recording.foxglove import NANO
from valve_drake.recording.records import Buffer, Frame, Unsound

INDEX_LIMIT = 192 << 20  # kept in memory; raise it if logs of hours are read too slowly [bytes]
LONGEST = 200  # of a reason in an error line [characters]
DEFINITIONS_LIMIT = 64 << 20  # schemas and channels, in all [bytes]

_ALWAYS = frozenset((Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END))
_LOSSLESS = frozenset((Opcode.MESSAGE_INDEX, Opcode.STATISTICS, Opcode.DATA_END, Opcode.FOOTER, Opcode.CHUNK_INDEX))
_BEGINNING = re.compile(rb"(?s)(?=[\x06\x09\x0c\x0f].{4}\x00{4})")  # perhaps a chunk, attachment, metadata, end of data
_ANYTHING = re.compile(rb"(?s)(?=[\x03-\x0f].{4}\x00{4})")  # perhaps a record
_CHAIN = 3  # records one after the other that prove where a record without a CRC begins
_OTHERS = {b"#ROSBAG": "a ROS 1 bag", b"SQLite format 3": "a ROS 2 bag", b"RRF": "a Rerun recording"}
_DAMAGE = (ValueError, struct.error)  # what parsing damaged bytes raises


class Record(NamedTuple):
    """One message as it stands in the file."""

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


@dc.dataclass
class _Block:
    """Messages that lie together: those of a chunk, or a run of them outside of chunks."""

    chunk: mcap_records.ChunkAt | None
    start: int  # of the run, or where its records are in the file or in the unpacked chunk
    end: int
    channels: frozenset[int]
    first: int  # the earliest message [ns]
    last: int
    index: tuple[np.ndarray, np.ndarray] | None  # positions (n,), rows (n,); None: too many to be kept


@dc.dataclass
class _Gap:
    """Bytes that are no sound record."""

    blocks: int  # sound ones before it
    position: int
    size: int
    opcode: int | None  # of the record, where its end is known
    reason: str
    closed: bool  # the end of the data has been read before it


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
        self.damage: list[str] = []
        self.losses: list[str] = []
        self.lost_messages: int | None = 0
        self.all_metadata: list[Metadata] = []
        self._data = _open(self.path)
        self._size = len(self._data)
        self._header: Header | None = None
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._attachments: list[Frame] = []
        self._blocks: list[_Block] = []
        self._index_bytes = self._definition_bytes = 0
        self._by_topic: dict[str, list[int]] = {}  # ids of its channels
        self._decoders: dict[int, Callable[[bytes], Message | Proto]] = {}
        self._unpacked: tuple[int, Buffer] | None = None  # the chunk that was read last: where, content
        counts = np.zeros(1 << 16, np.int64)
        self._counts, self._next = counts, counts.copy()  # by channel: messages, highest number + 1
        self._first, self._last = np.full(1 << 16, np.iinfo(np.uint64).max, np.uint64), counts.astype(np.uint64)
        _Pass(self).run()
        self.attachments: Mapping[str, Attachment] = _Attachments(self)
        self.topics = self._collect_topics()
        filled = [topic for topic in self.topics.values() if topic.count > 0]
        self.start = min((topic.start for topic in filled), default=0.0)
        self.end = max((topic.end for topic in filled), default=0.0)

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        return {record.name: record.metadata for record in self.all_metadata}

    @property
    def library(self) -> str | None:
        return self._header.library if self._header else None

    @property
    def profile(self) -> str:
        return self._header.profile if self._header else ""

    @property
    def own(self) -> bool:
        return self.library in (None, LIBRARY)

    @property
    def past_damage(self) -> str:
        """The damage of the logs that this one was recovered from; "" if there was none."""
        return self.metadata.get(RECOVERED, {}).get("damage", "")

    @property
    def schemas(self) -> dict[int, Schema]:
        """By id."""
        return self._schemas

    def channels(self, topic: str) -> list[Channel]:
        """A topic's channels, in the order of Record.channel."""
        return [self._channels[id] for id in self._by_topic[topic]]

    def records(
        self, topics: Iterable[str] | None = None, start: float = -np.inf, end: float = np.inf
    ) -> Iterator[Record]:
        """The messages of `topics` (None: all) with start <= time <= end [s], in the order of the file."""
        names = self.topics.keys() if topics is None else set(topics)
        for name in names - self.topics.keys():
            raise ConfigError(f"{self.path} has no topic {name}")
        wanted = {id for name in names for id in self._by_topic[name]}
        return self._select(wanted, start, end)

    def messages(
        self, topics: Iterable[str] | None = None, start: float = -np.inf, end: float = np.inf
    ) -> Iterator[tuple[str, float, Message | Proto]]:
        """As `records`, decoded: topic, time [s], and a message of the program or a foxglove protobuf message."""
        return ((record.topic, record.time, self.decode(record)) for record in self.records(topics, start, end))

    def decode(self, record: Record) -> Message | Proto:
        """The message in a record of this log; ConfigError if this version of the program cannot hold it."""
        try:
            return self._decoder(record)(record.data)
        except (DecodeError, TypeError, ValueError, McapError, KeyError, AttributeError) as error:
            reason = (
                f"{self.path}: {record.topic} was not recorded by this version of the program: {str(error)[:LONGEST]}"
            )
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

    def timing(self, topics: Iterable[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """When each message of these topics was logged (n,) [ns] and its number (n,), in the order of the file."""
        wanted = {topic: self._by_topic[topic] for topic in topics}
        ids_wanted = {id for ids in wanted.values() for id in ids}
        whens: dict[int, list[np.ndarray]] = {}
        numbers: dict[int, list[np.ndarray]] = {}
        for block in self._blocks:
            rows = self._rows(block)[1]
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
        return (mcap_records.attachment(self._data, record) for record in self._attachments)

    # ---- what the pass over the file (_Pass) finds

    def _add_block(
        self, chunk: mcap_records.ChunkAt | None, content: Buffer, found: mcap_records.Scan, start: int
    ) -> None:
        rows = mcap_records.rows(content, found.positions)
        if len(rows) == 0:
            return
        channel, when = rows["channel"], rows["when"]
        np.add.at(self._counts, channel, 1)
        np.maximum.at(self._next, channel, rows["sequence"].astype(np.int64) + 1)
        np.minimum.at(self._first, channel, when)
        np.maximum.at(self._last, channel, when)
        index = (found.positions, rows)
        size = found.positions.nbytes + rows.nbytes
        keep = self._index_bytes + size <= INDEX_LIMIT
        self._index_bytes += size if keep else 0
        channels = frozenset(np.unique(channel).tolist())
        span = int(when.min()), int(when.max())
        self._blocks.append(_Block(chunk, start, found.end, channels, *span, index if keep else None))

    def _collect_topics(self) -> dict[str, Topic]:
        topics: dict[str, Topic] = {}
        for channel in self._channels.values():
            known = self._schemas.get(channel.schema_id)
            name = known.name if known else ""
            topic = topics.setdefault(channel.topic, Topic(name))
            self._by_topic.setdefault(channel.topic, []).append(channel.id)
            if name not in topic.schema.split(", "):
                topic.schema = f"{topic.schema}, {name}"
            if count := int(self._counts[channel.id]):
                first, last = int(self._first[channel.id]) / NANO, int(self._last[channel.id]) / NANO
                topic.start = min(topic.start, first) if topic.count else first
                topic.end = max(topic.end, last) if topic.count else last
                topic.count += count
        return topics

    # ---- messages

    def _rows(self, block: _Block) -> tuple[np.ndarray, np.ndarray]:
        """Where a block's messages are, and their heads."""
        if block.index is not None:
            return block.index
        content = self._content(block)
        found = mcap_records.scan(content, block.start, block.end, only_messages=block.chunk is None)
        return found.positions, mcap_records.rows(content, found.positions)

    def _content(self, block: _Block) -> Buffer:
        if block.chunk is None or not block.chunk.compression:
            return self._data
        if self._unpacked is None or self._unpacked[0] != block.chunk.start:
            self._unpacked = None  # never two at a time
            self._unpacked = block.chunk.start, mcap_records.unpacked(self._data, block.chunk)[0]
        return self._unpacked[1]

    def _select(self, wanted: set[int], start: float, end: float) -> Iterator[Record]:
        names = {id: (topic, k) for topic, ids in self._by_topic.items() for k, id in enumerate(ids)}
        bounded = start > -np.inf or end < np.inf
        for block in self._blocks:
            if block.first / NANO > end or block.last / NANO < start or wanted.isdisjoint(block.channels):
                continue
            positions, rows = self._rows(block)
            if not wanted >= block.channels:
                here = wanted & block.channels
                match = rows["channel"] == here.pop() if len(here) == 1 else np.isin(rows["channel"], list(here))
                positions, rows = positions[match], rows[match]
            content = self._content(block)
            columns = (rows[name].tolist() for name in ("length", "channel", "sequence", "when", "published"))
            for position, length, channel, sequence, when, published in zip(positions.tolist(), *columns):
                if bounded and not start <= when / NANO <= end:
                    continue
                data = content[position + _DATA : position + mcap_records.HEAD.size + length]
                topic, k = names[channel]
                yield Record(topic, when, sequence, data, published, k)

    def _decoder(self, record: Record) -> Callable[[bytes], Message | Proto]:
        id = self._by_topic[record.topic][record.channel]
        if id not in self._decoders:
            channel = self._channels[id]
            schema = self._schemas.get(channel.schema_id)
            parse = DecoderFactory().decoder_for(channel.message_encoding, schema)
            if parse is None or schema is None:
                raise ValueError(f"its messages are {channel.message_encoding!r}, not protobuf")
            kind = schemas.kind_named(schema.name)
            self._decoders[id] = parse if kind is None else lambda data: schemas.from_proto(kind, parse(data))
        return self._decoders[id]


_DATA = mcap_records.ROW.itemsize  # of a message, from the beginning of its record [bytes]


class _Attachments(Mapping[str, Attachment]):
    """A log's attachments by name, the last of a name; each is loaded when it is asked for."""

    def __init__(self, log: LogReader):
        self._log = log
        heads = (mcap_records.attachment_to(log._data, record, load=False)[0] for record in log._attachments)
        self._records = {head.name: record for head, record in zip(heads, log._attachments)}

    def __getitem__(self, name: str) -> Attachment:
        return mcap_records.attachment(self._log._data, self._records[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._records)

    def __len__(self) -> int:
        return len(self._records)


class _Pass:
    """The one pass over a file: fills a LogReader with what is sound and says what is not."""

    def __init__(self, log: LogReader):
        self.log, self.data, self.size = log, log._data, log._size
        self.gaps: list[_Gap] = []
        self.hurt_chunks: list[mcap_records.ChunkAt] = []
        self.in_hurt_chunks = 0  # messages, by the indexes behind those chunks
        self.counting = False  # the last chunk was damaged: its indexes follow
        self.data_end: int | None = None  # where the data ends and the summary begins
        self.data_matches = True  # with the CRC of the whole data
        self.summary: list[tuple[Frame, Schema | Channel]] = []
        self.statistics: Statistics | None = None
        self.footer: Footer | None = None
        self.footer_crc_at = 0
        self.end = 0  # of what was read
        self.loose = False  # messages stand outside of chunks
        self.closed = self.data[self.size - len(MAGIC) :] == MAGIC and self.size >= 2 * len(MAGIC)

    def run(self) -> None:
        if self.data[: len(MAGIC)] != MAGIC:
            self._say("the file's first bytes are damaged")
        self._walk(self.size - len(MAGIC) if self.closed else self.size)
        summary_is_sound = self._check_summary()
        self._define_missing(summary_is_sound)
        self._tell(summary_is_sound)

    # ---- records

    def _walk(self, limit: int) -> None:
        position = len(MAGIC)
        while position < limit and self.footer is None:
            record, reason = None, ""
            try:
                record = mcap_records.frame(self.data, position, limit)
                after = self._take(record, position, limit)
            except _DAMAGE as error:
                reason = error.reason if isinstance(error, Unsound) else ""
                framed = record is not None and record.opcode in _NAMES and self._follows(record.end, limit, 1)
                after = record.end if record is not None and framed else self._next_sound(position, limit)
                opcode = record.opcode if record is not None and framed else None
                self._add_gap(position, after, opcode, reason)
            position = after
        self.end = position

    def _add_gap(self, position: int, end: int, opcode: int | None, reason: str) -> None:
        before = self.gaps[-1] if self.gaps else None
        if before and before.position + before.size == position and not (before.reason or reason):
            before.size, before.opcode = end - before.position, None
        else:
            closed = self.data_end is not None
            self.gaps.append(_Gap(len(self.log._blocks), position, end - position, opcode, reason, closed))

    def _take(self, record: Frame, position: int, limit: int) -> int:
        """Keeps what a sound record says -> where the next begins."""
        log, opcode = self.log, record.opcode
        if opcode == Opcode.MESSAGE:
            return self._take_run(position, limit)
        if opcode == Opcode.MESSAGE_INDEX:
            _, size = _INDEX.unpack_from(self.data, record.start)
            if record.end - record.start < _INDEX.size + size:
                raise Unsound
            self._check_end(record, record.start + _INDEX.size + size, limit)
            self.in_hurt_chunks += size // 16 if self.counting else 0
            return record.end
        self.counting = False
        if opcode == Opcode.CHUNK:
            chunk = mcap_records.chunk_at(self.data, record)
            self._check_end(record, chunk.end, limit)
            self._take_chunk(chunk)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definition, used = mcap_records.parse_to(self.data, record)
            self._check_end(record, used, limit)
            assert isinstance(definition, Schema | Channel)
            if self.data_end is None:
                self._define(record, definition)
            else:
                self.summary.append((record, definition))
        elif opcode == Opcode.ATTACHMENT:
            _, used = mcap_records.attachment_to(self.data, record, load=False)
            self._check_end(record, used, limit)
            log._attachments.append(record)
        elif opcode in _NAMES:
            self._take_other(record, position, limit)
        elif log.library == LIBRARY or not self._follows(record.end, limit, 1):
            raise Unsound  # a private record is skipped, but this program writes none
        return record.end

    def _check_end(self, record: Frame, used: int, limit: int) -> None:
        """Bytes behind a record's fields may be there, unless they are of a record whose length is damaged."""
        if used != record.end and (self.log.library == LIBRARY or not self._follows(record.end, limit, 1)):
            raise Unsound

    def _take_other(self, record: Frame, position: int, limit: int) -> None:
        if record.opcode not in _PARSED:
            return
        parsed, used = mcap_records.parse_to(self.data, record)
        self._check_end(record, used, limit)
        match parsed:
            case Header() as header:
                self.log._header = self.log._header or header
            case Metadata() as metadata:
                self.log.all_metadata.append(metadata)
            case Statistics() as statistics:
                self.statistics = statistics
            case DataEnd() as end:
                for earlier in self.summary:  # the one before was no end
                    self._define(*earlier)
                self.data_end, self.summary, self.statistics = record.end, [], None
                self.data_matches = end.data_section_crc in (0, mcap_records.crc(self.data, 0, position))
            case Footer() as footer:
                rest = self.data[record.end : record.end + len(MAGIC)]
                if rest != MAGIC and len(rest) == len(MAGIC) and record.end + len(MAGIC) != self.size:
                    raise Unsound
                self.footer, self.footer_crc_at = footer, record.start + 16

    def _take_chunk(self, chunk: mcap_records.ChunkAt) -> None:
        try:
            content, start, end = mcap_records.unpacked(self.data, chunk)
        except Unsound:
            self.hurt_chunks.append(chunk)
            self.counting = True
            raise
        found = mcap_records.scan(content, start, end)
        for definition in found.definitions:
            parsed = mcap_records.parse(content, definition)
            assert isinstance(parsed, Schema | Channel)
            self._define(definition, parsed)
        self.log._add_block(chunk, content, found, start)
        if found.end != end:
            raise Unsound(f"a chunk holds {end - found.end} bytes that are no records")

    def _take_run(self, position: int, limit: int) -> int:
        """Messages outside of chunks, up to the next record of another kind."""
        found = mcap_records.scan(self.data, position, limit, only_messages=True)
        if len(found.positions) == 0:
            raise Unsound
        self.loose = True
        if not self._follows(found.end, limit, 1):  # the last one's length may be what is damaged
            last = int(found.positions[-1])
            better = min(self._next_sound(last, limit), found.end)
            if better < found.end or self._torn(found.end):
                if last == position:
                    raise Unsound
                self.log._add_block(None, self.data, found._replace(positions=found.positions[:-1], end=last), position)
                self._add_gap(last, better, None, "")
                return better
        self.log._add_block(None, self.data, found, position)
        return found.end

    def _torn(self, end: int) -> bool:
        """Whether zeros lie across the end of a record: a disk that lost power had only a part of it."""
        return not any(self.data[end - 4 : end + 4])

    def _define(self, record: Frame, definition: Schema | Channel) -> None:
        """Takes a definition unless one of its id is known."""
        log = self.log
        if definition.id in (log._schemas if isinstance(definition, Schema) else log._channels):
            return
        log._definition_bytes += record.end - record.start
        if log._definition_bytes > DEFINITIONS_LIMIT:
            raise Unsound(f"schemas and channels take more than {DEFINITIONS_LIMIT} bytes: the rest is not read")
        if isinstance(definition, Schema):
            log._schemas[definition.id] = definition
        else:
            log._channels[definition.id] = definition

    # ---- where a sound record begins

    def _follows(self, position: int, limit: int, count: int) -> bool:
        """Whether so many records begin here, one after the other, or the file ends; none of a private kind if many."""
        for _ in range(count):
            if position == limit:
                return True
            try:
                record = mcap_records.frame(self.data, position, limit)
            except Unsound:
                return False
            known = record.opcode in _NAMES or (count == 1 and self.log.library != LIBRARY)
            if not known or (record.opcode == Opcode.MESSAGE and record.end - record.start < mcap_records.LEAST):
                return False
            position = record.end
        return True

    def _next_sound(self, damaged: int, limit: int) -> int:
        """Where the next record that can be proved sound begins; `limit` if there is none.

        Records that have no CRC count only in files whose messages stand outside of chunks: elsewhere
        they may be the inside of a damaged chunk.
        """
        chunked = bool(self.log._blocks or self.hurt_chunks) or self.data[damaged] == Opcode.CHUNK
        loose = self.loose or not chunked
        for found in (_ANYTHING if loose else _BEGINNING).finditer(self.data, damaged + 1, limit):
            position = found.start()
            try:
                record = mcap_records.frame(self.data, position, limit)
                if record.opcode == Opcode.CHUNK:
                    mcap_records.unpacked(self.data, mcap_records.chunk_at(self.data, record))
                elif record.opcode == Opcode.ATTACHMENT:
                    mcap_records.attachment_to(self.data, record, load=False)
                elif record.opcode == Opcode.DATA_END and record.end - record.start != 4:
                    continue
                elif record.opcode in _ALWAYS:
                    mcap_records.parse(self.data, record)
                elif not self._follows(position, limit, _CHAIN):
                    continue
            except _DAMAGE:
                continue
            return position
        return limit

    # ---- the summary, and definitions that the data lacks

    def _check_summary(self) -> bool:
        """Whether the summary agrees with its CRC and lies where the footer says."""
        if self.footer is None:
            return False
        start, stored = self.footer.summary_start, self.footer.summary_crc
        if start == 0:
            return not self.summary and self.statistics is None
        if not len(MAGIC) <= start <= self.footer_crc_at or self.data_end not in (None, start):
            return False
        return stored in (0, mcap_records.crc(self.data, start, self.footer_crc_at))

    def _define_missing(self, summary_is_sound: bool) -> None:
        log = self.log
        if summary_is_sound:
            for record, definition in self.summary:
                self._define(record, definition)
        else:
            self.statistics = None
        written = set(np.flatnonzero(log._counts).tolist())
        doubtful = 0
        if written - log._channels.keys() or self._schemas_missing():
            offered = [definition for _, definition in self.summary] + list(self._salvaged())
            doubtful = self._use(offered, written)
        orphans = sorted(written - log._channels.keys())
        for id in orphans:
            log._channels[id] = Channel(id, f"/unknown/channel_{id}", "", {}, 0)
        if doubtful:
            self._say(f"the definitions of {doubtful} topics come from damaged bytes", lost=True)
        if orphans:
            count = int(log._counts[orphans].sum())
            words = f"{count} messages have lost their topics' definitions: they are kept as {_names(orphans)}"
            self._say(words, lost=True)

    def _schemas_missing(self) -> set[int]:
        log = self.log
        return {channel.schema_id for channel in log._channels.values()} - log._schemas.keys() - {0}

    def _salvaged(self) -> Iterator[Schema | Channel]:
        """Definitions in damaged chunks."""
        for chunk in self.hurt_chunks:
            content = mcap_records.salvaged(self.data, chunk)
            for record in mcap_records.scan(content, 0, len(content)).definitions:
                try:
                    definition = mcap_records.parse(content, record)
                except _DAMAGE:
                    continue
                assert isinstance(definition, Schema | Channel)
                yield definition

    def _use(self, offered: Sequence[Schema | Channel], written: set[int]) -> int:
        """Takes doubtful definitions of what would else have none -> channels that they define."""
        log, doubtful = self.log, 0
        for channel in (one for one in offered if isinstance(one, Channel)):
            if channel.id in written and channel.id not in log._channels and channel.topic.isprintable():
                log._channels[channel.id] = channel
                doubtful += 1
        missing = self._schemas_missing()
        for schema in (one for one in offered if isinstance(one, Schema)):
            if schema.id in missing and schema.id not in log._schemas:
                own = schemas.known(schema.name)
                log._schemas[schema.id] = schema if own is None else dc.replace(schema, data=own)
        return doubtful

    # ---- what is told

    def _say(self, line: str, lost: bool = False) -> None:
        self.log.damage.append(line)
        if lost:
            self.log.losses.append(line)

    def _tell(self, summary_is_sound: bool) -> None:
        cut = self.footer is None and not self.closed
        if cut and self.gaps and self.gaps[-1].position + self.gaps[-1].size == self.end:
            self.gaps.pop()  # the truncated last record
        missing = self._missing()
        lossy = False
        for gap in self.gaps:
            behind = gap.closed and self.data_matches
            lost = not behind and not (missing == 0 and gap.opcode in _LOSSLESS)
            lossy = lossy or lost
            self._say(self._where(gap), lost)
        if self.footer is not None:
            self._tell_the_end(summary_is_sound)
        elif self.closed:
            self._say("the summary is damaged; the messages were read without it")
        self._tell_missing(missing, lossy)
        if not self.data_matches and not self.gaps:
            outside = "a message outside of chunks" if self.loose else "bytes outside the messages"
            verb = "may be" if self.loose else "are"
            self._say(f"{outside} {verb} damaged: the CRC of the whole does not match")
        if cut:
            blocks = self.log._blocks
            last = f"t = {blocks[-1].last / NANO:.3f} s" if blocks else "its beginning"
            self._say(f"the log breaks off after {last}: killed, cut off or still being written")

    def _tell_the_end(self, summary_is_sound: bool) -> None:
        if not summary_is_sound:
            self._say("the summary is damaged; the messages were read without it")
        rest = self.data[self.end : self.end + len(MAGIC)]
        if rest != MAGIC:
            self._say("the file's last bytes are damaged")
        elif self.size > self.end + len(MAGIC):
            self._say(f"{self.size - self.end - len(MAGIC)} bytes behind the log's end are not read", lost=True)

    def _where(self, gap: _Gap) -> str:
        blocks = self.log._blocks
        before = f"after t = {blocks[gap.blocks - 1].last / NANO:.3f} s" if gap.blocks > 0 else "at the beginning"
        after = f", sound again from t = {blocks[gap.blocks].first / NANO:.3f} s" if gap.blocks < len(blocks) else ""
        if gap.reason:
            return f"{gap.reason} ({gap.size} bytes {before}{after})"
        return f"{gap.size} bytes are damaged {before}{after}"

    def _missing(self) -> int | None:
        """How many messages are gone: by the summary, else by this program's numbering, else by the indexes."""
        log = self.log
        if self.statistics is not None:
            return max(self.statistics.message_count - int(log._counts.sum()), 0)
        holes = int((log._next - log._counts).clip(0).sum()) if log.own else None
        return max(holes or 0, self.in_hurt_chunks) or holes

    def _tell_missing(self, missing: int | None, lossy: bool) -> None:
        total = int(self.log._counts.sum())
        self.log.lost_messages = 0 if missing is None and not lossy else missing
        if self.statistics is not None and total > self.statistics.message_count:
            self._say(f"the summary counts {self.statistics.message_count} messages, the log holds {total}")
        elif self.statistics is not None and missing:
            self._say(f"{missing} of {total + missing} messages are missing", lost=True)
        elif missing:
            self._say(f"{missing} messages are missing between others", lost=True)


_INDEX = struct.Struct("<HI")  # channel, size of the index
_NAMES = frozenset(int(opcode) for opcode in Opcode)
_PARSED = frozenset((Opcode.HEADER, Opcode.METADATA, Opcode.STATISTICS, Opcode.DATA_END, Opcode.FOOTER))


def _names(ids: Sequence[int]) -> str:
    """The topics of channels without a definition, for people."""
    return f"/unknown/channel_{ids[0]}" if len(ids) == 1 else f"/unknown/channel_{ids[0]} to _{ids[-1]}"


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
