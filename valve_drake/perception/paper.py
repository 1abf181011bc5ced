"""`paper`: section 4 of the paper as printed, the pose in closed form, eq. (8)-(25).

n comes from the two sides parallel to X (both cameras: four equations), a from the two parallel to Y, the rough
position from all four, then the fine step through the area. The four sides' directions are vanishing points, which a
small rectangle hardly shows: 10 to 20 times the error of the bound at 1 to 2 m. The printed fine step is biased: its
eq. (22) and (23) take the tilt about one axis at a time, so equal tilts about both push the marker away.

n, o, a are the axes of V in the first camera, p its origin; X_w, Y_w half the rectangle's size [m]; q the ideal
corners (4, 3) with 1 appended.
"""

import math

import numpy as np

from valve_drake import frames
from valve_drake.perception.marker import NEXT
from valve_drake.perception.quadrilateral import meet, side_moments
from valve_drake.perception.rectangle_config import RectangleEstimatorConfig
from valve_drake.perception.refinement import Fit
from valve_drake.perception.views import View


def closed_form(
    corners: list[np.ndarray], X_CL: list[np.ndarray], model: np.ndarray, fine_step: str = "paper"
) -> tuple[np.ndarray, np.ndarray] | None:
    """Section 4 of the paper: R_LV (3, 3) and p_LV (3,), or None where it has no solution.

    corners: for each camera the (4, 2) ideal corners, side k (k to k + 1) being the model's side k of `model` (4, 3);
    X_CL: the left camera in each. The first camera gives a and p; all give n.
    """
    q = np.column_stack([corners[0], np.ones(4)])
    plane = [frames.cross(np.column_stack([c, np.ones(4)]), np.column_stack([c[NEXT], np.ones(4)])) for c in corners]
    R_0C = [X_CL[0][:, :3] @ X[:, :3].T for X in X_CL]
    # A model turned by a quarter has its sides parallel to X at 1 and 3.
    quarter = int(abs(model[0, 0] - model[1, 0]) < abs(model[0, 1] - model[1, 1]))
    x_sides, y_sides = ([1, 3], [0, 2]) if quarter else ([0, 2], [1, 3])
    n = _vector_n(np.vstack([plane[k][x_sides] @ R_0C[k].T for k in range(len(plane))]))
    # n points from low to high x: its sense in the image at the first such side.
    i = x_sides[0]
    j = NEXT[i]
    sense = (q[j] - q[i]) @ (n - n[2] * (q[i] + q[j]) / 2) * (model[j, 0] - model[i, 0])
    n = n if sense > 0 else -n
    a = _vector_a(n, q, y_sides)
    if a is None:
        return None
    o = frames.cross(a, n)
    R = np.column_stack([n, o, a])
    p = _position(R, q, model, x_sides, y_sides, fine_step)
    if p is None or p[2] <= 0:
        return None
    X = frames.compose(frames.inverse(X_CL[0]), frames.make(R, p))
    return X[:, :3], X[:, 3]


def _vector_n(m: np.ndarray) -> np.ndarray:
    """Eq. (8)-(10): unit n from the normals q_i x q_j (k, 3) of the planes through the sides parallel to X."""
    area = np.abs(m[0, 0] * m[1:, 1] - m[0, 1] * m[1:, 0]).max()
    if area > 1e-9 * (m[:, :2] ** 2).sum():  # eq. (9): divided by n_z
        n = np.append(np.linalg.lstsq(m[:, :2], -m[:, 2], rcond=None)[0], 1.0)
    else:  # eq. (10): n_z = 0
        m = m * np.sign(m @ m[0])[:, None]
        n = np.array([m[:, 1].sum(), -m[:, 0].sum(), 0.0])
    return n / np.linalg.norm(n)


def _vector_a(n: np.ndarray, q: np.ndarray, y_sides: list[int]) -> np.ndarray | None:
    """Eq. (13), (14): unit a from points on the two sides parallel to Y; each side has its own constant C'_2.

    The paper removes a'_x and divides by n_x. Where n_y is the larger, x and y change places.
    """
    x, y = (0, 1) if abs(n[0]) >= abs(n[1]) else (1, 0)
    rows, right = [], []
    for k, side in enumerate(y_sides):
        for point in (q[side], q[NEXT[side]]):
            row = [n[x] * point[y] - n[y] * point[x], 0.0, 0.0]
            row[1 + k] = -n[x] * (n @ point)
            rows.append(row)
            right.append(n[2] * point[x] - n[x])
    a_y = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0][0]
    a = np.empty(3)
    a[x], a[y], a[2] = -(n[2] + n[y] * a_y) / n[x], a_y, 1.0
    return a / np.linalg.norm(a) if np.isfinite(a).all() else None


