"""The command line: signals, streams that go away, files that are named for output."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from log_samples import write_log

from valve_drake import cli, outputs, teaching
from valve_drake.commands import common, experiment
from valve_drake.commands.common import Interrupted, break_off, signals, stopper
from valve_drake.recording.reader import LogReader

PROGRAM = [sys.executable, "-m", "valve_drake"]


def send(number=signal.SIGTERM):
    os.kill(os.getpid(), number)


@pytest.fixture
def patient(monkeypatch):
    """Disables the time within which a second signal counts as the same one."""
    monkeypatch.setattr(common, "ECHO", 0.0)


SIGNALS = pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 1), (signal.SIGTERM, 128 + 15), (signal.SIGHUP, 128 + 1)]
)


@SIGNALS
def test_once_is_the_operators_stop_and_twice_breaks_off(patient, number, code):
    with pytest.raises(Interrupted) as caught, stopper() as stop:
        assert not stop()
        send(number)
        assert stop() and stop()
        send(number)
    assert caught.value.exit_code == code


@SIGNALS
def test_before_anybody_looks_once_breaks_off(number, code):
    with pytest.raises(Interrupted), stopper():
        send(number)


def test_breaking_off_is_not_broken_off(patient):
    with pytest.raises(Interrupted), stopper():
        try:
            send()
        finally:
            send()
            send(signal.SIGINT)


def test_a_terminal_that_closes_sends_twice_and_means_once():
    with stopper() as stop:
        stop()
        send(signal.SIGHUP)
        send(signal.SIGHUP)
        assert stop()


def test_the_signals_mean_afterwards_what_they_meant_before():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    with stopper():
        pass
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == before


def test_nohup_is_heeded():
    old = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopper() as stop:
            send(signal.SIGHUP)
            assert not stop()
    finally:
        signal.signal(signal.SIGHUP, old)


def test_a_command_that_is_ended_leaves_no_half_file(tmp_path):
    with pytest.raises(Interrupted), signals(break_off), outputs.replacing(tmp_path / "a"):
        send()
    assert list(tmp_path.iterdir()) == []


def shell(command: str, folder: Path) -> subprocess.CompletedProcess:
    words = " ".join(PROGRAM)
    environment = os.environ | {"PYTHONPATH": str(Path(cli.__file__).parent.parent)}
    line = command.replace("PROGRAM", words)
    return subprocess.run(["bash", "-c", line], cwd=folder, env=environment, capture_output=True, text=True)


def test_a_reader_that_closes_the_pipe_is_no_error(tmp_path):
    done = shell("PROGRAM run --help | head -n 1; echo ${PIPESTATUS[0]}", tmp_path)
    assert done.stdout.startswith("usage:") and done.stdout.endswith("\n0\n") and done.stderr == ""


def test_an_output_that_cannot_be_written_is_one_line(tmp_path):
    done = shell("PROGRAM run --help > /dev/full", tmp_path)
    assert (done.returncode, done.stderr) == (
        1,
        "valve-drake: standard output cannot be written: No space left on device\n",
    )
    done = shell("PROGRAM review nowhere.mcap 2> /dev/full", tmp_path)
    assert (done.returncode, done.stdout) == (2, "")


def test_closed_streams_are_no_trouble(tmp_path):
    assert shell("PROGRAM review nowhere.mcap <&- >&- 2>&-", tmp_path).returncode == 2


@pytest.mark.parametrize("kind", ["draw", "teach", "experiment"])
def test_a_folder_that_cannot_be_filled_is_refused_before_the_work(tmp_path, capsys, kind, monkeypatch):
    monkeypatch.setattr(teaching, "teach", None)  # is not come to
    name, file = {"draw": "simulated.svg", "teach": "left.png", "experiment": "table2.json"}[kind], tmp_path / "file"
    words = [kind, "table2"] if kind == "experiment" else [kind]
    file.write_text("mine")
    (tmp_path / name).write_text("mine")
    for out in (file, file / "below", tmp_path, ""):
        monkeypatch.chdir(tmp_path)
        assert cli.main([*words, "--out", str(out)]) == 2
        err = capsys.readouterr().err
        assert err.startswith("valve-drake: --out must be ") and err.count("\n") == 1
    assert (tmp_path / name).read_text() == file.read_text() == "mine"


def test_a_drawing_is_made_again_over_the_old_one(tmp_path, capsys):
    for _ in range(2):
        assert cli.main(["draw", "--out", str(tmp_path / "new" / "folder")]) == 0
    assert sorted(path.name for path in (tmp_path / "new" / "folder").iterdir()) == [
        "simulated.svg",
        "simulated.wiring.txt",
    ]


def test_a_list_of_somebodys_own_is_no_drawing(tmp_path, capsys):
    mine = tmp_path / "simulated.wiring.txt"
    mine.write_text("red wire -> pin 3\nblack wire -> ground\n")
    assert cli.main(["draw", "--out", str(tmp_path)]) == 2
    assert (
        mine.read_text().startswith("red wire")
        and "--out must be a file that does not exist" in capsys.readouterr().err
    )


def test_an_experiments_table_may_be_made_again_and_no_other_file(tmp_path):
    for text, own in (
        (json.dumps({"experiment": "bound"}), True),
        (json.dumps({"experiment": "table2"}), False),
        ("[]", False),
        ("mine", False),
        ("[" * 100000, False),
    ):
        (tmp_path / "bound.json").write_text(text)
        assert experiment._made_before(tmp_path / "bound.json") == own


def test_references_may_be_taught_again_where_they_were_taught_before(tmp_path):
    (tmp_path / "left.png").write_text("")
    assert not teaching.made_before(tmp_path / "left.png")
    (tmp_path / "hands.yaml").write_text(f"# {teaching.HEADING} For each hand\n")
    assert teaching.made_before(tmp_path / "left.png")


def test_recover_writes_over_nothing_unasked_and_never_over_what_it_reads(tmp_path, capsys):
    write_log(tmp_path / "a.mcap", 1.0)
    left = (tmp_path / "a.mcap").rename(tmp_path / "b.mcap.active")
    before = left.read_bytes()
    (tmp_path / "b.mcap").write_text("mine")
    os.link(left, tmp_path / "hard")
    recover = ["recover", str(left), "-o"]
    for out, words in (("b.mcap", "--overwrite"), ("b.mcap.active", "another file"), ("hard", "another file")):
        assert cli.main([*recover, str(tmp_path / out)]) == 2
        assert words in capsys.readouterr().err
    assert (tmp_path / "b.mcap").read_text() == "mine" and left.read_bytes() == before
    assert cli.main([*recover, str(tmp_path / "b.mcap"), "--overwrite"]) == 0
    assert LogReader(tmp_path / "b.mcap").damage == [] and left.read_bytes() == before
    assert cli.main([*recover, str(tmp_path / "b.mcap")]) == 0  # made by recover itself
