"""Stage 3: the memory, and motions of both arms along paths that stance_planner finds."""

import copy
import dataclasses as dc
from typing import Any, NamedTuple

import numpy as np

from valve_drake.behaviors.joint_path import Path
from valve_drake.behaviors.valve_search import MOVED
from valve_drake.config import Config, number
from valve_drake.frames import apply, compose, inverse, make, planar
from valve_drake.memory import changed
from valve_drake.messages import (
    SIDES,
    Cause,
    GraspPlan,
    HandleMarks,
    ModeState,
    PathPlan,
    PlanRequest,
    RectangleEstimate,
    RobotState,
    Status,
    TurnState,
)
from valve_drake.robot.kinematics import RobotKinematics
from valve_drake.valve.valve import Valve, turned


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
    p_OV: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))  # the marker, as it was measured last [m]
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


FRESH = 2.5  # an older estimate does not tell where the valve is now; before fold there is one every two seconds [s]
FARTHEST_MOVE = 1.5  # a marker that is seen farther from where it was is another one [m]
NEAR = 1.5  # a valve farther from the base than this is no obstacle to the arms, unless they reach as far [m]
ASIDE = 0.5  # by which a valve may be farther than the farthest stance: a stance may be to one side of it [m]


class Motion:
    """Both arms. reference_area: of each green mark in the taught image [px^2]."""

    def __init__(
        self,
        config: KinematicApproachConfig,
        robot: RobotKinematics,
        valve: Valve,
        reference_area: dict[str, float],
    ):
        config.check()
        self.config = copy.copy(config)
        self.valve = valve
        self.robot = robot
        self.reference_area = reference_area
        self.home = self.robot.home
        speeds = np.concatenate([robot.arms[side].speed for side in SIDES])
        self._limits = speeds if (speeds < config.joint_speed).any() else None

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
        return X_BA if np.hypot(*X_BA[:2, 3]) < max(NEAR, self.robot.stand[1] + ASIDE) else None

    def _shifted(self, time: float, m: Memory, estimate: RectangleEstimate, turn: TurnState) -> Memory:
        """The valve where the cameras have just seen it, if that is not where it was measured: somebody moved it."""
        if m.X_OA is None or not estimate.found or time - estimate.time > FRESH:
            return m
        p_OV = m.p_OV
        if not self.valve.fixed:  # a marker off the axis goes round with the valve
            p_OV = apply(compose(turned(m.X_OA, self._by_hands(m, turn) - m.counted), inverse(m.X_OA)), p_OV)
        shift = apply(estimate.X_OL, estimate.X_LV[:, 3]) - p_OV
        if not MOVED < np.linalg.norm(shift) < FARTHEST_MOVE:
            return m
        return changed(m, X_OA=make(m.X_OA[:, :3], m.X_OA[:, 3] + shift), p_OV=m.p_OV + shift)

    def _by_hands(self, m: Memory, turn: TurnState) -> float:
        """How far the valve was turned in this run: by the camera until the last plan, and since by the hands [rad]."""
        return turn.angle if turn.number == m.plan.number >= 0 else m.counted

    def _homing(self, time: float, m: Memory, X_BA: np.ndarray | None, inputs: Inputs) -> Memory:
        """Brings the arms home along a free path, once per activation; m.path is the move, phase "home" on arrival.

        X_BA: of a valve to keep clear of; read in phase "start" alone.
        """
        if m.phase == "start":
            m = self._move(time, m, self.home, X_BA, self.robot.held(inputs.state.torso))
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
        path = Path(points, time, self.config.joint_speed, self.config.joint_acceleration, self._limits)
        return changed(m, phase="moving", path=path, since=time)
