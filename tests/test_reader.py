"""The log's reader: whatever happened to the file, everything that is sound, and a line on what is not."""

import os
import random
import time
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from google.protobuf import descriptor_pb2
from log_samples import same, samples, write_log
from mcap.writer import IndexType, Writer

from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.messages import Command, Message, RobotState, Segmentation, SegmentationPair, Status
from valve_drake.recording import rerun_view, schemas
from valve_drake.recording.reader import LogReader
from valve_drake.recording.recovery import recover
from valve_drake.recording.writer import LogWriter

SECONDS = 3.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "whole.mcap"
    write_log(path, SECONDS, 4000)
    return path


@pytest.fixture(scope="module")
def records(whole) -> list:
    return list(LogReader(whole).records())


def is_subsequence(part: list, of: list) -> bool:
    rest = iter(of)
    return all(any(item == other for other in rest) for item in part)


def test_a_whole_log_gives_back_all_that_was_written(whole):
    log = LogReader(whole)
    assert log.damage == []
    assert log.metadata == {"run": {"seed": "7", "scenario": "a: 1\n"}, "result": {"outcome": "done"}}
    assert log.attachments["layout.json"].data == b"{}"
    read = list(log.messages())
    written = list(samples(SECONDS, 4000))
    assert len(read) == len(written)
    for (topic, t, message), (topic_0, message_0, t_0) in zip(read, written):
        assert (topic, t) == (topic_0, t_0)
        if isinstance(message_0, Message):
            assert same(message, message_0)
        else:
            assert message.SerializeToString() == message_0.SerializeToString()


def test_topics_say_how_many_and_when(whole):
    log = LogReader(whole)
    topic = log.topics["/head_left/image"]
    assert (topic.schema, topic.count, topic.start, topic.end) == ("foxglove.CompressedImage", 24, 0.0, 2.875)
    assert log.topics["/robot_state/robot_state"].schema == "valve_drake.RobotState"
    assert (log.start, log.end) == (0.0, SECONDS - 1 / 128)


def test_messages_of_some_topics_and_times(whole):
    log = LogReader(whole)
    found = [t for _, t, _ in log.messages(["/head_left/image"], start=0.5, end=1.0)]
    assert found == [0.5, 0.625, 0.75, 0.875, 1.0]
    with pytest.raises(ConfigError, match="whole.mcap has no topic /tail"):
        log.messages(["/tail"])


def test_series_are_arrays_with_nan_for_none(whole):
    found = LogReader(whole).series("/base_approach/command", ["base_twist", "time", "torso"])
    assert found["base_twist"].shape == (384, 2)
    assert np.isnan(found["base_twist"][0::2]).all() and np.isfinite(found["base_twist"][1::2]).all()
    assert np.array_equal(found["time"], np.arange(384) / 128)
    assert np.isnan(found["torso"]).all()


