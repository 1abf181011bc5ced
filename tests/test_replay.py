"""Replay: the recorded station, the comparison, and the command."""

import dataclasses as dc
import itertools
import json
import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from log_samples import write_log
from pydrake.systems.analysis import Simulator
from robot_facts import GROUPS

from valve_drake import cli, player, resources, runner
from valve_drake import diagram as wires
from valve_drake import scenario as scenarios
from valve_drake.analysis.comparison import Comparison, differences
from valve_drake.messages import Command, Mode, Status
from valve_drake.pace import PACE, Pace
from valve_drake.ports import SLOT, TICK
from valve_drake.recording import foxglove
from valve_drake.recording.reader import LogReader
from valve_drake.recording.recovery import recover
from valve_drake.recording.schemas import Encoded, serialized
from valve_drake.recording.signals import measured
from valve_drake.recording.writer import LogWriter
from valve_drake.stations import contract
from valve_drake.stations.replay import Recording, make_replay_station

QUICK = ["simulation.start.distance=2.6", "simulation.start.bearing=0.1", "simulation.start.heading=0.1", "seed=4"]
STOP = 2.5  # when the operator stops the run [s]


HEAD, TAUGHT = "calibration/head.yaml", "taught/hands.yaml"


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """A run of three seconds: search, driving, and the operator's stop. The files that it named are gone."""
    path, now = tmp_path_factory.mktemp("run") / "short.mcap", [0.0]
    head, taught = (Path(shutil.copy(resources.models() / file, path.parent)) for file in (HEAD, TAUGHT))

    def show(progress):
        now[0] = progress.sim_time

    scenario = scenarios.load(None, [*QUICK, f"head_calibration={head}", f"taught={taught}"])
    runner.run(scenario, path, duration=3.0, show=show, stop=lambda: now[0] >= STOP)
    head.unlink()
    taught.unlink()
    return path


@pytest.fixture(scope="module")
def log(path):
    return LogReader(path)


@pytest.fixture(scope="module")
def recording(log):
    return Recording(log, GROUPS)


def rewritten(log, path, topics=lambda topic: True, end=0.1, files=True, also=(), **facts):
    """A log with some of the messages of another and, last, more of them (topic, message, time); other metadata."""
    with LogWriter(path) as writer:
        writer.write_metadata("run", log.metadata["run"] | facts)
        for file in log.attachments.values() if files else ():
            writer.attach(file.name, file.media_type, file.data)
        for record in log.records([t for t in log.topics if topics(t)], end=end):
            kind = serialized(log.decode(record)).kind
            writer.write(record.topic, Encoded(kind, record.data), record.time)
        for message in also:
            writer.write(*message)
    return path


def one_line(capsys, arguments, code):
    assert cli.main([str(a) for a in arguments]) == code
    err = capsys.readouterr().err
    assert err.startswith("valve-drake: ") and err.count("\n") == 1
    return err


# ---- the station


def station_of(name, recording):
    scenario = scenarios.resolve(scenarios.load(None, [f"station={name}"]))
    return wires.make_diagram(scenario, recording=recording)


@pytest.mark.parametrize("name", ["simulated", "replay"])
def test_every_station_keeps_the_contract_and_the_wiring_is_the_same(name, recording):
    system = station_of(name, recording)
    contract.check_contract(system.station, GROUPS)
    wired = {f"{source} -> {target}" for source, target in wires.WIRES}
    assert set(wires.wiring(system.diagram)) == wired
    extra = set(contract.ports_of(system.station)) - {spec.name for spec in contract.CONTRACT}
    assert all(port.startswith(contract.TRUTH) for port in extra) and bool(extra) == (name == "simulated")


@pytest.fixture(scope="module")
def read(recording):
    """read(port, time): what the recorded station shows then."""
    station = make_replay_station(recording)
    context = station.CreateDefaultContext()

    def read(port, when):
        context.SetTime(when)
        return station.GetOutputPort(port).Eval(context)

    return read


def test_vectors_are_shown_from_the_tick_at_which_robot_state_read_them(log, read):
    for _, when, states in itertools.islice(log.messages(["/joint_states"]), 100, 103):
        joints = {joint.name: joint for joint in states.joints}
        for port, names in measured(GROUPS).items():
            values = [getattr(joints[name.split(".")[0]], name.split(".")[1]) for name in names]
            for slot in range(4):
                assert read(port, when + slot * SLOT).tolist() == values
    _, when, wrench = next(itertools.islice(log.messages(["/left_wrist/wrench"]), 100, None))
    assert read("left_wrist.wrench", when).tolist() == [*wrench.torque, *wrench.force]


