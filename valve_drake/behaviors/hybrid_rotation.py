"""Stage 5: both hands grasp the valve and turn it under hybrid force and position control; then let go.

The law of the two arms and the valve is in closed_chain.py. The valve's axis is that of the plan, and is estimated as
the turn goes on (axis_estimate.py).

There is no integrator on the turn: the rate is scaled down as the torque nears its limit, and beyond the limit the
turn yields as all other directions do, so a stuck valve stores no energy. The joints get positions only: feeding the
admittance's velocity forward makes the loop oscillate.

All vectors are in the base's frame B, which stands still while the hands are on the valve. Lift and waist are held;
the hands are where they are measured.
"""

import math

import numpy as np

from valve_drake.behaviors.axis_estimate import AxisEstimate
from valve_drake.behaviors.closed_chain import (
    Chain,
    contact_wrench,
    gravity_wrench,
    make_chain,
)
from valve_drake.behaviors.hybrid_rotation_config import HybridRotationConfig
from valve_drake.behaviors.hybrid_rotation_grasp import Grasping
from valve_drake.behaviors.hybrid_rotation_hands import Memory as Memory
from valve_drake.behaviors.hybrid_rotation_hands import Pair
from valve_drake.behaviors.hybrid_rotation_release import Releasing
from valve_drake.behaviors.hybrid_rotation_turn import Turning
from valve_drake.frames import cross, wrap
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
from valve_drake.task.modes import owned

AT_VALVE = (Mode.REACH, Mode.SERVO, *owned("hybrid_rotation"))  # the wrist sensors are tared or filtered
AT_REST = 0.02  # slower arm joints stand still, and the sensors may be tared; raise it for noisy encoders [rad/s]
NO_TORQUE = 0.5  # below it the telemetry's share of the hands is that of their radii [N m]


class HybridRotation(Grasping, Turning, Releasing):
    """The mathematics of the stage: one step, of whichever mode it is."""

    def step(
        self, time: float, dt: float, memory: Memory, state: RobotState, mode: ModeState, plan: GraspPlan
    ) -> tuple[Memory, Command]:
        """One tick of length dt -> memory (with status and telemetry), command."""
        if mode.mode not in AT_VALVE:
            idle = memory if memory.activation < 0 else changed(memory, activation=-1, status=Status())
            return idle, Command(time=time)
        q = (state.left_arm, state.right_arm)
        posture = self.robot.held(state.torso)
        X = (self.robot.forward(LEFT, q[0], posture), self.robot.forward(RIGHT, q[1], posture))
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
        m = self._move(dt, m, V, chain, posture)
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
        c: HybridRotationConfig = self.config
        raw = (state.left_wrench, state.right_wrench)
        if mode.mode == Mode.REACH:
            speeds = (*state.left_arm_velocity.tolist(), *state.right_arm_velocity.tolist())
            if not all(abs(speed) < AT_REST for speed in speeds) or not np.isfinite(raw).all():
                return changed(m, tared=False) if m.tared else m
            load = np.array(
                [raw[k] - gravity_wrench(X[k][:, :3], self.robot.hands[side]) for k, side in enumerate(SIDES)]
            )
            a = 1 - np.exp(-dt / c.tare_time)
            bias = m.bias + a * (load - m.bias) if m.tared else load
            return changed(m, bias=bias, tared=True, wrenches=np.zeros((2, 6)))
        now = np.array(
            [contact_wrench(raw[k], m.bias[k], X[k][:, :3], self.robot.hands[side]) for k, side in enumerate(SIDES)]
        )
        a = 1 - np.exp(-2 * np.pi * c.filter * dt)
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
            behind=(None, None),
            back=0.0,
            pace=math.inf,
            rate=0.0,
            progress_at=(time, 0.0),
            stalls=0,
            stiff=False,
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
            share_left=float(couples[0] / chain.torque) if abs(chain.torque) > NO_TORQUE else chain.share,
            force_left=chain.f[0],
            force_right=chain.f[1],
            moment_left=chain.m[0],
            moment_right=chain.m[1],
            stem_force=chain.f[0] + chain.f[1],
            squeeze=float((chain.f[1] - chain.f[0]) @ chain.b / 2),
            center=chain.c,
            axis=chain.u,
        )
