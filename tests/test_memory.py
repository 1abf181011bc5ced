"""memory: the next memory shares what did not change, and no array in it can be written to."""

import dataclasses as dc

import numpy as np
import pytest

from valve_drake.behaviors import hybrid_rotation, valve_search
from valve_drake.memory import changed, lock


@pytest.mark.parametrize("kind", [hybrid_rotation.Memory, valve_search.Memory])
def test_a_changed_memory_is_what_replace_makes(kind):
    before = kind(activation=3)
    after, wanted = changed(before, since=2.0, activation=4), dc.replace(before, since=2.0, activation=4)
    assert type(after) is kind and vars(after).keys() == vars(wanted).keys()
    assert all(vars(after)[name] is vars(wanted)[name] for name in vars(wanted))
    assert before.activation == 3 and before.since == 0.0


def test_a_changed_memory_has_no_new_fields():
    with pytest.raises(TypeError, match="Memory has no sinse"):
        changed(valve_search.Memory(), sinse=1.0)


def test_what_is_new_in_a_memory_is_locked_and_what_both_share_was():
    before = valve_search.Memory()
    lock(before)
    after = changed(before, torso=np.ones(3), looks=((np.zeros(3), 0.1),))
    lock(after, before)
    assert not any(array.flags.writeable for array in (after.torso, after.velocity, after.goal, after.looks[0][0]))


def test_a_row_that_grows_is_locked_by_its_new_end():
    first, second = np.zeros(2), np.ones(2)
    before = valve_search.Memory(looks=((first, 0.1),))
    lock(before)
    after = changed(before, looks=(*before.looks, (second, 0.2)))
    lock(after, before)
    assert not first.flags.writeable and not second.flags.writeable


def test_a_memory_that_a_step_wrote_into_is_locked_too():
    @dc.dataclass
    class Careless:
        array: np.ndarray

    memory = Careless(np.zeros(2))
    lock(memory)
    memory.array = np.ones(2)
    lock(memory, memory)
    assert not memory.array.flags.writeable
