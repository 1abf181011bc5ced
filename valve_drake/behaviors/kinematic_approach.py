"""Stage 3: the arms by forward and inverse kinematics; and the measurements at rest before and after the turn.

In each mode:
    idle, search, approaches  holds the arms at home
    measure   several frames at rest -> the valve's pose in the base, and the grasps that stance_planner finds for it
    reach     a collision-free joint path of both arms to the stand-off before the handles, offset along the wrist
              cameras' view; ends on arrival, or before when both green marks are large enough in the wrist images
    fold      both arms home along a collision-free path
    verify    several frames at rest: the angle that the camera measures decides
    retreat   holds home

Paths and grasps are searched by stance_planner: a request goes out (Memory.request), the arms stand still until its
answer is there.

Frames: frames.py. The base stands still from measure to verify.
"""

import copy
import dataclasses as dc
from typing import Any, NamedTuple

import numpy as np

from valve_drake.behaviors.joint_path import Path
from valve_drake.config import Config, number
from valve_drake.frames import compose, inverse, planar, wrap
from valve_drake.memory import changed
from valve_drake.messages import (
    LEFT,
    RIGHT,
    SIDES,
    Cause,
    Command,
    GraspPlan,
    HandleMarks,
    Mode,
    ModeState,
    PathPlan,
    PlanRequest,
    RectangleEstimate,
    RobotState,
    Status,
    TurnState,
    Verdict,
)
from valve_drake.perception.fusion import fuse
from valve_drake.robot.kinematics import RobotKinematics
from valve_drake.task.modes import TABLE
from valve_drake.valve.valve import Valve, angle_turned, turned


@dc.dataclass
class KinematicApproachConfig(Config):
    """Scenario key `kinematic_approach`."""

    KEY = "kinematic_approach"
    joint_speed: float = number(0.9, 0.05, 2.5, "of the fastest joint of a path [rad/s]")
    joint_acceleration: float = number(2.0, 0.1, 20.0, "[rad/s^2]")
    settle: float = number(0.3, 0.05, 5.0, "stillness before a measurement [s]")
    rest: float = number(0.8, 0.05, 10.0, "stillness at the stand-off, in which the wrist sensors are tared [s]")
    frames: int = number(6, 1, 50, "estimates in one measurement at rest; more are slower and more accurate")
    mark_ratio: float = number(
        0.9, 0.3, 1.5, "reaching ends early when sqrt(area) of both green marks is this share of the taught one"
    )
    gripper_force: float = number(40.0, 5.0, 100.0, "while opening [N]")
    angle_tolerance: float = number(0.035, 0.002, 0.2, "camera angle against the command that counts as turned [rad]")
    still_rate: float = number(
        0.0017, 1e-4, 0.05, "a valve that turns slower stands still; its final angle is taken then [rad/s]"
    )
    still_time: float = number(
        1.5, 0.2, 10.0, "estimates of so long tell how fast it turns; longer tells a slower drift [s]"
    )
    look_time: float = number(
        8.0, 0.5, 60.0, "verify gives up looking after this: no marker, or the valve does not stand still [s]"
    )


@dc.dataclass(frozen=True)
class Memory:
    """Everything between two steps."""

    activation: int = -1
    mode: str = ""
    phase: str = ""
    since: float = 0.0  # of the phase [s]
    q: np.ndarray = dc.field(default_factory=lambda: np.zeros(0))  # command of both arms, left first [rad]
    path: Path | None = None
    looks: tuple[RectangleEstimate, ...] = ()
    seen: int = -1  # sequence of the newest estimate used
    covariance: np.ndarray = dc.field(default_factory=lambda: np.zeros((6, 6)))  # of the valve that was measured
    request: PlanRequest = PlanRequest()  # the last one
    X_OA0: np.ndarray | None = None  # the valve before this run turned it
    X_OA: np.ndarray | None = None  # the valve as it was measured last
    counted: float = 0.0  # turned in this run until then, by the camera [rad]
    plan: GraspPlan = GraspPlan()
    status: Status = Status()


class Inputs(NamedTuple):
    """What the block reads in a tick."""

    state: RobotState
    mode: ModeState
    estimate: RectangleEstimate
    marks: HandleMarks
    turn: TurnState
    grasps: GraspPlan  # the answers of stance_planner
    path: PathPlan


# Modes in which another block moves the arms; on return the commands start from the measured joints.
NOT_OWNED = tuple(mode for mode, row in TABLE.items() if row.hands != "kinematic_approach")
STILL = 0.005  # lift and waist have not moved by more in the last second: they stand [rad, m]
AGREE = 0.1  # camera and hands, on a turn in which nothing slipped [rad]
NEAR = 1.5  # a valve farther from the base than this is no obstacle to the arms [m]


