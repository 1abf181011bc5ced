"""MCAP files as other programs write them, and invalid ones: made record by record."""

import dataclasses as dc
import struct
import zlib
from pathlib import Path

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC as MAGIC

PACK = {"": lambda data: data, "zstd": zstandard.compress, "lz4": lz4.frame.compress}
FIXED = (Message, Chunk, DataEnd, Footer)  # no bytes may follow their fields

SCHEMA = Schema(id=1, name="Example", encoding="c", data=b"\4\5\6")
CHANNEL = Channel(id=1, topic="example", message_encoding="a", metadata={"foo": "bar"}, schema_id=1)
MESSAGES = tuple(  # neither in the order of time nor numbered from 0
    Message(channel_id=1, log_time=t, data=bytes([k] * k), publish_time=t + 5, sequence=10 + 3 * k)
    for k, t in enumerate((0, 2, 1, 3, 3, 5, 4, 7, 8, 9))
)


def record(part: McapRecord, pad: bytes = b"") -> bytes:
    """A record's bytes, with `pad` behind its fields."""
    builder = RecordBuilder()
    part.write(builder)
    data = builder.end()
    if not pad or isinstance(part, FIXED):
        return data
    opcode, length = struct.unpack_from("<BQ", data)
    return struct.pack("<BQ", opcode, length + len(pad)) + data[9:] + pad


def private(opcode: int, data: bytes) -> bytes:
    """A record of a kind that no reader knows."""
    return struct.pack("<BQ", opcode, len(data)) + data


@dc.dataclass
class Sample:
    """One file. Parts that are bytes are written as they are."""

    parts: tuple[McapRecord | bytes, ...] = (SCHEMA, CHANNEL, *MESSAGES)
    compression: str | None = None  # of one chunk around definitions and messages; None: no chunk
    indexed: bool = True  # with a MessageIndex behind the chunk
    pad: bytes = b""
    chunk_crc: bool = True
    data_crc: bool = True
    summary: tuple[McapRecord | bytes, ...] = ()
    summary_crc: bool = True
    summary_start: int | None = None  # None: the right one
    library: str = "another 1.0"
    profile: str = "ros2"

    def write(self, path: Path) -> Path:
        path.write_bytes(self.bytes())
        return path

    def bytes(self) -> bytes:
        out = bytearray(MAGIC + record(Header(profile=self.profile, library=self.library), self.pad))
        inside = (Schema, Channel, Message) if self.compression is not None else ()
        content, index = bytearray(), MessageIndex(channel_id=1, records=[])
        for part in self.parts:
            if isinstance(part, Message):
                index.records.append((part.log_time, len(content)))
            if isinstance(part, inside):
                content += record(part)
            else:
                out += part if isinstance(part, bytes) else record(part, self.pad)
        if self.compression is not None:
            out += record(chunk(bytes(content), self.compression, self.chunk_crc))
            out += record(index, self.pad) if self.indexed else b""
        out += record(DataEnd(zlib.crc32(out) if self.data_crc else 0))
        start = len(out)
        for part in self.summary:
            out += part if isinstance(part, bytes) else record(part, self.pad)
        place = (start if self.summary else 0) if self.summary_start is None else self.summary_start
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, place, 0)
        crc = zlib.crc32(head, zlib.crc32(out[start:])) if self.summary_crc else 0
        return bytes(out) + head + struct.pack("<I", crc) + MAGIC


def chunk(content: bytes, compression: str, crc: bool = True, size: int | None = None) -> Chunk:
    """A chunk of records; `size` that it claims to have when it is unpacked."""
    return Chunk(
        compression=compression,
        data=PACK[compression](content),
        message_end_time=0,
        message_start_time=0,
        uncompressed_crc=zlib.crc32(content) if crc else 0,
        uncompressed_size=len(content) if size is None else size,
    )


def statistics(messages: int) -> Statistics:
    return Statistics(
        attachment_count=0,
        channel_count=1,
        channel_message_counts={1: messages},
        chunk_count=0,
        message_count=messages,
        message_end_time=9,
        message_start_time=0,
        metadata_count=0,
        schema_count=1,
    )


def attachment(name: str, data: bytes, crc: bool = True) -> bytes:
    whole = record(Attachment(create_time=1, log_time=2, name=name, media_type="text/plain", data=data))
    return whole if crc else whole[:-4] + bytes(4)


def metadata(name: str, **facts: str) -> Metadata:
    return Metadata(name=name, metadata=facts)
