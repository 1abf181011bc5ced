"""Makes one self-contained HTML page of a log (or of two): it loads nothing from the network.

`review` reads a log, `page` and `comparison_page` make HTML of the result, `facts` makes the object of --json.
"""

import dataclasses as dc
import functools
import math
import os
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from valve_drake import outputs, yaml_file
from valve_drake.analysis import two_logs
from valve_drake.analysis.comparison import Divergence
from valve_drake.analysis.conversation import exchanges
from valve_drake.analysis.curves import make_plots, overlaid
from valve_drake.analysis.integrity import Integrity, examine, words
from valve_drake.analysis.metrics import Summary, summarize
from valve_drake.analysis.pictures import Album, Moment
from valve_drake.analysis.plots import LEFT, RIGHT, WIDTH, Plot, mode_class, nice_ticks
from valve_drake.analysis.traces import MOST, ModeSpan, Traces
from valve_drake.checks import ConfigError
from valve_drake.messages import Mode
from valve_drake.pace import PACE, Pace
from valve_drake.recording.container import LIBRARY
from valve_drake.recording.reader import LogReader

MADE = "Made by <code>valve-drake review</code>"  # in every page, see the templates
AT_REST = (Mode.MEASURE, Mode.VERIFY)
MOMENTS = 200  # changes of mode that are shown with pictures; raise it for runs with more
ROW = 22  # height of a row of the timeline [px]
LONGEST = 48  # values are cut to this where two logs differ [characters]


@dc.dataclass
class Review:
    """What the page and the JSON of one log are made from."""

    log: LogReader
    traces: Traces
    integrity: Integrity
    summary: Summary
    run: dict[str, str]  # metadata `run` without the scenario
    scenario_text: str
    scenario: dict[str, Any]
    recording: Path | None  # the 3D recording beside the log
    pace: Pace | None  # how real time was kept, of a paced run

    @property
    def name(self) -> str:
        return self.log.path.name


def review(path: str | os.PathLike[str]) -> Review:
    """Reads a log, also a damaged one. Raises ConfigError if the file is no log."""
    log = LogReader(path)
    traces = Traces(log)
    run = dict(log.metadata.get("run", {}))
    text = run.pop("scenario", "")
    recording = log.path.with_suffix(".html")
    return Review(
        log,
        traces,
        examine(log),
        summarize(traces),
        run,
        text,
        _parsed(text),
        recording if recording.is_file() else None,
        traces.attempt(PACE, lambda: _pace(log), None),
    )


def _pace(log: LogReader) -> Pace | None:
    """The last /pace message: its numbers count from the start of the run. None if there is none."""
    found = log.topics.get(PACE)
    if found is None or not found.count or found.schema != "valve_drake.Pace":
        return None
    *_, (_, _, last) = log.messages([PACE], found.end)
    return last if isinstance(last, Pace) and all(math.isfinite(v) for v in vars(last).values()) else None


def facts(review: Review) -> dict[str, Any]:
    """The object of `review --json`."""
    values = dc.asdict(review.summary)
    spans = values.pop("spans")
    values.pop("outcome")
    topics = [
        {"topic": r.topic, "schema": r.schema, "messages": r.count, "kind": r.kind, "period_s": r.period_s}
        | {"median_period_s": r.median_s, "lost": r.lost, "gaps": [dc.asdict(gap) for gap in r.gaps]}
        for r in review.integrity.topics
    ]
    out = {
        "log": str(review.log.path),
        "outcome": review.summary.outcome or "unfinished",
        "library": review.log.library,
        "own": review.log.own,
        "sound": review.integrity.sound,
        "finished": review.integrity.finished,
        "damage": review.integrity.troubles,
        "messages": review.integrity.messages,
        "lost": review.integrity.lost,
        "missing_topics": review.traces.missing,
        **values,
        "modes": spans,
        "mode_durations_s": review.summary.mode_durations(),
        "topics": topics,
        "recording": str(review.recording) if review.recording else None,
        "pace": review.pace and review.pace.as_json(),
        "run": review.run,
        "scenario": review.scenario,
    }
    return plain(out)


