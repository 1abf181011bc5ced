"""Plots over time as small inline SVG: without a library or network, with searchable text, zoomed by the page's script.

A plot is an outer SVG with the ticks, and an inner one whose user units are seconds across and pixels down: the script
zooms by changing its viewBox. Lines keep their width by `vector-effect`; points are lines of no length with round ends.
"""

import dataclasses as dc
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup, escape

from valve_drake.analysis.traces import ModeSpan
from valve_drake.messages import Mode

WIDTH, LEFT, RIGHT, BOTTOM = 1120, 62, 10, 20  # [px]
BUCKETS = 1400  # columns of a plot; the least and the greatest value of each are drawn
BREAK = 0.3  # a line is interrupted where no message came for longer [s]
BAND_BREAK = 1.1  # the same for bands; raise it for estimates at a lower rate [s]
_MODES = frozenset(Mode)
_Axis: TypeAlias = Callable[[Any], np.ndarray]


@dc.dataclass(frozen=True)
class Line:
    """One curve.

    style: line, dots, or rings (larger and paler, to lie under dots). sigma: a band of twice this to both sides is
    drawn behind it.
    """

    label: str
    time: np.ndarray  # [s]
    value: np.ndarray
    color: str
    style: str = "line"
    dashed: bool = False
    sigma: np.ndarray | None = None


