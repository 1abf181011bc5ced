"""The recorder: a System that reads ports, encodes their values and writes them to topics of the log, row by row of
a table."""

import dataclasses as dc
import functools
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, InputPort

from valve_drake import profiling
from valve_drake.ports import TICK, Block, Kind, PythonSystem
from valve_drake.recording.schemas import Loggable, serialized

ONCE = math.inf  # a period: at the start only


class Sink(Protocol):
    """Where the recorder writes: writer.LogWriter, or a live view."""

    def write(self, topic: str, message: Loggable, time: float) -> None:
        """Takes a message of `topic` at `time` [s]."""

    def flush(self) -> None:
        """What was written is to survive a crash."""


class Tee:
    """Several sinks as one."""

    def __init__(self, *sinks: Sink):
        self._sinks = sinks

    def write(self, topic: str, message: Loggable, time: float) -> None:
        for sink in self._sinks:
            sink.write(topic, message, time)

    def flush(self) -> None:
        for sink in self._sinks:
            sink.flush()


@dc.dataclass(frozen=True)
class Signal:
    """One row of the recorder's table: what is read, when it is written, and as what.

    Every `period` the row's ports are read. It is written if one of them holds another message than at the last
    writing, or if its ports are vectors or it has none. With `key` it is written when `key(*values)` has changed.
    Rows may share ports and topics. A row with a port that is unconnected at the first publish is left out.
    """

    topic: str
    inputs: Mapping[str, Kind]  # port -> message class, or size of the vector
    encode: Callable[..., Loggable | None]  # (time, *values) -> what to write; None: nothing
    period: float = TICK  # [s] a multiple of TICK, or ONCE
    key: Callable[..., Any] | None = None
    urgent: bool = False  # flushed to the disk at once


class RecorderSystem(PythonSystem):
    """Writes `signals` to `sink`.

    | port                | dir | type                                                       |
    |---------------------|-----|------------------------------------------------------------|
    | all names in `signals` | in | message or vector as the row says; may be left unconnected |

    Publishes every TICK from 0, in the order of the rows. A publish at t sees the values before the updates at t: what
    the sensors show at t is written at t, what a block makes of it during the tick is written at t + TICK.
    The sink, and what was written last, are not part of the Context: a recorder serves one simulation.
    From one tick to the next the ports of a block (`follow`) are read again only if it was updated: Drake takes 1 us,
    and 3 in a run, to say that a port shows what it showed before.
    """

    def __init__(self, sink: Sink, signals: Iterable[Signal], name: str = "recorder"):
        super().__init__()
        self.set_name(name)
        self._sink = sink
        self._ports: dict[str, _Port] = {}
        self._rows = [_Row(signal, [self._declare(*port) for port in signal.inputs.items()]) for signal in signals]
        self._cycle = math.lcm(*(int(row.every) for row in self._rows if row.every != ONCE))  # [ticks]
        self._begun = False
        self._next = 0  # the tick that follows the last one
        self._due = functools.cache(self._find_due)
        self.DeclarePeriodicPublishEvent(TICK, 0.0, self._publish)

    def _declare(self, name: str, kind: Kind) -> "_Port":
        if name not in self._ports:
            if isinstance(kind, int):
                declared = self.DeclareVectorInputPort(name, kind)
            else:
                declared = self.DeclareAbstractInputPort(name, Value(kind()))
            self._ports[name] = _Port(declared, kind)
        elif self._ports[name].kind != kind:
            raise ValueError(f"port {name} is {self._ports[name].kind} in one row and {kind} in another")
        return self._ports[name]

    def listen(self, source: Callable[[str], Callable[[float], Any] | None]) -> None:
        """Reads what `source`(port) reads at a time instead of Drake's ports; None stands for unconnected."""
        for name, port in self._ports.items():
            port.listen(source(name))

    def follow(self, name: str, block: Block[Any, Any]) -> None:
        """Says whose output the port `name` shows: of a block in the same simulation."""
        self._ports[name].block = block

    def _publish(self, context: Context) -> None:
        self.record(context.get_time(), context)

    def record(self, time: float, where: Any) -> None:
        """Writes what is due at `time`, with the ports evaluated in `where`: a Context, or the time itself."""
        with profiling.work(profiling.LOGGING):
            if not self._begun:
                self._begun = True
                self._rows = [row for row in self._rows if all(port.connected(where) for port in row.ports)]
            tick = round(time / TICK)
            rows, ports = self._due(tick if tick == 0 else tick % self._cycle or self._cycle)
            jumped, self._next = tick != self._next, tick + 1
            for port in ports:
                if port.block is not None:
                    if port.updates == port.block.updates and not jumped:
                        continue
                    port.updates = port.block.updates
                value = port.evaluate(where)
                if value is not port.value:
                    port.check(value)
                    port.value = value
            for row in rows:
                if row.watched and row.watched.value is row.seen:
                    continue  # the usual case: tested here, since a call for each row would cost more
                if (values := row.news()) is not None:
                    self._write(row.signal, time, values)

    def _find_due(self, tick: int) -> tuple[list["_Row"], list["_Port"]]:
        """The rows that are due at a tick, and their ports."""
        rows = [row for row in self._rows if tick % row.every == 0]
        return rows, list(dict.fromkeys(port for row in rows for port in row.ports))

    def _write(self, signal: Signal, time: float, values: list[Any]) -> None:
        message = signal.encode(time, *values)
        if message is not None:
            self._sink.write(signal.topic, serialized(message), time)  # serialised once for all sinks
            if signal.urgent:
                self._sink.flush()


class _Port:
    """An input port, and its value at the last publish that had a row for it."""

    def __init__(self, port: InputPort, kind: Kind):
        self.kind = kind
        self.value: Any = None
        self.block: Block[Any, Any] | None = None  # whose output it shows, if that is known
        self.updates = -1  # of the block when `value` was read
        self._port = port
        self.evaluate: Callable[[Any], Any] = port.Eval
        self.connected: Callable[[Any], bool] = port.HasValue
        self._type = np.ndarray if isinstance(kind, int) else kind

    def listen(self, source: Callable[[float], Any] | None) -> None:
        self.connected = lambda time: source is not None
        if source is not None:
            self.evaluate = source

    def check(self, value: Any) -> None:
        """Connect() cannot do this: Drake sees every Python message as Value[object]."""
        if not isinstance(value, self._type):
            found = type(value).__name__
            raise TypeError(f"{self._port.GetFullDescription()}: want {self._type.__name__}, got {found}")


class _Row:
    """A signal, its ports, and what was last written of it."""

    def __init__(self, signal: Signal, ports: list[_Port]):
        if signal.period != ONCE and (signal.period < TICK or signal.period % TICK != 0):
            raise ValueError(f"{signal.topic}: the period must be a multiple of {TICK} s, got {signal.period}")
        self.signal = signal
        self.ports = ports
        self.every = ONCE if signal.period == ONCE else round(signal.period / TICK)  # [ticks]; 0 % ONCE is 0
        self.watched = ports[0] if len(ports) == 1 and not isinstance(ports[0].kind, int) else None
        self.seen: Any = None  # the watched port's value at the last tick
        self._key = signal.key
        self._always = signal.key is None and all(isinstance(port.kind, int) for port in ports)
        self._last: Any = None

    def news(self) -> list[Any] | None:
        """The values to write, if any. Messages compare by identity."""
        values = [port.value for port in self.ports]
        if self.watched:
            self.seen = self.watched.value
        if not self._always:
            mark = values if self._key is None else self._key(*values)
            if mark == self._last:
                return None
            self._last = mark
        return values
