"""ports: a Block steps at its own times on its own memory, holds its outputs, and refuses what does not fit."""

import dataclasses as dc
import functools
from typing import Annotated

import numpy as np
import pytest
from helpers import Rig, SourceBlock, assert_clones_are_independent, assert_holds_between_updates, ports
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem, ValueProducer

from valve_drake.memory import lock
from valve_drake.messages import Health, Mode, ModeState, Status, StereoPosition
from valve_drake.ports import SLOT, TICK, Block, Inputs, Outputs
from valve_drake.recording.recorder_system import RecorderSystem
from valve_drake.stations.camera_rig import CameraSystem
from valve_drake.stations.hardware import LcmReceiver, LcmSender
from valve_drake.stations.plant_system import PlantSystem
from valve_drake.stations.replay import RecordedStation
from valve_drake.stations.simulated import TruthSystem


class CounterInputs(Inputs):
    a: Annotated[np.ndarray, 2]
    status: Status = Status()


class Counter(Block[CounterInputs, int]):
    """Counts its steps; multiplies its input."""

    OUTPUTS = {"sum": 2, "report": StereoPosition}

    def __init__(self, **timing):
        self.times = []  # of the steps, for the tests; no state
        super().__init__("counter", **timing)

    def initial(self):
        return 0

    def step(self, time, inputs, memory):
        self.times.append(time)
        out = {"report": StereoPosition(time=time, sequence=memory)}
        if inputs.status.state == "running":
            out["sum"] = inputs.a * (memory + 1)
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


RUNNING = Status(state="running")


def test_an_open_port_reads_as_its_default_and_a_connected_one_as_its_value():
    rig = Rig(Counter()).run(TICK)  # `status` is the default, so that `a` is not read
    assert rig.read("sum").tolist() == [0, 0]  # left out of the step's outputs: kept
    rig.fix(a=[1.0, 2.0], status=RUNNING)
    rig.run(2 * TICK)
    assert rig.read("sum").tolist() == [2, 4]
    rig.run(3 * TICK)
    assert rig.read("sum").tolist() == [3, 6]


def test_an_open_port_without_a_default_is_an_error_that_names_it_when_it_is_read():
    with pytest.raises(RuntimeError, match="a.*counter.*nothing is connected"):
        Rig(Counter(), status=RUNNING).run(TICK)


def test_a_port_that_may_be_none_says_so():
    class ListenerInputs(Inputs):
        health: Health | None = None

    class Listener(Block[ListenerInputs, list]):
        def initial(self):
            return []

        def step(self, time, inputs, memory):
            return [*memory, inputs.health], {}

    rig = Rig(Listener("listener")).run(TICK)
    rig.fix(health=Health())
    heard = rig.run(2 * TICK).block.memory(rig.context)
    assert heard[0] is None and type(heard[1]) is Health


def test_a_port_of_a_table_reads_as_its_message_while_nothing_is_connected():
    class Chief(Block[Inputs, list]):
        INPUTS = {"one": RUNNING, "other": Status}

        def initial(self):
            return []

        def step(self, time, inputs, memory):
            return [*memory, inputs["one"].state, inputs["other"].state], {}

    rig = Rig(Chief("chief"), other=Value(Status())).run(TICK)
    assert rig.block.memory(rig.context) == ["running", "idle"]
    with pytest.raises(RuntimeError, match="other.*chief.*nothing is connected"):
        Rig(Chief("chief")).run(TICK)


def test_unknown_ports_are_errors_and_no_port_can_be_written():
    def reading(work):
        class Curious(Counter):
            def step(self, time, inputs, memory):
                work(inputs)
                return memory, {}

        return Rig(Curious(), a=[1.0, 2.0])

    with pytest.raises(AttributeError, match="statsu"):
        reading(lambda inputs: inputs.statsu).run(TICK)
    with pytest.raises(KeyError, match="statsu"):
        reading(lambda inputs: inputs["statsu"]).run(TICK)
    with pytest.raises(AttributeError, match="a can only be read"):
        reading(lambda inputs: setattr(inputs, "a", 1)).run(TICK)
    with pytest.raises(TypeError, match="an input port is a message"):

        class Wrong(Inputs):
            a: float


def test_ports_of_a_table_are_read_by_their_name():
    class Tabled(Block[Inputs, None]):
        INPUTS = {"base.odometry": 1, "status": Status}
        OUTPUTS = {"sum": 1}

        def step(self, time, inputs, memory):
            return None, {"sum": inputs["base.odometry"] + inputs["status"].value}

    rig = Rig(Tabled("tabled"), **{"base.odometry": [2.0], "status": Status(value=3.0)})
    assert rig.run(TICK).read("sum").tolist() == [5.0]
    assert ports(rig.block) == {"base.odometry": "in 1", "status": "in abstract", "sum": "out 1"}


def test_a_block_reads_inputs_as_they_are_at_its_own_slot():
    """A source of slot 0 and a reader of slot 1 meet within the tick."""
    builder = DiagramBuilder()
    source = builder.AddSystem(SourceBlock("clock", Status, lambda t: Status(time=t)))

    class ReaderInputs(Inputs):
        status: Status

    class Reader(Block[ReaderInputs, None]):
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
    make = functools.partial(Rig, a=[1.0, 2.0], status=RUNNING)
    assert_clones_are_independent(lambda: make(Counter()), {"a": [5.0, 6.0]}, ("sum", "report"))


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

    with pytest.raises(TypeError, match="wrong.report: want .*StereoPosition.*, got Status"):
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


@dc.dataclass(frozen=True)
class Nested:
    array: np.ndarray
    parts: tuple
    hands: dict


