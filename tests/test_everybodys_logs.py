"""MCAP files of other programs, valid and odd: each message is found, kept by recover, and nothing false is said."""

import collections
import dataclasses as dc
import io
import itertools
import json
import os
import random
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap_samples import (
    CHANNEL,
    MESSAGES,
    PACK,
    SCHEMA,
    Sample,
    attachment,
    chunk,
    metadata,
    private,
    record,
    statistics,
)

from valve_drake import cli
from valve_drake.checks import ConfigError
from valve_drake.messages import CameraFrame, ModeState, Status
from valve_drake.recording import contents, foxglove, schemas
from valve_drake.recording import records as mcap_records
from valve_drake.recording.container import LIBRARY
from valve_drake.recording.reader import LogReader
from valve_drake.recording.recovery import recover
from valve_drake.recording.schemas import Vector
from valve_drake.recording.writer import LogWriter

SUMMARIES = {
    "no summary": (),
    "statistics": (statistics(10),),
    "definitions": (SCHEMA, CHANNEL),
    "all": (SCHEMA, CHANNEL, statistics(10)),
}


def run(capsys, *arguments):
    code = cli.main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return code, captured.out, captured.err


def by_the_package(path) -> list[tuple]:
    """What the mcap package reads: (logged, published, number, data) of each message."""
    with open(path, "rb") as file:
        found = [part for part in StreamReader(file, validate_crcs=True).records if isinstance(part, Message)]
    return [(part.log_time, part.publish_time, part.sequence, part.data) for part in found]


def ours(log: LogReader) -> list[tuple]:
    return [(one.when, one.published, one.sequence, one.data) for one in log.records()]


VARIANTS = list(itertools.product([None, "", "zstd", "lz4"], [b"", b"\1\xff\xff"], SUMMARIES, [True, False]))


@pytest.mark.parametrize(("compression", "pad", "summary", "crcs"), VARIANTS)
def test_every_form_of_a_valid_file_is_read_and_recovered(tmp_path, capsys, compression, pad, summary, crcs):
    sample = Sample(compression=compression, pad=pad, summary=SUMMARIES[summary], indexed=crcs, chunk_crc=crcs)
    path = dc.replace(sample, data_crc=crcs, summary_crc=crcs).write(tmp_path / "a.mcap")
    log = LogReader(path)
    assert log.damage == [] and log.losses == [] and log.lost_messages == 0
    assert len(MESSAGES) == log.topics["example"].count == len(by_the_package(path))
    assert ours(log) == by_the_package(path)
    assert (log.start, log.end) == (0.0, 9e-9)
    assert run(capsys, "recover", path, "-o", tmp_path / "b.mcap")[0] == 0
    new = LogReader(tmp_path / "b.mcap")
    assert new.damage == [] and ours(new) == ours(log) == by_the_package(tmp_path / "b.mcap")
    assert new.channels("example") == [CHANNEL] and new.schemas == {1: SCHEMA}
    assert (new.library, new.profile) == ("another 1.0", "ros2")


def test_review_names_the_program_that_wrote_a_log_and_counts(tmp_path, capsys):
    path = Sample(summary=SUMMARIES["all"]).write(tmp_path / "a.mcap")
    code, out, _ = run(capsys, "review", path)
    assert code == 0 and "written by another 1.0, not by valve_drake" in out and "example  Example  10" in out
    assert "unfinished" not in out and "whole: 10 messages" in out
    page = (tmp_path / "a.review.html").read_text()
    assert "written by another 1.0" in page and "the program did not write its result" not in page
    facts = json.loads(run(capsys, "review", path, "--json")[1])
    assert facts["sound"] and facts["messages"] == 10 and facts["lost"] == 0 and not facts["own"]
    shorter = Sample((SCHEMA, CHANNEL, *MESSAGES[:4])).write(tmp_path / "b.mcap")
    code, out, _ = run(capsys, "review", path, shorter)
    assert code == 0 and "they part at" in out and "only in" in out