def test_health_is_shown_right_after_the_tick_at_which_it_was_reported(log, read):
    for _, when, health in itertools.islice(log.messages(["/health"]), 1, None):
        reported = when - TICK
        assert health.time == reported
        assert read("health", reported) is not read("health", reported + SLOT)
        assert {read("health", reported + slot * SLOT).time for slot in (1, 2, 3)} == {reported}
        assert read("health", reported + SLOT) is read("health", reported + 2 * SLOT)  # or it would be logged again


def test_images_are_those_that_the_stage_looked_at_when_it_did(log, read):
    seen = [(t, pair) for _, t, pair in log.messages(["/color_segmentation/segmentation"]) if pair.sequence >= 0]
    images = [message for _, _, message in log.messages(["/head_right/image"])]
    assert len(seen) == len(images) > 3
    for (when, pair), image in zip(seen, images):
        frame = read("head_right.image", when - TICK + SLOT)
        assert (frame.time, frame.sequence) == (pair.right.frame.time, pair.right.frame.sequence)
        assert frame.data == image.data and frame.image.shape == (480, 640, 3)
    assert read("head_right.image", 0.0).sequence == read("left_wrist.image", 1.0).sequence == -1


def test_commands_are_accepted_and_change_nothing(recording):
    station = make_replay_station(recording)
    context = station.CreateDefaultContext()
    context.SetTime(1.0)
    before = station.GetOutputPort("left_arm.position_measured").Eval(context)
    station.GetInputPort("left_arm.position_command").FixValue(context, np.full(6, 9.0))
    assert (station.GetOutputPort("left_arm.position_measured").Eval(context) == before).all()


def test_a_run_cannot_be_made_on_the_replay_station(tmp_path, capsys):
    there = tmp_path / "a.mcap"
    assert "replay LOG" in one_line(capsys, ["run", "--set", "station=replay", "--log", there, "--no-html"], 2)
    assert list(tmp_path.iterdir()) == []


# ---- the whole


def test_an_unchanged_program_makes_every_message_again_to_the_bit(log):
    result = runner.replay(log)
    assert result.comparison.identical and result.comparison.first is None
    assert result.as_json()["first_divergence"] is None and result.as_json()["max_difference"] == 0.0
    assert result.end == log.end == 3.0
    recorded = {name for name in log.topics if not name.startswith("/truth/")}
    assert set(result.comparison.topics) == recorded and len(recorded) > 35
    count = sum(log.topics[name].count for name in recorded)
    assert result.as_json()["messages_compared"] == count == sum(t.equal for t in result.comparison.topics.values())


def test_the_run_was_stopped_by_the_operator_in_the_midst_of_a_tick(log):
    requests = list(log.messages(["/operator/command"]))
    assert [r.command for _, _, r in requests] == ["open", "stop"]
    assert requests[1][1] == STOP + TICK
    assert list(log.messages(["/supervisor/mode"]))[-1][2].mode == Mode.STOPPED


def test_a_changed_gain_is_found_at_the_first_command_that_it_changes(path, log, capsys):
    gain = scenarios.parse(log.metadata["run"]["scenario"], "the log").base_approach.acceleration
    assert cli.main(["replay", str(path), "--json", "--set", f"base_approach.acceleration={gain / 2}"]) == 0
    result = json.loads(capsys.readouterr().out)
    commands = log.series("/base_approach/command", ["base_twist"])
    driving = int(np.argmax(np.nan_to_num(commands["base_twist"][:, 0]) > 0))
    first = result["first_divergence"]
    assert not result["identical"]
    assert (first["topic"], first["field"]) == ("/base_approach/command", "base_twist[0]")
    assert first["time_s"] == commands["time"][driving] > 0.4
    assert first["replayed"] == pytest.approx(first["recorded"] / 2)
    touched = {"/base_approach/command", "/joint_commands", "/command_selector/report"}
    assert set(result["differences"]) <= touched  # the rest of what was seen and thought is as it was
    there = result["differences"]["/base_approach/command"]
    assert there["recorded"] == there["replayed"] == log.topics["/base_approach/command"].count
    assert 0.01 < there["max_difference"] == result["max_difference"] < 1.0
    assert result["real_time_factor"] > 0


