"""collision: what the controllers' own model of robot, valve and panel calls free."""

import numpy as np
import pytest
from robot_facts import ARMS_HOME as HOME
from robot_facts import ROBOT
from robot_variants import variant

from valve_drake.behaviors.grasp_geometry import Turn, standoff
from valve_drake.behaviors.stance_config import StanceConfig
from valve_drake.behaviors.stance_search import Stances
from valve_drake.checks import ConfigError
from valve_drake.collision import CollisionModel
from valve_drake.frames import compose, inverse, make, planar
from valve_drake.messages import SIDES
from valve_drake.robot.robot import Robot
from valve_drake.stations.scene import panel_pose
from valve_drake.stations.simulation_config import ValveConfig
from valve_drake.valve.valve import Valve, turned

VALVE = Valve()
ON_BAR = (0.0, 0.03, 0.0)  # off the handle, in the hand: a finger touches the bar [m]
STRAIGHT = dict.fromkeys(SIDES, np.array([0.0, 0, 1]))


def stances(config: StanceConfig) -> Stances:
    return Stances(ROBOT, VALVE, config, STRAIGHT, lambda *_: True)


@pytest.fixture(scope="module")
def model():
    return CollisionModel(ROBOT)


@pytest.fixture(scope="module")
def X_BA():
    X_OA = compose(panel_pose(ValveConfig(height=1.0)), inverse(VALVE.X_AP()))
    config = StanceConfig(distance_min=0.7, distance_max=0.78)
    place, margin = stances(config).find(X_OA, np.pi / 2)
    assert margin > 0.5
    return compose(inverse(planar(*place.base)), X_OA)


