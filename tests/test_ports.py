"""ports: a Block steps at its own times on its own memory, holds its outputs, and refuses what does not fit."""

import dataclasses as dc

import numpy as np
import pytest
from helpers import Rig, SourceBlock, assert_clones_are_independent, assert_holds_between_updates, ports
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from valve_drake.messages import Health, Status, StereoPosition
from valve_drake.ports import SLOT, TICK, Block, profile


class Counter(Block):
    """Counts its steps; adds up its inputs."""

    INPUTS = {"a": 2, "status": Status}
    OUTPUTS = {"sum": 2, "report": StereoPosition}

    def __init__(self, **timing):
        self.times = []  # of the steps, for the tests; no state
        super().__init__("counter", **timing)

    def initial(self):
        return 0

    def step(self, time, inputs, memory):
        self.times.append(time)
        a = inputs.a
        out = {"report": StereoPosition(time=time, sequence=memory, found=inputs.status is not None)}
        if a is not None:
            out["sum"] = a * (memory + 1)
        return memory + 1, out


def test_slots_cut_a_tick_into_four_plant_steps():
    assert TICK == 4 * SLOT == 1 / 128
    assert float(TICK).hex().startswith("0x1.0000")  # a power of two: no drift of the times


def test_ports_are_those_of_the_tables_in_order():
    dut = Counter()
    assert dut.get_name() == "counter"
    assert ports(dut) == {"a": "in 2", "status": "in abstract", "sum": "out 2", "report": "out abstract"}
    assert not dut.HasAnyDirectFeedthrough()


@pytest.mark.parametrize(
    "timing, first, period",
    [
        ({}, SLOT, TICK),
        ({"slot": 3}, 3 * SLOT, TICK),
        ({"period": 1 / 16, "slot": 2, "delay": 1 / 32}, 2 * SLOT + 1 / 32, 1 / 16),
    ],
)
def test_steps_come_at_exact_times(timing, first, period):
    rig = Rig(Counter(**timing)).run(1.0)
    wanted = np.arange(first, 1.0, period)
    assert rig.block.times == wanted.tolist()
    assert rig.block.memory(rig.context) == len(wanted)


def test_outputs_before_the_first_step_are_the_defaults():
    rig = Rig(Counter())
    assert rig.read("report").sequence == -1
    assert rig.read("sum").tolist() == [0, 0]


def test_an_open_port_reads_as_none_and_a_connected_one_as_its_value():
    rig = Rig(Counter()).run(TICK)
    assert not rig.read("report").found
    assert rig.read("sum").tolist() == [0, 0]  # left out of the step's outputs: kept
    rig.fix(a=[1.0, 2.0], status=Status())
    rig.run(2 * TICK)
    assert rig.read("report").found
    assert rig.read("sum").tolist() == [2, 4]
    rig.run(3 * TICK)
    assert rig.read("sum").tolist() == [3, 6]


def test_a_block_reads_inputs_as_they_are_at_its_own_slot():
    """A source of slot 0 and a reader of slot 1 meet within the tick."""
    builder = DiagramBuilder()
    source = builder.AddSystem(SourceBlock("clock", Status, lambda t: Status(time=t)))

    class Reader(Block):
        INPUTS = {"status": Status}
        OUTPUTS = {"age": 1}

        def step(self, time, inputs, memory):
            return None, {"age": [time - inputs.status.time]}

    reader = builder.AddSystem(Reader("reader"))
    builder.Connect(source.GetOutputPort("value"), reader.GetInputPort("status"))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    for k in range(1, 4):
        simulator.AdvanceTo(k * TICK)
        age = reader.get_output_port().Eval(reader.GetMyContextFromRoot(simulator.get_context()))
        assert age == [SLOT]


def test_outputs_hold_between_updates():
    for slot in range(4):
        assert_holds_between_updates(Rig(Counter(slot=slot)), "report", slot=slot)


