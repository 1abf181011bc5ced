"""The log's writer: deterministic, safe against crashes, never in the loop's way."""

import hashlib
import logging
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from log_samples import samples, write_log
from mcap.reader import make_reader
from mcap.writer import Writer

from valve_drake.checks import ConfigError
from valve_drake.messages import Message, Status
from valve_drake.recording import container, schemas, writer
from valve_drake.recording.reader import LogReader
from valve_drake.recording.writer import LogError, LogWriter

CHILD = Path(__file__).with_name("log_samples.py")


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def start_child(path: Path, seconds: float) -> tuple[subprocess.Popen, float]:
    """(a child process that is writing a log which has reached `seconds`, the log's time at that moment)."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([p for p in sys.path if p] + [os.getcwd()])}
    child = subprocess.Popen([sys.executable, CHILD, path], stdout=subprocess.PIPE, text=True, env=environment)
    now = 0.0
    for line in child.stdout:
        now = float(line)
        if now >= seconds:
            break
    return child, now


def test_same_messages_make_the_same_file(tmp_path, monkeypatch):
    write_log(tmp_path / "a.mcap", 3.0)
    slow = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: (time.sleep(0.02), slow(fd)))
    write_log(tmp_path / "b.mcap", 3.0)
    assert digest(tmp_path / "a.mcap") == digest(tmp_path / "b.mcap")


def test_the_file_is_what_the_mcap_package_would_write(tmp_path, monkeypatch):
    monkeypatch.setattr(container, "LEVEL", 3)  # the package compresses harder
    write_log(tmp_path / "a.mcap", 2.0)
    with open(tmp_path / "b.mcap", "wb") as file:
        mcap = Writer(file, enable_data_crcs=True)
        mcap.start(library="valve_drake")
        mcap.add_metadata("run", {"seed": "7", "scenario": "a: 1\n"})
        mcap.add_attachment(0, 0, "layout.json", "application/json", b"{}")
        ids, count, half, here = {}, {}, 0, set()
        for topic, message, t in samples(2.0):
            when = round(t * 1e9)
            if when // 500_000_000 != half:
                half = when // 500_000_000
                mcap.flush()
                here = set()
            own = isinstance(message, Message)
            if topic not in ids:
                kind = schemas.proto_class(type(message)) if own else type(message)
                schema = mcap.register_schema(kind.DESCRIPTOR.full_name, "protobuf", schemas.schema_data(kind))
                ids[topic] = mcap.register_channel(topic, "protobuf", schema)
            elif topic not in here:  # the one thing that the package does not: a chunk defines its own channels
                mcap._Writer__chunk_builder.add_schema(mcap._Writer__schemas[ids[topic]])
                mcap._Writer__chunk_builder.add_channel(mcap._Writer__channels[ids[topic]])
            here.add(topic)
            data = schemas.encode(message) if own else message.SerializeToString()
            count[topic] = count.get(topic, -1) + 1
            mcap.add_message(ids[topic], when, data, when, count[topic])
        mcap.flush()
        mcap.add_metadata("result", {"outcome": "done"})
        mcap.finish()
    assert digest(tmp_path / "a.mcap") == digest(tmp_path / "b.mcap")


def test_another_reader_finds_all_messages_with_valid_crcs(tmp_path):
    write_log(tmp_path / "a.mcap", 2.0)
    counts, expected = {}, {}
    with open(tmp_path / "a.mcap", "rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for _, channel, message in reader.iter_messages():
            assert message.log_time == message.publish_time
            assert message.sequence == counts.get(channel.topic, 0)
            counts[channel.topic] = message.sequence + 1
        summary = reader.get_summary()
    for topic, _, _ in samples(2.0):
        expected[topic] = expected.get(topic, 0) + 1
    assert counts == expected
    assert summary.statistics.message_count == sum(expected.values())
    names = [schema.name for schema in summary.schemas.values()]
    assert sorted(names) == sorted(set(names))


def test_topics_of_one_type_share_a_schema(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write("/a/status", Status(), 0.0)
        log.write("/b/status", Status(), 0.0)
    with open(tmp_path / "a.mcap", "rb") as file:
        assert len(make_reader(file).get_summary().schemas) == 1


def test_log_is_active_until_it_is_complete(tmp_path):
    path, unfinished = tmp_path / "new" / "a.mcap", tmp_path / "new" / "a.mcap.active"
    with LogWriter(path) as log:
        log.write("/a", Status(), 0.0)
        assert unfinished.exists() and not path.exists()
    assert path.exists() and not unfinished.exists()


def test_an_exception_in_the_run_still_completes_the_log(tmp_path):
    with pytest.raises(ZeroDivisionError), LogWriter(tmp_path / "a.mcap") as log:
        log.write("/a", Status(), 0.0)
        raise ZeroDivisionError
    reader = LogReader(tmp_path / "a.mcap")
    assert reader.damage == []
    assert "result" not in reader.metadata


def test_a_topic_keeps_its_type(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write("/a", Status(), 0.0)
        with pytest.raises(TypeError, match="/a holds Status, got Wrench"):
            log.write("/a", schemas.Wrench(), 0.0)


def test_a_place_that_cannot_be_written_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        LogWriter(tmp_path / "file" / "a.mcap")


@pytest.mark.system
@pytest.mark.parametrize("seconds", [0.3, 1.9, 3.1])
def test_kill_9_loses_at_most_a_second(tmp_path, seconds):
    child, now = start_child(tmp_path / "a.mcap", seconds)
    child.kill()
    child.wait()
    unfinished = tmp_path / "a.mcap.active"
    if seconds < 0.5:
        assert unfinished.stat().st_size > 0
        return
    log = LogReader(unfinished)
    assert log.end > now - 1.0
    assert log.metadata["run"] == {"seed": "7"}
    assert len(log.damage) == 1 and "breaks off" in log.damage[0]
    times = [t for _, t, _ in log.messages(["/robot_state/robot_state"])]
    assert times == [k / 128 for k in range(len(times))]


def test_sigterm_completes_the_log(tmp_path):
    child, now = start_child(tmp_path / "a.mcap", 0.7)
    child.send_signal(signal.SIGTERM)
    child.stdout.read()
    assert child.wait(10) == 143
    log = LogReader(tmp_path / "a.mcap")
    assert log.damage == [] and log.end >= now


def on_a_full_disk(path: Path) -> LogWriter:
    """A LogWriter whose file refuses every further write, as on a full disk."""
    log = LogWriter(path)
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, log._file.file.fileno())
    os.close(full)
    return log


def test_a_full_disk_stops_the_log_and_not_the_loop(tmp_path, caplog):
    log = on_a_full_disk(tmp_path / "a.mcap")
    with caplog.at_level(logging.ERROR):
        for topic, message, t in samples(20.0, 1000):
            log.write(topic, message, t)
            if log.error:
                break
            time.sleep(1e-4)
        for topic, message, t in samples(0.1):
            log.write(topic, message, 20.0 + t)
    assert "No space left on device" in log.error and "a.mcap.active" in log.error
    assert [record.getMessage() for record in caplog.records] == [log.error]
    with pytest.raises(LogError, match="No space left on device"):
        log.close()
    log.close()
    assert not (tmp_path / "a.mcap").exists()


def test_the_runs_own_error_is_not_hidden_by_the_logs(tmp_path):
    with pytest.raises(ZeroDivisionError), on_a_full_disk(tmp_path / "a.mcap") as log:
        log.write("/a", Status(), 0.0)
        raise ZeroDivisionError


def test_what_a_full_disk_has_taken_can_be_read(tmp_path):
    pid = os.fork()
    if pid == 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        try:
            write_log(tmp_path / "a.mcap", 5.0)
        except LogError:
            os._exit(0)
        os._exit(1)
    assert os.waitpid(pid, 0)[1] == 0
    log = LogReader(tmp_path / "a.mcap.active")
    written = list(samples(5.0))
    found = [(topic, t) for topic, t, _ in log.messages()]
    assert found == [(topic, t) for topic, _, t in written[: len(found)]]
    assert log.end >= 0.45


def test_the_loop_does_not_wait_for_a_slow_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda fd: time.sleep(0.3))
    with LogWriter(tmp_path / "a.mcap") as log:
        begin = time.perf_counter()
        for topic, message, t in samples(1.9):
            log.write(topic, message, t)
        spent = time.perf_counter() - begin
        monkeypatch.undo()
    assert spent < 0.3  # it would be three times 0.3 s
    assert LogReader(tmp_path / "a.mcap").damage == []


def test_a_disk_that_falls_far_behind_stops_the_log(tmp_path, monkeypatch):
    go_on = threading.Event()
    monkeypatch.setattr(writer, "MAX_BACKLOG", 100_000)
    monkeypatch.setattr(os, "fsync", lambda fd: go_on.wait(10))
    log = LogWriter(tmp_path / "a.mcap")
    recorded = 0
    for topic, message, t in samples(5.0):
        recorded += not log.error
        log.write(topic, message, t)
    assert "behind" in log.error and 100 < recorded < 1000
    log.write_metadata("result", {"outcome": "done"})
    go_on.set()
    with pytest.raises(LogError, match="behind"):
        log.close()
    found = LogReader(tmp_path / "a.mcap.active")  # all that was recorded until then, and no end
    count = sum(topic.count for topic in found.topics.values())
    assert recorded - 1 <= count <= recorded and "result" not in found.metadata