def test_the_arrays_of_a_memory_are_locked_so_that_no_clone_can_be_changed():
    class Careless(Block[Inputs, Nested]):
        def initial(self):
            return Nested(np.zeros(3), (np.zeros(2), [np.zeros(1)]), {"left": Nested(np.zeros(2), (), {})})

        def step(self, time, inputs, memory):
            array = memory.array + 1
            return dc.replace(memory, array=array), {}

    rig = Rig(Careless("careless")).run(0.1)
    memory = rig.block.memory(rig.context)
    assert memory is rig.block.memory(rig.context.Clone()) and memory.array[0] > 0
    for array in (memory.array, memory.parts[0], memory.parts[1][0], memory.hands["left"].array):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 5.0


def test_locking_leaves_what_is_no_array():
    for value in (None, 3, "text", Status, Status(), (1, None, {"a": 2.0})):
        lock(value)


def test_a_source_block_says_its_value_of_the_time_in_slot_0():
    rig = Rig(SourceBlock("source", Status, lambda t: Status(time=t, value=10 * t)))
    assert ports(rig.block) == {"value": "out abstract"}
    rig.run(0.25 + SLOT / 2)
    assert (rig.read("value").time, rig.read("value").value) == (0.25, 2.5)
    assert_holds_between_updates(rig, "value", slot=0)


def test_an_error_of_who_is_read_is_not_taken_for_a_port_without_a_value():
    class Failing(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareVectorOutputPort("a", 2, self.calc)

        def calc(self, context, output):
            raise RuntimeError("no image")

    builder = DiagramBuilder()
    source, block = builder.AddSystem(Failing()), builder.AddSystem(Counter())
    status = builder.AddSystem(SourceBlock("status", Status, lambda t: RUNNING))
    builder.Connect(source.GetOutputPort("a"), block.GetInputPort("a"))
    builder.Connect(status.GetOutputPort("value"), block.GetInputPort("status"))
    with pytest.raises(RuntimeError, match="no image"):
        Simulator(builder.Build()).AdvanceTo(TICK)


# ---------------------------------------------------------------- blocks that sleep


class SleeperInputs(Inputs):
    mode: ModeState


class Sleeper(Block[SleeperInputs, int]):
    """Counts its steps; awake while turning."""

    AWAKE = frozenset((Mode.TURN,))
    OUTPUTS = {"status": Status}

    def __init__(self) -> None:
        super().__init__("sleeper")

    def initial(self) -> int:
        return 0

    def step(self, time: float, inputs: SleeperInputs, memory: int) -> tuple[int, Outputs]:
        return memory + 1, {"status": Status(time=time, activation=inputs.mode.activation)}


def test_a_block_steps_in_its_modes_and_once_in_any_other():
    """It says once that it is idle, so that whoever reads its status sees the activation; then nothing is logged."""
    block = Sleeper()
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    steps, statuses = [], []
    for k, (mode, activation) in enumerate(
        [(Mode.IDLE, 0), (Mode.SEARCH, 1), (Mode.TURN, 2), (Mode.RELEASE, 3), (Mode.TURN, 4)]
    ):
        block.GetInputPort("mode").FixValue(context, Value(ModeState(mode=mode.value, activation=activation)))
        before = block.memory(context)
        for tick in range(4):
            simulator.AdvanceTo((4 * k + tick + 1) * TICK)
            statuses.append(block.GetOutputPort("status").Eval(context))
            if tick == 0:
                assert block.memory(context) == before + 1  # it wakes, or falls asleep, in the mode's first tick
        steps.append(block.memory(context) - before)
    assert steps == [1, 1, 4, 1, 4]
    assert statuses[0] is statuses[3] and statuses[4] is statuses[7]  # held, so that a log has it once
    assert [s.activation for s in statuses[::4]] == [0, 1, 2, 3, 4]


def test_a_sleeping_block_is_the_same_in_a_clone():
    block = Sleeper()
    simulator = Simulator(block)
    block.GetInputPort("mode").FixValue(simulator.get_mutable_context(), Value(ModeState(mode="search", activation=1)))
    simulator.AdvanceTo(4 * TICK)
    clone = Simulator(block, simulator.get_context().Clone())
    clone.AdvanceTo(8 * TICK)
    assert block.memory(clone.get_context()) == block.memory(simulator.get_context()) == 1


def test_where_every_block_due_sleeps_drake_forgets_no_value():
    """Else each output of each sleeper is computed again in every tick."""
    block = Sleeper()
    seen = block.DeclareCacheEntry(
        "seen", ValueProducer(lambda: Value(0), lambda context, value: None), {block.xa_ticket()}
    )
    simulator = Simulator(block)
    context = simulator.get_mutable_context()
    block.GetInputPort("mode").FixValue(context, Value(ModeState(mode="turn", activation=1)))
    forgotten = []
    for tick in range(6):
        if tick == 3:
            block.GetInputPort("mode").FixValue(context, Value(ModeState(mode="search", activation=2)))
        seen.EvalAbstract(context)
        simulator.AdvanceTo((tick + 1) * TICK)
        forgotten.append(seen.is_out_of_date(context))
    assert forgotten == [True, True, True, True, False, False]


def test_no_system_of_the_program_is_searched_for_witness_functions_at_every_event():
    """Where pybind11 binds Drake, the search ends in an exception, unless a C++ function has the name."""
    bound = type(LeafSystem.get_name).__name__ == "instancemethod"
    for kind in (
        Block,
        RecorderSystem,
        PlantSystem,
        TruthSystem,
        CameraSystem,
        RecordedStation,
        LcmReceiver,
        LcmSender,
    ):
        assert hasattr(kind, "DoGetWitnessFunctions") == bound