@dc.dataclass
class SideBySide:
    """Everything that is known of two logs side by side."""

    a: Review
    b: Review
    modes: two_logs.Pairs
    numbers: list[tuple[str, float | None, float | None, float | None]]  # name, of a, of b, difference
    settings: list[tuple[str, Any, Any]]  # key, of a, of b
    versions: list[tuple[str, Any, Any]]
    topics: list[two_logs.TopicPair]

    @property
    def first(self) -> Divergence | None:
        """Where the two part; None if all that both hold is equal."""
        return two_logs.first_divergence(self.topics)

    @property
    def sound(self) -> bool:
        """Whether both logs are whole."""
        return self.a.integrity.sound and self.b.integrity.sound


def compare(a: Review, b: Review) -> SideBySide:
    """Two logs side by side."""
    return SideBySide(
        a,
        b,
        two_logs.pair_modes(a.traces.spans, b.traces.spans),
        two_logs.number_rows(a.summary, b.summary),
        two_logs.settings(a.scenario, b.scenario),
        [row for row in two_logs.settings(a.run, b.run) if row[0] not in (*a.scenario, *b.scenario)],
        two_logs.compare_messages(a.log, b.log),
    )


def comparison_facts(comparison: SideBySide) -> dict[str, Any]:
    """The object of `review A B --json`."""
    pairs = [
        {"mode": one.mode, "a_s": x.duration if x else None, "b_s": y.duration if y else None}
        for x, y in comparison.modes
        if (one := x or y)
    ]
    out = {
        "a": str(comparison.a.log.path),
        "b": str(comparison.b.log.path),
        "identical": comparison.first is None and comparison.sound,
        "sound": comparison.sound,
        "damage": {"a": comparison.a.integrity.troubles, "b": comparison.b.integrity.troubles},
        "outcomes": {
            "a": comparison.a.summary.outcome or "unfinished",
            "b": comparison.b.summary.outcome or "unfinished",
        },
        "verdicts": {"a": comparison.a.summary.verdict, "b": comparison.b.summary.verdict},
        "first_divergence": _parting(comparison.first),
        "modes": pairs,
        "numbers": {name: {"a": x, "b": y, "difference": d} for name, x, y, d in comparison.numbers},
        "settings": {key: {"a": x, "b": y} for key, x, y in comparison.settings + comparison.versions},
        "topics": {
            pair.topic: {"a": pair.count_a, "b": pair.count_b, "equal": pair.equal, "first": _parting(pair.first)}
            for pair in comparison.topics
        },
    }
    return plain(out)


