"""Stage 4: image-based servoing of both hands onto the taught image of their green marks. Wrist cameras uncalibrated.

The feature of a mark with centre (u, v) and area a is

    s = (u, v, 1) / sqrt(a)                                                     (1)

For a small plane mark and a held orientation sqrt(a) = c / Z, so s = M p / c with p the mark in the camera and M the
camera matrix: s is LINEAR in the hand's translation. Its Jacobian J = ds/dx (x: hand translation in the hand's own
frame) is one constant 3x3 matrix that holds intrinsics, depth and hand-eye together. It is taught once, at the
reference, by small moves of the hand; no intrinsics and no hand-eye transform are needed.

    e  = J^-1 (s - s*)        the hand's displacement from the reference, in its frame [m]    (2)
    dx = -gain e              per image, from where the hand was when the image was taken     (3)

A consequence of (1): moving straight along the camera's view only scales s, so the view direction in the hand's
frame is -J^-1 s* normalised; stand-offs are laid along it (grasp_geometry.standoff).

The orientation (of stage 2) is held and the gripper stays open. [Tahri, Chaumette: normalised moments]
"""

import copy
import dataclasses as dc

import numpy as np

from valve_drake.behaviors.taught import TaughtReference
from valve_drake.config import Config, number
from valve_drake.frames import make
from valve_drake.memory import changed
from valve_drake.messages import (
    LEFT,
    POSE_HISTORY,
    SIDES,
    Command,
    HandleMark,
    HandleMarks,
    Mode,
    ModeState,
    RobotState,
    ServoState,
    Status,
    Verdict,
)
from valve_drake.robot.kinematics import STRIDE, RobotKinematics

BLIND = 0.25  # without an image for so long a hand stands still; raise it for cameras slower than 4 Hz [s]


@dc.dataclass
class ImageServoConfig(Config):
    """Scenario key `image_servo`."""

    KEY = "image_servo"
    FORMER = {"sag": "max_droop"}
    gain: float = number(0.5, 0.01, 0.95, "of (3), per image; higher is faster, and oscillates near 1")
    speed: float = number(0.06, 0.005, 0.2, "of the hand, at most [m/s]")
    tolerance: float = number(
        0.0015, 2e-4, 0.02, "a hand this near to the reference has arrived; raise it for noisy marks [m]"
    )
    images_in_tolerance: int = number(3, 1, 30, "in a row, until it succeeds")
    lost_after: float = number(1.0, 0.1, 30.0, "without a mark, then it fails [s]")
    max_droop: float = number(
        0.003, 1e-4, 0.02, "tracking error that is compensated, at most; a larger one means contact [m]"
    )
    reach: float = number(0.20, 0.02, 0.5, "a hand farther than this from where servoing began has gone astray [m]")
    gripper_force: float = number(40.0, 5.0, 100.0, "of the finger actuator [N]")
    touch_force: float = number(10.0, 2.0, 60.0, "without a camera in the hand: a force that tells of a touch [N]")
    touch_reach: float = number(0.015, 0.002, 0.05, "the same: a touch so near to the grasp is the handle [m]")
    rest: float = number(0.3, 0.02, 5.0, "the same: both hands stand so long at their handles [s]")


@dc.dataclass(frozen=True)
class Hand:
    """One hand's part of the memory."""

    X_BG: np.ndarray  # commanded pose (3, 4)
    start: np.ndarray  # p_BG at the beginning
    goal: np.ndarray  # p_BG to move to, by the last image
    q: np.ndarray
    seen: int = -1
    seen_at: float = 0.0
    error: np.ndarray = dc.field(default_factory=lambda: np.full(3, np.nan))
    inside: int = 0  # images in tolerance in a row
    past: tuple[tuple[float, np.ndarray], ...] = ()  # time; measured grip point + tracking error (clipped to max_droop)


@dc.dataclass(frozen=True)
class Memory:
    """Everything between two steps."""

    activation: int = -1
    hands: dict[str, Hand] = dc.field(default_factory=dict)
    status: Status = Status()


