"""Stage 5: both hands grasp the valve and turn it under hybrid force and position control; then let go.

The law of the two arms and the valve is in closed_chain.py. The valve's axis is that of the plan, and is estimated as
the turn goes on (axis_estimate.py).

There is no integrator on the turn: the rate is scaled down as the torque nears its limit, and beyond the limit the
turn yields as all other directions do, so a stuck valve stores no energy. The joints get positions only: feeding the
admittance's velocity forward makes the loop oscillate.

All vectors are in the base's frame B, which stands still while the hands are on the valve. Lift and waist are held;
the hands are where they are measured.
"""

import copy
import dataclasses as dc
import math

import numpy as np

from valve_drake.behaviors.axis_estimate import AxisEstimate
from valve_drake.behaviors.closed_chain import (
    Chain,
    contact_wrench,
    gravity_wrench,
    make_chain,
    turn_rate,
    twists,
)
from valve_drake.behaviors.grasp_geometry import standoff
from valve_drake.behaviors.hybrid_rotation_config import HybridRotationConfig
from valve_drake.frames import cross, make, rotation, wrap
from valve_drake.memory import changed
from valve_drake.messages import (
    LEFT,
    RIGHT,
    SIDES,
    Command,
    GraspPlan,
    Mode,
    ModeState,
    RobotState,
    Status,
    TurnState,
    Verdict,
)
from valve_drake.robot.kinematics import RobotKinematics
from valve_drake.task.modes import owned
from valve_drake.valve.valve import Valve

AT_VALVE = (Mode.REACH, Mode.SERVO, *owned("hybrid_rotation"))  # the wrist sensors are tared or filtered


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
    tripped: int = 0  # ticks over the force trip
    held_time: float = 0.0  # both grippers have held for so long, in grasp [s]
    bad_grip_time: float = 0.0  # an opening or the sharing of the load is no grasp's for so long, in turn [s]
    tugged: tuple[bool, bool] = (False, False)
    status: Status = Status()
    telemetry: TurnState = TurnState()


