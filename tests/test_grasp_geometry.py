"""grasp_geometry: grasps fixed to the valve, the sign of the turn, and stances that serve the whole range of valves."""

import dataclasses as dc

import numpy as np
import pytest
from robot_facts import ROBOT

from valve_drake import resources
from valve_drake.behaviors import arc_search
from valve_drake.behaviors.grasp_geometry import Turn, pairs, standoff
from valve_drake.behaviors.questions import UNITS, Questions
from valve_drake.behaviors.stance_config import MAX_PLACES, StanceConfig
from valve_drake.behaviors.stance_search import FEW, Stances
from valve_drake.behaviors.taught import load_taught
from valve_drake.checks import ConfigError
from valve_drake.frames import apply, compose, inverse, make, planar, rotation, wrap
from valve_drake.messages import SIDES
from valve_drake.robot import description
from valve_drake.robot.robot import Robot
from valve_drake.stations.scene import panel_pose
from valve_drake.stations.simulation_config import ValveConfig
from valve_drake.valve.valve import HandleConfig, Valve, angle_turned, turned

VALVE = Valve()
CONFIG = StanceConfig()
VIEW = {side: taught.view for side, taught in load_taught(resources.models() / "taught" / "hands.yaml").items()}


def valve_at(height: float, tilt: float = 0.0, bar: float = 0.0, *, yaw: float = 0.3) -> np.ndarray:
    """X_OA of a valve [m, deg] whose bar stands at `bar` from level; it stands somewhere in the room."""
    X_WP = panel_pose(ValveConfig(height=height, tilt=np.deg2rad(tilt), yaw=yaw))
    return turned(compose(planar(2.0, 0.4, 0.0), X_WP, inverse(VALVE.X_AP())), np.deg2rad(bar))


def stances(is_free=lambda *_: True, **changes) -> Stances:
    return Stances(ROBOT, VALVE, dc.replace(CONFIG, **changes), VIEW, is_free)


def stance(X_OA: np.ndarray, turn: float, **changes):
    place, margin = stances(**changes).find(X_OA, np.deg2rad(turn))
    assert place.posture is None  # this robot has no lift
    return place.base, margin


def test_a_robot_that_is_bolted_down_asks_only_of_where_it_stands():
    X_OA = valve_at(1.0)
    base, margin = stance(X_OA, 90)
    here = compose(inverse(planar(*base)), X_OA)  # the valve as it is for a robot that stands there
    where, found = dc.replace(stances(), bolted=True).find(here, np.deg2rad(90))
    assert where.base.tolist() == [0, 0, 0] and found == pytest.approx(margin, abs=0.05)
    away = compose(planar(0.4, 0.0, 0.0), here)
    assert dc.replace(stances(), bolted=True).find(away, np.deg2rad(90))[1] < 0


# ---------------------------------------------------------------- the turn's sign


def test_positive_turns_counter_clockwise_as_seen_from_the_robot():
    X_BA = compose(inverse(planar(1.2, 0.4, 0.0)), valve_at(1.0, yaw=0.0))  # x_V to the right, z_V forward
    tip = apply(turned(X_BA, 0.3), np.array([0.15, 0, 0]))  # the right end of the bar
    assert tip - X_BA[:, 3] == pytest.approx(0.15 * np.array([0, -np.cos(0.3), np.sin(0.3)]))  # goes up
    R = X_BA[:, :3].T @ turned(X_BA, 0.3)[:, :3]
    assert R == pytest.approx(rotation(np.array([0, 0, -0.3])))  # about -z of A


@pytest.mark.parametrize("angle", [-3.0, -np.pi / 2, -0.01, 0.0, 0.4, 1.5, 3.1])
def test_angle_turned_measures_what_turned_turns(angle):
    rng = np.random.default_rng(1)
    X = make(rotation(rng.normal(size=3)), rng.normal(size=3))
    assert angle_turned(X, turned(X, angle)) == pytest.approx(angle)
    assert angle_turned(turned(X, angle), X) == pytest.approx(-angle)
    assert np.array_equal(turned(X, angle)[:, 3], X[:, 3])


