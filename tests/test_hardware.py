"""hardware: the station made of LCM messages. A puppet robot speaks on an in-process bus, and time is moved by hand."""

import dataclasses as dc
from pathlib import Path

import numpy as np
import pytest
from bad_messages import bad_messages, on
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from robot_facts import GROUPS

from valve_drake import diagram, drawing, resources
from valve_drake import scenario as scenarios
from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.messages import CAMERAS, DEVICES, CameraFrame
from valve_drake.ports import SLOT, TICK
from valve_drake.stations import hardware, lcm_channels
from valve_drake.stations.bus import Bus
from valve_drake.stations.camera_rig import encode_frame
from valve_drake.stations.contract import check_contract, vectors
from valve_drake.stations.hardware import SPEEDS, RobotLink, make_hardware_station
from valve_drake.stations.lcm_channels import (
    CHANNELS,
    COMMANDS,
    CONTROLLER,
    REPORTS,
    REQUEST,
    ROBOT,
    STATE,
    HardwareConfig,
    from_utime,
    image_message,
    to_utime,
)

OUT, IN = vectors(GROUPS, "out"), vectors(GROUPS, "in")
DOCS = Path(__file__).resolve().parent.parent / "docs" / "hardware.md"
SILENT = 0.05  # answer_time of a robot that is to be missed [s]
GREY = np.full((16, 16, 3), 90, np.uint8)


def values(seed: int, ports=OUT) -> dict:
    rng = np.random.default_rng(seed)
    return {port: rng.uniform(-0.2, 0.2, size) for port, size in ports.items()}


class Puppet:
    """A robot that says what it is told to, to a link whose clock is `now`.

    answer_time: only a robot that is to be silent needs a short one [s]; a busy machine takes longer than that.
    """

    def __init__(self, answer_time: float = 10.0, **hardware):
        lcm = DrakeLcm("memq://")
        self.config = HardwareConfig(answer_time=answer_time, image_size=[16, 16], **hardware)
        self.told: list[str] = []
        self.link = RobotLink(Bus(self.config, lcm), GROUPS, notice=self.told.append)
        self.link.clock = lambda: self.now
        self.now = 100.0
        self.bus = Bus(self.config, lcm)
        self.heard: dict[str, list] = {}
        self.bus.listen(CONTROLLER, lambda key, message: self.heard.setdefault(key, []).append(message))
        self.tick = 0
        self.state = {"protocol": 1, "torso": 3, "left_arm": 6, "right_arm": 6, "estop": 0}

    def report(self, said=None, skip=(), utime=None):
        said = values(self.tick) if said is None else said
        utime = to_utime(7 + self.now) if utime is None else utime
        for row in REPORTS:
            if row.key not in skip:
                self.bus.send(row.key, row.encode(utime, said))
        if STATE not in skip:
            self.bus.say(STATE, utime, self.state)

    def image(self, camera, sequence, image=GREY, ago=0.0):
        frame = encode_frame(camera, 7 + self.now - ago, sequence, image, 90)
        self.bus.send(f"{camera}.image", image_message(frame))

    def start(self):
        self.report()
        return self.link.start()

    def step(self, ticks=1, **report):
        """Ticks of the diagram, with a report before each."""
        for _ in range(ticks):
            self.tick += 1
            self.now += TICK
            self.report(**report)
            shown = self.link.update(self.tick * TICK)
        return shown

    def age(self, shown, device):
        return shown.health.ages[shown.health.devices.index(device)]


@pytest.fixture
def puppet():
    puppet = Puppet()
    puppet.start()
    return puppet


# ---------------------------------------------------------------- the table


@pytest.mark.parametrize("row", REPORTS + COMMANDS, ids=lambda row: row.key)
def test_every_message_gives_back_what_was_put_in(row):
    said = values(3, OUT | IN)
    again = row.read(row.kind.decode(row.encode(1234567, said).encode()))
    assert again
    for port, value in again.items():
        np.testing.assert_allclose(value, said[port], rtol=1e-15)
    assert getattr(row.encode(1234567, said), row.stamp) == 1234567


