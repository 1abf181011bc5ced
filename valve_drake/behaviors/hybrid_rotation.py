"""Stage 5: both hands grasp the valve and turn it under hybrid force and position control; then let go.

The two arms and the valve form one closed chain with a single free motion, the turn. With everything at the valve's
centre c (mid-point of the hands) and u the valve's axis towards the robot, the wrenches felt by the hands and the
hands' twists are split into common and relative parts [Uchiyama, Dauchez 1988]:

    h_i = [m_i + (p_i - c) x f_i ; f_i]       h_a = h_1 + h_2       h_r = (h_2 - h_1) / 2              (1)
    V_1 = V_a - V_r / 2,  V_2 = V_a + V_r / 2                                                          (2)
    u . w_a = turn rate;   the other five of V_a = D_a^-1 h_a                                          (3)
    V_r = D_r^-1 (h_r - h_r*)                                                                          (4)
    h_r* = squeeze b - (tau / L) t                                                                     (5)

hand 1 left, 2 right; b from hand 1 to 2, t = u x b, L their distance, tau the couple on the valve. D_a = 2 D and
D_r = D / 2 give each hand the same damping D. The term of (5) in tau is necessary: the two driving forces are
themselves a relative wrench, and with a constant h_r* the hands yield to the couple that they should apply.

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

from valve_drake.behaviors.grasp_geometry import standoff
from valve_drake.checks import require
from valve_drake.config import Config, number
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
from valve_drake.perception.marker import Marker
from valve_drake.robot.kinematics import HandLoad, RobotKinematics
from valve_drake.task.modes import owned

GRAVITY = 9.81
AT_VALVE = (Mode.REACH, Mode.SERVO, *owned("hybrid_rotation"))  # the wrist sensors are tared or filtered


@dc.dataclass
class HybridRotationConfig(Config):
    """Scenario key `hybrid_rotation`."""

    KEY = "hybrid_rotation"
    damping: float = number(
        4000.0,
        500.0,
        20000.0,
        "D of each hand, stable with 20 ms of delay each way; higher: larger forces, lower: it oscillates [N s/m]",
    )
    angular_damping: float = number(256.0, 16.0, 2000.0, "the same for rotations [N m s/rad]")
    filter: float = number(
        10.0, 1.0, 60.0, "low-pass of the wrenches; lower it for a noisy sensor, which also slows the reaction [Hz]"
    )
    rate: float = number(0.105, 0.005, 0.5, "of the turn, at most [rad/s]")
    ramp: float = number(0.5, 0.05, 5.0, "time from rest to full rate, and back [s]")
    slow: float = number(0.006, 5e-4, 0.1, "least rate near the goal [rad/s]")
    torque_limit: float = number(
        12.0, 1.0, 16.0, "on the valve; the rate falls to zero over its last 30 %; raise it for a stiff valve [N m]"
    )
    lead_limit: float = number(0.05, 0.005, 0.2, "commanded minus measured angle, at most [rad]")
    force_trip: float = number(55.0, 10.0, 55.0, "force on one hand that ends the turn [N]")
    squeeze: float = number(0.0, 0.0, 30.0, "internal force along the bar, positive compresses it [N]")
    tolerance: float = number(0.001, 1e-4, 0.05, "of the turned angle as the hands measure it [rad]")
    stall_time: float = number(2.0, 0.2, 30.0, "without progress, then it is a stall [s]")
    stall_angle: float = number(0.01, 0.001, 0.2, "that counts as progress [rad]")
    back_off: float = number(
        0.07, 0.005, 0.5, "turned the other way after a stall, to tell a stop from a stuck valve [rad]"
    )
    grip_force: float = number(70.0, 5.0, 100.0, "of the finger actuator [N]")
    grip_margin: float = number(0.005, 5e-4, 0.02, "a grasp is an opening within this of the handle's width [m]")
    tug_force: float = number(8.0, 1.0, 30.0, "pull on each hand that proves the grasp [N]")
    tug_speed: float = number(0.006, 0.001, 0.02, "pulls a hand with at most this times `damping` [m/s]")
    tug_reach: float = number(0.012, 0.002, 0.05, "a hand that moves farther without force has missed the handle [m]")
    close_time: float = number(4.0, 0.5, 30.0, "deadline for closing [s]")
    relax: float = number(
        0.6, 0.05, 10.0, "the hands yield for this long before they open, until the forces have decayed [s]"
    )
    open_force: float = number(40.0, 5.0, 100.0, "of the finger actuator while opening [N]")
    retreat: float = number(0.12, 0.02, 0.3, "hands drawn back after opening [m]")
    retreat_speed: float = number(0.10, 0.01, 0.3, "[m/s]")
    tare_time: float = number(0.2, 0.02, 2.0, "time constant of zeroing the wrist sensors at the stand-off [s]")

    def relations(self, key: str) -> None:
        require(self.slow <= self.rate, f"{key}.slow", f"at most rate, {self.rate:g}", self.slow)
        highest = self.force_trip / self.damping
        gentle = self.tug_speed <= highest
        require(gentle, f"{key}.tug_speed", f"at most force_trip / damping, {highest:.3g}", self.tug_speed)


def gravity_wrench(R_BG: np.ndarray, hand: HandLoad) -> np.ndarray:
    """The load of the hand's own weight on the wrist sensor, in its frame -> [torque; force] (6,)."""
    R_SB = hand.X_SG[:, :3] @ R_BG.T
    force = R_SB @ np.array([0.0, 0.0, -GRAVITY * hand.mass])
    return np.concatenate([cross(hand.p_SCom, force), force])


