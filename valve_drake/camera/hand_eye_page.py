"""The report of a hand-eye calibration as one self-contained HTML page."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from valve_drake.camera import calibration_page as pages


def page(numbers: dict[str, Any], corners: Sequence[np.ndarray], size: tuple[int, int]) -> str:
    """The page of a hand-eye calibration; corners (n, 2) of each view."""
    key, views = "X_BC" if numbers["eye_to_hand"] else "X_EC", numbers["per_view"]
    title = f"Hand-eye calibration: {key}"
    noise = numbers["noise"]
    figures = [
        (f"{numbers['residual_deg']:.3f} deg, {numbers['residual_mm']:.2f} mm", "by which the views disagree (rms)"),
        (f"{noise['arm_deg']:.3f} deg, {noise['arm_mm']:.2f} mm", "scatter of the arm about each axis"),
        (f"{noise['corner_px']:.2f} px", "noise of the corners"),
    ]
    marked = [view["outlier"] for view in views]
    told = f"{len(views) - sum(marked)} views used, written to {numbers['out']}"
    parts = [pages.head(title, told, numbers["warnings"], figures)]
    rows: list[Sequence[str]] = [[f"{value:.6f}" for value in row] for row in numbers["X_EC"]]
    parts += [f"<h2>{key}</h2>", pages.table(("x", "y", "z", "position [m]"), rows)]
    spread = numbers["X_EC_sigma"]
    rows = [(a, f"{d:.3g}", f"{p:.3g}") for a, d, p in zip("xyz", spread["rotation_deg"], spread["position_mm"])]
    parts += [
        "<h2>Standard deviations</h2>",
        "<p class='note'>From the noise of the corners and of the arm, both estimated from these views.</p>",
        pages.table(("axis", "rotation [deg]", "position [mm]"), rows),
        "<h2>Other methods on the same views</h2>",
        "<p class='note'>How well each foretells the board's pose in a view left out, and how far its result is from "
        "this one.</p>",
    ]
    ours = ("this one", f"{numbers['left_out_deg']:.3f}", f"{numbers['left_out_mm']:.2f}", "", "")
    columns = (("left_out_deg", 3), ("left_out_mm", 2), ("apart_deg", 3), ("apart_mm", 2))
    rows = [(name, *(f"{m[c]:.{digits}f}" for c, digits in columns)) for name, m in numbers["methods"].items()]
    parts.append(pages.table(("method", "left out [deg]", "left out [mm]", "apart [deg]", "apart [mm]"), [ours, *rows]))
    names = [view["image"] for view in views]
    parts += ["<h2>Views</h2>", pages.bars(names, [view["residual_mm"] for view in views], marked, "mm")]
    shown = ("rms_px", "residual_deg", "residual_mm", "left_out_deg", "left_out_mm", "deviations")
    rows = [(view["image"], *(f"{view[column]:.3f}" for column in shown)) for view in views]
    head = ("view", "rms [px]", "deg", "mm", "deg, view left out", "mm, view left out", "standard deviations")
    parts += [pages.table(head, rows, marked), "<h2>Coverage</h2>"]
    return pages.page(title, [*parts, pages.corner_map(corners, None, size, "corners of all views")])
