"""How a stage stands on Drake's ports: `Block`, the base of every LeafSystem of the program.

A block is a pure step: at fixed times it reads its inputs, and out come its memory and the messages that
its output ports hold until the next step. All state is abstract state of the Context (nothing hidden in
attributes), so a block can be cloned, replayed and tested alone.

Time inside one control tick of 1/128 s is cut into four slots of 1/512 s, so that a measurement reaches the
joints within one tick and no two blocks that feed each other run at the same instant:

    slot 0  robot_state (measurements are gathered)
    slot 1  behaviours
    slot 2  command_selector
    slot 3  supervisor, perception, and the station's wrench sensors, all for the next tick

On a robot the commands leave at the beginning of slot 3: what takes longest, to look at an image and to plan where to
stand (`later`), holds up none.

Every block uses UNRESTRICTED updates: a discrete update would see the plant already stepped.
"""

import functools
import time as _time
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, InputPort, LeafSystem, State

TICK = 1 / 128  # control period [s]
SLOT = 1 / 512  # plant period, and the slots of a tick [s]

Kind = type | int | AbstractValue  # a message class, the size of a vector, or a model value of one of Drake's types


class Profile:
    """Wall time by kind of work, each second counted once (inner work is taken off the outer's)."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.beside = 0.0  # processor time of other processes that make images
        self._stack: list[list] = []

    def clear(self) -> None:
        self.seconds.clear()
        self.beside = 0.0

    def __call__(self, kind: str) -> "Profile":
        self._stack.append([kind, _time.perf_counter(), 0.0])
        return self

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        kind, start, inner = self._stack.pop()
        spent = _time.perf_counter() - start
        self.seconds[kind] = self.seconds.get(kind, 0.0) + spent - inner
        if self._stack:
            self._stack[-1][2] += spent


profile = Profile()


class Inputs:
    """Read access to a block's input ports by name, evaluated on demand: a camera that a step does
    not look at is not rendered. An unconnected port reads as None."""

    def __init__(self, block: "Block", context: Context):
        self._block = block
        self._context = context

    def __getattr__(self, name: str) -> Any:
        port, kind = self._block.input_ports[name]
        try:
            value = port.Eval(self._context)
        except RuntimeError:  # also what Drake says of a port without a value; asking first would evaluate it twice
            if port.HasValue(self._context):
                raise
            return None
        if isinstance(kind, type) and not isinstance(value, kind):
            # Connect() cannot check this: Drake sees every Python message as Value[object].
            raise TypeError(f"{port.GetFullDescription()}: want {kind.__name__}, got {type(value).__name__}")
        return value


class Block(LeafSystem):
    """A stage on ports. Subclasses set INPUTS and OUTPUTS and write `step`.

    INPUTS, OUTPUTS: port name -> message class, or vector size.
    """

    INPUTS: ClassVar[dict[str, Kind]] = {}
    OUTPUTS: ClassVar[dict[str, Kind]] = {}

    def __init__(self, name: str, *, period: float = TICK, slot: int = 1, delay: float = 0.0):
        """Runs every `period` seconds in slot `slot` of a tick, the first time `delay` seconds after 0."""
        super().__init__()
        self.set_name(name)
        self.input_ports: dict[str, tuple[InputPort, Kind]] = {}
        for port, kind in self.INPUTS.items():
            if isinstance(kind, int):
                declared = self.DeclareVectorInputPort(port, kind)
            else:
                model = kind if isinstance(kind, AbstractValue) else Value(kind())
                declared = self.DeclareAbstractInputPort(port, model)
            self.input_ports[port] = (declared, kind)
        self._memory = self.DeclareAbstractState(Value(_Held(self.initial())))
        self._held: dict[str, Any] = {}
        vectors = {name: kind for name, kind in self.OUTPUTS.items() if isinstance(kind, int)}
        for port, kind in self.OUTPUTS.items():
            if port in vectors:
                index = self.DeclareDiscreteState(kind)
            else:
                index = self.DeclareAbstractState(Value(kind()))
            self._held[port] = index
            self.DeclareStateOutputPort(port, index)
        self.period = period
        works = [(slot, self.step)]
        if type(self).later is not Block.later:
            works.append((3, self.later))
        for when, work in works:
            run = functools.partial(self._update, work)
            self.DeclarePeriodicUnrestrictedUpdateEvent(period, when * SLOT + delay, run)

    def initial(self) -> Any:
        """The memory before the first step: immutable, or None."""
        return None

    def step(self, time: float, inputs: Inputs, memory: Any) -> tuple[Any, dict[str, Any]]:
        """One step: new memory, and the outputs that change (those left out keep their value)."""
        raise NotImplementedError(f"{type(self).__name__}.step")  # abstract

    def later(self, time: float, inputs: Inputs, memory: Any) -> tuple[Any, dict[str, Any]]:
        """What of a step takes long and can wait for slot 3, when the commands have left; not run unless written."""
        return memory, {}

    def memory(self, context: Context) -> Any:
        """The memory in this Context, for tests and reports."""
        return context.get_abstract_state(int(self._memory)).get_value().value

    def _update(self, work: Callable, context: Context, state: State) -> None:
        with profile("stages"):
            memory, outputs = work(context.get_time(), Inputs(self, context), self.memory(context))
        abstract = state.get_mutable_abstract_state()
        abstract.get_mutable_value(int(self._memory)).set_value(_Held(memory))
        for port, value in outputs.items():
            kind = self.OUTPUTS[port]
            if isinstance(kind, int):
                state.get_mutable_discrete_state(int(self._held[port])).SetFromVector(np.asarray(value, float))
            elif isinstance(value, kind):
                abstract.get_mutable_value(int(self._held[port])).set_value(value)
            else:
                raise TypeError(f"{self.get_name()}.{port}: want {kind.__name__}, got {type(value).__name__}")


class _Held:
    """Carries a block's memory through Drake's state copies without copying it."""

    __slots__ = ("value",)

    def __init__(self, value: Any):
        self.value = value

    def __deepcopy__(self, memo: dict) -> "_Held":
        return self
