"""Tables: the numbers of messages as one array, whether all of them fit the first one's form or not."""

import numpy as np
import pytest
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from robot_facts import GROUPS

from valve_drake.messages import RobotState
from valve_drake.recording import schemas, signals, tables
from valve_drake.recording.foxglove import transforms
from valve_drake.recording.schemas import proto_class
from valve_drake.recording.tables import table

JOINTS = signals.joints("/joint_states", "measured", GROUPS)
NAMES = [name for names in signals.measured(GROUPS).values() for name in names]


def filled(count):
    """Joint states as they are logged, and their numbers (count, n)."""
    numbers = np.random.default_rng(1).normal(size=(count, len(NAMES)))
    numbers[0, :4] = 0.0, -0.0, np.nan, np.inf
    return [JOINTS.encode(1.7 * k, row).data for k, row in enumerate(numbers)], numbers


def never(data):
    raise AssertionError("a message was parsed by itself")


def parse_first(kind):
    """A parser that serves once."""
    parsers = iter([kind.FromString])
    return lambda data: next(parsers, never)(data)


def test_logged_joints_are_read_at_once_to_the_bit_by_the_names_of_the_log():
    data, numbers = filled(2 * tables.BATCH + 3)
    found = table(data, parse_first(JointStates))
    read = found.values[:, [found.columns[f"joints.{name}"] for name in NAMES]]
    assert read.tobytes() == numbers.tobytes() and not found.gaps


def test_vectors_and_wrenches_too():
    rows = [signals.wrench("left"), signals.vector("/truth/base_pose", "truth.base_pose", ("x", "y", "heading"))]
    for row, kind, paths in zip(rows, (schemas.Wrench, schemas.Vector), (("torque", "force"), ("values",))):
        size = row.inputs[next(iter(row.inputs))]
        numbers = np.arange(4.0 * size).reshape(4, size) - 5.0
        found = table([row.encode(k, n).data for k, n in enumerate(numbers)], parse_first(proto_class(kind)))
        assert found.values[:, found.columns["time"]].tolist() == [0.0, 1.0, 2.0, 3.0]
        read = [found.columns[f"{path}.{k}"] for path in paths for k in range(size // len(paths))]
        assert found.values[:, read].tolist() == numbers.tolist()


@pytest.mark.parametrize("odd", ["short", "renamed", "other encoding"])
def test_messages_of_another_form_are_read_one_by_one(odd):
    data, numbers = filled(tables.BATCH + 2)
    message = JointStates.FromString(data[-1])
    if odd == "short":
        message.joints[0].ClearField("position")
    elif odd == "renamed":
        message.joints[0].name = "base_z"
    data[-1] = message.SerializeToString()
    found = table(data, JointStates.FromString)
    read = found.values[:, [found.columns[f"joints.{name}"] for name in NAMES]]
    gone = odd != "other encoding"
    assert read[:-1].tobytes() == numbers[:-1].tobytes()
    assert found.gaps == ({"joints.base_x.position"} if gone else set())
    assert np.isnan(read[-1, 0]) if gone else read[-1, 0] == numbers[-1, 0]
    assert read[-1, 1:].tobytes() == numbers[-1, 1:].tobytes()


def test_joints_of_one_name_and_nested_messages_are_read():
    states = JointStates()
    for position in (1.0, 2.0):
        states.joints.add(name="waist", position=position)
    found = table([states.SerializeToString()] * 2, JointStates.FromString)
    assert found.values[:, found.columns["joints.waist.position"]].tolist() == [2.0, 2.0]
    tree = transforms(1.0, [("world", "robot", np.eye(3, 4))])
    found = table([tree.data], tree.kind.FromString)
    assert found.values[0, found.columns["transforms.0.rotation.w"]] == 1.0
    state = RobotState(time=2.0)
    found = table([schemas.encode(state)], proto_class(RobotState).FromString)
    assert found.values[0, found.columns["time"]] == 2.0
