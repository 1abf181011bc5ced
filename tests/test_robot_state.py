"""robot_state: one message of all measurements of an instant, and the head's last half second."""

import numpy as np
import pytest
from helpers import Rig, assert_clones_are_independent, assert_holds_between_updates, ports
from robot_facts import GROUPS

from valve_drake.messages import POSE_HISTORY, SIDES
from valve_drake.ports import SLOT, TICK
from valve_drake.robot_state_system import HISTORY, RobotStateSystem
from valve_drake.stations.contract import vectors

MEASURED = vectors(GROUPS, "out")


def values() -> dict[str, np.ndarray]:
    """Station outputs in which every number differs from every other."""
    out, start = {}, 0.0
    for name, size in MEASURED.items():
        out[name] = start + np.arange(size)
        start += size
    return out


def rig(**changes) -> Rig:
    dut = Rig(RobotStateSystem(GROUPS))
    dut.fix(**values() | changes)
    return dut


def test_ports_are_the_measurements_of_the_station_contract():
    measured = {name: f"in {size}" for name, size in MEASURED.items()}
    found = ports(RobotStateSystem(GROUPS))
    assert found.pop("robot_state") == "out abstract"
    assert found == measured


def test_every_measurement_arrives_in_its_own_field():
    state, given = rig().run(TICK / 2).read("robot_state"), values()
    assert np.array_equal(state.odometry, given["base.odometry"])
    assert np.array_equal(state.torso, given["torso.position_measured"])
    for side in SIDES:
        for field, port in {
            "arm": "arm.position_measured",
            "arm_velocity": "arm.velocity_measured",
            "arm_torque": "arm.torque_measured",
            "wrench": "wrist.wrench",
        }.items():
            assert np.array_equal(getattr(state, f"{side}_{field}"), given[f"{side}_{port}"]), (side, field)
        assert [getattr(state, f"{side}_gripper")] == given[f"{side}_gripper.position_measured"]
        assert [getattr(state, f"{side}_gripper_force")] == given[f"{side}_gripper.force_measured"]


def test_the_past_of_the_head_is_kept_for_a_second():
    dut = rig()
    for k in range(200):
        dut.fix(**{"base.odometry": [k, 0, 0, 0, 0], "torso.position_measured": [k, 2 * k, 3 * k]})
        dut.run(k * TICK + SLOT)
        state = dut.read("robot_state")
        assert state.time == k * TICK
        assert len(state.history) == min(k + 1, HISTORY)
    assert HISTORY * TICK == pytest.approx(POSE_HISTORY)
    assert state.history[:, 0] == pytest.approx(np.arange(200 - HISTORY, 200) * TICK)
    base, torso = state.head_at(80 * TICK)
    assert base.tolist() == [80, 0, 0] and torso.tolist() == [80, 160, 240]


def test_it_runs_first_in_a_tick_and_holds():
    assert_holds_between_updates(rig(), "robot_state", slot=0)


def test_clones_are_independent():
    assert_clones_are_independent(rig, {"left_arm.position_measured": np.ones(6)}, ("robot_state",))


@pytest.mark.parametrize("port", MEASURED)
def test_a_missing_measurement_is_an_error(port):
    dut = Rig(RobotStateSystem(GROUPS))
    dut.fix(**{name: value for name, value in values().items() if name != port})
    with pytest.raises(RuntimeError, match=f"{port}.*nothing is connected"):
        dut.run(TICK)