@pytest.mark.parametrize("compression", [None, "zstd"])
def test_private_records_are_skipped_wherever_they_stand(tmp_path, compression):
    strange = private(0x81, b"mine"), private(0xFF, b"")
    parts = (strange[0], SCHEMA, CHANNEL, *MESSAGES[:5], *strange, *MESSAGES[5:], private(0x42, b"of a later version"))
    log = LogReader(Sample(parts, compression, summary=(*strange, statistics(10))).write(tmp_path / "a.mcap"))
    assert log.damage == [] and len(ours(log)) == 10


def test_this_program_writes_no_private_records_so_one_in_its_log_is_damage(tmp_path):
    parts = (SCHEMA, CHANNEL, *MESSAGES, private(0x86, b"was a chunk"))
    log = LogReader(Sample(parts, "zstd", library=LIBRARY).write(tmp_path / "a.mcap"))
    assert any("damaged" in line for line in log.damage)


def test_attachments_and_metadata_of_one_name_are_all_kept(tmp_path):
    files = attachment("a", b"1"), attachment("a", b"2", crc=False), attachment("b", b"3")
    facts = metadata("run", seed="1"), metadata("run", seed="2")
    path = Sample((SCHEMA, CHANNEL, files[0], facts[0], *MESSAGES, *files[1:], facts[1])).write(tmp_path / "a.mcap")
    log = LogReader(path)
    assert log.damage == [] and log.attachments["a"].data == b"2" and log.metadata["run"] == {"seed": "2"}
    recover(path, tmp_path / "b.mcap")
    with open(tmp_path / "b.mcap", "rb") as file:
        parts = list(StreamReader(file, validate_crcs=True).records)
    assert [part.data for part in parts if isinstance(part, Attachment)] == [b"1", b"2", b"3"]
    assert [part.metadata for part in parts if isinstance(part, Metadata)][:2] == [{"seed": "1"}, {"seed": "2"}]


def protobuf(id: int, kind: type) -> Schema:
    proto = schemas.proto_class(kind)
    return Schema(id=id, name=proto.DESCRIPTOR.full_name, encoding="protobuf", data=schemas.schema_data(proto))


def test_two_channels_of_one_topic_keep_their_schemas(tmp_path):
    defined = protobuf(1, Status), protobuf(2, Vector)
    channels = [Channel(id=k, topic="/x", message_encoding="protobuf", metadata={}, schema_id=k) for k in (1, 2)]
    written = Status(detail="hello"), Vector(values=np.array([4.0]))
    messages = [
        Message(channel_id=1 + k % 2, log_time=k, data=schemas.encode(written[k % 2]), publish_time=k, sequence=0)
        for k in range(12)
    ]
    path = Sample((*defined, *channels, *messages)).write(tmp_path / "a.mcap")
    recover(path, tmp_path / "b.mcap")
    for log in (LogReader(path), LogReader(tmp_path / "b.mcap")):
        assert log.damage == [] and log.topics["/x"].count == 12
        assert log.topics["/x"].schema == "valve_drake.Status, valve_drake.Vector"
        kinds = collections.Counter(type(message).__name__ for _, _, message in log.messages())
        assert kinds == {"Status": 6, "Vector": 6}
        assert [channel.schema_id for channel in log.channels("/x")] == [1, 2]


# ---------------------------------------------------------------- summaries that are wrong


@pytest.mark.parametrize("start", [1, 8, 60, 10**6, 2**63])
@pytest.mark.parametrize("compression", [None, "lz4"])
def test_a_summary_that_lies_about_its_place_costs_nothing(tmp_path, capsys, start, compression):
    sample = Sample(compression=compression, summary=SUMMARIES["all"], summary_crc=False, summary_start=start)
    path = sample.write(tmp_path / "a.mcap")
    log = LogReader(path)
    assert len(ours(log)) == 10 and any("summary is damaged" in line for line in log.damage)
    assert run(capsys, "recover", path, "-o", tmp_path / "b.mcap")[0] == 0
    assert run(capsys, "review", path)[0] == 3


