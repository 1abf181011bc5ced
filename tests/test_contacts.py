"""Contact honesty: who held the valve while it turned, what slipped, what was touched besides, by the plant's truth."""

import numpy as np
import pytest
from hands_at_valve import BASE, OUTWARD, SHUT, VALVE, Hands, at_handle
from pydrake.systems.analysis import Simulator
from robot_facts import GROUPS, ROBOT

from valve_drake import diagram
from valve_drake import scenario as scenarios
from valve_drake.analysis import metrics
from valve_drake.frames import compose, inverse, make, planar
from valve_drake.messages import LEFT, RIGHT, SIDES, Contacts
from valve_drake.ports import TICK
from valve_drake.recording.recorder_system import RecorderSystem
from valve_drake.recording.signals import CONTACTS, SLOW, signals
from valve_drake.stations import contacts
from valve_drake.stations.scene import panel_pose


def home(side):
    return ROBOT.arms[side].home


@pytest.fixture(scope="module")
def both():
    hands = Hands(at_handle(LEFT), at_handle(RIGHT))
    hands.command(SHUT)
    return hands.run(0.5).turn(0.3, SIDES)


def test_both_pads_of_both_hands_hold_while_both_hands_turn(both, tmp_path):
    found = both.summary(tmp_path / "run.mcap")
    assert found.angle_true_rad == pytest.approx(0.3, abs=0.02)
    assert min(found.contact_honesty.values()) > 0.98
    assert (found.slips, found.collisions, found.collided) == ({"left": 0, "right": 0}, 0, [])
    last = both.kept[-1][2]
    assert last.left_pads.min() > 10 and last.right_pads.min() > 10  # of 60 N each
    assert found.peak_internal_force_N < 15


def test_a_turn_by_one_hand_is_told_from_one_by_both(tmp_path):
    hands = Hands(at_handle(LEFT), home(RIGHT))
    hands.command(SHUT)
    found = hands.run(0.5).turn(0.3, [LEFT]).summary(tmp_path / "run.mcap")
    assert found.angle_true_rad > 0.2
    assert found.contact_honesty["left"] > 0.95 and found.contact_honesty["right"] == 0.0


def test_a_finger_that_pushes_from_outside_does_not_hold(tmp_path):
    beside = (0.0, -0.045, 0.0)  # above the bar, the hand shut
    hands = Hands(at_handle(LEFT, 0.0, beside), home(RIGHT), opening=0.005)
    found = hands.turn(0.3, [LEFT], left=(0.0, -0.02, 0.0)).summary(tmp_path / "run.mcap")
    assert found.angle_true_rad > 0.15
    assert found.contact_honesty == {"left": 0.0, "right": 0.0}
    assert min(kept[2].left_pads.min() for kept in hands.kept) < -5
    assert found.collisions == 0


def test_hands_that_pull_apart_load_the_valve_from_within(both, tmp_path):
    hands = Hands(at_handle(LEFT), at_handle(RIGHT))
    hands.command(SHUT)
    pulled = {f"{s}_arm.position_command": at_handle(s, 0.0, (0.006 * OUTWARD[s], 0, 0), hands.arms[s]) for s in SIDES}
    hands.run(0.5).run(1.0, lambda share: pulled)
    found = hands.summary(tmp_path / "run.mcap")
    assert found.peak_internal_force_N > both.summary(tmp_path / "both.mcap").peak_internal_force_N + 15
    assert found.contact_honesty is None  # nothing turned


def test_a_hand_that_slides_along_its_handle_slips(tmp_path):
    hands = Hands(at_handle(LEFT), at_handle(RIGHT))
    hands.command(SHUT | {"left_gripper.force_limit": np.array([8.0])})
    hands.run(0.5)
    inwards = [at_handle(LEFT, 0.0, (0.04 * k / 8, 0, 0), hands.arms[LEFT]) for k in range(9)]
    hands.run(1.0, lambda share: {"left_arm.position_command": inwards[int(8 * share)]})
    found = hands.summary(tmp_path / "run.mcap")
    assert found.slips["left"] >= 1 and found.slips["right"] == 0


@pytest.mark.system
def test_a_grip_that_is_lost_in_mid_turn_counts_as_a_slip_and_ends_the_hold(tmp_path):
    hands = Hands(at_handle(LEFT), at_handle(RIGHT))
    hands.command(SHUT)
    hands.run(0.5).turn(0.15, SIDES)
    hands.command({"left_gripper.position_command": np.array([0.08])})
    hands.run(0.25)
    hands.arms[RIGHT] = at_handle(RIGHT, 0.15, near=hands.arms[RIGHT])
    near = [hands.arms[RIGHT]]

    def follow(share):
        near.append(at_handle(RIGHT, 0.15 * (1 + share), near=near[-1]))
        return {"right_arm.position_command": near[-1]}

    found = hands.run(1.5, follow).summary(tmp_path / "run.mcap")
    assert found.slips == {"left": 1, "right": 0}
    assert 0.3 < found.contact_honesty["left"] < 0.7 and found.contact_honesty["right"] > 0.95