def test_the_table_carries_every_vector_port_of_the_contract_and_every_camera():
    said = values(3, OUT | IN)
    carried = [port for row in REPORTS + COMMANDS for port in row.read(row.encode(0, said))]
    assert sorted(carried) == sorted(OUT | IN)
    assert {f"{camera}.image" for camera in CAMERAS} <= set(CHANNELS)


def test_every_device_that_can_be_silent_has_its_row_in_the_table():
    assert {row.device for row in REPORTS} | {*CAMERAS, "robot"} == set(DEVICES)


def test_the_table_in_the_documents_is_current():
    """If this fails: put what lcm_channels.table() returns into docs/hardware.md."""
    assert lcm_channels.table() in DOCS.read_text(encoding="utf-8")


def test_stamps_on_the_grid_of_slots_come_back_exactly():
    assert all(from_utime(to_utime(k * SLOT)) == k * SLOT for k in range(100_000))


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("hardware.lcm_url=http://x", ["hardware.lcm_url", "udpm", "http"]),
        ("hardware.channels.left_leg=A", ["hardware.channels", "left_leg"]),
        ("hardware.channels={base.command: A, torso.command: A}", ["hardware.channels", "A"]),
        ("hardware.lcm_url=udpm://10.0.0.1:7667", ["hardware.lcm_url", "multicast", "10.0.0.1"]),
        ("hardware.network=''", ["hardware.network", "interface"]),
        ("hardware.channels.base.command=", ["hardware.channels"]),
        ("hardware.channels={base.command: '" + "x" * 64 + "'}", ["hardware.channels", "63"]),
        ("hardware.image_size=[640]", ["hardware.image_size", "640"]),
        ("hardware.image_size=[640, 100000]", ["hardware.image_size", "100000"]),
        ("hardware.answer_time=0", ["hardware.answer_time"]),
        ("hardware.image_age=1.5", ["hardware.image_age", "1.5"]),  # where the head was then is not known any more
        ("hardware.robot_period=0.01", ["hardware.robot_period", "1/128"]),
        ("hardware.lockstep=maybe", ["hardware.lockstep", "true or false"]),
    ],
)
def test_bad_values_give_one_line(override, words):
    with pytest.raises(ConfigError) as caught:
        scenarios.load("hardware.scenario.yaml", [override])
    assert all(word in str(caught.value) for word in words) and "\n" not in str(caught.value)


def test_channels_can_be_renamed_one_by_one():
    config = scenarios.load("hardware.scenario.yaml", ["hardware.channels={base.command: OTHER}"]).hardware
    bus = Bus(config, DrakeLcm("memq://"))
    assert bus.name("base.command") == "OTHER" and bus.name("base.status") == "VALVE_BASE_STATUS"


# ---------------------------------------------------------------- the same controllers


@pytest.fixture(scope="module")
def both():
    found = {}
    for name in ("simulated", "hardware"):
        scenario = scenarios.resolve(scenarios.load(f"{name}.scenario.yaml", ["hardware.lcm_url=memq://"]))
        found[name] = scenario, diagram.make_diagram(scenario)
    return found


def test_the_scenarios_differ_in_the_station_and_nothing_else(both):
    simulated, hardware = (both[name][0] for name in ("simulated", "hardware"))
    assert (simulated.station, hardware.station) == ("simulated", "hardware")
    assert scenarios.dump(dc.replace(hardware, station="simulated")) == scenarios.dump(simulated)


def test_the_diagrams_are_the_same_object_for_object_but_for_the_station(both):
    systems = [both[name][1] for name in ("simulated", "hardware")]
    lists = [drawing.wiring_text(system.diagram) for system in systems]
    assert lists[0] == lists[1]
    assert lists[1] == (resources.diagrams() / "hardware.wiring.txt").read_text()
    blocks = [[(b.get_name(), type(b)) for b in s.diagram.GetSystems() if b is not s.station] for s in systems]
    assert blocks[0] == blocks[1]
    for system in systems:
        check_contract(system.station, GROUPS)
    inside = {b.get_name() for b in systems[1].station.GetSystems()}
    assert inside == {"lcm_receiver", "lcm_sender"}


