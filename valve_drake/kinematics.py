"""Forward and inverse kinematics of arms and head in closed form, and the robot's dimensions.

Arm (both sides alike, lateral offset mirrored; at zero it points straight forward):

    J1 about y at the shoulder, J2 and J3 (elbow) about z, J4 about x, J5 about z, J6 about x, the last three through
    the wrist's centre. The first axis is lateral, so upper arm and forearm lie in a plane that holds the axis through
    both shoulders, and the elbow points outward in it.

Inverse (X_HG given): wrist centre w = p_HG - hand z_G - p_HS;  q1 = atan2(-w_z, w_x) turns the plane onto it;
in the plane (x', y') = (hypot(w_x, w_z), w_y) the two links are a plane triangle:
cos q3 = (x'^2 + y'^2 - l1^2 - l2^2) / (2 l1 l2), elbow out;
then R_x(q4) R_z(q5) R_x(q6) = (R_y(q1) R_z(q2 + q3))^T R_HG R_G0^T.

Frames: frames.py. The numbers below are those of models/robot/robot.sdf; a test holds them to the file.
"""

import dataclasses as dc
import functools
import math

import numpy as np

from valve_drake.frames import compose, cross, make, planar, rot_x, rot_y, rot_z
from valve_drake.messages import LEFT, RIGHT

ARM_LIMITS = np.array([2.97, 2.09, 2.62, 3.32, 2.09, 3.14])  # +- [rad]
_AT_ORIGIN = np.zeros(3)
_LIMITS = tuple(ARM_LIMITS.tolist())
MIRROR = np.array([1.0, -1, -1, -1, -1, -1])  # left arm to right arm: all axes but the lateral J1 change sign
R_G0 = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # R_HG at zero: x_G = y_H, y_G = z_H, z_G = x_H


