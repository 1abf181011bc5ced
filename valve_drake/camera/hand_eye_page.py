"""The report of a hand-eye calibration as one self-contained HTML page."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from valve_drake.camera import calibration_page as pages


def page(numbers: dict[str, Any], corners: Sequence[np.ndarray], size: tuple[int, int]) -> str:
    """The page of a hand-eye calibration; corners (n, 2) of each view."""
    key, views = "X_BC" if numbers["eye_to_hand"] else "X_EC", numbers["per_view"]
    title = f"Hand-eye calibration: {key}"
    figures = [
        (f"{numbers['residual_mm']:.2f} mm, {numbers['residual_deg']:.3f} deg", "by which the views disagree (rms)"),
        (f"{numbers['rms_px']:.2f} px", "rms of the corners"),
    ]
    told = f"{len(views)} views, written to {numbers['out']}"
    parts = [pages.head(title, told, numbers["warnings"], figures)]
    rows = [[f"{value:.6f}" for value in row] for row in numbers["X_EC"]]
    parts += [f"<h2>{key}</h2>", pages.table(("x", "y", "z", "position [m]"), rows)]
    spread = numbers["X_EC_sigma"]
    rows = [(a, f"{d:.3g}", f"{p:.3g}") for a, d, p in zip("xyz", spread["rotation_deg"], spread["position_mm"])]
    parts += ["<h2>Standard deviations</h2>", "<p class='note'>By leaving out one view at a time.</p>"]
    parts += [pages.table(("axis", "rotation [deg]", "position [mm]"), rows), "<h2>Views</h2>"]
    names = [view["image"] for view in views]
    parts.append(pages.bars(names, [view["residual_mm"] for view in views], [False] * len(views), "mm"))
    columns = ("rms_px", "residual_deg", "residual_mm", "left_out_deg", "left_out_mm")
    rows = [(view["image"], *(f"{view[column]:.3f}" for column in columns)) for view in views]
    parts.append(pages.table(("view", "rms [px]", "deg", "mm", "deg, view left out", "mm, view left out"), rows))
    return pages.page(
        title, [*parts, "<h2>Coverage</h2>", pages.corner_map(corners, None, size, "corners of all views")]
    )