# ---------------------------------------------------------------- the start


def test_a_robot_that_does_not_answer_is_reported_after_the_stated_time():
    puppet = Puppet(SILENT)
    with pytest.raises(OperationFailed, match="does not answer: nothing on VALVE_BASE_STATUS, .* within 0.05 s"):
        puppet.link.start()


def test_what_is_missing_is_named():
    puppet = Puppet(SILENT)
    puppet.report(skip=("left_arm.status",))
    with pytest.raises(OperationFailed, match="nothing on VALVE_LEFT_ARM_STATUS within"):
        puppet.link.start()


def test_another_version_is_refused():
    puppet = Puppet()
    puppet.state["protocol"] = 2
    with pytest.raises(ConfigError, match="speaks version 2 of the protocol, this program 1"):
        puppet.start()


def test_another_joint_count_is_refused_whoever_tells_it():
    puppet = Puppet()
    puppet.state["left_arm"] = 7
    with pytest.raises(ConfigError, match="left_arm has 7 joints, want 6"):
        puppet.start()
    puppet = Puppet()
    row = CHANNELS["torso.status"]
    message = CHANNELS["left_arm.status"].encode(0, values(0))
    puppet.bus.send(row.key, message)
    with pytest.raises(ConfigError, match="torso: 6 joints, want 3"):
        puppet.start()


def test_another_type_on_a_channel_is_refused():
    puppet = Puppet()
    puppet.bus.lcm.Publish("VALVE_BASE_STATUS", CHANNELS["left_gripper.status"].encode(0, values(0)).encode())
    with pytest.raises(ConfigError, match="VALVE_BASE_STATUS does not carry lcmt_drake_signal"):
        puppet.start()


def test_a_long_wait_for_the_robot_says_what_is_missing_and_the_operator_can_end_it(monkeypatch):
    assert HardwareConfig().answer_time == 30
    monkeypatch.setattr(hardware, "NOTICE", 0.02)
    puppet = Puppet(SILENT)
    puppet.report(skip=("torso.status",))
    with pytest.raises(OperationFailed, match="does not answer"):
        puppet.link.start()
    assert puppet.told == ["waiting up to 0.05 s for the robot: nothing yet on VALVE_TORSO_STATUS"]
    puppet = Puppet(SILENT)
    puppet.link.stop = lambda: True
    with pytest.raises(OperationFailed, match="stopped by the operator before"):
        puppet.link.start()


def test_a_program_does_not_start_beside_another_one_and_gives_no_command():
    puppet = Puppet()
    other = Bus(puppet.config, puppet.bus.lcm)
    other.announce(CONTROLLER)
    puppet.bus.pump()
    with pytest.raises(OperationFailed, match="another program is on"):
        puppet.start()
    assert not {row.key for row in COMMANDS} & set(puppet.heard)


def test_a_program_does_not_start_with_two_robots():
    puppet = Puppet()
    for _ in range(2):
        Bus(puppet.config, puppet.bus.lcm).announce(ROBOT)
    with pytest.raises(OperationFailed, match="2 robots are on"):
        puppet.start()


def test_another_program_or_robot_that_comes_later_is_a_fault(puppet):
    assert not puppet.step(4).health.faults
    others = [Bus(puppet.config, puppet.bus.lcm) for _ in range(2)]
    others[0].announce(CONTROLLER)
    assert "another program commands this robot" in puppet.step(4).health.faults
    for robot in others:
        robot._announced = -np.inf
        robot.announce(ROBOT)
    assert "two robots on the bus" in puppet.step(4).health.faults


def test_lock_step_is_kept_by_both_or_by_none():
    puppet = Puppet(SILENT, lockstep=True)
    with pytest.raises(OperationFailed, match="does not run in lock-step"):
        puppet.start()
    puppet = Puppet(SILENT)
    puppet.bus.say("robot.sync", 0, {"tick": -1, "messages": 0})
    with pytest.raises(ConfigError, match="runs in lock-step"):
        puppet.start()


