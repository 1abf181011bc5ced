"""What was said in a run, on its page: words, answers, the sound's waveform."""

import numpy as np
import pytest
from review_samples import write_run

from valve_drake.analysis.conversation import exchanges, waveform
from valve_drake.analysis.report import page, review
from valve_drake.analysis.traces import Traces
from valve_drake.messages import OperatorState
from valve_drake.recording import foxglove
from valve_drake.recording.reader import LogReader
from valve_drake.recording.schemas import serialized
from valve_drake.recording.writer import LogWriter

STORY = (
    OperatorState(speaker=7, answers=1, says="at your service"),
    OperatorState(speaker=7, answers=2, heard=1, words="robot <open>", score=0.93, outcome="asked", says="say confirm"),
    OperatorState(speaker=7, answers=2, heard=2, words="the weather", score=0.6, outcome="ignored", says="say confirm"),
    OperatorState(speaker=7, answers=3, heard=3, words="confirm", score=0.8, outcome="given", says="open"),
    OperatorState(speaker=7, answers=3, heard=3, words="confirm", score=0.8, outcome="given", says="open", mode="turn"),
    OperatorState(speaker=7, answers=4, heard=3, words="confirm", score=0.8, outcome="given", says="turned"),
)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("said")
    whole = LogReader(write_run(folder / "run.mcap"))
    extra = [(1.0 + k, "/operator_channel/state", state) for k, state in enumerate(STORY)]
    tone = np.round(16384 * np.sin(np.arange(1280) / 7)).astype(np.int16)
    extra += [(2.0 + 0.08 * k, foxglove.AUDIO, foxglove.audio(2.0, 16000, tone)) for k in range(5)]
    records = [(r.time, r.topic, whole.decode(r)) for r in whole.records(list(whole.topics))]
    with LogWriter(folder / "said.mcap") as writer:
        writer.write_metadata("run", whole.metadata["run"])
        for time, topic, message in sorted(records + extra, key=lambda row: row[0]):
            writer.write(topic, serialized(message), time)
        writer.write_metadata("result", whole.metadata["result"])
    return folder / "said.mcap"


def test_the_conversation_has_every_sentence_and_every_answer_once(path):
    said = exchanges(LogReader(path))
    assert [(one.time, one.words, one.outcome, one.says) for one in said] == [
        (1.0, "", "", "at your service"),
        (2.0, "robot <open>", "asked", "say confirm"),
        (3.0, "the weather", "ignored", ""),
        (4.0, "confirm", "given", "open"),
        (6.0, "", "", "turned"),
    ]


def test_the_waveform_lies_where_the_sound_was_and_reaches_as_far_as_it(path):
    plot = waveform(Traces(LogReader(path)))
    sound, given, asked, rest = plot.lines
    assert sound.time[0] == pytest.approx(2.0 - 0.08) and sound.time[-1] < 2.32
    assert sound.value.max() == pytest.approx(0.5, abs=1e-3) and sound.value.min() == pytest.approx(-0.5, abs=1e-3)
    assert (given.time.tolist(), given.value.tolist()) == ([4.0], [0.8])
    assert (asked.value.tolist(), rest.value.tolist()) == ([0.93], [0.6])


def test_the_page_shows_both_and_escapes_what_was_heard(path, tmp_path):
    html = page(review(path), tmp_path)
    assert "What was said" in html and "What the operator said" in html
    assert "robot &lt;open&gt;" in html and "robot <open>" not in html


def test_a_run_without_operators_has_neither(tmp_path):
    path = write_run(tmp_path / "run.mcap", end=1.0)
    assert exchanges(LogReader(path)) == [] and waveform(Traces(LogReader(path))).lines == []
    assert "What was said" not in page(review(path), tmp_path)


def test_sound_that_cannot_be_is_left_out(tmp_path):
    bad = [foxglove.audio(0.0, 16000, np.zeros(10, np.int16)) for _ in range(4)]
    bad[0].sample_rate = 0
    bad[1].format = "mp3"
    bad[2].number_of_channels = 2
    bad[3].data = b"\x00" * 7
    with LogWriter(tmp_path / "bad.mcap") as writer:
        for k, message in enumerate(bad):
            writer.write(foxglove.AUDIO, message, float(k))
    lines = waveform(Traces(LogReader(tmp_path / "bad.mcap"))).lines
    assert len(lines) == 1 and np.all(lines[0].value == 0.0)