@dc.dataclass(frozen=True)
class RobotGeometry:
    """Dimensions [m], and the mass that each wrist sensor carries."""

    shoulder_half_width: float = 0.20
    shoulder_height: float = 1.05  # of H over the floor
    upper_arm: float = 0.36
    forearm: float = 0.34
    hand: float = 0.24  # wrist centre to grip point
    grip_behind: float = 0.14  # wrist sensor to grip point, along z_G
    hand_mass: float = 0.86  # everything beyond the sensor [kg]
    p_SHand: tuple[float, float, float] = (0.0065, 0.0, 0.0433)  # its centre of mass in the (left) sensor's frame
    neck_yaw: tuple[float, float, float] = (-0.03, 0.0, 1.27)  # in B, at waist = 0
    neck_pitch: tuple[float, float, float] = (-0.03, 0.0, 1.36)
    eye_left: tuple[float, float, float] = (0.02, 0.06, 1.42)

    # ------------------------------------------------------------ head
    def X_BL(self, torso: np.ndarray) -> np.ndarray:
        """Left head camera in the base for torso = (waist twist, neck pitch, neck yaw) -> (3, 4)."""
        waist, pitch, yaw = torso
        to_yaw, to_pitch, to_eye = self._head_links
        return compose(make(rot_z(waist), _AT_ORIGIN), make(rot_z(yaw), to_yaw), make(rot_y(pitch), to_pitch), to_eye)

    @functools.cached_property
    def _head_links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """From the waist to the neck's yaw axis (3,), on to its pitch axis (3,), and on to the left eye (3, 4)."""
        to_yaw = np.array(self.neck_yaw)
        to_pitch = np.array(self.neck_pitch) - to_yaw
        to_eye = np.array(self.eye_left) - np.array(self.neck_pitch)
        return to_yaw, to_pitch, make(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), to_eye)

    def head_pose(self, base: np.ndarray, torso: np.ndarray) -> np.ndarray:
        """X_OL for base = (x, y, heading) in O -> (3, 4)."""
        return compose(planar(*base), self.X_BL(torso))

    # ------------------------------------------------------------ arms
    def shoulder(self, side: str) -> np.ndarray:
        """p_HS, the shoulder in the chest -> (3,)."""
        return np.array([0.0, self.shoulder_half_width * lateral(side), 0.0])

    def X_BH(self, waist: float = 0.0) -> np.ndarray:
        return make(rot_z(waist), np.array([0, 0, self.shoulder_height]))

    def arm_forward(self, q: np.ndarray, side: str) -> np.ndarray:
        """X_HG of one arm (6,) -> (3, 4)."""
        R1 = rot_y(q[0])
        R2 = R1 @ rot_z(q[1])
        R3 = R2 @ rot_z(q[2])
        R = R3 @ rot_x(q[3]) @ rot_z(q[4]) @ rot_x(q[5])
        p = self.shoulder(side) + R2[:, 0] * self.upper_arm + R3[:, 0] * self.forearm + R[:, 0] * self.hand
        return make(R @ R_G0, p)

    def arm_jacobian(self, q: np.ndarray, side: str) -> np.ndarray:
        """J with V_HG = J q' ([w; v] of the grip point, in H) -> (6, 6)."""
        R1 = rot_y(q[0])
        R2 = R1 @ rot_z(q[1])
        R3 = R2 @ rot_z(q[2])
        R4 = R3 @ rot_x(q[3])
        R5 = R4 @ rot_z(q[4])
        shoulder = self.shoulder(side)
        elbow = shoulder + R2[:, 0] * self.upper_arm
        wrist = elbow + R3[:, 0] * self.forearm
        grip = wrist + R5[:, 0] * self.hand
        axes = [
            (np.array([0.0, 1, 0]), shoulder),
            (R1[:, 2], shoulder),
            (R2[:, 2], elbow),
            (R3[:, 0], wrist),
            (R4[:, 2], wrist),
            (R5[:, 0], wrist),
        ]
        return np.array([np.concatenate([a, cross(a, grip - p)]) for a, p in axes]).T

    def arm_inverse(self, X_HG: np.ndarray, side: str, q_near: np.ndarray | None = None) -> np.ndarray | None:
        """Joint angles (6,) with the elbow out, or None when out of reach or beyond a joint limit.

        J4 and J6 are taken as near as possible to `q_near` (zero by default); both wrist branches are tried.
        """
        near = [0.0] * 6 if q_near is None else q_near.tolist()
        rows = X_HG.tolist()
        if not all(map(math.isfinite, [*rows[0], *rows[1], *rows[2], *near[3:]])):
            return None
        # Plain floats: numpy takes five times as long for so few numbers, and both arms need this at every tick.
        (x_x, y_x, z_x, p_x), (x_y, y_y, z_y, p_y), (x_z, y_z, z_z, p_z) = rows  # x_G, y_G, z_G, p_HG, each in H
        w_x = p_x - self.hand * z_x
        w_y = p_y - self.hand * z_y - self.shoulder_half_width * lateral(side)
        w_z = p_z - self.hand * z_z
        x, y = math.hypot(w_x, w_z), w_y
        q1 = math.atan2(-w_z, w_x)
        l1, l2 = self.upper_arm, self.forearm
        cos3 = (x * x + y * y - l1 * l1 - l2 * l2) / (2 * l1 * l2)
        if not abs(cos3) < 1:
            return None
        q3 = -lateral(side) * math.acos(cos3)
        q2 = math.atan2(y, x) - math.atan2(l2 * math.sin(q3), l1 + l2 * math.cos(q3))
        # M = (R_y(q1) R_z(q2 + q3))^T R_HG R_G0^T; the columns of R_HG R_G0^T are z_G, x_G, y_G.
        c1, s1, c, s = math.cos(q1), math.sin(q1), math.cos(q2 + q3), math.sin(q2 + q3)
        M_00 = c1 * c * z_x + s * z_y - s1 * c * z_z
        M_01 = c1 * c * x_x + s * x_y - s1 * c * x_z
        M_02 = c1 * c * y_x + s * y_y - s1 * c * y_z
        M_10 = -c1 * s * z_x + c * z_y + s1 * s * z_z
        M_20 = s1 * z_x + c1 * z_z
        best, cost = None, math.inf
        for sign in (1.0, -1.0):
            s5 = sign * math.hypot(M_10, M_20)
            q5 = math.atan2(s5, M_00)
            if abs(s5) < 1e-9:  # wrist straight: J4 and J6 turn about one axis; keep J4
                q4 = near[3]
                M_11 = -c1 * s * x_x + c * x_y + s1 * s * x_z
                M_21 = s1 * x_x + c1 * x_z
                q6 = math.atan2(math.cos(q4) * M_21 - math.sin(q4) * M_11, math.cos(q4) * M_11 + math.sin(q4) * M_21)
            else:
                q4 = math.atan2(M_20 / s5, M_10 / s5)
                q6 = math.atan2(M_02 / s5, -M_01 / s5)
            q4, q6 = (q + math.tau * round((n - q) / math.tau) for q, n in ((q4, near[3]), (q6, near[5])))
            angles = [
                q - math.copysign(math.tau, q) if abs(q) > limit else q  # by a whole turn, where that is within
                for q, limit in zip((q1, q2, q3, q4, q5, q6), _LIMITS)
            ]
            if any(abs(q) > limit for q, limit in zip(angles, _LIMITS)):
                continue
            if q_near is None:
                far = abs(q5 - lateral(side) * 1.3)
            else:
                far = sum(abs(q - n) for q, n in zip(angles[3:], near[3:]))
            if far < cost:
                best, cost = angles, far
        return None if best is None else np.array(best)

    def arm_margin(self, q: np.ndarray) -> float:
        """Distance of an arm pose from singularities and joint limits: 1 is comfortable, 0 at a limit, negative beyond.

        Elbow bend within 20..150 deg, wrist bend J5 within 12..118 deg, joints inside their limits.
        """
        angles = [math.degrees(abs(angle)) for angle in q.tolist()]
        bend, wrist = angles[2], angles[4]
        inside = min(math.degrees(limit) - angle for limit, angle in zip(_LIMITS, angles))
        return min(1.0, (bend - 20) / 25, (150 - bend) / 25, (wrist - 12) / 25, (118 - wrist) / 25, inside / 40)


def both_arms(left: np.ndarray) -> np.ndarray:
    """A pose of the left arm (6,) and its mirror image on the right -> (12,)."""
    return np.concatenate([left, left * MIRROR])


def lateral(side: str) -> float:
    """+1 on the left, -1 on the right."""
    return {LEFT: 1.0, RIGHT: -1.0}[side]


GEOMETRY = RobotGeometry()
