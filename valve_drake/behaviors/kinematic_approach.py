"""Stage 3: the arms by forward and inverse kinematics; and the measurements at rest before and after the turn.

In each mode:
    idle, search, approaches  holds the arms at home; fine_approach: computes the stance from every good estimate
    measure   several frames at rest -> the valve's pose in the base and the grasps (GraspPlan)
    reach     a collision-free joint path of both arms to the stand-off before the handles, offset along the wrist
              cameras' view; ends on arrival, or before when both green marks are large enough in the wrist images
    fold      both arms home along a collision-free path
    verify    several frames at rest: the angle that the camera measures decides
    retreat   holds home

Frames: frames.py. The base stands still from measure to verify.
"""

import copy
import dataclasses as dc
from typing import NamedTuple

import numpy as np

from valve_drake.behaviors.grasp_geometry import Stances, angle_turned, hand_in_valve, standoff, turned
from valve_drake.behaviors.joint_path import Path, find_path
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
    RectangleEstimate,
    RobotState,
    Stance,
    Status,
    TurnState,
    Verdict,
)
from valve_drake.perception.fusion import fuse
from valve_drake.robot.kinematics import OUTWARD, RobotKinematics
from valve_drake.task.modes import TABLE


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
    stance_period: float = number(0.5, 0.1, 10.0, "between two computations of the stance [s]")
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
    stance_looks: tuple[RectangleEstimate, ...] = ()
    stance: Stance = Stance()
    stance_at: float = -1e9  # when it was computed [s]
    X_OV0: np.ndarray | None = None  # the valve before the turn
    plan: GraspPlan = GraspPlan()
    status: Status = Status()


class Inputs(NamedTuple):
    """What the block reads in a tick."""

    state: RobotState
    mode: ModeState
    estimate: RectangleEstimate
    marks: HandleMarks
    turn: TurnState


# Modes in which another block moves the arms; on return the commands start from the measured joints.
NOT_OWNED = tuple(mode for mode, row in TABLE.items() if row.hands != "kinematic_approach")
OFF_HOME = 0.005  # of lift and waist while the hands work; it displaces them by as much a meter away [rad, m]
NEAR = 1.5  # a valve farther from the base than this is no obstacle to the arms [m]


