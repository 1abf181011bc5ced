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


def recover(source: str | os.PathLike[str], path: str | os.PathLike[str], overwrite: bool | None = None) -> LogReader:
    """Writes all that can be read of the log `source` to a new, sound log `path`; returns the reader of `source`.

    Everything keeps its bytes, times, numbers and order: messages, channels, schemas, attachments and metadata, of one
    name as well. Metadata `recovered` is added: the number of messages and all damage, earlier recoveries' included.
    Raises ConfigError if `source` is no log, or `path` a file that is no recovered log, unless `overwrite`;
    OperationFailed if the new one cannot be written.
    """
    target = outputs.check(path, "-o", inputs=[source], made_before=was_recovered, overwrite=overwrite)
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
    for part in log.load_attachments():
        mcap.add_attachment(part)
    definitions = {topic: [_both(log, channel) for channel in log.channels(topic)] for topic in log.topics}
    chunk.define(
        *(one for pairs in definitions.values() for pair in pairs for one in pair)
    )  # those without messages, too
    for record in log.records():
        both = definitions[record.topic][record.channel]
        chunk.define(*both)
        chunk.add(both[-1].record.id, record.when, record.sequence, record.data, record.published)
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


def _both(log: LogReader, channel: Channel) -> tuple[Definition, ...]:
    """A channel's schema, if it has one, and the channel."""
    if channel.schema_id in log.schemas:
        return definition(log.schemas[channel.schema_id]), definition(channel)
    return (definition(dc.replace(channel, schema_id=0)),)  # a reader must find each schema that is named
