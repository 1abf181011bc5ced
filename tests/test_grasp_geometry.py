"""grasp_geometry: grasps fixed to the valve, the sign of the turn, and stances that serve the whole range of valves."""

import dataclasses as dc

import numpy as np
import pytest
from robot_facts import ROBOT

from valve_drake import resources
from valve_drake.behaviors.grasp_geometry import (
    StanceConfig,
    Stances,
    angle_turned,
    hand_in_valve,
    standoff,
    turned,
)
from valve_drake.behaviors.taught import load_taught
from valve_drake.checks import ConfigError
from valve_drake.frames import apply, compose, inverse, make, planar, rotation, wrap
from valve_drake.messages import SIDES
from valve_drake.perception.marker import Marker
from valve_drake.robot.kinematics import OUTWARD
from valve_drake.stations.scene import panel_pose
from valve_drake.stations.simulation_config import ValveConfig

MARKER = Marker()
CONFIG = StanceConfig()
VIEW = {side: taught.view for side, taught in load_taught(resources.models() / "taught" / "hands.yaml").items()}


def valve_at(height: float, tilt: float = 0.0, bar: float = 0.0, *, yaw: float = 0.3) -> np.ndarray:
    """X_OV of a valve [m, deg] whose bar stands at `bar` from level; it stands somewhere in the room."""
    X_WP = panel_pose(ValveConfig(height=height, tilt=np.deg2rad(tilt), yaw=yaw))
    X_PV = make(np.eye(3), np.array([0, 0, -MARKER.panel_depth]))
    return turned(compose(planar(2.0, 0.4, 0.0), X_WP, X_PV), np.deg2rad(bar))


def stances(is_free=lambda *_: True, **changes) -> Stances:
    return Stances(ROBOT, MARKER, dc.replace(CONFIG, **changes), VIEW, is_free)


def stance(X_OV: np.ndarray, turn: float, **changes):
    place, margin = stances(**changes).find(X_OV, np.deg2rad(turn))
    assert place.posture is None  # this robot has no lift
    return place.base, margin


# ---------------------------------------------------------------- the turn's sign


def test_positive_turns_counter_clockwise_as_seen_from_the_robot():
    X_BV = compose(inverse(planar(1.2, 0.4, 0.0)), valve_at(1.0, yaw=0.0))  # x_V to the right, z_V forward
    tip = apply(turned(X_BV, 0.3), np.array([0.15, 0, 0]))  # the right end of the bar
    assert tip - X_BV[:, 3] == pytest.approx(0.15 * np.array([0, -np.cos(0.3), np.sin(0.3)]))  # goes up
    R = X_BV[:, :3].T @ turned(X_BV, 0.3)[:, :3]
    assert R == pytest.approx(rotation(np.array([0, 0, -0.3])))  # about -z of V


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


@pytest.mark.parametrize("swapped", [False, True])
def test_hands_hold_the_marked_ends_of_the_bar(swapped):
    for side in SIDES:
        X_VG = hand_in_valve(side, swapped, MARKER)
        end = -OUTWARD[side] * (-1 if swapped else 1)  # x_V points to the robot's right when it faces a level bar
        assert X_VG[:, 3] == pytest.approx([end * MARKER.handle_radius, 0, MARKER.handle_depth])
        assert X_VG[:, 2] == pytest.approx([0, 0, 1])  # approaches into the panel
        assert abs(X_VG[1, 1]) == 1  # closes across the bar
        assert np.linalg.det(X_VG[:, :3]) == pytest.approx(1)
        left = hand_in_valve("left", swapped, MARKER)
        assert X_VG[:, 0] == pytest.approx(
            left[:, 3] / np.linalg.norm(left[:2, 3]) * [1, 1, 0]
        )  # to the left hand's end


def test_hand_poses_are_constant_in_the_valve_while_it_turns():
    """A rigid turn of valve and hands about the valve's axis, worked out in the room."""
    X_BV = compose(inverse(planar(1.2, 0.4, 0.3)), valve_at(1.1, tilt=7, bar=5))
    for side in SIDES:
        X_BG = compose(X_BV, hand_in_valve(side, False, MARKER))
        for angle in (-0.7, 0.2, 1.57):
            turn = rotation(-angle * X_BV[:, 2])  # positive opens: about -z of V
            moved = make(turn @ X_BG[:, :3], X_BV[:, 3] + turn @ (X_BG[:, 3] - X_BV[:, 3]))
            assert compose(inverse(turned(X_BV, angle)), moved) == pytest.approx(hand_in_valve(side, False, MARKER))


