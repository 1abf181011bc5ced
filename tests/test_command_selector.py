"""command_selector: who commands what in which mode; nothing unbounded, stale or broken ever reaches the robot."""

import dataclasses as dc
import math

import numpy as np
import pytest
from helpers import Rig, assert_clones_are_independent, assert_holds_between_updates, ports
from robot_facts import GROUPS as ROBOT_GROUPS
from robot_facts import HOME, LIMITS, ROBOT, arm, robot_state

from valve_drake.checks import ConfigError
from valve_drake.messages import Command, Health, Mode, ModeState, SelectorReport, Verdict
from valve_drake.motion import braking_speed, follow
from valve_drake.stations.contract import vectors
from valve_drake.supervisor.command_selector import (
    GRIPPERS,
    GROUPS,
    JOINTS,
    SOURCE,
    CommandSelectorConfig,
    bounds,
    changes,
    outputs,
    start,
    step,
)
from valve_drake.supervisor.command_selector_system import CommandSelectorSystem
from valve_drake.task.modes import BEHAVIORS, TABLE

DT = 1 / 128
CONFIG = CommandSelectorConfig()
PORTS = vectors(ROBOT_GROUPS, "in")
INITIAL = {port: np.full(size, 0.01) for port, size in PORTS.items()}
BOUNDS = bounds(CONFIG, ROBOT.torso, ROBOT.arms)


def command(time: float, **groups) -> Command:
    """A command for every group; `groups` replaces some of them."""
    full = {
        "base_twist": np.array([0.1, 0.2]),
        "torso": np.array([0.1, 0.2, 0.3]),
        "left_arm": HOME,
        "right_arm": arm("right", HOME),
        "left_gripper": np.array([0.05, 30.0]),
        "right_gripper": np.array([0.05, 30.0]),
    }
    return Command(time=time, **full | groups)


class Bench:
    """The selector on a robot that stands at home; all blocks send `command` unless told otherwise."""

    def __init__(self, mode: Mode = Mode.REACH, config: CommandSelectorConfig = CONFIG):
        self.config = config
        self.memory = start(config, INITIAL, ROBOT.torso, ROBOT.arms)
        self.tick_count = 0
        self.mode = ModeState(mode=mode.value, activation=1)
        self.health = Health()
        self.robot = robot_state(left_arm=HOME, right_arm=arm("right", HOME), left_gripper=0.02)
        self.robot_age = self.mode_age = self.command_age = 0.0

    def tick(self, commands=None, **groups) -> SelectorReport:
        """One tick; `commands` by block, or every block sends the same with `groups` replaced."""
        time = self.tick_count * DT
        if commands is None:
            commands = dict.fromkeys(BEHAVIORS, command(time - self.command_age, **groups))
        self.memory, report = step(
            self.config,
            self.memory,
            time,
            DT,
            dc.replace(self.mode, time=time - self.mode_age),
            dc.replace(self.robot, time=time - self.robot_age),
            self.health,
            commands,
        )
        self.tick_count += 1
        return report

    def out(self, port: str) -> np.ndarray:
        return outputs(self.memory)[port]


# ---------------------------------------------------------------- the table


@pytest.mark.parametrize("mode", list(Mode))
def test_each_mode_takes_each_group_from_the_block_of_the_table(mode):
    bench = Bench(mode)
    report = bench.tick()
    assert report.source == tuple(SOURCE[mode][group] for group in GROUPS)
    assert not report.refused


def test_the_table_is_the_agreed_one():
    for mode in Mode:
        row = SOURCE[mode]
        final = mode in (Mode.DONE, Mode.FAILED, Mode.STOPPED)
        assert row["torso"] == ("hold" if final else "valve_search")
        base = {Mode.SEARCH: "valve_search"} | dict.fromkeys(
            (Mode.ROUGH_APPROACH, Mode.FINE_APPROACH, Mode.RETREAT), "base_approach"
        )
        assert row["base"] == base.get(mode, "hold")
        hands = {Mode.SERVO: "image_servo"} | dict.fromkeys((Mode.GRASP, Mode.TURN, Mode.RELEASE), "hybrid_rotation")
        arms = "hold" if final else hands.get(mode, "kinematic_approach")
        assert row["left_arm"] == row["right_arm"] == arms
        opens = mode in (Mode.FAILED, Mode.STOPPED)
        assert row["left_gripper"] == row["right_gripper"] == ("command_selector" if opens else arms)


