"""The report of `check-robot` as text and as one self-contained HTML page."""

import base64
import html
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from valve_drake.checks import shown
from valve_drake.page_style import STYLE
from valve_drake.robot_check import DOUBTFUL, MISSING, Finding, Reach, Report

_MADE = "<meta name='generator' content='valve-drake check-robot'>"
_STYLE = (
    STYLE
    + """\
.yes { color: #1a7f37; font-weight: 600 } .no { color: #b3261e; font-weight: 600 }
.missing, .doubtful { border-left: 4px solid #b3261e; background: #fdecea; padding: .3em .8em; margin: .3em 0 }
.doubtful { border-color: #e39a1a; background: #fff4e0 }
.plain { border-left: 4px solid #d8dde4; padding: .3em .8em; margin: .3em 0 }
.cell { padding: .3em .8em; color: #1c2430 }
figure { display: inline-block; margin: 0 1em 1em 0; vertical-align: top }
img { max-width: 100%; border: 1px solid #d8dde4 }
"""
)


def is_page(path: Path) -> bool:
    """Whether a file is a page that `check-robot` wrote, which a new one may replace."""
    try:
        with open(path, "rb") as file:
            return _MADE.encode() in file.read(1000)
    except OSError:
        return False


# ---------------------------------------------------------------- text


def lines(report: Report) -> Iterator[str]:
    """The report for a terminal."""
    yield f"{report.source}: {report.name} is {'usable' if report.usable else 'not usable yet'}"
    yield from (finding.line() for finding in report.sorted())
    if not report.groups:
        return
    yield ""
    for name, joints in report.groups.items():
        yield f"{name}: {', '.join(row['joint'] for row in joints) or 'none'}"
    for side, gripper in report.grippers.items():
        shuts, opens, used = (1e3 * gripper[key] for key in ("shuts_m", "opens_m", "used_m"))
        motor = f"its motor closes with up to {gripper['force_N']:.0f} N"
        yield f"{side} gripper: {shuts:.0f} to {opens:.0f} mm, {used:.0f} mm used, {motor}"
    yield "hidden by the folded arms: " + ", ".join(f"{e} eye {100 * s:.1f} %" for e, s in report.hidden.items())
    yield ""
    yield from _table(_reach_head(report), [_reach_row(row) for row in report.reach])
    yield ""
    yield from _table(SERVO_HEAD, _servo_rows(report))
    yield ""
    yield f"{report.seconds:.1f} s of processor time"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    widths = [max(len(row[k]) for row in (head, *rows)) for k in range(len(head))]
    for row in (head, *rows):
        yield "  ".join(cell.rjust(width) for cell, width in zip(row, widths)).rstrip()


SERVO_HEAD = ("servo", "stiffness", "limit", "damping", "hangs [mrad, mm]")


def _servo_rows(report: Report) -> list[tuple[str, ...]]:
    return [
        (s.joint, f"{s.stiffness:.0f}", f"{s.effort:.0f}", f"{s.ratio:.2f}", f"{1e3 * s.droop:.1f}")
        for s in report.servos
    ]


def _reach_head(report: Report) -> tuple[str, ...]:
    return (
        "height [m]",
        "tilt [deg]",
        "margin",
        "distance [m]",
        "seen to [m]",
        "lift, waist",
        f"effort at {report.friction:g} N m",
        "of",
    )


def _reach_row(row: Reach) -> tuple[str, ...]:
    place = f"{row.height:g}", f"{math.degrees(row.tilt):.0f}"
    if row.margin < 0:
        return (*place, "-", "out of reach", "", "", "", "")
    effort = "" if math.isnan(row.effort) else f"{row.effort:.2f}"
    posture = ", ".join(f"{q:g}" for q in row.posture) or "home"
    seen = "" if row.seen_to is None else f"{row.seen_to:.2f}" if row.seen_to else "not seen"
    return (*place, f"{row.margin:.2f}", f"{row.distance:.2f}", seen, posture, effort, row.joint)


# ---------------------------------------------------------------- page