def test_series_reach_into_nested_and_repeated_messages(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        for k in range(3):
            pair = SegmentationPair(left=Segmentation(green=np.ones((k, 3))), sequence=k)
            log.write("/pair", pair, k)
            joints = [JointState(name="one", position=k), JointState(name="two", position=2 * k, effort=5)]
            log.write("/joint_states", JointStates(joints=joints), k)
    log = LogReader(tmp_path / "a.mcap")
    found = log.series("/joint_states", ["joints.position", "joints.effort", "joints.name"])
    assert np.array_equal(found["joints.position"], [[0, 0], [1, 2], [2, 4]])
    assert np.array_equal(found["joints.effort"], [[0, 5]] * 3)
    assert found["joints.name"][0].tolist() == ["one", "two"]
    found = log.series("/pair", ["left.green", "sequence"])
    assert [len(rows) for rows in found["left.green"]] == [0, 1, 2]
    assert found["sequence"].tolist() == [0, 1, 2]


def test_series_of_lists_of_different_lengths_are_objects(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        for k in range(2):
            drawing = ImageAnnotations()
            for corners in (3, 4):
                drawing.points.add(points=[Point2(x=n, y=k) for n in range(corners)])
            log.write("/drawn", drawing, k)
    found = LogReader(tmp_path / "a.mcap").series("/drawn", ["points.points.x"])["points.points.x"]
    assert found.dtype == object and found[1] == [[0, 1, 2], [0, 1, 2, 3]]


def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    with pytest.raises(ConfigError, match="log .*pipe.mcap is a device, pipe or socket, not a file"):
        LogReader(tmp_path / "pipe.mcap")


def test_what_rerun_cannot_do_is_one_line_and_a_failure(capsys):
    assert rerun_view.main(["/"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises(OperationFailed, match=r"rerun no such failed: [^\[\n]+$"):
        rerun_view._rerun("no", "such")


def test_a_log_cut_off_anywhere_gives_all_complete_chunks(whole, records, tmp_path):
    data = whole.read_bytes()
    rng = random.Random(4)
    cut, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    for size in sorted(rng.randrange(9, len(data)) for _ in range(20)):
        cut.write_bytes(data[:size])
        log = LogReader(cut)
        found = list(log.records())
        assert found == records[: len(found)]
        assert "breaks off" in log.damage[-1]
        assert recover(cut, saved).damage == log.damage
        new = LogReader(saved)
        assert new.damage == []
        assert list(new.records()) == found
        assert new.metadata["recovered"]["messages"] == str(len(found))
        assert new.metadata.keys() == log.metadata.keys() | {"recovered"}
    assert len(found) > 100


def test_a_flipped_bit_anywhere_is_told_and_costs_at_most_its_chunk(whole, records, tmp_path):
    data = bytearray(whole.read_bytes())
    rng = random.Random(8)
    bad = tmp_path / "bad.mcap"
    largest = max(len(rows) for rows in by_chunk(whole))
    everywhere = [rng.randrange(len(data)) for _ in range(100)]
    for place in [*range(0, 60, 3), *everywhere, *range(len(data) - 60, len(data))]:
        bit = 1 << rng.randrange(8)
        data[place] ^= bit
        bad.write_bytes(data)
        data[place] ^= bit
        log = LogReader(bad)
        assert log.damage, place
        found = list(log.records())
        assert len(found) >= len(records) - largest, place
        assert is_subsequence(found, records), place


def by_chunk(path: Path) -> list[list]:
    """Numbers of messages: chunks end at multiples of half a second."""
    chunks: dict[int, list] = {}
    for record in LogReader(path).records():
        chunks.setdefault(int(record.time * 2), []).append(record)
    return list(chunks.values())


def test_damage_says_where(whole, records, tmp_path):
    data = bytearray(whole.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "bad.mcap").write_bytes(data)
    log = LogReader(tmp_path / "bad.mcap")
    lost = set(records) - set(log.records())
    assert lost
    before = max(r.time for r in records if r.time < min(r.time for r in lost))
    after = min(r.time for r in records if r.time > max(r.time for r in lost))
    assert f"damaged after t = {before:.3f} s, sound again from t = {after:.3f} s" in log.damage[0]
    assert log.damage[1] == f"{len(lost)} of {len(records)} messages are missing"


def test_damage_of_an_unfinished_log_does_not_hide_the_rest(whole, records, tmp_path):
    data = bytearray(whole.read_bytes())
    data = data[: int(len(data) * 0.9)]
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(data)
    log = LogReader(tmp_path / "bad.mcap")
    assert len(log.damage) == 3
    lost = sum(r.time < log.end + 1e-3 for r in records) - len(list(log.records()))
    assert log.damage[1] == f"{lost} messages are missing between others" and log.lost_messages == lost > 0
    found = list(log.records())
    assert is_subsequence(found, records) and found[-1].time > 1.9


def test_recover_keeps_what_was_sound(whole, records, tmp_path):
    assert recover(whole, tmp_path / "new.mcap").damage == []
    new = LogReader(tmp_path / "new.mcap")
    assert list(new.records()) == records
    assert new.attachments["layout.json"].data == b"{}"
    assert new.metadata["recovered"] == {"messages": str(len(records)), "damage": ""}
    with pytest.raises(ConfigError, match="another file than"):
        recover(whole, whole)
    assert list(LogReader(whole).records()) == records


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"#ROSBAG V2.0\n" + b"x" * 100, "is a ROS 1 bag, not an MCAP log"),
        (b"SQLite format 3\0" + b"x" * 100, "is a ROS 2 bag, not an MCAP log"),
        (b"time,angle\n0,0\n", "is not an MCAP log"),
        (b"\x00", "is not an MCAP log"),
        (None, "there is no log"),
    ],
)
def test_what_is_no_log_is_refused_in_one_line(tmp_path, content, words):
    path = tmp_path / "strange"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=words) as error:
        LogReader(path)
    assert "\n" not in str(error.value)