class KinematicApproach:
    """The mathematics of the stage. reference_area: of each green mark in the taught image [px^2]."""

    def __init__(
        self,
        config: KinematicApproachConfig,
        robot: RobotKinematics,
        valve: Valve,
        reference_area: dict[str, float],
    ):
        config.check()
        self.config = copy.copy(config)
        self._X_VA = valve.X_VA()
        self.robot = robot
        self.reference_area = reference_area
        self.home = self.robot.home

    # ------------------------------------------------------------ the step
    def step(self, time: float, memory: Memory, inputs: Inputs) -> tuple[Memory, Command]:
        """One tick -> new memory (with status, plan and request in it), command."""
        state, mode, turn = inputs.state, inputs.mode, inputs.turn
        measured = np.concatenate([state.left_arm, state.right_arm])
        m = memory
        mine_again = m.activation < 0 or (mode.activation != m.activation and m.mode in NOT_OWNED)
        if mode.activation != m.activation:
            m = changed(m, activation=mode.activation, mode=mode.mode, phase="start", since=time, looks=())
            m = changed(m, status=Status(time=time, activation=mode.activation, state="idle"))
        if mine_again or mode.mode in NOT_OWNED:
            m = changed(m, q=measured, path=None)
        if mode.mode == Mode.IDLE and m.X_OA0 is not None:
            m = changed(m, X_OA0=None)  # a new run counts from its own beginning
        if mode.mode in NOT_OWNED:
            return m, Command(time=time)
        run = {
            Mode.MEASURE: self._measure,
            Mode.REACH: self._reach,
            Mode.FOLD: self._fold,
            Mode.VERIFY: self._verify,
        }
        if mode.mode in run:
            m = run[Mode(mode.mode)](time, m, inputs)
        else:
            m = self._homing(time, m, self._valve(m, state, turn) if m.phase == "start" else None, inputs)
        if m.path is not None:
            m = changed(m, q=m.path.sample(time))
        gripper = np.array([self.robot.opening, self.config.gripper_force])
        arms = self.robot.split(m.q)
        command = Command(
            time=time, left_arm=arms[LEFT], right_arm=arms[RIGHT], left_gripper=gripper, right_gripper=gripper
        )
        return m, command

    def _status(
        self, m: Memory, time: float, state: str, verdict: str = "", detail: str = "", cause: str = Cause.NONE
    ) -> Memory:
        return changed(m, status=Status(time, m.activation, state, verdict, detail, cause=str(cause)))

    def _valve(self, m: Memory, state: RobotState, turn: TurnState) -> np.ndarray | None:
        """X_BA of the valve that was measured last, turned as the hands left it; None if there is none near."""
        if m.X_OA is None:
            return None
        since = self._by_hands(m, turn) - m.counted
        X_BA = compose(inverse(planar(*state.odometry[:3])), turned(m.X_OA, since))
        return X_BA if np.hypot(*X_BA[:2, 3]) < NEAR else None

    def _by_hands(self, m: Memory, turn: TurnState) -> float:
        """How far the valve was turned in this run: by the camera until the last plan, and since by the hands [rad]."""
        return turn.angle if turn.number == m.plan.number >= 0 else m.counted

    def _homing(self, time: float, m: Memory, X_BA: np.ndarray | None, inputs: Inputs) -> Memory:
        """Brings the arms home along a free path, once per activation; m.path is the move, phase "home" on arrival.

        X_BA: of a valve to keep clear of; read in phase "start" alone.
        """
        if m.phase == "start":
            m = self._move(time, m, self.home, X_BA, inputs.state.posture)
        m = self._follow(time, m, inputs.path)
        if m.phase == "moving" and (m.path is None or time >= m.path.end()):
            m = changed(m, phase="home", since=time)
        return m

    def _ask(self, m: Memory, kind: str, X_BA: np.ndarray | None, **what: Any) -> Memory:
        request = PlanRequest(m.request.number + 1, kind, X_BA is not None, np.eye(3, 4) if X_BA is None else X_BA)
        return changed(m, request=dc.replace(request, **what))

    def _move(self, time: float, m: Memory, goal: np.ndarray, X_BA: np.ndarray | None, posture: np.ndarray) -> Memory:
        """Asks for a path from the present command to `goal`: phase "planning"; "moving" if there is no way to go."""
        m = changed(m, path=None, since=time)
        if np.max(np.abs(goal - m.q)) < 1e-6:
            return changed(m, phase="moving")
        return changed(self._ask(m, "path", X_BA, posture=posture, start=m.q, goal=goal), phase="planning")

    def _follow(self, time: float, m: Memory, answer: PathPlan) -> Memory:
        """Takes the path that was asked for: phase "moving", or "blocked" if there is none."""
        if m.phase != "planning" or answer.number != m.request.number:
            return m
        if not answer.found:
            return changed(m, phase="blocked", since=time)
        points = answer.points.reshape(-1, len(self.home))
        path = Path(points, time, self.config.joint_speed, self.config.joint_acceleration)
        return changed(m, phase="moving", path=path, since=time)

    # ------------------------------------------------------------ measure
    def _look(self, time: float, m: Memory, estimate: RectangleEstimate) -> Memory:
        """Gathers estimates whose images were taken after `since` + settle."""
        if estimate.found and estimate.sequence != m.seen and estimate.time >= m.since + self.config.settle:
            m = changed(m, looks=(*m.looks, estimate), seen=estimate.sequence)
        return m

    def _measure(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(changed(m, phase="look", since=time), time, "running")
        if m.phase == "planning":
            return self._plan(time, m, inputs.grasps)
        if m.phase != "look":
            return m
        m = self._look(time, m, inputs.estimate)
        if len(m.looks) < self.config.frames:
            return m
        fused = fuse(m.looks)
        if not fused.found:
            return self._status(changed(m, phase="end"), time, "failed", Verdict.MARKER_LOST, fused.reason)
        past = inputs.state.history[:, 4:-2]
        if past.size and not np.max(np.ptp(past, axis=0)) <= STILL:
            return m  # lift or waist is on its way
        X_OA = compose(fused.X_OV, self._X_VA)
        X_BA = compose(inverse(planar(*inputs.state.odometry[:3])), X_OA)
        counted = 0.0
        if m.X_OA0 is not None:
            counted = self.seen_angle(m.X_OA0, X_OA, fused.axis_known, self._by_hands(m, inputs.turn))
        first = X_OA if m.X_OA0 is None else m.X_OA0
        m = changed(m, phase="planning", X_OA0=first, X_OA=X_OA, counted=counted, covariance=fused.covariance)
        m = changed(m, plan=GraspPlan())  # what the hands did by it is counted
        return self._ask(m, "grasps", X_BA, posture=inputs.state.posture, turn_angle=inputs.mode.turn_angle - counted)

    def _plan(self, time: float, m: Memory, grasps: GraspPlan) -> Memory:
        """Takes the grasps that were asked for."""
        if grasps.number != m.request.number:
            return m
        m = changed(m, phase="end")
        if not grasps.found:
            detail = f"arm margin {grasps.margin:.2f} from here"
            return self._status(m, time, "failed", Verdict.REACH_LIMIT, detail, cause=Cause.STANCE)
        p = grasps.X_BA[:, 3]
        detail = f"valve {np.hypot(p[0], p[1]):.3f} m ahead, {p[2]:.3f} m high, margin {grasps.margin:.2f}"
        m = changed(m, plan=dc.replace(grasps, time=time, covariance=m.covariance, turned=m.counted))
        return self._status(m, time, "succeeded", detail=detail)

    # ------------------------------------------------------------ reach
    def _reach(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(m, time, "running")
            m = self._move(time, m, m.plan.q_standoff, m.plan.X_BA, m.plan.posture)
        if m.phase == "planning":
            m = self._follow(time, m, inputs.path)
            if m.phase == "blocked":
                return self._status(m, time, "failed", Verdict.REACH_LIMIT, "no collision-free path to the handles")
        if m.phase == "moving":
            arrived = m.path is None or time >= m.path.end()
            near = all(self._mark_ratio(inputs.marks, side) >= self.config.mark_ratio for side in SIDES)
            if arrived or near:
                why = "at the stand-off" if arrived else "marks are large enough"
                m = changed(m, phase="rest", since=time, path=m.path if arrived else None)
                m = self._status(m, time, "running", detail=why)
        if m.phase == "rest" and time >= m.since + self.config.rest:
            m = self._status(changed(m, phase="end"), time, "succeeded", detail=m.status.detail)
        return m

    def _mark_ratio(self, marks: HandleMarks, side: str) -> float:
        mark = getattr(marks, side)
        return float(np.sqrt(mark.area / self.reference_area[side])) if mark.found else 0.0

    # ------------------------------------------------------------ fold
    def _fold(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(m, time, "running")
        if m.phase in ("start", "planning", "moving"):
            m = self._homing(time, m, self._valve(m, inputs.state, inputs.turn), inputs)
            if m.phase == "blocked":
                return self._status(m, time, "failed", Verdict.REACH_LIMIT, "no collision-free path home")
        if m.phase == "home":
            m = self._status(changed(m, phase="end"), time, "succeeded", detail="arms home")
        return m

    # ------------------------------------------------------------ verify
    def _verify(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(changed(m, phase="look", since=time), time, "running")
        if m.phase != "look":
            return m
        m = self._look(time, m, inputs.estimate)
        newest = m.looks[-1].time if m.looks else 0.0
        m = changed(m, looks=tuple(look for look in m.looks if look.time >= newest - self.config.still_time))
        drift = self._drift(m.looks)
        if drift is None or abs(drift) > self.config.still_rate:
            patient = time - m.since <= self.config.look_time
            return m if patient else self._unverified(m, time, inputs.mode, inputs.turn, drift)
        fused = fuse(m.looks)
        m = changed(m, phase="end")
        if not fused.found or m.X_OA0 is None:
            return self._status(m, time, "failed", Verdict.MARKER_LOST, fused.reason)
        seen = self.seen_angle(
            m.X_OA0, compose(fused.X_OV, self._X_VA), fused.axis_known, self._by_hands(m, inputs.turn)
        )
        asked, tolerance = inputs.mode.turn_angle, self.config.angle_tolerance
        detail = f"camera sees {np.degrees(seen):.2f} deg of {np.degrees(asked):.2f} deg"
        if abs(asked - seen) <= tolerance:
            return changed(m, status=self._seen(time, m, "succeeded", Verdict.NONE, detail, seen))
        hands = self._by_hands(m, inputs.turn)
        if not inputs.mode.verdict and abs(asked - hands) > tolerance and abs(hands - seen) < AGREE:
            # The turn ended as it should, where the arms reach no farther.
            status = self._seen(time, m, "failed", Verdict.REACH_LIMIT, detail, seen)
            return changed(m, status=dc.replace(status, cause=Cause.REGRASP.value))
        return changed(m, status=self._seen(time, m, "failed", Verdict.SLIP, detail, seen))

    def _drift(self, looks: tuple[RectangleEstimate, ...]) -> float | None:
        """How fast the valve turns, by the slope of its angle over the looks [rad/s]; None: too few of them to tell.

        A valve without friction goes on turning when the hands let go of it: its angle at one moment is no result.
        """
        if len(looks) < self.config.frames or looks[-1].time - looks[0].time < 0.8 * self.config.still_time:
            return None
        poses = [compose(look.X_OL, look.X_LV, self._X_VA) for look in looks]
        slopes = [  # of all pairs: their median is not moved by one wrong estimate
            # the rectangle repeats every quarter turn
            wrap(angle_turned(poses[i], poses[k]), np.pi / 2) / (looks[k].time - looks[i].time)
            for k in range(len(looks))
            for i in range(k)
        ]
        return float(np.median(slopes))

    def _unverified(self, m: Memory, time: float, mode: ModeState, turn: TurnState, drift: float | None) -> Memory:
        """The camera cannot say how far the valve is turned: what the hands felt is told, and not taken for it."""
        asked, felt = np.degrees(mode.turn_angle), np.degrees(self._by_hands(m, turn))
        hands = f"hands turned {felt:.2f} deg of {asked:.2f} deg"
        m = changed(m, phase="end")
        if drift is None or m.X_OA0 is None:
            return self._status(m, time, "failed", Verdict.UNVERIFIED, f"camera does not see the marker, {hands}")
        fused = fuse(m.looks[-1:])
        seen = self.seen_angle(m.X_OA0, compose(fused.X_OV, self._X_VA), fused.axis_known, self._by_hands(m, turn))
        camera = f"camera sees {np.degrees(seen):.2f} deg, turning by {np.degrees(drift):+.2f} deg/s"
        status = self._seen(time, m, "failed", Verdict.UNVERIFIED, f"{camera}, {hands}", seen)
        return changed(m, status=status)

    def _seen(self, time: float, m: Memory, state: str, verdict: str, detail: str, angle: float) -> Status:
        """A status with the angle that the camera saw [rad]."""
        return Status(time, m.activation, state, verdict, detail, 1.0, angle, seen=True)

    def seen_angle(self, X_OA0: np.ndarray, X_OA1: np.ndarray, axis_known: bool, by_hands: float) -> float:
        """The turned angle by camera [rad]. The rectangle repeats every quarter turn, with the green marks every half:
        the branch nearest to what the hands felt is taken, the value is the camera's."""
        period = np.pi if axis_known else np.pi / 2
        return by_hands + wrap(angle_turned(X_OA0, X_OA1) - by_hands, period)
