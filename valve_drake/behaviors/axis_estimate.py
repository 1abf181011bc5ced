"""The valve's axis as the turn shows it: hands that hold the valve move on circles about it.

The camera's axis is as good as the marker's place on the valve is known: a marker stuck on by hand is 10 mm and 3 deg
off. Two linear least squares, with what is known beforehand as their start:

    direction  p_k . (u + a x + b y) = h_k       hand k stays in a plane across the axis          (1)
    place      (p_1 + p_2) / 2 = c + d_1 b(t) + d_2 u x b(t)     the hands' middle circles it      (2)

x, y: across the axis u that the plan has; b(t): from the left hand to the right one. Known beforehand: a, b are zero
within TILT, h_2 - h_1 is that of the handles within DEPTH, d is that of the handles within MIDDLE. c is free.
"""

import dataclasses as dc
import math

import numpy as np

from valve_drake.frames import cross, wrap

TILT = 0.05  # standard deviation of the plan's direction [rad]
DEPTH = 0.002  # of one hand's grasp against the other's, along the axis [m]
MIDDLE = 0.0015  # of the hands' middle on the valve, across the axis [m]
FREE = 0.1  # of what nothing is known of [m]
NOISE = 0.0005  # of a hand's measured place, one sample [m]
BETWEEN = 0.01  # turned between two samples [rad]


@dc.dataclass(frozen=True, eq=False)
class AxisEstimate:
    """See the file. X_BA: of the plan; middle: of the handles, as of closed_chain.make_chain (2,) [m]."""

    X_BA: np.ndarray
    middle: np.ndarray
    at: float = math.inf  # turned at the last sample [rad]
    tilt: tuple[np.ndarray, np.ndarray] = (np.zeros((4, 4)), np.zeros(4))  # normal equations of a, b, h_1, h_2
    place: tuple[np.ndarray, np.ndarray] = (np.zeros((4, 4)), np.zeros(4))  # of c_x, c_y, d_1, d_2

    @staticmethod
    def begin(X_BA: np.ndarray, handles: np.ndarray) -> "AxisEstimate":
        """handles: of the left and of the right hand, in A (2, 3) [m]."""
        line, middle = handles[1, :2] - handles[0, :2], handles[:, :2].mean(axis=0)
        b = line / math.hypot(*line)
        d = np.array([middle @ b, middle @ [b[1], -b[0]]])  # u x b, for u = -z of A
        apart = -(handles[1, 2] - handles[0, 2])
        tilt = np.diag([TILT**-2, TILT**-2, FREE**-2, FREE**-2])
        row = np.array([0.0, 0.0, -1.0, 1.0]) / DEPTH
        place = np.diag([FREE**-2, FREE**-2, MIDDLE**-2, MIDDLE**-2])
        return AxisEstimate(
            X_BA=X_BA,
            middle=d,
            tilt=(tilt + np.outer(row, row), row * apart / DEPTH),
            place=(place, np.array([0.0, 0.0, *(d / MIDDLE**2)])),
        )

    @property
    def u(self) -> np.ndarray:
        """The axis towards the robot -> unit (3,)."""
        a, b = np.linalg.solve(*self.tilt)[:2]
        u = -self.X_BA[:, 2] + a * self.X_BA[:, 0] + b * self.X_BA[:, 1]
        direction: np.ndarray = u / math.sqrt(u @ u)
        return direction

    @property
    def offset(self) -> np.ndarray:
        """The hands' middle from the axis, as multiples of b and of u x b (2,) [m]."""
        offset: np.ndarray = np.linalg.solve(*self.place)[2:]
        return offset

    def add(self, p: np.ndarray, turned: float) -> "AxisEstimate":
        """With the hands at p (2, 3); turned: since the grasp [rad]. Samples are BETWEEN apart."""
        if math.isfinite(self.at) and abs(wrap(turned - self.at)) < BETWEEN:
            return self
        x, y, u = self.X_BA[:, 0], self.X_BA[:, 1], -self.X_BA[:, 2]
        off = p - self.X_BA[:, 3]
        H, g = self.tilt[0].copy(), self.tilt[1].copy()
        for k in range(2):
            row = np.array([off[k] @ x, off[k] @ y, -float(k == 0), -float(k == 1)]) / NOISE
            H += np.outer(row, row)
            g -= row * (off[k] @ u) / NOISE
        line = p[1] - p[0]
        line = line - u * (u @ line)
        b = line / math.sqrt(line @ line)
        s, middle = cross(u, b), off.mean(axis=0)
        P, q = self.place[0].copy(), self.place[1].copy()
        for axis in (x, y):
            row = np.array([float(axis is x), float(axis is y), axis @ b, axis @ s]) / NOISE
            P += np.outer(row, row)
            q += row * (axis @ middle) / NOISE
        return dc.replace(self, at=turned, tilt=(H, g), place=(P, q))
