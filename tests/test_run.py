"""Whole runs of the system: short ones here, long ones marked slow."""

import contextlib
import hashlib
import json
import os
import re
import signal
import socket

import pytest
from robot_variants import fixed, stiff_neck, variant, without_base_joints, without_waist

from valve_drake import cli, runner
from valve_drake import scenario as scenarios
from valve_drake.checks import OperationFailed
from valve_drake.messages import Mode, ModeState
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


@pytest.mark.system
def test_same_seed_same_file_to_the_last_byte(short, tmp_path):
    _, path = short
    run(tmp_path / "again.mcap", ["seed=4"], duration=3.0)
    assert sha(tmp_path / "again.mcap") == sha(path)


@pytest.mark.system
def test_another_seed_is_another_file(short, tmp_path):
    _, path = short
    run(tmp_path / "other.mcap", ["seed=5"], duration=0.5)
    assert sha(tmp_path / "other.mcap") != sha(path)


def messages(path):
    return [r for r in LogReader(path).records() if not r.topic.startswith("/truth/")]


@pytest.mark.system
def test_without_the_truth_ports_every_other_message_is_the_same_to_the_byte(short, tmp_path):
    _, path = short
    run(tmp_path / "blind.mcap", ["seed=4"], duration=3.0, truth=False)
    blind = LogReader(tmp_path / "blind.mcap")
    assert not any(topic.startswith("/truth/") for topic in blind.topics)
    assert messages(tmp_path / "blind.mcap") == messages(path)


@pytest.mark.system
def test_an_operators_stop_ends_the_run_still_and_stopped(tmp_path):
    calls = []
    result = run(tmp_path / "stop.mcap", ["seed=4"], stop=lambda: len(calls) > 40, show=calls.append)
    assert result.summary.outcome == "stopped" and result.summary.verdict == "stopped"
    last = list(LogReader(tmp_path / "stop.mcap").messages(["/joint_commands"]))[-1][2]
    twist = {j.name: j.velocity for j in last.joints if j.name.startswith("base")}
    assert all(v == 0 for v in twist.values())


def command(capsys, *arguments):
    """`valve-drake run` with a near start -> exit code, what it prints, what it says."""
    quick = [word for key in QUICK for word in ("--set", key)]
    code = cli.main(["run", "--no-html", *quick, *arguments])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def full_disk(monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)


@pytest.mark.system
def test_a_full_disk_stops_the_log_and_not_the_run(tmp_path, monkeypatch):
    full_disk(monkeypatch)
    said = []
    result = run(tmp_path / "full.mcap", ["seed=4"], duration=1.0, say=said.append)
    assert "No space left" in result.log_error and said == [result.log_error]
    assert result.log == tmp_path / "full.mcap.active"
    assert result.summary.sim_time_s == pytest.approx(1.0, abs=0.02)


@pytest.mark.system
def test_a_full_disk_is_said_in_one_line_and_the_verdict_is_shown(here, capsys, monkeypatch):
    full_disk(monkeypatch)
    code, out, err = command(capsys, "--duration", "0.01", "--log", "full.mcap")
    assert code == 1 and "verdict" in out
    assert err.count("\n") == 1 and err.startswith("valve-drake: logging stopped: No space left on device; ")


@pytest.mark.system
def test_a_log_folder_that_is_moved_in_mid_run_keeps_the_log_and_the_verdict(tmp_path):
    def move(progress):
        if progress.sim_time == 0.0:
            (tmp_path / "logs").rename(tmp_path / "logs2")

    result = run(tmp_path / "logs" / "a.mcap", ["seed=4"], duration=0.2, show=move)
    assert "was moved or removed" in result.log_error and result.log == tmp_path / "logs2" / "a.mcap.active"
    assert result.summary.spans and result.summary.verdict == ""
    assert LogReader(result.log).metadata["result"]["outcome"] == "unfinished"


@pytest.mark.system
def test_a_rendering_process_that_is_killed_ends_the_run_with_a_verdict_and_a_whole_log(here, capsys, monkeypatch):
    enter = runner.CameraWorkers.__enter__

    def kill_one(self):
        enter(self)
        self._workers[0].process.kill()
        return self

    monkeypatch.setattr(runner.CameraWorkers, "__enter__", kill_one)
    code, out, err = command(capsys, "--duration", "2", "--log", "a.mcap", "--json")
    result = json.loads(out)
    assert code == 1 and (result["outcome"], result["verdict"]) == ("failed", "fault")
    assert err == "valve-drake: the process that renders head_left ended with code -9\n"
    assert result["reason"] in err and result["log"] == "a.mcap"
    log = LogReader("a.mcap")
    assert log.damage == [] and log.metadata["result"]["verdict"] == "fault"