def test_a_count_that_is_not_right_is_told_either_way(tmp_path, capsys):
    more = Sample(summary=(statistics(12),)).write(tmp_path / "more.mcap")
    assert "2 of 12 messages are missing" in LogReader(more).damage and LogReader(more).lost_messages == 2
    assert run(capsys, "recover", more, "-o", tmp_path / "b.mcap")[0] == 3
    less = Sample(summary=(statistics(3),)).write(tmp_path / "less.mcap")
    assert LogReader(less).damage == ["the summary counts 3 messages, the log holds 10"]
    assert run(capsys, "recover", less, "-o", tmp_path / "c.mcap")[0] == 0


def test_a_summary_that_lost_bytes_have_moved_still_counts(tmp_path):
    data = own_log(tmp_path / "a.mcap").read_bytes()
    start, end = chunks(data)[2]
    (tmp_path / "b.mcap").write_bytes(data[: start + 50] + data[end - 50 :])
    log = LogReader(tmp_path / "b.mcap")
    assert log.lost_messages == 64 and "64 of 384 messages are missing" in log.losses
    assert not any("summary" in line for line in log.damage)


def test_definitions_that_only_the_summary_has_are_used(tmp_path):
    log = LogReader(Sample(MESSAGES, "zstd", summary=(SCHEMA, CHANNEL)).write(tmp_path / "a.mcap"))
    assert log.damage == [] and log.topics["example"].count == 10 and log.topics["example"].schema == "Example"


def test_bytes_behind_the_end_are_told(tmp_path):
    data = Sample().bytes()
    (tmp_path / "a.mcap").write_bytes(data + data)
    log = LogReader(tmp_path / "a.mcap")
    assert len(ours(log)) == 10 and f"{len(data)} bytes behind the log's end are not read" in log.damage
    (tmp_path / "b.mcap").write_bytes(data[:-3])
    log = LogReader(tmp_path / "b.mcap")
    assert len(ours(log)) == 10 and log.damage == ["the file's last bytes are damaged"] and log.losses == []


# ---------------------------------------------------------------- damage


def variant(rng: random.Random) -> tuple[bytes, list[Message]]:
    """A valid file of any form, of many small chunks or none."""
    messages = [
        Message(rng.choice((1, 2)), rng.randrange(10**9), rng.randbytes(rng.randrange(1, 60)), k, rng.randrange(5))
        for k in range(40)
    ]
    second = dc.replace(CHANNEL, id=2, topic="other", schema_id=0)
    compression = rng.choice([None, "", "zstd", "lz4"])
    if compression is None:
        parts: list = [SCHEMA, CHANNEL, second, *messages]
    else:
        groups = [messages[k : k + 8] for k in range(0, 40, 8)]
        contents = [b"".join(record(part) for part in (SCHEMA, CHANNEL, second, *group)) for group in groups]
        parts = [record(chunk(content, compression)) for content in contents]
    parts.insert(rng.randrange(len(parts)), metadata("m", a="b"))
    parts.insert(rng.randrange(len(parts)), attachment("f", b"12345" * 5))
    summary = rng.choice([(), (SCHEMA, CHANNEL, second, statistics(40))])
    return Sample(tuple(parts), summary=summary).bytes(), messages


