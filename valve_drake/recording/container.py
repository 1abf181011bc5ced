"""Writes MCAP files in two steps: the control loop fills a Chunk, a thread compresses and writes it.

Filling takes about a microsecond a message. McapFile compresses and writes whole chunks nearly without holding Python's
interpreter lock. mcap.writer.Writer holds that lock for 4 to 7 microseconds a message, so that it would slow the loop
down from any thread. Records are serialised by the mcap package.
"""

import collections
import os
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, NamedTuple

import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC as MAGIC

LEVEL = 1  # of zstd; 3 takes twice the time for half a per cent, since most of a log are JPEG images
CHUNK_SIZE = 1 << 20  # a chunk is closed when it is larger; raise it for denser compression [bytes]
LIBRARY = "valve_drake"
RECOVERED = "recovered"  # metadata of a recovered log

_HEAD = struct.Struct("<BQ")  # opcode, length of the body
_MESSAGE = struct.Struct("<BQHIQQ")  # the same, channel, sequence, log time, publish time
_MESSAGE_HEAD = _MESSAGE.size - _HEAD.size
_OPCODE = int(Opcode.MESSAGE)


class Definition(NamedTuple):
    """A schema or channel, and its bytes."""

    record: records.Schema | records.Channel
    data: bytes

    @property
    def key(self) -> tuple[type, int]:
        return type(self.record), self.record.id


def definition(record: records.Schema | records.Channel) -> Definition:
    """A schema or channel for chunks."""
    return Definition(record, _bytes_of(record))


class Chunk:
    """Records that are compressed together. It holds the definitions of its channels, so that it can be read alone."""

    def __init__(self) -> None:
        self.definitions: dict[tuple[type, int], Definition] = {}
        self.index: dict[int, list[int]] = collections.defaultdict(list)  # channel -> time, offset, time, offset, ...
        self.parts: list[bytes] = []
        self.size = 0

    def define(self, *definitions: Definition) -> None:
        """Adds schemas and channels, right before the first message of theirs, unless they are here."""
        for one in definitions:
            if one.key not in self.definitions:
                self.definitions[one.key] = one
                self.parts.append(one.data)
                self.size += len(one.data)

    def add(self, channel: int, when: int, sequence: int, data: bytes, published: int | None = None) -> None:
        """Adds a message logged at `when`; `published`: its publish time, if another [ns]."""
        self.index[channel] += (when, self.size)
        length = len(data)
        at = when if published is None else published
        self.parts += (_MESSAGE.pack(_OPCODE, _MESSAGE_HEAD + length, channel, sequence, when, at), data)
        self.size += _MESSAGE.size + length


class McapFile:
    """Writes an MCAP file of zstd chunks, with all indexes and a CRC on every byte. Same calls, same bytes."""

    def __init__(self, file: IO[bytes], library: str = LIBRARY, profile: str = ""):
        self._file = file
        self._position = 0
        self._crc = 0  # of the section so far
        self._definitions: dict[tuple[type, int], Definition] = {}  # of all chunks, for the summary
        self._chunks: list[records.ChunkIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: collections.Counter[int] = collections.Counter()  # of messages by channel
        self._write(MAGIC)
        self._add(records.Header(profile=profile, library=library))

    def add_chunk(self, chunk: Chunk) -> None:
        """Compresses and writes a chunk."""
        content = b"".join(chunk.parts)
        times = [when for index in chunk.index.values() for when in index[0::2]]
        data = zstandard.compress(content, LEVEL)
        start, end = min(times, default=0), max(times, default=0)
        offset, length = self._add(records.Chunk("zstd", data, end, start, zlib.crc32(content), len(content)))
        offsets = {}
        for channel, index in chunk.index.items():
            body = struct.pack(f"<HI{len(index)}Q", channel, 8 * len(index), *index)
            offsets[channel], _ = self._write(_HEAD.pack(Opcode.MESSAGE_INDEX, len(body)) + body)
            self._counts[channel] += len(index) // 2
        self._definitions |= {key: one for key, one in chunk.definitions.items() if key not in self._definitions}
        self._chunks.append(
            records.ChunkIndex(
                chunk_start_offset=offset,
                chunk_length=length,
                message_index_offsets=offsets,
                message_index_length=self._position - offset - length,
                compression="zstd",
                compressed_size=len(data),
                message_end_time=end,
                message_start_time=start,
                uncompressed_size=len(content),
            )
        )

    def add_metadata(self, name: str, facts: dict[str, str]) -> None:
        """Writes a metadata record."""
        offset, length = self._add(records.Metadata(name=name, metadata=facts))
        self._metadata.append(records.MetadataIndex(offset=offset, length=length, name=name))

    def add_attachment(self, file: records.Attachment) -> None:
        """Writes an attached file."""
        offset, length = self._add(file)
        self._attachments.append(
            records.AttachmentIndex(
                offset=offset,
                length=length,
                log_time=file.log_time,
                create_time=file.create_time,
                data_size=len(file.data),
                name=file.name,
                media_type=file.media_type,
            )
        )

    def sync(self) -> None:
        """Forces everything to the disk (fsync), where it survives a crash of the machine."""
        self._file.flush()
        os.fsync(self._file.fileno())

    def finish(self) -> None:
        """Ends the data and writes the summary, from which readers seek."""
        self._add(records.DataEnd(self._crc))
        self._crc, start = 0, self._position
        defined = [one.record for one in self._definitions.values()]
        channels = [record for record in defined if isinstance(record, records.Channel)]
        schemas = [record for record in defined if isinstance(record, records.Schema)]
        statistics = records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            message_start_time=min((c.message_start_time for c in self._chunks), default=0),
            message_end_time=max((c.message_end_time for c in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(schemas),
        )
        groups: dict[Opcode, Sequence[records.McapRecord]] = {
            Opcode.SCHEMA: schemas,
            Opcode.CHANNEL: channels,
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: self._chunks,
            Opcode.ATTACHMENT_INDEX: self._attachments,
            Opcode.METADATA_INDEX: self._metadata,
        }
        offsets = []
        for opcode, group in groups.items():
            group_start = self._position
            for record in group:
                self._add(record)
            if group:
                offsets.append(records.SummaryOffset(opcode, group_start, self._position - group_start))
        offsets_start = self._position
        for offset in offsets:
            self._add(offset)
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_start), self._crc)
        self._add(records.Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=crc))
        self._write(MAGIC)

    def _add(self, record: records.McapRecord) -> tuple[int, int]:
        return self._write(_bytes_of(record))

    def _write(self, data: bytes) -> tuple[int, int]:
        """Writes -> where it stands, and its length."""
        offset = self._position
        self._file.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._position += len(data)
        return offset, len(data)


def _bytes_of(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def active(path: Path) -> Path:
    """The name of a log until it is complete: FILE.active."""
    return path.with_name(path.name + ".active")
