"""`Block`, the base class of all LeafSystems of the program: typed input ports, a pure step(), outputs that hold.

A block is a pure step: at fixed times it reads its inputs and returns its new memory and the messages that its output
ports hold until the next step. All state is abstract state of the Context (nothing hidden in attributes), so a block
can be cloned, replayed and tested alone.

    class GreeterInputs(Inputs):
        mode: ModeState                           # a message; an error when it is read and nothing is connected
        estimate: RectangleEstimate = RectangleEstimate()     # reads as this value while nothing is connected
        twist: Annotated[np.ndarray, 2]           # a vector of 2

    class GreeterSystem(Block[GreeterInputs, Memory]):
        OUTPUTS = {"status": Status}

        def initial(self) -> Memory: ...
        def step(self, time: float, inputs: GreeterInputs, memory: Memory) -> tuple[Memory, Outputs]: ...

Time inside one control tick of 1/128 s is cut into four slots of 1/512 s, so that a measurement reaches the joints
after one tick and no two blocks that feed each other run at the same instant:

    slot 0  robot_state (measurements are gathered)
    slot 1  behaviours
    slot 2  command_selector; the simulated plant, by the commands of the tick before
    slot 3  supervisor, perception, and the station's wrench sensors, all for the next tick

Commands are published when slot 3 begins. Slow work (perception and planning) therefore runs in slot 3 and cannot
delay them; what takes longer than a tick is cut into portions (stance_planner).

Every block uses UNRESTRICTED updates: Drake makes them all from the state before any of them. A discrete update, made
afterwards, would see what the other blocks have made of the same instant.
"""

import operator
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Generic, NamedTuple, TypeAlias, TypeVar, Union

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from valve_drake import profiling
from valve_drake.memory import lock
from valve_drake.messages import Message

TICK = 1 / 128  # control period [s]
SLOT = 1 / 512  # the slots of a tick [s]

# Of a port: a message class, the size of a vector, or a model value of one of Drake's types.
Kind: TypeAlias = type | int | AbstractValue
Outputs = dict[str, Any]  # port name -> what it holds from now on; ports left out keep their value


_REQUIRED = object()  # instead of a default: reading the port while nothing is connected is an error


class _Port(property):
    """One declared port as an attribute of Inputs: evaluated when it is read."""

    def __init__(self, name: str, kind: Kind, default: Any):
        super().__init__(operator.itemgetter(name), self._refuse)  # a getter in C: blocks read 100 000 times a run
        self.name, self.kind, self.default = name, kind, default

    def _refuse(self, inputs: "Inputs", value: Any) -> None:
        raise AttributeError(f"input port {self.name} can only be read")


class Inputs:
    """Read access to a block's input ports, evaluated on demand: a camera that a step does not look at is not rendered.

    A subclass annotates a block's ports, in order (see the top of this file); the annotation is the message class,
    Annotated[np.ndarray, size], or Annotated[..., model value] for one of Drake's types. Ports of a table
    (`Block.INPUTS`) are read as inputs["name"]. Unknown names: AttributeError, KeyError.
    """

    PORTS: ClassVar[dict[str, Kind]] = {}

    def __init_subclass__(cls) -> None:
        cls.PORTS = dict(cls.PORTS)
        for name, hint in typing.get_type_hints(cls, include_extras=True).items():
            if typing.get_origin(hint) is ClassVar or name in cls.PORTS:
                continue
            cls.PORTS[name] = kind = _kind(hint)
            setattr(cls, name, _Port(name, kind, cls.__dict__.get(name, _REQUIRED)))

    def __init__(self, sources: "Mapping[str, Source]", context: Any):
        self._sources = sources
        self._context = context

    def __getitem__(self, name: str) -> Any:
        """The value of a port, or its default while nothing is connected to it.

        Raises RuntimeError when nothing is connected and there is no default, TypeError for a wrong message.
        """
        port, evaluate, kind, default = self._sources[name]
        try:
            value = evaluate(self._context)
        except RuntimeError as error:
            if port.HasValue(self._context):  # the error is the source's; asking before would evaluate it twice
                raise
            if default is _REQUIRED:
                raise RuntimeError(f"{port.GetFullDescription()}: nothing is connected") from error
            return default
        if not isinstance(value, kind):
            # Connect() cannot check this: Drake sees every Python message as Value[object].
            raise TypeError(f"{port.GetFullDescription()}: want {kind.__name__}, got {type(value).__name__}")
        return value