def test_a_folder_is_no_log(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        LogReader(tmp_path)


def test_an_unfinished_log_is_pointed_to(tmp_path):
    (tmp_path / "a.mcap.active").write_bytes(b"x")
    with pytest.raises(ConfigError, match="a.mcap.active"):
        LogReader(tmp_path / "a.mcap")


def write_foreign(path: Path, name: str, encoding: str, schema: bytes, data: bytes) -> None:
    with open(path, "wb") as file:
        mcap = Writer(file)
        mcap.start()
        schema_id = mcap.register_schema(name, encoding, schema)
        mcap.add_message(mcap.register_channel("/a", encoding, schema_id), 0, data, 0)
        mcap.finish()


def test_logs_of_other_programs_are_refused_in_one_line_when_decoded(tmp_path):
    write_foreign(tmp_path / "a.mcap", "std_msgs/String", "json", b"{}", b"{}")
    log = LogReader(tmp_path / "a.mcap")
    assert log.topics["/a"].count == 1
    with pytest.raises(ConfigError, match="a.mcap: /a was not recorded by this version"):
        next(log.messages())


def test_a_field_that_changed_its_type_is_refused_in_one_line(tmp_path):
    # A log that calls valve_drake.Command what is laid out like a Status: `torso` is text in it.
    field = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="old.proto", package="valve_drake", syntax="proto3")
    file.message_type.add(name="Command").field.add(name="torso", number=1, type=field.TYPE_STRING, label=1)
    schema = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    write_foreign(tmp_path / "a.mcap", "valve_drake.Command", "protobuf", schema, b"\x0a\x02no")
    with pytest.raises(ConfigError, match="not recorded by this version"):
        next(LogReader(tmp_path / "a.mcap").messages())


def test_a_log_without_summary_is_whole(tmp_path):
    with open(tmp_path / "a.mcap", "wb") as file:
        options = {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False}
        mcap = Writer(file, index_types=IndexType.NONE, use_summary_offsets=False, **options)
        mcap.start()
        proto = schemas.proto_class(Status)
        schema = mcap.register_schema(proto.DESCRIPTOR.full_name, "protobuf", schemas.schema_data(proto))
        mcap.add_message(mcap.register_channel("/a", "protobuf", schema), 0, schemas.encode(Status(detail="x")), 0)
        mcap.finish()
    log = LogReader(tmp_path / "a.mcap")
    assert log.damage == []
    assert [message.detail for _, _, message in log.messages()] == ["x"]


def test_a_class_that_this_version_lacks_is_read_as_protobuf(tmp_path):
    schema = schemas.schema_data(schemas.proto_class(Status)).replace(b"Status", b"Statue")
    write_foreign(tmp_path / "a.mcap", "valve_drake.Statue", "protobuf", schema, schemas.encode(Status(detail="x")))
    _, _, message = next(LogReader(tmp_path / "a.mcap").messages())
    assert message.detail == "x"


def test_reading_a_minute_of_messages_takes_seconds_at_most(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        for k in range(7680):
            log.write("/robot_state/robot_state", RobotState(time=k / 128), k / 128)
            log.write("/a/command", Command(time=k / 128), k / 128)
    begin = time.perf_counter()
    log = LogReader(tmp_path / "a.mcap")
    log.series("/robot_state/robot_state", ["odometry"])
    assert time.perf_counter() - begin < 5.0
