"""The curves of a run's page: which series stand in which plot, in what units and colours."""

import dataclasses as dc
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np

from valve_drake.analysis import two_logs
from valve_drake.analysis.conversation import waveform
from valve_drake.analysis.plots import Line, Plot
from valve_drake.analysis.traces import Traces
from valve_drake.messages import SIDES, Mode
from valve_drake.task.modes import RUNNING, owned

BLUE, ORANGE, GREEN, BLACK, GREY = "#0b62a8", "#d1500c", "#157f4c", "#1b1b1b", "#8a8f98"
PURPLE, RED = "#7a3fa0", "#c1272d"
SIDE_COLORS = dict(zip(SIDES, (BLUE, ORANGE)))
AXES = tuple(zip("xyz", (RED, GREEN, BLUE)))


def make_plots(log: Traces) -> list[Plot]:
    """All plots of a run; those without lines have nothing in this log."""
    makers: tuple[Callable[[Traces], Plot], ...] = (
        _distance,
        _position_error,
        _angle_error,
        _servo_error,
        _servo_speed,
        _forces,
        _pads,
        _couple,
        _angle,
        _angle_difference,
        _tracking,
        _health,
        waveform,
    )
    plots = [log.attempt(f"plot {make.__name__.lstrip('_')}", functools.partial(make, log), None) for make in makers]
    return [plot if plot is not None else Plot("", "", []) for plot in plots]


def _distance(log: Traces) -> Plot:
    lines: list[Line] = []
    found = log.estimates
    if found is not None and log.truth is not None and log.joints is not None:
        time = log.joints.time[::8]
        true = log.true_X_LV(time)
        if true is not None:
            lines.append(Line("true", time, np.linalg.norm(true[:, :, 3], axis=1), GREY))
    if log.stereo is not None:
        time, distance = log.stereo
        lines.append(Line("stage 1, stereo", time, distance, ORANGE, "rings"))
    if found is not None and len(found.time):
        lines.append(Line("stage 2, rectangle", found.time, found.distance, BLUE, "dots"))
    return Plot("Distance of the marker", "m", lines, low=0.0, key="distance")


NOMINAL = (
    "Zero is the truth, taken through the nominal head kinematics: the true base and marker poses are recorded, the"
    " head\u2019s mount and its small error are not, so a steady offset of a few millimetres is the mount\u2019s."
    " Bands are the estimate\u2019s own 2 \u03c3."
)


def _position_error(log: Traces) -> Plot:
    if log.truth is None:
        return _position(log)
    title = "Marker position: estimate minus truth, in the left camera"
    return _pose_error(log, title, "mm", 1e3, 3, NOMINAL, "position_error")


def _position(log: Traces) -> Plot:
    """Without truth: the estimate in odometry's frame minus its median, since a marker at rest should not move."""
    found = log.estimates
    lines: list[Line] = []
    if found is not None and len(found.time):
        p = found.X_OV[:, :, 3]
        R_OL = found.X_OV[:, :, :3] @ found.X_LV[:, :, :3].transpose(0, 2, 1)
        covariance = R_OL @ found.covariance[:, 3:, 3:] @ R_OL.transpose(0, 2, 1)
        sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
        for k, (axis, color) in enumerate(AXES):
            off = 1e3 * (p[:, k] - np.median(p[:, k]))
            lines.append(Line(axis, found.time, off, color, "dots", sigma=1e3 * sigma[:, k]))
    note = (
        "No truth in this log: zero is the median, and odometry\u2019s drift shows too."
        " Bands are the estimate\u2019s own 2 \u03c3."
    )
    return Plot(
        "Marker position in odometry, about its median", "mm", lines, note, height=190, knee=0.5, key="position"
    )


def _angle_error(log: Traces) -> Plot:
    note = "About the marker\u2019s own axes, modulo the half turn after which a rectangle looks the same."
    return _pose_error(log, "Marker orientation: estimate minus truth", "deg", math.degrees(1), 0, note, "angle_error")


def _pose_error(log: Traces, title: str, unit: str, scale: float, first: int, note: str, key: str) -> Plot:
    found = log.estimates
    lines: list[Line] = []
    if found is not None and len(found.time) and np.isfinite(found.error).all():
        for k, (axis, color) in enumerate(AXES):
            error, sigma = scale * found.error[:, first + k], scale * found.sigma[:, first + k]
            lines.append(Line(axis, found.time, error, color, "dots", sigma=sigma))
    return Plot(title, unit, lines, note, height=190, knee=0.5 if first else 0.1, key=key)


def _servo_error(log: Traces) -> Plot:
    lines = _by_side(log.servo, "error", 1e3)
    return Plot(
        "Image servo: distance of each hand from its reference", "mm", lines, low=0.0, height=120, key="servo_error"
    )


def _servo_speed(log: Traces) -> Plot:
    lines = _by_side(log.servo, "speed", 1e3)
    return Plot("Image servo: speed of each hand, measured", "mm/s", lines, low=0.0, height=110, key="servo_speed")


def _by_side(series: dict[str, np.ndarray] | None, what: str, scale: float) -> list[Line]:
    if series is None:
        return []
    return [
        Line(side, series["time"], scale * series[f"{side}_{what}"], SIDE_COLORS[side])
        for side in SIDES
        if f"{side}_{what}" in series
    ]


def _forces(log: Traces) -> Plot:
    lines: list[Line] = []
    if (turn := log.turn) is not None:
        t = turn["time"]
        lines = [Line(f"{side} hand", t, turn[f"force_{side}"], SIDE_COLORS[side]) for side in SIDES]
        lines += [
            Line("internal (squeeze)", t, turn["squeeze"], PURPLE),
            Line("on the stem beyond the couple", t, turn["stem_force"], GREEN),
        ]
    note = (
        "Magnitudes, without the hands\u2019 weight and the sensors\u2019 bias; the internal force is signed,"
        " positive compresses the bar."
    )
    return Plot("Forces on the hands", "N", lines, note, height=170, low=0.0, key="forces")