class KinematicApproach:
    """The mathematics of the stage.

    stances: where the hands can turn the valve from; they hold robot, marker and view.
    reference_area: of each green mark in the taught image [px^2].
    """

    def __init__(self, config: KinematicApproachConfig, stances: Stances, reference_area: dict[str, float]):
        config.check()
        stances.config.check()
        stances.marker.check()
        self.config = copy.copy(config)
        self.stances = dc.replace(
            stances, config=copy.copy(stances.config), marker=copy.copy(stances.marker), view=dict(stances.view)
        )
        self.robot: RobotKinematics = stances.robot
        self.reference_area = reference_area
        self.home = self.robot.home

    # ------------------------------------------------------------ the step
    def step(
        self,
        time: float,
        memory: Memory,
        state: RobotState,
        mode: ModeState,
        estimate: RectangleEstimate,
        marks: HandleMarks,
        turn: TurnState,
    ) -> tuple[Memory, Command]:
        """One tick -> new memory (with status, stance and plan in it), command. `watch_stance` follows it."""
        measured = np.concatenate([state.left_arm, state.right_arm])
        m = memory
        mine_again = m.activation < 0 or (mode.activation != m.activation and m.mode in NOT_OWNED)
        if mode.activation != m.activation:
            m = changed(m, activation=mode.activation, mode=mode.mode, phase="start", since=time, looks=())
            m = changed(m, status=Status(time=time, activation=mode.activation, state="idle"))
        if mine_again or mode.mode in NOT_OWNED:
            m = changed(m, q=measured, path=None)
        if mode.mode in NOT_OWNED:
            return m, Command(time=time)
        run = {
            Mode.MEASURE: self._measure,
            Mode.REACH: self._reach,
            Mode.FOLD: self._fold,
            Mode.VERIFY: self._verify,
        }
        if mode.mode in run:
            m = run[Mode(mode.mode)](time, m, Inputs(state, mode, estimate, marks, turn))
        else:
            if mode.mode == Mode.SEARCH:
                m = changed(m, stance=Stance(), stance_looks=())
            m = self._homing(time, m, self._valve(m, state, turn) if m.phase == "start" else None)
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
        """X_BV of the valve that was measured last, turned as the hands left it; None if there is none near."""
        if m.X_OV0 is None:
            return None
        X_BV = compose(inverse(planar(*state.odometry[:3])), turned(m.X_OV0, turn.angle))
        return X_BV if np.hypot(*X_BV[:2, 3]) < NEAR else None

    def _homing(self, time: float, m: Memory, X_BV: np.ndarray | None) -> Memory:
        """Brings the arms home along a free path, once per activation; m.path is the move, phase "home" on arrival.

        X_BV: of a valve to keep clear of; read in phase "start" alone.
        """
        if m.phase == "start":
            m = self._move(time, m, self.home, X_BV)
        if m.phase == "moving" and (m.path is None or time >= m.path.end()):
            m = changed(m, phase="home", since=time)
        return m

    def _move(self, time: float, m: Memory, goal: np.ndarray, X_BV: np.ndarray | None) -> Memory:
        """Plans a path from the present command to `goal`; phase "moving", or "blocked" if there is none."""
        if np.max(np.abs(goal - m.q)) < 1e-6:
            return changed(m, phase="moving", path=None, since=time)
        arms, split = self.robot.arms, self.robot.split

        def is_free(q: np.ndarray) -> bool:
            return all(arms[side].within(part) for side, part in split(q).items()) and self.stances.is_free(X_BV, q)

        points = find_path(m.q, goal, self._vias(m.q, goal, X_BV), is_free)
        if points is None:
            return changed(m, phase="blocked", path=None, since=time)
        path = Path(points, time, self.config.joint_speed, self.config.joint_acceleration)
        return changed(m, phase="moving", path=path, since=time)

    def _vias(self, q: np.ndarray, goal: np.ndarray, X_BV: np.ndarray | None) -> list[np.ndarray]:
        """Via poses: both hands drawn straight back from the end of the path at the valve; nearly always free."""
        if X_BV is None:
            return []
        at_valve = self.robot.split(q if np.allclose(goal, self.home) else goal)
        out: list[np.ndarray] = []
        for back in (0.10, 0.16, 0.22):
            arms = []
            for side in SIDES:
                X_BG = standoff(self.robot.forward(side, at_valve[side]), np.array([0.0, 0, 1]), back)
                X_BG[1, 3] += OUTWARD[side] * back / 2
                arms.append(self.robot.inverse(side, X_BG, at_valve[side]))
            reached = [q for q in arms if q is not None]
            if len(reached) == len(arms):
                out.append(np.concatenate(reached))
        return out

    # ------------------------------------------------------------ stance
    def watch_stance(self, time: float, m: Memory, mode: ModeState, estimate: RectangleEstimate) -> Memory:
        """Computes the stance, in fine_approach. Slow (up to two ticks), and no command of this tick needs it."""
        return self._find_stance(time, m, mode, estimate) if mode.mode == Mode.FINE_APPROACH else m

    def _find_stance(self, time: float, m: Memory, mode: ModeState, estimate: RectangleEstimate) -> Memory:
        """The stance from the last few estimates: those from nearby are better, so old ones are dropped."""
        if not estimate.found or estimate.sequence == m.seen:
            return m
        looks = (*m.stance_looks, estimate)[-5:]
        m = changed(m, seen=estimate.sequence, stance_looks=looks)
        if m.stance.found and time - m.stance_at < self.config.stance_period:
            return m
        m = changed(m, stance_at=time)
        fused = fuse(looks)
        if not fused.found:
            return m
        base, margin = self.stances.find(fused.X_OV, mode.turn_angle)
        good = margin >= self.stances.config.margin_min
        reason = "" if good else f"no stance holds both handles through the turn (margin {margin:.2f})"
        return changed(m, stance=Stance(time=estimate.time, found=good, base=base, margin=margin, reason=reason))

    # ------------------------------------------------------------ measure
    def _look(self, time: float, m: Memory, estimate: RectangleEstimate) -> Memory:
        """Gathers estimates whose images were taken after `since` + settle."""
        if estimate.found and estimate.sequence != m.seen and estimate.time >= m.since + self.config.settle:
            m = changed(m, looks=(*m.looks, estimate), seen=estimate.sequence)
        return m

    def _measure(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(changed(m, phase="look", since=time), time, "running")
        if m.phase != "look":
            return m
        m = self._look(time, m, inputs.estimate)
        if len(m.looks) < self.config.frames:
            return m
        fused = fuse(m.looks)
        if not fused.found:
            return self._status(changed(m, phase="end"), time, "failed", Verdict.MARKER_LOST, fused.reason)
        posture = self.robot.posture
        off = np.abs(inputs.state.torso[: len(posture)] - posture.home)
        if len(posture) and not np.max(off) <= OFF_HOME:
            k = int(np.argmax(off))
            stands = inputs.state.torso[k]
            detail = f"{posture.names[k]} stands at {stands:.3f}, the arms reach from {posture.home[k]:.3f}"
            return self._status(changed(m, phase="end"), time, "failed", Verdict.FAULT, detail)
        X_BV = compose(inverse(planar(*inputs.state.odometry[:3])), fused.X_OV)
        arc = self.stances.best_arc(X_BV, inputs.mode.turn_angle)
        if arc.margin < self.stances.config.margin_min:
            m = self._find_stance(time, changed(m, stance_looks=m.looks, seen=-1), inputs.mode, inputs.estimate)
            detail = f"arm margin {arc.margin:.2f} from here"
            return self._status(
                changed(m, phase="end"), time, "failed", Verdict.REACH_LIMIT, detail, cause=Cause.STANCE
            )
        grasps = {side: compose(X_BV, hand_in_valve(side, arc.swapped, self.stances.marker)) for side in SIDES}
        plan = GraspPlan(
            time=time,
            found=True,
            X_BV=X_BV,
            covariance=fused.covariance,
            swapped=arc.swapped,
            X_BG_left=grasps[LEFT],
            X_BG_right=grasps[RIGHT],
            margin=arc.margin,
        )
        m = changed(m, phase="end", plan=plan, X_OV0=fused.X_OV)
        detail = f"valve {np.linalg.norm(X_BV[:2, 3]):.3f} m ahead, {X_BV[2, 3]:.3f} m high, margin {arc.margin:.2f}"
        return self._status(m, time, "succeeded", detail=detail)

    # ------------------------------------------------------------ reach
    def _reach(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        plan = m.plan
        if m.phase == "start":
            m = self._status(m, time, "running")
            goal = self._standoff_joints(plan)
            if goal is None:
                return self._status(
                    changed(m, phase="end"), time, "failed", Verdict.REACH_LIMIT, "stand-off out of reach"
                )
            m = self._move(time, m, goal, plan.X_BV)
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

    def _standoff_joints(self, plan: GraspPlan) -> np.ndarray | None:
        arms = []
        for side in SIDES:
            X_BG = plan.X_BG_left if side == LEFT else plan.X_BG_right
            near = self.robot.inverse(side, X_BG)
            back = standoff(X_BG, self.stances.view[side], self.stances.config.standoff)
            arms.append(None if near is None else self.robot.inverse(side, back, near))
        reached = [q for q in arms if q is not None]
        return np.concatenate(reached) if len(reached) == len(arms) else None

    # ------------------------------------------------------------ fold
    def _fold(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(m, time, "running")
        if m.phase in ("start", "moving"):
            m = self._homing(time, m, turned(m.plan.X_BV, inputs.turn.angle))
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
        if not fused.found or m.X_OV0 is None:
            return self._status(m, time, "failed", Verdict.MARKER_LOST, fused.reason)
        seen = self.seen_angle(m.X_OV0, fused.X_OV, fused.axis_known, inputs.turn.angle)
        missing = abs(inputs.mode.turn_angle - seen)
        detail = f"camera sees {np.degrees(seen):.2f} deg of {np.degrees(inputs.mode.turn_angle):.2f} deg"
        state_now = "succeeded" if missing <= self.config.angle_tolerance else "failed"
        verdict = Verdict.NONE if state_now == "succeeded" else Verdict.SLIP
        return changed(m, status=self._seen(time, m, state_now, verdict, detail, seen))

    def _drift(self, looks: tuple[RectangleEstimate, ...]) -> float | None:
        """How fast the valve turns, by the slope of its angle over the looks [rad/s]; None: too few of them to tell.

        A valve without friction goes on turning when the hands let go of it: its angle at one moment is no result.
        """
        if len(looks) < self.config.frames or looks[-1].time - looks[0].time < 0.8 * self.config.still_time:
            return None
        poses = [compose(look.X_OL, look.X_LV) for look in looks]
        slopes = [  # of all pairs: their median is not moved by one wrong estimate
            # the rectangle repeats every quarter turn
            wrap(angle_turned(poses[i], poses[k]), np.pi / 2) / (looks[k].time - looks[i].time)
            for k in range(len(looks))
            for i in range(k)
        ]
        return float(np.median(slopes))

    def _unverified(self, m: Memory, time: float, mode: ModeState, turn: TurnState, drift: float | None) -> Memory:
        """The camera cannot say how far the valve is turned: what the hands felt is told, and not taken for it."""
        asked, felt = np.degrees(mode.turn_angle), np.degrees(turn.angle)
        hands = f"hands turned {felt:.2f} deg of {asked:.2f} deg"
        m = changed(m, phase="end")
        if drift is None or m.X_OV0 is None:
            return self._status(m, time, "failed", Verdict.UNVERIFIED, f"camera does not see the marker, {hands}")
        fused = fuse(m.looks[-1:])
        seen = self.seen_angle(m.X_OV0, fused.X_OV, fused.axis_known, turn.angle)
        camera = f"camera sees {np.degrees(seen):.2f} deg, turning by {np.degrees(drift):+.2f} deg/s"
        status = self._seen(time, m, "failed", Verdict.UNVERIFIED, f"{camera}, {hands}", seen)
        return changed(m, status=status)

    def _seen(self, time: float, m: Memory, state: str, verdict: str, detail: str, angle: float) -> Status:
        """A status with the angle that the camera saw [rad]."""
        return Status(time, m.activation, state, verdict, detail, 1.0, angle, seen=True)

    def seen_angle(self, X_OV0: np.ndarray, X_OV1: np.ndarray, axis_known: bool, by_hands: float) -> float:
        """The turned angle by camera [rad]. The rectangle repeats every quarter turn, with the green marks every half:
        the branch nearest to what the hands felt is taken, the value is the camera's."""
        period = np.pi if axis_known else np.pi / 2
        return by_hands + wrap(angle_turned(X_OV0, X_OV1) - by_hands, period)