def test_angle_turned_is_not_moved_by_errors_of_the_axis():
    rng = np.random.default_rng(2)
    X = valve_at(1.0)
    for _ in range(50):
        w = rng.normal(size=3) * [0.1, 0.1, 0]
        seen = make(turned(X, 1.5)[:, :3] @ rotation(w), X[:, 3] + rng.normal(size=3) * 0.01)
        assert angle_turned(X, seen) == pytest.approx(1.5, abs=1e-9)


# ---------------------------------------------------------------- the grasps


@pytest.mark.parametrize("handle", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_hands_hold_the_marked_ends_of_the_bar_either_way_round(handle, sign):
    X_AG = VALVE.grasp(handle, sign)
    outwards = np.array([1.0 - 2 * handle, 0, 0])
    assert X_AG[:, 3] == pytest.approx(0.15 * outwards)
    assert X_AG[:, 2] == pytest.approx([0, 0, 1])  # approaches into the panel
    assert X_AG[:, 0] == pytest.approx(sign * outwards)
    assert abs(X_AG[1, 1]) == 1  # closes across the bar
    assert np.linalg.det(X_AG[:, :3]) == pytest.approx(1)


def test_hand_poses_are_constant_in_the_valve_while_it_turns():
    """A rigid turn of valve and hands about the valve's axis, worked out in the room."""
    X_BA = compose(inverse(planar(1.2, 0.4, 0.3)), valve_at(1.1, tilt=7, bar=5))
    for k in (0, 1):
        X_BG = compose(X_BA, VALVE.grasp(k, 1.0))
        for angle in (-0.7, 0.2, 1.57):
            turn = rotation(-angle * X_BA[:, 2])  # positive opens: about -z of A
            moved = make(turn @ X_BG[:, :3], X_BA[:, 3] + turn @ (X_BG[:, 3] - X_BA[:, 3]))
            assert compose(inverse(turned(X_BA, angle)), moved) == pytest.approx(VALVE.grasp(k, 1.0))


def test_standoff_draws_back_along_the_cameras_view_and_keeps_the_orientation():
    X = make(rotation(np.array([0.3, -0.2, 0.5])), np.array([0.7, 0.1, 0.0]))
    view = VIEW["left"]
    back = standoff(X, view, 0.12)
    assert np.array_equal(back[:, :3], X[:, :3])
    assert X[:, :3].T @ (X[:, 3] - back[:, 3]) == pytest.approx(0.12 * view)
    assert view[2] > 0.7  # mostly against the approach: away from the panel


# ---------------------------------------------------------------- stances


@pytest.mark.parametrize("height", [0.81, 1.0, 1.22])
@pytest.mark.parametrize("tilt", [-10, 0, 10])
@pytest.mark.parametrize("bar, turn", [(-10, 90), (10, 90), (90, -90)])
def test_a_comfortable_stance_exists_over_the_whole_range(height, tilt, bar, turn):
    X_OA = valve_at(height, tilt, bar)
    base, margin = stance(X_OA, turn)
    assert margin > 0.5
    # square to the panel, on the axis' line, at a distance that was asked for
    assert wrap(base[2] - 0.3) == pytest.approx(0, abs=1e-9)
    axis = compose(X_OA, VALVE.X_AP())[:2, 3]
    off = axis - base[:2]
    forward = np.array([np.cos(base[2]), np.sin(base[2])])
    assert off @ [-forward[1], forward[0]] == pytest.approx(0, abs=1e-9)
    assert ROBOT.stand[0] - 1e-9 <= off @ forward <= ROBOT.stand[1] + 1e-9
    # and it holds what it says, along the arc at a finer step
    X_BA = compose(inverse(planar(*base)), X_OA)
    fine = stances(arc_step=0.02).best_arc(Turn(X_BA, np.deg2rad(turn)))
    assert fine.margin > margin - 0.1


def test_a_stance_is_bit_by_bit_the_same_twice():
    X_OA = valve_at(1.1, 5, 3)
    few = {"distance_min": 0.70, "distance_max": 0.76}
    a, b = stance(X_OA, 90, **few), stance(X_OA, 90, **few)
    assert a[0].tobytes() == b[0].tobytes() and a[1] == b[1]


@pytest.mark.parametrize("height", [0.2, 1.9])
def test_a_valve_out_of_reach_has_no_stance(height):
    assert stance(valve_at(height), 90)[1] < 0


@pytest.mark.parametrize("turn", [180, -180, 360, 720])
def test_a_turn_that_one_grasp_does_not_reach_is_made_of_several(turn):
    X_OA = valve_at(1.0)
    base, margin = stance(X_OA, turn, distance_min=0.72, distance_max=0.76)
    assert margin > 0.15
    dut, left, X_BA = stances(), np.deg2rad(turn), compose(inverse(planar(*base)), X_OA)
    assert dut.best_arc(Turn(X_BA, left)).turn != pytest.approx(left)
    arcs = []
    while abs(left) > 1e-9:
        arcs.append(dut.best_arc(Turn(X_BA, left)))
        X_BA, left = turned(X_BA, arcs[-1].turn), left - arcs[-1].turn
        assert len(arcs) <= 12
    assert all(arc.margin >= CONFIG.margin_min for arc in arcs)
    assert len(arcs) <= abs(turn) / 90 + 1
    assert any(a.grasps["left"].handle != b.grasps["left"].handle for a, b in zip(arcs, arcs[1:]))  # ends are swapped


def test_the_arc_says_where_it_starts_and_that_the_whole_of_it_is_reached():
    X_OA = valve_at(1.0)
    base, _ = stance(X_OA, 90, distance_min=0.70, distance_max=0.76)
    X_BA = compose(inverse(planar(*base)), X_OA)
    arc = stances().best_arc(Turn(X_BA, np.pi / 2))
    for side, q in arc.q.items():
        X_BG = ROBOT.forward(side, q)
        assert X_BG == pytest.approx(
            compose(X_BA, VALVE.grasp(arc.grasps[side].handle, arc.grasps[side].sign)), abs=1e-6
        )
    # too near and too far are worse, and further it is out of reach
    margins = [
        stances().best_arc(Turn(compose(make(np.eye(3), np.array([d, 0, 0])), X_BA), np.pi / 2)).margin
        for d in (0.0, 0.12, 0.20, 0.40)
    ]
    assert 0 < margins[0] < margins[1] > margins[2] and margins[3] == -1


def searched(dut: Stances, search):
    """The search at its end, and how many portions it took."""
    portions = 0
    while not search.done:
        search, portions = dut.advance(search), portions + 1
    return search, portions


@pytest.mark.system
def test_a_place_that_took_long_to_find_is_tried_first_when_the_valve_is_measured_again():
    """Of a valve that lies flat, where no place is comfortable, the whole of the search is made but once."""
    dut = stances(distance_min=0.5, distance_max=0.54)
    X_OA, viewer = valve_at(0.75, tilt=90.0), np.array([0.7, 0.4])
    first, long = searched(dut, dut.begin(X_OA, np.pi / 2, viewer))
    assert CONFIG.margin_min < first.margin < CONFIG.margin_good
    again = make(X_OA[:, :3], X_OA[:, 3] + [0.01, -0.02, 0.0])
    second, short = searched(dut, dut.begin(again, np.pi / 2, viewer, first))
    assert short < long / 5
    assert second.best.base == pytest.approx(first.best.base + [0.01, -0.02, 0.0])
    assert second.margin == pytest.approx(first.margin, abs=0.01)
    # where it serves no longer, all is searched
    blocked = stances(
        lambda X_BA, q, posture=None: X_BA is None or X_BA[2, 3] < 0.7, distance_min=0.5, distance_max=0.54
    )
    third, steps = searched(blocked, blocked.begin(again, np.pi / 2, viewer, first))
    assert third.margin < 0 and steps > short


def test_the_place_before_stays_where_it_is_when_the_markers_other_end_is_taken_for_its_x():
    """A robot that drives round a valve that lies flat sees it from another side."""
    dut = stances(distance_min=0.5, distance_max=0.54)
    X_OA = valve_at(0.75, tilt=90.0)
    found, _ = searched(dut, dut.begin(X_OA, np.pi / 2, np.array([0.7, 0.4])))
    assert dut.moved(found, turned(X_OA, np.pi), np.pi / 2) == pytest.approx(found.best.base)
    assert dut.moved(found, turned(X_OA, -np.pi + 0.01), np.pi / 2) == pytest.approx(found.best.base)
    assert dut.moved(found, turned(X_OA, np.pi / 2), np.pi / 2) is None  # handles where there were none


def test_the_place_before_turns_with_the_heading_of_the_valve():
    """A valve in a corner, turned from a step aside."""
    X_OA = valve_at(1.0)
    left = np.array([-np.sin(0.3), np.cos(0.3)])

    def is_free(X_BA, q, posture=None):
        return X_BA is None or X_BA[1, 3] < -0.05  # only from the left of the valve

    dut = stances(is_free, distance_min=0.7, distance_max=0.78)
    first, long = searched(dut, dut.begin(X_OA, np.pi / 2, np.zeros(2)))
    assert first.found_in == 1 and (first.best.base[:2] - X_OA[:2, 3]) @ left > 0.1
    yawed = compose(make(rotation(np.array([0, 0, 0.05])), np.array([0.0, 0, 0])), X_OA)
    second, short = searched(dut, dut.begin(yawed, np.pi / 2, np.zeros(2), first))
    assert short < long
    before = compose(inverse(planar(*first.best.base)), X_OA)
    assert compose(inverse(planar(*second.best.base)), yawed) == pytest.approx(before, abs=1e-9)


def test_handles_are_shared_the_better_way():
    """A valve turned by half a turn looks the same with its ends exchanged: the hands must not cross."""
    X_BA = compose(inverse(planar(1.2, 0.4, 0.3)), valve_at(1.0))
    straight = stances().best_arc(Turn(X_BA, np.pi / 2))
    other = stances().best_arc(Turn(turned(X_BA, np.pi), np.pi / 2))
    assert straight.grasps["left"].handle == other.grasps["right"].handle == 1
    assert all(straight.q[side] == pytest.approx(other.q[side]) for side in SIDES)
    crossed = stances().check_arc(
        Turn(X_BA, np.pi / 2), {"left": straight.grasps["right"], "right": straight.grasps["left"]}
    )
    assert crossed.margin < straight.margin


@pytest.mark.parametrize(
    "changes", [{"distance_min": 0.2}, {"distance_max": 4.0}, {"arc_step": 0.0}, {"standoff": float("nan")}]
)
def test_bad_config_is_refused_by_name(changes):
    with pytest.raises(ConfigError, match=f"stance.{next(iter(changes))}"):
        StanceConfig(**changes).check()


@pytest.mark.parametrize("changes", [{"distance_min": 0.9}, {"distance_step": 0.005, "distance_max": 1.2}])
def test_distances_that_the_robot_does_not_have_are_refused_by_name(changes):
    with pytest.raises(ConfigError, match=f"stance.{next(iter(changes))} must be at"):
        stances(**changes)


def test_arms_that_reach_far_are_tried_at_as_many_distances_as_there_may_be():
    tried = StanceConfig().distances((0.6, 1.9))
    assert len(tried) == MAX_PLACES and tried[[0, -1]] == pytest.approx([0.6, 1.9])
    assert StanceConfig().distances((0.7, 0.84)) == pytest.approx(np.arange(0.7, 0.85, 0.02))
    with pytest.raises(ConfigError, match=r"stance.distance_step must be at least 0.0333: 40 distances, got 0.03"):
        StanceConfig(distance_step=0.03).distances((0.6, 1.9))


def test_hands_never_hold_two_handles_of_which_one_is_before_the_other():
    """The line between them, along the axis, would not tell how the valve is turned."""
    handles = [HandleConfig(xyz=place) for place in ([0.15, 0.0, 0.0], [0.15, 0.0, -0.2], [-0.15, 0.0, 0.0])]
    valve = dc.replace(VALVE, model="", handles=handles)
    held = {(pair["left"].handle, pair["right"].handle) for group in pairs(valve, valve_at(1.0), 1.0) for pair in group}
    assert held == {(0, 2), (2, 0), (1, 2), (2, 1)}


def rim(count: int, radius: float) -> Valve:
    angles = 2 * np.pi * np.arange(count) / count
    handles = [HandleConfig(kind="rim", xyz=[radius * np.cos(a), radius * np.sin(a), 0]) for a in angles]
    return dc.replace(VALVE, model="", handles=handles)


@pytest.mark.parametrize("height, radius, turn", [(1.55, 0.34, 1.3), (0.6, 0.3, -1.7)])
def test_a_wheel_too_high_or_too_low_for_hands_wide_apart_is_held_where_both_reach(height, radius, turn):
    valve = rim(12, radius)
    X_OA = compose(panel_pose(ValveConfig(height=height)), inverse(valve.X_AP()))
    search = Stances(ROBOT, valve, CONFIG, VIEW, lambda *_: True)
    margins = []
    for groups in (slice(0, 1), slice(2, 3)):
        turns = [Turn(compose(inverse(planar(-d, 0, 0)), X_OA), turn) for d in (0.70, 0.77, 0.84)]
        some = [(at, pair) for at in turns for group in list(pairs(valve, at.X_BA, turn))[groups] for pair in group]
        margins.append(max(search.check_arc(at, pair).margin for at, pair in some))
    assert margins[0] < CONFIG.margin_min < CONFIG.margin_good < margins[1]


@pytest.mark.parametrize("count, tried", [(2, 2), (3, 6), (5, 16), (12, 21)])
def test_however_many_handles_there_are_few_pairs_are_tried_and_each_once(count, tried):
    valve = rim(count, 0.15)
    groups = list(pairs(valve, compose(inverse(planar(1.2, 0.4, 0.3)), valve_at(1.0)), 1.0))
    assert [len(group) for group in groups[1::2]] == [3 * len(group) for group in groups[::2]]  # fingers otherwise
    handles = [(pair["left"].handle, pair["right"].handle) for group in groups[::2] for pair in group]
    assert len(set(handles)) == len(handles) == tried


def test_a_robot_that_does_not_say_where_it_stands_tries_from_its_footprint_to_its_reach():
    pr2 = Robot.load(description.find("pr2/pr2.robot.yaml"))
    near, far = pr2.stand
    assert near == pytest.approx(np.hypot(0.34, 0.34) + 0.2)
    assert pr2.forward("left", pr2.arms["left"].work)[0, 3] < far < 1.0
    assert ROBOT.stand == (0.70, 0.84)


def test_arms_that_touch_something_where_they_draw_back_have_no_stance():
    X_OV = valve_at(1.0)
    base, _ = stance(X_OV, 90, distance_min=0.76, distance_max=0.78)
    X_BA = compose(inverse(planar(*base)), X_OV)
    arc = stances().best_arc(Turn(X_BA, np.pi / 2))
    back = np.concatenate([arc.q_standoff[side] for side in SIDES])
    blocked = stances(lambda X_BA, q, posture=None: not np.allclose(q, back))
    assert arc.margin > 0.5
    assert blocked.check_arc(Turn(X_BA, np.pi / 2), arc.grasps).margin == -1


@pytest.mark.parametrize("share", [0.0, 1 / 6, 0.5, 5 / 6, 1.0])
def test_arms_that_touch_anywhere_along_the_turn_cannot_make_it(share):
    X_OA = valve_at(1.0)
    base, _ = stance(X_OA, 90, distance_min=0.76, distance_max=0.78)
    X_BA = compose(inverse(planar(*base)), X_OA)
    there = turned(X_BA, share * np.pi / 2)
    arc = stances().best_arc(Turn(X_BA, np.pi / 2))
    blocked = stances(lambda X_BA, q, posture=None: not np.allclose(X_BA, there))
    assert arc.margin > 0.5
    assert blocked.check_arc(Turn(X_BA, np.pi / 2), arc.grasps).margin == -1


def test_a_redundant_arm_that_is_not_comfortable_begins_from_other_postures_too():
    pr2 = Robot.load(description.find("pr2/pr2.robot.yaml"))
    X_OA = compose(panel_pose(ValveConfig(height=1.22)), inverse(VALVE.X_AP()))
    X_BA, high = compose(inverse(planar(-0.88, 0, 0)), X_OA), pr2.posture.high
    search = Stances(pr2, VALVE, CONFIG, VIEW, lambda *_: True)
    turn = Turn(X_BA, np.pi / 2, high)
    arc = search.best_arc(turn)
    angles = np.linspace(0, np.pi / 2, 7)
    first = [min(search._follow(turn, angles, side, arc.grasps[side], None, -1.0, Questions())[1]) for side in SIDES]
    assert min(first) < 0.2 < 0.25 < arc.margin


def test_a_redundant_arms_search_asks_little_in_a_portion_and_finds_the_same(monkeypatch):
    """Robot and collision checker are asked at most UNITS questions in one, however long the whole takes."""
    pr2, asked = Robot.load(description.find("pr2/pr2.robot.yaml")), []

    class Counted:
        def __getattr__(self, name):
            return getattr(pr2, name)

        def inverse(self, *args):
            asked.append("inverse")
            return pr2.inverse(*args)

    def is_free(*_):
        asked.append("free")
        return True

    search = Stances(Counted(), VALVE, CONFIG, VIEW, is_free)
    X_OA = compose(panel_pose(ValveConfig(height=1.1)), inverse(VALVE.X_AP()))
    X_BA = compose(inverse(planar(-0.88, 0, 0)), X_OA)

    def best():
        state, most = search.begin_arc(Turn(X_BA, np.pi / 2)), 0
        while not state.done:
            before = len(asked)
            state = search.advance_arc(state)
            most = max(most, len(asked) - before)
        return state.best, most

    cut, most = best()
    monkeypatch.setattr(arc_search, "UNITS", np.inf)
    whole, all_of_a_pair = best()
    assert most <= UNITS < all_of_a_pair
    assert cut.margin == whole.margin and cut.way["left"].tolist() == whole.way["left"].tolist()


def test_where_a_robot_may_stand_at_many_distances_a_few_are_tried_first():
    wide = stances(distance_min=0.6, distance_max=1.2)
    search = wide.begin(valve_at(1.0), np.pi / 2, np.zeros(2))
    first, last = search.places[0], search.places[search.dense]
    assert len(first) <= FEW < len(last) == 31
    assert {tuple(place.base) for place in first} <= {tuple(place.base) for place in last}
    narrow = stances().begin(valve_at(1.0), np.pi / 2, np.zeros(2))
    assert narrow.dense == len(narrow.places)


@pytest.mark.system
def test_places_between_are_tried_where_none_of_the_few_serves():
    X_OA = valve_at(1.0)
    wide = stances(distance_min=0.6, distance_max=1.2)
    search = wide.begin(X_OA, np.pi / 2, np.zeros(2))
    few = [np.linalg.norm(place.base[:2] - search.places[0][0].base[:2]) for place in search.places[0]]
    nearest, step = compose(inverse(planar(*search.places[0][0].base)), X_OA)[0, 3], few[1]

    def between(X_BA, q, posture=None):  # only half-way between two of the few the arms are free
        return abs((nearest - X_BA[0, 3]) / step % 1.0 - 0.5) < 0.2

    place, margin = stances(between, distance_min=0.6, distance_max=1.2, aside=0.0).find(X_OA, np.pi / 2)
    assert margin >= CONFIG.margin_min and place.base.tolist() not in [p.base.tolist() for p in search.places[0]]


@pytest.mark.system
def test_grasps_that_do_not_follow_a_turn_to_its_end_turn_as_far_as_they_reach():
    X_OA = valve_at(1.0)
    place, _ = stances(distance_min=0.72, distance_max=0.76).find(X_OA, 1.5)
    X_BA = compose(inverse(planar(*place.base)), X_OA)

    def before_a_radian(X_BA, q, posture=None):  # the level bar's right end goes up
        return bool(np.arcsin(np.clip(X_BA[2, 0], -1, 1)) < 0.99)

    dut = stances(before_a_radian)
    assert dut.best_arc(Turn(X_BA, 1.5)).margin < 0
    arc = dut.best_arc(Turn(X_BA, 1.5, split=True))
    assert 0.4 <= arc.turn < 1.0 and arc.margin >= CONFIG.margin_min
    assert stances().best_arc(Turn(X_BA, 1.5)).turn == pytest.approx(1.5)
    assert dut.find(X_OA, 1.5)[1] < 0  # but then the turn is not made, from anywhere
