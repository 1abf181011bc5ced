"""A whole, sound MCAP file from all that can be read of a truncated or damaged one."""

import dataclasses as dc
import os
from pathlib import Path
from typing import IO

from mcap.records import Channel

from valve_drake import outputs
from valve_drake.checks import ConfigError
from valve_drake.recording.container import CHUNK_SIZE, LIBRARY, RECOVERED, Chunk, Definition, McapFile, definition
from valve_drake.recording.reader import LogReader


def recover(source: str | os.PathLike[str], path: str | os.PathLike[str]) -> LogReader:
    """Writes all that can be read of the log `source` to a new, sound log `path`; returns the reader of `source`.

    Everything keeps its bytes, times, numbers and order: messages, channels, schemas, attachments and metadata, of one
    name as well. Metadata `recovered` is added: the number of messages and all damage, earlier recoveries' included.
    Raises ConfigError if `source` is no log or `path` is a file that is no recovered log, OperationFailed if the new
    one cannot be written.
    """
    target = outputs.check(path, "-o", inputs=[source], made_before=was_recovered)
    log = LogReader(source)
    with outputs.replacing(target) as file:
        copy(log, file)
    return log


def was_recovered(path: Path) -> bool:
    """Whether a file is a log that `recover` made."""
    try:
        return RECOVERED in LogReader(path).metadata
    except ConfigError:
        return False


def copy(log: LogReader, file: IO[bytes]) -> None:
    """Writes all that could be read of a log as a new MCAP file."""
    library = LIBRARY if log.library is None else log.library
    mcap, chunk = McapFile(file, library, log.profile), Chunk()
    definitions = _definitions(log)
    for part in log.load_attachments():
        mcap.add_attachment(part)
    chunk.define(*(one for pair in definitions.values() for one in pair))  # those of channels without messages, too
    for record in log.records():
        assert record.channel is not None
        if record.channel not in chunk.index:
            chunk.define(*definitions[record.channel])
        chunk.add(record.channel, record.when, record.sequence, record.data, record.published)
        if chunk.size > CHUNK_SIZE:
            mcap.add_chunk(chunk)
            chunk = Chunk()
    if chunk.size > 0:
        mcap.add_chunk(chunk)
    for metadata in log.all_metadata:
        mcap.add_metadata(metadata.name, metadata.metadata)
    damage = "; ".join([log.past_damage] * bool(log.past_damage) + log.damage)
    count = sum(topic.count for topic in log.topics.values())
    mcap.add_metadata(RECOVERED, {"messages": str(count), "damage": damage})
    mcap.finish()


def _definitions(log: LogReader) -> dict[int, tuple[Definition, ...]]:
    """Channel -> its schema, if it has one, and the channel itself."""
    schemas, channels = log.definitions
    made = {id: definition(schema) for id, schema in schemas.items()}

    def both(channel: Channel) -> tuple[Definition, ...]:
        if channel.schema_id in made:
            return made[channel.schema_id], definition(channel)
        return (definition(dc.replace(channel, schema_id=0)),)  # a reader must find each schema that is named

    return {id: both(channel) for id, channel in channels.items()}