def test_the_marker_is_reached_by_exactly_both_hands_once():
    for swapped in (False, True):
        ends = {round(hand_in_valve(side, swapped, MARKER)[0, 3], 6) for side in SIDES}
        assert ends == {-MARKER.handle_radius, MARKER.handle_radius}


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
    X_OV = valve_at(height, tilt, bar)
    base, margin = stance(X_OV, turn)
    assert margin > 0.5
    # square to the panel, on the axis' line, at a distance that was asked for
    assert wrap(base[2] - 0.3) == pytest.approx(0, abs=1e-9)
    axis = X_OV[:2, 3] + MARKER.panel_depth * X_OV[:2, 2]
    off = axis - base[:2]
    forward = np.array([np.cos(base[2]), np.sin(base[2])])
    assert off @ [-forward[1], forward[0]] == pytest.approx(0, abs=1e-9)
    assert CONFIG.distance_min - 1e-9 <= off @ forward <= CONFIG.distance_max + 1e-9
    # and it holds what it says, along the arc at a finer step
    X_BV = compose(inverse(planar(*base)), X_OV)
    fine = stances(arc_step=0.02).best_arc(X_BV, np.deg2rad(turn))
    assert fine.margin > margin - 0.1


def test_a_stance_is_bit_by_bit_the_same_twice():
    X_OV = valve_at(1.1, 5, 3)
    few = {"distance_min": 0.70, "distance_max": 0.76}
    a, b = stance(X_OV, 90, **few), stance(X_OV, 90, **few)
    assert a[0].tobytes() == b[0].tobytes() and a[1] == b[1]


@pytest.mark.parametrize("height", [0.2, 1.9])
def test_a_valve_out_of_reach_has_no_stance(height):
    assert stance(valve_at(height), 90)[1] < 0


def test_a_turn_that_arms_cannot_follow_has_no_stance():
    base, margin = stance(valve_at(1.0), 360, distance_min=0.72, distance_max=0.74)
    assert margin < 0


def test_the_arc_says_where_it_starts_and_that_the_whole_of_it_is_reached():
    X_OV = valve_at(1.0)
    base, _ = stance(X_OV, 90, distance_min=0.70, distance_max=0.76)
    X_BV = compose(inverse(planar(*base)), X_OV)
    arc = stances().best_arc(X_BV, np.pi / 2)
    for side, q in arc.q.items():
        X_BG = ROBOT.forward(side, q)
        assert X_BG == pytest.approx(compose(X_BV, hand_in_valve(side, arc.swapped, MARKER)), abs=1e-6)
    # too near and too far are worse, and further it is out of reach
    margins = [
        stances().best_arc(compose(make(np.eye(3), np.array([d, 0, 0])), X_BV), np.pi / 2).margin
        for d in (0.0, 0.12, 0.20, 0.40)
    ]
    assert 0 < margins[0] < margins[1] > margins[2] and margins[3] == -1


def test_handles_are_shared_the_better_way():
    """A valve turned by half a turn looks the same with its ends exchanged: the hands must not cross."""
    X_BV = compose(inverse(planar(1.2, 0.4, 0.3)), valve_at(1.0))
    straight = stances().best_arc(X_BV, np.pi / 2)
    other = stances().best_arc(turned(X_BV, np.pi), np.pi / 2)
    assert (straight.swapped, other.swapped) == (False, True)
    assert all(straight.q[side] == pytest.approx(other.q[side]) for side in SIDES)
    crossed = stances().check_arc(X_BV, np.pi / 2, True)
    assert crossed.margin < straight.margin


@pytest.mark.parametrize(
    "changes", [{"distance_min": 0.3}, {"distance_min": 0.9}, {"arc_step": 0.0}, {"standoff": float("nan")}]
)
def test_bad_config_is_refused_by_name(changes):
    with pytest.raises(ConfigError, match=f"stance.{next(iter(changes))}"):
        StanceConfig(**changes).check()


def test_arms_that_touch_something_where_they_draw_back_have_no_stance():
    X_OV = valve_at(1.0)
    base, _ = stance(X_OV, 90, distance_min=0.76, distance_max=0.78)
    X_BV = compose(inverse(planar(*base)), X_OV)
    arc = stances().best_arc(X_BV, np.pi / 2)
    back = np.concatenate([arc.q_standoff[side] for side in SIDES])
    blocked = stances(lambda X_BV, q, posture=None: not np.allclose(q, back))
    assert arc.margin > 0.5
    assert blocked.check_arc(X_BV, np.pi / 2, arc.swapped).margin == -1