def test_a_finger_on_the_panel_and_a_hand_on_the_hub_are_collisions(tmp_path):
    X_BV = compose(inverse(planar(*BASE)), panel_pose(VALVE))
    panel = ROBOT.inverse(LEFT, compose(X_BV, make(np.eye(3), np.array([-0.3, 0.1, -0.03]))))
    further = ROBOT.inverse(LEFT, compose(X_BV, make(np.eye(3), np.array([-0.3, 0.1, 0.01]))), panel)
    hands = Hands(panel, home(RIGHT)).run(0.5)
    hands.run(0.5, lambda share: {"left_arm.position_command": further})
    hands.run(0.5, lambda share: {"left_arm.position_command": panel})
    found = hands.summary(tmp_path / "run.mcap")
    assert found.collisions == len(found.collided) >= 1
    assert {one.bodies for one in found.collided} <= {f"left_finger_{k}_link, panel" for k in (1, 2)}
    first = found.collided[0]
    assert 0.4 < first.time_s < 0.7 and 0.3 < first.duration_s < 0.7 and first.peak_force_N > 20
    assert found.contact_honesty is None and found.slips == {"left": 0, "right": 0}


def test_two_touches_of_one_pair_are_two_collisions_unless_they_are_close(tmp_path):
    def kept(time, *pairs):
        return time, 0.0, Contacts(time=time, touching=pairs, forces=np.full(len(pairs), 5.0 * len(pairs)))

    hands = Hands.__new__(Hands)
    hands.kept = [
        kept(1.0, "a, b"),
        kept(1.0625),
        kept(1.125, "a, b", "c, d"),
        kept(1.1875),
        kept(2.0, "a, b"),
        kept(2.5),
    ]
    found = hands.summary(tmp_path / "run.mcap")
    assert [(one.bodies, one.time_s, one.duration_s, one.peak_force_N) for one in found.collided] == [
        ("a, b", 1.0, 0.1875, 10.0),
        ("c, d", 1.125, 0.0625, 10.0),
        ("a, b", 2.0, 0.0625, 5.0),
    ]


def test_a_hand_that_closes_on_nothing_collides_with_nothing(tmp_path):
    hands = Hands(home(LEFT), home(RIGHT))
    hands.command(SHUT)
    found = hands.run(1.5).summary(tmp_path / "run.mcap")
    assert (found.collisions, found.peak_internal_force_N) == (0, 0.0)


@pytest.mark.system
@pytest.mark.parametrize("name", ["simulated.scenario.yaml", "pr2.scenario.yaml"])
def test_any_robots_hands_hold_by_the_pads_that_its_file_names(name):
    scenario = scenarios.resolve(scenarios.load(name, ["seed=1", "simulation.start.at_valve=true"]))
    station = diagram.make_station(scenario)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    for port, value in diagram.initial_commands(scenario).items():
        station.GetInputPort(port).FixValue(context, value)
    simulator.Initialize()
    for group in ("torso", *(f"{side}_arm" for side in SIDES)):
        here = station.GetOutputPort(f"{group}.position_measured").Eval(context)
        station.GetInputPort(f"{group}.position_command").FixValue(context, here)

    def grip(opening, until):
        for side in SIDES:
            station.GetInputPort(f"{side}_gripper.position_command").FixValue(context, [opening])
            station.GetInputPort(f"{side}_gripper.force_limit").FixValue(context, [60.0])
        simulator.AdvanceTo(until)
        return station.GetOutputPort(CONTACTS).Eval(context)

    found = grip(0.0, 0.75)
    assert min(found.left_pads.min(), found.right_pads.min()) > 10 and found.touching == ()
    found = grip(0.08, 1.5)
    assert not found.left_pads.any() and not found.right_pads.any() and found.touching == ()


# ---------------------------------------------------------------- who may know


def test_no_block_of_the_program_and_no_part_of_the_station_can_read_the_truth():
    scenario = scenarios.resolve(scenarios.load())
    recorder = RecorderSystem(LogSink(), signals(GROUPS, lambda *messages: []))
    system = diagram.make_diagram(scenario, recorder)
    readers = {line for line in diagram.wiring(system.diagram) if line.startswith("station.truth.")}
    assert {line.split(" -> ")[1].split(".")[0] for line in readers} == {"recorder"}
    assert f"station.{CONTACTS} -> recorder.{CONTACTS}" in readers
    inside = diagram.wiring(system.station)
    assert not [line for line in inside if line.startswith(("plant.contacts ", "truth."))]


class LogSink:
    def write(self, topic, message, time): ...

    def flush(self): ...


def test_every_look_at_the_contacts_is_recorded():
    row = next(row for row in signals(GROUPS, lambda *messages: []) if row.topic == "/truth/contacts")
    assert row.period == SLOW and contacts.EVERY * TICK == metrics.PERIOD
    assert metrics.PERIOD % SLOW == 0


def test_a_log_without_contacts_has_no_such_numbers(both, tmp_path):
    hands = Hands.__new__(Hands)
    hands.kept = [(0.0, 0.0, None), (1.0, 1.0, None)]
    found = hands.summary(tmp_path / "old.mcap")
    assert found.angle_true_rad == 1.0
    assert (found.contact_honesty, found.slips, found.collisions, found.peak_internal_force_N) == (None,) * 4