class ImageServo:
    """The mathematics of the stage, for both hands."""

    def __init__(self, config: ImageServoConfig, robot: RobotKinematics, taught: dict[str, TaughtReference]):
        config.check()
        self.config = copy.copy(config)
        self.robot = robot
        self.taught = taught

    def step(
        self, time: float, dt: float, memory: Memory, state: RobotState, mode: ModeState, marks: HandleMarks
    ) -> tuple[Memory, Command, ServoState]:
        """One tick of length dt -> memory (with status), command, telemetry."""
        if mode.mode != Mode.SERVO:
            return Memory(), Command(time=time), ServoState(time=time)
        if memory.activation != mode.activation:
            hands = {side: self._begin(time, state, side) for side in SIDES}
            memory = Memory(mode.activation, hands, Status(time, mode.activation, "running"))
        hands = {side: self._hand(time, dt, memory.hands[side], state, side, getattr(marks, side)) for side in SIDES}
        status = memory.status
        if status.state == "running":
            status = self._judge(time, mode.activation, hands)
        gripper = np.array([self.robot.opening, self.config.gripper_force])
        command = Command(
            time=time,
            left_arm=hands["left"].q,
            right_arm=hands["right"].q,
            left_gripper=gripper,
            right_gripper=gripper,
        )
        enough = self.config.images_in_tolerance
        telemetry = ServoState(
            time=time,
            left_error=hands["left"].error,
            right_error=hands["right"].error,
            left_converged=hands["left"].inside >= enough,
            right_converged=hands["right"].inside >= enough,
        )
        return Memory(mode.activation, hands, status), command, telemetry

    def _begin(self, time: float, state: RobotState, side: str) -> Hand:
        q = state.left_arm if side == LEFT else state.right_arm
        X_BG = self.robot.forward(side, q, self.robot.held(state.torso))
        return Hand(X_BG=X_BG, start=X_BG[:, 3], goal=X_BG[:, 3], q=q, seen_at=time)

    def _hand(self, time: float, dt: float, hand: Hand, state: RobotState, side: str, mark: HandleMark) -> Hand:
        q = state.left_arm if side == LEFT else state.right_arm
        p_now = self.robot.forward(side, q, self.robot.held(state.torso))[:, 3]
        # A constant servo error would bias the hand: it is compensated.
        droop = hand.X_BG[:, 3] - p_now
        droop = droop * min(1.0, self.config.max_droop / max(float(np.linalg.norm(droop)), 1e-12))
        gone = int(bool(hand.past) and hand.past[0][0] < time - POSE_HISTORY)
        hand = changed(hand, past=(*hand.past[gone:], (time, p_now + droop)))
        if mark.found and mark.sequence != hand.seen and mark.time >= hand.past[0][0]:
            e = self.taught[side].displacement(mark.feature)
            R = hand.X_BG[:, :3]
            p_then = min(hand.past, key=lambda item: abs(item[0] - mark.time))[1]
            hand = changed(
                hand,
                seen=mark.sequence,
                seen_at=time,
                error=e,
                goal=p_then - self.config.gain * (R @ e),
                inside=hand.inside + 1 if np.linalg.norm(e) < self.config.tolerance else 0,
            )
        elif not mark.found and mark.sequence != hand.seen:
            hand = changed(hand, seen=mark.sequence, inside=0)
        if time - hand.seen_at > BLIND:
            hand = changed(hand, goal=hand.X_BG[:, 3])
        step = hand.goal - hand.X_BG[:, 3]
        most = self.config.speed * dt
        length = float(np.linalg.norm(step))
        p = hand.X_BG[:, 3] + step * min(1.0, most / max(length, 1e-12))
        X_BG = make(hand.X_BG[:, :3], p)
        solution = self.robot.inverse(side, X_BG, hand.q, self.robot.held(state.torso))
        if solution is None or np.max(np.abs(solution - hand.q)) > STRIDE:
            return hand  # out of reach, or the wrist would turn by far: keep the command
        return changed(hand, X_BG=X_BG, q=solution)

    def _judge(self, time: float, activation: int, hands: dict[str, Hand]) -> Status:
        c = self.config
        errors = ", ".join(f"{side} {1e3 * np.linalg.norm(hands[side].error):.1f} mm" for side in SIDES)
        for side, hand in hands.items():
            if time - hand.seen_at > c.lost_after:
                return Status(time, activation, "failed", Verdict.MARKER_LOST, f"{side} mark lost")
            if np.linalg.norm(hand.X_BG[:, 3] - hand.start) > c.reach:
                return Status(time, activation, "failed", Verdict.GRASP_MISSED, f"{side} hand ran away")
        if all(hand.inside >= c.images_in_tolerance for hand in hands.values()):
            return Status(time, activation, "succeeded", detail=errors, progress=1.0)
        return Status(time, activation, "running", detail=errors)
