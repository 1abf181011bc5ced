"""Stage 5: what grasping, turning and releasing have in common: the memory, the grip, and the hands' commands."""

import copy
import dataclasses as dc
import math

import numpy as np

from valve_drake.behaviors.axis_estimate import AxisEstimate
from valve_drake.behaviors.closed_chain import (
    Chain,
)
from valve_drake.behaviors.grasp_geometry import standoff
from valve_drake.behaviors.hybrid_rotation_config import HybridRotationConfig
from valve_drake.frames import cross, make, rotation
from valve_drake.memory import changed
from valve_drake.messages import (
    SIDES,
    GraspPlan,
    RobotState,
    Status,
    TurnState,
    Verdict,
)
from valve_drake.robot.kinematics import STRIDE, RobotKinematics
from valve_drake.valve.valve import Valve

DRAWN = 0.03  # of a redundant arm's distance from its planned way, a tick: it follows that way by a quarter of a second
PRESSES = 0.5  # share of grip_force from which a gripper presses on something; lower it for fingers that rub

Pair = tuple[np.ndarray, np.ndarray]  # of both hands, left first


def _pair(*shape: int) -> Pair:
    return np.zeros(shape), np.zeros(shape)


@dc.dataclass(frozen=True)
class Memory:
    """Everything between two steps."""

    activation: int = -1
    stage: str = ""
    since: float = 0.0  # of the stage [s]
    bias: np.ndarray = dc.field(default_factory=lambda: np.zeros((2, 6)))
    tared: bool = False
    wrenches: np.ndarray = dc.field(default_factory=lambda: np.zeros((2, 6)))  # filtered, at the grip points, in B
    commanding: bool = False  # X and q hold this block's own commands; not while other blocks move the hands
    X: Pair = dc.field(default_factory=lambda: _pair(3, 4))  # commanded X_BG
    q: Pair = dc.field(default_factory=lambda: _pair(6))  # commanded joints
    start: Pair = dc.field(default_factory=lambda: _pair(3, 4))  # X_BG at the stage's beginning
    # Where redundant arms end when the hands are drawn back (joints; None: not known), and the share of the way there.
    behind: tuple[np.ndarray | None, ...] = (None, None)
    back: float = 0.0
    pace: float = math.inf  # of that way, if the joints could not follow at full speed [m/s]
    plan: GraspPlan = GraspPlan()  # of this grasp
    axis: AxisEstimate | None = None  # none before the first grasp
    u: np.ndarray = dc.field(default_factory=lambda: np.array([-1.0, 0.0, 0.0]))  # the valve's axis, towards the robot
    middle: np.ndarray = dc.field(default_factory=lambda: np.zeros(2))  # of the hands, from the axis; see make_chain
    b0: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))  # from the left hand to the right one at the grasp
    turned: float = 0.0  # by the hands since the grasp, unwrapped [rad]
    commanded: float = 0.0
    rate: float = 0.0  # commanded, along the turn's sense
    progress_at: tuple[float, float] = (0.0, 0.0)  # (time, angle) of the last progress
    stalls: int = 0
    stalled_at: float = 0.0
    stiff: bool = False  # the last stall was one in both senses, with as much force as was allowed then
    tripped: int = 0  # ticks over the force trip
    held_time: float = 0.0  # both grippers have held for so long, in grasp [s]
    bad_grip_time: float = 0.0  # an opening or the sharing of the load is no grasp's for so long, in turn [s]
    tugged: tuple[bool, bool] = (False, False)
    status: Status = Status()
    telemetry: TurnState = TurnState()


