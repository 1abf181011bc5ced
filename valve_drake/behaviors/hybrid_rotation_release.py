"""Stage 5, mode `release`: wrenches bled, fingers opened, hands drawn back."""

import math

import numpy as np

from valve_drake.behaviors.closed_chain import (
    Chain,
    twists,
)
from valve_drake.behaviors.grasp_geometry import standoff
from valve_drake.behaviors.hybrid_rotation_config import HybridRotationConfig
from valve_drake.behaviors.hybrid_rotation_hands import Hands, Memory
from valve_drake.memory import changed
from valve_drake.messages import (
    SIDES,
    ModeState,
    RobotState,
    Status,
)

BRISK = 0.7  # share of a joint's speed beyond which hands are drawn back more slowly; raise it if that takes too long
OPEN = 0.9  # share of an open gripper's opening from which a hand may be drawn back
OPENING = 2.0  # after so long it is drawn back all the same: fingers that do not open come off with it [s]
EASE = 1.0  # until hands that start gently are drawn back at full speed [s]


class Releasing(Hands):
    """Mode `release`."""

    def _release(
        self, time: float, dt: float, m: Memory, state: RobotState, mode: ModeState, chain: Chain
    ) -> tuple[Memory, np.ndarray, np.ndarray]:
        c: HybridRotationConfig = self.config
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
            wide = min(state.left_gripper, state.right_gripper) > OPEN * self.robot.opening
            if wide or time - m.since > OPENING:
                behind = self._behind(m, self.robot.held(state.torso))
                m = changed(m, stage="retreat", since=time, start=m.X, behind=behind)
            return m, V, opened
        if m.stage == "retreat":
            m = self._draw_back(time, dt, m, state)
            if m.back >= 1.0:
                status = Status(time, m.activation, "succeeded", progress=1.0, value=m.plan.turned + m.turned)
                m = changed(m, stage="away", status=status)
        return m, np.zeros((2, 6)), opened

    def _draw_back(self, time: float, dt: float, m: Memory, state: RobotState) -> Memory:
        """The next piece of the way back, as long as the joints can follow it.

        A joint that is too slow for its command lags behind the others: the hand leaves its straight line, and the
        fingers push the handle that is still between them. An elbow that is nearly straight is too slow for any hand.
        """
        c: HybridRotationConfig = self.config
        way, done = c.retreat_speed * (time - m.since), c.retreat * m.back
        after = self._drawn_back(m, way, state)
        haste = self._haste(dt, m, after)
        if haste <= 1 and m.pace == math.inf:
            return after
        pace = min(m.pace, c.retreat_speed if done else 0.0) + c.retreat_speed * dt / EASE
        way = done + dt * min(pace, c.retreat_speed)
        after = self._drawn_back(m, way, state)
        if (haste := self._haste(dt, m, after)) > 1:
            way = done + (way - done) / haste
            after = self._drawn_back(m, way, state)
        return changed(after, pace=(way - done) / dt, since=time - way / c.retreat_speed)

    def _drawn_back(self, m: Memory, way: float, state: RobotState) -> Memory:
        """Both hands `way` from where they let go [m]."""
        way = min(way, self.config.retreat)
        left, right = (standoff(m.start[k], self.view[side], way) for k, side in enumerate(SIDES))
        return self._command(changed(m, back=way / self.config.retreat), (left, right), self.robot.held(state.torso))

    def _haste(self, dt: float, before: Memory, after: Memory) -> float:
        """How fast the fastest joint has to be between two commands, as a share of what is allowed."""
        allowed = [BRISK * dt * self.robot.arms[side].speed for side in SIDES]
        return max(float(np.max(np.abs(after.q[k] - before.q[k]) / allowed[k])) for k in range(2))