@pytest.mark.parametrize("seed", range(150))
def test_whatever_is_done_to_a_file_is_told_and_costs_only_what_was_hit(tmp_path, seed):
    rng = random.Random(seed)
    data, messages = variant(rng)
    path, hurt = tmp_path / "a.mcap", bytearray(data)
    at, kind = rng.randrange(9, len(data)), seed % 5
    if kind == 0:
        hurt[at] ^= 1 << rng.randrange(8)
    elif kind == 1:
        del hurt[at:]
    elif kind == 2:
        del hurt[at : at + rng.randrange(1, 200)]
    elif kind == 3:
        hurt[at:at] = rng.randbytes(rng.randrange(1, 100))
    else:
        hurt[at:] = bytes(4096)
    path.write_bytes(hurt)
    log = LogReader(path)
    assert log.damage, "damage is told"
    found = [(when, data) for when, _, _, data in ours(log)]
    written = [(message.log_time, message.data) for message in messages]
    kept = collections.Counter(found) & collections.Counter(written)
    chunked = b"\x06" in data and log._contents.blocks and log._contents.blocks[0].chunk is not None
    if chunked:
        assert kept.total() == len(found), "a chunk proves its messages"
    if kind in (0, 3):
        assert kept.total() >= 40 - 8, "one chunk, or fewer messages, at most"
    if kind in (1, 4) and not chunked and found:
        assert kept.total() == sum(end <= at for end in ends(data)), "all up to the cut"
        assert kept.total() == len(found), "and nothing made of a part and zeros"
    recover(path, tmp_path / "b.mcap")
    new = LogReader(tmp_path / "b.mcap")
    assert new.damage == [] and ours(new) == ours(log) == by_the_package(tmp_path / "b.mcap")
    assert "; ".join(log.damage) == new.past_damage


def ends(data: bytes) -> list[int]:
    """Where each message outside of chunks ends."""
    out, position = [], 8
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        position += 9 + length
        out += [position] if opcode == 5 else []
    return out


def own_log(path, seconds=3.0):
    with LogWriter(path) as log:
        for k in range(round(seconds * 64)):
            log.write("/a/status", Status(time=k / 64, detail=f"step {k}"), k / 64)
            log.write("/supervisor/mode", ModeState(time=k / 64), k / 64)
    return path


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Where each chunk's record begins and ends."""
    out, position = [], 8
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        if opcode == 6:
            out.append((position, position + 9 + length))
        position += 9 + length
    return out


def test_a_chunk_can_be_read_alone(tmp_path):
    data = own_log(tmp_path / "a.mcap").read_bytes()
    assert len(chunks(data)) == 6
    for start, end in chunks(data):
        (tmp_path / "b.mcap").write_bytes(data[:39] + data[start:end])
        log = LogReader(tmp_path / "b.mcap")
        assert {topic: found.schema for topic, found in log.topics.items()} == {
            "/a/status": "valve_drake.Status",
            "/supervisor/mode": "valve_drake.ModeState",
        }
        assert all(log.decode(one) is not None for one in log.records())


def test_a_killed_log_whose_first_chunk_is_damaged_loses_that_chunk_alone(tmp_path, capsys):
    data = bytearray(own_log(tmp_path / "a.mcap").read_bytes())
    places = chunks(data)
    data[places[0][0] + 60] ^= 1
    (tmp_path / "b.mcap").write_bytes(data[: places[-1][1]])
    log = LogReader(tmp_path / "b.mcap")
    assert log.topics["/a/status"].count == log.topics["/supervisor/mode"].count == 160
    assert log.lost_messages == 64 and "64 messages are missing between others" in log.losses
    code, out, _ = run(capsys, "recover", tmp_path / "b.mcap", "-o", tmp_path / "c.mcap")
    assert code == 3 and "320 messages" in out and "64 messages are missing" in out


def defined_once(last: bytes) -> Sample:
    """A log of this program whose definitions stand in one chunk, and its messages in another."""
    channel = Channel(id=1, topic="/s", message_encoding="protobuf", metadata={}, schema_id=1)
    first = record(protobuf(1, Status)) + record(channel)
    message = Message(channel_id=1, log_time=5, data=schemas.encode(Status(detail="kept")), publish_time=5, sequence=0)
    return Sample((last or record(chunk(first, "zstd")), record(chunk(record(message), "zstd"))), library=LIBRARY)


