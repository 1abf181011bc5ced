"""The log's writer: MCAP with protobuf messages; a crash loses at most FLUSH_PERIOD, and the control loop never waits.

`write` adds a serialised message to a chunk in memory. A thread compresses whole chunks and writes them to the disk.
The file's bytes depend on the messages alone: chunks are closed by size, by the messages' own time and by `flush`,
never by the wall clock, and neither machine nor date is written.

While it is being written the log is FILE.active (active.py); it is renamed to FILE when it is complete. Whatever kills
the program, all but the last FLUSH_PERIOD of the log's own time can be read back (reader.py). Every chunk defines the
topics that it holds messages of, so that a damaged chunk never takes another one's meaning with it.

When the disk refuses (full, gone) or falls MAX_BACKLOG behind, logging stops and the loop goes on: `error`
says why, the next write tells Python's logging so, once, and closing raises LogError. A slow disk still gets what was
recorded until then.
"""

import dataclasses
import logging
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from google.protobuf.message import Message as Proto
from mcap.records import Attachment, Channel, Schema

from valve_drake.checks import OperationFailed
from valve_drake.recording import schemas
from valve_drake.recording.active import ActiveFile
from valve_drake.recording.container import CHUNK_SIZE, Chunk, Definition, McapFile, definition
from valve_drake.recording.foxglove import NANO, nanoseconds

FLUSH_PERIOD = NANO // 2  # of the messages' time: what a crash can lose; raise it for a slow disk [ns]
MAX_BACKLOG = 256 << 20  # waiting for the disk; raise it if a disk stalls for longer and memory allows [bytes]


class LogError(OperationFailed):
    """A log could not be written to its end. Its text is one clear line for the user."""


