"""Stage 5, mode `release`: wrenches bled, fingers opened, hands drawn back."""

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
            wide = min(state.left_gripper, state.right_gripper) > 0.9 * self.robot.opening
            if wide or time - m.since > 2.0:
                m = changed(m, stage="retreat", since=time, start=m.X, behind=self._behind(m, state.posture))
            return m, V, opened
        if m.stage == "retreat":
            way = min(c.retreat, c.retreat_speed * (time - m.since))
            left, right = (standoff(m.start[k], self.view[side], way) for k, side in enumerate(SIDES))
            m = self._command(changed(m, back=way / c.retreat), (left, right), state.posture)
            if way >= c.retreat:
                status = Status(time, m.activation, "succeeded", progress=1.0, value=m.plan.turned + m.turned)
                m = changed(m, stage="away", status=status)
        return m, np.zeros((2, 6)), opened