def test_clones_are_independent():
    assert_clones_are_independent(lambda: Rig(Counter(), a=[1.0, 2.0]), {"a": [5.0, 6.0]}, ("sum", "report"))


def test_a_wrong_message_on_a_port_is_refused_with_the_port_named():
    rig = Rig(Counter())
    rig.block.GetInputPort("status").FixValue(rig.context, Value(Health()))
    with pytest.raises(TypeError, match="status.*want Status, got Health"):
        rig.run(TICK)


def test_a_wrong_output_is_refused_with_block_and_port_named():
    class Wrong(Block):
        OUTPUTS = {"report": StereoPosition}

        def step(self, time, inputs, memory):
            return None, {"report": Status()}

    with pytest.raises(TypeError, match="wrong.report: want StereoPosition, got Status"):
        Rig(Wrong("wrong")).run(TICK)


def test_an_error_in_a_step_comes_out_of_the_simulator_unchanged():
    class Broken(Block):
        def step(self, time, inputs, memory):
            raise ZeroDivisionError("in the step")

    with pytest.raises(ZeroDivisionError, match="in the step"):
        Rig(Broken("broken")).run(TICK)


def test_the_memory_is_not_copied_by_drake():
    @dc.dataclass(frozen=True)
    class Heavy:
        array: np.ndarray

        def __deepcopy__(self, memo):
            raise AssertionError("copied")

    class Keeper(Block):
        OUTPUTS = {"report": StereoPosition}

        def initial(self):
            return Heavy(np.zeros(3))

        def step(self, time, inputs, memory):
            return memory, {"report": StereoPosition(time=time)}

    rig = Rig(Keeper("keeper")).run(0.1)
    assert rig.block.memory(rig.context) is rig.block.memory(rig.context.Clone())


def test_a_source_block_says_its_value_of_the_time_in_slot_0():
    rig = Rig(SourceBlock("source", Status, lambda t: Status(time=t, value=10 * t)))
    assert ports(rig.block) == {"value": "out abstract"}
    rig.run(0.25 + SLOT / 2)
    assert (rig.read("value").time, rig.read("value").value) == (0.25, 2.5)
    assert_holds_between_updates(rig, "value", slot=0)


def test_profile_counts_every_second_once():
    before = dict(profile.seconds)
    with profile("outer of the test"):
        with profile("inner of the test"):
            sum(range(200_000))
        inner = profile.seconds["inner of the test"]
    outer = profile.seconds["outer of the test"]
    assert inner > 0 and 0 <= outer < inner
    assert before.get("stages", 0) == profile.seconds.get("stages", 0)


def test_an_error_of_who_is_read_is_not_taken_for_a_port_without_a_value():
    class Failing(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareVectorOutputPort("a", 2, self.calc)

        def calc(self, context, output):
            raise RuntimeError("no image")

    builder = DiagramBuilder()
    source, block = builder.AddSystem(Failing()), builder.AddSystem(Counter())
    builder.Connect(source.GetOutputPort("a"), block.GetInputPort("a"))
    with pytest.raises(RuntimeError, match="no image"):
        Simulator(builder.Build()).AdvanceTo(TICK)


def test_what_can_wait_runs_in_slot_3_on_what_the_step_left_and_only_where_it_is_written():
    class Planner(Counter):
        def later(self, time, inputs, memory):
            return memory + 10, {"report": StereoPosition(time=time, sequence=memory)}

    rig = Rig(Planner())
    rig.run(SLOT * 2.9)
    assert rig.read("report").sequence == 0 and rig.block.memory(rig.context) == 1
    rig.run(SLOT * 3.1)
    assert rig.read("report").sequence == 1 and rig.read("report").time == 3 * SLOT
    assert rig.block.memory(rig.context) == 11
    plain = Rig(Counter())
    plain.run(TICK)
    assert plain.block.memory(plain.context) == 1
