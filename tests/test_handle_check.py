"""handle_check: valves whose handles no open hand can be at are refused by their key."""

import dataclasses as dc
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable

import numpy as np
import pytest
from robot_variants import part, variant

from valve_drake import scenario as scenarios
from valve_drake.behaviors.handle_check import check_handles
from valve_drake.checks import ConfigError
from valve_drake.collision import CollisionModel
from valve_drake.diagram import make_blocks
from valve_drake.messages import SIDES
from valve_drake.robot import description
from valve_drake.robot.robot import Robot
from valve_drake.valve.valve import HandleConfig, MarkerConfig, PanelConfig, Valve

VALVE = Valve()


def check(valve: Valve) -> None:
    robot = Robot.load(description.find("robot/robot.yaml"), valve)
    check_handles(CollisionModel(robot), valve, robot.opening)


def made(radius: float, kind: str = "bar", count: int = 2, **changes) -> Valve:
    angles = 2 * np.pi * np.arange(count) / count
    places = [[round(radius * np.cos(a), 4), round(radius * np.sin(a), 4), 0.0] for a in angles]
    return dc.replace(VALVE, model="", handles=[HandleConfig(kind=kind, xyz=xyz) for xyz in places], **changes)


def least_told(refusal: str, make: Callable[[float], Valve], value: float) -> None:
    """A valve made with `value` is refused, by a line that tells the least one which will do: it does, and no less."""
    with pytest.raises(ConfigError) as error:
        check(make(value))
    said = re.fullmatch(refusal, str(error.value))
    assert said, error.value
    check(make(float(said[1])))
    with pytest.raises(ConfigError, match="must be at least"):
        check(make(float(said[1]) - 0.003))


def test_handles_beside_the_markers_plate_are_refused_with_the_least_radius_which_will_do():
    refusal = (
        r"valve\.handles\[0\]\.xyz must be at least (0\.1\d+) m off the axis: an open hand there touches the valve "
        r"\(face\) or is nearer than collision.padding, got \[0.06, 0.0, 0.0\]"
    )
    least_told(refusal, made, 0.06)


def test_a_wheel_whose_spokes_are_where_hands_would_be_is_refused_by_its_spokes():
    def spoked(spokes: int) -> Valve:
        return made(0.15, "rim", spokes=spokes, marker=MarkerConfig(size=[0.06, 0.06], face=0.07))

    with pytest.raises(ConfigError, match=r"valve.spokes must be fewer, or farther from valve.handles\[0\]: .*got 5"):
        check(spoked(5))
    check(spoked(4))


def test_a_panel_that_hands_touch_is_refused_with_the_least_depth_which_will_do():
    refusal = (
        r"valve\.panel\.depth must be at least (0\.0\d+): an open hand at valve\.handles\[0\] touches the panel or is "
        r"nearer than collision\.padding, got 0\.025"
    )
    least_told(refusal, lambda depth: made(0.15, panel=PanelConfig(depth=depth)), 0.025)


def test_fingers_that_do_not_go_round_a_handle_are_the_robots_fault(tmp_path):
    """A hand has a shape where it is to hold: no other place of the handle would help."""
    knob = ElementTree.fromstring("""<collision name="knob"><pose>0 0 0.14 0 0 0</pose><geometry><sphere>
        <radius>0.01</radius></sphere></geometry></collision>""")
    path = variant(tmp_path, lambda model: [part(model, "link", f"{side}_hand").append(knob) for side in SIDES])
    robot = Robot.load(path, VALVE)
    with pytest.raises(ConfigError) as error:
        check_handles(CollisionModel(robot), VALVE, robot.opening)
    assert str(error.value) == (
        "opening must be wider, or frames.left_grip and pad.at between the fingers' shapes: an open hand at "
        "valve.handles[0], 0.025 m wide, touches what it is to hold (bar) or is nearer than collision.padding, "
        "got 0.085"
    )


def test_two_hands_need_two_handles_that_they_can_be_at():
    """A third one that nobody can hold does not matter."""
    valve = made(0.15)
    valve.handles.append(HandleConfig(xyz=[0.0, 0.06, 0.0]))
    check(valve)


def test_a_program_with_such_a_valve_does_not_start():
    handles = "[{xyz: [0.06, 0, 0]}, {xyz: [-0.06, 0, 0]}]"
    scenario = scenarios.load(None, ["seed=1", "valve.model=''", f"valve.handles={handles}"])
    with pytest.raises(ConfigError, match=r"valve.handles\[0\].xyz must be at least"):
        make_blocks(scenarios.resolve(scenario))
