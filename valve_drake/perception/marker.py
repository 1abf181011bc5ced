"""The target: a rectangle of known size on the valve, two green marks beside it on handles for the hands."""

import dataclasses as dc

import numpy as np

from valve_drake.checks import require, require_in

# Corners of the unit rectangle in V in their one order: clockwise as the camera sees them (V's z points into the
# panel). Side k joins corner k and corner k + 1: side 0 is y = -Y_w, 1 is x = +X_w, 2 is y = +Y_w, 3 is x = -X_w.
NEXT = [1, 2, 3, 0]
_UNIT_CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)


@dc.dataclass
class Marker:
    """Scenario key `marker`: what is known of the valve beforehand, in V (x along the handles, z into the panel)."""

    size: list[float] = dc.field(default_factory=lambda: [0.098, 0.100])  # 2 X_w, 2 Y_w [m]
    handle_radius: float = 0.15  # of the green marks from the axis, along +x and -x of V [m]
    mark_depth: float = 0.028  # of the green marks behind the rectangle's plane, along z of V [m]
    handle_depth: float = 0.041  # of the handles' centre line behind it [m]
    panel_depth: float = 0.131  # of the panel's surface behind it [m]
    handle_width: float = 0.025  # between the pads when grasped [m]

    def check(self) -> None:
        ok = len(self.size) == 2 and all(0.005 <= s <= 2.0 for s in self.size)
        require(ok, "marker.size", "two lengths within 0.005..2 m", self.size)
        require(max(self.size) <= 3 * min(self.size), "marker.size", "of an aspect up to 3:1", self.size)
        require_in(self.handle_radius, 0.6 * max(self.size), 5.0, "marker.handle_radius")
        require_in(self.mark_depth, -0.5, 0.5, "marker.mark_depth")
        require_in(self.handle_depth, 0.0, self.panel_depth, "marker.handle_depth")
        require_in(self.panel_depth, 0.0, 1.0, "marker.panel_depth")
        require_in(self.handle_width, 0.005, 0.08, "marker.handle_width")

    def corners(self) -> np.ndarray:
        """(4, 3) in V [m], clockwise as seen by the camera."""
        return _UNIT_CORNERS * [self.size[0] / 2, self.size[1] / 2, 0]

    def aspect(self) -> float:
        """Long side over short side, >= 1."""
        return max(self.size) / min(self.size)