def test_the_station_waits_for_its_robot_when_it_is_initialised_and_then_shows_what_was_measured():
    puppet = Puppet(SILENT)
    simulator = Simulator(make_hardware_station(puppet.link))
    with pytest.raises(OperationFailed, match="does not answer"):
        simulator.Initialize()
    station, context = simulator.get_system(), simulator.get_context()
    for port in OUT:
        assert np.all(np.isnan(station.GetOutputPort(port).Eval(context))), "what is not known is not zero"
    said = values(5)
    puppet.report(said)
    simulator.Initialize()
    for port in OUT:
        np.testing.assert_allclose(station.GetOutputPort(port).Eval(context), said[port], rtol=1e-15)


def test_commands_go_out_in_slot_3_of_their_tick():
    puppet = Puppet()
    station = make_hardware_station(puppet.link)
    simulator = Simulator(station)
    asked = values(1, IN)
    for port, value in asked.items():
        station.GetInputPort(port).FixValue(simulator.get_mutable_context(), value)
    puppet.report()
    simulator.AdvanceTo(2.9 * SLOT)
    puppet.bus.pump()
    assert not puppet.heard
    simulator.AdvanceTo(2 * TICK)
    puppet.bus.pump()
    for row in COMMANDS:
        first, second = puppet.heard[row.key]
        assert (getattr(first, row.stamp), getattr(second, row.stamp)) == (0, to_utime(TICK))
        for port, value in row.read(first).items():
            np.testing.assert_allclose(value, asked[port], rtol=1e-15)


# ---------------------------------------------------------------- news and silence


def test_ages_are_of_the_receivers_clock(puppet):
    shown = puppet.step(4)
    assert np.all(shown.health.ages == 0) and not shown.health.faults and not shown.health.estop
    shown = puppet.step(32, skip=("left_arm.status",))
    assert puppet.age(shown, "left_arm") == pytest.approx(0.25)
    assert puppet.age(shown, "right_arm") == 0
    assert shown.health.time == puppet.tick * TICK


def test_a_wrist_sensor_that_falls_silent_reads_nan_after_100_ms(puppet):
    port = "left_wrist.wrench"
    quiet = puppet.step(12, skip=("left_wrist_sensor.status",))
    assert np.all(np.isfinite(quiet.values[port]))
    late = puppet.step(1, skip=("left_wrist_sensor.status",))
    assert np.all(np.isnan(late.values[port])) and np.all(np.isfinite(late.values["right_wrist.wrench"]))
    assert np.all(np.isfinite(puppet.step().values[port]))


def test_a_frozen_wrist_sensor_is_as_silent_as_a_dead_one(puppet):
    puppet.step(4)
    same = values(99) | {port: np.zeros(OUT[port]) for port in OUT if port in SPEEDS}
    shown = puppet.step(20, said=same)
    assert np.all(np.isnan(shown.values["left_wrist.wrench"]))
    assert puppet.age(shown, "left_wrist_sensor") > 0.1 and puppet.age(shown, "left_arm") == 0


@pytest.mark.parametrize(("port", "device"), [("base.odometry", "base"), ("left_arm.velocity_measured", "left_arm")])
def test_what_says_that_it_moves_and_says_the_same_again_is_silent(puppet, port, device):
    puppet.step(4)
    still = values(99) | {other: np.zeros(OUT[other]) for other in SPEEDS}
    assert puppet.age(puppet.step(20, said=still), device) == 0
    assert puppet.age(puppet.step(20, said=still | {port: np.full(OUT[port], 0.1)}), device) > 0.1


def test_a_report_that_is_not_finite_is_none_and_a_fault_and_a_wrench_reads_nan_at_once(puppet):
    good = puppet.step(4)
    bad = {port: np.full(size, np.nan) for port, size in OUT.items()}
    shown = puppet.step(4, said=bad)
    np.testing.assert_array_equal(shown.values["left_arm.position_measured"], good.values["left_arm.position_measured"])
    assert np.all(np.isnan(shown.values["left_wrist.wrench"]))
    assert "left_arm: not finite" in shown.health.faults and "left_wrist_sensor: not finite" in shown.health.faults
    assert puppet.age(shown, "left_arm") == pytest.approx(4 * TICK)


