"""Stage 4 for hands without a camera (robot.yaml's `servo: none`): the last decimetre by the head's estimate and touch.

Both hands move straight from the stand-off to the grasps that were planned from the head's measurement, slowly. What
the estimate, the head's mount and the arms' encoders are off has to fit between the open fingers; the fingers then
centre themselves on the handle, since the arms yield while they close (hybrid_rotation), and its tug proves the grasp.

A force on a wrist sensor that has changed by `touch_force` since the hand began is a touch: the hand stops there. It
has arrived if it was nearly at the grasp (`touch_reach`: it stands on the handle), else it has missed.
"""

import copy
import dataclasses as dc
import math

import numpy as np

from valve_drake.behaviors.image_servo import ImageServoConfig
from valve_drake.frames import make
from valve_drake.memory import changed
from valve_drake.messages import (
    LEFT,
    SIDES,
    Command,
    GraspPlan,
    Mode,
    ModeState,
    RobotState,
    ServoState,
    Status,
    Verdict,
)
from valve_drake.robot.kinematics import STRIDE, RobotKinematics

STRAIGHT = np.array([0.0, 0.0, 1.0])  # the way of a hand to its handle, in its frame
TICKS = 3  # in a row that a touch takes


@dc.dataclass(frozen=True)
class Hand:
    """One hand's part of the memory."""

    X_BG: np.ndarray  # commanded pose (3, 4)
    q: np.ndarray
    load: np.ndarray  # raw force at the beginning (3,) [N]
    touching: int = 0  # ticks in a row
    stopped: bool = False  # by a touch


@dc.dataclass(frozen=True)
class Memory:
    """Everything between two steps."""

    activation: int = -1
    hands: dict[str, Hand] = dc.field(default_factory=dict)
    arrived_at: float = math.inf  # when both hands were there [s]
    status: Status = Status()


class BlindServo:
    """The mathematics of the stage, for both hands; it takes image_servo's place in the diagram."""

    def __init__(self, config: ImageServoConfig, robot: RobotKinematics):
        config.check()
        self.config = copy.copy(config)
        self.robot = robot

    def step(
        self, time: float, dt: float, memory: Memory, state: RobotState, mode: ModeState, plan: GraspPlan
    ) -> tuple[Memory, Command, ServoState]:
        """One tick of length dt -> memory (with status), command, telemetry."""
        if mode.mode != Mode.SERVO:
            return Memory(), Command(time=time), ServoState(time=time)
        m = memory
        if m.activation != mode.activation:
            hands = {side: self._begin(state, side) for side in SIDES}
            m = Memory(mode.activation, hands, status=Status(time, mode.activation, "running"))
        goals = {side: getattr(plan, f"X_BG_{side}")[:, 3] for side in SIDES}
        if m.status.state == "running":
            hands = {side: self._hand(dt, m.hands[side], state, side, goals[side]) for side in SIDES}
            m = self._judge(time, changed(m, hands=hands), goals)
        errors = {side: m.hands[side].X_BG[:, :3].T @ (m.hands[side].X_BG[:, 3] - goals[side]) for side in SIDES}
        gripper = np.array([self.robot.opening, self.config.gripper_force])
        command = Command(
            time=time,
            left_arm=m.hands["left"].q,
            right_arm=m.hands["right"].q,
            left_gripper=gripper,
            right_gripper=gripper,
        )
        done = m.status.state == "succeeded"
        telemetry = ServoState(
            time=time,
            left_error=errors["left"],
            right_error=errors["right"],
            left_converged=done,
            right_converged=done,
        )
        return m, command, telemetry

    def _begin(self, state: RobotState, side: str) -> Hand:
        q = state.left_arm if side == LEFT else state.right_arm
        wrench = state.left_wrench if side == LEFT else state.right_wrench
        return Hand(self.robot.forward(side, q, self.robot.held(state.torso)), q, wrench[3:])

    def _hand(self, dt: float, hand: Hand, state: RobotState, side: str, goal: np.ndarray) -> Hand:
        c = self.config
        wrench = state.left_wrench if side == LEFT else state.right_wrench
        felt = math.hypot(*(wrench[3:] - hand.load).tolist())
        touching = 0 if felt < c.touch_force else hand.touching + 1  # NaN counts
        hand = changed(hand, touching=touching, stopped=hand.stopped or touching >= TICKS)
        step = goal - hand.X_BG[:, 3]
        left = float(np.linalg.norm(step))
        if hand.stopped or left < 1e-9:
            return hand
        X_BG = make(hand.X_BG[:, :3], hand.X_BG[:, 3] + step * min(1.0, c.speed * dt / left))
        q = self.robot.inverse(side, X_BG, hand.q, self.robot.held(state.torso))
        if q is None or np.max(np.abs(q - hand.q)) > STRIDE:
            return hand  # out of reach, or the wrist would turn by far: keep the command
        return changed(hand, X_BG=X_BG, q=q)

    def _judge(self, time: float, m: Memory, goals: dict[str, np.ndarray]) -> Memory:
        c = self.config
        left = {side: float(np.linalg.norm(goals[side] - hand.X_BG[:, 3])) for side, hand in m.hands.items()}
        far = {side: f"{side} {1e3 * left[side]:.0f} mm" for side in SIDES}
        words = ", ".join(f"{far[side]} (touched)" if m.hands[side].stopped else far[side] for side in SIDES)
        for side, hand in m.hands.items():
            if hand.stopped and left[side] > c.touch_reach:
                detail = f"{side} hand touched something {1e3 * left[side]:.0f} mm before its handle"
                status = Status(time, m.activation, "failed", Verdict.GRASP_MISSED, detail)
                return changed(m, status=status)
        there = all(hand.stopped or left[side] < 1e-6 for side, hand in m.hands.items())
        m = changed(m, arrived_at=min(m.arrived_at, time) if there else math.inf)
        if time - m.arrived_at >= c.rest:
            return changed(m, status=Status(time, m.activation, "succeeded", detail=words, progress=1.0))
        return changed(m, status=Status(time, m.activation, "running", detail=words))