@pytest.mark.parametrize("mode", list(Mode))
def test_no_other_blocks_command_gets_through(mode):
    """Every block asks for something of its own; the outputs move only towards the owner's wish."""
    bench = Bench(mode)
    bench.tick()
    wish = {block: 0.02 * (k + 1) for k, block in enumerate(BEHAVIORS)}
    for _ in range(200):
        time = bench.tick_count * DT
        commands = {
            block: command(time, base_twist=np.full(2, d), left_arm=HOME + d, torso=np.full(3, d))
            for block, d in wish.items()
        }
        bench.tick(commands)
    row = SOURCE[mode]
    assert np.allclose(bench.out("base.twist_command"), wish.get(row["base"], 0.0))
    assert np.allclose(bench.out("left_arm.position_command"), HOME + wish.get(row["left_arm"], 0.0))
    if row["torso"] in wish:
        assert np.allclose(bench.out("torso.position_command"), wish[row["torso"]])


@pytest.mark.parametrize("mode", [Mode.FAILED, Mode.STOPPED])
def test_the_hands_open_at_the_end_of_a_failed_run_whatever_the_behaviours_say(mode):
    bench = Bench(Mode.GRASP)
    for _ in range(100):
        bench.tick(left_gripper=np.array([0.0, 60.0]), right_gripper=np.array([0.0, 60.0]))
    bench.mode = ModeState(mode=mode.value, activation=2)
    for _ in range(200):
        bench.tick(left_gripper=np.array([0.0, 60.0]), right_gripper=np.array([0.0, 60.0]))
    for group in GRIPPERS:
        assert bench.out(f"{group}.position_command") == CONFIG.gripper_high
        assert bench.out(f"{group}.force_limit") == 60.0


def test_done_holds_the_hands_as_they_are():
    bench = Bench(Mode.RETREAT)
    for _ in range(100):
        bench.tick()
    bench.mode = ModeState(mode="done", activation=2)
    for _ in range(100):
        bench.tick(left_gripper=np.array([0.0, 60.0]))
    assert bench.out("left_gripper.position_command") == 0.05


# ---------------------------------------------------------------- start


def test_the_first_arm_command_is_the_measured_position():
    bench = Bench()
    bench.robot = dc.replace(bench.robot, left_arm=HOME + 0.4)
    bench.tick()
    step_limit = BOUNDS.acceleration[BOUNDS.parts["left_arm"]] * DT * DT
    assert np.all(np.abs(bench.out("left_arm.position_command") - (HOME + 0.4)) <= step_limit + 1e-12)


@pytest.mark.parametrize("broken", [{"history": np.zeros((0, 7))}, {"left_arm": np.full(6, np.nan)}])
def test_before_the_first_valid_robot_state_the_outputs_are_the_initial_values(broken):
    bench = Bench()
    good = bench.robot
    bench.robot = dc.replace(good, **broken)
    for _ in range(10):
        report = bench.tick()
    assert report.refused == ("robot_state: none yet",) and set(report.source) == {"hold"}
    assert all(np.array_equal(bench.out(port), INITIAL[port]) for port in PORTS)
    bench.robot = good
    bench.tick()
    assert np.allclose(bench.out("left_arm.position_command"), HOME, atol=1e-3)


def test_initial_values_that_do_not_fit_are_refused_by_port():
    for wrong in (np.zeros(5), np.full(6, np.nan)):
        with pytest.raises(ConfigError, match="left_arm.position_command"):
            start(CONFIG, INITIAL | {"left_arm.position_command": wrong}, ROBOT.torso, ROBOT.arms)
    with pytest.raises(ConfigError, match="right_gripper.force_limit"):
        start(CONFIG, {p: v for p, v in INITIAL.items() if p != "right_gripper.force_limit"}, ROBOT.torso, ROBOT.arms)


# ---------------------------------------------------------------- limits