class Hands:
    """Both hands at the valve. view: the wrist cameras' view directions (hands draw back against them)."""

    def __init__(
        self,
        config: HybridRotationConfig,
        valve: Valve,
        robot: RobotKinematics,
        view: dict[str, np.ndarray],
    ):
        config.check()
        self.config = copy.copy(config)
        self.valve = valve
        self.robot = robot
        self.view = view

    def _held(self, m: Memory, state: RobotState) -> bool:
        """Both grippers stopped at the handle's width and press."""
        c = self.config
        off = self._off(m, state)
        forces = (state.left_gripper_force, state.right_gripper_force)
        return all(o < c.grip_margin for o in off) and all(force > PRESSES * c.grip_force for force in forces)

    def _widths(self, m: Memory) -> tuple[float, float]:
        """Of what the hands hold [m]."""
        left, right = (self.valve.handles[k].width for k in (m.plan.handle_left, m.plan.handle_right))
        return left, right

    def _off(self, m: Memory, state: RobotState) -> tuple[float, float]:
        """How far both openings are from what is held [m]."""
        left, right = self._widths(m)
        return abs(state.left_gripper - left), abs(state.right_gripper - right)

    def _openings(self, state: RobotState) -> str:
        return (
            f"openings {1e3 * state.left_gripper:.1f} and {1e3 * state.right_gripper:.1f} mm, "
            f"{state.left_gripper_force:.0f} and {state.right_gripper_force:.0f} N"
        )

    def _fail(self, time: float, m: Memory, verdict: Verdict, detail: str) -> Memory:
        status = Status(time, m.activation, "failed", verdict, detail, value=m.plan.turned + m.turned)
        return changed(m, stage="failed", status=status)

    def _move(self, dt: float, m: Memory, V: np.ndarray, chain: Chain, posture: np.ndarray) -> Memory:
        """Integrates the hands' twists (about the chain's centre) into commanded poses and joints."""
        X = []
        for k in range(2):
            w, v = V[k, :3], V[k, 3:]
            R, p = m.X[k][:, :3], m.X[k][:, 3]
            X.append(make(rotation(w * dt) @ R, p + dt * (v + cross(w, p - chain.c))))
        return self._command(m, (X[0], X[1]), posture)

    def _command(self, m: Memory, X: Pair, posture: np.ndarray) -> Memory:
        """Commands the poses X; a hand keeps its command if its pose has no inverse near the present joints."""
        q, kept = list(m.q), list(m.X)
        for k, side in enumerate(SIDES):
            solution = self.robot.inverse(side, X[k], self._near(m, k), posture)
            if solution is not None and np.max(np.abs(solution - m.q[k])) < STRIDE:
                q[k], kept[k] = solution, X[k]
        return changed(m, X=(kept[0], kept[1]), q=(q[0], q[1]))

    def _near(self, m: Memory, k: int) -> np.ndarray:
        """From where hand k's joints are looked for. A redundant arm is drawn to the way that was planned, since only
        that is known to be free of collision: left to itself its elbow wanders as the hand goes on."""
        planned, behind = self._planned(m, k), m.behind[k]
        if planned is None:
            return m.q[k]
        if behind is not None:
            planned = planned + m.back * (behind - planned)
        return m.q[k] + DRAWN * (planned - m.q[k])

    def _planned(self, m: Memory, k: int) -> np.ndarray | None:
        """The joints of hand k's arm by the plan where the valve is now; None for an arm that is not redundant."""
        plan, count = m.plan, len(m.q[k])
        if count <= 6 or not plan.way.size or not plan.turn:
            return None
        way = plan.way.reshape(-1, len(plan.q_standoff))
        way = way[:, :count] if k == 0 else way[:, -count:]
        at = min(max(m.turned / plan.turn, 0.0), 1.0) * (len(way) - 1)
        row = min(int(at), len(way) - 2)
        return way[row] + (at - row) * (way[row + 1] - way[row])

    def _behind(self, m: Memory, posture: np.ndarray) -> tuple[np.ndarray | None, ...]:
        """The joints of redundant arms with the hands drawn back, as the plan looked for them: from its way at once."""
        out: list[np.ndarray | None] = []
        for k, side in enumerate(SIDES):
            planned, X = self._planned(m, k), standoff(m.X[k], self.view[side], self.config.retreat)
            out.append(None if planned is None else self.robot.inverse(side, X, planned, posture))
        return tuple(out)