class HybridRotation:
    """The mathematics of the stage. view: the wrist cameras' view directions (hands draw back against them)."""

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

    def step(
        self, time: float, dt: float, memory: Memory, state: RobotState, mode: ModeState, plan: GraspPlan
    ) -> tuple[Memory, Command]:
        """One tick of length dt -> memory (with status and telemetry), command."""
        if mode.mode not in AT_VALVE:
            idle = memory if memory.activation < 0 else changed(memory, activation=-1, status=Status())
            return idle, Command(time=time)
        q = (state.left_arm, state.right_arm)
        X = (self.robot.forward(LEFT, q[0], state.posture), self.robot.forward(RIGHT, q[1], state.posture))
        m = self._sense(dt, memory, state, mode, X)
        if mode.mode in (Mode.REACH, Mode.SERVO):  # other blocks move the hands
            return changed(m, activation=-1, status=Status(), commanding=False), Command(time=time)
        p = np.array([X[0][:, 3], X[1][:, 3]])
        if m.axis is None or (mode.mode == Mode.GRASP and mode.activation != m.activation):
            m = self._hold(m, plan)
        chain = make_chain(p, m.wrenches, m.u, m.middle)
        if mode.activation != m.activation:
            m = self._begin(time, changed(m, plan=plan), mode, X, q, chain)
        sound = bool(np.isfinite(chain.h).all())
        if sound:
            m = self._angle(m, chain)
        elif mode.mode != Mode.RELEASE and m.status.state == "running":
            m = self._fail(time, m, Verdict.FAULT, "a wrist sensor's or arm's report is not finite")
        run = {Mode.GRASP: self._grasp, Mode.TURN: self._turn, Mode.RELEASE: self._release}[Mode(mode.mode)]
        m, V, gripper = run(time, dt, m, state, mode, chain)
        V = V if sound else np.zeros((2, 6))
        m = self._move(dt, m, V, chain, state.posture)
        m = changed(m, telemetry=self._telemetry(time, m, chain))
        command = Command(time=time, left_arm=m.q[0], right_arm=m.q[1], left_gripper=gripper, right_gripper=gripper)
        return m, command

    def _hold(self, m: Memory, plan: GraspPlan) -> Memory:
        """What is held, by the plan."""
        handles = [self.valve.handles[k].xyz for k in (plan.handle_left, plan.handle_right)]
        axis = AxisEstimate.begin(plan.X_BA, np.array(handles))
        return changed(m, plan=plan, axis=axis, u=-plan.X_BA[:, 2], middle=axis.middle)

    # ------------------------------------------------------------ sensing
    def _sense(self, dt: float, m: Memory, state: RobotState, mode: ModeState, X: Pair) -> Memory:
        """Tares the sensors while the hands stand still at the stand-off; elsewhere filters the contact wrenches."""
        raw = (state.left_wrench, state.right_wrench)
        if mode.mode == Mode.REACH:
            speeds = (*state.left_arm_velocity.tolist(), *state.right_arm_velocity.tolist())
            if not all(abs(speed) < 0.02 for speed in speeds) or not np.isfinite(raw).all():
                return changed(m, tared=False) if m.tared else m
            load = np.array(
                [raw[k] - gravity_wrench(X[k][:, :3], self.robot.hands[side]) for k, side in enumerate(SIDES)]
            )
            a = 1 - np.exp(-dt / self.config.tare_time)
            bias = m.bias + a * (load - m.bias) if m.tared else load
            return changed(m, bias=bias, tared=True, wrenches=np.zeros((2, 6)))
        now = np.array(
            [contact_wrench(raw[k], m.bias[k], X[k][:, :3], self.robot.hands[side]) for k, side in enumerate(SIDES)]
        )
        a = 1 - np.exp(-2 * np.pi * self.config.filter * dt)
        last = np.where(
            np.isfinite(m.wrenches), m.wrenches, now
        )  # one report that is not finite must not stay in the filter
        return changed(m, wrenches=last + a * (now - last))

    def _begin(self, time: float, m: Memory, mode: ModeState, X: Pair, q: Pair, chain: Chain) -> Memory:
        stage = {Mode.GRASP: "close", Mode.TURN: "turn", Mode.RELEASE: "relax"}[Mode(mode.mode)]
        if mode.mode == Mode.GRASP or not m.commanding:
            m = changed(m, commanding=True, X=X, q=q, b0=chain.b, turned=0.0, commanded=0.0)
        if mode.mode == Mode.TURN:
            m = changed(m, b0=chain.b, turned=0.0, commanded=0.0)
        return changed(
            m,
            activation=mode.activation,
            stage=stage,
            since=time,
            start=m.X,
            rate=0.0,
            progress_at=(time, 0.0),
            stalls=0,
            tripped=0,
            held_time=0.0,
            bad_grip_time=0.0,
            tugged=(False, False),
            status=Status(time, mode.activation, "running"),
        )

    def _angle(self, m: Memory, chain: Chain) -> Memory:
        """Angle of the line between the hands about u since b0, unwrapped; what it tells of the axis."""
        b0 = m.b0 - chain.u * (chain.u @ m.b0)
        now = float(np.arctan2(chain.u @ cross(b0, chain.b), b0 @ chain.b))
        m = changed(m, turned=m.turned + wrap(now - m.turned))
        if m.stage != "turn" or m.axis is None:
            return m
        axis = m.axis.add(chain.p, m.turned)
        return m if axis is m.axis else changed(m, axis=axis, u=axis.u, middle=axis.offset)

    # ------------------------------------------------------------ grasp
    def _grasp(
        self, time: float, dt: float, m: Memory, state: RobotState, mode: ModeState, chain: Chain
    ) -> tuple[Memory, np.ndarray, np.ndarray]:
        c = self.config
        gripper = np.array([0.0, c.grip_force])
        extra = np.zeros(6)
        if m.stage == "close":
            held = self._held(m, state)
            m = changed(m, held_time=m.held_time + dt if held else 0.0)
            if m.held_time >= 0.4:
                m = changed(m, stage="tug", since=time, start=m.X)
            elif time - m.since > c.close_time:
                m = self._fail(time, m, Verdict.GRASP_MISSED, self._openings(state))
        elif m.stage == "tug":
            pull = -(chain.f @ chain.u)  # the bar holds the hands back: force into the panel
            tugged = (bool(m.tugged[0] or pull[0] >= c.tug_force), bool(m.tugged[1] or pull[1] >= c.tug_force))
            m = changed(m, tugged=tugged)
            moved = max(float((m.X[k][:, 3] - m.start[k][:, 3]) @ chain.u) for k in range(2))
            if all(tugged):
                m = changed(m, stage="settle", since=time)
            elif moved > c.tug_reach or not self._held(m, state):
                detail = f"tug: {pull[0]:.1f} and {pull[1]:.1f} N, {self._openings(state)}"
                m = self._fail(time, m, Verdict.GRASP_MISSED, detail)
            else:
                extra[3:] = c.tug_speed * chain.u + chain.u * min(float(np.sum(pull)), 40.0) / (2 * c.damping)
        elif m.stage == "settle" and time - m.since > c.relax:
            if self._held(m, state):
                status = Status(time, m.activation, "succeeded", detail=self._openings(state))
                m = changed(m, stage="held", status=status)
            else:
                m = self._fail(time, m, Verdict.GRASP_MISSED, self._openings(state))
        return m, twists(chain, None, c, extra), gripper

    def _held(self, m: Memory, state: RobotState) -> bool:
        """Both grippers stopped at the handle's width and press."""
        c = self.config
        off = self._off(m, state)
        forces = (state.left_gripper_force, state.right_gripper_force)
        return all(o < c.grip_margin for o in off) and all(force > 0.5 * c.grip_force for force in forces)

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

    # ------------------------------------------------------------ turn
    def _turn(
        self, time: float, dt: float, m: Memory, state: RobotState, mode: ModeState, chain: Chain
    ) -> tuple[Memory, np.ndarray, np.ndarray]:
        c = self.config
        gripper = np.array([0.0, c.grip_force])
        asked = m.plan.turn
        sense = 1.0 if asked >= 0 else -1.0
        if m.stage in ("turn", "back"):
            m = self._watch(time, dt, m, state, chain)
        if m.stage not in ("turn", "back"):
            return m, twists(chain, None, c, np.zeros(6)), gripper
        if m.stage == "back":
            sense = -sense
        goal = asked if m.stage == "turn" else m.stalled_at + sense * c.back_off
        left = sense * (goal - m.turned)
        if m.stage == "turn" and left <= c.tolerance:
            detail = f"{np.degrees(m.turned):.2f} deg by the hands"
            status = Status(
                time, m.activation, "succeeded", detail=detail, progress=1.0, value=m.plan.turned + m.turned
            )
            m = changed(m, stage="there", status=status)
            return m, twists(chain, None, c, np.zeros(6)), gripper
        lead = sense * (m.commanded - m.turned)
        rate = turn_rate(left, m.rate, sense * chain.torque, lead, c, dt)
        if mode.held:  # it slows down to rest; a stall is none
            rate = min(rate, max(m.rate - c.rate / c.ramp * dt, 0.0))
            m = changed(m, progress_at=(time, m.turned))
        m = changed(m, rate=rate, commanded=m.commanded + sense * rate * dt)
        progress = min(max((m.plan.turned + m.turned) / mode.turn_angle, 0.0), 1.0)
        m = changed(m, status=Status(time, m.activation, "running", progress=progress, value=m.plan.turned + m.turned))
        m = self._stall(time, m, sense, left)
        return m, twists(chain, sense * rate, c, np.zeros(6)), gripper

    def _stall(self, time: float, m: Memory, sense: float, left: float) -> Memory:
        """After a stall it turns the other way: if that is free, the stall was an end stop, else the valve is stuck."""
        c = self.config
        since, angle = m.progress_at
        if sense * (m.turned - angle) > c.stall_angle:
            return changed(m, progress_at=(time, m.turned))
        if m.stage == "back":
            if left <= c.tolerance:  # free the other way: turn on
                return changed(m, stage="turn", rate=0.0, progress_at=(time, m.turned), commanded=m.turned)
            if time - since > c.stall_time:
                detail = f"stiff both ways at {np.degrees(m.turned):.1f} deg, {m.telemetry.torque:.1f} N m"
                return self._fail(time, m, Verdict.STUCK, detail)
        elif time - since > c.stall_time:
            if m.stalls > 0 and abs(m.turned - m.stalled_at) < np.radians(2):
                detail = f"stopped twice at {np.degrees(m.turned):.1f} deg, free the other way"
                return self._fail(time, m, Verdict.END_STOP, detail)
            if m.stalls >= 3:
                return self._fail(time, m, Verdict.STUCK, f"stalled {m.stalls + 1} times")
            return changed(
                m,
                stage="back",
                rate=0.0,
                stalls=m.stalls + 1,
                stalled_at=m.turned,
                progress_at=(time, m.turned),
                commanded=m.turned,
            )
        return m

    def _watch(self, time: float, dt: float, m: Memory, state: RobotState, chain: Chain) -> Memory:
        """Force trip, grasp lost, one hand carrying all, end of reach."""
        c = self.config
        force = [math.hypot(*f) for f in chain.f.tolist()]
        m = changed(m, tripped=m.tripped + 1 if max(force) > c.force_trip else 0)
        if m.tripped >= 3:
            verdict = Verdict.STUCK if abs(chain.torque) > 0.7 * c.torque_limit else Verdict.FAULT
            return self._fail(time, m, verdict, f"hand forces {force[0]:.0f} and {force[1]:.0f} N")
        off = max(self._off(m, state)) > 2 * c.grip_margin
        share = chain.couples[0] / chain.torque if abs(chain.torque) > 2.0 else chain.share
        bad = off or not 0.2 * chain.share < share < 1 - 0.2 * (1 - chain.share)
        m = changed(m, bad_grip_time=m.bad_grip_time + dt if bad else 0.0)
        if m.bad_grip_time > 0.5:
            detail = f"{self._openings(state)}, left hand carries {100 * share:.0f} %"
            return self._fail(time, m, Verdict.SLIP, detail)
        if min(self.robot.margin(LEFT, state.left_arm), self.robot.margin(RIGHT, state.right_arm)) < 0.02:
            return self._fail(time, m, Verdict.REACH_LIMIT, f"arms at their limit at {np.degrees(m.turned):.1f} deg")
        return m

    # ------------------------------------------------------------ release
    def _release(
        self, time: float, dt: float, m: Memory, state: RobotState, mode: ModeState, chain: Chain
    ) -> tuple[Memory, np.ndarray, np.ndarray]:
        c = self.config
        V = twists(chain, None, c, np.zeros(6))
        grip = np.array([0.0, c.grip_force])
        opened = np.array([self.robot.opening, c.open_force])
        if m.stage == "relax":
            widths = self._widths(m)
            over = min(state.left_gripper - widths[0], state.right_gripper - widths[1])
            closed = over < 2 * c.grip_margin
            if not closed or time - m.since > c.relax:
                m = changed(m, stage="open", since=time)
            return m, V, grip if closed else opened
        if m.stage == "open":
            wide = min(state.left_gripper, state.right_gripper) > 0.9 * self.robot.opening
            if wide or time - m.since > 2.0:
                m = changed(m, stage="retreat", since=time, start=m.X)
            return m, V, opened
        if m.stage == "retreat":
            way = min(c.retreat, c.retreat_speed * (time - m.since))
            left, right = (standoff(m.start[k], self.view[side], way) for k, side in enumerate(SIDES))
            m = self._command(m, (left, right), state.posture)
            if way >= c.retreat:
                status = Status(time, m.activation, "succeeded", progress=1.0, value=m.plan.turned + m.turned)
                m = changed(m, stage="away", status=status)
        return m, np.zeros((2, 6)), opened

    # ------------------------------------------------------------ common
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
            solution = self.robot.inverse(side, X[k], m.q[k], posture)
            if solution is not None and np.max(np.abs(solution - m.q[k])) < 0.5:
                q[k], kept[k] = solution, X[k]
        return changed(m, X=(kept[0], kept[1]), q=(q[0], q[1]))

    def _telemetry(self, time: float, m: Memory, chain: Chain) -> TurnState:
        couples = chain.couples
        return TurnState(
            time=time,
            number=m.plan.number,
            stage=m.stage,
            angle=m.plan.turned + m.turned,
            angle_reference=m.plan.turned + m.commanded,
            rate=m.rate,
            torque=chain.torque,
            share_left=float(couples[0] / chain.torque) if abs(chain.torque) > 0.5 else chain.share,
            force_left=chain.f[0],
            force_right=chain.f[1],
            moment_left=chain.m[0],
            moment_right=chain.m[1],
            stem_force=chain.f[0] + chain.f[1],
            squeeze=float((chain.f[1] - chain.f[0]) @ chain.b / 2),
            center=chain.c,
            axis=chain.u,
        )