def follow_joint(targets: np.ndarray, group: str = "left_arm", joint: int = 0, mode: Mode = Mode.REACH):
    """Feeds one joint a series of targets, starting at rest on the first -> outputs (n,), reports."""
    bench = Bench(mode)
    base = {"left_arm": HOME, "torso": np.zeros(3)}[group].copy()
    base[joint] = targets[0]
    bench.robot = dc.replace(bench.robot, **{group: base})
    out, reports = [], []
    for target in targets:
        wish = base.copy()
        wish[joint] = target
        reports.append(bench.tick(**{group: wish}))
        out.append(bench.out(f"{group}.position_command")[joint])
    return np.array(out), reports


@pytest.mark.parametrize("size", [1e-4, 0.003, 0.05, 0.3, 1.5, -0.7])
@pytest.mark.parametrize("group, joint", [("left_arm", 0), ("left_arm", 5), ("torso", 2), ("torso", 0)])
def test_a_step_becomes_a_trapezoid_that_does_not_overshoot(group, joint, size):
    size = np.clip(size, -0.5, 0.5) if group == "torso" else size
    k = BOUNDS.parts[group].start + joint
    out, _ = follow_joint(np.concatenate([[0.0], np.full(400, size)]), group, joint)
    speed = np.diff(out) / DT
    assert out[-1] == size
    assert np.all(np.abs(out) <= abs(size))  # never beyond
    assert np.all(np.diff(out) * np.sign(size) >= 0)
    assert np.max(np.abs(speed)) <= BOUNDS.speed[k] * (1 + 1e-9)
    assert np.max(np.abs(np.diff(speed, prepend=0.0))) <= BOUNDS.acceleration[k] * DT * (1 + 1e-6)
    v, a, d = BOUNDS.speed[k], BOUNDS.acceleration[k], abs(size)  # as fast as the limits allow
    ideal = d / v + v / a if d > v * v / a else 2 * np.sqrt(d / a)
    assert np.argmax(out == size) * DT <= ideal + 3 * DT


@pytest.mark.parametrize("amplitude, frequency", [(0.02, 0.5), (0.2, 0.5), (0.02, 2.0), (1e-3, 5.0)])
def test_a_command_within_the_limits_passes_unchanged_and_without_lag(amplitude, frequency):
    t = np.arange(512) * DT
    targets = amplitude * (1 - np.cos(2 * np.pi * frequency * t))
    out, reports = follow_joint(targets)
    assert np.array_equal(out, targets)
    assert not any(name.startswith("left_arm") for r in reports for name in r.limited)


def test_a_slow_noisy_command_such_as_a_servo_passes_unchanged():
    rng = np.random.default_rng(3)
    targets = np.cumsum(rng.normal(scale=5e-5, size=1000))
    out, reports = follow_joint(targets)
    assert np.array_equal(out, targets)
    assert not any(name.startswith("left_arm") for r in reports for name in r.limited)


def test_a_ramp_that_starts_abruptly_is_caught_up_with_and_then_followed_without_lag():
    targets = 0.8 * np.arange(300) * DT
    out, _ = follow_joint(targets)
    assert np.all(out <= targets + 1e-12)
    assert np.array_equal(out[100:], targets[100:])


def test_a_ramp_that_stops_abruptly_is_not_overshot():
    targets = np.minimum(0.8 * np.arange(300) * DT, 0.7)
    out, _ = follow_joint(targets)
    assert np.max(out) == 0.7


def test_any_command_whatever_gives_outputs_within_all_limits():
    """Random jumps beyond every limit, random modes and silences: position, speed and gain of speed stay bounded."""
    rng = np.random.default_rng(9)
    bench = Bench()
    last, velocity, twist = None, None, np.zeros(2)
    asked = None
    for k in range(3000):
        if k % 40 == 0:
            bench.mode = ModeState(mode=str(rng.choice(list(Mode))), activation=k)
            bench.command_age = float(rng.choice([0.0, 0.0, 0.0, 0.5]))
        if k % 7 == 0:
            asked = {name: rng.normal(scale=4, size=size) for name, size in (("torso", 3), ("left_arm", 6))}
            asked |= {"base_twist": rng.normal(scale=2, size=2)}
            asked |= {name: np.abs(rng.normal(scale=[0.1, 100])) for name in GRIPPERS}
        bench.tick(**asked)
        position = bench.memory.position
        assert np.all((BOUNDS.low <= position) & (position <= BOUNDS.high))
        if last is not None:
            now = (position - last) / DT
            assert np.all(np.abs(now) <= BOUNDS.speed * (1 + 1e-6))
            assert np.all(np.abs(now) - np.abs(velocity) <= BOUNDS.acceleration * DT * (1 + 1e-6))
            velocity = now
        else:
            velocity = np.zeros(17)
        last = position
        new = bench.out("base.twist_command")
        assert np.all(np.abs(new) <= ROBOT.drive.speed)
        assert np.all(np.abs(new - twist) <= ROBOT.drive.acceleration * DT * (1 + 1e-9))
        twist = new
        assert all(0 <= bench.out(f"{g}.force_limit")[0] <= CONFIG.gripper_force for g in GRIPPERS)


