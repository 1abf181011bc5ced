"""The target: a rectangle of known size on the valve, green marks beside it on handles for the hands."""

import dataclasses as dc
import math
from collections.abc import Sequence

import numpy as np

from valve_drake.checks import require
from valve_drake.frames import apply, inverse

# Corners of the unit rectangle in V in their one order: clockwise as the camera sees them (V's z points into the
# panel). Side k joins corner k and corner k + 1: side 0 is y = -Y_w, 1 is x = +X_w, 2 is y = +Y_w, 3 is x = -X_w.
NEXT = [1, 2, 3, 0]
MARK = (0.040, 0.022)  # a green mark: along its handle, across it [m]
MARKS = np.array([[0.15, 0.0, 0.028], [-0.15, 0.0, 0.028]])  # of our valve, in V [m]
_UNIT_CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)


@dc.dataclass(eq=False)
class Marker:
    """The rectangle, and green marks beside it.

    size: 2 X_w, 2 Y_w [m]; marks: their places in V (K, 3) [m]; X_VA: of a rectangle that does not turn with the valve,
    the valve's axis (z of A), about which the marks turn (3, 4); then `marks` are their places where the valve is at
    zero, and `along` the directions of their longer sides (K, 3). None: rectangle and marks turn together.
    """

    size: list[float] = dc.field(default_factory=lambda: [0.098, 0.100])
    marks: np.ndarray = dc.field(default_factory=lambda: MARKS.copy())
    X_VA: np.ndarray | None = None
    along: np.ndarray = dc.field(default_factory=lambda: np.zeros((0, 3)))

    @staticmethod
    def of(size: Sequence[float], radius: float = 0.15) -> "Marker":
        """With two marks along x, `radius` to both sides of it."""
        return Marker(list(size), MARKS * [radius / MARKS[0, 0], 1.0, 1.0])

    def check(self) -> None:
        """Raises ConfigError: no size, or no places of marks."""
        length = len(self.size) == 2 and all(math.isfinite(n) and 0.005 <= n <= 2.0 for n in self.size)
        require(length, "marker.size", "2 values within [0.005, 2]", self.size)
        require(max(self.size) <= 3 * min(self.size), "marker.size", "of an aspect up to 3:1", self.size)
        places = self.marks.ndim == 2 and self.marks.shape[1] == 3 and bool(np.isfinite(self.marks).all())
        require(places, "marker.marks", "places (K, 3)", self.marks.tolist())
        ways = self.X_VA is None or self.along.shape == self.marks.shape
        require(ways, "marker.along", "a direction for each of marker.marks", self.along.tolist())

    def corners(self) -> np.ndarray:
        """(4, 3) in V [m], clockwise as seen by the camera."""
        return _UNIT_CORNERS * [self.size[0] / 2, self.size[1] / 2, 0]

    def reach(self) -> float:
        """How far from the rectangle's middle a mark may be, in lengths of its longer side."""
        far = float(np.linalg.norm(self.marks, axis=1).max())
        if self.X_VA is not None:
            p = apply(inverse(self.X_VA), self.marks)
            far = float((np.hypot(*self.X_VA[:, 3][:2]) + np.hypot(p[:, 0], p[:, 1])).max())
        return far / max(self.size)

    def aspect(self) -> float:
        """Long side over short side, >= 1."""
        return max(self.size) / min(self.size)