def test_definitions_in_a_damaged_chunk_are_used_and_told(tmp_path):
    sample = defined_once(b"")
    hurt = bytearray(sample.parts[0])
    hurt[9 + 24] ^= 1  # the chunk's CRC: its content is right, and nothing proves it
    path = dc.replace(sample, parts=(bytes(hurt), sample.parts[1])).write(tmp_path / "a.mcap")
    log = LogReader(path)
    assert [message.detail for _, _, message in log.messages(["/s"])] == ["kept"]
    assert "the definitions of 1 topics come from damaged bytes" in log.losses


def test_messages_without_a_definition_are_kept(tmp_path, capsys):
    path = defined_once(private(6, b"nothing of it is left")).write(tmp_path / "a.mcap")
    code, out, _ = run(capsys, "recover", path, "-o", tmp_path / "b.mcap")
    assert code == 3 and "1 messages have lost their topics' definitions" in out and "/unknown/channel_1" in out
    new = LogReader(tmp_path / "b.mcap")
    assert schemas.decode(Status, next(new.records(["/unknown/channel_1"])).data).detail == "kept"
    with pytest.raises(ConfigError, match="not recorded by this version"):
        next(new.messages())
    assert run(capsys, "review", path)[0] == 3


# ---------------------------------------------------------------- recover


def test_a_log_that_was_only_cut_is_recovered_with_0_and_a_word(tmp_path, capsys):
    data = own_log(tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap.active").write_bytes(data[: chunks(data)[-1][1] - 20])
    (tmp_path / "a.mcap").unlink()
    before = (tmp_path / "a.mcap.active").read_bytes()
    code, out, _ = run(capsys, "recover", tmp_path / "a.mcap.active", "-o", tmp_path / "a.mcap")
    assert code == 0 and "breaks off after" in out and "320 messages" in out
    assert (tmp_path / "a.mcap.active").read_bytes() == before
    assert run(capsys, "review", tmp_path / "a.mcap.active")[0] == 3


def test_a_cut_chunk_whose_length_reads_as_an_end_of_data_is_a_cut(tmp_path, capsys):
    data = own_log(tmp_path / "a.mcap").read_bytes()
    start = chunks(data)[3][0]
    head = struct.pack("<BQ", 6, 0x40F)  # its bytes 1 to 13 are a DataEnd record: opcode 0x0F, length 4
    (tmp_path / "b.mcap").write_bytes(
        data[:start] + head + data[start + 9 : start + 40] + bytes(len(data) - start - 40)
    )
    code, out, _ = run(capsys, "recover", tmp_path / "b.mcap", "-o", tmp_path / "c.mcap")
    assert "192 messages" in out and "breaks off" in out
    assert code == 0 and "bytes are damaged" not in out


@pytest.mark.parametrize("filler", [b"\xa5", b"\0"])
def test_a_cut_is_told_from_bytes_that_were_written_over(tmp_path, capsys, filler):
    data = own_log(tmp_path / "a.mcap").read_bytes()
    half = chunks(data)[3][0] + 40  # in a chunk's middle
    (tmp_path / "b.mcap").write_bytes(data[:half] + filler * (len(data) - half))
    code, out, _ = run(capsys, "recover", tmp_path / "b.mcap", "-o", tmp_path / "c.mcap")
    assert "192 messages" in out and "breaks off" in out
    assert (code, "bytes are damaged" in out) == ((0, False) if filler == b"\0" else (3, True))


def test_recovering_again_does_not_forget_the_damage(tmp_path, capsys):
    data = bytearray(own_log(tmp_path / "a.mcap").read_bytes())
    data[chunks(data)[2][0] + 60] ^= 1
    (tmp_path / "0.mcap").write_bytes(data)
    for k in range(3):
        recover(tmp_path / f"{k}.mcap", tmp_path / f"{k + 1}.mcap")
    first, last = LogReader(tmp_path / "0.mcap"), LogReader(tmp_path / "3.mcap")
    assert last.past_damage == "; ".join(first.damage)
    assert [one.name for one in last.all_metadata].count("recovered") == 3
    code, out, _ = run(capsys, "review", tmp_path / "3.mcap")
    assert code == 3 and "recovered from a damaged log" in out


def test_recover_writes_over_nothing_but_what_it_made(tmp_path, capsys):
    source = own_log(tmp_path / "a.mcap")
    data = source.read_bytes()
    other = own_log(tmp_path / "b.mcap", 1.0).read_bytes()
    os.link(source, tmp_path / "hard.mcap")
    (tmp_path / "soft.mcap").symlink_to("b.mcap")
    for name in ("a.mcap", "b.mcap", "hard.mcap", "soft.mcap", ".", "no/where.mcap", ""):
        code, _, err = run(capsys, "recover", source, "-o", tmp_path / name if name else "")
        assert code == 2 and err.count("\n") == 1
    assert source.read_bytes() == data and (tmp_path / "b.mcap").read_bytes() == other
    assert run(capsys, "recover", source, "-o", tmp_path / "c.mcap")[0] == 0
    assert run(capsys, "recover", tmp_path / "b.mcap", "-o", tmp_path / "c.mcap")[0] == 0  # made by recover before
    assert LogReader(tmp_path / "c.mcap").topics["/a/status"].count == 64


# ---------------------------------------------------------------- bounds

BOMBS = """
import json, sys
from valve_drake.recording.reader import LogReader
for path in sys.argv[1:]:
    log = LogReader(path)
    list(log.records())
    status = dict(line.split(":", 1) for line in open("/proc/self/status"))
    print(json.dumps([int(status["VmHWM"].split()[0]) // 1024, log.topics["example"].count, *log.damage]))
"""


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_chunk_that_grows_without_end_is_one_line_and_no_memory(tmp_path, compression):
    claims, paths = (0, 1000, 1 << 31, 1 << 60), []
    for claim in claims:
        big = record(dc.replace(MESSAGES[1], data=bytes(200 << 20))) if claim in (0, 1000) else b"x" * 1000
        bomb = chunk(big, compression, size=claim)
        messages = (SCHEMA, CHANNEL, *MESSAGES, record(bomb), *MESSAGES)
        paths.append(Sample(messages).write(tmp_path / f"{claim}.mcap"))
    done = subprocess.run([sys.executable, "-c", BOMBS, *paths], capture_output=True, text=True, timeout=60)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) == len(claims), done.stderr
    for claim, (memory, count, *damage) in zip(claims, found):
        assert count == 20 and len(damage) == 1, damage
        assert ("claims to hold" in damage[0]) == (claim > 1 << 30)
        assert memory < 200  # MB, most of it the interpreter and its libraries