def contact_wrench(raw: np.ndarray, bias: np.ndarray, R_BG: np.ndarray, hand: HandLoad) -> np.ndarray:
    """The external load on the hand at its grip point, in B: the reading `raw` without bias and weight.

    raw, bias: in the sensor's frame (6,). -> [torque; force] (6,).
    """
    load = raw - bias - gravity_wrench(R_BG, hand)
    torque = load[:3] - cross(hand.X_SG[:, 3], load[3:])
    R_BS = R_BG @ hand.X_SG[:, :3].T
    return np.concatenate([R_BS @ torque, R_BS @ load[3:]])


@dc.dataclass(frozen=True)
class Chain:
    """The closed chain at one instant, measured (all in B)."""

    p: np.ndarray  # grip points (2, 3), left first
    f: np.ndarray  # forces felt (2, 3) [N]
    m: np.ndarray  # moments felt at the grip points (2, 3) [N m]
    c: np.ndarray  # centre (3,)
    u: np.ndarray  # axis towards the robot
    b: np.ndarray  # along the bar, left to right hand
    t: np.ndarray  # u x b
    L: float  # distance of the hands

    h: np.ndarray  # h_1, h_2 of (1) (2, 6)
    couples: np.ndarray  # that each hand exerts on the valve about u (2,) [N m]
    torque: float  # their sum


def make_chain(p: np.ndarray, wrenches: np.ndarray, u: np.ndarray) -> Chain:
    """p (2, 3), wrenches at the grip points (2, 6), axis u -> Chain."""
    c = (p[0] + p[1]) / 2
    line = p[1] - p[0]
    line = line - u * (u @ line)
    L = math.sqrt(line @ line)
    b = line / L
    m, f = wrenches[:, :3], wrenches[:, 3:]
    h = wrenches.copy()
    for k in range(2):
        h[k, :3] += cross(p[k] - c, f[k])
    couples = -(h[:, :3] @ u)
    return Chain(p, f, m, c, u, b, cross(u, b), L, h, couples, float(couples[0] + couples[1]))


def twists(chain: Chain, turn_rate: float | None, config: HybridRotationConfig, extra: np.ndarray) -> np.ndarray:
    """Eq. (2)-(5): the twists [w; v at c] of both hands -> (2, 6).

    turn_rate: about u [rad/s]; None lets the hands yield in that direction too.
    extra: added to the common twist (6,), e.g. a tug.
    """
    h1, h2 = chain.h
    D = np.array([config.angular_damping] * 3 + [config.damping] * 3)
    h_a, h_r = h1 + h2, (h2 - h1) / 2
    V_a = h_a / (2 * D)
    target = np.zeros(6)
    if turn_rate is not None:
        V_a[:3] += chain.u * (turn_rate - chain.u @ V_a[:3])
        # Beyond the limit the target is constant, or the relative loop would build up force on a stuck valve.
        couple = min(max(chain.torque, -config.torque_limit), config.torque_limit)
        target[3:] = config.squeeze * chain.b - (couple / chain.L) * chain.t
    V_a = V_a + extra
    V_r = (h_r - target) / (D / 2)
    return np.array([V_a - V_r / 2, V_a + V_r / 2])