class Source(NamedTuple):
    """Where a block reads an input: a port of Drake's, or of the player's."""

    port: Any  # of Drake's kind: HasValue, GetFullDescription
    evaluate: Callable[[Any], Any]  # (Context) or, in the player, (time): the value; looked up once
    kind: type  # of its values; object where Drake checks it
    default: Any  # what it reads as while nothing is connected; _REQUIRED if that is an error


def _kind(hint: Any) -> Kind:
    """The kind of port that an annotation asks for: `T` and `T | None` a message, Annotated[..., kind] that kind."""
    if typing.get_origin(hint) is typing.Annotated:
        kind: Kind = typing.get_args(hint)[1]
        return kind
    if typing.get_origin(hint) in (Union, types.UnionType):
        (hint,) = (arg for arg in typing.get_args(hint) if arg is not type(None))
    if not (isinstance(hint, type) and issubclass(hint, Message)):
        raise TypeError(f"an input port is a message or Annotated[..., size], not {hint}")
    return hint


In = TypeVar("In", bound=Inputs)
M = TypeVar("M")  # memory


class PythonSystem(LeafSystem):
    """The base of all systems that are written in Python and have no witness functions.

    At every event Drake asks each of them for its witness functions. Where pybind11 binds Drake it then looks for a
    method of this name and makes an exception for want of one, 0.7 us a time; a C++ function under the name it takes,
    once and for all, for a sign that nothing is overridden. (Bound by nanobind, Drake calls whatever it finds.)
    """

    if type(LeafSystem.GetWitnessFunctions).__name__ == "instancemethod":  # pybind11
        DoGetWitnessFunctions = LeafSystem.GetWitnessFunctions