def test_what_was_changed_is_reported():
    bench = Bench()
    bench.tick()
    report = bench.tick(left_arm=HOME + [9, 0, 0, 0, 0, 0], left_gripper=np.array([0.02, 200.0]))
    assert {"left_arm.position", "left_arm.acceleration", "left_gripper.force"} <= set(report.limited)
    assert not any(name.startswith("right_arm") for name in report.limited)
    for _ in range(60):
        report = bench.tick(left_arm=HOME + [1.5, 0, 0, 0, 0, 0])
    assert "left_arm.velocity" in report.limited
    bench = Bench(Mode.ROUGH_APPROACH)
    assert {"base.velocity", "base.acceleration"} <= set(bench.tick(base_twist=np.array([3.0, 0])).limited)


def test_a_joint_measured_outside_its_limits_is_brought_back_without_a_jump():
    bench = Bench()
    bench.robot = dc.replace(bench.robot, torso=np.array([0.65, 0.0, 0.0]))
    before = None
    for _ in range(200):
        bench.tick(torso=np.array([0.65, 0.0, 0.0]))
        now = bench.out("torso.position_command")[0]
        assert before is None or 0 <= before - now <= BOUNDS.speed[0] * DT + 1e-12
        before = now
    assert now == ROBOT.torso.high[0]


# ---------------------------------------------------------------- refusals, staleness, holding


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("group", GROUPS)
def test_a_command_that_is_not_finite_is_refused_and_only_that_group_holds(group, bad):
    mode = Mode.ROUGH_APPROACH
    bench = Bench(mode)
    field = "base_twist" if group == "base" else group
    size = {"base": 2, "torso": 3, "left_gripper": 2, "right_gripper": 2}.get(group, 6)
    value = np.zeros(size)
    value[-1] = bad
    report = bench.tick(**{field: value})
    assert report.refused == (f"{group}: not finite",)
    assert [s == "hold" for s in report.source] == [g == group for g in GROUPS]
    assert all(np.all(np.isfinite(v)) for v in outputs(bench.memory).values())


@pytest.mark.parametrize("group", ["torso", "left_arm", "right_arm"])
@pytest.mark.parametrize("more", [-1, 1])
def test_a_command_of_another_number_of_joints_is_refused_and_only_that_group_holds(group, more):
    bench = Bench(Mode.ROUGH_APPROACH)
    count = bench.memory.bounds.parts[group].stop - bench.memory.bounds.parts[group].start
    report = bench.tick(**{group: np.full(count + more, 0.3)})
    assert report.refused == (f"{group}: {count + more} values, not {count}",)
    assert [s == "hold" for s in report.source] == [g == group for g in GROUPS]
    assert {port: len(v) for port, v in outputs(bench.memory).items()} == {p: len(v) for p, v in INITIAL.items()}


def test_a_negative_force_limit_is_refused():
    bench = Bench()
    assert bench.tick(left_gripper=np.array([0.05, -1.0])).refused == ("left_gripper: force limit -1.0 N",)
    assert bench.out("left_gripper.force_limit") == INITIAL["left_gripper.force_limit"]


