"""Parses MCAP records with bounds on every length, and as tolerantly as the specification asks.

Bytes behind the fields of a record are ignored (later versions of the format may add fields), and a CRC of 0 is no
CRC. Every length is compared with the end of its record before anything is copied, and the size of a compressed chunk
with MAX_CHUNK before it is unpacked: a file of a few kB cannot take gigabytes. All functions raise Unsound for bytes
that are no such record.
"""

import array
import struct
import zlib
from mmap import mmap
from typing import NamedTuple, TypeAlias

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Footer, Header, McapRecord, Metadata, Schema, Statistics

MAX_CHUNK = 64 << 20  # unpacked; raise it if single messages are larger [bytes]
HEAD = struct.Struct("<BQ")  # opcode, length of the body
ROW = np.dtype(  # of a message, its opcode and length included
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("when", "<u8")]
    + [("published", "<u8")]
)
LEAST = ROW.itemsize - HEAD.size  # length of a message without data [bytes]

_WINDOW = 1 << 27  # of zstd, at most [bytes]
_PIECE = 1 << 16  # of compressed data, where a chunk is damaged [bytes]
Buffer: TypeAlias = bytes | mmap


class Unsound(ValueError):
    """Bytes that are no sound record. `reason` is a sentence for people where there is more to say than that."""

    def __init__(self, reason: str = ""):
        super().__init__(reason)
        self.reason = reason


class Frame(NamedTuple):
    """A record in a buffer: its kind, where its body begins and where it ends."""

    opcode: int
    start: int
    end: int


class ChunkAt(NamedTuple):
    """A chunk's head, and where its records are in the buffer, packed."""

    size: int  # unpacked [bytes]
    crc: int
    compression: str
    start: int
    end: int


def frame(data: Buffer, position: int, limit: int) -> Frame:
    """The record at `position`, which ends before `limit`."""
    if position + HEAD.size > limit:
        raise Unsound
    opcode, length = HEAD.unpack_from(data, position)
    start = position + HEAD.size
    if opcode == 0 or length > limit - start:
        raise Unsound
    return Frame(opcode, start, start + length)


def parse(data: Buffer, record: Frame) -> McapRecord:
    """A header, schema, channel, metadata, statistics, end of data or footer."""
    return parse_to(data, record)[0]


def parse_to(data: Buffer, record: Frame) -> tuple[McapRecord, int]:
    """As `parse`, and where its last field ends."""
    fields = _Fields(data, record.start, record.end)
    return _parse(record.opcode, fields), fields.position


def _parse(opcode: int, f: "_Fields") -> McapRecord:
    match opcode:
        case Opcode.HEADER:
            return Header(profile=f.text(), library=f.text())
        case Opcode.SCHEMA:
            return Schema(id=f.number(2), name=f.text(), encoding=f.text(), data=f.blob(f.number(4)))
        case Opcode.CHANNEL:
            return Channel(
                id=f.number(2),
                schema_id=f.number(2),
                topic=f.text(),
                message_encoding=f.text(),
                metadata=f.texts(),
            )
        case Opcode.METADATA:
            return Metadata(name=f.text(), metadata=f.texts())
        case Opcode.STATISTICS:
            counts = {name: f.number(size) for name, size in _STATISTICS.items()}
            f.skip(f.number(4))  # counts by channel: the messages themselves are counted
            return Statistics(channel_message_counts={}, **counts)
        case Opcode.DATA_END:
            return DataEnd(data_section_crc=f.number(4))
        case Opcode.FOOTER:
            return Footer(summary_start=f.number(8), summary_offset_start=f.number(8), summary_crc=f.number(4))
    raise Unsound


_STATISTICS = {"message_count": 8, "schema_count": 2, "channel_count": 4, "attachment_count": 4}
_STATISTICS |= {"metadata_count": 4, "chunk_count": 4, "message_start_time": 8, "message_end_time": 8}


def attachment(data: Buffer, record: Frame) -> Attachment:
    """An attachment whose CRC matches."""
    return attachment_to(data, record)[0]


def attachment_to(data: Buffer, record: Frame, load: bool = True) -> tuple[Attachment, int]:
    """As `attachment`, and where its last field ends; without its data unless `load`."""
    f = _Fields(data, record.start, record.end)
    log_time, create_time, name, media_type = f.number(8), f.number(8), f.text(), f.text()
    start, end = f.skip(f.number(8))
    if f.number(4) not in (0, crc(data, record.start, end)):
        raise Unsound
    content = data[start:end] if load else b""
    return Attachment(create_time, log_time, name, media_type, content), f.position


def chunk_at(data: Buffer, record: Frame) -> ChunkAt:
    """A chunk's head."""
    f = _Fields(data, record.start, record.end)
    f.skip(16)  # times of its first and last message: they are taken from the messages
    size, stored, compression = f.number(8), f.number(4), f.text()
    start, end = f.skip(f.number(8))
    if compression not in ("", "lz4", "zstd"):
        raise Unsound(f"a chunk is compressed by {compression!r}, which cannot be unpacked")
    return ChunkAt(size, stored, compression, start, end)