def test_records_that_claim_more_than_there_is_are_damage_alone(tmp_path):
    for length in (100, 1 << 31, 1 << 60, (1 << 64) - 1):
        for opcode in (1, 3, 4, 5, 6, 7, 9, 11, 12, 15, 0x80):
            lie = struct.pack("<BQ", opcode, length) + b"\xff" * 40
            log = LogReader(Sample((SCHEMA, CHANNEL, *MESSAGES, lie, *MESSAGES)).write(tmp_path / "a.mcap"))
            assert log.topics["example"].count >= 19 and log.damage, (opcode, length)


def test_counts_inside_records_that_lie_are_damage_alone(tmp_path):
    for opcode in (3, 4, 6, 9, 11, 12):
        lie = private(opcode, struct.pack("<HH", 7, 7) + b"\xff" * 60)
        log = LogReader(Sample((SCHEMA, CHANNEL, *MESSAGES, lie, *MESSAGES)).write(tmp_path / "a.mcap"))
        assert log.topics["example"].count == 20 and log.damage, opcode


def test_too_many_messages_for_memory_are_read_again_from_the_file(tmp_path, monkeypatch):
    for compression in PACK:
        path = Sample(compression=compression).write(tmp_path / f"{compression}.mcap")
        whole = ours(LogReader(path))
        monkeypatch.setattr(contents, "INDEX_LIMIT", 0)
        log = LogReader(path)
        assert ours(log) == whole and log.timing(["example"])["example"][1].tolist() == [m.sequence for m in MESSAGES]
        monkeypatch.undo()


