"""The wiring of a scenario as a reviewed text list and as a drawing (SVG), both made from the built diagram."""

import re
from collections.abc import Iterable
from html import escape
from pathlib import Path

from pydrake.systems.framework import Diagram

from valve_drake import outputs
from valve_drake.diagram import make_diagram, wiring
from valve_drake.scenario import Scenario, resolve

# Column and row of each block; and its colour by kind.
PLACES: dict[str, tuple[float, float]] = {
    "station": (0, 2.7),
    "robot_state": (1, 4.9),
    "color_segmentation": (1, 1.2),
    "handle_marker": (1, 3.4),
    "stereo_positioning": (2, 0.4),
    "line_fitting": (2, 1.7),
    "rectangle_estimator": (3, 1.7),
    "stance_planner": (3, 3.0),
    "valve_search": (4, 0.4),
    "base_approach": (4, 1.5),
    "kinematic_approach": (4, 2.6),
    "image_servo": (4, 3.8),
    "hybrid_rotation": (4, 4.9),
    "supervisor": (5.4, 1.2),
    "command_selector": (5.4, 3.8),
}
KINDS = {
    "station": "#37474f",
    "robot_state": "#546e7a",
    "color_segmentation": "#8e3b46",
    "line_fitting": "#8e3b46",
    "stereo_positioning": "#8e3b46",
    "rectangle_estimator": "#8e3b46",
    "handle_marker": "#3c7a3f",
    "command_selector": "#37474f",
    "supervisor": "#6a4c93",
}
BOTTOM = 6.0  # row of blocks without a place
BEHAVIOR = "#1f5f8b"
WIDTH, HEIGHT, COLUMN, ROW, LEFT, TOP = 158, 46, 222, 92, 24, 40
TO_ALL = {"status": "#6a4c93", "command": "#37474f"}  # ports that every behaviour has: coloured, not labelled
CAPTION = "One arrow for all ports between two blocks."
_WIRE = re.compile(r"\w+\.[\w.]+ -> \w+\.[\w.]+")  # a line of the list
BUSES = {"supervisor.mode": "#6a4c93", "robot_state.robot_state": "#546e7a", "station.health": "#c77d0a"}


def files(name: str) -> tuple[str, str]:
    """The names of the wiring list and of the drawing."""
    return f"{name}.wiring.txt", f"{name}.svg"