def test_duplicates_and_overtaken_reports_change_nothing(puppet):
    first = values(50)
    puppet.step(said=first)
    old = to_utime(7 + puppet.now - 2 * TICK)
    shown = puppet.step(said=values(51), utime=old)
    np.testing.assert_allclose(shown.values["torso.position_measured"], first["torso.position_measured"], rtol=1e-15)
    assert puppet.link.clock() - puppet.link._reports["torso.status"].arrival == pytest.approx(TICK)


def test_a_driver_that_restarts_is_a_fault_and_then_speaks_again(puppet):
    puppet.step(4)
    shown = puppet.step(4, utime=0)
    assert "left_arm restarted" in shown.health.faults
    shown = None
    for k in range(80):
        shown = puppet.step(utime=to_utime((k + 1) * TICK))
    assert not shown.health.faults and np.all(shown.health.ages == 0)


def test_a_wrong_message_on_the_way_is_a_fault_and_no_news(puppet):
    puppet.bus.lcm.Publish("VALVE_TORSO_STATUS", b"nonsense")
    shown = puppet.step(4, skip=("torso.status",))
    assert "VALVE_TORSO_STATUS does not carry lcmt_iiwa_status" in shown.health.faults
    assert puppet.age(shown, "torso") == pytest.approx(4 * TICK)


def test_a_single_bad_message_is_dropped_and_counted(puppet):
    puppet.step(3)
    puppet.bus.lcm.Publish("VALVE_TORSO_STATUS", b"nonsense")
    puppet.link.bus.pump()
    for _ in range(20):
        shown = puppet.step()
        assert not shown.health.faults
    assert puppet.link.dropped == {"torso": 1}


def test_sync_that_is_none_is_dropped(puppet):
    for numbers in ([np.nan, 0.0], [np.inf, 1.0], [], [1.0]):
        puppet.bus.say("robot.sync", 0, {str(k): value for k, value in enumerate(numbers)})
        puppet.link.bus.pump()
    assert puppet.link.dropped == {"robot": 4}


@pytest.mark.parametrize("wild", [2**63 - 1, -(2**63), 0])
def test_a_single_wild_stamp_is_dropped(puppet, wild):
    good = puppet.step(4)
    for row in REPORTS:
        puppet.bus.send(row.key, row.encode(wild, values(9)))
    puppet.link.bus.pump()
    shown = puppet.step(4, said=good.values)
    assert not shown.health.faults
    np.testing.assert_array_equal(shown.values["left_arm.position_measured"], good.values["left_arm.position_measured"])


def test_a_finite_number_that_no_sensor_measures_is_as_good_as_none(puppet):
    good = puppet.step(4)
    shown = puppet.step(4, said={port: np.full(size, 1e300) for port, size in OUT.items()})
    assert "torso: not finite" in shown.health.faults
    np.testing.assert_array_equal(shown.values["torso.position_measured"], good.values["torso.position_measured"])


@pytest.mark.system
@pytest.mark.parametrize("seed", range(4))
def test_whatever_is_sent_to_the_program_it_goes_on_and_recovers(seed):
    puppet = Puppet()
    puppet.start()
    rng = np.random.default_rng(seed)
    said = values(1) | {port: np.zeros(OUT[port]) for port in OUT if port in SPEEDS}
    for message in bad_messages(rng, ROBOT, 600):
        on(puppet.bus, message)
        puppet.link.bus.pump()
        if rng.random() < 0.3:
            shown = puppet.step(said=said)
            for camera in CAMERAS:
                look(puppet, shown, camera)
            puppet.link.send(puppet.tick * TICK, values(1, IN))
    assert sum(puppet.link.dropped.values()) > 100
    for k in range(256):
        shown = puppet.step(said=said | values(1000 + k, {p: n for p, n in OUT.items() if p.endswith("wrench")}))
    assert not shown.health.faults
    np.testing.assert_allclose(shown.values["torso.position_measured"], said["torso.position_measured"])