def test_definitions_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(contents, "DEFINITIONS_LIMIT", 1000)
    many = [dc.replace(SCHEMA, id=k, data=bytes(100)) for k in range(2, 100)]
    log = LogReader(Sample((SCHEMA, CHANNEL, *MESSAGES, *many)).write(tmp_path / "a.mcap"))
    assert log.topics["example"].count == 10 and any("take more than 1000 bytes" in line for line in log.damage)


# ---------------------------------------------------------------- logs that make no sense, in review


def log_of(path, *rows):
    """(topic, message) a tick, written as this program writes."""
    with LogWriter(path) as log:
        for k in range(5):
            for topic, make in rows:
                log.write(topic, make(k), k / 32)
    return path


VALUES = {  # of /truth/base_pose
    "short": lambda k: [1.0],
    "long": lambda k: [0.0] * 50,
    "empty": lambda k: [],
    "ragged": lambda k: [0.0] * k,
    "not finite": lambda k: [np.nan, np.inf, -np.inf],
    "huge": lambda k: [1e308, -1e308, 1e308],
}


@pytest.mark.parametrize("what", VALUES)
def test_vectors_of_any_length_and_value_leave_a_page(tmp_path, capsys, what):
    def vector(k):
        return Vector(k / 32, (), np.array(VALUES[what](k), dtype=float))

    topics = ("/truth/base_pose", "/truth/marker_pose", "/truth/valve_angle")
    path = log_of(tmp_path / "a.mcap", *((topic, vector) for topic in topics))
    code, _, err = run(capsys, "review", path)
    page = (tmp_path / "a.review.html").read_text()
    assert code == 0 and err == "" and "Is the log whole?" in page
    if what in ("short", "empty", "ragged"):
        assert "Left out on this page" in page and "truth" in page
    json.loads(run(capsys, "review", path, "--json")[1], parse_constant=lambda name: pytest.fail(name))


@pytest.mark.parametrize("data", [b"", b"\xff" * 20, b"\0" * 200, schemas.schema_data(schemas.proto_class(Status))])
@pytest.mark.parametrize("encoding", ["protobuf", "json", ""])
def test_schemas_that_are_none_leave_a_page(tmp_path, capsys, data, encoding):
    names = {
        "/supervisor/mode": "valve_drake.ModeState",
        "/log": "foxglove.Log",
        "/pace": "valve_drake.Pace",
        "/head_left/image": "foxglove.CompressedImage",
    }
    records = []
    for k, (topic, name) in enumerate(names.items(), 1):
        records.append(Schema(id=k, name=name, encoding=encoding, data=data))
        records.append(Channel(id=k, topic=topic, message_encoding=encoding, metadata={}, schema_id=k))
        records += [dc.replace(message, channel_id=k) for message in MESSAGES]
    path = Sample(tuple(records)).write(tmp_path / "a.mcap")
    code, out, _ = run(capsys, "review", path)
    assert code == 0 and "40 messages" in out and (tmp_path / "a.review.html").stat().st_size > 1000


def test_an_image_that_claims_gigabytes_is_not_decoded(tmp_path, capsys):
    head = struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b""))
    png = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in parts
    )
    frame = foxglove.image(CameraFrame("head_left", 0.01, 0, data=png))

    def mode(k):
        return ModeState(time=k / 32, mode="turn", activation=k, since=k / 32)

    path = log_of(tmp_path / "a.mcap", ("/head_left/image", lambda k: frame), ("/supervisor/mode", mode))
    assert run(capsys, "review", path)[0] == 0
    assert "cannot be decoded" in (tmp_path / "a.review.html").read_text()


