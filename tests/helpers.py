"""What the tests of blocks share: one block alone in a simulator, its inputs fixed by hand."""

from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, PortDataType

from valve_drake.messages import Message
from valve_drake.ports import SLOT, TICK, Block, Inputs, Kind, Outputs


class Rig:
    """One block in a simulator. `inputs` fixes ports by name; those left out stay open."""

    def __init__(self, block: Block[Any, Any], **inputs: Any):
        self.block = block
        self.simulator = Simulator(block)
        self.context = self.simulator.get_mutable_context()
        self.fix(**inputs)

    def fix(self, **inputs: Any) -> None:
        for port, value in inputs.items():
            self.block.GetInputPort(port).FixValue(self.context, value)

    def run(self, until: float) -> "Rig":
        self.simulator.AdvanceTo(until)
        return self

    def read(self, port: str, context: Context | None = None) -> Any:
        return self.block.GetOutputPort(port).Eval(self.context if context is None else context)


class SourceBlock(Block[Inputs, None]):
    """A block without inputs whose single output is `value(time)`."""

    def __init__(self, name: str, kind: Kind, value: Callable[[float], Any], *, period: float = TICK, slot: int = 0):
        self.OUTPUTS = {"value": kind}
        self._value = value
        super().__init__(name, period=period, slot=slot)

    def step(self, time: float, inputs: Inputs, memory: None) -> tuple[None, Outputs]:
        return None, {"value": self._value(time)}


def ports(block: Block[Any, Any]) -> dict[str, str | int]:
    """Port name -> "in"/"out" and vector size or "abstract", in order."""
    found = {}
    for direction, count, get in (
        ("in", block.num_input_ports(), block.get_input_port),
        ("out", block.num_output_ports(), block.get_output_port),
    ):
        for k in range(count):
            port = get(k)
            size = port.size() if port.get_data_type() == PortDataType.kVectorValued else "abstract"
            found[port.get_name()] = f"{direction} {size}"
    return found


def same(a: Any, b: Any) -> bool:
    """Bitwise equality of messages and vectors."""
    if isinstance(a, Message):
        return type(a) is type(b) and all(same(x, y) for x, y in zip(vars(a).values(), vars(b).values()))
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.tobytes() == b.tobytes()
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b))
    return a == b


def assert_holds_between_updates(rig: Rig, port: str, slot: int, period: float = TICK) -> None:
    """The output changes at slot `slot` of each period, and only there; it carries the time of its step."""
    start = rig.context.get_time() // period + 1
    due = start * period + slot * SLOT
    rig.run(due - SLOT / 2)
    before = rig.read(port)
    rig.run(due + SLOT / 2)
    now = rig.read(port)
    assert before.time == due - period and now.time == due
    rig.run(due + period - SLOT / 2)
    assert rig.read(port) is now


def assert_clones_are_independent(make, change: dict[str, Any], outputs: tuple[str, ...]) -> None:
    """make() -> Rig. A clone with other inputs does not affect the original, which repeats bit by bit."""
    rig = make().run(0.1)
    clone = rig.context.Clone()
    other = Simulator(rig.block, clone)
    for port, value in change.items():
        rig.block.GetInputPort(port).FixValue(clone, value)
    other.AdvanceTo(0.6)
    rig.run(0.6)
    again = make().run(0.6)
    assert all(same(rig.read(port), again.read(port)) for port in outputs)
    assert not all(same(rig.read(port), rig.read(port, clone)) for port in outputs)