def arms(X_BA: np.ndarray, *, back: float = 0.0, aside=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Both hands on their handles, drawn back from the panel by `back` and moved by `aside` (in the hand) [m]."""
    arc = stances(StanceConfig()).best_arc(Turn(X_BA, np.pi / 2))
    q = []
    for side, near in arc.q.items():
        X_BG = standoff(
            compose(X_BA, VALVE.grasp(arc.grasps[side].handle, arc.grasps[side].sign)), STRAIGHT[side], back
        )
        q.append(ROBOT.inverse(side, make(X_BG[:, :3], X_BG[:, 3] + X_BG[:, :3] @ aside), near))
    return np.concatenate(q)


def test_home_is_free_with_and_without_a_valve(model, X_BA):
    assert model.is_free(None, HOME)
    assert model.is_free(X_BA, HOME)
    assert model.touching(X_BA, HOME) == []


def test_hands_before_the_handles_are_free(model, X_BA):
    for back in (0.08, 0.12, 0.16):
        assert model.is_free(X_BA, arms(X_BA, back=back)), model.touching(X_BA, arms(X_BA, back=back))


def test_open_fingers_fit_round_the_bar_with_the_same_room_on_both_sides(X_BA):
    """Robot, valve and grasp agree to the millimetre: (85 - 25) / 2 from every pad to the bar."""
    wide = CollisionModel(ROBOT, 0.05, opening=0.085)
    rows = [line for line in wide.touching(X_BA, arms(X_BA)) if "::pad" in line and "::bar" in line]
    assert len(rows) == 24 and all(row.endswith(": 30 mm") for row in rows)


def test_a_finger_on_the_bar_is_not_free(model, X_BA):
    q = arms(X_BA, aside=ON_BAR)
    assert not model.is_free(X_BA, q)
    names = "\n".join(model.touching(X_BA, q))
    assert "bar" in names and "pad" in names
    assert model.is_free(None, q)  # without the valve it is


def test_fingers_less_open_have_less_room(X_BA):
    assert not CollisionModel(ROBOT, opening=0.04).is_free(X_BA, arms(X_BA))


def test_one_hand_is_enough(model, X_BA):
    q = arms(X_BA, aside=ON_BAR)
    for k in range(2):
        one = HOME.copy()
        one[6 * k : 6 * k + 6] = q[6 * k : 6 * k + 6]
        assert not model.is_free(X_BA, one)
        assert model.is_free(None, one)


def test_a_hand_in_the_panel_is_not_free(model, X_BA):
    q = arms(X_BA, back=-0.09, aside=(0.0, 0.10, 0.0))  # beside the bar, too deep
    names = "\n".join(model.touching(X_BA, q))
    assert not model.is_free(X_BA, q)
    assert "plate" in names


def test_hands_that_touch_each_other_are_not_free(model):
    q = np.zeros(12)
    q[[1, 7]] = -0.3, 0.3  # both arms inward
    assert not model.is_free(None, q)


def test_clearance_is_the_distance_that_counts(X_BA):
    """The same pose, nearer than one clearance and further than the other."""
    q = arms(X_BA, back=0.05)
    distances = [float(line.split(": ")[1].split(" ")[0]) for line in CollisionModel(ROBOT, 0.2).touching(X_BA, q)]
    least = min(distances) / 1e3
    assert 0.012 < least < 0.2
    assert not CollisionModel(ROBOT, least + 0.005).is_free(X_BA, q)
    assert CollisionModel(ROBOT, least - 0.005).is_free(X_BA, q)


def test_the_bar_turns_with_the_marker(model, X_BA):
    q = arms(X_BA, aside=ON_BAR)
    assert not model.is_free(X_BA, q)
    assert model.is_free(turned(X_BA, np.pi / 4), q)
    assert not model.is_free(turned(X_BA, np.pi), q)


def test_every_question_is_answered_afresh(model, X_BA):
    q = arms(X_BA, aside=ON_BAR)
    answers = [model.is_free(X, p) for X, p in ((X_BA, q), (None, q), (X_BA, HOME), (X_BA, q), (None, HOME))]
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
        model = CollisionModel(robot)
        free[ignore] = model.is_free(None, robot.home)
        inwards = np.zeros(12)
        inwards[[1, 7]] = -0.3, 0.3
        assert not model.is_free(None, inwards)  # other parts of the arms
    assert free == {"": False, "touching_at_home": True}


SRDF = """<robot name="r">
  <disable_collisions link1="left_forearm" link2="right_forearm" reason="Never"/>
  <disable_collisions link1="left_hand" link2="no_such_link" reason="Never"/>
</robot>"""


def test_the_pairs_of_an_srdf_are_not_looked_at(tmp_path):
    crossed = np.zeros(12)
    crossed[[1, 7]] = -0.3, 0.3
    touching = {}
    for name, text in (("without", "<robot/>"), ("with", SRDF)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "r.srdf").write_text(text)
        robot = Robot.load(variant(folder, change=lambda given: given.update(collision={"srdf": "r.srdf"})))
        model = CollisionModel(robot)
        touching[name] = {frozenset((model._link(p.id_A), model._link(p.id_B))) for p in model._near(None, crossed)}
    forearms = frozenset({"left_forearm", "right_forearm"})
    assert touching["without"] - touching["with"] == {forearms}


def test_a_file_that_is_no_srdf_is_refused_in_one_line(tmp_path):
    (tmp_path / "r.srdf").write_text("no xml")
    robot = Robot.load(variant(tmp_path, change=lambda given: given.update(collision={"srdf": "r.srdf"})))
    with pytest.raises(ConfigError, match="collision.srdf must be an SRDF file, got 'r.srdf'"):
        CollisionModel(robot)


@pytest.mark.parametrize("side", SIDES)
def test_what_an_open_hand_touches_does_not_depend_on_where_the_arm_is(side, model):
    grasp = VALVE.grasp(0, 1.0)
    assert model.at_handle(side, grasp) == []
    assert model.at_handle(side, make(grasp[:, :3], grasp[:, 3] + grasp[:, :3] @ ON_BAR)) == ["bar"]
    assert model.at_handle(side, make(grasp[:, :3], grasp[:, 3] * 0.4)) != []