def test_the_robots_own_faults_and_emergency_stop_are_passed_on(puppet):
    puppet.state |= {"left_arm too hot": 1, "estop": 1}
    shown = puppet.step(4)
    assert shown.health.faults == ("left_arm too hot",) and shown.health.estop


# ---------------------------------------------------------------- images


def look(puppet, shown, camera) -> CameraFrame:
    return puppet.link.look(camera, shown.images[camera], puppet.tick * TICK)


def noise(k):
    return np.random.default_rng(k).integers(0, 255, (16, 16, 3), np.uint8)


def test_a_camera_is_requested_while_it_is_looked_at(puppet):
    shown = puppet.step()
    assert look(puppet, shown, "left_wrist").sequence == -1
    puppet.link.send(puppet.tick * TICK, values(1, IN))
    puppet.bus.pump()
    request = puppet.heard[REQUEST][-1]
    assert dict(zip(request.coord, request.val)) == {c: float(c == "left_wrist") for c in CAMERAS}
    shown = puppet.step(64)
    assert puppet.age(shown, "left_wrist") == pytest.approx(0.5, abs=2 * TICK)  # requested and silent
    assert puppet.age(shown, "right_wrist") == 0
    shown = puppet.step(64)
    puppet.link.send(puppet.tick * TICK, values(1, IN))
    puppet.bus.pump()
    assert not any(puppet.heard[REQUEST][-1].val)
    assert puppet.age(puppet.step(4), "left_wrist") == 0


def test_an_image_carries_when_it_was_taken_on_this_sides_clock(puppet):
    puppet.step(64)
    puppet.image("left_wrist", 7, noise(1), ago=0.05)
    frame = look(puppet, puppet.step(), "left_wrist")
    assert frame.sequence == 7 and frame.image.shape == (16, 16, 3)
    assert frame.time == pytest.approx((puppet.tick - 1) * TICK - 0.05, abs=1e-5)


def test_both_eyes_show_the_newest_instant_that_both_have(puppet):
    puppet.step(8)
    for sequence in (0, 1):
        puppet.image("head_left", sequence, noise(sequence))
        if sequence == 0:
            puppet.image("head_right", 0, noise(10))
        shown = puppet.step(4)
    left, right = (look(puppet, shown, f"head_{side}") for side in ("left", "right"))
    assert left.sequence == right.sequence == 0 and left.time == right.time


def test_an_image_too_old_is_not_shown(puppet):
    puppet.image("left_wrist", 3)
    assert look(puppet, puppet.step(), "left_wrist").sequence == 3
    ticks = int(puppet.config.image_age / TICK)
    assert look(puppet, puppet.step(ticks - 2), "left_wrist").sequence == 3
    assert look(puppet, puppet.step(4), "left_wrist").sequence == -1