def _position(
    R: np.ndarray, q: np.ndarray, model: np.ndarray, x_sides: list[int], y_sides: list[int], fine_step: str
) -> np.ndarray | None:
    """Rough position, eq. (15)-(18), then the fine step, eq. (20)-(25)."""
    n, o, a = R.T
    X_w, Y_w = np.abs(model[0, :2])

    def constant(axis: np.ndarray, side: int) -> float:  # C_1 of eq. (6) for o; 1 / C_2 of eq. (12) for n
        ends = q[[side, NEXT[side]]]
        return float(((ends @ axis) / (ends @ a)).mean())

    def high_low(axis: np.ndarray, sides: list[int], k: int) -> tuple[float, float]:
        values = sorted((model[side, k] + model[NEXT[side], k], constant(axis, side)) for side in sides)
        return values[1][1], values[0][1]

    C11, C12 = high_low(o, x_sides, 1)
    E21, E22 = high_low(n, y_sides, 0)  # 1 / C_21, 1 / C_22
    rows = np.array([2 * o - (C11 + C12) * a, (C11 - C12) * a, 2 * n - (E21 + E22) * a, (E21 - E22) * a])
    p = np.linalg.lstsq(rows, np.array([0, 2 * Y_w, 0, 2 * X_w]), rcond=None)[0]
    if fine_step == "none" or p[2] <= 0:
        return p
    b = p / p[2]
    if fine_step == "paper":  # eq. (22), (23), over p_z
        m_x = (q[:, 0] - b[0]) * math.hypot(a[0], a[2]) / (a[2] + a[0] * q[:, 0])
        m_y = (q[:, 1] - b[1]) * math.hypot(a[1], a[2]) / (a[2] + a[1] * q[:, 1])
    else:  # the ray's point in the plane through b
        X = q * ((a @ b) / (q @ a))[:, None] - b
        m_x, m_y = X @ n, X @ o
    S_1 = abs((m_x * m_y[NEXT] - m_x[NEXT] * m_y).sum()) / 2  # eq. (24)
    if not S_1 > 0:
        return None
    p_z = 2 * math.sqrt(X_w * Y_w / S_1)  # eq. (25)
    p_xy = np.linalg.solve(rows[[0, 2], :2], -rows[[0, 2], 2] * p_z)
    return np.append(p_xy, p_z)


def paper_pose(
    views: list[View], model: np.ndarray, config: RectangleEstimatorConfig
) -> tuple[Fit | None, np.ndarray | None, str]:
    """The closed form, and its covariance by propagating the sides' offsets and angles; or why there is none."""
    X_CL = [view.X_CL for view in views]

    def pose(lines: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
        return closed_form([meet(line) for line in lines], X_CL, model, config.fine_step)

    lines = [view.lines for view in views]
    found = pose(lines)
    if found is None:
        return None, None, "the closed form has no solution"
    R, p = found
    columns = []
    for c, view in enumerate(views):
        w = view.trust * (view.scale[view.side] / view.sigma) ** 2
        total, mean, S = side_moments(view.points, view.side, w)
        for k in range(4):
            normal = view.lines[k, :2]
            along = np.array([normal[1], -normal[0]])
            offset = 1 / math.sqrt(total[k]) + config.side_bias / view.focal
            angle = 1 / math.sqrt(max(along @ S[k] @ along, 1e-300))
            for change in ((0.0, offset), (angle, 0.0)):
                turned = normal + change[0] * along
                moved = [line.copy() for line in lines]
                moved[c][k] = [*turned, -(turned @ mean[k]) + change[1]]
                there = pose(moved)
                if there is None:
                    return None, None, "the closed form has no solution nearby"
                columns.append(np.append(frames.rotation_vector(R.T @ there[0]), there[1] - p))
        if view.bias.any():
            moved = [line.copy() for line in lines]
            moved[c][:, 2] += view.bias / view.scale
            there = pose(moved)
            if there is None:
                return None, None, "the closed form has no solution nearby"
            columns.append(np.append(frames.rotation_vector(R.T @ there[0]), there[1] - p))
    if config.fine_step == "paper":  # the printed step has a bias of its own, which the exact one shows
        exact = closed_form([meet(line) for line in lines], X_CL, model, "exact")
        if exact is not None:
            columns.append(np.append(np.zeros(3), exact[1] - p))
    J = np.array(columns)
    fit = Fit(R=R, p=p, yaw=0.0, cost=0.0, information=np.eye(6))
    return fit, J.T @ J, ""