class Block(PythonSystem, Generic[In, M]):
    """A stage on ports. A subclass names its Inputs and its memory's type, sets OUTPUTS and writes `step`.

    OUTPUTS: port name -> message class, or vector size. INPUTS: ports beside the annotated ones, for names that come
    from a table; a message instead of its class is what the port reads as while nothing is connected. AWAKE: a block
    with an input port `mode` steps in these modes; of another mode it takes one step, the first, and then its outputs
    hold: nobody listens, and nothing is logged.
    """

    INPUTS: Mapping[str, Kind | Message] = {}
    OUTPUTS: Mapping[str, Kind] = {}
    AWAKE: ClassVar[frozenset[str] | None] = None  # the modes in which it steps; None: in all
    _inputs: ClassVar[type[Inputs]] = Inputs

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for base in cls.__dict__.get("__orig_bases__", ()):
            if typing.get_origin(base) is Block and isinstance(typing.get_args(base)[0], type):
                cls._inputs = typing.get_args(base)[0]

    def __init__(self, name: str, *, period: float = TICK, slot: int = 1, delay: float = 0.0):
        """Runs every `period` seconds in slot `slot` of a tick, the first time `delay` seconds after 0."""
        super().__init__()
        self.set_name(name)
        self._name = name
        self.sources: dict[str, Source] = {}
        for port, kind in {**self._inputs.PORTS, **self.INPUTS}.items():
            annotated = getattr(self._inputs, port, None)
            default = annotated.default if isinstance(annotated, _Port) else _REQUIRED
            if isinstance(kind, Message):
                kind, default = type(kind), kind
            if isinstance(kind, int):
                declared = self.DeclareVectorInputPort(port, kind)
            else:
                model = Value(kind()) if isinstance(kind, type) else kind
                declared = self.DeclareAbstractInputPort(port, model)
            self.sources[port] = Source(declared, declared.Eval, kind if isinstance(kind, type) else object, default)
        self._memory = int(self.DeclareAbstractState(Value(Held(self.initial()))))
        self._messages: dict[str, int] = {}  # output port -> index of its abstract state
        self._vectors: dict[str, int] = {}  # output port -> index of its discrete state
        first = self.initial_outputs()
        for port, kind in self.OUTPUTS.items():
            if isinstance(kind, int):
                state = self.DeclareDiscreteState(first[port])
                self._vectors[port] = int(state)
            elif isinstance(kind, type):
                state = self.DeclareAbstractState(Value(first[port]))
                self._messages[port] = int(state)
            else:
                raise TypeError(f"{name}.{port}: an output is a message class or the size of a vector")
            self.DeclareStateOutputPort(port, state)
        self.updates = 0  # of outputs, in any Context: while it stays, none has changed
        self.period, self.offset = period, slot * SLOT + delay  # offset: of the first step [s]
        self.DeclarePeriodicUnrestrictedUpdateEvent(self.period, self.offset, self._update)

    def initial(self) -> M:
        """The memory before the first step; its arrays are locked. A block that keeps none need not write it."""
        return None  # type: ignore[return-value]

    def initial_outputs(self) -> Outputs:
        """What the outputs hold before the first step: zeros, and messages by default."""
        return {
            port: kind() if isinstance(kind, type) else np.zeros(kind) if isinstance(kind, int) else kind
            for port, kind in self.OUTPUTS.items()
        }

    def step(self, time: float, inputs: In, memory: M) -> tuple[M, Outputs]:
        """One step: new memory, and the outputs that change (those left out keep their value)."""
        raise NotImplementedError(f"{type(self).__name__}.step")  # abstract

    def memory(self, context: Context) -> M:
        """The memory in this Context, for tests and reports."""
        held: Held = context.get_abstract_state(self._memory).get_value()
        memory: M = held.value
        return memory

    def update(
        self, time: float, sources: "Mapping[str, Source]", where: Any, held: "Held"
    ) -> "tuple[Held, Outputs] | None":
        """One step on the ports `sources` evaluated in `where`; None while the block sleeps."""
        inputs = self._inputs(sources, where)
        activation = None
        if self.AWAKE is not None:
            mode = inputs["mode"]
            if mode.mode not in self.AWAKE:
                activation = mode.activation
                if held.asleep == activation:
                    return None
        with profiling.work(profiling.STAGE, self._name):
            memory, outputs = self.step(time, inputs, held.value)  # type: ignore[arg-type]
        for port, value in outputs.items():
            kind = self.OUTPUTS[port]
            if isinstance(kind, type) and not isinstance(value, kind):
                raise TypeError(f"{self.get_name()}.{port}: want {kind}, got {type(value).__name__}")
        return type(held)(memory, activation, held.value), outputs

    def _update(self, context: Context, state: State) -> EventStatus | None:
        abstract = state.get_mutable_abstract_state()
        memory = abstract.get_mutable_value(self._memory)  # Drake has put there what is in `context`
        updated = self.update(context.get_time(), self.sources, context, memory.get_value())
        if updated is None:
            return _ASLEEP
        held, outputs = updated
        if outputs:
            self.updates += 1
        memory.set_value(held)
        for port, value in outputs.items():
            if port in self._messages:
                abstract.get_mutable_value(self._messages[port]).set_value(value)
            else:
                vector = state.get_mutable_discrete_state(self._vectors[port])
                vector.SetFromVector(np.asarray(value, float))
        return None


_ASLEEP = EventStatus.DidNothing()  # where all blocks of an instant say so, Drake writes no state and forgets no value


class Held:
    """Carries a block's memory through Drake's state copies without copying it; its arrays are locked.

    before: the memory that this one replaces.
    """

    __slots__ = ("asleep", "value")

    def __init__(self, value: Any, asleep: int | None = None, before: Any = None):
        lock(value, before)
        self.value = value
        self.asleep = asleep  # the activation of a mode that has had its one step; None: awake

    def __deepcopy__(self, memo: dict[int, Any]) -> "Held":
        return self