class LogWriter:
    """Writes one log. Use it as a context manager: leaving it, for whatever reason, completes the file.

    Only a log that holds no message yet when an exception comes is not kept: the run was refused before it began.
    path: the log's name, the next free one if `path` is taken (ActiveFile, also for the arguments); `note` says so.
    spent: processor time of the thread so far [s].
    """

    def __init__(self, path: str | os.PathLike[str], *, companions: Sequence[str] = (), overwrite: bool = False):
        self._file = ActiveFile(Path(path), companions, overwrite)
        self.path, self.note = self._file.path, self._file.note
        self._mcap = McapFile(self._file.file)
        self._chunk = Chunk()
        self._schemas: dict[str, Definition] = {}  # by full name
        self._channels: dict[str, _Channel] = {}
        self._interval = 0  # number of the FLUSH_PERIOD that the last message belongs to
        self._handed, self._written = 0, 0  # bytes, to the thread and by it
        self._error = ""
        self.spent = 0.0  # processor time of the thread [s]
        self._error_logged = self._closed = False
        self._jobs: queue.SimpleQueue[tuple[int, Callable[..., object], tuple[Any, ...]] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="log writer", daemon=True)
        self._thread.start()

    @property
    def error(self) -> str:
        """Why logging has stopped; "" while all is well."""
        return self._error

    @property
    def where(self) -> Path | None:
        """Where the log is: `path` once it is complete, else FILE.active; None if it was removed."""
        return self.path if self._closed and not self._error else self._file.where()

    @property
    def empty(self) -> bool:
        """Whether there is no message yet."""
        return not self._channels

    def write(self, topic: str, message: schemas.Loggable, time: float) -> None:
        """Appends a message of `topic` at `time` [s]. Times must not decrease; a topic keeps one type of message."""
        if self._error:
            self._tell()
            return
        when = nanoseconds(time)
        if when // FLUSH_PERIOD != self._interval:
            self._interval = when // FLUSH_PERIOD
            self.flush()
        elif self._chunk.size > CHUNK_SIZE:
            self._close_chunk()
        kind, data = message if isinstance(message, schemas.Encoded) else schemas.serialized(message)
        channel = self._channels.get(topic) or self._define(topic, kind)
        if kind is not channel.kind:
            raise TypeError(f"{topic} holds {channel.kind.__name__}, got {kind.__name__}")
        if channel.id not in self._chunk.index:
            self._chunk.define(channel.schema, channel.record)
        self._chunk.add(channel.id, when, channel.count, data)
        channel.count += 1

    def write_metadata(self, name: str, facts: Mapping[str, str]) -> None:
        """Adds a metadata record and flushes. What is not UTF-8, of a file's name, is written as \\udcXX."""
        self._close_chunk()
        facts = {key: value.encode("utf-8", "backslashreplace").decode() for key, value in facts.items()}
        self._hand_over(0, self._mcap.add_metadata, name, facts)
        self.flush()

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Adds a file and flushes."""
        file = Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
        self._close_chunk()
        self._hand_over(len(data), self._mcap.add_attachment, file)
        self.flush()

    def flush(self) -> None:
        """Hands everything so far to the thread, to be written to the disk; does not wait for it."""
        self._close_chunk()
        self._hand_over(0, self._mcap.sync)

    def close(self) -> None:
        """Completes the file. Raises LogError if it could not be written; what there is of it is FILE.active then."""
        if self._closed:
            return
        self._closed = True
        self._close_chunk()
        self._end(self._finish)
        if self._error:
            raise LogError(self._error)

    def _end(self, last: Callable[[], None]) -> None:
        """Gives the thread `last` as its last job, unless logging has stopped, and waits until it has ended."""
        self._hand_over(0, last)
        self._jobs.put(None)
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None and self.empty and not self._closed:
            self._closed = True
            self._end(self._file.discard)
            return
        try:
            self.close()
        except LogError:
            if error is None:  # else the run's own error is the one to show
                raise

    def _define(self, topic: str, kind: type[Proto]) -> "_Channel":
        """A new topic's channel; topics of one type share a schema."""
        name = kind.DESCRIPTOR.full_name
        if name not in self._schemas:
            data = schemas.schema_data(kind)
            self._schemas[name] = definition(Schema(len(self._schemas) + 1, data, "protobuf", name))
        schema = self._schemas[name]
        record = Channel(len(self._channels) + 1, topic, "protobuf", {}, schema.record.id)
        self._channels[topic] = _Channel(record.id, kind, schema, definition(record))
        return self._channels[topic]

    def _close_chunk(self) -> None:
        if self._chunk.size > 0:
            self._hand_over(self._chunk.size, self._mcap.add_chunk, self._chunk)
            self._chunk = Chunk()

    def _hand_over(self, size: int, job: Callable[..., object], *args: Any) -> None:
        """Gives the thread a job with so many bytes to write; nothing more once logging has stopped."""
        if self._error:
            return
        self._handed += size
        if self._handed - self._written > MAX_BACKLOG:
            self._stop(f"the disk is {MAX_BACKLOG >> 20} MiB behind")
        self._jobs.put((size, job, args))

    def _tell(self) -> None:
        if not self._error_logged:
            self._error_logged = True
            logging.getLogger(__name__).error("%s", self._error)

    def _stop(self, reason: str) -> None:
        where = self._file.where()
        left = "nothing of the log is left" if where is None else f"what was written is in {str(where)!r}"
        self._error = self._error or f"logging stopped: {reason}; {left}"

    def _work(self) -> None:
        """The thread: does the jobs in their order, none after one that failed."""
        failed = False
        while (handed := self._jobs.get()) is not None:
            size, job, args = handed
            if not failed:
                try:
                    job(*args)
                except Exception as error:  # whatever it is, it must not end the run
                    failed = True
                    self._stop(_words(error))
            self._written += size
            self.spent = time.thread_time()
        if self._error:
            self._file.close()

    def _finish(self) -> None:
        self._mcap.finish()
        self._file.publish()


def _words(error: Exception) -> str:
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return str(error) if isinstance(error, OperationFailed) else repr(error)


@dataclasses.dataclass
class _Channel:
    id: int
    kind: type[Proto]
    schema: Definition
    record: Definition
    count: int = 0  # of its messages
