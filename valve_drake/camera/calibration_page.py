"""The report of a calibration as one self-contained HTML page."""

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake import frames
from valve_drake.camera.calibration import Calibration
from valve_drake.page_style import STYLE

_GRID = np.array([10, 8])  # cells of an image, for coverage
_MADE = "<meta name='generator' content='valve-drake calibrate'>"
_ENLARGED = 50  # residuals in the maps
_STYLE = (
    STYLE
    + """\
svg { background: #fafbfc; border: 1px solid #d8dde4; max-width: 100%; height: auto }
figure { display: inline-block; margin: 0 1em 0 0 }
.out { color: #b3261e; font-weight: 600 }
.big { font-size: 1.25em; font-weight: 600 }
.warn { background: #fff4e0; border-left: 4px solid #e39a1a; padding: .3em .8em; margin: .3em 0 }
"""
)


def is_page(path: Path) -> bool:
    """Whether a file is a page that `calibrate` wrote, which a new one may replace."""
    try:
        with open(path, "rb") as file:
            return _MADE.encode() in file.read(1000)
    except OSError:
        return False


def cells(px: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Which cells of an image hold a point: px (n, 2) -> (columns, rows) bool."""
    out = np.zeros(_GRID, bool)
    out[tuple(np.floor(px / size * _GRID).astype(int).clip(0, _GRID - 1).T)] = True
    return out


def cameras(numbers: dict[str, Any], result: Calibration, size: tuple[int, int]) -> str:
    """The page of one camera, or of the stereo head."""
    fit, both = result.fit, len(result.fit.lenses) == 2
    views, sigmas = numbers["per_view"], numbers["standard_deviations"]
    title = "Calibration of the stereo head" if both else "Calibration of one camera"
    told = f"{len(views)} views, {size[0]} x {size[1]} px, {fit.kind} lens, written to {numbers['out']}"
    figures = [(f"{fit.rms:.3f} px", "rms of the corners")]
    if both:
        figures.append((f"{numbers['baseline_mm']:.2f} mm", "baseline"))
    parts = [head(title, told, numbers["warnings"], figures)]
    if both:
        parts.append(_triangulation(numbers))
    lenses = numbers["lenses"].items()
    rows: list[tuple[Any, ...]] = [
        (k + " (better)" * (k == result.better), f"{v['rms_px']:.3f}", v["parameters"]) for k, v in lenses
    ]
    parts += ["<h2>Lens models on the same corners</h2>", table(("model", "rms [px]", "parameters"), rows)]
    lens = [(name, value) for name, value in numbers["parameters"].items() if not name.startswith("X_LR")]
    rows = [(name, f"{value:.6g}", f"{sigmas[name]:.2g}") for name, value in lens]
    if both and fit.X_LR is not None:
        rotation, spread = np.degrees(frames.rotation_vector(fit.X_LR[:, :3])), numbers["X_LR_sigma"]
        for k, axis in enumerate("xyz"):
            rows.append((f"X_LR rotation {axis} [deg]", f"{rotation[k]:.4f}", f"{spread['rotation_deg'][k]:.2g}"))
        for k, axis in enumerate("xyz"):
            position = f"{1e3 * fit.X_LR[k, 3]:.3f}"
            rows.append((f"X_LR position {axis} [mm]", position, f"{spread['position_mm'][k]:.2g}"))
    parts += ["<h2>Parameters</h2>", table(("", "value", "standard deviation"), rows)]
    names, marked = [" / ".join(view.names) for view in result.views], [view["outlier"] for view in views]
    parts += ["<h2>Views</h2>", bars(names, [view["rms_px"] for view in views], marked, "px rms")]
    rows = [(n, f"{v['rms_px']:.3f}", f"{v['max_px']:.2f}", f"{v['tilt_deg']:.0f}") for n, v in zip(names, views)]
    parts += [
        table(("view", "rms [px]", "largest [px]", "tilt [deg]"), rows, marked),
        "<h2>Coverage and residuals</h2>",
    ]
    for c, side in enumerate(("left camera", "right camera") if both else ("camera",)):
        caption = f"{side}: corners in {100 * numbers['coverage'][c]:.0f} % of the cells; "
        caption += f"residuals enlarged {_ENLARGED} times"
        px, residuals = [view.px[c] for view in result.views], [view[c] for view in fit.residuals]
        parts.append(corner_map(px, residuals, size, caption))
    return page(title, parts)


def page(title: str, parts: Sequence[str]) -> str:
    """A whole page of parts that are HTML; the title is text."""
    head = f"<meta charset='utf-8'>{_MADE}<title>{html.escape(title)}</title><style>{_STYLE}</style>"
    return f"<!doctype html><html lang='en'><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def head(title: str, told: str, warnings: Sequence[str], figures: Sequence[tuple[str, str]]) -> str:
    """Title, a sentence below it, warnings, and the figures to see first, each with what it is."""
    out = f"<h1>{html.escape(title)}</h1><p class='note'>{html.escape(told)}</p>"
    out += "".join(f"<div class='warn'>{html.escape(text)}</div>" for text in warnings)
    return out + "<p>" + " &emsp; ".join(f"<span class='big'>{n}</span> {what}" for n, what in figures) + "</p>"


def _triangulation(numbers: dict[str, Any]) -> str:
    half, sigma, pitch = numbers["split_half_mm"] or {}, numbers["depth_sigma_mm"], numbers["triangulated_pitch"]
    rows = [(f"{z} m", f"{half[z]:.1f}" if z in half else "-", f"{sigma[z]:.1f}") for z in sigma]
    return (
        "<h2>Triangulated points</h2><p>The rms does not tell how good a calibration is. Calibrated once from every "
        "second pair and once from the others, the distance of one and the same point comes out different by:</p>"
        + table(("distance", "split-half difference [mm]", "standard deviation [mm]"), rows)
        + "<p class='note'>About twice the standard deviation is to be expected, since a half has half the views. "
        "Much more says that something is not as the model has it: lens, board, pairing. The triangulated pitch is "
        f"{100 * pitch['mean']:.2f} % of the true one, each +- {100 * pitch['standard_deviation']:.2f} %.</p>"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[Any]], marked: Sequence[bool] | None = None) -> str:
    """Rows of text below their heads; those `marked` stand out."""
    out = "<tr>" + "".join(f"<th>{html.escape(name)}</th>" for name in head) + "</tr>"
    for k, row in enumerate(rows):
        kind = " class='out'" if marked is not None and marked[k] else ""
        out += f"<tr{kind}>" + "".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) + "</tr>"
    return f"<table>{out}</table>"


def corner_map(
    px: Sequence[np.ndarray], residuals: Sequence[np.ndarray] | None, size: tuple[int, int], caption: str
) -> str:
    """The corners (n, 2) of each view in its colour, their residuals (n, 2) enlarged [px], empty cells tinted."""
    (width, height), parts = size, []
    w, h = np.array(size) / _GRID
    for k, j in np.argwhere(~cells(np.vstack(px), size)):
        parts.append(f"<rect x='{k * w:.1f}' y='{j * h:.1f}' width='{w:.1f}' height='{h:.1f}' fill='#f6e3e1'/>")
    radius = max(width / 320, 1)
    for k, p in enumerate(px):
        color = f"hsl({(k * 137) % 360} 65% 45%)"
        parts += [f"<circle cx='{u:.1f}' cy='{v:.1f}' r='{radius:.1f}' fill='{color}'/>" for u, v in p]
        if residuals is not None:
            ends = p + _ENLARGED * residuals[k]
            lines = "".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in zip(p, ends))
            parts.append(f"<path d='{lines}' stroke='{color}' stroke-width='{radius / 2:.1f}' fill='none'/>")
    svg = f"<svg viewBox='0 0 {width} {height}' width='500'>{''.join(parts)}</svg>"
    return f"<figure>{svg}<figcaption class='note'>{html.escape(caption)}</figcaption></figure>"


def bars(names: Sequence[str], values: Sequence[float], marked: Sequence[bool], unit: str) -> str:
    """A bar for each value, none below 0, with its name; those `marked` stand out."""
    top, parts = max(max(values), 1e-12), []
    for k, (name, value) in enumerate(zip(names, values)):
        y, length, color = 18 * k, 440 * value / top, "#b3261e" if marked[k] else "#4a7fb5"
        parts.append(
            f"<text x='290' y='{y + 13}' text-anchor='end' font-size='12'>{html.escape(name)}</text>"
            f"<rect x='298' y='{y + 3}' width='{length:.1f}' height='12' fill='{color}'/>"
            f"<text x='{304 + length:.0f}' y='{y + 13}' font-size='12'>{value:.3g} {unit}</text>"
        )
    return f"<svg viewBox='0 0 860 {18 * len(parts) + 4}' width='860'>{''.join(parts)}</svg>"