@pytest.mark.system
def test_a_second_run_of_one_seed_takes_the_next_name_and_says_so(here, capsys):
    for name in ("run-4.mcap", "run-4-2.mcap"):
        code, out, err = command(capsys, "--seed", "4", "--duration", "0.01", "--json")
        assert code == 0 and json.loads(out)["log"] == f"logs/{name}"
    assert err == "valve-drake: 'logs/run-4.mcap' exists: this log is 'logs/run-4-2.mcap'\n"
    assert json.loads((here / "logs" / "run-4.json").read_text())["log"] == "logs/run-4.mcap"
    names = {"run-4.mcap", "run-4.json", "run-4-2.mcap", "run-4-2.json"}
    assert {path.name for path in (here / "logs").iterdir()} == names


@pytest.mark.system
def test_a_log_that_was_named_and_exists_is_replaced_with_overwrite_only(here, capsys):
    (here / "a.mcap").write_text("mine")
    code, _, err = command(capsys, "--duration", "0.01", "--log", "a.mcap")
    assert code == 2 and "--overwrite" in err and (here / "a.mcap").read_text() == "mine"
    code, _, err = command(capsys, "--duration", "0.01", "--log", "a.mcap", "--overwrite")
    assert code == 0 and err == "" and LogReader("a.mcap").damage == []


@pytest.mark.system
def test_a_log_takes_the_place_of_an_empty_file_and_follows_a_link(here, capsys):
    (here / "there").mkdir()
    (here / "there" / "empty.mcap").touch()
    (here / "link.mcap").symlink_to("there/empty.mcap")
    code, _, err = command(capsys, "--duration", "0.01", "--log", "link.mcap")
    assert code == 0 and err == "" and (here / "link.mcap").is_symlink()
    assert LogReader(here / "there" / "empty.mcap").damage == []
    assert sorted(path.name for path in (here / "there").iterdir()) == ["empty.json", "empty.mcap"]


@pytest.mark.parametrize("name", ["x.json", "y.html", "log", ".mcap", ".", "", "/", "x.mcap.active"])
def test_a_log_is_named_mcap_so_that_what_lies_beside_it_has_another_name(here, capsys, name):
    code, _, err = command(capsys, "--duration", "0.01", "--log", name)
    assert code == 2 and err.startswith("valve-drake: --log must be ") and err.count("\n") == 1
    assert list(here.iterdir()) == []


def test_what_lies_beside_a_log_is_not_replaced_either(here, capsys):
    (here / "a.json").write_text("mine")
    code, _, err = command(capsys, "--duration", "0.01", "--log", "a.mcap")
    assert code == 2 and "got 'a.json'" in err and (here / "a.json").read_text() == "mine"


@pytest.mark.parametrize("refusal", ["taught", "no robot"])
def test_a_refused_run_leaves_no_file_and_touches_none(here, capsys, refusal, monkeypatch):
    def silence(_):
        raise OperationFailed("the robot does not answer")

    (here / "logs").mkdir()
    (here / "logs" / "run-0.mcap").write_text("older")
    (here / "wrong.yaml").write_text("neither: hand\n")
    if refusal == "taught":
        code, _, err = command(capsys, "--set", "taught=wrong.yaml")
        assert code == 2 and "wrong.yaml" in err
    else:
        monkeypatch.setattr(runner.RobotLink, "start", silence)
        code = cli.main(["run", "hardware.scenario.yaml", "--set", "hardware.lcm_url=memq://"])
        err = capsys.readouterr().err
        assert code == 1 and "robot" in err
    assert {path.name for path in here.rglob("*")} == {"logs", "run-0.mcap", "wrong.yaml"}
    assert (here / "logs" / "run-0.mcap").read_text() == "older"


@pytest.mark.system
def test_a_signal_is_the_operators_stop_and_the_log_is_whole(here, capsys, monkeypatch):
    advance = runner._advance

    def told(system, simulator, scenario, duration, go, link, show, stop, begin):
        def signalled(progress):
            if progress.sim_time == 0.0:
                os.kill(os.getpid(), signal.SIGHUP)
            show(progress)

        stop()  # somebody looks
        return advance(system, simulator, scenario, duration, go, link, signalled, stop, begin)

    monkeypatch.setattr(runner, "_advance", told)
    code, out, err = command(capsys, "--log", "a.mcap")
    assert code == 1 and "verdict stopped" in out and err == ""
    log = LogReader("a.mcap")
    assert log.damage == [] and log.metadata["result"]["outcome"] == "stopped"


@pytest.mark.system
def test_a_run_that_fails_within_its_duration_exits_1(here, capsys, monkeypatch):
    ended = ModeState(mode=Mode.FAILED, verdict="timeout", reason="too long")
    monkeypatch.setattr(runner, "_advance", lambda *_: ended)
    code, out, _ = command(capsys, "--duration", "1", "--log", "a.mcap")
    assert code == 1 and "failed  verdict timeout  too long" in out