@dc.dataclass
class Plot:
    """Curves over one axis. knee > 0: linear up to about this value, logarithmic beyond."""

    title: str
    unit: str
    lines: list[Line]
    note: str = ""
    height: int = 150
    knee: float = 0.0
    low: float | None = None  # the axis reaches at least from low to high
    high: float | None = None
    key: str = ""  # for tests and links

    def svg(self, spans: Sequence[ModeSpan], start: float, end: float) -> Markup:
        """The plot from `start` to `end` with the modes' spans behind it."""
        forward, _ = _scale(self.knee)
        low, high = self._limits(forward)
        inner = self.height - BOTTOM - 6

        def y(value: np.ndarray | float) -> np.ndarray:
            return inner * (1 - (forward(np.asarray(value, float)) - low) / (high - low))

        ticks = [t for t in self._ticks(low, high) if -0.5 <= float(y(t)) <= inner + 0.5]
        out = [
            f'<svg class="plot" viewBox="0 0 {WIDTH} {self.height}" role="img" aria-label="{escape(self.title)}" '
            f'data-low="{low:.9g}" data-high="{high:.9g}" data-knee="{self.knee:g}" data-inner="{inner}">',
            '<g class="y">',
        ]
        digits = _digits(ticks)
        for tick in ticks:
            at = float(y(tick)) + 6
            label = _plain(tick, digits)
            out.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
            out.append(f'<text x="{LEFT - 6}" y="{at + 3.5:.1f}">{label}</text>')
        out.append(f'</g><g class="x">{time_ticks(start, end, inner + 6)}</g>')
        out.append(
            f'<svg class="area" x="{LEFT}" y="6" width="{WIDTH - LEFT - RIGHT}" height="{inner}" '
            f'viewBox="{start:.4f} 0 {end - start:.4f} {inner}" preserveAspectRatio="none">'
        )
        out.append(shades(spans, inner))
        if low < 0 < high:
            zero = float(y(0.0))
            out.append(f'<path class="zero" d="M{start:.3f} {zero:.1f}H{end:.3f}"/>')
        out += [_band(line, y) for line in self.lines if line.sigma is not None]
        out += [f'<path class="{_kind(line)}" stroke="{line.color}" d="{_path(line, y)}"/>' for line in self.lines]
        out.append("</svg></svg>")
        return Markup("".join(out))

    def _limits(self, forward: _Axis) -> tuple[float, float]:
        values = [forward(line.value[np.isfinite(line.value)]) for line in self.lines]
        values += [forward(np.array([v])) for v in (self.low, self.high) if v is not None]
        values = [v for v in values if len(v)]
        low = min((float(v.min()) for v in values), default=0.0)
        high = max((float(v.max()) for v in values), default=1.0)
        room = 0.06 * (high - low) or 0.5 * max(abs(high), 1e-6)
        # An axis that starts at zero stays there: no space below what cannot be negative.
        return (low if low == 0 else low - room), high + room

    def _ticks(self, low: float, high: float) -> list[float]:
        if not self.knee:
            return nice_ticks(low, high, max(3, self.height // 27))
        _, back = _scale(self.knee)
        most = max(abs(float(back(low))), abs(float(back(high))))
        decades = range(math.floor(math.log10(self.knee)), math.ceil(math.log10(max(most, self.knee))) + 1)
        sizes = [10.0**k for k in decades if 10.0**k >= self.knee]
        return sorted([-v for v in sizes] + [0.0] + sizes)


def shades(spans: Iterable[ModeSpan], tall: float) -> str:
    """The modes as tinted areas, in seconds across."""
    rows = ((mode_class(span.mode), span.start, span.duration) for span in spans)
    return "".join(
        f'<rect class="{css}" x="{start:.4f}" y="0" width="{duration:.4f}" height="{tall}"/>'
        for css, start, duration in rows
    )


def mode_class(mode: str) -> str:
    """The CSS class of a mode's colour; of a mode that this program does not know, none that exists."""
    return f"m-{mode}" if mode in _MODES else "m-unknown"


def time_ticks(start: float, end: float, bottom: float) -> str:
    """Ticks of the time axis; the page's script draws the same when it zooms."""
    out = []
    ticks = nice_ticks(start, end, 10)
    digits = _digits(ticks)
    for tick in ticks:
        x = LEFT + (tick - start) / (end - start) * (WIDTH - LEFT - RIGHT)
        out.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="6" y2="{bottom:.1f}"/>')
        unit = " s" if tick == ticks[-1] else ""
        out.append(f'<text x="{x:.1f}" y="{bottom + 13:.1f}">{_plain(tick, digits)}{unit}</text>')
    return "".join(out)


def nice_ticks(low: float, high: float, count: int) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten, about `count` of them."""
    if not (math.isfinite(high - low) and high > low):
        return [low]
    rough = (high - low) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= rough)
    return [k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)]


def thin(time: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fewer points that draw the same curve: the least and the greatest value of every bucket of time, in order."""
    if len(time) <= 2 * BUCKETS or time[-1] <= time[0]:
        return time, value
    bucket = np.minimum(((time - time[0]) / (time[-1] - time[0]) * BUCKETS).astype(int), BUCKETS - 1)
    starts = np.flatnonzero(np.diff(bucket, prepend=-1))
    keep = set()
    for first, last in zip(starts, np.append(starts[1:], len(time))):
        part = value[first:last]
        keep |= {first + int(part.argmin()), first + int(part.argmax())}
    at = sorted(keep)
    return time[at], value[at]


def _scale(knee: float) -> tuple[_Axis, _Axis]:
    """Value -> axis and back."""
    if knee:
        return (lambda v: np.arcsinh(np.asarray(v) / knee)), (lambda a: np.sinh(a) * knee)
    return (lambda v: np.asarray(v, float)), (lambda a: a)


def _kind(line: Line) -> str:
    return line.style if line.style != "line" else "dashed" if line.dashed else "line"


def _path(line: Line, y: _Axis) -> str:
    good = np.isfinite(line.value)
    time, value = line.time[good], line.value[good]
    if line.style != "line":
        return "".join(f"M{t:.3f} {v:.1f}h0" for t, v in zip(time.tolist(), y(value).tolist()))
    time, value = thin(time, value)
    broken = np.flatnonzero(np.diff(time) > BREAK) + 1
    out = []
    for part in np.split(np.arange(len(time)), broken):
        points = [f"{t:.3f} {v:.1f}" for t, v in zip(time[part].tolist(), y(value[part]).tolist())]
        if points:
            out.append("M" + "L".join(points) + ("h0" if len(points) == 1 else ""))
    return "".join(out)


def _band(line: Line, y: _Axis) -> str:
    """Two standard deviations to both sides; a single point gets a whisker."""
    sigma = np.zeros_like(line.value) if line.sigma is None else line.sigma
    good = np.isfinite(line.value) & np.isfinite(sigma)
    time, value, wide = line.time[good], line.value[good], 2 * sigma[good]
    areas, whiskers = [], []
    for part in np.split(np.arange(len(time)), np.flatnonzero(np.diff(time) > BAND_BREAK) + 1):
        top, low = y(value[part] + wide[part]).tolist(), y(value[part] - wide[part]).tolist()
        t = time[part].tolist()
        if len(t) == 1:
            whiskers.append(f"M{t[0]:.3f} {top[0]:.1f}V{low[0]:.1f}")
        elif t:
            there = "L".join(f"{a:.3f} {b:.1f}" for a, b in zip(t, top))
            back = "L".join(f"{a:.3f} {b:.1f}" for a, b in zip(reversed(t), reversed(low)))
            areas.append(f"M{there}L{back}Z")
    out = f'<path class="band" fill="{line.color}" d="{"".join(areas)}"/>' if areas else ""
    return out + (f'<path class="whisker" stroke="{line.color}" d="{"".join(whiskers)}"/>' if whiskers else "")


def _digits(ticks: Sequence[float]) -> int:
    """Decimals that tell the ticks apart."""
    steps = [abs(b - a) for a, b in zip(ticks, ticks[1:]) if b != a]
    return max(0, -math.floor(math.log10(min(steps)) + 1e-9)) if steps else 2


def _plain(value: float, digits: int) -> str:
    return (f"{value:.{digits}f}" if abs(value) > 1e-12 else "0").replace("-", "\u2212")