def turn_rate(left: float, rate: float, torque: float, lead: float, config: HybridRotationConfig, dt: float) -> float:
    """The rate for the next tick [rad/s]. All numbers count along the sense of the turn: positive = towards the goal.

    left: still to turn [rad]; rate: now; torque, lead: see the config's limits. A negative result yields to a torque
    above its limit.
    """
    if torque > config.torque_limit:
        return (config.torque_limit - torque) / (2 * config.angular_damping)
    acceleration = config.rate / config.ramp
    brake = math.sqrt(2 * acceleration * max(left, 0.0))
    wanted = max(config.slow, min(config.rate, brake)) if left > 0 else 0.0
    by_torque = (config.torque_limit - torque) / (0.3 * config.torque_limit)
    by_lead = (config.lead_limit - lead) / (0.25 * config.lead_limit)
    scaled = wanted * min(max(min(by_torque, by_lead), 0.0), 1.0)
    return min(scaled, max(rate, 0.0) + acceleration * dt)


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
    b0: np.ndarray = dc.field(default_factory=lambda: np.zeros(3))  # direction of the bar at the grasp
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
        marker: Marker,
        robot: RobotKinematics,
        view: dict[str, np.ndarray],
    ):
        config.check()
        self.config = copy.copy(config)
        self.marker = copy.copy(marker)
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
        u = -plan.X_BV[:, 2]
        chain = make_chain(p, m.wrenches, u)
        if mode.activation != m.activation:
            m = self._begin(time, m, mode, X, q, chain)
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
        """Angle of the line between the hands about u since b0, unwrapped."""
        b0 = m.b0 - chain.u * (chain.u @ m.b0)
        now = float(np.arctan2(chain.u @ cross(b0, chain.b), b0 @ chain.b))
        return changed(m, turned=m.turned + wrap(now - m.turned))

    # ------------------------------------------------------------ grasp
    def _grasp(
        self, time: float, dt: float, m: Memory, state: RobotState, mode: ModeState, chain: Chain
    ) -> tuple[Memory, np.ndarray, np.ndarray]:
        c = self.config
        gripper = np.array([0.0, c.grip_force])
        extra = np.zeros(6)
        if m.stage == "close":
            held = self._held(state)
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
            elif moved > c.tug_reach or not self._held(state):
                detail = f"tug: {pull[0]:.1f} and {pull[1]:.1f} N, {self._openings(state)}"
                m = self._fail(time, m, Verdict.GRASP_MISSED, detail)
            else:
                extra[3:] = c.tug_speed * chain.u + chain.u * min(float(np.sum(pull)), 40.0) / (2 * c.damping)
        elif m.stage == "settle" and time - m.since > c.relax:
            if self._held(state):
                status = Status(time, m.activation, "succeeded", detail=self._openings(state))
                m = changed(m, stage="held", status=status)
            else:
                m = self._fail(time, m, Verdict.GRASP_MISSED, self._openings(state))
        return m, twists(chain, None, c, extra), gripper

    def _held(self, state: RobotState) -> bool:
        """Both grippers stopped at the handle's width and press."""
        c = self.config
        off = (abs(opening - self.marker.handle_width) for opening in (state.left_gripper, state.right_gripper))
        forces = (state.left_gripper_force, state.right_gripper_force)
        return all(o < c.grip_margin for o in off) and all(force > 0.5 * c.grip_force for force in forces)

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
        sense = 1.0 if mode.turn_angle >= 0 else -1.0
        if m.stage in ("turn", "back"):
            m = self._watch(time, dt, m, state, chain)
        if m.stage not in ("turn", "back"):
            return m, twists(chain, None, c, np.zeros(6)), gripper
        if m.stage == "back":
            sense = -sense
        goal = mode.turn_angle if m.stage == "turn" else m.stalled_at + sense * c.back_off
        left = sense * (goal - m.turned)
        if m.stage == "turn" and left <= c.tolerance:
            detail = f"{np.degrees(m.turned):.2f} deg by the hands"
            status = Status(time, m.activation, "succeeded", detail=detail, progress=1.0, value=m.turned)
            m = changed(m, stage="there", status=status)
            return m, twists(chain, None, c, np.zeros(6)), gripper
        lead = sense * (m.commanded - m.turned)
        rate = turn_rate(left, m.rate, sense * chain.torque, lead, c, dt)
        if mode.held:  # it slows down to rest; a stall is none
            rate = min(rate, max(m.rate - c.rate / c.ramp * dt, 0.0))
            m = changed(m, progress_at=(time, m.turned))
        m = changed(m, rate=rate, commanded=m.commanded + sense * rate * dt)
        progress = min(max(m.turned / mode.turn_angle, 0.0), 1.0)
        m = changed(m, status=Status(time, m.activation, "running", progress=progress, value=m.turned))
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
        openings = (state.left_gripper, state.right_gripper)
        off = any(abs(opening - self.marker.handle_width) > 2 * c.grip_margin for opening in openings)
        share = chain.couples[0] / chain.torque if abs(chain.torque) > 2.0 else 0.5
        bad = off or not 0.1 < share < 0.9
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
            closed = min(state.left_gripper, state.right_gripper) < self.marker.handle_width + 2 * c.grip_margin
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
                status = Status(time, m.activation, "succeeded", progress=1.0, value=m.turned)
                m = changed(m, stage="away", status=status)
        return m, np.zeros((2, 6)), opened

    # ------------------------------------------------------------ common
    def _fail(self, time: float, m: Memory, verdict: Verdict, detail: str) -> Memory:
        status = Status(time, m.activation, "failed", verdict, detail, value=m.turned)
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
            stage=m.stage,
            angle=m.turned,
            angle_reference=m.commanded,
            rate=m.rate,
            torque=chain.torque,
            share_left=float(couples[0] / chain.torque) if abs(chain.torque) > 0.5 else 0.5,
            force_left=chain.f[0],
            force_right=chain.f[1],
            moment_left=chain.m[0],
            moment_right=chain.m[1],
            stem_force=chain.f[0] + chain.f[1],
            squeeze=float((chain.f[1] - chain.f[0]) @ chain.b / 2),
            center=chain.c,
        )