@pytest.mark.system
def test_a_name_that_is_not_utf8_is_written_and_shown(here, capsys):
    name = os.fsdecode(b"caf\xe9.mcap")
    code, out, err = command(capsys, "--duration", "0.01", "--log", name)
    assert code == 0 and "log caf\\udce9.mcap" in out and err == ""
    assert json.loads((here / name).with_suffix(".json").read_text())["log"] == name


@pytest.mark.system
def test_brackets_in_a_name_are_no_markup(here, capsys):
    code, out, _ = command(capsys, "--duration", "0.01", "--log", "z[/b].mcap")
    assert code == 0 and "log z[/b].mcap" in out


@pytest.mark.system
def test_the_3d_view_takes_the_next_free_port_and_says_which(here, capsys):
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        with contextlib.suppress(OSError):  # somebody else has it: as good
            taken.bind(("127.0.0.1", 7000))
            taken.listen()
        code, _, err = command(capsys, "--duration", "0.01", "--log", "a.mcap", "--meshcat")
    assert code == 0 and re.fullmatch(r"valve-drake: 3D view at http://\S+:70\d\d \(port 7000 is taken\)\n", err)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "nowhere.yaml"], "no such file: nowhere.yaml"),
        (["run", "a" * 5000], "no such file: "),
        (["run", "--set", f"taught={'a' * 5000}"], "no such file: "),
        (["run", "--set", "valve.height=1"], "unknown key valve"),
        (["run", "--set", "simulation.valve.height=nan"], "finite number"),
        (["run", "--set", "valve.marker.size=[0.3, 0.3]"], "face"),
        (["run", "--seed", "x"], "--seed"),
        (["run", "--duration", "nan"], "--duration"),
        (["run", "--command", "push"], "push"),
        (["run", "--live", "--live-port", "65536"], "--live-port must be within [0, 65535], got 65536"),
        (["run", "--live", "--live-port", "-1"], "--live-port"),
        (["fly"], "fly"),
        ([], "COMMAND"),
        (["recover", "nowhere.mcap", "-o", "x.mcap"], "nowhere.mcap"),
    ],
)
def test_bad_input_gives_one_line_and_exit_code_2(arguments, words, capsys):
    assert cli.main(arguments) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and err.startswith("valve-drake: ") and words in err


@pytest.mark.system
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
    spent = result["processor_s"]
    assert {"robot_state", "supervisor", "odometry"} <= spent["stages"].keys()
    parts = [seconds for kind, seconds in spent.items() if kind not in ("stages", "waited", "total")]
    assert min(parts) >= 0 and spent["total"] == pytest.approx(sum(parts) + sum(spent["stages"].values()), abs=2e-3)
    for kind in ("start_up", "renderers_start_up", "plant", "framework", "logging", "rendering", "end"):
        assert spent[kind] > 0


@pytest.mark.slow
def test_the_whole_work_turns_the_valve(tmp_path):
    html = tmp_path / "whole.html"
    result = runner.run(scenarios.load(None, ["seed=1"]), tmp_path / "whole.mcap", recording=True)
    s = result.summary
    assert (s.outcome, s.verdict) == ("done", "turned")
    assert s.angle_true_rad == pytest.approx(s.command_rad, abs=0.035)
    assert s.angle_camera_rad == pytest.approx(s.angle_true_rad, abs=0.01)
    assert s.turn_peak_hand_force_N < 35 and 0.4 < s.turn_share_left < 0.6
    assert html.stat().st_size > 1e6 and LogReader(tmp_path / "whole.mcap").damage == []


@pytest.mark.slow
def test_a_robot_whose_head_waist_and_base_do_not_move_turns_the_valve_before_it(tmp_path):
    def edit(model):
        without_base_joints(model)
        stiff_neck(model, 0.6, waist=False)

    robot = variant(tmp_path / "robot", edit, lambda given: (fixed(given), without_waist(given)))
    before = "simulation.start={distance: 0.77, bearing: 0, heading: 0}"
    result = run(tmp_path / "stiff.mcap", ["seed=3", f"robot={robot}", before, "simulation.valve.height=1.0"])
    s = result.summary
    assert (s.outcome, s.verdict, s.retries) == ("done", "turned", 0)
    assert s.angle_true_rad == pytest.approx(s.command_rad, abs=0.035)


@pytest.mark.slow
def test_a_seized_valve_is_stuck_and_no_hand_is_overloaded(tmp_path):
    result = run(tmp_path / "seized.mcap", ["seed=1", "simulation.valve.seized=true"])
    assert (result.summary.outcome, result.summary.verdict) == ("failed", "stuck")
    assert result.summary.peak_hand_force_N < 60
    assert abs(result.summary.angle_true_rad) < 0.01
