"""Whole runs of the system: short ones here, long ones marked slow."""

import hashlib
import json

import pytest

from valve_drake import cli, runner
from valve_drake import scenario as scenarios
from valve_drake.messages import Mode
from valve_drake.recording.reader import LogReader

QUICK = ["simulation.start.distance=2.6", "simulation.start.bearing=0.1", "simulation.start.heading=0.1"]


def run(path, overrides=(), **options):
    return runner.run(scenarios.load(None, [*QUICK, *overrides]), path, **options)


def sha(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Three seconds: the search ends and driving begins."""
    path = tmp_path_factory.mktemp("run") / "short.mcap"
    return run(path, ["seed=4"], duration=3.0), path


def test_the_search_succeeds_and_the_robot_drives(short):
    result, _ = short
    assert result.summary.sim_time_s == pytest.approx(3.0, abs=0.02)
    assert [span.mode for span in result.summary.spans][:3] == [Mode.IDLE, Mode.SEARCH, Mode.ROUGH_APPROACH]


def test_the_log_is_whole_and_names_its_scenario_and_has_no_result_of_its_own_making(short):
    _, path = short
    reader = LogReader(path)
    assert reader.damage == []
    assert reader.metadata["run"]["seed"] == "4"
    again = scenarios.parse(reader.metadata["run"]["scenario"], "log")
    assert scenarios.dump(again) == reader.metadata["run"]["scenario"]
    assert reader.metadata["result"]["outcome"] == "unfinished"
    assert "layout.json" in reader.attachments
    for topic in ("/head_left/image", "/tf", "/scene", "/joint_states", "/supervisor/mode", "/truth/valve_angle"):
        assert reader.topics[topic].count > 0, topic


def test_the_layout_names_only_topics_of_the_log(short):
    _, path = short
    reader = LogReader(path)
    text = reader.attachments["layout.json"].data.decode()
    json.loads(text)
    from valve_drake.recording.layout import PLOTS, VISIBLE_3D

    late = {"/image_servo/servo", "/hybrid_rotation/turn"}  # blocks that have not spoken yet still have their topic
    for topic in VISIBLE_3D:
        assert topic in reader.topics
    for paths in PLOTS.values():
        for path_ in paths.values():
            assert path_.split(".")[0] in set(reader.topics) | late


def test_same_seed_same_file_to_the_last_byte(short, tmp_path):
    _, path = short
    run(tmp_path / "again.mcap", ["seed=4"], duration=3.0)
    assert sha(tmp_path / "again.mcap") == sha(path)


def test_another_seed_is_another_file(short, tmp_path):
    _, path = short
    run(tmp_path / "other.mcap", ["seed=5"], duration=0.5)
    assert sha(tmp_path / "other.mcap") != sha(path)


def messages(path):
    return [r for r in LogReader(path).records() if not r.topic.startswith("/truth/")]


def test_without_the_truth_ports_every_other_message_is_the_same_to_the_byte(short, tmp_path):
    _, path = short
    run(tmp_path / "blind.mcap", ["seed=4"], duration=3.0, truth=False)
    blind = LogReader(tmp_path / "blind.mcap")
    assert not any(topic.startswith("/truth/") for topic in blind.topics)
    assert messages(tmp_path / "blind.mcap") == messages(path)


def test_an_operators_stop_ends_the_run_still_and_stopped(tmp_path):
    calls = []
    result = run(tmp_path / "stop.mcap", ["seed=4"], stop=lambda: len(calls) > 40, show=calls.append)
    assert result.summary.outcome == "stopped" and result.summary.verdict == "stopped"
    last = list(LogReader(tmp_path / "stop.mcap").messages(["/joint_commands"]))[-1][2]
    twist = {j.name: j.velocity for j in last.joints if j.name.startswith("base")}
    assert all(v == 0 for v in twist.values())


def test_a_full_disk_stops_the_log_and_not_the_run(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    result = run(tmp_path / "full.mcap", ["seed=4"], duration=1.0)
    assert "No space left" in result.log_error


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "nowhere.yaml"], "no such file: nowhere.yaml"),
        (["run", "--set", "valve.height=1"], "unknown key valve"),
        (["run", "--set", "simulation.valve.height=nan"], "finite number"),
        (["run", "--set", "marker.size=[0.3, 0.3]"], "panel"),
        (["run", "--seed", "x"], "--seed"),
        (["run", "--duration", "nan"], "--duration"),
        (["run", "--command", "push"], "push"),
        (["fly"], "fly"),
        ([], "COMMAND"),
        (["recover", "nowhere.mcap", "-o", "x.mcap"], "nowhere.mcap"),
    ],
)
def test_bad_input_gives_one_line_and_exit_code_2(arguments, words, capsys):
    assert cli.main(arguments) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and err.startswith("valve-drake: ") and words in err


def test_run_json_prints_one_object(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick = [word for key in QUICK for word in ("--set", key)]
    assert cli.main(["run", "--duration", "0.2", "--json", "--no-html", "--log", "a.mcap", *quick]) == 0
    result = json.loads(capsys.readouterr().out)
    for key in ("outcome", "verdict", "mode_durations_s", "valve_angle_estimated_rad", "valve_angle_true_rad"):
        assert key in result
    for key in ("sim_time_s", "wall_time_s", "real_time_factor", "peak_hand_force_N", "log"):
        assert key in result
    assert (tmp_path / "a.json").is_file()


@pytest.mark.slow
def test_the_whole_work_turns_the_valve(tmp_path):
    html = tmp_path / "whole.html"
    result = runner.run(scenarios.load(None, ["seed=1"]), tmp_path / "whole.mcap", html=html)
    s = result.summary
    assert (s.outcome, s.verdict) == ("done", "turned")
    assert s.angle_true_rad == pytest.approx(s.command_rad, abs=0.035)
    assert s.angle_camera_rad == pytest.approx(s.angle_true_rad, abs=0.01)
    assert s.turn_peak_hand_force_N < 35 and 0.4 < s.turn_share_left < 0.6
    assert html.stat().st_size > 1e6 and LogReader(tmp_path / "whole.mcap").damage == []


@pytest.mark.slow
def test_a_seized_valve_is_stuck_and_no_hand_is_overloaded(tmp_path):
    result = run(tmp_path / "seized.mcap", ["seed=1", "simulation.valve.seized=true"])
    assert (result.summary.outcome, result.summary.verdict) == ("failed", "stuck")
    assert result.summary.peak_hand_force_N < 60
    assert abs(result.summary.angle_true_rad) < 0.01
