"""hybrid_rotation: two hands as stiff springs on a bar with dry friction. It turns as commanded, shares the load, bleeds
forces, and tells a seized valve, an end stop and a lost grip apart."""

import dataclasses as dc

import numpy as np
import pytest
from helpers import Rig, assert_clones_are_independent, assert_holds_between_updates, ports

from valve_drake.behaviors import hybrid_rotation
from valve_drake.behaviors.grasp_geometry import hand_in_valve, turned
from valve_drake.behaviors.hybrid_rotation import (
    HybridRotation,
    HybridRotationConfig,
    Memory,
    contact_wrench,
    gravity_wrench,
    make_chain,
    turn_rate,
    twists,
)
from valve_drake.behaviors.hybrid_rotation_system import HybridRotationSystem
from valve_drake.checks import ConfigError
from valve_drake.frames import compose, cross, inverse, make, rot_y, rot_z, rotation, rotation_vector
from valve_drake.kinematics import GEOMETRY
from valve_drake.messages import LEFT, RIGHT, SIDES, Command, GraspPlan, Mode, ModeState, RobotState, Status
from valve_drake.perception.marker import Marker
from valve_drake.ports import TICK

CONFIG = HybridRotationConfig()
MARKER = Marker()
VIEW = {LEFT: np.array([-0.5, 0, 0.866]), RIGHT: np.array([0.5, 0, 0.866])}
QUARTER = np.pi / 2
FACING = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # R_HV of a valve straight ahead
OPEN = np.array([CONFIG.opening, CONFIG.open_force])

STIFFNESS = 80e3  # of an arm's joint servos, at the grip point [N/m]
ANGULAR = 9e3  # [N m/rad]


