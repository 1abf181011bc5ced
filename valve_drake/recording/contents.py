"""What an MCAP file holds, found in one pass from end to end: where each sound message is, and what is not sound.

The end of every record can be checked, so a damaged one costs only itself: reading goes on at the next sound record.
The summary is not needed; it is compared with what was read. Definitions of topics are taken from wherever they stand:
the data, the summary, or a chunk that is damaged (and `damage` says so). Messages without a definition are kept under
topics /unknown/channel_N.
"""

import dataclasses as dc
import re
import struct
from collections.abc import Iterator, Sequence

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Header, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC as MAGIC

from valve_drake.recording.container import LIBRARY
from valve_drake.recording.foxglove import NANO
from valve_drake.recording.records import (
    HEAD,
    LEAST,
    Buffer,
    ChunkAt,
    Frame,
    Scan,
    Unsound,
    attachment_to,
    chunk_at,
    crc,
    frame,
    parse,
    parse_to,
    rows,
    salvaged,
    scan,
    unpacked,
)
from valve_drake.recording.schemas import known

INDEX_LIMIT = 192 << 20  # kept in memory; raise it if logs of hours are read too slowly [bytes]
DEFINITIONS_LIMIT = 64 << 20  # schemas and channels, in all [bytes]
LARGEST = 1 << 32  # size of a record, at most; a truncated one that claims more is damaged [bytes]

_ALWAYS = frozenset((Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA, Opcode.DATA_END))
_LOSSLESS = frozenset((Opcode.MESSAGE_INDEX, Opcode.STATISTICS, Opcode.DATA_END, Opcode.FOOTER, Opcode.CHUNK_INDEX))
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
_PARSED = frozenset((Opcode.HEADER, Opcode.METADATA, Opcode.STATISTICS, Opcode.DATA_END, Opcode.FOOTER))
_BEGINNING = re.compile(rb"(?s)(?=[\x06\x09\x0c\x0f].{4}\x00{4})")  # perhaps a chunk, attachment, metadata, end of data
_ANYTHING = re.compile(rb"(?s)(?=[\x03-\x0f].{4}\x00{4})")  # perhaps a record
_CHAIN = 3  # consecutive sound records that confirm the beginning of a record without a CRC
_INDEX = struct.Struct("<HI")  # channel, size of the index
_DAMAGE = (ValueError, struct.error)  # what parsing damaged bytes raises


@dc.dataclass
class Block:
    """Messages that lie together: those of a chunk, or a run of them outside of chunks."""

    chunk: ChunkAt | None
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
    closed: bool  # a DataEnd record was read before it


