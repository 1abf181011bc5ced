"""`valve-drake review` from the outside: pages, JSON, tables, exit codes, and one line for whatever cannot be read."""

import contextlib
import csv
import io
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import time

import numpy as np
import pytest
import review_samples as sample
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from valve_drake import cli
from valve_drake.analysis import export
from valve_drake.messages import CameraFrame, Command, HandleMark, HandleMarks, Status
from valve_drake.recording import foxglove
from valve_drake.recording.container import active
from valve_drake.recording.reader import LogReader
from valve_drake.recording.recovery import recover
from valve_drake.recording.writer import LogWriter


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return sample.write_run(tmp_path_factory.mktemp("source") / "run.mcap").read_bytes()


@pytest.fixture
def log(source, tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(source)
    return path


@pytest.fixture
def hurt(source, tmp_path):
    data = bytearray(source)
    data[len(data) // 2] ^= 0xFF
    path = tmp_path / "hurt.mcap"
    path.write_bytes(data)
    return path


def review(capsys, *arguments):
    code = cli.main(["review", *map(str, arguments)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_a_log_gets_its_page_beside_it_and_a_short_word_on_the_terminal(log, capsys):
    code, out, err = review(capsys, log)
    page = log.with_name("run.review.html")
    assert code == 0 and err == "" and page.read_text(encoding="utf-8").startswith("<!doctype html>")
    assert "verdict turned" in out and "the log is whole" in out and str(page) in out
    assert "servo (retry 1)" in out


def test_a_log_without_truth_has_its_page_its_json_and_its_comparison(log, capsys, tmp_path):
    blind = sample.write_run(tmp_path / "blind.mcap", without=("/truth",))
    code, out, err = review(capsys, blind)
    assert code == 0 and err == "" and "verdict turned" in out and "true" not in out
    assert "No truth in this log" in blind.with_name("blind.review.html").read_text(encoding="utf-8")
    code, out, _ = review(capsys, blind, "--json")
    assert code == 0 and json.loads(out)["angle_true_rad"] is None
    code, out, _ = review(capsys, blind, log, "--html", tmp_path / "both.html")
    assert code == 0 and "/truth/" in out


def test_html_says_where_the_page_goes_and_links_are_right_from_there(log, capsys, tmp_path):
    log.with_suffix(".html").write_text("3D", encoding="utf-8")
    (tmp_path / "pages").mkdir()
    assert review(capsys, log, "--html", tmp_path / "pages" / "a.html")[0] == 0
    assert 'href="../run.html"' in (tmp_path / "pages" / "a.html").read_text(encoding="utf-8")
    assert not log.with_name("run.review.html").exists()


def test_json_prints_one_object_and_writes_no_page(log, capsys):
    code, out, _ = review(capsys, log, "--json")
    facts = json.loads(out)
    assert code == 0 and facts["outcome"] == "done" and facts["html"] is None and facts["sound"]
    assert not log.with_name("run.review.html").exists()


def test_a_damaged_log_is_read_by_itself_and_the_exit_code_is_3(hurt, capsys):
    code, out, _ = review(capsys, hurt)
    assert code == 3 and "damaged: " in out and "not whole" in out
    assert "bytes are damaged after t" in hurt.with_name("hurt.review.html").read_text(encoding="utf-8")


def test_a_log_that_was_cut_off_is_read_too(source, capsys, tmp_path):
    path = tmp_path / "cut.mcap.active"
    path.write_bytes(source[: len(source) // 2])
    code, out, _ = review(capsys, path, "--json")
    facts = json.loads(out)
    assert code == 3 and not facts["finished"] and facts["outcome"] == "unfinished"
    assert any("breaks off" in line for line in facts["damage"])


def test_a_recovered_log_still_says_what_is_missing(hurt, capsys, tmp_path):
    recover(hurt, tmp_path / "again.mcap")
    code, out, _ = review(capsys, tmp_path / "again.mcap", "--json")
    assert code == 3 and any("recovered from a damaged log" in line for line in json.loads(out)["damage"])


def test_two_logs_are_compared(log, capsys, tmp_path):
    other = sample.write_run(tmp_path / "other.mcap", scenario=sample.SCENARIO.replace("seed: 7", "seed: 8"))
    code, out, _ = review(capsys, log, other)
    assert code == 0 and "identical" in out
    page = tmp_path / "run-other.review.html"
    assert "Two runs compared" in page.read_text(encoding="utf-8")
    facts = json.loads(review(capsys, log, other, "--json")[1])
    assert facts["identical"] and facts["settings"] == {"seed": {"a": 7, "b": 8}}


def test_where_two_logs_part_is_printed(log, capsys, tmp_path):
    def change(topic, message, t):
        return Status(time=t, detail="other") if topic == "/base_approach/status" and t >= 1.0 else message

    other = sample.write_run(tmp_path / "other.mcap", change=change)
    _, out, _ = review(capsys, log, other)
    assert "they part at t = 1.000000 s, /base_approach/status detail:  and other" in out


def test_comparing_with_a_damaged_log_ends_with_3(log, hurt, capsys):
    assert review(capsys, log, hurt)[0] == 3


# ---------------------------------------------------------------- export


def table(path):
    rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    return rows[0], rows[1:]


def test_export_csv_has_time_in_ns_and_every_value_to_the_bit(log, capsys, tmp_path):
    code, out, _ = review(
        capsys, log, "--export", "csv", "--topic", "/rectangle_estimator/estimate", "--out", tmp_path / "e.csv"
    )
    head, rows = table(tmp_path / "e.csv")
    messages = list(LogReader(log).messages(["/rectangle_estimator/estimate"]))
    assert code == 0 and str(len(messages)) in out and len(rows) == len(messages)
    assert head[:2] == ["time_ns", "time"] and "X_LV[11]" in head and "covariance[35]" in head
    assert int(rows[0][0]) == round(messages[0][1] * 1e9)
    values = [float(rows[3][head.index(f"X_LV[{k}]")]) for k in range(12)]
    assert values == messages[3][2].X_LV.ravel().tolist()


@pytest.mark.parametrize("folder", ["/", "."])
@pytest.mark.parametrize("options", [(), ("--export", "csv", "--topic", "/x")])
def test_a_folder_is_no_log_whatever_it_is_called(folder, options, capsys):
    code, _, error = review(capsys, folder, *options)
    assert code == 2 and f"log {folder} cannot be read: Is a directory" in error


def test_export_goes_beside_the_log_by_default_and_names_joints(log, capsys, tmp_path):
    assert review(capsys, log, "--export", "csv", "--topic", "/joint_states")[0] == 0
    head, rows = table(tmp_path / "run.joint_states.csv")
    assert "joints[left_arm_1].position" in head and len(rows) == 768
    assert float(rows[0][head.index("joints[waist].position")]) == 0.1


def test_a_damaged_table_is_a_file_like_any_other_and_not_replaced(log, capsys, tmp_path):
    path = tmp_path / "t.npz"
    assert review(capsys, log, "--export", "npz", "--topic", "/hybrid_rotation/turn", "--out", path)[0] == 0
    damaged = path.read_bytes().replace(b"PK\x01\x02", b"PKxx")
    path.write_bytes(damaged)
    code, _, error = review(capsys, log, "--export", "npz", "--topic", "/hybrid_rotation/turn", "--out", path)
    assert code == 2 and "--out must be a file that does not exist yet" in error and path.read_bytes() == damaged


def test_export_npz_gives_arrays_by_field(log, capsys, tmp_path):
    path = tmp_path / "t.npz"
    assert review(capsys, log, "--export", "npz", "--topic", "/hybrid_rotation/turn", "--out", path)[0] == 0
    with np.load(path) as found:
        assert found["time_ns"].dtype == np.int64 and found["time"][0] == 3.0
        assert found["force_left"].shape == (256, 3) and set(found["stage"]) == {"grasp", "turn", "release"}
        assert found["angle"][-1] == sample.valve_angle(5.0)


@pytest.mark.system
def test_every_topic_can_be_exported_in_both_forms(log, tmp_path):
    reader = LogReader(log)
    for topic in reader.topics:
        for form in export.FORMATS:
            assert export.write(reader, topic, form, tmp_path / f"x.{form}") == reader.topics[topic].count
        with np.load(tmp_path / "x.npz") as found:
            assert all(len(found[name]) == reader.topics[topic].count for name in found)


def test_export_of_changing_lengths_absent_groups_truth_and_nested_messages(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as writer:
        writer.write("/c", Command(time=0.0), 0.0)
        writer.write("/c", Command(time=1.0, torso=[1, 2, 3]), 1.0)
        mark = HandleMark(found=True, frame=CameraFrame("left_wrist", 0.5, 3), corners=[[1, 2], [3, 4]])
        writer.write("/m", HandleMarks(time=1.0, left=mark), 1.0)
        writer.write("/i", foxglove.image(CameraFrame("x", 0.25, 0, data=b"12345")), 1.0)
    reader = LogReader(tmp_path / "a.mcap")
    export.write(reader, "/c", "csv", tmp_path / "c.csv")
    head, rows = table(tmp_path / "c.csv")
    assert [row[head.index("torso[2]")] for row in rows] == ["", "3.0"]  # not asked for at first
    export.write(reader, "/m", "npz", tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz") as found:
        assert found["left.corners"].tolist() == [[[1.0, 2.0], [3.0, 4.0]]]
        assert found["left.frame.sequence"].tolist() == [3]
    export.write(reader, "/i", "csv", tmp_path / "i.csv")
    head, rows = table(tmp_path / "i.csv")
    assert rows[0][head.index("timestamp")] == "0.25" and rows[0][head.index("data.bytes")] == "5"


def foreign_messages():
    """The class of a message of another program: elements with names, a map, and a time of its own."""
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="other.proto", package="other", syntax="proto3")
    part = file.message_type.add(name="Part")
    part.field.add(name="x", number=1, type=field.TYPE_DOUBLE, label=field.LABEL_OPTIONAL)
    for name, kind in (("Text", field.TYPE_STRING), ("Number", field.TYPE_INT32), ("Nested", field.TYPE_MESSAGE)):
        element = file.message_type.add(name=name)
        own = element.field.add(name="name", number=1, type=kind, label=field.LABEL_OPTIONAL)
        if kind == field.TYPE_MESSAGE:
            own.type_name = ".other.Part"
        element.field.add(name="x", number=2, type=field.TYPE_DOUBLE, label=field.LABEL_OPTIONAL)
    message = file.message_type.add(name="Message")
    message.field.add(name="time_ns", number=1, type=field.TYPE_INT64, label=field.LABEL_OPTIONAL)
    for number, name in enumerate(("Text", "Number", "Nested"), start=2):
        of = f".other.{name}"
        repeated = field.LABEL_REPEATED
        message.field.add(name=name.lower(), number=number, type=field.TYPE_MESSAGE, type_name=of, label=repeated)
    entry = message.nested_type.add(name="GainsEntry")
    entry.options.map_entry = True
    entry.field.add(name="key", number=1, type=field.TYPE_STRING, label=field.LABEL_OPTIONAL)
    entry.field.add(name="value", number=2, type=field.TYPE_DOUBLE, label=field.LABEL_OPTIONAL)
    of = ".other.Message.GainsEntry"
    message.field.add(name="gains", number=5, type=field.TYPE_MESSAGE, type_name=of, label=field.LABEL_REPEATED)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("other.Message"))


def test_export_of_another_programs_messages_drops_no_value_and_has_each_column_once(tmp_path):
    message = foreign_messages()(time_ns=77, gains={"p": 1.5, "d": 0.25})
    for name, x in (("a", 1), ("a", 2), ("b", 3), ("", 4), ("3", 5)):
        message.text.add(name=name, x=x)
    message.number.add(name=5, x=6)
    message.nested.add(x=7).name.x = 8
    when = 2**63 + 5  # ns; an MCAP time has 64 bits
    with LogWriter(tmp_path / "a.mcap") as writer:
        writer.write("/m", message, 0.0)
    log = LogReader(tmp_path / "a.mcap")
    rows = [(when, export.leaves(log.decode(record))) for record in log.records(["/m"])]
    head, values = (line.split(",") for line in export.to_csv(rows).splitlines())
    assert len(set(head)) == len(head)
    found = dict(zip(head, values))
    assert found["time_ns"] == str(when) and found["message_time_ns"] == "77"
    assert (found["gains[p]"], found["gains[d]"]) == ("1.5", "0.25")
    assert [found[f"text[{k}].x"] for k in (0, 1, "b", 3, 4)] == ["1.0", "2.0", "3.0", "4.0", "5.0"]
    assert (found["number[0].x"], found["nested[0].x"], found["nested[0].name.x"]) == ("6.0", "7.0", "8.0")
    arrays = export.to_arrays(rows)
    assert arrays["time_ns"].tolist() == [when] and arrays["message_time_ns"].tolist() == [77]


def test_export_of_truth_uses_its_names(log, capsys, tmp_path):
    assert review(capsys, log, "--export", "csv", "--topic", "/truth/base_pose", "--out", tmp_path / "b.csv")[0] == 0
    assert table(tmp_path / "b.csv")[0] == ["time_ns", "time", "message_time", "x", "y", "heading"]


def test_export_from_a_damaged_log_gives_what_there_is_and_3(hurt, capsys, tmp_path):
    code, out, _ = review(capsys, hurt, "--export", "csv", "--topic", "/joint_states", "--out", tmp_path / "j.csv")
    assert code == 3 and "damaged" in out and 0 < len(table(tmp_path / "j.csv")[1]) < 768


# ---------------------------------------------------------------- killed runs

RUN = """
import pathlib, sys
from valve_drake import runner, scenario
show = lambda progress: print(progress.sim_time, flush=True)
runner.run(scenario.load(None, [f"seed={sys.argv[2]}"]), pathlib.Path(sys.argv[1]), show=show)
"""


@pytest.mark.slow
@pytest.mark.parametrize("k", range(10))
def test_a_run_that_is_killed_loses_less_than_a_second_and_can_be_reviewed(k, tmp_path, capsys):
    """kill -9 at a random moment of a whole run."""
    rng, path, now = random.Random(k), tmp_path / "run.mcap", 0.0
    when = rng.uniform(0.6, 45.0)
    child = subprocess.Popen(
        [sys.executable, "-c", RUN, path, str(k)], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        while now < when:
            now = float(child.stdout.readline())
        time.sleep(rng.uniform(0.0, 0.1))
        child.kill()
        reported = [float(line) for line in child.stdout.read().splitlines() if line.count(".") == 1]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)  # its helpers, if they are left
        child.wait()
    now = max([now, *reported])
    left = LogReader(active(path))
    with capsys.disabled():
        print(f" killed at {now:.3f} s, lost {now - left.end:.3f} s", end="", flush=True)
    assert not path.exists() and now - left.end <= 1.0
    assert [line for line in left.damage if "breaks off" in line] == left.damage
    assert review(capsys, active(path))[0] == 3
    recover(active(path), tmp_path / "whole.mcap")
    whole = LogReader(tmp_path / "whole.mcap")
    assert whole.damage == [] and whole.end == left.end


# ---------------------------------------------------------------- bad input


def a_ros_2_bag(path):
    with sqlite3.connect(path) as base:
        base.execute("create table messages (id)")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: None, "there is no log"),
        (lambda path: path.write_bytes(b""), "is empty"),
        (lambda path: path.write_text("hello, this is a text file of some length\n" * 5), "not an MCAP log"),
        (lambda path: path.write_bytes(b"#ROSBAG V2.0\n" + b"x" * 100), "ROS 1 bag"),
        (a_ros_2_bag, "ROS 2 bag"),
        (lambda path: path.mkdir(), "cannot be read"),
    ],
)
def test_what_is_no_log_is_one_line_and_2(make, words, tmp_path, capsys):
    path = tmp_path / "odd.mcap"
    make(path)
    code, out, err = review(capsys, path)
    assert code == 2 and out == "" and err.count("\n") == 1 and words in err


@pytest.mark.parametrize("name", ["", ".", "..", "/"])
@pytest.mark.parametrize("export", [[], ["--export", "csv", "--topic", "/health"]])
def test_what_is_no_name_of_a_file_is_no_log_either(name, export, capsys):
    code, out, err = review(capsys, name, *export)
    assert code == 2 and out == "" and err.count("\n") == 1 and "cannot be read: Is a directory" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["LOG", "LOG", "LOG"], "one log or two"),
        (["LOG", "--export", "csv"], "--topic"),
        (["LOG", "--topic", "/health"], "--export"),
        (["LOG", "LOG", "--export", "csv", "--topic", "/health"], "one log"),
        (["LOG", "--export", "csv", "--topic", "/nothing"], "no topic /nothing"),
        (["LOG", "--export", "xml", "--topic", "/health"], "xml"),
        (["LOG", "--html", "LOG"], "another file"),
        (["LOG", "--export", "csv", "--topic", "/health", "--out", "LOG"], "another file"),
        (["LOG", "--html", "nowhere/at/all.html"], "in a folder that exists"),
        (["LOG", "--export", "npz", "--topic", "/health", "--out", "nowhere/at/all.npz"], "in a folder that exists"),
        ([], "LOG"),
    ],
)
def test_a_wrong_request_is_one_line_and_2_and_the_log_stays_as_it_is(
    arguments, words, log, source, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    code, _, err = review(capsys, *(log if word == "LOG" else word for word in arguments))
    assert code == 2 and err.count("\n") == 1 and err.startswith("valve-drake: ") and words in err
    assert log.read_bytes() == source