class Bench:
    """The arms' joint servos are springs between commanded and true hand poses; a command arrives one tick late; a hand
    that has closed on the bar is one body with it; the valve turns when the couple exceeds its dry friction.

    travel: lowest and highest angle of the valve, from where it stands at first [rad].
    spin: moment about the valve's axis beyond which pads spin on the bar [N m].
    off: standard error of the plan's position [m], and ten times that of its direction [rad].
    noise: of the wrist sensors' forces [N], and a hundredth of it of their torques [N m].
    """

    def __init__(
        self,
        friction: float = 5.1,
        *,
        travel: tuple[float, float] = (-10.0, 10.0),
        spin: float = 1.0,
        off: float = 0.002,
        seed: int = 0,
        noise: float = 0.3,
    ):
        self.rng = np.random.default_rng(seed)
        self.law = HybridRotation(CONFIG, MARKER, GEOMETRY, VIEW)
        self.friction, self.travel, self.spin = friction, travel, spin
        self.noise = noise
        self.bias = self.rng.normal(size=(2, 6)) * [0.1, 0.1, 0.1, 2, 2, 2]
        self.X_HV = make(FACING @ rot_y(0.05) @ rot_z(0.1), np.array([0.66, 0.01, -0.06]))
        seen = rotation(self.rng.normal(size=3) * off * 10)
        plan = make(self.X_HV[:, :3] @ seen, self.X_HV[:, 3] + self.rng.normal(size=3) * off)
        self.plan = GraspPlan(found=True, X_BV=compose(GEOMETRY.X_BH(), plan))
        self.angle = 0.0
        self.held: list[np.ndarray | None] = [None, None]  # X_VG of a hand that holds the bar
        self.slips = [False, False]  # a hand whose pads slide carries nothing, though it stays closed
        self.missing = [False, False]  # no bar between the pads of this hand
        self.X = [compose(plan, hand_in_valve(side, False, MARKER)) for side in SIDES]  # of the hands, true
        self.q = [GEOMETRY.arm_inverse(X, side) for X, side in zip(self.X, SIDES)]  # commanded, as the servos have it
        self.true = list(self.q)
        self.velocity = [np.zeros(6), np.zeros(6)]
        self.gripper = [OPEN[0], OPEN[0]]
        self.pressed = [0.0, 0.0]
        self.load = np.zeros((2, 6))  # on the hands at their grip points, in H
        self.memory = Memory()
        self.time, self.activation = 20.0, 0
        self.rows: list = []
        self.command = Command()

    # ------------------------------------------------------------ physics
    def springs(self, wanted: list[np.ndarray]) -> float:
        """Poses of the hands with the valve as it stands, and what the springs put on them -> couple on the valve."""
        X_HV, couple = turned(self.X_HV, self.angle), 0.0
        u = -X_HV[:, 2]
        for k, Xc in enumerate(wanted):
            holds = self.held[k] is not None and not self.slips[k]
            X = self.X[k] = compose(X_HV, self.held[k]) if holds else Xc
            m = -ANGULAR * rotation_vector(Xc[:, :3] @ X[:, :3].T)
            over = m @ u - np.clip(m @ u, -self.spin, self.spin)
            if holds and over:  # the pads spin on the bar
                X = self.X[k] = make(rotation(-over / ANGULAR * u) @ X[:, :3], X[:, 3])
                self.held[k], m = compose(inverse(X_HV), X), m - over * u
            f = -STIFFNESS * (Xc[:, 3] - X[:, 3])
            self.load[k] = *m, *f
            couple -= u @ (m + cross(X[:, 3] - X_HV[:, 3], f))
        return couple

    def turn_valve(self) -> None:
        stiffness = 2 * (STIFFNESS * MARKER.handle_radius**2 + ANGULAR)
        wanted = [GEOMETRY.arm_forward(q, side) for q, side in zip(self.q, SIDES)]
        couple = self.springs(wanted)
        for _ in range(3):
            over = couple - np.clip(couple, -self.friction, self.friction)
            if abs(over) < 1e-3:
                break
            self.angle = float(np.clip(self.angle + over / stiffness, *self.travel))
            couple = self.springs(wanted)

    def close(self, k: int, wanted: float, force: float) -> None:
        opening = self.gripper[k] + np.clip(wanted - self.gripper[k], -0.15 * TICK, 0.15 * TICK)
        self.pressed[k] = 0.0
        if opening <= MARKER.handle_width and not self.missing[k]:
            opening, self.pressed[k] = MARKER.handle_width, force
            if self.held[k] is None:
                self.held[k] = compose(inverse(turned(self.X_HV, self.angle)), self.X[k])
        elif opening > MARKER.handle_width + 1e-4:
            self.held[k] = None
        self.gripper[k] = opening

    def state(self) -> RobotState:
        raw = []
        for k, side in enumerate(SIDES):
            R = GEOMETRY.arm_forward(self.true[k], side)[:, :3]
            f, m = R.T @ self.load[k, 3:], R.T @ self.load[k, :3]
            at_sensor = np.concatenate([m + np.cross([0, 0, GEOMETRY.grip_behind], f), f])
            noise = self.rng.normal(size=6) * self.noise * np.array([0.01] * 3 + [1] * 3)
            raw.append(at_sensor + gravity_wrench(R, GEOMETRY, side) + self.bias[k] + noise)
        return RobotState(
            time=self.time,
            left_arm=self.true[0],
            right_arm=self.true[1],
            left_arm_velocity=self.velocity[0],
            right_arm_velocity=self.velocity[1],
            left_gripper=self.gripper[0],
            right_gripper=self.gripper[1],
            left_gripper_force=self.pressed[0],
            right_gripper_force=self.pressed[1],
            left_wrench=raw[0],
            right_wrench=raw[1],
        )

    # ------------------------------------------------------------ running
    def tick(self, mode: ModeState) -> Status:
        self.memory, command = self.law.step(self.time, TICK, self.memory, self.state(), mode, self.plan)
        if command.left_arm is not None:
            self.q = [command.left_arm, command.right_arm]
            self.close(0, *command.left_gripper)
            self.close(1, *command.right_gripper)
        self.command = command
        self.turn_valve()
        for k, side in enumerate(SIDES):
            q = GEOMETRY.arm_inverse(self.X[k], side, self.true[k])
            self.velocity[k] = (q - self.true[k]) / TICK
            self.true[k] = q
        self.time += TICK
        t = self.memory.telemetry
        self.rows.append((self.time, self.angle, t.angle, t.torque, t.share_left, *np.linalg.norm(self.load[:, 3:], axis=1)))
        return self.memory.status

    def run(self, mode: Mode, angle: float = 0.0, *, limit: float = 60.0, each=None) -> Status:
        """One activation until it ends (or `limit` seconds) -> its status. each(self) is called every tick."""
        self.activation += 1
        self.rows = []
        state = ModeState(mode=mode.value, activation=self.activation, turn_angle=angle)
        for _ in range(int(limit / TICK)):
            status = self.tick(state)
            if each is not None:
                each(self)
            if status.state in ("succeeded", "failed"):
                break
        return status

    def grasp(self) -> "Bench":
        """Stand-off (where the sensors are tared), then the grasp."""
        self.run(Mode.REACH, limit=1.0)
        status = self.run(Mode.GRASP)
        assert status.state == "succeeded", status.detail
        return self

    def record(self) -> np.ndarray:
        """Columns: time, true angle, angle by the hands, torque, left share, force of the left and the right hand."""
        return np.array(self.rows)