@pytest.mark.parametrize("stale", ["robot_age", "mode_age", "command_age"])
def test_stale_input_holds_the_joints_still_and_brakes_the_base(stale):
    bench = Bench(Mode.ROUGH_APPROACH)
    for k in range(50):
        bench.tick(left_arm=HOME + k * 0.005, base_twist=np.array([0.3, 0.5]))
    setattr(bench, stale, 0.05)
    assert "hold" not in bench.tick(left_arm=HOME + 0.25).source
    setattr(bench, stale, 0.15)
    moving = bench.memory.velocity[BOUNDS.parts["left_arm"]]
    for _ in range(128):
        report = bench.tick(left_arm=HOME + 3.0, base_twist=np.array([0.3, 0.5]))
        now = bench.memory.velocity[BOUNDS.parts["left_arm"]]
        assert np.all(np.abs(now) <= np.abs(moving))
        moving = now
    assert set(report.source) == {"hold"} and report.refused
    assert np.all(moving == 0) and np.all(bench.out("base.twist_command") == 0)


@pytest.mark.parametrize("group", JOINTS)
def test_a_silent_block_means_hold(group):
    bench = Bench(Mode.REACH)
    bench.tick()
    before = bench.out(f"{group}.position_command")
    for _ in range(50):
        bench.tick({})
    assert np.allclose(bench.out(f"{group}.position_command"), before, atol=2e-3)
    report = bench.tick(**{group: None})
    assert report.source[GROUPS.index(group)] == "hold"
    assert not report.refused  # not to ask is no error


def test_hold_brakes_within_the_acceleration_limit_and_inside_the_range():
    limit = LIMITS[1]
    for room in (0.15, 0.02):  # enough to brake in, and not
        bench = Bench()
        k = 0
        while bench.out("left_arm.position_command")[1] < limit - room:
            k += 1
            bench.tick(left_arm=HOME + [0, k * DT, 0, 0, 0, 0])
        assert bench.memory.velocity[4] > 0.9
        for _ in range(60):
            before = bench.memory.velocity[4]
            bench.tick({})
            after = bench.memory.velocity[4]
            at_limit = bench.out("left_arm.position_command")[1] == limit
            assert 0 <= after <= before
            assert at_limit or before - after <= CONFIG.acceleration_arm * DT * (1 + 1e-9)
            assert bench.out("left_arm.position_command")[1] <= limit
        assert after == 0


def test_a_silent_device_holds_its_group_and_one_silent_arm_holds_both():
    arms = {"left_arm", "right_arm"}
    for device, held in (("torso", {"torso"}), ("left_arm", arms), ("left_gripper", {"left_gripper"})):
        bench = Bench(Mode.TURN)
        bench.tick()
        bench.health = Health(devices=("base", device), ages=np.array([0.0, CONFIG.max_age + 0.01]))
        before = {port: bench.out(port) for port in PORTS}
        report = bench.tick(left_arm=HOME + 0.1, right_arm=arm("right", HOME) + 0.1)
        assert {group for group, source in zip(GROUPS, report.source) if source == "hold"} == held | {"base"}
        assert f"{device} silent" in " ".join(report.refused)
        for group in held:
            assert np.array_equal(bench.out(f"{group}.position_command"), before[f"{group}.position_command"])


def test_a_device_whose_age_is_not_a_number_is_silent():
    bench = Bench()
    bench.health = Health(devices=("torso",), ages=np.array([np.nan]))
    assert bench.tick().source[GROUPS.index("torso")] == "hold"


@pytest.mark.parametrize("lost", [0.3, np.nan])
def test_a_joint_that_does_not_follow_is_reported_after_a_quarter_of_a_second(lost):
    bench = Bench()
    assert not bench.tick(torso=np.zeros(3), base_twist=np.zeros(2)).astray
    bench.robot = dc.replace(bench.robot, left_arm=HOME + lost)
    reports = [bench.tick(torso=np.zeros(3), base_twist=np.zeros(2)) for _ in range(40)]
    assert [r.astray for r in reports[:32]] == [()] * 32 and reports[33].astray == ("left_arm",)


def test_a_base_that_does_not_follow_is_reported():
    bench = Bench(Mode.SEARCH)
    report = None
    for _ in range(128):
        report = bench.tick(torso=np.zeros(3), base_twist=np.array([0.5, 0.0]))
    assert report.astray == ("base",)


