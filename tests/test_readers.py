"""Other people's readers on the log of a whole run: `make readers`, or `pytest -m readers` where they are installed.

LOG: the log of a run that is there already; without it one is made.
"""

import collections
import contextlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import zstandard
from mcap.reader import make_reader

from valve_drake import runner
from valve_drake import scenario as scenarios
from valve_drake.recording import rerun_view
from valve_drake.recording.reader import LogReader

pytestmark = pytest.mark.readers
NODE = Path(__file__).parent / "readers"


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    if path := os.environ.get("LOG"):
        return LogReader(path)
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    runner.run(scenarios.load(None, ["seed=1"]), path)
    return LogReader(path)


@pytest.fixture(scope="module")
def counts(log):
    """Messages by topic as the program's own reader finds them."""
    assert log.damage == []
    return {name: topic.count for name, topic in log.topics.items()}


@pytest.fixture
def flipped(log, tmp_path):
    """The log with a bit turned over within a chunk's messages, so that it can be unpacked and its CRC alone tells."""
    data = bytearray(log.path.read_bytes())
    with open(log.path, "rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    for chunk in chunks[len(chunks) // 2 :]:
        end = chunk.chunk_start_offset + chunk.chunk_length
        start, at = end - chunk.compressed_size, end - chunk.compressed_size // 2
        data[at] ^= 1
        with contextlib.suppress(zstandard.ZstdError):
            zstandard.decompress(bytes(data[start:end]), chunk.uncompressed_size)
            (tmp_path / "flipped.mcap").write_bytes(data)
            return tmp_path / "flipped.mcap"
        data[at] ^= 1
    raise AssertionError("no chunk can be unpacked with a bit turned over")


@pytest.fixture(scope="module")
def rerun(tmp_path_factory):
    """rerun(arguments): Rerun's command, with its analytics off."""
    if importlib.util.find_spec("rerun") is None:
        pytest.skip("rerun-sdk is not installed: pip install '.[readers]'")
    home = tmp_path_factory.mktemp("home")

    def run(*arguments):
        command = [sys.executable, "-m", "rerun", *map(str, arguments)]
        return subprocess.run(
            command, capture_output=True, text=True, env=os.environ | {"HOME": str(home), "XDG_CONFIG_HOME": str(home)}
        )

    assert run("analytics", "disable").returncode == 0
    return run


def node(path):
    if shutil.which("node") is None or not (NODE / "node_modules").is_dir():
        pytest.skip("@mcap/core is not installed: npm install --prefix tests/readers")
    return subprocess.run(["node", NODE / "count.mjs", path], capture_output=True, text=True)


def test_foxgloves_reader_finds_every_message_with_valid_crcs(log, counts):
    done = node(log.path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["read"] == found["summary"] == counts


def test_foxgloves_reader_would_have_told(flipped):
    done = node(flipped)
    assert done.returncode != 0 and "CRC" in done.stderr


def test_small_mcap_finds_every_message_with_valid_crcs(log, counts, flipped):
    reader = pytest.importorskip("small_mcap", reason="small-mcap is not installed: pip install '.[readers]'")
    with open(log.path, "rb") as file:
        found = collections.Counter(channel.topic for _, channel, _ in reader.read_message(file, validate_crc=True))
    assert dict(found) == counts
    with open(flipped, "rb") as file, pytest.raises(reader.CRCValidationError):
        for _ in reader.read_message(file, validate_crc=True):
            pass


def test_reruns_checker_accepts_the_log_and_would_have_told(log, flipped, rerun):
    done = rerun("mcap", "check", log.path)
    assert done.returncode == 0, done.stderr
    assert rerun("mcap", "check", flipped).returncode != 0


def test_reruns_recording_has_every_message_and_all_that_the_blueprint_shows(log, counts, rerun, tmp_path):
    out = tmp_path / "run.rrd"
    rerun_view.write(log.path, out)
    assert rerun("rrd", "verify", out).returncode == 0
    rows, columns = rows_of(rerun("rrd", "print", out).stdout)
    frames = sum(len(tree.transforms) for _, _, tree in log.messages(["/tf"]))
    assert {name: rows[name] for name in counts} == counts | {"/tf": frames}
    views = list(views_of(rerun_view.blueprint(log).root_container))
    assert len(views) >= 12
    for view in views:
        shown = [view.contents] if isinstance(view.contents, str) else view.contents
        for path in (p.replace("$origin", view.origin).rstrip("/*") for p in shown):
            assert any(name == path or name.startswith(f"{path}/") for name in rows), path
        for path, visualizers in view.visualizer_overrides.items():
            for visualizer in visualizers if isinstance(visualizers, list) else [visualizers]:
                assert visualizer.mappings[0].source_component in columns[path]
    assert "Mesh3D:vertex_positions" in columns["/scene/robot::chest/0"]


def test_a_log_that_was_cut_off_has_its_recording_too(log, rerun, tmp_path, capsys):
    whole = log.path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 4])
    assert rerun_view.main([str(tmp_path / "cut.mcap")]) == 3
    assert "breaks off" in capsys.readouterr().out
    rows, _ = rows_of(rerun("rrd", "print", tmp_path / "cut.rrd").stdout)
    assert rows["/joint_states"] == LogReader(tmp_path / "cut.mcap").topics["/joint_states"].count > 100


def test_what_is_no_log_is_one_line(rerun, tmp_path, capsys):
    (tmp_path / "text.mcap").write_text("not a log, but long enough to be taken for one\n")
    assert rerun_view.main([str(tmp_path / "text.mcap")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def rows_of(listing):
    """Rows and columns by entity of what `rerun rrd print` lists, channels' descriptions left out."""
    rows, columns = collections.Counter(), collections.defaultdict(set)
    for count, entity, names in re.findall(r"with (\d+) rows .*? - (/\S+) - data columns: \[(.*?)\]", listing):
        if "McapChannel:id" not in names:
            rows[entity.replace("\\", "")] += int(count)
            columns[entity.replace("\\", "")] |= set(names.split())
    return rows, columns


def views_of(part):
    if not hasattr(part, "origin"):
        for inner in part.contents:
            yield from views_of(inner)
    else:
        yield part