def unpacked(data: Buffer, chunk: ChunkAt) -> tuple[Buffer, int, int]:
    """A chunk's records: the buffer that they are in, where they begin and end; its CRC matches."""
    if not chunk.compression:
        if chunk.size != chunk.end - chunk.start or chunk.crc not in (0, crc(data, chunk.start, chunk.end)):
            raise Unsound
        return data, chunk.start, chunk.end
    if chunk.size > MAX_CHUNK:
        raise Unsound(f"a chunk claims to hold {chunk.size} bytes, more than {MAX_CHUNK}: it is not read")
    packed = data[chunk.start : chunk.end]
    try:
        content = _unpack(packed, chunk)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise Unsound from error
    if len(content) != chunk.size or chunk.crc not in (0, zlib.crc32(content)):
        raise Unsound
    return content, 0, len(content)


def _unpack(packed: bytes, chunk: ChunkAt) -> bytes:
    """At most chunk.size + 1 bytes, whatever the data itself claims."""
    if chunk.compression == "lz4":
        unpacker = lz4.frame.LZ4FrameDecompressor()
        content = bytes(unpacker.decompress(packed, max_length=chunk.size + 1)) if packed else b""
        return content
    if not packed:
        return b""
    unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW)
    if zstandard.frame_content_size(packed) == chunk.size:
        return unpacker.decompress(packed)
    with unpacker.stream_reader(packed, read_across_frames=True) as stream:
        return stream.read(chunk.size + 1)


def salvaged(data: Buffer, chunk: ChunkAt) -> bytes:
    """What can still be unpacked of a damaged chunk: it may be wrong, since no CRC confirms it."""
    if not chunk.compression:
        return data[chunk.start : min(chunk.end, chunk.start + MAX_CHUNK)]
    zstd = chunk.compression == "zstd"
    unpacker = zstandard.ZstdDecompressor(max_window_size=_WINDOW).decompressobj() if zstd else None
    other = lz4.frame.LZ4FrameDecompressor()
    content = bytearray()
    try:
        for at in range(chunk.start, chunk.end, _PIECE):
            piece = data[at : min(at + _PIECE, chunk.end)]
            content += unpacker.decompress(piece) if unpacker else other.decompress(piece)
            if len(content) > min(chunk.size, MAX_CHUNK):
                break
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
        pass
    return bytes(content)


class Scan(NamedTuple):
    """What a stretch of records holds."""

    positions: np.ndarray  # of its messages (n,)
    definitions: list[Frame]  # schemas and channels
    end: int  # of the last sound record


def scan(data: Buffer, position: int, end: int, only_messages: bool = False) -> Scan:
    """Scans records up to `end` or the first unsound one; with `only_messages`, up to the first of another kind."""
    found = array.array("Q")
    definitions: list[Frame] = []
    size, unpack, message = HEAD.size, HEAD.unpack_from, int(Opcode.MESSAGE)
    last = end - size
    while position <= last:
        opcode, length = unpack(data, position)
        after = position + size + length
        if after > end or opcode == 0:
            break
        if opcode == message:
            if length < LEAST:
                break
            found.append(position)
        elif only_messages:
            break
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.append(Frame(opcode, position + size, after))
        position = after
    return Scan(np.frombuffer(found, np.uint64) if found else np.empty(0, np.uint64), definitions, position)


def rows(data: Buffer, positions: np.ndarray) -> np.ndarray:
    """The heads of the messages at `positions` (n,) -> (n,) of ROW."""
    if len(positions) == 0:
        return np.empty(0, ROW)
    everywhere = np.ndarray((len(data) - ROW.itemsize + 1,), ROW, data, strides=(1,))  # a row at every byte
    return everywhere[positions]


def crc(data: Buffer, start: int, end: int) -> int:
    """CRC-32 of a part of a buffer, which is not copied."""
    with memoryview(data) as view, view[start:end] as part:
        return zlib.crc32(part)


class _Fields:
    """Reads a record's fields one after the other."""

    def __init__(self, data: Buffer, position: int, end: int):
        self._data, self.position, self._end = data, position, end

    def skip(self, size: int) -> tuple[int, int]:
        """Where a field of this size begins and ends."""
        start = self.position
        if size > self._end - start:
            raise Unsound
        self.position = start + size
        return start, self.position

    def blob(self, size: int) -> bytes:
        start, end = self.skip(size)
        return self._data[start:end]

    def number(self, size: int) -> int:
        return int.from_bytes(self.blob(size), "little")

    def text(self) -> str:
        return self.blob(self.number(4)).decode()  # a UnicodeDecodeError is a ValueError, as Unsound is

    def texts(self) -> dict[str, str]:
        """A map of texts."""
        start, end = self.skip(self.number(4))
        inner = _Fields(self._data, start, end)
        out = {}
        while inner.position < end:
            key = inner.text()
            out[key] = inner.text()
        return out
