"""What goes wrong in the middle of a run, each at its time and for its time (scenario key simulation.mishap)."""

import dataclasses as dc

import numpy as np
import pytest
from hands_at_valve import SHUT, VALVE, Hands, at_handle
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.analysis import Simulator
from robot_facts import ROBOT
from test_station import NEAR, PERFECT, Rig

from valve_drake import resources
from valve_drake import scenario as scenarios
from valve_drake.checks import ConfigError
from valve_drake.messages import LEFT, RIGHT, SIDES, ModeState, OperatorCommand
from valve_drake.stations.mishaps import OPENING_FORCE, InterruptingOperator, LostGripSystem
from valve_drake.stations.rails import COVER, CREEP, SPEED, STAND, Rail
from valve_drake.stations.simulation_config import MishapConfig

LEVELS = sorted((resources.diagrams() / "levels").glob("level5_*.scenario.yaml"))


@pytest.mark.system
def test_a_valve_stiffens_evenly_from_closed_to_open():
    valve = dc.replace(VALVE, friction=2.0, friction_open=12.0, travel=1.0)
    hands = Hands(at_handle(LEFT), at_handle(RIGHT), valve=valve)
    hands.command(SHUT)
    hands.run(0.5)
    for angle in (0.1, 0.2):

        def follow(share, angle=angle):
            for side in SIDES:
                hands.arms[side] = at_handle(side, angle - 0.1 + share * 0.1, near=hands.arms[side])
            return {f"{side}_arm.position_command": q for side, q in hands.arms.items()}

        hands.run(1.0, follow)
        turned = hands.kept[-1][1]
        now = hands.plant.GetOutputPort("now").Eval(hands.context)
        torque = abs(now[hands.plant.parts["stem"]][2])
        assert turned == pytest.approx(angle, abs=0.03)
        assert torque == pytest.approx(2.0 + 10.0 * turned, abs=0.3)


def test_a_hand_lets_go_when_the_valve_has_turned_so_far_and_obeys_again():
    system = LostGripSystem(MishapConfig(grip_lost_at=0.5, grip_lost_for=0.25), 0.1, ROBOT)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for name, value in (("angle", 0.1), ("position", 0.0), ("force", 70.0)):
        system.GetInputPort(name).FixValue(context, [value])

    def does(until):
        simulator.AdvanceTo(until)
        return [system.GetOutputPort(name).Eval(context)[0] for name in ("position_command", "force_limit")]

    assert does(0.5) == [0.0, 70.0]
    system.GetInputPort("angle").FixValue(context, [-0.41])  # in either sense
    assert does(0.6) == [ROBOT.opening, OPENING_FORCE]
    assert does(0.7) == [ROBOT.opening, OPENING_FORCE]
    assert does(0.9) == [0.0, 70.0]
    system.GetInputPort("angle").FixValue(context, [0.1])
    simulator.AdvanceTo(1.0)
    system.GetInputPort("angle").FixValue(context, [0.7])  # once is enough
    assert does(1.2) == [0.0, 70.0]


def test_a_hand_lets_go_of_a_valve_that_is_being_closed_where_it_comes_to_the_place_and_not_before():
    system = LostGripSystem(MishapConfig(grip_lost_at=0.5, grip_lost_for=0.25), 0.1, ROBOT)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    for name, value in (("angle", 1.7), ("position", 0.0), ("force", 70.0)):
        system.GetInputPort(name).FixValue(context, [value])
    for until, angle, force in ((0.5, 0.7, 70.0), (0.6, 0.59, 70.0), (0.7, 0.59, OPENING_FORCE), (1.2, 0.1, 70.0)):
        simulator.AdvanceTo(until)
        assert system.GetOutputPort("force_limit").Eval(context)[0] == force
        system.GetInputPort("angle").FixValue(context, [angle])


def test_the_station_puts_a_lost_grip_between_the_command_and_the_hand():
    rig = Rig(["simulation.mishap.grip_lost_at=0.0", "simulation.mishap.grip_lost_for=0.5"])
    rig.set("left_gripper.position_command", np.array([0.03]))
    rig.set("right_gripper.position_command", np.array([0.03]))
    rig.run(0.45)
    assert rig.read("left_gripper.position_measured")[0] > 0.08
    assert rig.read("right_gripper.position_measured")[0] == pytest.approx(0.03, abs=2e-3)
    rig.run(1.5)
    assert rig.read("left_gripper.position_measured")[0] == pytest.approx(0.03, abs=2e-3)


def test_wheels_that_slip_take_the_base_less_far_than_odometry_says():
    slip = ["wheel_slip_at=0.5", "wheel_slip_for=0.5", "wheel_slip_share=0.8"]
    rig = Rig([*(f"simulation.mishap.{key}" for key in slip), "simulation.start.distance=3.0"])
    start = rig.read("truth.base_pose")[:2].copy()
    rig.set("base.twist_command", np.array([0.4, 0.0]))
    rig.run(1.5)
    driven = np.linalg.norm(rig.read("truth.base_pose")[:2] - start)
    believed = rig.read("base.odometry")[0]
    assert believed - driven == pytest.approx(0.8 * 0.5 * 0.4, abs=0.02)


@pytest.mark.system
def test_the_cameras_see_nothing_while_the_lamps_are_out():
    rig = Rig(["simulation.light.off_at=0.5", "simulation.light.off_for=0.5"])
    bright = [rig.run(time).read("head_left.image").image.mean() for time in (0.4, 0.9, 1.4)]
    assert bright[1] < 10 < 50 < min(bright[0], bright[2])


PUSHED, COVERED = "simulation.valve.pushed", "simulation.valve.covered"


