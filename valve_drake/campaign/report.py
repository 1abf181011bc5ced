"""The page of a campaign: count and interval, verdicts, failures, figures against what was drawn, a table of runs."""

import csv
import io
import math
import shlex
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import jinja2
import numpy as np
from markupsafe import Markup, escape

from valve_drake import outputs
from valve_drake.analysis.metrics import figures, summarize
from valve_drake.analysis.plots import nice_ticks
from valve_drake.campaign.campaign import least_honesty, summary
from valve_drake.campaign.trial import Record, turned
from valve_drake.checks import ConfigError
from valve_drake.recording.reader import LogReader

MADE = "Made by <code>valve-drake campaign</code>"  # in every page, see the template
GOOD, BAD = "#2f8f5b", "#c0392b"
_EQUAL = 1e-9  # numbers that are closer, as a share of them, are one: rounding is no distribution
_WIDE, _HIGH, _LEFT, _BOTTOM = 340, 150, 46, 30  # of a small plot [px]

# Figures of a run, as the page shows them: title, value of a record (None: not known).
FIGURES: dict[str, Callable[[Record], float | None]] = {
    "camera minus truth [deg]": lambda r: _degrees(r, "valve_angle_estimated_rad", "valve_angle_true_rad"),
    "true angle minus command [deg]": lambda r: _degrees(r, "valve_angle_true_rad", "valve_angle_command_rad"),
    "held by both pads, worse hand [%]": lambda r: _percent(least_honesty(r)),
    "slips": lambda r: None if r.get("slips") is None else sum(r["slips"].values()),
    "collisions": lambda r: r.get("collisions"),
    "peak internal force [N]": lambda r: r.get("peak_internal_force_N"),
    "peak hand force while turning [N]": lambda r: r.get("turn_peak_hand_force_N"),
    "stem force beyond the couple [N]": lambda r: r.get("turn_mean_stem_force_N"),
    "position error measured at rest [mm]": lambda r: _times(r.get("measured_position_rms_m"), 1e3),
    "estimator's NEES at rest": lambda r: r.get("estimator_nees"),
    "retries": lambda r: r.get("retries"),
    "simulated time [s]": lambda r: r.get("sim_time_s"),
    "processor time [s]": lambda r: (r["times"].get("processor_s") or {}).get("total"),
}


def _times(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


def _percent(share: float | None) -> float | None:
    return _times(share, 100.0)


def _degrees(record: Record, a: str, b: str) -> float | None:
    x, y = record.get(a), record.get(b)
    return None if x is None or y is None else math.degrees(x - y)


def was_made(path: Path) -> bool:
    """Whether a file is such a page."""
    return outputs.holds(path, MADE)


def table(records: list[Record]) -> str:
    """CSV: a row for each run, with its draws and figures."""
    draws = sorted({key for record in records for key in record["draws"]})
    plain = ("scenario", "seed", "outcome", "verdict", "mode", "reason")
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*plain, *draws, *FIGURES, "log"])
    for r in records:
        drawn = [r["draws"].get(key) for key in draws]
        writer.writerow([*(r[key] for key in plain), *drawn, *(f(r) for f in FIGURES.values()), r.get("log")])
    return out.getvalue()


def page(records: list[Record], beside: Path, logs: Path | None = None) -> str:
    """The HTML page, to lie in folder `beside`; logs: the folder that their `log`s are relative to (None: beside)."""
    numbers = summary(records)
    draws = sorted({key for record in records for key in record["draws"]})
    rows: list[dict[str, Any]] = []
    for record in records:
        log = record.get("log")
        link = None
        if log is not None:
            path = (logs or beside) / log
            review = path.parent / f"{path.stem}.review.html"
            link = _relative(review if review.exists() else path, beside)
        values = {title: figure(record) for title, figure in FIGURES.items()}
        again = shlex.join(record["command"]) if record.get("command") else ""
        rows.append({"r": record, "good": turned(record), "figures": values, "link": link, "again": again})
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("valve_drake.campaign", "."), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("report.html.j2").render(
        made=Markup(MADE),
        numbers=numbers,
        verdicts=Counter((r["verdict"] or r["outcome"], "" if turned(r) else r["mode"]) for r in records).most_common(),
        rows=rows,
        draws=draws,
        figures=list(FIGURES),
        histograms=[_histogram(title, [row["figures"][title] for row in rows]) for title in FIGURES],
        scatters=[(key, [_scatter(key, title, rows) for title in FIGURES]) for key in draws],
        shares=[_shares(key, rows) for key in draws],
    )


def _relative(path: Path, beside: Path) -> str:
    try:
        return quote(path.resolve().relative_to(beside.resolve()).as_posix())
    except ValueError:
        return path.resolve().as_uri()


# ---------------------------------------------------------------- small plots


