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

import numpy as np

from valve_drake.frames import compose, cross, make, planar, rot_x, rot_y, rot_z
from valve_drake.messages import LEFT, RIGHT

ARM_LIMITS = np.array([2.97, 2.09, 2.62, 3.32, 2.09, 3.14])  # +- [rad]
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
        to_yaw = np.array(self.neck_yaw)
        to_pitch = np.array(self.neck_pitch) - to_yaw
        to_eye = np.array(self.eye_left) - np.array(self.neck_pitch)
        optical = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
        return compose(
            make(rot_z(waist), np.zeros(3)),
            make(rot_z(yaw), to_yaw),
            make(rot_y(pitch), to_pitch),
            make(optical, to_eye),
        )

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
        near = np.zeros(6) if q_near is None else q_near
        R, p = X_HG[:, :3], X_HG[:, 3]
        w = p - self.hand * R[:, 2] - self.shoulder(side)
        x, y = np.hypot(w[0], w[2]), w[1]
        q1 = np.arctan2(-w[2], w[0])
        l1, l2 = self.upper_arm, self.forearm
        cos3 = (x * x + y * y - l1 * l1 - l2 * l2) / (2 * l1 * l2)
        if not abs(cos3) < 1:
            return None
        q3 = -lateral(side) * np.arccos(cos3)
        q2 = np.arctan2(y, x) - np.arctan2(l2 * np.sin(q3), l1 + l2 * np.cos(q3))
        M = (rot_y(q1) @ rot_z(q2 + q3)).T @ R @ R_G0.T
        best, cost = None, np.inf
        for sign in (1.0, -1.0):
            s5 = sign * np.hypot(M[1, 0], M[2, 0])
            q5 = np.arctan2(s5, M[0, 0])
            if abs(s5) < 1e-9:  # wrist straight: J4 and J6 turn about one axis; keep J4
                q4 = near[3]
                T = rot_x(q4).T @ M
                q6 = np.arctan2(T[2, 1], T[1, 1])
            else:
                q4 = np.arctan2(M[2, 0] / s5, M[1, 0] / s5)
                q6 = np.arctan2(M[0, 2] / s5, -M[0, 1] / s5)
            q = np.array([q1, q2, q3, q4, q5, q6])
            for k in (3, 5):
                q[k] += 2 * np.pi * np.round((near[k] - q[k]) / (2 * np.pi))
            q = np.where(
                np.abs(q) > ARM_LIMITS, q - np.sign(q) * 2 * np.pi, q
            )  # by a whole turn, where that is within the limits
            if np.any(np.abs(q) > ARM_LIMITS):
                continue
            c = np.sum(np.abs(q - near)[3:]) if q_near is not None else abs(q5 - lateral(side) * 1.3)
            if c < cost:
                best, cost = q, c
        return best

    def arm_margin(self, q: np.ndarray) -> float:
        """Distance of an arm pose from singularities and joint limits: 1 is comfortable, 0 at a limit, negative beyond.

        Elbow bend within 20..150 deg, wrist bend J5 within 12..118 deg, joints inside their limits.
        """
        bend, wrist = abs(q[2]), abs(q[4])
        parts = [
            (bend - np.deg2rad(20)) / np.deg2rad(25),
            (np.deg2rad(150) - bend) / np.deg2rad(25),
            (wrist - np.deg2rad(12)) / np.deg2rad(25),
            (np.deg2rad(118) - wrist) / np.deg2rad(25),
            *((ARM_LIMITS - np.abs(q)) / np.deg2rad(40)),
        ]
        return float(min(1.0, *parts))


def both_arms(left: np.ndarray) -> np.ndarray:
    """A pose of the left arm (6,) and its mirror image on the right -> (12,)."""
    return np.concatenate([left, left * MIRROR])


def lateral(side: str) -> float:
    """+1 on the left, -1 on the right."""
    return {LEFT: 1.0, RIGHT: -1.0}[side]


GEOMETRY = RobotGeometry()