@pytest.mark.system
@pytest.mark.parametrize("by", [0.1, -0.06])
def test_a_valves_stand_is_pushed_aside_once_a_hand_is_near_and_stays_there(by):
    rig = Rig([f"{PUSHED}_at=2.0", f"{PUSHED}_by={by}", "simulation.valve.yaw=0.0"])
    before = rig.read("truth.marker_pose").reshape(3, 4)
    places = [rig.run(time).read("truth.marker_pose").reshape(3, 4) for time in (0.2, 1.0, 1.3)]
    assert 0.01 < np.linalg.norm(places[0][:, 3] - before[:, 3]) < 0.055  # it takes its time
    for place in places[1:]:
        assert place[:, 3] - before[:, 3] == pytest.approx([0, -by, 0], abs=1e-4)
        assert place[:, :3] == pytest.approx(before[:, :3], abs=1e-4)


def test_a_valves_stand_stays_where_it_is_while_no_hand_is_near():
    rig = Rig([f"{PUSHED}_at=0.1"])
    before = rig.read("truth.marker_pose").copy()
    assert rig.run(0.5).read("truth.marker_pose") == pytest.approx(before, abs=1e-5)


def test_a_rail_waits_then_goes_stays_on_its_way_and_goes_on():
    rail, step = Rail(ModelInstanceIndex(2), "cover", near=0.3, end=-0.3, stay=0.1, stay_for=2.0), 1 / 256
    assert rail.desired(0.0, 0.31, step) == (0.0, 0.0)
    q, time, stays = 0.0, 0.0, []
    while q != -0.3:
        q, _ = rail.desired(q, 0.29 if time < 0.01 else 1.0, step)  # who has come may go
        time += step
        stays += [time] if 0.1 <= -q < 0.1 + CREEP else []
        assert time < 10
    assert stays[-1] - stays[0] == pytest.approx(2.0, abs=0.1)
    assert time == pytest.approx(2.0 + 0.3 / SPEED, abs=0.1)
    assert rail.desired(q, 1.0, step) == (-0.3, 0.0)


@pytest.mark.system
def test_a_cover_hides_half_of_the_marker_for_its_time():
    rig = Rig([f"{COVERED}_at=4.0", f"{COVERED}_for=1.0", "simulation.start.distance=3.0", "simulation.valve.yaw=0.0"])

    def red(time):
        image = rig.run(time).read("head_left.image").image.astype(int)
        return (image[..., 0] > 90) & (image[..., 1:].max(2) < 60)

    before, half, after = red(0.4), red(1.8), red(4.5)
    rows, columns = np.nonzero(before & ~half)
    marker = before[:, columns.min() : columns.max() + 1]  # the room has other red things beside it
    assert len(rows) == pytest.approx(marker.sum() / 2, rel=0.1)
    assert rows.max() - rows.min() < 0.6 * np.ptp(np.nonzero(marker)[0])  # the upper half
    assert (before ^ after).sum() < 0.02 * marker.sum()


def test_an_operator_stops_the_run_and_gives_the_command_again():
    go = OperatorCommand(sequence=0, command="open", angle=1.2)
    operator = InterruptingOperator(MishapConfig(operator_stop_at=10.0, operator_go_after=3.0), go)
    assert operator.say(9.9, ModeState(mode="turn")) is None and operator.waits
    said = [operator.say(10.0, ModeState(mode="turn"))]
    assert operator.say(12.0, ModeState(mode="release")) is None
    assert operator.say(14.0, ModeState(mode="stopped", since=13.0)) is None
    said += [operator.say(16.0, ModeState(mode="stopped", since=13.0)), operator.say(16.1, ModeState(mode="idle"))]
    assert [(s.command, s.angle) for s in said] == [("stop", 1.2), ("reset", 1.2), ("open", 1.2)]
    assert len({0, 1, *(s.sequence for s in said)}) == 5  # new ones, and none that the user's own stop has
    assert not operator.waits and operator.say(99.0, ModeState(mode="done")) is None


def test_an_operator_who_would_stop_a_run_that_is_over_says_nothing():
    operator = InterruptingOperator(MishapConfig(operator_stop_at=10.0), OperatorCommand(command="open", angle=1.2))
    assert operator.say(9.0, ModeState(mode="done", since=8.5)) is None
    assert not operator.waits and operator.say(10.0, ModeState(mode="done", since=8.5)) is None


def test_without_mishaps_the_station_has_no_system_for_them():
    station = Rig().station
    plant = station.GetSubsystemByName("plant").plant
    assert not any(plant.HasModelInstanceNamed(name) for name in (STAND, COVER))
    assert not {"lost_grip", "wheel_slip"} & {system.get_name() for system in station.GetSystems()}


@pytest.mark.parametrize("path", LEVELS, ids=lambda path: path.name.split(".")[0])
def test_level_5_is_a_mishap_in_todays_work(path):
    plain = scenarios.resolve(scenarios.load("simulated.scenario.yaml", ["seed=3"]))
    given = scenarios.resolve(scenarios.load(str(path), ["seed=3"]))
    given.check()
    ours, theirs = vars(given.simulation), vars(plain.simulation)
    changed = {key for key in ours if ours[key] != theirs[key]}
    assert changed and changed <= {"valve", "mishap", "light"}
    assert given.angle == plain.angle and given.supervisor == plain.supervisor


def test_a_mishap_out_of_its_bounds_is_refused_by_its_key():
    with pytest.raises(ConfigError, match="simulation.mishap.wheel_slip_share"):
        scenarios.load(None, ["simulation.mishap.wheel_slip_share=1.0"])
    assert len(LEVELS) >= 8 and PERFECT and NEAR
