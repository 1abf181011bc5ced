"""Checks whether a log is complete: damage, missing messages, and gaps against each topic's expected rate."""

import dataclasses as dc
import math

import numpy as np

from valve_drake.messages import CAMERAS, SIDES
from valve_drake.ports import TICK
from valve_drake.recording.foxglove import NANO
from valve_drake.recording.reader import LogReader
from valve_drake.recording.signals import SLOW, TRUTH, topic_of

# Topics that the recorder writes at every period. A test compares these tables with signals.py.
PERIODS: dict[str, float] = {
    **{topic: TICK for topic in ("/joint_states", "/joint_commands", *(f"/{side}_wrist/wrench" for side in SIDES))},
    **{topic_of(port): SLOW for port in TRUTH},
    **{f"/{camera}/calibration": 1.0 for camera in CAMERAS},
}
# Outputs that a block writes at every step: the expected rate is the median rate of the log itself.
STEADY = frozenset(
    ("/valve_search/command", "/valve_search/status")
    + ("/command_selector/report", "/supervisor/mode", "/robot_state/robot_state", "/health", "/tf")
)
# Topics that follow the cameras: images are taken only when the mode asks for them, so no rate is expected.
GATED = frozenset(
    ("/color_segmentation/segmentation", "/line_fitting/edges", "/stereo_positioning/position", "/handle_marker/marks")
    + ("/rectangle_estimator/estimate", "/rectangle_estimator/pose")
    + tuple(f"/{camera}/{what}" for camera in CAMERAS for what in ("image", "detections"))
)
RESULT = "result"  # metadata that a run writes when it ends
MOST, MOST_OF_A_TOPIC = 10_000_000, 4_000_000  # messages whose times are held in memory, some 90 bytes each
LATE = 1.5  # a message that comes later than this many periods after the last one counts as a gap


@dc.dataclass(frozen=True)
class Gap:
    """Between two messages of a topic, or between one and the log's start or end."""

    start: float  # [s]
    end: float
    missing: int  # messages that should be between them


@dc.dataclass(frozen=True)
class TopicRow:
    """One topic of a log. kind: steady, gated (follows the cameras), changes (written when it
    changes) or many (more messages than can be examined)."""

    topic: str
    schema: str
    count: int
    kind: str
    period_s: float | None  # expected; None where there is no rate, or too few messages to see it
    median_s: float | None  # observed
    lost: int  # holes in the numbering: written once, not in this file; 0 for logs of other programs
    gaps: tuple[Gap, ...]  # in time, where there is a rate; else where the numbering has holes
    silence: Gap | None  # the longest time between two messages

    @property
    def whole(self) -> bool:
        return not self.gaps and not self.lost


@dc.dataclass
class Integrity:
    """Of one log. damage: what could not be read, in lines for people."""

    damage: list[str]
    finished: bool  # the program wrote its result
    topics: list[TopicRow]
    messages: int = 0
    bytes: int = 0

    @property
    def lost(self) -> int:
        """Messages that were written and are not in this file, by the holes in their numbering."""
        return sum(row.lost for row in self.topics)

    @property
    def troubles(self) -> list[str]:
        """All that is wrong with the file, in lines for people."""
        if self.lost and not any("messages are missing" in line for line in self.damage):
            return [*self.damage, f"{self.lost} messages are missing between others"]
        return self.damage

    @property
    def late(self) -> list[TopicRow]:
        """Topics that miss messages."""
        return [row for row in self.topics if row.gaps]

    @property
    def sound(self) -> bool:
        """Nothing that was written is missing."""
        return not self.damage and not self.lost

    def gaps(self) -> list[tuple[float, float]]:
        """Spans of time in which the regular topics miss messages, merged."""
        regular = [row for row in self.topics if row.period_s is not None and row.period_s <= SLOW]
        out: list[tuple[float, float]] = []
        for start, end in sorted((gap.start, gap.end) for row in regular for gap in row.gaps):
            if out and start <= out[-1][1]:
                out[-1] = (out[-1][0], max(out[-1][1], end))
            else:
                out.append((start, end))
        return out


def examine(log: LogReader) -> Integrity:
    """Looks at every message's time and number; nothing is decoded."""
    damage = list(log.damage)
    if log.past_damage:
        damage.append(f"recovered from a damaged log: {log.past_damage}")
    rows, some, total = [], [], 0
    for name, topic in sorted(log.topics.items()):
        if topic.count <= MOST_OF_A_TOPIC and total + topic.count <= MOST:
            total += topic.count
            some.append(name)
        else:
            rows.append(TopicRow(name, topic.schema, topic.count, "many", None, None, 0, (), None))
    for name, (when, number) in log.timing(some).items():
        schema, time = log.topics[name].schema, when / NANO
        if log.own and len(log.channels(name)) == 1:
            rows.append(_row(name, schema, time, number.astype(np.int64), log.start, log.end))
        else:  # the numbering and rates of other programs are not known
            rows.append(_foreign_row(name, schema, np.sort(time)))
    rows.sort(key=lambda row: row.topic)
    count = sum(row.count for row in rows)
    return Integrity(damage, RESULT in log.metadata, rows, count, log.path.stat().st_size)


def _foreign_row(topic: str, schema: str, time: np.ndarray) -> TopicRow:
    median, silence = _rhythm(time)
    return TopicRow(topic, schema, len(time), "changes", None, median, 0, (), silence)


def _row(topic: str, schema: str, time: np.ndarray, number: np.ndarray, start: float, end: float) -> TopicRow:
    median, silence = _rhythm(time)
    period = median if topic in STEADY else PERIODS.get(topic)
    period = period if period is not None and period > 0 else None  # one message has no rate
    kind = "gated" if topic in GATED else "steady" if topic in STEADY or topic in PERIODS else "changes"
    holes = np.diff(np.concatenate([[-1], number])) - 1
    lost = int(np.maximum(holes, 0).sum())
    edges = np.concatenate([[start], time, [end]]) if len(time) else np.array([start, end])
    if period is not None:
        wide = np.flatnonzero(np.diff(edges) > LATE * period)
        gaps = [Gap(float(edges[k]), float(edges[k + 1]), _between(edges, int(k), period)) for k in wide]
    else:
        gaps = [Gap(float(edges[k]), float(edges[k + 1]), int(holes[k])) for k in np.flatnonzero(holes > 0)]
    return TopicRow(topic, schema, len(time), kind, period, median, lost, tuple(gaps), silence)


def _rhythm(time: np.ndarray) -> tuple[float | None, Gap | None]:
    """The median and the longest time between two messages; None for fewer than two."""
    steps = np.diff(time)
    if len(steps) == 0:
        return None, None
    k = int(steps.argmax())
    return float(np.median(steps)), Gap(float(time[k]), float(time[k + 1]), 0)


def _between(edges: np.ndarray, k: int, period: float) -> int:
    """Messages that should be inside gap k; the first and the last interval have a message at one end only."""
    periods = (edges[k + 1] - edges[k]) / period
    return math.floor(periods + 1e-6) if k in (0, len(edges) - 2) else round(periods) - 1


def words(row: TopicRow, most: int = 3) -> str:
    """A topic's gaps for people."""
    parts = [f"{gap.missing} in {gap.start:.3f}\u2013{gap.end:.3f} s" for gap in row.gaps[:most]]
    if len(row.gaps) > most:
        parts.append(f"{len(row.gaps) - most} more")
    return ", ".join(parts)
