"""collision: what the controllers' own model of robot, valve and panel calls free."""

import numpy as np
import pytest
from robot_facts import ARMS_HOME as HOME
from robot_facts import ROBOT
from robot_variants import variant

from valve_drake.behaviors.grasp_geometry import StanceConfig, Stances, hand_in_valve, standoff, turned
from valve_drake.collision import CollisionModel
from valve_drake.frames import compose, inverse, make, planar
from valve_drake.messages import SIDES
from valve_drake.perception.marker import Marker
from valve_drake.robot.robot import Robot
from valve_drake.stations.scene import panel_pose
from valve_drake.stations.simulation_config import ValveConfig

MARKER = Marker()
ON_BAR = (0.0, 0.03, 0.0)  # off the handle, in the hand: a finger touches the bar [m]
STRAIGHT = dict.fromkeys(SIDES, np.array([0.0, 0, 1]))


def stances(config: StanceConfig) -> Stances:
    return Stances(ROBOT, MARKER, config, STRAIGHT, lambda *_: True)


@pytest.fixture(scope="module")
def model():
    return CollisionModel(ROBOT, MARKER)


@pytest.fixture(scope="module")
def X_BV():
    X_OV = compose(panel_pose(ValveConfig(height=1.0)), make(np.eye(3), np.array([0, 0, -MARKER.panel_depth])))
    config = StanceConfig(distance_min=0.7, distance_max=0.78)
    place, margin = stances(config).find(X_OV, np.pi / 2)
    assert margin > 0.5
    return compose(inverse(planar(*place.base)), X_OV)


def arms(X_BV: np.ndarray, *, back: float = 0.0, aside=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Both hands on their handles, drawn back from the panel by `back` and moved by `aside` (in the hand) [m]."""
    arc = stances(StanceConfig()).best_arc(X_BV, np.pi / 2)
    q = []
    for side, near in arc.q.items():
        X_BG = standoff(compose(X_BV, hand_in_valve(side, arc.swapped, MARKER)), STRAIGHT[side], back)
        q.append(ROBOT.inverse(side, make(X_BG[:, :3], X_BG[:, 3] + X_BG[:, :3] @ aside), near))
    return np.concatenate(q)


def test_home_is_free_with_and_without_a_valve(model, X_BV):
    assert model.is_free(None, HOME)
    assert model.is_free(X_BV, HOME)
    assert model.touching(X_BV, HOME) == []


def test_hands_before_the_handles_are_free(model, X_BV):
    for back in (0.08, 0.12, 0.16):
        assert model.is_free(X_BV, arms(X_BV, back=back)), model.touching(X_BV, arms(X_BV, back=back))


def test_open_fingers_fit_round_the_bar_with_the_same_room_on_both_sides(X_BV):
    """Robot, valve and grasp agree to the millimetre: (85 - 25) / 2 from every pad to the bar."""
    wide = CollisionModel(ROBOT, MARKER, 0.05, opening=0.085)
    rows = [line for line in wide.touching(X_BV, arms(X_BV)) if "::pad" in line and "::bar" in line]
    assert len(rows) == 24 and all(row.endswith(": 30 mm") for row in rows)


def test_a_finger_on_the_bar_is_not_free(model, X_BV):
    q = arms(X_BV, aside=ON_BAR)
    assert not model.is_free(X_BV, q)
    names = "\n".join(model.touching(X_BV, q))
    assert "bar" in names and "pad" in names
    assert model.is_free(None, q)  # without the valve it is


def test_fingers_less_open_have_less_room(X_BV):
    assert not CollisionModel(ROBOT, MARKER, opening=0.04).is_free(X_BV, arms(X_BV))


def test_one_hand_is_enough(model, X_BV):
    q = arms(X_BV, aside=ON_BAR)
    for k in range(2):
        one = HOME.copy()
        one[6 * k : 6 * k + 6] = q[6 * k : 6 * k + 6]
        assert not model.is_free(X_BV, one)
        assert model.is_free(None, one)


def test_a_hand_in_the_panel_is_not_free(model, X_BV):
    q = arms(X_BV, back=-0.09, aside=(0.0, 0.10, 0.0))  # beside the bar, too deep
    names = "\n".join(model.touching(X_BV, q))
    assert not model.is_free(X_BV, q)
    assert "plate" in names


def test_hands_that_touch_each_other_are_not_free(model):
    q = np.zeros(12)
    q[[1, 7]] = -0.3, 0.3  # both arms inward
    assert not model.is_free(None, q)


def test_clearance_is_the_distance_that_counts(X_BV):
    """The same pose, nearer than one clearance and further than the other."""
    q = arms(X_BV, back=0.05)
    distances = [
        float(line.split(": ")[1].split(" ")[0]) for line in CollisionModel(ROBOT, MARKER, 0.2).touching(X_BV, q)
    ]
    least = min(distances) / 1e3
    assert 0.012 < least < 0.2
    assert not CollisionModel(ROBOT, MARKER, least + 0.005).is_free(X_BV, q)
    assert CollisionModel(ROBOT, MARKER, least - 0.005).is_free(X_BV, q)


def test_the_bar_turns_with_the_marker(model, X_BV):
    q = arms(X_BV, aside=ON_BAR)
    assert not model.is_free(X_BV, q)
    assert model.is_free(turned(X_BV, np.pi / 4), q)
    assert not model.is_free(turned(X_BV, np.pi), q)


def test_every_question_is_answered_afresh(model, X_BV):
    q = arms(X_BV, aside=ON_BAR)
    answers = [model.is_free(X, p) for X, p in ((X_BV, q), (None, q), (X_BV, HOME), (X_BV, q), (None, HOME))]
    assert answers == [False, True, True, False, True]


def test_what_touches_at_home_may_touch_if_the_robot_says_so(tmp_path):
    crossed = {"left": [0, -1.2, 0, 0, 0, 0], "right": [0, 1.2, 0, 0, 0, 0]}

    def make_home(given, ignore):
        for side, home in crossed.items():
            given["arms"][side]["home"] = home
        given["collision"] = {"ignore": ignore}

    free = {}
    for ignore in ("", "touching_at_home"):
        robot = Robot.load(variant(tmp_path / ignore, change=lambda given, ignore=ignore: make_home(given, ignore)))
        model = CollisionModel(robot, MARKER)
        free[ignore] = model.is_free(None, robot.home)
        inwards = np.zeros(12)
        inwards[[1, 7]] = -0.3, 0.3
        assert not model.is_free(None, inwards)  # other parts of the arms
    assert free == {"": False, "touching_at_home": True}
