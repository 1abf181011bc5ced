"""Stage 5, mode `turn`: both hands turn the valve; what ends it: the angle, a stall, a slip, the reach, a force."""

import math

import numpy as np

from valve_drake.behaviors.closed_chain import (
    Chain,
    torque_limit,
    turn_rate,
    twists,
)
from valve_drake.behaviors.hybrid_rotation_config import HybridRotationConfig
from valve_drake.behaviors.hybrid_rotation_hands import Hands, Memory
from valve_drake.memory import changed
from valve_drake.messages import (
    LEFT,
    RIGHT,
    ModeState,
    RobotState,
    Status,
    Verdict,
)

SAME_PLACE = np.radians(2)  # two stalls so near to each other are of one cause [rad]
LOOK = 8  # ticks between two looks at the arms' margins, in which the valve turns by 0.4 deg at most; each takes 70 us

STALLS = 3  # after so many, in different places, one more is a stuck valve
TRIPPED = 3  # ticks in a row above force_trip that end the turn
STIFF = 0.6  # share of torque_limit from which a force that trips is the valve's; below, something else is touched
TELLING = 2.0  # torque from which it tells how the hands share it; raise it for noisy sensors [N m]
IDLE = 0.2  # of the share that a hand should carry: with less of it, it does not hold the valve any more
LOST = 0.5  # for so long an opening or a share is no grasp's: then it is lost [s]
AT_LIMIT = 0.02  # arm margin at which a turn ends


class Turning(Hands):
    """Mode `turn`."""

    def _turn(
        self, time: float, dt: float, m: Memory, state: RobotState, mode: ModeState, chain: Chain
    ) -> tuple[Memory, np.ndarray, np.ndarray]:
        c: HybridRotationConfig = self.config
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
            detail = f"{np.degrees(m.plan.turned + m.turned):.2f} deg by the hands"
            status = Status(
                time, m.activation, "succeeded", detail=detail, progress=1.0, value=m.plan.turned + m.turned
            )
            m = changed(m, stage="there", status=status)
            return m, twists(chain, None, c, np.zeros(6)), gripper
        lead = sense * (m.commanded - m.turned)
        limit = torque_limit(chain, c, 1.0 if m.stalls else c.gentle)
        rate = turn_rate(left, m.rate, sense * chain.torque, lead, c, dt, limit)
        if mode.held:  # it slows down to rest; a stall is none
            rate = min(rate, max(m.rate - c.rate / c.ramp * dt, 0.0))
            m = changed(m, progress_at=(time, m.turned))
        m = changed(m, rate=rate, commanded=m.commanded + sense * rate * dt)
        progress = min(max((m.plan.turned + m.turned) / mode.turn_angle, 0.0), 1.0)
        m = changed(m, status=Status(time, m.activation, "running", progress=progress, value=m.plan.turned + m.turned))
        m = self._stall(time, m, sense, left)
        return m, twists(chain, sense * rate, c, np.zeros(6), limit), gripper

    def _stall(self, time: float, m: Memory, sense: float, left: float) -> Memory:
        """After a stall it turns the other way, and then on with all the torque that is allowed: if it was free that
        way and stalls in the same place, that is an end stop; if it stalls in both senses, the valve is stuck."""
        c: HybridRotationConfig = self.config
        since, angle = m.progress_at
        if sense * (m.turned - angle) > c.stall_angle:
            return changed(m, progress_at=(time, m.turned))
        free = m.stage == "back" and left <= c.tolerance
        again = m.stage == "turn" and m.stiff and abs(m.turned - m.stalled_at) < SAME_PLACE
        if not free and time - since <= (c.stall_time / 2 if again else c.stall_time):
            return m
        if m.stage == "back":  # turn on, with more force than before
            return changed(m, stage="turn", rate=0.0, progress_at=(time, m.turned), commanded=m.turned, stiff=not free)
        here = f"{np.degrees(m.plan.turned + m.turned):.1f} deg"
        if again:
            detail = f"stiff both ways at {here}, {m.telemetry.torque:.1f} N m"
            return self._fail(time, m, Verdict.STUCK, detail)
        if m.stalls > 0 and abs(m.turned - m.stalled_at) < SAME_PLACE:
            return self._fail(time, m, Verdict.END_STOP, f"stopped twice at {here}, free the other way")
        if m.stalls >= STALLS:
            return self._fail(time, m, Verdict.STUCK, f"stalled {m.stalls + 1} times")
        return changed(
            m,
            stage="back",
            rate=0.0,
            stalls=m.stalls + 1,
            stalled_at=m.turned,
            progress_at=(time, m.turned),
            commanded=m.turned,
            stiff=False,
        )

    def _watch(self, time: float, dt: float, m: Memory, state: RobotState, chain: Chain) -> Memory:
        """Force trip, grasp lost, one hand carrying all, end of reach."""
        c: HybridRotationConfig = self.config
        force = [math.hypot(*f) for f in chain.f.tolist()]
        m = changed(m, tripped=m.tripped + 1 if max(force) > c.force_trip else 0)
        if m.tripped >= TRIPPED:
            verdict = Verdict.STUCK if abs(chain.torque) > STIFF * c.torque_limit else Verdict.FAULT
            return self._fail(time, m, verdict, f"hand forces {force[0]:.0f} and {force[1]:.0f} N")
        off = max(self._off(m, state)) > 2 * c.grip_margin
        share = chain.couples[0] / chain.torque if abs(chain.torque) > TELLING else chain.share
        bad = off or not IDLE * chain.share < share < 1 - IDLE * (1 - chain.share)
        m = changed(m, bad_grip_time=m.bad_grip_time + dt if bad else 0.0)
        if m.bad_grip_time > LOST:
            detail = f"{self._openings(state)}, left hand carries {100 * share:.0f} %"
            return self._fail(time, m, Verdict.SLIP, detail)
        if round(time / dt) % LOOK:
            return m
        margin = min(self.robot.margin(LEFT, state.left_arm), self.robot.margin(RIGHT, state.right_arm))
        if margin < AT_LIMIT:
            detail = f"arms at their limit at {np.degrees(m.plan.turned + m.turned):.1f} deg"
            return self._fail(time, m, Verdict.REACH_LIMIT, detail)
        return m