def test_another_image_threshold_is_found_in_the_first_image(path, log, capsys):
    assert cli.main(["replay", str(path), "--set", "color_segmentation.min_area=12000"]) == 0
    out = capsys.readouterr().out
    looked = next(t for _, t, p in log.messages(["/color_segmentation/segmentation"]) if p.sequence >= 0)
    assert f"different from t = {looked:.4f} s: /color_segmentation/segmentation left.candidates" in out
    images = re.findall(r"/head_(?:left|right)/image +\d+ +(\d+) +(\d+)", out)
    assert len(images) == 2  # it looks less often, as it stays in search; what it looks at is as recorded
    assert all(replayed == equal for replayed, equal in images)


@pytest.mark.system
def test_the_replays_own_log_is_the_same_without_the_truth_and_can_be_replayed(path, log, tmp_path, capsys):
    copy = tmp_path / "copy.mcap"
    assert cli.main(["replay", str(path), "--log", str(copy), "--json"]) == 0
    again = LogReader(copy)
    recorded = [name for name in log.topics if not name.startswith("/truth/")]
    assert list(again.records()) == list(log.records(recorded))
    assert again.metadata["run"]["replay_of"] == "short.mcap" and again.metadata["result"] == log.metadata["result"]
    assert runner.replay(again).comparison.identical