class Contents:
    """What an MCAP file holds.

    header: None if it is damaged. schemas, channels: by id. attachments: where they are. metadata: all of them.
    blocks: where the messages are, in the order of the file. counts, first, last: of each channel's messages, by id
    (65536,), how many, the earliest and the latest [ns].
    damage, losses, lost_messages: as in LogReader.
    """

    def __init__(self, data: Buffer):
        self.header: Header | None = None
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.attachments: list[Frame] = []
        self.metadata: list[Metadata] = []
        self.blocks: list[Block] = []
        self.counts = np.zeros(1 << 16, np.int64)
        self.first = np.full(1 << 16, np.iinfo(np.uint64).max, np.uint64)
        self.last = np.zeros(1 << 16, np.uint64)
        self.damage: list[str] = []
        self.losses: list[str] = []
        self.lost_messages: int | None = 0

        self._data, self._size = data, len(data)
        self._next = np.zeros(1 << 16, np.int64)  # by channel: highest number of a message, plus 1
        self._index_bytes = self._definition_bytes = 0
        self._defined: set[bytes] = set()  # definitions in chunks, each as its whole record
        self._unpacked: tuple[int, Buffer] | None = None  # the chunk that was read last: where, content
        self._gaps: list[_Gap] = []
        self._damaged_chunks: list[ChunkAt] = []
        self._in_damaged_chunks = 0  # messages, by the indexes behind those chunks
        self._counting = False  # the last chunk was damaged: its indexes follow
        self._data_end: int | None = None  # where the data ends and the summary begins
        self._data_matches = True  # with the CRC of the whole data
        self._summary: list[tuple[Frame, Schema | Channel]] = []
        self._statistics: Statistics | None = None
        self._footer: Footer | None = None
        self._footer_crc_at = 0
        self._end = 0  # of what was read
        self._loose = False  # messages stand outside of chunks
        self._closed = data[-len(MAGIC) :] == MAGIC and self._size >= 2 * len(MAGIC)  # the file ends as it should

        if data[: len(MAGIC)] != MAGIC:
            self._say("the file's first bytes are damaged")
        self._walk(self._size - len(MAGIC) if self._closed else self._size)
        summary_is_sound = self._check_summary()
        self._define_missing(summary_is_sound)
        self._tell(summary_is_sound)

    @property
    def library(self) -> str | None:
        return self.header.library if self.header else None

    @property
    def own(self) -> bool:
        """This program wrote the file, or the header is lost."""
        return self.library in (None, LIBRARY)

    def rows(self, block: Block) -> tuple[np.ndarray, np.ndarray]:
        """Where a block's messages are (n,) in its `content`, and their heads (n,) of records.ROW."""
        if block.index is not None:
            return block.index
        content = self.content(block)
        found = scan(content, block.start, block.end, only_messages=block.chunk is None)
        return found.positions, rows(content, found.positions)

    def content(self, block: Block) -> Buffer:
        """What a block's positions count in: the file, or the unpacked chunk."""
        if block.chunk is None or not block.chunk.compression:
            return self._data
        if self._unpacked is None or self._unpacked[0] != block.chunk.start:
            self._unpacked = None  # never two at a time
            self._unpacked = block.chunk.start, unpacked(self._data, block.chunk)[0]
        return self._unpacked[1]

    # ---- records

    def _walk(self, limit: int) -> None:
        position = len(MAGIC)
        while position < limit and self._footer is None:
            record, reason = None, ""
            try:
                record = frame(self._data, position, limit)
                after = self._take(record, position, limit)
            except _DAMAGE as error:
                reason = error.reason if isinstance(error, Unsound) else ""
                framed = record is not None and record.opcode in _KNOWN and self._follows(record.end, limit, 1)
                after = record.end if record is not None and framed else self._next_sound(position, limit)
                opcode = record.opcode if record is not None and framed else None
                self._add_gap(position, after, opcode, reason)
            position = after
        self._end = position

    def _add_gap(self, position: int, end: int, opcode: int | None, reason: str) -> None:
        before = self._gaps[-1] if self._gaps else None
        if before and before.position + before.size == position and not (before.reason or reason):
            before.size, before.opcode = end - before.position, None
        else:
            closed = self._data_end is not None
            self._gaps.append(_Gap(len(self.blocks), position, end - position, opcode, reason, closed))

    def _take(self, record: Frame, position: int, limit: int) -> int:
        """Keeps what a sound record says -> where the next begins."""
        opcode = record.opcode
        if opcode == Opcode.MESSAGE:
            return self._take_run(position, limit)
        if opcode == Opcode.MESSAGE_INDEX:
            _, size = _INDEX.unpack_from(self._data, record.start)
            if record.end - record.start < _INDEX.size + size:
                raise Unsound
            self._check_end(record, record.start + _INDEX.size + size, limit)
            self._in_damaged_chunks += size // 16 if self._counting else 0
            return record.end
        self._counting = False
        if opcode == Opcode.CHUNK:
            chunk = chunk_at(self._data, record)
            self._check_end(record, chunk.end, limit)
            self._take_chunk(chunk)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definition, used = parse_to(self._data, record)
            self._check_end(record, used, limit)
            assert isinstance(definition, Schema | Channel)
            if self._data_end is None:
                self._define(record, definition)
            else:
                self._summary.append((record, definition))
        elif opcode == Opcode.ATTACHMENT:
            _, used = attachment_to(self._data, record, load=False)
            self._check_end(record, used, limit)
            self.attachments.append(record)
        elif opcode in _KNOWN:
            self._take_other(record, position, limit)
        elif self.library == LIBRARY or not self._follows(record.end, limit, 1):
            raise Unsound  # other programs' private records are skipped; this program writes none, so it is damage
        return record.end

    def _check_end(self, record: Frame, used: int, limit: int) -> None:
        """Bytes behind a record's fields may be there, unless they are of a record whose length is damaged."""
        if used != record.end and (self.library == LIBRARY or not self._follows(record.end, limit, 1)):
            raise Unsound

    def _take_other(self, record: Frame, position: int, limit: int) -> None:
        if record.opcode not in _PARSED:
            return
        parsed, used = parse_to(self._data, record)
        self._check_end(record, used, limit)
        match parsed:
            case Header() as header:
                self.header = self.header or header
            case Metadata() as metadata:
                self.metadata.append(metadata)
            case Statistics() as statistics:
                self._statistics = statistics
            case DataEnd() as end:
                for earlier in self._summary:  # the one before was no end
                    self._define(*earlier)
                self._data_end, self._summary, self._statistics = record.end, [], None
                self._data_matches = end.data_section_crc in (0, crc(self._data, 0, position))
            case Footer() as footer:
                rest = self._data[record.end : record.end + len(MAGIC)]
                if rest != MAGIC and len(rest) == len(MAGIC) and record.end + len(MAGIC) != self._size:
                    raise Unsound
                self._footer, self._footer_crc_at = footer, record.start + 16

    def _take_chunk(self, chunk: ChunkAt) -> None:
        try:
            content, start, end = unpacked(self._data, chunk)
        except Unsound:
            self._damaged_chunks.append(chunk)
            self._counting = True
            raise
        found = scan(content, start, end)
        for definition in found.definitions:
            record = content[definition.start - HEAD.size : definition.end]
            if record in self._defined:  # every chunk repeats them
                continue
            parsed = parse(content, definition)
            assert isinstance(parsed, Schema | Channel)
            self._define(definition, parsed)
            self._defined.add(record)
        self._add_block(chunk, content, found, start)
        if found.end != end:
            raise Unsound(f"a chunk holds {end - found.end} bytes that are no records")

    def _take_run(self, position: int, limit: int) -> int:
        """Messages outside of chunks, up to the next record of another kind."""
        found = scan(self._data, position, limit, only_messages=True)
        if len(found.positions) == 0:
            raise Unsound
        self._loose = True
        if not self._follows(found.end, limit, 1):  # the last one's length may be what is damaged
            last = int(found.positions[-1])
            better = min(self._next_sound(last, limit), found.end)
            if better < found.end or self._torn(found.end):
                if last == position:
                    raise Unsound
                self._add_block(None, self._data, found._replace(positions=found.positions[:-1], end=last), position)
                self._add_gap(last, better, None, "")
                return better
        self._add_block(None, self._data, found, position)
        return found.end

    def _torn(self, end: int) -> bool:
        """Whether zeros lie across the end of a record: a disk that lost power had only a part of it."""
        return not any(self._data[end - 1 : end + 8])

    def _define(self, record: Frame, definition: Schema | Channel) -> None:
        """Takes a definition unless one of its id is known."""
        if definition.id in (self.schemas if isinstance(definition, Schema) else self.channels):
            return
        self._definition_bytes += record.end - record.start
        if self._definition_bytes > DEFINITIONS_LIMIT:
            raise Unsound(f"schemas and channels take more than {DEFINITIONS_LIMIT} bytes: the rest is not read")
        if isinstance(definition, Schema):
            self.schemas[definition.id] = definition
        else:
            self.channels[definition.id] = definition

    def _add_block(self, chunk: ChunkAt | None, content: Buffer, found: Scan, start: int) -> None:
        heads = rows(content, found.positions)
        if len(heads) == 0:
            return
        channel, when = heads["channel"], heads["when"]
        np.add.at(self.counts, channel, 1)
        np.maximum.at(self._next, channel, heads["sequence"].astype(np.int64) + 1)
        np.minimum.at(self.first, channel, when)
        np.maximum.at(self.last, channel, when)
        index = (found.positions, heads)
        size = found.positions.nbytes + heads.nbytes
        keep = self._index_bytes + size <= INDEX_LIMIT
        self._index_bytes += size if keep else 0
        channels = frozenset(np.unique(channel).tolist())
        span = int(when.min()), int(when.max())
        self.blocks.append(Block(chunk, start, found.end, channels, *span, index if keep else None))

    # ---- where a sound record begins

    def _follows(self, position: int, limit: int, count: int) -> bool:
        """Whether so many records begin here, one after the other, or the file ends; none of a private kind if many."""
        for _ in range(count):
            if position == limit:
                return True
            try:
                record = frame(self._data, position, limit)
            except Unsound:
                return False
            known = record.opcode in _KNOWN or (count == 1 and self.library != LIBRARY)
            if not known or (record.opcode == Opcode.MESSAGE and record.end - record.start < LEAST):
                return False
            position = record.end
        return True

    def _next_sound(self, damaged: int, limit: int) -> int:
        """Where the next record that can be proved sound begins; `limit` if there is none.

        Records that have no CRC count only in files whose messages stand outside of chunks: elsewhere
        they may be the inside of a damaged chunk.
        """
        chunked = bool(self.blocks or self._damaged_chunks) or self._data[damaged] == Opcode.CHUNK
        loose = self._loose or not chunked
        for found in (_ANYTHING if loose else _BEGINNING).finditer(self._data, damaged + 1, limit):
            position = found.start()
            try:
                record = frame(self._data, position, limit)
                if record.opcode == Opcode.CHUNK:
                    unpacked(self._data, chunk_at(self._data, record))
                elif record.opcode == Opcode.ATTACHMENT:
                    attachment_to(self._data, record, load=False)
                elif record.opcode == Opcode.DATA_END:  # 9 bytes that a chunk's length may look like
                    if record.end - record.start != 4 or not self._follows(record.end, limit, 1):
                        continue
                elif record.opcode in _ALWAYS:
                    parse(self._data, record)
                elif not self._follows(position, limit, _CHAIN):
                    continue
            except _DAMAGE:
                continue
            return position
        return limit

    # ---- the summary, and definitions that the data lacks

    def _check_summary(self) -> bool:
        """Whether the summary agrees with its CRC, wherever lost bytes have moved it; else it must be where it says."""
        if self._footer is None:
            return False
        start, stored = self._footer.summary_start, self._footer.summary_crc
        if start == 0:
            return not self._summary and self._statistics is None
        if stored and self._data_end is not None:
            return stored == crc(self._data, self._data_end, self._footer_crc_at)
        if not len(MAGIC) <= start <= self._footer_crc_at or self._data_end not in (None, start):
            return False
        return stored in (0, crc(self._data, start, self._footer_crc_at))

    def _define_missing(self, summary_is_sound: bool) -> None:
        if summary_is_sound:
            for record, definition in self._summary:
                self._define(record, definition)
        else:
            self._statistics = None
        written = set(np.flatnonzero(self.counts).tolist())
        doubtful = 0
        if written - self.channels.keys() or self._schemas_missing():
            offered = [definition for _, definition in self._summary] + list(self._salvaged())
            doubtful = self._use(offered, written)
        orphans = sorted(written - self.channels.keys())
        for id in orphans:
            self.channels[id] = Channel(id, f"/unknown/channel_{id}", "", {}, 0)
        if doubtful:
            self._say(f"the definitions of {doubtful} topics come from damaged bytes", lost=True)
        if orphans:
            count = int(self.counts[orphans].sum())
            words = f"{count} messages have lost their topics' definitions: they are kept as {_unknown_topics(orphans)}"
            self._say(words, lost=True)

    def _schemas_missing(self) -> set[int]:
        return {channel.schema_id for channel in self.channels.values()} - self.schemas.keys() - {0}

    def _salvaged(self) -> Iterator[Schema | Channel]:
        """Definitions in damaged chunks."""
        for chunk in self._damaged_chunks:
            content = salvaged(self._data, chunk)
            for record in scan(content, 0, len(content)).definitions:
                try:
                    definition = parse(content, record)
                except _DAMAGE:
                    continue
                assert isinstance(definition, Schema | Channel)
                yield definition

    def _use(self, offered: Sequence[Schema | Channel], written: set[int]) -> int:
        """Takes doubtful definitions of what would else have none -> channels that they define."""
        doubtful = 0
        for channel in (one for one in offered if isinstance(one, Channel)):
            if channel.id in written and channel.id not in self.channels and channel.topic.isprintable():
                self.channels[channel.id] = channel
                doubtful += 1
        missing = self._schemas_missing()
        for schema in (one for one in offered if isinstance(one, Schema)):
            if schema.id in missing and schema.id not in self.schemas:
                own = known(schema.name)
                self.schemas[schema.id] = schema if own is None else dc.replace(schema, data=own)
        return doubtful

    # ---- what is told

    def _say(self, line: str, lost: bool = False) -> None:
        self.damage.append(line)
        if lost:
            self.losses.append(line)

    def _tell(self, summary_is_sound: bool) -> None:
        cut = self._footer is None and not self._closed
        if cut and self._gaps and self._is_truncated(self._gaps[-1]):
            self._gaps.pop()
        missing = self._missing()
        lossy = False
        for gap in self._gaps:
            behind = gap.closed and self._data_matches
            lost = not behind and not (missing == 0 and gap.opcode in _LOSSLESS)
            lossy = lossy or lost
            self._say(self._where(gap), lost)
        if self._footer is not None:
            self._tell_the_end(summary_is_sound)
        elif self._closed:
            self._say("the summary is damaged; the messages were read without it")
        self._tell_missing(missing, lossy)
        if not self._data_matches and not self._gaps:
            outside = "a message outside of chunks" if self._loose else "bytes outside the messages"
            verb = "may be" if self._loose else "are"
            self._say(f"{outside} {verb} damaged: the CRC of the whole does not match")
        if cut:
            blocks = self.blocks
            last = f"t = {blocks[-1].last / NANO:.3f} s" if blocks else "its beginning"
            self._say(f"the log breaks off after {last}: killed, cut off or still being written")

    def _is_truncated(self, gap: _Gap) -> bool:
        """Whether a gap is the last record, of which the file has only a part, or that and zeros."""
        if gap.position + gap.size != self._end:
            return False
        if gap.size < HEAD.size or not any(self._data[-2 * HEAD.size :]):
            return True
        opcode, length = HEAD.unpack_from(self._data, gap.position)
        return opcode in _KNOWN and gap.size < HEAD.size + length < LARGEST

    def _tell_the_end(self, summary_is_sound: bool) -> None:
        if not summary_is_sound:
            self._say("the summary is damaged; the messages were read without it")
        rest = self._data[self._end : self._end + len(MAGIC)]
        if rest != MAGIC:
            self._say("the file's last bytes are damaged")
        elif self._size > self._end + len(MAGIC):
            self._say(f"{self._size - self._end - len(MAGIC)} bytes behind the log's end are not read", lost=True)

    def _where(self, gap: _Gap) -> str:
        blocks = self.blocks
        before = f"after t = {blocks[gap.blocks - 1].last / NANO:.3f} s" if gap.blocks > 0 else "at the beginning"
        after = f", sound again from t = {blocks[gap.blocks].first / NANO:.3f} s" if gap.blocks < len(blocks) else ""
        if gap.reason:
            return f"{gap.reason} ({gap.size} bytes {before}{after})"
        return f"{gap.size} bytes are damaged {before}{after}"

    def _missing(self) -> int | None:
        """How many messages are gone: by the summary, else by this program's numbering, else by the indexes."""
        if self._statistics is not None:
            return max(self._statistics.message_count - int(self.counts.sum()), 0)
        holes = int((self._next - self.counts).clip(0).sum()) if self.own else None
        return max(holes or 0, self._in_damaged_chunks) or holes

    def _tell_missing(self, missing: int | None, lossy: bool) -> None:
        total = int(self.counts.sum())
        unknown = self._statistics is None and lossy and not missing
        self.lost_messages = None if unknown else missing or 0
        if self._statistics is not None and total > self._statistics.message_count:
            self._say(f"the summary counts {self._statistics.message_count} messages, the log holds {total}")
        elif self._statistics is not None and missing:
            self._say(f"{missing} of {total + missing} messages are missing", lost=True)
        elif missing:
            self._say(f"{missing} messages are missing between others", lost=True)


def _unknown_topics(ids: Sequence[int]) -> str:
    """The topics of channels without a definition, for people."""
    return f"/unknown/channel_{ids[0]}" if len(ids) == 1 else f"/unknown/channel_{ids[0]} to _{ids[-1]}"