def test_an_emergency_stop_holds_all_but_the_grippers():
    bench = Bench(Mode.RELEASE)
    bench.health = Health(estop=True)
    report = bench.tick()
    held = [g for g, s in zip(GROUPS, report.source) if s == "hold"]
    assert held == [g for g in GROUPS if g not in GRIPPERS]
    assert report.refused == ("emergency stop",)


def test_a_command_from_the_future_is_refused():
    bench = Bench()
    bench.command_age = -1.0
    assert set(bench.tick().source) == {"hold"}


# ---------------------------------------------------------------- force trip


def pull(bench: Bench, newtons: float, side: str = "left", ticks: int = 1) -> SelectorReport:
    wrench = np.array([0, 0, 0, 0, newtons, 0.0])
    bench.robot = dc.replace(bench.robot, **{f"{side}_wrench": wrench})
    for _ in range(ticks):
        report = bench.tick()
    return report


def test_a_force_above_the_trip_for_three_ticks_trips():
    bench = Bench()
    assert pull(bench, CONFIG.trip_force + 1, ticks=2).tripped == ()
    assert pull(bench, CONFIG.trip_force + 1).tripped == ("left",)


def test_two_ticks_twice_do_not_trip_and_neither_does_the_trip_force_itself():
    bench = Bench()
    for _ in range(4):
        assert pull(bench, CONFIG.trip_force + 1, ticks=2).tripped == ()
        assert pull(bench, 0.0).tripped == ()
    assert pull(bench, CONFIG.trip_force, ticks=10).tripped == ()


def test_torque_does_not_count_as_force():
    bench = Bench()
    bench.robot = dc.replace(bench.robot, right_wrench=np.array([500.0, 500, 500, 0, 0, 0]))
    for _ in range(10):
        assert bench.tick().tripped == ()


def test_a_trip_is_kept_until_the_mode_changes():
    bench = Bench()
    pull(bench, 200.0, "right", ticks=3)
    assert pull(bench, 0.0, "right", ticks=20).tripped == ("right",)
    bench.mode = dc.replace(bench.mode, activation=2)
    assert bench.tick().tripped == ()


def test_a_wrench_that_is_not_a_number_trips():
    assert pull(Bench(), np.nan, ticks=3).tripped == ("left",)


# ---------------------------------------------------------------- motion laws


def test_braking_speed_falls_by_one_step_of_the_acceleration_each_step():
    a, dt = 3.0, DT
    distance = 0.5
    speed = braking_speed(distance, a, dt)
    for _ in range(20):
        distance -= speed * dt
        slower = braking_speed(distance, a, dt)
        assert speed - slower == pytest.approx(a * dt)
        speed = slower


def test_follow_lands_exactly_for_periods_that_are_no_power_of_two():
    position, velocity, target = 0.0, 0.0, 0.0
    for k in range(200):
        before, target, last = target, 0.5 * (1 - math.cos(0.01 * k)), position
        position = follow(target, (target - before) / 0.01, position, velocity, 2.0, 9.0, 0.01)
        velocity = (position - last) / 0.01
        assert position == target


def test_a_target_that_is_no_number_is_not_followed_to_a_number():
    assert math.isnan(follow(math.nan, math.nan, 0.3, 0.0, 1.0, 2.0, DT))


def test_speeds_and_distances_without_bounds_are_followed_at_the_joints_own():
    assert follow(1e308, 1e308, 0.0, 1.0, 1.0, 2.0, DT) == 1.0 * DT


# ---------------------------------------------------------------- block


def rig(**inputs) -> Rig:
    robot = robot_state(left_arm=HOME, right_arm=arm("right", HOME))
    fixed = {"mode": ModeState(mode="reach", activation=1), "robot_state": robot, "health": Health()}
    return Rig(CommandSelectorSystem(CONFIG, INITIAL, ROBOT.torso, ROBOT.arms), **fixed | inputs)


def test_ports():
    assert ports(CommandSelectorSystem(CONFIG, INITIAL, ROBOT.torso, ROBOT.arms)) == {
        "mode": "in abstract",
        "robot_state": "in abstract",
        "health": "in abstract",
        **dict.fromkeys(BEHAVIORS, "in abstract"),
        **{port: f"out {size}" for port, size in PORTS.items()},
        "report": "out abstract",
    }


