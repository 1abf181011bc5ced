"""beside: a function computed in a copy of the process gives the bits that it gives here, also after a wrong guess."""

import os
import subprocess
import sys

import pytest

FUNCTION = """
import os, signal, sys
import numpy as np
from valve_drake.beside import Beside

def where(question):  # -> whatever it is asked, and the process that answers
    if question[0] < 0:
        raise ValueError("negative")
    return np.array([*np.sqrt(question), os.getpid()])

here = os.getpid()
one, two = np.array([1.0, 4.0]), np.array([9.0, 16.0])
"""


def run(code, **environment):
    """Runs code in a process of its own, with one thread -> what it prints, as a value."""
    result = subprocess.run(
        [sys.executable, "-c", FUNCTION + code],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert result.stderr == "" and result.returncode == 0
    return result.stdout.split()


def test_what_was_begun_is_answered_by_the_copy_and_all_else_here():
    code = """
import valve_drake.beside as module
module.PATIENCE = 60.0  # on a busy machine it would do without the copy
with Beside(where, 2, 3) as beside:
    pid = beside._process.pid
    def ask(question):
        *roots, process = beside.answer(question)
        return [*map(int, roots), {here: "here", pid: "copy"}[process]]
    print(*ask(one))
    beside.begin(one); print(*ask(one))
    beside.begin(one); print(*ask(two)); print(*ask(one))
    beside.begin(one); beside.begin(two); print(*ask(two))
    beside.begin(np.array([-1.0, 0.0]))
    try:
        beside.answer(np.array([-1.0, 0.0]))
    except ValueError as error:
        print(error)
    beside.begin(two); print(*ask(two), beside.spent > 0)
print(os.path.exists(f"/proc/{pid}"))
"""
    expected = "1 2 here 1 2 copy 3 4 here 1 2 copy 3 4 copy negative 3 4 copy True False"
    assert " ".join(run(code)) == expected


def test_a_copy_that_is_lost_is_done_without():
    code = """
with Beside(where, 2, 3) as beside:
    beside.begin(one)
    os.kill(beside._process.pid, signal.SIGKILL)
    beside._process.join()
    beside.answer(one)
    for question in (one, two):
        beside.begin(question)
        print(*map(int, beside.answer(question)[:2]), beside.answer(question)[2] == here)
"""
    assert run(code) == ["1", "2", "True", "3", "4", "True"]


def test_where_waiting_takes_longer_than_the_work_it_is_done_here_for_a_while():
    code = """
import types
from valve_drake import beside as module

def wait(*arguments):
    clock[0] += seconds
    return os.read(*arguments)

clock, module.REST = [0.0], 3
with Beside(where, 2, 3) as beside:
    module.time = types.SimpleNamespace(perf_counter=lambda: clock[0])
    module.os = types.SimpleNamespace(**vars(os) | {"read": wait})
    for seconds in (0.0, 0.05, 0.0, 0.0, 0.0, 0.0):
        beside.begin(one)
        print("here" if beside.answer(one)[2] == here else "copy")
"""
    assert run(code) == ["copy", "copy", "here", "here", "here", "copy"]


def test_beside_other_threads_no_copy_is_made():
    code = """
import threading
threading.Thread(target=threading.Event().wait, daemon=True).start()
with Beside(where, 2, 3) as beside:
    beside.begin(one)
    print(beside.answer(one)[2] == here, beside._process)
"""
    assert run(code) == ["True", "None"]


def test_the_copy_ends_with_the_program_however_that_ends():
    code = """
beside = Beside(where, 2, 3).__enter__()
print(beside._process.pid, flush=True)
os.kill(here, signal.SIGKILL)
"""
    result = subprocess.run(
        [sys.executable, "-c", FUNCTION + code],
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,  # which stays open as long as the copy lives
        timeout=60,
    )
    assert result.stdout.strip().isdigit()


PLANT = """
from valve_drake import diagram, scenario
from pydrake.systems.analysis import Simulator

scenario = scenario.resolve(scenario.load(None, ["seed=3"]))
physics = diagram.plant_of(scenario)
station = diagram.make_station(scenario, physics=physics)
first = station.CreateDefaultContext()
for name, value in diagram.initial_commands(scenario).items():
    station.GetInputPort(name).FixValue(first, value)
second = first.Clone()
station.GetInputPort("base.twist_command").FixValue(second, np.array([0.5, 0.2]))

def states(ticks):
    out, simulators = [], [Simulator(station, context.Clone()) for context in (first, second)]
    for tick in range(1, ticks):
        for simulator in simulators:  # in turns: each begins what the other does not ask for
            simulator.AdvanceTo(tick / 128)
        if tick == 4:
            simulators.append(Simulator(station, simulators[1].get_context().Clone()))
            simulators[2].Initialize()
    for simulator in simulators:
        values = physics.GetMyContextFromRoot(simulator.get_context()).get_discrete_state()
        out.append(b"".join(values.value(k).tobytes() for k in range(values.num_groups())))
    return out

alone = states(9)
with physics.beside() as beside:
    print(states(9) == alone, alone[1] == alone[2] != alone[0], beside.spent > 0)
"""


@pytest.mark.system
def test_a_plant_beside_gives_the_bits_of_one_that_is_not_in_any_context():
    assert run(PLANT) == ["True", "True", "True"]