def test_messages_of_one_time_have_no_rate(tmp_path, capsys):
    with LogWriter(tmp_path / "a.mcap") as log:
        for _ in range(5):
            log.write("/supervisor/mode", ModeState(), 0.0)
        log.write("/a", Status(), 1.0)
    code, out, err = run(capsys, "review", tmp_path / "a.mcap")
    assert code == 0 and err == "" and "gaps" not in out


def test_a_log_of_one_message_a_topic_has_a_page(tmp_path, capsys):
    path = own_log(tmp_path / "a.mcap", 1 / 64)
    assert run(capsys, "review", path)[0] == 0
    data = path.read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[: chunks(data)[0][1]])  # killed in its first half second
    assert run(capsys, "review", tmp_path / "b.mcap")[0] == 3
    assert "breaks off" in (tmp_path / "b.review.html").read_text()


EVIL = '"><script>alert(1)</script><img src=x onerror=alert(2)>\x1b[2J\x1b]0;title\x07[bold red]x[/]\r\n'


def test_no_text_of_a_log_is_script_markup_or_an_escape_sequence(tmp_path, capsys):
    def mode(k):
        return ModeState(time=k / 32, mode=EVIL, activation=k, since=k / 32, reason=EVIL, verdict=EVIL)

    path = log_of(tmp_path / "<img src=x>.mcap", ("/supervisor/mode", mode), ("/" + EVIL, mode))
    other = log_of(tmp_path / "b.mcap", ("/supervisor/mode", lambda k: dc.replace(mode(k), time=9.0)))
    (tmp_path / "<img src=x>.html").write_text("the recording")
    html = tmp_path / "page.html"
    for logs in ((path,), (path, other)):
        code, out, _ = run(capsys, "review", *logs, "--html", html)
        assert code == 0 and "\x1b" not in out and "\x07" not in out and "[bold red]x[/]" in out.replace("\n", "")
        page = html.read_text()
        assert "<script>alert" not in page and "<img src=x" not in page and 'class="m-unknown' in page


def test_a_link_to_the_recording_is_a_path_whatever_its_name(tmp_path, capsys):
    path = own_log(tmp_path / "javascript:alert(1);#?.mcap", 0.1)
    (tmp_path / "javascript:alert(1);#?.html").write_text("the recording")
    assert run(capsys, "review", path, "--html", tmp_path / "page.html")[0] == 0
    assert 'href="javascript%3Aalert%281%29%3B%23%3F.html"' in (tmp_path / "page.html").read_text()


def test_review_writes_over_nothing_but_its_own_pages_and_tables(tmp_path, capsys):
    path = own_log(tmp_path / "a.mcap", 0.2)
    (tmp_path / "notes.html").write_text("mine")
    assert run(capsys, "review", path, "--html", tmp_path / "notes.html")[0] == 2
    export = ("review", path, "--export", "csv", "--topic", "/a/status", "--out")
    assert run(capsys, *export, tmp_path / "notes.html")[0] == 2 and (tmp_path / "notes.html").read_text() == "mine"
    for _ in range(2):
        assert run(capsys, "review", path)[0] == 0 and run(capsys, *export, tmp_path / "a.csv")[0] == 0
        assert run(capsys, *[str(a).replace("csv", "npz") for a in export], tmp_path / "a.npz")[0] == 0


# ---------------------------------------------------------------- single records


def test_rows_and_crc_are_those_of_the_bytes():
    data = record(MESSAGES[3]) + record(MESSAGES[4])
    found = mcap_records.scan(data, 0, len(data))
    rows = mcap_records.rows(data, found.positions)
    assert rows["when"].tolist() == [3, 3] and rows["published"].tolist() == [8, 8] and found.end == len(data)
    assert mcap_records.crc(data, 3, 20) == zlib.crc32(data[3:20])
    with open(os.devnull, "rb"), io.BytesIO(data):
        assert mcap_records.scan(data, 0, len(data) - 1).end == len(record(MESSAGES[3]))