def _frame(title: str, x: tuple[float, float], y: tuple[float, float], body: str, across: str = "") -> Markup:
    def at(v: float, low: float, high: float, a: float, b: float) -> float:
        return a + (v - low) / (high - low) * (b - a)

    out = [f'<svg viewBox="0 0 {_WIDE} {_HIGH}" role="img"><title>{escape(title)}</title>']
    for tick in nice_ticks(*x, 4):
        px = at(tick, *x, _LEFT, _WIDE - 6)
        out.append(f'<line class="g" x1="{px:.1f}" x2="{px:.1f}" y1="6" y2="{_HIGH - _BOTTOM}"/>')
        out.append(f'<text x="{px:.1f}" y="{_HIGH - _BOTTOM + 12}" text-anchor="middle">{tick:g}</text>')
    for tick in nice_ticks(*y, 4):
        py = at(tick, *y, _HIGH - _BOTTOM, 6)
        out.append(f'<line class="g" x1="{_LEFT}" x2="{_WIDE - 6}" y1="{py:.1f}" y2="{py:.1f}"/>')
        out.append(f'<text x="{_LEFT - 4}" y="{py + 3:.1f}" text-anchor="end">{tick:g}</text>')
    out.append(f'<text x="{(_LEFT + _WIDE) / 2}" y="{_HIGH - 4}" text-anchor="middle">{escape(across)}</text>')
    return Markup("".join(out) + body + "</svg>")


def _range(values: list[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    apart = high - low if high - low > _EQUAL * abs(high) else 0.0
    room = 0.05 * apart or 0.5 * abs(high) or 0.5
    return low - room, high + room


def _histogram(title: str, values: list[float | None]) -> tuple[str, Markup | None]:
    known = [v for v in values if v is not None]
    if not known:
        return title, None
    x, bins = _range(known), min(24, max(4, round(math.sqrt(len(known)))))
    around = max(known) - min(known) <= _EQUAL * abs(max(known))
    counts, edges = np.histogram(known, bins | 1, range=x if around else None)
    y = 0.0, float(max(counts)) * 1.08
    bars = []
    for count, a, b in zip(counts, edges, edges[1:]):
        left, right = (_LEFT + (v - x[0]) / (x[1] - x[0]) * (_WIDE - 6 - _LEFT) for v in (a, b))
        tall = count / y[1] * (_HIGH - _BOTTOM - 6)
        bars.append(
            f'<rect fill="#4a7db5" x="{left:.1f}" width="{max(right - left - 1, 1):.1f}" '
            f'y="{_HIGH - _BOTTOM - tall:.1f}" height="{tall:.1f}"/>'
        )
    return title, _frame(title, x, y, "".join(bars))


def _scatter(key: str, title: str, rows: list[dict[str, Any]]) -> tuple[str, Markup | None]:
    points = [(row["r"]["draws"].get(key), row["figures"][title], row["good"]) for row in rows]
    known = [(x, y, good) for x, y, good in points if x is not None and y is not None]
    if not known:
        return title, None
    xs, ys = _range([p[0] for p in known]), _range([p[1] for p in known])
    ways = {True: "", False: ""}  # one element for all runs of a kind: pages of hundreds of runs stay quick
    for x, y, good in known:
        px = _LEFT + (x - xs[0]) / (xs[1] - xs[0]) * (_WIDE - 6 - _LEFT)
        py = _HIGH - _BOTTOM - (y - ys[0]) / (ys[1] - ys[0]) * (_HIGH - _BOTTOM - 6)
        ways[good] += f"M{px:.0f} {py:.0f}h0"
    colors = {True: GOOD, False: BAD}
    body = "".join(f'<path class="d" stroke="{colors[good]}" d="{way}"/>' for good, way in ways.items() if way)
    return title, _frame(title, xs, ys, body, key)


def _shares(key: str, rows: list[dict[str, Any]], bins: int = 6) -> tuple[str, Markup]:
    """The share of successes over a drawn value, in bins of equally many runs."""
    known = sorted((row["r"]["draws"][key], row["good"]) for row in rows if key in row["r"]["draws"])
    x = _range([value for value, _ in known])
    body = []
    for part in np.array_split(np.arange(len(known)), min(bins, len(known))):
        share = float(np.mean([known[k][1] for k in part]))
        left, right = (_LEFT + (known[k][0] - x[0]) / (x[1] - x[0]) * (_WIDE - 6 - _LEFT) for k in (part[0], part[-1]))
        py = _HIGH - _BOTTOM - share / 1.08 * (_HIGH - _BOTTOM - 6)
        color = GOOD if share == 1 else BAD
        body.append(f'<path stroke="{color}" stroke-width="3" d="M{left:.1f} {py:.1f}H{max(right, left + 2):.1f}"/>')
    return key, _frame(key, x, (0.0, 1.08), "".join(body), key)


# ---------------------------------------------------------------- a folder of logs


def records_of_logs(folder: Path) -> list[Record]:
    """Records of all logs in a folder, made from the logs alone. Raises ConfigError if there are none."""
    found = sorted(folder.glob("**/*.mcap"))
    if not found:
        raise ConfigError(f"runs: there is no log in {str(folder)!r}")
    return [_record_of(path, folder) for path in found]


def _record_of(path: Path, folder: Path) -> Record:
    record: Record = {"scenario": "", "seed": -1, "draws": {}, "verdict": "", "reason": "", "mode": "", "times": {}}
    record |= {"log": path.relative_to(folder).as_posix()}
    try:
        log = LogReader(path)
        s = summarize(log)
    except ConfigError as error:
        return record | {"outcome": "unreadable", "reason": str(error)}
    run = log.metadata.get("run", {})
    seed = run.get("seed", "")
    return record | {
        "scenario": path.stem,
        "seed": int(seed) if seed.isdecimal() and seed.isascii() else -1,
        "outcome": s.outcome or "unfinished",
        "verdict": s.verdict,
        "reason": s.reason,
        "mode": s.last_mode,
        **outputs.finite(figures(s)),
    }