def _parting(found: Divergence | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {"time_s": found.time, "topic": found.topic, "field": found.field} | dict(zip("ab", parting_values(found)))


def parting_values(found: Divergence) -> tuple[str | float | None, str | float | None]:
    """Both values at the first difference: numbers unchanged, others as short text, None where a log has no message."""

    def brief(value: Any) -> str | float | None:
        if value is None or isinstance(value, int | float):
            return value
        text = value if isinstance(value, str) else " ".join(repr(value).split())
        return text if len(text) <= LONGEST else text[: LONGEST - 1] + "\u2026"

    return brief(found.recorded), brief(found.replayed)


def plain(value: Any) -> Any:
    """A value as JSON has it: no NaN, no numpy."""
    if isinstance(value, dict):
        return {str(key): plain(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def was_made(path: Path) -> bool:
    """Whether a file is a page that `review` made."""
    return outputs.holds(path, MADE)


# ---------------------------------------------------------------- the page


def page(review: Review, link_base: Path) -> str:
    """The page of one log; links are relative to the folder `link_base`."""
    start, end = _extent(review.log)
    spans = review.traces.spans
    plots = [plot for plot in make_plots(review.traces) if plot.lines]
    album = Album(review.log)
    worst = review.traces.attempt("worst estimate", lambda: _worst(review, album), None)
    return (
        _environment()
        .get_template("review.html.j2")
        .render(
            title=f"{review.name}: {review.summary.verdict or review.summary.outcome or 'unfinished'}",
            r=review,
            s=review.summary,
            integrity=review.integrity,
            tiles=tiles(review.summary, review.pace),
            timeline=timeline(spans, start, end, review.integrity.gaps()),
            writer=writer(review.log),
            plots=_drawn(review.traces, plots, spans, start, end),
            missing=review.traces.missing,
            spans=spans,
            span=(start, end),
            moments=review.traces.attempt("pictures", lambda: album.changes_of_mode(spans[:MOMENTS]), []),
            worst=worst,
            said=review.traces.attempt("the conversation", lambda: exchanges(review.log), []),
            log_lines=review.traces.attempt("/log", lambda: _log_lines(review.log), []),
            recording=_link(review.recording, link_base),
            geometry={"width": WIDTH, "left": LEFT, "right": RIGHT},
        )
    )


# ---------------------------------------------------------------- the page of two


def comparison_page(comparison: SideBySide, link_base: Path) -> str:
    """The page of two logs; links are relative to the folder `link_base`."""
    a, b = comparison.a, comparison.b
    spans = a.traces.spans
    start, end = _extent(a.log)
    plots = overlaid(make_plots(a.traces), make_plots(b.traces), comparison.modes)
    headline = {"modes", "estimates", "tracking", "mode_durations_s", "selector_limited", "selector_refused"}
    main = [row for row in comparison.numbers if row[0].split(".")[0] not in headline]
    return (
        _environment()
        .get_template("compare.html.j2")
        .render(
            title=f"{a.name} and {b.name}",
            c=comparison,
            a=a,
            b=b,
            first=comparison.first,
            values=parting_values(comparison.first) if comparison.first else None,
            parting_values=parting_values,
            main=main,
            others=[row for row in comparison.numbers if row not in main],
            timelines=[timeline(r.traces.spans, *_extent(r.log), r.integrity.gaps()) for r in (a, b)],
            plots=_drawn(a.traces, plots, spans, start, end),
            spans=spans,
            span=(start, end),
            recordings=[_link(r.recording, link_base) for r in (a, b)],
            geometry={"width": WIDTH, "left": LEFT, "right": RIGHT},
        )
    )


def writer(log: LogReader) -> str:
    """A sentence on who wrote a log of another program; "" for one of this program."""
    if log.own:
        return ""
    name = log.library or "a program that does not give its name"
    return f"written by {name}, not by {LIBRARY}: topics and counts are shown, and what is in this program's schemas"


def _drawn(
    traces: Traces, plots: Sequence[Plot], spans: Sequence[ModeSpan], start: float, end: float
) -> list[tuple[Plot, Markup]]:
    """(plot, its SVG) of those that can be drawn."""
    drawn = [
        (plot, traces.attempt(f"plot {plot.key}", functools.partial(plot.svg, spans, start, end), None))
        for plot in plots
    ]
    return [(plot, svg) for plot, svg in drawn if svg is not None]


def _link(path: Path | None, link_base: Path) -> str | None:
    """A relative link to a file, percent-encoded, since a name may contain characters with a meaning in URLs."""
    return urllib.parse.quote(os.fsencode(os.path.relpath(path, link_base))) if path else None


def _extent(log: LogReader) -> tuple[float, float]:
    return log.start, max(log.end, log.start + 1e-3)


# ---------------------------------------------------------------- parts of the page


def timeline(spans: Sequence[ModeSpan], start: float, end: float, gaps: Sequence[tuple[float, float]]) -> Markup:
    """The modes as bars, a row for each, in the order of first entry; a last row for what is missing."""
    if not spans:
        return Markup("")
    modes = list(dict.fromkeys(span.mode for span in spans))
    left, right = 130, 10
    height = ROW * (len(modes) + bool(gaps)) + 24

    def x(time: float) -> float:
        return left + (time - start) / (end - start) * (WIDTH - left - right)

    out = [
        Markup('<svg class="gantt" viewBox="0 0 {} {}" role="img" aria-label="Modes over time">').format(WIDTH, height)
    ]

    def add(template: str, *values: object) -> None:
        out.append(Markup(template).format(*values))  # escapes every value: modes and reasons are the log's text

    bottom = ROW * (len(modes) + bool(gaps))
    for tick in nice_ticks(start, end, 10):
        add('<line x1="{0:.1f}" x2="{0:.1f}" y1="0" y2="{1}"/>', x(tick), bottom)
        add('<text class="tick" x="{:.1f}" y="{}">{:g}</text>', x(tick), bottom + 15, tick)
    for row, mode in enumerate(modes):
        middle = ROW * row + ROW / 2
        add('<text class="name" x="{}" y="{}">{}</text>', left - 8, middle + 4, _label(mode))
        for span in (s for s in spans if s.mode == mode):
            width = max(x(span.end) - x(span.start), 2.0)
            words_ = f"{span.duration:.2f} s" + (f", retry {span.attempt}" if span.attempt else "")
            hover = f"{_label(mode)}: {span.start:.3f} to {span.end:.3f} s. {span.reason}"
            add('<g class="bar" data-start="{:.4f}" data-end="{:.4f}"><title>{}</title>', span.start, span.end, hover)
            add('<rect class="{} {}" x="{:.1f}" ', mode_class(mode), "retry" if span.attempt else "", x(span.start))
            add('y="{}" width="{:.1f}" height="16" rx="2"/>', middle - 8, width)
            # Behind the bar, before it where there is no room.
            room = x(span.start) + width + 7 * len(words_) + 12 < WIDTH
            place, kind = (x(span.start) + width + 6, "time") if room else (x(span.start) - 6, "time before")
            add('<text class="{}" x="{:.1f}" y="{}">{}</text></g>', kind, place, middle + 4, words_)
    if gaps:
        middle = ROW * len(modes) + ROW / 2
        add('<text class="name bad" x="{}" y="{}">missing</text>', left - 8, middle + 4)
        for a, b in gaps:
            wide = max(x(b) - x(a), 2)
            add('<rect class="gap" x="{:.1f}" y="{}" width="{:.1f}" height="16"/>', x(a), middle - 8, wide)
    out.append(Markup("</svg>"))
    return Markup("").join(out)


def tiles(s: Summary, pace: Pace | None = None) -> list[tuple[str, str, str]]:
    """(label, value, remark) of the numbers to see first."""
    out: list[tuple[str, str, str]] = []

    def add(label: str, value: Any, show: Callable[[Any], str], remark: str = "") -> None:
        if value is not None:
            out.append((label, show(value), remark))

    def degrees(value: float) -> str:
        return f"{round(math.degrees(value), 2) + 0.0:.2f}\u00b0"  # no negative zero

    add("commanded", s.command_rad, degrees)
    add("seen by the cameras", s.angle_camera_rad, degrees, _off(s.angle_camera_rad, s.angle_true_rad))
    add("felt by the hands", s.angle_hands_rad, degrees, _off(s.angle_hands_rad, s.angle_true_rad))
    add("true", s.angle_true_rad, degrees, _off(s.angle_true_rad, s.command_rad, "command"))
    add("simulated time" if s.angle_true_rad is not None else "time", s.sim_time_s, lambda v: f"{v:.1f} s")
    add("retries", s.retries, str)
    if s.turn_peak_torque_Nm is not None:
        force, stem = s.turn_mean_hand_force_N, s.turn_peak_stem_force_N
        add("peak force of a hand", s.turn_peak_hand_force_N, lambda v: f"{v:.1f} N", f"mean {force:.1f} N")
        add("couple", s.turn_mean_torque_Nm, lambda v: f"{v:.1f} N m", f"peak {s.turn_peak_torque_Nm:.1f} N m")
        add(
            "load on the stem",
            s.turn_mean_stem_force_N,
            lambda v: f"{v:.2f} N",
            f"beyond the couple; peak {stem:.1f} N",
        )
        add("left hand\u2019s share", s.turn_share_left, lambda v: f"{100 * v:.1f} %", "of the couple")
    if s.contact_honesty is not None and s.slips is not None:
        least = min(s.contact_honesty.values())
        shares = ", ".join(f"{side} {100 * share:.1f} %" for side, share in s.contact_honesty.items())
        add("held by both pads", least, lambda v: f"{100 * v:.1f} %", f"of the valve\u2019s way, worse hand; {shares}")
    if s.collisions is not None:
        internal = s.peak_internal_force_N or 0.0
        add("collisions", s.collisions, str, f"internal force at most {internal:.1f} N")
    rest = s.estimates.get(Mode.MEASURE)
    if rest is not None and rest.position_rms_m is not None and rest.angle_rms_rad is not None:
        add(
            "pose measured at rest",
            rest.position_rms_m,
            lambda v: f"{1e3 * v:.2f} mm",
            f"{math.degrees(rest.angle_rms_rad):.2f}\u00b0 off, head mount included",
        )
    if s.servo_final_error_m:
        worst = max(s.servo_final_error_m.values())
        add("hands before the grasp", worst, lambda v: f"{1e3 * v:.2f} mm", "worse hand, by its own image")
    if pace is not None:
        times = f"median {1e3 * pace.median:.1f}, p99 {1e3 * pace.p99:.1f}, longest {1e3 * pace.longest:.0f} ms"
        add("late ticks", pace.missed, lambda v: f"{v} of {pace.ticks}", times)
    return out


def _off(value: float | None, other: float | None, name: str = "truth") -> str:
    if value is None or other is None:
        return ""
    off = round(math.degrees(value - other), 2) + 0.0
    return f"{off:+.2f}\u00b0 to the {name}".replace("-", "\u2212")


def _worst(review: Review, album: Album) -> Moment | None:
    time, estimates = review.summary.worst_estimate_time_s, review.traces.estimates
    if time is None or estimates is None:
        return None
    k = int(np.argmin(np.abs(estimates.time - time)))
    error = 1e3 * np.linalg.norm(estimates.position_error[k])
    what = f"{error:.1f} mm" if math.isfinite(error) else f"residual {estimates.residual_px[k]:.2f} px"
    moment = album.moment(time, "worst estimate", f"{what} at a distance of {estimates.distance[k]:.2f} m")
    return moment if moment.thumbnails else None


def _log_lines(log: LogReader) -> list[tuple[float, str, str, int]]:
    """(time, who, what, level) of /log."""
    if "/log" not in log.topics:
        return []
    if log.topics["/log"].schema != "foxglove.Log" or log.topics["/log"].count > MOST:
        return []
    return [(t, m.name, m.message, m.level) for _, t, m in _foreign(log, "/log")]


def _foreign(log: LogReader, topic: str) -> Iterator[tuple[str, float, Any]]:
    """Messages in Foxglove's schemas, typed Any: the type checker does not know their fields."""
    return log.messages([topic])


def _parsed(text: str) -> dict[str, Any]:
    try:
        out = yaml_file.parse(text, "scenario")
    except ConfigError:
        return {}
    return out if isinstance(out, dict) else {}


def _label(mode: str) -> str:
    return mode.replace("_", " ")


def _environment() -> jinja2.Environment:
    loader = jinja2.PackageLoader("valve_drake", "analysis")
    environment = jinja2.Environment(
        loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    environment.filters |= {"label": _label, "mode_class": mode_class, "rate": _rate, "words": words, "size": _size}
    environment.globals |= {"degrees": math.degrees, "AT_REST": AT_REST}
    return environment


def _rate(period: float | None) -> str:
    if period is None or period <= 0:
        return ""
    return f"{1 / period:.4g} Hz"


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.0f} kB"