def _pads(log: Traces) -> Plot:
    lines: list[Line] = []
    if (touches := log.touches) is not None and len(touches.time) > 1 and log.truth is not None:
        time = log.truth.time
        at = touches.at(time)
        lines = [Line(f"{side} hand", time, touches.pads[side].min(axis=1)[at], SIDE_COLORS[side]) for side in SIDES]
    note = "By the simulation\u2019s truth: a hand holds while both its pads press. Below zero an outer side pushes."
    return Plot("Hold: the weaker pad of each hand", "N", lines, note, height=110, key="pads")


def _couple(log: Traces) -> Plot:
    lines: list[Line] = []
    if (turn := log.turn) is not None:
        t = turn["time"]
        lines = [Line("couple on the valve", t, turn["torque"], BLACK)]
        lines += [Line(f"moment at the {side} grip", t, turn[f"moment_{side}"], SIDE_COLORS[side]) for side in SIDES]
    return Plot("Couple and moments", "N m", lines, height=130, low=0.0, key="couple")


def _angle(log: Traces) -> Plot:
    lines: list[Line] = []
    scale = math.degrees(1)
    if log.truth is not None:
        lines.append(Line("true", log.truth.time, scale * log.truth.angle, GREY))
    if log.turn is not None:
        working = log.inside(log.turn["time"], *owned("hybrid_rotation"))
        t = log.turn["time"][working]
        lines.append(Line("reference", t, scale * log.turn["angle_reference"][working], BLACK, dashed=True))
        lines.append(Line("by the hands", t, scale * log.turn["angle"][working], ORANGE))
    if log.camera_angle is not None:
        time, angle = log.camera_angle
        lines.append(Line("by the head cameras", time, scale * angle, BLUE, "dots"))
    return Plot("Valve angle, counter-clockwise for the robot", "deg", lines, height=170, key="valve_angle")


def _angle_difference(log: Traces) -> Plot:
    lines: list[Line] = []
    scale = math.degrees(1)
    if (truth := log.truth) is not None:
        if log.turn is not None:
            at = log.inside(log.turn["time"], Mode.TURN)
            t = log.turn["time"][at]
            zero = np.interp(t[:1], truth.time, truth.angle)
            off = log.turn["angle"][at] - (np.interp(t, truth.time, truth.angle) - zero)
            lines.append(Line("by the hands", t, scale * off, ORANGE))
        if log.camera_angle is not None:
            time, angle = log.camera_angle
            seen = log.inside(time, *RUNNING[RUNNING.index(Mode.MEASURE) : RUNNING.index(Mode.RETREAT)])
            off = (angle - np.interp(time, truth.time, truth.angle))[seen]
            lines.append(Line("by the head cameras", time[seen], scale * off, BLUE, "dots"))
    return Plot(
        "Valve angle: belief minus truth",
        "deg",
        lines,
        "From the measurement at rest on.",
        height=120,
        key="angle_error_valve",
    )


def _tracking(log: Traces) -> Plot:
    colors = {"torso": GREEN} | {f"{side}_arm": SIDE_COLORS[side] for side in SIDES}
    groups = [(group.replace("_", " "), names, colors[group]) for group, names in log.groups.items()]
    lines: list[Line] = []
    if log.joints is not None:
        for label, names, color in groups:
            error = np.abs(log.joints.error(names))
            if error.size and np.isfinite(error).all():
                lines.append(Line(label, log.joints.time, 1e3 * error.max(axis=1), color))
    return Plot("Joint tracking: largest difference of a group", "mrad", lines, low=0.0, height=130, key="tracking")


def _health(log: Traces) -> Plot:
    lines: list[Line] = []
    if log.health is not None:
        time, devices, ages = log.health
        groups = (
            ("head cameras", [d for d in devices if d.startswith("head")], BLUE),
            ("wrist cameras", [d for d in devices if d.endswith("_wrist")], ORANGE),
            ("all others", [d for d in devices if not d.startswith("head") and not d.endswith("_wrist")], GREEN),
        )
        for label, names, color in groups:
            if names:
                age = ages[:, [devices.index(name) for name in names]].max(axis=1)
                lines.append(Line(label, time, age, color))
    note = "A simulated station has no silent devices: zero throughout."
    return Plot(
        "Health: age of the oldest report of a group",
        "s",
        lines,
        note if _all_zero(lines) else "",
        height=96,
        low=0.0,
        high=0.1,
        key="health",
    )


def _all_zero(lines: Sequence[Line]) -> bool:
    return all(not line.value.any() for line in lines)


def overlaid(first: Sequence[Plot], second: Sequence[Plot], pairs: two_logs.Pairs) -> list[Plot]:
    """The plots of the first run with the second's curves in paler colours, laid mode over mode."""
    out = []
    for plot, other in zip(first, second):
        theirs = [
            dc.replace(
                line,
                label=f"B: {line.label}",
                time=two_logs.onto(pairs, line.time),
                color=_paler(line.color),
                dashed=line.style == "line",
                sigma=None,
            )
            for line in other.lines
        ]
        ours = [dc.replace(line, label=f"A: {line.label}", sigma=None) for line in plot.lines]
        if ours or theirs:
            out.append(dc.replace(plot, lines=theirs + ours, note=""))
    return out


def _paler(color: str) -> str:
    return "#" + "".join(f"{round(0.45 * int(color[k : k + 2], 16) + 0.55 * 255):02x}" for k in (1, 3, 5))
