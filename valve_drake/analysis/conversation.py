"""What was said in a run: the operator's words with the robot's answers, and the sound that they came from."""

import dataclasses as dc
from typing import Any

import numpy as np

from valve_drake.analysis.plots import Line, Plot
from valve_drake.analysis.traces import MOST, Traces
from valve_drake.messages import OperatorState
from valve_drake.recording.foxglove import AUDIO
from valve_drake.recording.reader import LogReader

STATE = "/operator_channel/state"
FULL = 2.0**15  # of 16 bits
STRIP = 0.02  # of sound, of which the least and the greatest sample are kept [s]
GIVEN, ASKED, REST, SOUND = "#157f4c", "#0b62a8", "#d1500c", "#8a8f98"


@dc.dataclass(frozen=True)
class Exchange:
    """One answer of the robot, and the words before it; "" if it spoke by itself."""

    time: float  # [s]
    words: str
    score: float
    outcome: str
    says: str


def exchanges(log: LogReader) -> list[Exchange]:
    """The whole conversation; empty where no operator was listened to."""
    topic = log.topics.get(STATE)
    if topic is None or topic.schema != "valve_drake.OperatorState" or topic.count > MOST:
        return []
    out: list[Exchange] = []
    before = OperatorState()
    for _, time, state in log.messages([STATE]):
        assert isinstance(state, OperatorState)
        new = (state.speaker, state.heard) != (before.speaker, before.heard) and bool(state.words)
        if new or state.answers != before.answers:
            words = (state.words, state.score, state.outcome) if new else ("", 0.0, "")
            out.append(Exchange(time, *words, state.says if state.answers != before.answers else ""))
        before = state
    return out


def waveform(log: Traces) -> Plot:
    """The sound, and the scores of what was made of it."""
    lines: list[Line] = []
    sound = _sound(log.reader)
    if sound is not None:
        lines.append(Line("sound", *sound, SOUND))
    said = [one for one in exchanges(log.reader) if one.words]
    for name, color, outcomes in (
        ("score: given", GIVEN, ("given",)),
        ("read back, answered", ASKED, ("asked", "answered", "listening")),
        ("refused or ignored", REST, ("refused", "ignored")),
    ):
        shown = [one for one in said if one.outcome in outcomes]
        if shown:
            times, scores = (np.array([getattr(one, key) for one in shown]) for key in ("time", "score"))
            lines.append(Line(name, times, scores, color, "dots"))
    return Plot("What the operator said", "full scale; score", lines, low=-1.0, high=1.0, key="voice")


def _sound(log: LogReader) -> tuple[np.ndarray, np.ndarray] | None:
    """The least and the greatest sample of every STRIP -> times, values; None if the log holds no sound."""
    topic = log.topics.get(AUDIO)
    if topic is None or topic.schema != "foxglove.RawAudio" or topic.count > MOST:
        return None
    times, values = [], []
    for _, time, recorded in log.messages([AUDIO]):
        message: Any = recorded
        rate, data = float(message.sample_rate), message.data
        if message.format != "pcm-s16" or message.number_of_channels != 1 or not rate > 0:
            continue
        samples = np.frombuffer(data, "<i2", len(data) // 2) / FULL
        size = max(round(STRIP * rate), 1)
        begin = time - len(samples) / rate  # the piece ended when it came
        for k in range(0, len(samples), size):
            strip = samples[k : k + size]
            at = begin + k / rate
            times += [at, at + STRIP / 2]
            values += [float(strip.min()), float(strip.max())]
    order = np.argsort(times, kind="stable")
    return (np.array(times)[order], np.array(values)[order]) if times else None