def page(report: Report) -> str:
    """The whole page, pictures within it."""
    verdict, kind = ("usable", "yes") if report.usable else ("not usable yet", "no")
    title = f"{report.name}: {verdict}"
    parts = [
        f"<h1>{html.escape(report.name)}: <span class='{kind}'>{verdict}</span></h1>",
        f"<p class='note'>{html.escape(shown(report.source)[1:-1])}, {report.seconds:.1f} s of processor time</p>",
        *(_finding(finding) for finding in report.sorted()),
    ]
    parts += [_picture(name, data) for name, data in report.pictures.items()]
    if report.groups:
        parts += _sections(report)
    head = f"<meta charset='utf-8'>{_MADE}<title>{html.escape(title)}</title><style>{_STYLE}</style>"
    return f"<!doctype html><html lang='en'><head>{head}</head><body>{''.join(parts)}</body></html>\n"


def _finding(finding: Finding) -> str:
    kind = finding.level if finding.level in (MISSING, DOUBTFUL) else "plain"
    key = f" <b>{html.escape(finding.key)}</b>" if finding.key else ""
    return f"<div class='{kind}'>{finding.level}, {finding.stage}:{key} {html.escape(finding.text)}</div>"


def _picture(name: str, data: bytes) -> str:
    image = base64.b64encode(data).decode()
    caption = f"<figcaption class='note'>{html.escape(name)}</figcaption>"
    return f"<figure><img src='data:image/png;base64,{image}' alt=''>{caption}</figure>"


def _sections(report: Report) -> Iterator[str]:
    yield f"<h2>Reach: a quarter turn of a valve of {report.friction:g} N m</h2>"
    yield (
        "<p class='note'>The best place for each height and tilt of the panel. margin: of the arms from their limits "
        f"and singular postures, 1 is comfortable, {report.least_margin:g} is needed; effort: the largest share of a "
        "joint's limit, by weight and push; seen to: how far back from there both eyes see the whole marker.</p>"
    )
    table = "".join(_reach_cells(row, report.least_margin) for row in report.reach)
    yield f"<table><tr>{_cells(_reach_head(report), 'th')}</tr>{table}</table>"
    yield "<h2>Joints</h2>"
    for group, joints in report.groups.items():
        head = (group, "lowest", "highest", "speed", "home")
        body = "".join(
            f"<tr>{_cells((row['joint'], *(_number(row[key]) for key in ('low', 'high', 'speed', 'home'))), 'td')}</tr>"
            for row in joints
        )
        yield f"<table><tr>{_cells(head, 'th')}</tr>{body}</table><br>"
    yield "<h2>Grippers</h2>"
    names = ("side", "shuts to [mm]", "opens to [mm]", "used [mm]", "room each side [mm]", "its motor closes with [N]")
    keys = ("shuts_m", 1e3), ("opens_m", 1e3), ("used_m", 1e3), ("room_m", 1e3), ("force_N", 1.0)
    rows = [(side, *(f"{scale * g[key]:.0f}" for key, scale in keys)) for side, g in report.grippers.items()]
    body = "".join(f"<tr>{_cells(row, 'td')}</tr>" for row in rows)
    yield f"<table><tr>{_cells(names, 'th')}</tr>{body}</table>"
    yield "<h2>Servos of the simulated joints, at home</h2>"
    body = "".join(f"<tr>{_cells(row, 'td')}</tr>" for row in _servo_rows(report))
    yield f"<table><tr>{_cells(SERVO_HEAD, 'th')}</tr>{body}</table>"


def _reach_cells(row: Reach, least: float) -> str:
    serves = row.serves(least) and row.seen_to != 0
    shade = f"hsl(130 45% {94 - 24 * max(row.margin, 0):.0f}%)" if serves else "#f6e3e1"
    cells = "".join(f"<td class='cell'>{html.escape(cell)}</td>" for cell in _reach_row(row))
    return f"<tr style='background: {shade}'>{cells}</tr>"


def _cells(values: Sequence[str], tag: str) -> str:
    return "".join(f"<{tag}>{html.escape(value)}</{tag}>" for value in values)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
