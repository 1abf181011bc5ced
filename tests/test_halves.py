"""halves: a replay in two processes says identical exactly where one with all blocks together does."""

import os
import subprocess
import sys

import pytest

from valve_drake import diagram, halves, runner, scenario
from valve_drake.analysis.comparison import TopicDifference
from valve_drake.recording.signals import JOINED, OUTPUTS, topic_of

REPLAY = """
import sys
from pathlib import Path
from valve_drake import halves, runner
from valve_drake.recording.reader import LogReader
if sys.argv[2] == "alone":
    halves.can_fork = lambda: False
elif sys.argv[2] in halves.BESIDE | {"base_approach"}:  # a block that makes something else than when it was recorded
    from valve_drake import ports
    update = ports.Block.update
    def other(self, time, *rest):
        done = update(self, time, *rest)
        if self.get_name() == sys.argv[2] and time > 1.5 and done:
            import dataclasses
            done = done[0], {port: dataclasses.replace(value, time=value.time + 1) for port, value in done[1].items()}
        return done
    ports.Block.update = other
halved = runner._in_halves
runner._in_halves = lambda *arguments: print(bool(found := halved(*arguments)), end=" ") or found
found = runner.replay(LogReader(Path(sys.argv[1]))).comparison
print(found.identical, *[f"{name}:{topic.equal}" for name, topic in found.topics.items()])
"""


def replay(log, way):
    """-> whether the halves found it identical, whether it is, and the topics with what was equal."""
    command = [sys.executable, "-c", REPLAY, str(log), way]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert result.stderr == ""
    halved, identical, *topics = result.stdout.split()
    return halved == "True", identical == "True", topics


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Two seconds of a run that drives at once."""
    path = tmp_path_factory.mktemp("run") / "short.mcap"
    runner.run(scenario.load(None, ["simulation.start.distance=2.6", "simulation.start.heading=0.1"]), path, duration=2)
    return path


@pytest.fixture(scope="module")
def together(log):
    return replay(log, "alone")


@pytest.mark.system
def test_the_halves_find_what_all_blocks_together_find(log, together):
    halved, identical, topics = replay(log, "halves")
    assert halved and identical
    assert together == (False, True, topics) and len(topics) > 30


@pytest.mark.system
@pytest.mark.parametrize("block", ["line_fitting", "base_approach"])
def test_a_difference_in_either_half_is_found_and_told_by_all_blocks_together(log, together, block):
    halved, identical, topics = replay(log, block)
    assert not halved and not identical
    assert topics != together[2] and [t.split(":")[0] for t in topics] == [t.split(":")[0] for t in together[2]]


def test_what_the_halves_exchange_is_recorded_by_every_tick():
    recorded = {f"{block}.{port}" for block, port, _ in OUTPUTS}
    for source, target in diagram.WIRES:
        blocks = [end.partition(".")[0] for end in (source, target)]
        if halves.BOTH not in blocks and "station" not in blocks and len({b in halves.BESIDE for b in blocks}) == 2:
            assert source in recorded, f"{source} -> {target}"


def test_each_topic_is_made_by_one_half():
    sc = scenario.resolve(scenario.load(None, []))
    table = runner._table(sc)
    beside = halves.topics_beside(table)
    assert {topic_of(f"{block}.{port}") in beside for block, port, _ in OUTPUTS if block in halves.BESIDE} == {True}
    assert not {topic_of(f"{block}.{port}") for block, port, _ in OUTPUTS if block not in halves.BESIDE} & beside
    assert {"/log", "/tf", "/joint_commands"}.isdisjoint(beside) and {"/joint_states", "/health"} <= beside
    assert set(halves.JOINED_FROM) == set(JOINED)


@pytest.mark.system
def test_work_that_fails_or_is_lost_is_a_difference():
    code = """
import os, signal, sys
from valve_drake import halves
from valve_drake.analysis.comparison import TopicDifference
works = {
    "done": lambda: {"/a": TopicDifference(1, 1, 1)},
    "failed": lambda: 1 / 0,
    "lost": lambda: os.kill(os.getpid(), signal.SIGKILL),
}
for name, work in works.items():
    try:
        with halves.beside(work) as found:
            print(name, found(True)["/a"].equal, found(False)["/a"].equal)
    except halves.Different:
        print(name, "different")
"""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    result = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)
    assert result.stdout.split() == ["done", "1", "1", "failed", "different", "lost", "different"], result.stderr
    assert TopicDifference(1, 1, 1).identical
