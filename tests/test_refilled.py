"""Filled-in templates: a parser reads the values that were filled in, to the bit."""

import numpy as np
import pytest
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from log_samples import same

from valve_drake.recording import foxglove, schemas
from valve_drake.recording.refilled import STAMP, Refilled, slot
from valve_drake.recording.schemas import Encoded, Wrench, parsed, proto_class, serialized

STRANGE = np.array([0.0, -0.0, np.nan, np.inf, 5e-324, slot(0), -1.5])


@pytest.fixture(scope="module")
def joints():
    form = JointStates(timestamp=STAMP)
    for k in range(3):
        form.joints.add(name=f"joint_{k}", position=slot(2 * k), effort=slot(2 * k + 1))
    return Refilled(form, 6)


@pytest.mark.parametrize("when", [0, 1, 7_812_500, 999_999_999, 1_000_000_000, 240_992_187_500, 2**40])
def test_the_time_is_read_back_whatever_its_length(joints, when):
    data = joints.fill(when, [0.0] * 6).data
    found = JointStates.FromString(data)
    assert found.timestamp.seconds * 10**9 + found.timestamp.nanos == when
    assert len(data) == len(joints.fill(0, [1.0] * 6).data)


def test_numbers_are_read_back_in_their_order_to_the_bit_and_fields_without_one_stay_unset(joints):
    for shift in range(len(STRANGE)):
        values = np.roll(STRANGE, shift)[:6].reshape(3, 2)
        found = parsed(joints.fill(5, values.ravel().tolist())).joints
        read = np.array([[joint.position, joint.effort] for joint in found])
        assert read.tobytes() == values.tobytes()
        assert [joint.name for joint in found] == ["joint_0", "joint_1", "joint_2"]
        assert all(joint.HasField("position") and not joint.HasField("velocity") for joint in found)


def test_filling_again_leaves_what_was_filled_before_as_it_was(joints):
    first = joints.fill(1, range(6))
    kept = bytes(first.data)
    joints.fill(2, [1.0] * 6)
    assert first.data == kept and joints.fill(1, range(6)) == first


def test_own_messages_can_be_filled_in_too():
    form = proto_class(Wrench)(time=slot(0), torque=[slot(1), slot(2), slot(3)], force=[slot(4), slot(5), slot(6)])
    found = parsed(Refilled(form, 7).fill(0, range(7)))
    assert same(found, Wrench(0.0, np.array([1.0, 2, 3]), np.array([4.0, 5, 6])))


def test_a_form_that_lacks_a_slot_and_numbers_that_do_not_fit_are_refused(joints):
    with pytest.raises(ValueError):
        Refilled(JointStates(timestamp=STAMP), 1)
    with pytest.raises(IndexError):
        joints.fill(0, [0.0] * 5)


def test_a_tree_of_frames_is_what_the_schema_says():
    rng = np.random.default_rng(1)
    poses = [np.column_stack([np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)]) for _ in range(4)]
    poses = [X * np.array([*[np.sign(np.linalg.det(X[:, :3]))] * 3, 1.0]) for X in poses]
    for count in (4, 2, 3):  # frames come and go
        tree = parsed(foxglove.transforms(1.25, [("world", f"frame {k}", poses[k]) for k in range(count)]))
        assert [(t.parent_frame_id, t.child_frame_id) for t in tree.transforms] == [
            ("world", f"frame {k}") for k in range(count)
        ]
        for k, at in enumerate(tree.transforms):
            expected = foxglove.pose(poses[k])
            assert at.translation == expected.position and at.rotation == expected.orientation
            assert (at.timestamp.seconds, at.timestamp.nanos) == (1, 250_000_000)


def test_what_is_serialised_already_is_passed_on():
    message = schemas.Vector(1.0, ("a",), np.ones(1))
    encoded = serialized(message)
    assert isinstance(encoded, Encoded) and serialized(encoded) is encoded
    assert same(parsed(encoded), message)
    line = foxglove.log(1.0, "supervisor", "reach")
    assert parsed(serialized(line)) == line