def test_output_ports_are_the_stations_command_ports():
    block = CommandSelectorSystem(CONFIG, INITIAL, ROBOT.torso, ROBOT.arms)
    assert {p: int(k.removeprefix("out ")) for p, k in ports(block).items() if p in PORTS} == PORTS


def test_block_holds_the_initial_values_until_its_first_step_and_again_after_initialising():
    dut = rig()
    dut.simulator.Initialize()
    assert all(np.array_equal(dut.read(port), INITIAL[port]) for port in PORTS)
    dut.run(1.5 / 512)
    assert np.array_equal(dut.read("left_arm.position_command"), INITIAL["left_arm.position_command"])
    dut.run(3 / 512)
    assert np.allclose(dut.read("left_arm.position_command"), HOME)
    dut.simulator.Initialize()
    assert np.allclose(dut.read("left_arm.position_command"), HOME)


def test_block_takes_the_command_of_the_owner_only():
    wish = HOME + 0.01
    dut = rig(
        kinematic_approach=command(0.0, left_arm=wish),
        image_servo=command(0.0, left_arm=HOME + 1),
        hybrid_rotation=command(0.0, left_arm=HOME - 1),
    ).run(0.09)
    assert np.allclose(dut.read("left_arm.position_command"), wish)
    assert dut.read("report").source[GROUPS.index("left_arm")] == "kinematic_approach"
    assert dut.read("report").source[GROUPS.index("torso")] == "hold"  # that port is open


def test_block_holds_its_outputs_between_updates():
    assert_holds_between_updates(rig(), "report", slot=2)


def test_block_clones_are_independent():
    def make():
        return rig(robot_state=robot_state(time=0.5, left_arm=HOME))

    change = {"mode": ModeState(mode="failed", activation=2, time=0.5)}
    assert_clones_are_independent(make, change, (*PORTS, "report"))


def test_block_refuses_a_wrong_message_and_a_wrong_config():
    with pytest.raises(TypeError, match="want Command"):
        rig(mode=ModeState(mode="servo", activation=1), image_servo=ModeState()).run(0.1)
    with pytest.raises(ConfigError, match="initial"):
        CommandSelectorSystem(CONFIG, {}, ROBOT.torso, ROBOT.arms)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"acceleration_arm": float("nan")}, "command_selector.acceleration_arm"),
        ({"trip_force": -1.0}, "command_selector.trip_force"),
    ],
)
def test_bad_config_is_refused_by_name(changes, words):
    with pytest.raises(ConfigError, match=words):
        CommandSelectorSystem(CommandSelectorConfig(**changes), INITIAL, ROBOT.torso, ROBOT.arms)


def test_verdicts_and_modes_travel_as_plain_text():
    assert str(Mode.TURN) == "turn" and str(Verdict.END_STOP) == "end_stop"


def test_whoever_commands_a_group_in_a_mode_is_awake_in_it():
    from valve_drake.behaviors.base_approach_system import BaseApproachSystem
    from valve_drake.behaviors.hybrid_rotation_system import HybridRotationSystem
    from valve_drake.behaviors.image_servo_system import ImageServoSystem
    from valve_drake.behaviors.kinematic_approach_system import KinematicApproachSystem
    from valve_drake.behaviors.valve_search_system import ValveSearchSystem

    awake = {
        "valve_search": ValveSearchSystem.AWAKE,
        "base_approach": BaseApproachSystem.AWAKE,
        "kinematic_approach": KinematicApproachSystem.AWAKE,
        "image_servo": ImageServoSystem.AWAKE,
        "hybrid_rotation": HybridRotationSystem.AWAKE,
    }
    for mode, row in SOURCE.items():
        for block in {*row.values(), TABLE[mode].owner} & set(awake):
            assert awake[block] is None or mode in awake[block], f"{block} in {mode}"


def test_ports_whose_value_stays_are_not_written_again():
    before = start(CONFIG, INITIAL, ROBOT.torso, ROBOT.arms)
    assert changes(before, before) == {}
    moved = dc.replace(before, position=before.position + np.eye(len(before.position))[4], twist=-before.twist)
    assert set(changes(moved, before)) == {"left_arm.position_command", "base.twist_command"}  # -0.0 is not 0.0
