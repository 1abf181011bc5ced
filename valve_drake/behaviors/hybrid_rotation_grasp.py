"""Stage 5, mode `grasp`: fingers close while the arms yield; proved by opening, force and a tug."""

import numpy as np

from valve_drake.behaviors.closed_chain import (
    Chain,
    twists,
)
from valve_drake.behaviors.hybrid_rotation_config import HybridRotationConfig
from valve_drake.behaviors.hybrid_rotation_hands import Hands, Memory
from valve_drake.memory import changed
from valve_drake.messages import (
    ModeState,
    RobotState,
    Status,
    Verdict,
)

HELD = 0.4  # both grippers hold for so long before the tug; raise it for fingers that bounce [s]
MOST_PULL = 40.0  # of both hands, that the tug makes up for, at most: beyond it the hands yield again [N]


class Grasping(Hands):
    """Mode `grasp`."""

    def _grasp(
        self, time: float, dt: float, m: Memory, state: RobotState, mode: ModeState, chain: Chain
    ) -> tuple[Memory, np.ndarray, np.ndarray]:
        c: HybridRotationConfig = self.config
        gripper = np.array([0.0, c.grip_force])
        extra = np.zeros(6)
        if m.stage == "close":
            held = self._held(m, state)
            m = changed(m, held_time=m.held_time + dt if held else 0.0)
            if m.held_time >= HELD:
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
                extra[3:] = c.tug_speed * chain.u + chain.u * min(float(np.sum(pull)), MOST_PULL) / (2 * c.damping)
        elif m.stage == "settle" and time - m.since > c.relax:
            if self._held(m, state):
                status = Status(time, m.activation, "succeeded", detail=self._openings(state))
                m = changed(m, stage="held", status=status)
            else:
                m = self._fail(time, m, Verdict.GRASP_MISSED, self._openings(state))
        return m, twists(chain, None, c, extra), gripper