def made_before(path: Path) -> bool:
    """Whether a file is a wiring list or a drawing by `write`."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    if path.suffix == ".svg":
        return CAPTION in text
    return bool(text) and all(map(_WIRE.fullmatch, text.splitlines()))


def write(scenario: Scenario, name: str, folder: Path) -> list[Path]:
    """Writes <name>.wiring.txt and <name>.svg -> their paths. Raises OperationFailed."""
    diagram = make_diagram(resolve(scenario)).diagram
    outputs.make_folder(folder)
    paths = [folder / file for file in files(name)]
    for path, text in zip(paths, (wiring_text(diagram), svg(diagram))):
        outputs.write(path, text)
    return paths


def wiring_text(diagram: Diagram) -> str:
    """The sorted list of connections."""
    return "\n".join(wiring(diagram)) + "\n"


def svg(diagram: Diagram) -> str:
    """The drawing. A block without a place in PLACES is drawn in the bottom row."""
    edges: dict[tuple[str, str], list[str]] = {}
    buses: dict[str, list[str]] = {bus: [] for bus in BUSES}
    for line in wiring(diagram):
        source, target = line.split(" -> ")
        (a, port), (b, _) = source.split(".", 1), target.split(".", 1)
        if source in BUSES:
            buses[source].append(b)
        else:
            edges.setdefault((a, b), []).append(port)
    names = {system.get_name() for system in diagram.GetSystems()}
    new = sorted(names - set(PLACES))
    places = PLACES | {name: (float(k), BOTTOM) for k, name in enumerate(new)}
    width = int(LEFT * 2 + 5.4 * COLUMN + WIDTH + 36)
    height = int(TOP + (BOTTOM + 1 if new else 6.3) * ROW)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="Helvetica, Arial, sans-serif">',
        '<defs><marker id="a" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#607d8b"/></marker></defs>',
        f'<rect width="{width}" height="{height}" fill="#fbfbf8"/>',
        f'<text x="{LEFT}" y="28" font-size="13" fill="#607d8b">{CAPTION} Squares: '
        "reads the mode (purple), the robot's state (grey), its health (amber). "
        "Arrows: status (purple), command (dark).</text>",
    ]
    x, y = _corner(places["supervisor"])
    parts.append(
        f'<path d="M{x + WIDTH / 2:.0f} {y - 34:.0f}L{x + WIDTH / 2:.0f} {y:.0f}" stroke="#90a4ae" stroke-width="1.6" '
        f'marker-end="url(#a)"/><text x="{x + WIDTH / 2:.0f}" y="{y - 40:.0f}" font-size="12" fill="#455a64" '
        'text-anchor="middle">operator</text>'
    )
    parts += [_edge(places[a], places[b], ports) for (a, b), ports in sorted(edges.items())]
    parts += [_block(name, places[name], [bus for bus in BUSES if name in buses[bus]]) for name in sorted(names)]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _corner(place: tuple[float, float]) -> tuple[float, float]:
    column, row = place
    return LEFT + column * COLUMN, TOP + row * ROW


def _block(name: str, place: tuple[float, float], reads: Iterable[str]) -> str:
    x, y = _corner(place)
    color = KINDS.get(name, BEHAVIOR)
    out = [
        f'<rect x="{x:.0f}" y="{y:.0f}" width="{WIDTH}" height="{HEIGHT}" rx="8" fill="{color}"/>',
        f'<text x="{x + WIDTH / 2:.0f}" y="{y + HEIGHT / 2 + 5:.0f}" font-size="14" fill="white" '
        f'text-anchor="middle">{escape(name)}</text>',
    ]
    for k, bus in enumerate(reads):
        out.append(
            f'<rect x="{x + 8 + 14 * k:.0f}" y="{y - 5:.0f}" width="10" height="10" fill="{BUSES[bus]}" '
            'stroke="white" stroke-width="1.5"/>'
        )
    return "".join(out)


def _edge(a: tuple[float, float], b: tuple[float, float], ports: list[str]) -> str:
    (xa, ya), (xb, yb) = _corner(a), _corner(b)
    short = ports[0] if len(ports) == 1 else f"{len(ports)} ports"
    color = TO_ALL.get(ports[0], "#90a4ae") if len(ports) == 1 else "#90a4ae"
    style = f'fill="none" stroke="{color}" stroke-opacity="0.75" stroke-width="1.6" marker-end="url(#a)"'
    if xb > xa:
        x0, y0, x1, y1 = xa + WIDTH, ya + HEIGHT / 2, xb, yb + HEIGHT / 2
        bend = max(40.0, (x1 - x0) / 2)
        path = f"M{x0:.0f} {y0:.0f}C{x0 + bend:.0f} {y0:.0f} {x1 - bend:.0f} {y1:.0f} {x1:.0f} {y1:.0f}"
        label = (x0 + 0.32 * (x1 - x0), y0 + 0.22 * (y1 - y0) - 4)
    elif xb == xa:
        side = xa + WIDTH
        y0, y1 = ya + HEIGHT / 2 + 8, yb + HEIGHT / 2 - 8
        path = f"M{side:.0f} {y0:.0f}C{side + 46:.0f} {y0:.0f} {side + 46:.0f} {y1:.0f} {side:.0f} {y1:.0f}"
        label = (side + 30, (y0 + y1) / 2 + 3)
    else:  # back to an earlier column: below everything
        low = TOP + 6.0 * ROW
        x0, y0, x1, y1 = xa + WIDTH / 2, ya + HEIGHT, xb + WIDTH / 2, yb + HEIGHT
        path = f"M{x0:.0f} {y0:.0f}L{x0:.0f} {low:.0f}L{x1:.0f} {low:.0f}L{x1:.0f} {y1:.0f}"
        label = ((x0 + x1) / 2, low - 6)
    text = (
        ""
        if ports[0] in TO_ALL
        else (
            f'<text x="{label[0]:.0f}" y="{label[1]:.0f}" font-size="10" fill="#78909c" '
            f'paint-order="stroke" stroke="#fbfbf8" stroke-width="3">{escape(short)}</text>'
        )
    )
    return f'<path d="{path}" {style}/>{text}'