@pytest.mark.system
def test_a_log_replays_with_its_own_files_and_set_names_others(path, log, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert log.attachments["head_calibration.yaml"].data == (resources.models() / HEAD).read_bytes()
    assert log.attachments["taught.yaml"].data == (resources.models() / TAUGHT).read_bytes()
    assert not runner.replay(log).notes
    shipped = runner.replay(log, [f"head_calibration={HEAD}", f"taught={TAUGHT}"], copy=tmp_path / "shipped.mcap")
    assert shipped.comparison.identical
    other = (resources.models() / HEAD).read_text(encoding="utf-8").replace("u_0: 3", "u_0: 2")  # 100 px beside
    (tmp_path / "other.yaml").write_text(other, encoding="utf-8")
    changed = runner.replay(log, ["head_calibration=other.yaml"], copy=tmp_path / "changed.mcap")
    assert changed.comparison.topics["/head_left/calibration"].largest.field == "K[2]"
    assert not changed.comparison.topics["/stereo_positioning/position"].identical
    (tmp_path / "other.yaml").unlink()  # the replay's own log stands alone, too
    assert runner.replay(LogReader("changed.mcap")).comparison.identical
    assert "no such file: nowhere.yaml" in one_line(capsys, ["replay", path, "--set", "taught=nowhere.yaml"], 2)


def test_a_log_without_its_files_is_replayed_with_those_of_today_and_says_so(log, tmp_path):
    facts = {"scenario": log.metadata["run"]["scenario"]}
    for key, file in (("head_calibration", HEAD), ("taught", TAUGHT)):
        recorded = next(line for line in facts["scenario"].splitlines() if line.startswith(f"{key}: "))
        facts["scenario"] = facts["scenario"].replace(recorded, f"{key}: {file}")
    result = runner.replay(LogReader(rewritten(log, tmp_path / "a.mcap", files=False, **facts)))
    assert result.comparison.identical
    assert f"the log does not hold its taught: {TAUGHT} of today stands in" in result.notes


@pytest.mark.system
@pytest.mark.parametrize("kind", ["cut off", "flipped"])
def test_a_damaged_log_is_replayed_up_to_the_damage(kind, path, tmp_path, capsys):
    data, bad = path.read_bytes(), tmp_path / "bad.mcap"
    middle = int(0.6 * len(data))
    rest = b"" if kind == "cut off" else bytes([data[middle] ^ 1]) + data[middle + 1 :]
    bad.write_bytes(data[:middle] + rest)
    damaged = LogReader(bad)
    assert damaged.damage
    assert cli.main(["replay", str(bad), "--json"]) == 3
    result = json.loads(capsys.readouterr().out)
    assert result["identical"] and result["damage"] == damaged.damage
    assert 0.4 < result["replayed_s"] < 2.6 and "incomplete" in result["notes"][-1]
    recover(bad, tmp_path / "recovered.mcap")
    saved = runner.replay(LogReader(tmp_path / "recovered.mcap"))
    assert saved.comparison.identical and saved.end == result["replayed_s"]


@pytest.mark.system
def test_a_paced_robots_log_is_identical_though_the_walls_clock_does_not_come_again(log, tmp_path):
    pace = PACE, Pace(1.5, 192, 1, 0.01, 0.002, 0.006, 0.02), 1.5
    paced = rewritten(log, tmp_path / "a.mcap", lambda topic: not topic.startswith("/truth/"), 1.5, also=[pace])
    comparison = runner.replay(LogReader(paced)).comparison
    assert comparison.identical and PACE not in comparison.topics and len(comparison.topics) > 30


@pytest.mark.system
def test_a_robots_log_has_no_truth_and_is_replayed_and_reviewed_as_any(path, log, tmp_path, capsys):
    scenario = log.metadata["run"]["scenario"].replace("station: simulated", "station: hardware")
    robots = rewritten(
        log,
        tmp_path / "a.mcap",
        lambda topic: not topic.startswith("/truth/"),
        3.0,
        station="hardware",
        scenario=scenario,
    )
    assert not any("truth" in topic for topic in LogReader(robots).topics)
    result = runner.replay(LogReader(robots))
    assert result.comparison.identical and result.end == 3.0 and not result.notes
    assert cli.main(["review", str(robots), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["sound"] and facts["angle_true_rad"] is None and facts["outcome"] != "done"
    assert cli.main(["review", str(robots), str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["topics"]["/joint_states"]["first"] is None and facts["settings"] == {
        "station": {"a": "hardware", "b": "simulated"}
    }


def test_a_logs_own_robot_is_used_where_the_file_that_it_names_is_gone(log, tmp_path):
    scenario = log.metadata["run"]["scenario"].replace("robot: robot/robot.yaml", "robot: gone/robot.yaml")
    assert "gone/robot.yaml" in scenario
    moved = rewritten(log, tmp_path / "a.mcap", lambda topic: True, 1.0, scenario=scenario)
    assert runner.replay(LogReader(moved)).comparison.identical


@pytest.mark.parametrize("topic", ["/health", "/joint_states", "/operator/command", "/left_wrist/wrench"])
def test_a_missing_topic_is_named_in_one_line(topic, log, tmp_path, capsys):
    lacking = rewritten(log, tmp_path / "a.mcap", lambda name: name != topic)
    assert f"no messages of {topic}\n" in one_line(capsys, ["replay", lacking], 2)


def test_a_missing_image_is_named_in_one_line(log, tmp_path, capsys):
    first = next(log.messages(["/head_left/image"]))[1]
    lacking = rewritten(log, tmp_path / "a.mcap", lambda name: name != "/head_left/image", end=first + 0.1)
    assert f"lacks the image 0 of head_left at t = {first:.3f} s" in one_line(capsys, ["replay", lacking], 2)


def claiming(jpeg, width, height):
    """The JPEG with another size in its header."""
    at = jpeg.index(b"\xff\xc0") + 5
    return jpeg[:at] + struct.pack(">HH", height, width) + jpeg[at + 4 :]


@pytest.mark.parametrize("change", [lambda data: data[:200] + b"\xff\xd9", lambda data: claiming(data, 30000, 30000)])
def test_an_image_that_cannot_be_decoded_is_named_in_one_line(change, log, tmp_path, capsys):
    _, first, image = next(log.messages(["/head_left/image"]))
    bad = CompressedImage.FromString(image.SerializeToString())
    bad.data = change(image.data)
    also, others = [("/head_left/image", bad, first)], lambda name: name != "/head_left/image"
    path = rewritten(log, tmp_path / "a.mcap", others, end=first + 0.1, also=also)
    words = f"holds an image that cannot be decoded: of head_left at t = {first:.3f} s"
    assert words in one_line(capsys, ["replay", path], 2)


@pytest.mark.parametrize("topic", ["/health", "/joint_states", "/left_wrist/wrench", "/handle_marker/marks"])
def test_a_topic_of_another_schema_is_named_in_one_line(topic, log, tmp_path, capsys):
    other = [(topic, Status(time=0.0), 0.0)]
    path = rewritten(log, tmp_path / "a.mcap", lambda name: name != topic, also=other)
    assert f"{topic} holds valve_drake.Status, not " in one_line(capsys, ["replay", path], 2)


def test_a_log_of_another_version_is_refused_in_one_line_or_noted(log, tmp_path, capsys):
    scenario = log.metadata["run"]["scenario"]
    newer = rewritten(log, tmp_path / "newer.mcap", scenario=scenario + "tentacles: 8\n")
    assert "unknown key tentacles" in one_line(capsys, ["replay", newer], 2)
    lines = [line for line in scenario.splitlines() if "line_speed" not in line]
    older = rewritten(log, tmp_path / "older.mcap", scenario="\n".join(lines), numpy="0.1")
    result = runner.replay(LogReader(older))
    assert result.comparison.identical and any("lacks keys" in note for note in result.notes)
    assert any(note.startswith("numpy was 0.1, is ") for note in result.notes)


def test_what_is_no_log_of_a_run_is_refused_in_one_line(path, tmp_path, capsys):
    (tmp_path / "text").write_text("not a log at all, but long enough to be one")
    (tmp_path / "empty").write_bytes(b"")
    write_log(tmp_path / "other.mcap", 0.1)
    with LogWriter(tmp_path / "bare.mcap") as writer:
        writer.write("/health", Status(), 0.0)
    (tmp_path / "stump").write_bytes(path.read_bytes()[:5000])
    for name, code, words in (
        ("text", 2, "not an MCAP log"),
        ("empty", 2, "empty"),
        ("nowhere", 2, "no log"),
        ("other.mcap", 2, "unknown key a"),
        ("bare.mcap", 2, "does not hold its scenario"),
        ("stump", 3, "breaks off"),
    ):
        assert words in one_line(capsys, ["replay", tmp_path / name], code)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "seed=5"], "--set seed: it is recorded"),
        (["--set", "simulation.valve.height=1"], "it is recorded"),
        (["--set", "base_approach.hurry=1"], "unknown key base_approach.hurry"),
        (["--set", "base_approach.speed=-1"], "base_approach.speed"),
        (["--set", "'seed'=5"], "unknown key"),
        (["--set", "rectangle_estimator.method=paper\nseed: 5"], "not YAML"),
        (["--log", "{path}"], "another file"),
        (["--log", "{path}.json"], "ends in .mcap"),
        (["--log", ""], "--log must be"),
        (["--log", "/"], "--log must be"),
    ],
)
def test_a_replay_that_makes_no_sense_is_refused_in_one_line(arguments, words, path, capsys):
    before = path.read_bytes()
    assert words in one_line(capsys, ["replay", path, *(a.format(path=path) for a in arguments)], 2)
    assert path.read_bytes() == before


# ---- the comparison


@pytest.fixture
def small(tmp_path):
    """Two topics and the truth, three ticks."""
    with LogWriter(tmp_path / "small.mcap") as writer:
        for k in range(3):
            writer.write("/a/command", Command(time=k, base_twist=[0.1 * k, 0.0]), k * TICK)
            writer.write("/b/status", Status(time=k, detail=f"step {k}"), k * TICK)
            writer.write("/truth/x", Status(), k * TICK)
    return LogReader(tmp_path / "small.mcap")


def compared(log, change=lambda topic, k, message: message, end=1.0):
    comparison = Comparison(log, end)
    for topic, when, message in log.messages():
        if (changed := change(topic, round(when / TICK), message)) is not None:
            comparison.write(topic, changed, when)
    comparison.finish()
    return comparison


def test_equal_messages_are_identical_and_the_truth_is_left_out(small):
    found = compared(small)
    assert found.identical and set(found.topics) == {"/a/command", "/b/status"}
    assert all(topic.equal == 3 for topic in found.topics.values())


def test_bytes_of_a_type_that_had_other_fields_are_no_message_of_todays(small):
    found = compared(small)
    assert found._canonical("/a/command", b"") == b"" and found._canonical("/a/command", b"\x0f") is None


def test_the_first_difference_of_a_tick_is_that_of_the_topic_that_comes_first(small):
    def change(topic, k, message):
        if k == 0:
            return message
        return Status(time=1.0 * k) if topic == "/b/status" else Command(time=1.0 * k, base_twist=[0.1 * k, 0.5 * k])

    found = compared(small, change)
    assert found.first == (TICK, "/a/command", "base_twist[1]", 0.0, 0.5)
    assert found.topics["/b/status"].first == (TICK, "/b/status", "detail", "step 1", "")
    assert found.max_difference == found.topics["/a/command"].max_difference == 1.0
    assert found.topics["/a/command"].largest.time == 2 * TICK
    assert found.topics["/b/status"].largest is None and found.topics["/b/status"].equal == 1


@pytest.mark.parametrize("k", [0, 1, 2])
def test_a_missing_message_is_a_difference(small, k):
    found = compared(small, lambda topic, tick, message: None if (topic, tick) == ("/b/status", k) else message)
    assert str(found.first) == "/b/status not in the replay" and found.first.time == k * TICK
    assert (found.topics["/b/status"].recorded, found.topics["/b/status"].replayed) == (3, 2)
    assert found.topics["/a/command"].identical


def test_an_additional_message_or_topic_is_a_difference(small):
    comparison = Comparison(small, 1.0)
    more = [("/c/status", 2 * TICK, Status()), ("/a/command", 3 * TICK, Command())]
    for topic, when, message in [*small.messages(), *more]:
        comparison.write(topic, message, when)
    comparison.finish()
    assert str(comparison.first) == "/c/status only in the replay"
    assert comparison.topics["/a/command"].first.time == 3 * TICK
    assert not comparison.topics["/c/status"].identical and not comparison.topics["/a/command"].identical


def test_a_message_that_is_written_down_in_another_way_is_equal_and_one_with_an_unknown_field_is_not(small):
    def change(topic, k, message):
        kind, data = serialized(message)
        return Encoded(kind, data + {0: b"", 1: b"\x09" + bytes(8), 2: b"\xf8\x3f\x01"}[k])  # time again; field 1023

    zero = {"/a/command": Command(base_twist=[0.0, 0.0]), "/b/status": Status()}
    with LogWriter(small.path.with_name("zeros.mcap")) as writer:
        for k in range(3):
            for topic, message in zero.items():
                writer.write(topic, message, k * TICK)
    found = compared(LogReader(small.path.with_name("zeros.mcap")), change)
    assert [topic.equal for topic in found.topics.values()] == [2, 2]
    assert found.first == (2 * TICK, "/a/command", "(encoding)", "", "")


def test_nothing_after_the_end_is_compared(small):
    found = Comparison(small, TICK)
    for topic, when, message in small.messages(end=TICK):
        found.write(topic, message, when)
    found.finish()
    assert found.identical and found.topics["/a/command"].recorded == 2


def test_differences_name_the_field_and_see_single_bits():
    nan = float("nan")
    assert differences(Command(base_twist=[nan, 0.0]), Command(base_twist=[nan, 0.0])) == []
    found = differences(Command(base_twist=[0.0, 1.0]), Command(base_twist=[-0.0, 1.0]))
    assert [field for field, _, _ in found] == ["base_twist[0]"]
    assert [d[0] for d in differences(Command(), Command(torso=[1, 2, 3]))] == ["torso"]
    a, b = (foxglove.log(1.0, "x", text) for text in ("same", "other"))
    assert differences(a, a) == [] and differences(a, b) == [("message", "same", "other")]
    assert [d[0] for d in differences(foxglove.log(1.0, "x", ""), foxglove.log(1.5, "x", ""))] == ["timestamp.nanos"]


@pytest.mark.system
def test_a_simulator_on_the_recorded_station_comes_to_the_same_bits(log, recording):
    scenario, _ = runner._recorded_scenario(log)
    with runner._files_of(log, scenarios.with_overrides(dc.replace(scenario, station="replay"), []), []) as files:
        comparison = Comparison(log, recording.end)
        system = wires.make_diagram(files, runner.make_recorder(comparison, files), recording=recording)
        simulator, requests = Simulator(system.diagram), recording.requests
        wires.command(system, simulator.get_mutable_context(), requests.values[0])
        simulator.Initialize()
        for when, request in zip(requests.times[1:], requests.values[1:]):
            simulator.AdvanceTo(when - TICK)
            wires.command(system, simulator.get_mutable_context(), request)
        simulator.AdvanceTo(recording.end)
    comparison.finish()
    assert comparison.identical


def test_a_block_whose_times_are_no_slots_is_refused():
    with pytest.raises(ValueError, match="no multiple of a slot"):
        player._slots(TICK / 3)
