"""Steps the program's blocks on a recording, in the order in which Drake steps them, without a simulator.

A block is a pure step at fixed times (ports.py), so that nothing is left of a simulation when its inputs are a
recording: no plant, no integrator, no copies of a Context. Blocks, wires and the recorder are those of diagram.py; that
both come to the same bits is what a replay shows, whose log Drake has written.

Some blocks may be left out: what they sent is shown as it was recorded (halves.py).
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from valve_drake.diagram import OPERATOR, PACKETS, listens, make_blocks, recorded_from, wires_of
from valve_drake.messages import ModeState, OperatorCommand, OperatorPackets
from valve_drake.ports import SLOT, TICK, Block, Held, Source
from valve_drake.recording.recorder_system import RecorderSystem
from valve_drake.recording.signals import JOINED, topic_of
from valve_drake.scenario import Scenario
from valve_drake.stations.replay import Recording, shown

Read = Callable[[float], Any]  # time [s] -> value


_SLOTS = round(TICK / SLOT)  # of a tick


class _Kept(Held):
    """A memory that is not locked: there is no clone that could share it, and what a run locks a replay need not."""

    __slots__ = ()

    def __init__(self, value: Any, asleep: int | None = None, before: Any = None):
        self.value, self.asleep = value, asleep


class _Played:
    """A block with its memory, its wired inputs and its times."""

    def __init__(self, block: Block[Any, Any]):
        self.block = block
        self.stepped: Block[Any, Any] | _Shown = block
        self.held: Any = _Kept(block.initial())
        self.ports = {port: f"{block.get_name()}.{port}" for port in block.OUTPUTS}
        self.sources: dict[str, Source] = {}
        self.asleep: ModeState | None = None  # in what it was found asleep: it sleeps on while this is the mode
        self.period, self.offset = _slots(block.period), _slots(block.offset)  # of its steps [slots]


class _Message:
    """What a block that is left out sent at one time; read when somebody looks at it."""

    def __init__(self, decode: Callable[[Any], Any], recorded: Any):
        self._decode, self._recorded = decode, recorded

    @functools.cached_property
    def value(self) -> Any:
        return self._decode(self._recorded)


class _Shown:
    """Stands for a block that is left out: at its times its ports get what the next tick has recorded of them."""

    def __init__(self) -> None:
        self.sent: dict[int, dict[str, _Message]] = {}  # by the tick that recorded it

    def update(self, time: float, *_: Any) -> tuple[None, dict[str, _Message]]:
        return None, self.sent.get(math.floor(time / TICK) + 1, {})


class Player:
    """The blocks of a resolved scenario on a recording; `recorder` writes what comes out.

    plays: which blocks are stepped, by name; the others must be recorded whole, by every tick.
    time: up to where it was played [s].
    """

    def __init__(
        self,
        scenario: Scenario,
        recording: Recording,
        recorder: RecorderSystem,
        plays: Callable[[str], bool] = lambda name: True,
    ):
        self._recorder, self._groups = recorder, recording.groups
        self._listens = listens(scenario)
        self._slot = 0  # the next one whose updates are due
        # What ports hold, by block.port, and the diagram's own.
        self._values: dict[str, Any] = {OPERATOR: OperatorCommand(), PACKETS: OperatorPackets()}
        self._station, self._joined = shown(recording), recording.joined
        blocks = [_Played(block) for block in make_blocks(scenario)]
        self._left_out = {name: _Shown() for played in blocks if not plays(name := played.block.get_name())}
        self._looked_at = {"supervisor.mode"}  # what is read of those that are left out
        for played in blocks:
            for port, value in played.block.initial_outputs().items():
                self._values[played.ports[port]] = value
        wires = {target: source for source, target in wires_of(scenario)}
        for played in blocks:
            name = played.block.get_name()
            if name in self._left_out:
                for port in played.ports.values():
                    self._values[port] = _Message(_itself, self._values[port])
                played.stepped = self._left_out[name]
                continue
            for port, declared in played.block.sources.items():
                read = self._read(wires[f"{name}.{port}"])
                played.sources[port] = declared._replace(port=_Wired(), evaluate=read)
        recorder.listen(self._recorded)
        self._show(recording)
        self._blocks = blocks
        cycle = math.lcm(*(played.period for played in blocks))
        # Which blocks are due in each slot of a cycle.
        self._due: list[list[_Played]] = [
            [played for played in blocks if (slot - played.offset) % played.period == 0] for slot in range(cycle)
        ]

    @property
    def time(self) -> float:
        return self._slot * SLOT

    @property
    def mode(self) -> ModeState:
        mode: ModeState = self._values["supervisor.mode"]
        return mode

    def command(self, request: OperatorCommand) -> None:
        """The operator's request, from now on."""
        self._values[OPERATOR] = request

    def deliver(self, packets: OperatorPackets) -> None:
        """What operators have sent, from now on."""
        self._values[PACKETS] = packets

    def begin(self) -> None:
        """Records what is there at 0."""
        self._recorder.record(0.0, 0.0)

    def advance(self, until: float) -> None:
        """Plays on to a tick. As in a simulation it is recorded at its end, and updated when the play goes on."""
        values, due = self._values, self._due
        while (time := self.time) < until:
            mode, done = values["supervisor.mode"], []
            for played in due[self._slot % len(due)]:  # each reads what was there before
                if self._slot < played.offset or played.asleep is mode:
                    continue
                updated = played.stepped.update(time, played.sources, time, played.held)
                if updated is None:
                    played.asleep = mode
                else:
                    played.held, outputs = updated
                    done.append((played, outputs))
            for played, outputs in done:
                for port, value in outputs.items():
                    values[played.ports[port]] = value
            self._slot += 1
            if self._slot % _SLOTS == 0:
                self._recorder.record(self.time, self.time)

    def _read(self, source: str) -> Read:
        """What an output port holds: "station.<port>" or "<block>.<port>", or a port of the diagram's own."""
        block, _, port = source.partition(".")
        if block == "station":
            return self._station[port]
        if block in self._left_out:
            self._looked_at.add(source)
            return lambda time: self._values[source].value
        return lambda time: self._values[source]

    def _show(self, recording: Recording) -> None:
        """Has the blocks that are left out show what they sent, as far as somebody looks at it."""
        ports = {
            topic_of(source): source.split(".") for source in self._looked_at if source.split(".")[0] in self._left_out
        }
        for record in recording.sent(ports):
            block, port = ports[record.topic]
            sent = self._left_out[block].sent.setdefault(round(record.time / TICK), {})
            sent[port] = _Message(recording.decode, record)

    def _recorded(self, name: str) -> Read | None:
        """What a port of the recorder shows; None if that is not in a recording."""
        if name in self._joined:
            return self._joined[name].at
        if name in JOINED:
            parts = [self._read(recorded_from(part)) for part in JOINED[name](self._groups)]
            return lambda time: np.concatenate([part(time) for part in parts])
        source = recorded_from(name)
        there = source.startswith("station.") or source in self._values
        if source.startswith("station.truth.") or not there or (source == PACKETS and not self._listens):
            return None
        return self._read(source)


def _itself(value: Any) -> Any:
    return value


class _Wired:
    """Stands for an input port that leads to another block."""

    def HasValue(self, context: Any) -> bool:
        return True

    def GetFullDescription(self) -> str:
        return "an input port"


def _slots(seconds: float) -> int:
    """A time as a number of slots; ports.py's are all multiples of one."""
    count = round(seconds / SLOT)
    if count * SLOT != seconds:
        raise ValueError(f"{seconds} s is no multiple of a slot of {SLOT} s")
    return count