def spoilt(way, data):
    return {
        "cut": data[: len(data) // 2],
        "garbage": b"no image" * 50,
        "empty": b"",
        "of pixels only at its start": data[:-200] + bytes(200),
    }[way]


@pytest.mark.parametrize("way", ["cut", "garbage", "empty", "of pixels only at its start"])
def test_an_image_that_cannot_be_decoded_is_no_news_and_a_fault_if_it_goes_on(puppet, way):
    puppet.image("left_wrist", 0, noise(0))
    assert look(puppet, puppet.step(), "left_wrist").sequence == 0
    puppet.link.send(puppet.tick * TICK, values(1, IN))
    faults = []
    for k in range(1, 130):
        if k % 16 == 1:
            message = image_message(encode_frame("left_wrist", 7 + puppet.now, k, noise(k), 90))
            image = message.images[0]
            image.data = spoilt(way, bytes(image.data))
            image.size = len(image.data)
            puppet.bus.send("left_wrist.image", message)
        shown = puppet.step()
        assert look(puppet, shown, "left_wrist").sequence in (0, -1)
        puppet.link.send(puppet.tick * TICK, values(1, IN))
        faults.append("left_wrist: an image that cannot be decoded" in shown.health.faults)
    assert puppet.link.dropped["left_wrist"] == 9
    assert not any(faults[:60]) and all(faults[72:])
    assert puppet.age(shown, "left_wrist") == pytest.approx(1.0, abs=0.1), "and none of them was news"
    puppet.image("left_wrist", 200, noise(7))
    shown = puppet.step(4)
    assert look(puppet, shown, "left_wrist").sequence == 200 and puppet.age(shown, "left_wrist") < 0.05


def test_a_single_image_that_cannot_be_decoded_is_no_fault_and_its_fellow_is_not_shown(puppet):
    for sequence, way in ((0, None), (1, "cut"), (2, None)):
        for camera in ("head_left", "head_right"):
            frame = encode_frame(camera, 7 + puppet.now, sequence, noise(2 * sequence + (camera == "head_left")), 90)
            broken = way is not None and camera == "head_left"
            frame = dc.replace(frame, data=spoilt(way, frame.data)) if broken else frame
            puppet.bus.send(f"{camera}.image", image_message(frame))
        seen = set()
        for _ in range(16):
            shown = puppet.step()
            assert not shown.health.faults
            left, right = (look(puppet, shown, f"head_{side}").sequence for side in ("left", "right"))
            seen.add((left, right))
        assert (sequence, sequence) in seen or way is not None
        assert all(left in (right, -1) for left, right in seen)


@pytest.mark.parametrize("size", [(10, 10), (3000, 4000), (16, 17)])
def test_an_image_of_another_size_is_no_news(puppet, size):
    puppet.image("left_wrist", 3, np.zeros((*size, 3), np.uint8))
    assert look(puppet, puppet.step(), "left_wrist").sequence == -1
    assert puppet.link.dropped == {"left_wrist": 1}


def test_an_image_that_claims_the_right_size_and_has_another_one_is_not_decoded(puppet, monkeypatch):
    monkeypatch.setattr(hardware, "decode_image", lambda data: pytest.fail("decoded"))
    frame = encode_frame("left_wrist", 7 + puppet.now, 3, np.zeros((48, 64, 3), np.uint8), 90)
    message = image_message(frame)
    message.images[0].width = message.images[0].height = 16
    puppet.bus.send("left_wrist.image", message)
    assert look(puppet, puppet.step(), "left_wrist").sequence == -1


def test_images_that_come_too_late_are_no_news_and_a_fault_if_that_goes_on(puppet):
    puppet.step(8)
    words = "left_wrist: images come 0.9 s after they were taken, want 0.8 s"
    faults = []
    for k in range(200):
        if k % 32 == 0:
            puppet.image("left_wrist", k, noise(k), ago=0.9)
        shown = puppet.step()
        assert look(puppet, shown, "left_wrist").sequence == -1
        puppet.link.send(puppet.tick * TICK, values(1, IN))
        faults.append(words in shown.health.faults)
    assert not any(faults[:112]) and all(faults[128:])
    assert puppet.age(shown, "left_wrist") > 1.0


def test_an_image_from_the_future_is_no_news(puppet):
    puppet.step(8)
    puppet.image("left_wrist", 3, noise(1), ago=-0.5)
    assert look(puppet, puppet.step(), "left_wrist").sequence == -1
    assert puppet.link.dropped == {"left_wrist": 1}


def test_a_frozen_camera_is_silent(puppet):
    puppet.link.look("left_wrist", None, 0.0)
    for sequence in range(40):
        puppet.link.look("left_wrist", None, puppet.tick * TICK)
        puppet.link.send(puppet.tick * TICK, values(1, IN))
        puppet.image("left_wrist", sequence, GREY)
        shown = puppet.step()
    assert puppet.age(shown, "left_wrist") > 0.25


def test_images_that_are_asked_for_are_decoded_while_there_is_time(puppet):
    puppet.link.look("left_wrist", None, 0.0)
    puppet.link.send(0.0, values(1, IN))
    puppet.image("left_wrist", 0)
    puppet.image("right_wrist", 0)
    shown = puppet.step()
    puppet.link.pass_time(0.002)
    assert shown.images["left_wrist"].frame is None
    puppet.link.pass_time(0.006)
    assert shown.images["left_wrist"].frame is not None and shown.images["right_wrist"].frame is None
