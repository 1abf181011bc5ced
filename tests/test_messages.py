"""messages: checked when made, never changed afterwards, copied for nothing."""

import copy
import dataclasses as dc
import inspect

import numpy as np
import pytest

from valve_drake import messages
from valve_drake.messages import CameraFrame, Command, Health, Message, RobotState, Segmentation, StereoPosition

KINDS = [k for _, k in inspect.getmembers(messages, inspect.isclass) if issubclass(k, Message) and k is not Message]


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_every_message_has_defaults_and_cannot_be_changed(kind):
    message = kind()
    for field in dc.fields(kind):
        value = getattr(message, field.name)
        with pytest.raises(dc.FrozenInstanceError):
            setattr(message, field.name, value)
        if isinstance(value, np.ndarray):
            assert not value.flags.writeable, field.name
        else:
            assert not isinstance(value, list | dict | set), f"{field.name} could be changed in place"


@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_arrays_are_float64_of_the_declared_shape(kind):
    message = kind()
    for field in dc.fields(kind):
        if "shape" not in field.metadata:
            continue
        value, shape = getattr(message, field.name), field.metadata["shape"]
        if field.metadata["optional"]:
            assert value is None
        else:
            size = 5 if field.name == "odometry" else 0  # of any length: that of a base with two speeds
            assert value.shape == tuple(size if n < 0 else n for n in shape)
            assert value.dtype == np.float64
        given = np.ones([2 if n < 0 else n for n in shape], int)
        assert np.array_equal(getattr(kind(**{field.name: given.tolist()}), field.name), given)
        with pytest.raises(ValueError, match=f"{kind.__name__}.{field.name} must have shape"):
            kind(**{field.name: given[..., None]})


def test_an_array_is_copied_so_that_the_giver_may_go_on_using_it():
    given = np.arange(5.0)
    message = RobotState(odometry=given)
    given[:] = 7
    assert message.odometry.tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="read-only"):
        message.odometry[0] = 1


def test_an_array_that_nobody_can_change_is_shared_and_a_view_of_another_is_not():
    first = RobotState(odometry=np.arange(5.0))
    assert RobotState(odometry=first.odometry).odometry is first.odometry
    given = np.arange(8.0)
    view = given[:5]
    view.setflags(write=False)
    message = RobotState(odometry=view)
    given[:] = 7
    assert message.odometry.tolist() == [0, 1, 2, 3, 4]


def test_integers_become_floats_and_any_length_is_any_length():
    assert Health(devices=("a", "b"), ages=[1, 2]).ages.dtype == np.float64
    assert Segmentation(green=[]).green.shape == (0, 3)
    assert Segmentation(green=np.ones((7, 3))).green.shape == (7, 3)
    with pytest.raises(ValueError, match=r"must have shape \(-1, 3\)"):
        Segmentation(green=np.ones((7, 2)))


def test_an_optional_group_is_none_unless_asked_for():
    with pytest.raises(ValueError, match="StereoPosition.p_LV"):
        StereoPosition(p_LV=None)
    command = Command(left_arm=np.zeros(6))
    assert command.right_arm is None and command.left_arm.shape == (6,)
    with pytest.raises(ValueError, match="Command.left_gripper"):
        Command(left_gripper=np.zeros(3))


def test_copies_are_the_message_itself():
    message = StereoPosition(time=1.0)
    assert copy.copy(message) is message and copy.deepcopy(message) is message
    assert copy.deepcopy({"a": [message]})["a"][0] is message


def test_dataclass_replace_checks_and_copies_again():
    message = dc.replace(StereoPosition(), p_LV=np.ones(3))
    assert not message.p_LV.flags.writeable
    with pytest.raises(ValueError, match="p_LV"):
        dc.replace(message, p_LV=np.ones(2))


def test_a_camera_frame_protects_its_image():
    frame = CameraFrame(image=np.zeros((4, 6, 3), np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0, 0] = 1
    assert frame.image.dtype == np.uint8


# ---------------------------------------------------------------- the head's past


def moving_head() -> RobotState:
    t = np.array([1.0, 1.5, 2.0])
    rows = np.column_stack([t, 2 * t, -t, 0.1 * t, 0.2 * t, 0.3 * t, -0.4 * t])
    return RobotState(time=2.0, odometry=[4, -2, 0.2, 0, 0], torso=[0.4, 0.6, -0.8], history=rows)


def test_head_at_interpolates_and_holds_beyond_the_ends():
    state = moving_head()
    for time, t in ((1.2, 1.2), (1.5, 1.5), (1.9, 1.9), (0.5, 1.0), (3.0, 2.0)):
        base, torso = state.head_at(time)
        assert base == pytest.approx([2 * t, -t, 0.1 * t])
        assert torso == pytest.approx([0.2 * t, 0.3 * t, -0.4 * t])


def test_head_at_without_a_past_is_the_present():
    state = RobotState(odometry=[1, 2, 3, 4, 5], torso=[6, 7, 8])
    base, torso = state.head_at(0.3)
    assert base.tolist() == [1, 2, 3] and torso.tolist() == [6, 7, 8]


def test_head_at_goes_the_short_way_where_the_heading_jumps_by_a_turn():
    rows = np.zeros((2, 7))
    rows[:, 0] = 1.0, 2.0
    rows[:, 3] = np.pi - 0.01, -np.pi + 0.01
    base, _ = RobotState(history=rows).head_at(1.5)
    assert np.cos(base[2]) == pytest.approx(-1.0)
