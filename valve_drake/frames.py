"""Every frame letter, axis and sign of the program, in one place.

SI units and radians. Drake's monogram notation: X_AB pose of B in A, p_AB position of B's origin from A's in A,
R_AB rotation, V_AB = [w; v], F = [torque; force].

    W  world (simulation only; controllers never use it)
    O  odometry: where the base stood at the start; what controllers use as a world. It drifts against W.
    B  base: on the floor, x forward, y left, z up; the frame that robot.yaml names
    L, R  head cameras: x right, y down, z forward; pixel (0, 0) is the centre of the first pixel (OpenCV)
    A  the valve's axis: origin on it at the grip plane, z along it into the panel; turns with the valve
    V  marker: origin at the rectangle's centre, z into the panel; `valve.marker` says where it is in A
    (the wrist cameras have no letter: they are not calibrated, and no code may use their lens or mounting)
    G, K  left and right hand, at the grip point: z approach, y closing direction, x = y cross z (along the bar)
    S, T  left and right wrist sensor: the child's frame of the fixed joint that robot.yaml names

Valve angle: positive is counter-clockwise as seen from the robot = about -z of A; `valve.opens` says which sense opens.
"""

import math

import numpy as np

_SKEW = np.zeros((3, 9))  # v @ _SKEW is [v]x row by row
_SKEW[0, [7, 5]], _SKEW[1, [2, 6]], _SKEW[2, [3, 1]] = (1, -1), (1, -1), (1, -1)


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """Axis times angle of a rotation matrix (3, 3) -> (3,), angle in [0, pi]."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()  # of so few numbers a quarter of numpy's time
    x, y, z = (h - f) / 2, (c - g) / 2, (d - b) / 2
    sine, cosine = math.sqrt(x * x + y * y + z * z), (a + e + i - 1) / 2
    if sine > 1e-7 or cosine > 0:
        scale = math.atan2(sine, cosine) / sine if sine > 1e-7 else 1.0
        return np.array([x * scale, y * scale, z * scale])
    k = int(np.argmax(np.diag(R)))  # half a turn: the axis is the longest column of R + I
    axis = (R + np.eye(3))[:, k]
    return axis * (np.pi / np.linalg.norm(axis))


def rotation(w: np.ndarray) -> np.ndarray:
    """exp([w]x): rotation matrix of axis times angle (3,) -> (3, 3)."""
    x, y, z = np.asarray(w, float).tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    a = math.sin(angle) / angle if angle > 1e-8 else 1.0
    b = 2 * (math.sin(angle / 2) / angle) ** 2 if angle > 1e-8 else 0.5
    return np.array(
        [
            [1 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1 - b * (x * x + y * y)],
        ]
    )


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a x b of (3,) or (n, 3); ten times as fast as np.cross on a few vectors, and called many times in every tick."""
    flat = a.ndim == b.ndim == 1  # then plain floats are the faster ones
    (ax, ay, az), (bx, by, bz) = (a.tolist(), b.tolist()) if flat else (a.T, b.T)
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]).T


def skew(v: np.ndarray) -> np.ndarray:
    """[v]x with [v]x u = v cross u: (..., 3) -> (..., 3, 3)."""
    rows: np.ndarray = v @ _SKEW
    return rows.reshape(*rows.shape[:-1], 3, 3)


def rot_x(a: float) -> np.ndarray:
    c, s = np.cos(a), np.sin(a)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def rot_y(a: float) -> np.ndarray:
    c, s = np.cos(a), np.sin(a)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rot_z(a: float) -> np.ndarray:
    c, s = np.cos(a), np.sin(a)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def make(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """[R | p] -> (3, 4)."""
    X = np.empty((3, 4))
    X[:, :3], X[:, 3] = R, p
    return X


def compose(*X: np.ndarray) -> np.ndarray:
    """X_AB X_BC ... -> (3, 4)."""
    out = X[0]
    for nxt in X[1:]:
        product = out[:, :3] @ nxt
        product[:, 3] += out[:, 3]
        out = product
    return out


def inverse(X: np.ndarray) -> np.ndarray:
    """X_AB -> X_BA (3, 4)."""
    return make(X[:, :3].T, -X[:, :3].T @ X[:, 3])


def stepped(X: np.ndarray, step: np.ndarray) -> np.ndarray:
    """X (3, 4) turned about its own axes by step[:3] [rad], and displaced by step[3:] [m]."""
    return make(X[:, :3] @ rotation(step[:3]), X[:, 3] + step[3:])


def apply(X: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Points (..., 3) moved by X."""
    return p @ X[:, :3].T + X[:, 3]


def planar(x: float, y: float, heading: float) -> np.ndarray:
    """X_OB of a base on the floor -> (3, 4)."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.0]])


def wrap(angle: float, period: float = 2 * np.pi) -> float:
    """`angle` brought to [-period/2, period/2)."""
    return float((angle + period / 2) % period - period / 2)
