"""active: a log under way belongs to one process, and existing files are never overwritten."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from log_samples import write_log

from valve_drake.checks import ConfigError
from valve_drake.messages import Status
from valve_drake.recording.container import active
from valve_drake.recording.reader import LogReader
from valve_drake.recording.writer import LogError, LogWriter


def say_hello(log: LogWriter) -> None:
    log.write("/a", Status(), 0.0)


def topics(path: Path) -> list[str]:
    log = LogReader(path)
    assert log.damage == []
    return list(log.topics)


def test_a_name_that_is_taken_makes_way_for_the_next_free_one(tmp_path):
    path = tmp_path / "run-7.mcap"
    for name in ("run-7.mcap", "run-7-2.mcap", "run-7-3.mcap"):
        with LogWriter(path) as log:
            say_hello(log)
        assert log.path == tmp_path / name
        assert (log.note == "") == (name == path.name)
    assert "run-7.mcap' exists: this log is" in log.note and "run-7-3.mcap'" in log.note
    assert all(topics(file) == ["/a"] for file in tmp_path.iterdir())


def test_two_logs_of_one_name_at_once_are_two_logs(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as one, LogWriter(tmp_path / "a.mcap") as two:
        one.write("/one", Status(), 0.0)
        two.write("/two", Status(), 0.0)
    assert two.path == tmp_path / "a-2.mcap" and "is being written by another run" in two.note
    assert topics(tmp_path / "a.mcap") == ["/one"] and topics(tmp_path / "a-2.mcap") == ["/two"]


def test_many_programs_that_begin_at_once_get_a_log_each(tmp_path):
    code = (
        "import sys, pathlib\n"
        "from valve_drake.recording.active import ActiveFile\n"
        "sys.stdin.readline()\n"
        "for k in range(20):\n"
        "    file = ActiveFile(pathlib.Path(sys.argv[1]))\n"
        "    file.file.write(file.path.name.encode())\n"
        "    file.publish()\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a.mcap")]
    programs = [subprocess.Popen(command, stdin=subprocess.PIPE) for _ in range(3)]
    for program in programs:
        program.stdin.write(b"go\n")
        program.stdin.flush()
    assert [program.wait() for program in programs] == [0, 0, 0]
    names = sorted(file.name for file in tmp_path.iterdir())
    assert len(names) == 60
    assert all((tmp_path / name).read_text() == name for name in names)


def test_what_a_killed_run_left_is_kept_and_said(tmp_path):
    left = tmp_path / "a.mcap.active"
    left.write_bytes(b"the only copy")
    with LogWriter(tmp_path / "a.mcap", overwrite=True) as log:
        say_hello(log)
    assert log.path == tmp_path / "a-2.mcap"
    assert log.note.count("\n") == 0 and "a.mcap.active' was left by a killed run and is kept" in log.note
    assert left.read_bytes() == b"the only copy" and not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("kind", ["link", "dangling link", "folder"])
def test_an_active_of_another_kind_is_not_followed(tmp_path, kind):
    (tmp_path / "victim").write_text("mine")
    if kind == "folder":
        (tmp_path / "a.mcap.active").mkdir()
    else:
        (tmp_path / "a.mcap.active").symlink_to("victim" if kind == "link" else "nowhere")
    with LogWriter(tmp_path / "a.mcap") as log:
        say_hello(log)
    assert log.path.name == "a-2.mcap"
    assert (tmp_path / "victim").read_text() == "mine" and not (tmp_path / "nowhere").exists()


def test_a_companion_of_an_older_run_counts_as_a_taken_name(tmp_path):
    (tmp_path / "a.json").write_text("older")
    with LogWriter(tmp_path / "a.mcap", companions=(".json", ".html")) as log:
        say_hello(log)
    assert log.path.name == "a-2.mcap" and "a.json' exists" in log.note


def test_overwrite_replaces_the_log_that_was_named_and_only_when_the_new_one_is_whole(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"old")
    with LogWriter(path, overwrite=True) as log:
        say_hello(log)
        assert path.read_bytes() == b"old"
    assert log.path == path and log.note == "" and topics(path) == ["/a"]
    assert os.listdir(tmp_path) == ["a.mcap"]


def test_a_log_that_another_program_makes_meanwhile_is_not_replaced(tmp_path):
    log = LogWriter(tmp_path / "a.mcap")
    say_hello(log)
    (tmp_path / "a.mcap").write_bytes(b"another's")
    with pytest.raises(LogError, match="a.mcap' was made by another program meanwhile.*a.mcap.active"):
        log.close()
    assert (tmp_path / "a.mcap").read_bytes() == b"another's"
    assert topics(tmp_path / "a.mcap.active") == ["/a"] and log.where == tmp_path / "a.mcap.active"


def test_a_folder_that_is_moved_keeps_the_log_and_the_error_tells_where(tmp_path):
    log = LogWriter(tmp_path / "logs" / "a.mcap")
    say_hello(log)
    (tmp_path / "logs").rename(tmp_path / "logs2")
    (tmp_path / "logs").mkdir()
    active(log.path).write_bytes(b"of another run")
    with pytest.raises(LogError, match=r"^logging stopped: .* was moved or removed; .*logs2/a.mcap.active'"):
        log.close()
    assert log.where == tmp_path / "logs2" / "a.mcap.active" and topics(log.where) == ["/a"]
    assert active(log.path).read_bytes() == b"of another run" and not log.path.exists()


def test_a_log_that_was_removed_is_said_to_be_gone(tmp_path):
    log = LogWriter(tmp_path / "a.mcap")
    say_hello(log)
    active(log.path).unlink()
    with pytest.raises(LogError, match="nothing of the log is left"):
        log.close()
    assert log.where is None and os.listdir(tmp_path) == []


def test_a_run_that_is_refused_before_its_first_message_leaves_nothing(tmp_path):
    with pytest.raises(ConfigError), LogWriter(tmp_path / "logs" / "deep" / "a.mcap") as log:
        log.write_metadata("run", {"seed": "7"})
        raise ConfigError("no robot")
    assert os.listdir(tmp_path) == []
    write_log(tmp_path / "logs" / "a.mcap", 0.5)
    with pytest.raises(KeyboardInterrupt), LogWriter(tmp_path / "logs" / "b.mcap"):
        raise KeyboardInterrupt
    assert os.listdir(tmp_path / "logs") == ["a.mcap"]


@pytest.mark.parametrize("name", ["file/a.mcap", "x" * 251 + ".mcap", "x" * 245 + ".mcap"])
def test_a_name_that_cannot_be_written_is_one_clear_line(tmp_path, name):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written") as caught:
        LogWriter(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_log_that_cannot_be_made_leaves_no_folder_and_no_open_file(tmp_path):
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(ConfigError, match="cannot be written: File name too long"):
        LogWriter(tmp_path / "new" / "folder" / f"{'a' * 300}.mcap")
    assert list(tmp_path.iterdir()) == [] and len(os.listdir("/proc/self/fd")) == before
