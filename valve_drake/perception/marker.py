"""The target: a rectangle of known size on the valve, two green marks beside it on handles for the hands."""

import dataclasses as dc

import numpy as np

from valve_drake.checks import require
from valve_drake.config import Config, number, numbers

# Corners of the unit rectangle in V in their one order: clockwise as the camera sees them (V's z points into the
# panel). Side k joins corner k and corner k + 1: side 0 is y = -Y_w, 1 is x = +X_w, 2 is y = +Y_w, 3 is x = -X_w.
NEXT = [1, 2, 3, 0]
_UNIT_CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)


@dc.dataclass
class Marker(Config):
    """Scenario key `marker`: what is known of the valve beforehand, in V (x along the handles, z into the panel)."""

    KEY = "marker"
    size: list[float] = numbers([0.098, 0.100], 0.005, 2.0, "2 X_w, 2 Y_w [m]")
    handle_radius: float = number(0.15, 0.003, 5.0, "of the green marks from the axis, along +x and -x of V [m]")
    mark_depth: float = number(0.028, -0.5, 0.5, "of the green marks behind the rectangle's plane, along z of V [m]")
    handle_depth: float = number(0.041, 0.0, 1.0, "of the handles' centre line behind it [m]")
    panel_depth: float = number(0.131, 0.0, 1.0, "of the panel's surface behind it [m]")
    handle_width: float = number(0.025, 0.005, 0.08, "between the pads when grasped [m]")

    def relations(self, key: str) -> None:
        require(max(self.size) <= 3 * min(self.size), f"{key}.size", "of an aspect up to 3:1", self.size)
        least = 0.6 * max(self.size)
        outside = self.handle_radius >= least
        require(outside, f"{key}.handle_radius", f"outside the rectangle, at least {least:g}", self.handle_radius)
        before = self.handle_depth <= self.panel_depth
        require(before, f"{key}.handle_depth", f"at most panel_depth, {self.panel_depth:g}", self.handle_depth)

    def corners(self) -> np.ndarray:
        """(4, 3) in V [m], clockwise as seen by the camera."""
        return _UNIT_CORNERS * [self.size[0] / 2, self.size[1] / 2, 0]

    def aspect(self) -> float:
        """Long side over short side, >= 1."""
        return max(self.size) / min(self.size)
