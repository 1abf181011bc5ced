"""Compares two logs: modes, numbers, settings, and the first message that differs."""

import dataclasses as dc
import difflib
from collections.abc import Sequence
from typing import Any

import numpy as np

from valve_drake.analysis.comparison import Divergence, differences
from valve_drake.analysis.metrics import Summary
from valve_drake.analysis.traces import ModeSpan
from valve_drake.checks import ConfigError
from valve_drake.recording.container import RECOVERED
from valve_drake.recording.foxglove import NANO
from valve_drake.recording.reader import LogReader, Record

Pairs = list[tuple[ModeSpan | None, ModeSpan | None]]


@dc.dataclass(frozen=True)
class TopicPair:
    """One topic in both logs: counts, equal messages up to the first that differs, and that one."""

    topic: str
    count_a: int
    count_b: int
    equal: int
    first: Divergence | None  # its `recorded` is of the first log, `replayed` of the second


def pair_modes(a: Sequence[ModeSpan], b: Sequence[ModeSpan]) -> Pairs:
    """Pairs the stays of both runs in the same mode, in order; None where one run has no counterpart."""
    out: Pairs = []
    matcher = difflib.SequenceMatcher(None, [s.mode for s in a], [s.mode for s in b], autojunk=False)
    for what, i, j, k, m in matcher.get_opcodes():
        if what == "equal":
            out += list(zip(a[i:j], b[k:m]))
        else:
            out += [(span, None) for span in a[i:j]] + [(None, span) for span in b[k:m]]
    return out


def onto(pairs: Pairs, time: np.ndarray) -> np.ndarray:
    """Maps times of the second run to the first one's axis: each mode is stretched to the length of its partner."""
    knots = [(b.start, a.start) for a, b in pairs if a and b] + [(b.end, a.end) for a, b in pairs if a and b]
    if not knots:
        return time
    there, here = np.array(sorted(set(knots))).T
    return np.interp(time, there, np.maximum.accumulate(here))


def numbers(value: Any, path: str = "") -> dict[str, float]:
    """All numbers in a Summary or the like, by dotted name; lists are left out."""
    if dc.is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in dc.fields(value)}
    if isinstance(value, dict):
        parts = (numbers(v, f"{path}.{key}" if path else str(key)) for key, v in value.items())
        return {name: number for part in parts for name, number in part.items()}
    if isinstance(value, int | float) and not isinstance(value, bool):
        return {path: float(value)}
    return {}


def number_rows(a: Summary, b: Summary) -> list[tuple[str, float | None, float | None, float | None]]:
    """(name, of a, of b, b minus a) of every number, mode durations included."""
    left, right = ({**numbers(s), **numbers(s.mode_durations(), "mode_durations_s")} for s in (a, b))
    out = []
    for name in dict.fromkeys((*left, *right)):
        x, y = left.get(name), right.get(name)
        out.append((name, x, y, y - x if x is not None and y is not None else None))
    return out


def settings(a: dict[str, Any], b: dict[str, Any], path: str = "") -> list[tuple[str, Any, Any]]:
    """Keys of two scenarios whose values differ; None where one has none."""
    out: list[tuple[str, Any, Any]] = []
    for key in dict.fromkeys((*a, *b)):
        name, x, y = f"{path}.{key}" if path else str(key), a.get(key), b.get(key)
        if isinstance(x, dict) and isinstance(y, dict):
            out += settings(x, y, name)
        elif x != y:
            out.append((name, x, y))
    return out


def compare_messages(a: LogReader, b: LogReader) -> list[TopicPair]:
    """All topics of both logs, in the order of the first log: message by message, the time included, to the bit.

    Messages are paired by their sequence numbers, in logs of other programs by their order; what a damaged or
    unfinished log lacks is left out.
    """
    logs = (a, b)
    numbered = a.own and b.own
    keys = [_keys(log, numbered) for log in logs]
    partial = [bool(log.damage) or RECOVERED in log.metadata for log in logs]
    out = []
    for topic in dict.fromkeys((*a.topics, *b.topics)):
        left, right = (found.get(topic, {}) for found in keys)
        equal, first = 0, None
        for number in sorted(left.keys() | right.keys()):
            x, y = left.get(number), right.get(number)
            if x == y:
                equal += 1
            elif not (x is None and partial[0]) and not (y is None and partial[1]):
                first = _divergence(topic, _record(a, topic, x), _record(b, topic, y), a, b)
                break
        out.append(TopicPair(topic, len(left), len(right), equal, first))
    return out


def first_divergence(topics: Sequence[TopicPair]) -> Divergence | None:
    """The earliest one; of those at one time, that of the topic recorded first, which is how the data flows."""
    return min((pair.first for pair in topics if pair.first), key=lambda found: found.time, default=None)


def _keys(log: LogReader, numbered: bool) -> dict[str, dict[int, tuple[int, int]]]:
    """Topic -> number of the message -> its time and the hash of its content."""
    out: dict[str, dict[int, tuple[int, int]]] = {}
    for record in log.records():
        rows = out.setdefault(record.topic, {})
        rows[record.sequence if numbered else len(rows)] = (record.when, hash(record.data))
    return out


def _record(log: LogReader, topic: str, at: tuple[int, int] | None) -> Record | None:
    """The topic's message of this time and content, None if there is none."""
    if at is None:
        return None
    time = at[0] / NANO
    return next(r for r in log.records([topic], time - 1e-6, time + 1e-6) if (r.when, hash(r.data)) == at)


def _divergence(topic: str, x: Record | None, y: Record | None, a: LogReader, b: LogReader) -> Divergence:
    if x is None or y is None:
        one = x or y
        assert one is not None
        return Divergence(one.time, topic, "", x and "", y and "")
    if x.when != y.when:
        return Divergence(min(x.time, y.time), topic, "(time)", x.time, y.time)
    try:
        found = differences(a.decode(x), b.decode(y))
    except ConfigError:
        found = []
    field, before, after = found[0] if found else ("(encoding)", "", "")
    return Divergence(x.time, topic, field, before, after)
