"""Stage 3: the arms by forward and inverse kinematics; and the measurements at rest before and after the turn.

In each mode:
    idle, search, approaches  holds the arms at home
    measure   several frames at rest -> the valve's pose in the base, and the grasps that stance_planner finds for it
    reach     a collision-free joint path of both arms to the stand-off before the handles, offset along the wrist
              cameras' view; ends on arrival, or before when both green marks are large enough in the wrist images
    fold      both arms home along a collision-free path
    verify    several frames at rest: the angle that the camera measures decides
    retreat   holds home

Paths and grasps are searched by stance_planner: a request goes out (Memory.request), the arms stand still until its
answer is there.

Frames: frames.py. The base stands still from measure to verify.
"""

import numpy as np

from valve_drake.behaviors.kinematic_approach_looks import Looks
from valve_drake.behaviors.kinematic_approach_motion import Inputs as Inputs
from valve_drake.behaviors.kinematic_approach_motion import KinematicApproachConfig as KinematicApproachConfig
from valve_drake.behaviors.kinematic_approach_motion import Memory as Memory
from valve_drake.memory import changed
from valve_drake.messages import (
    LEFT,
    RIGHT,
    SIDES,
    Command,
    HandleMarks,
    Mode,
    Status,
    Verdict,
)
from valve_drake.task.modes import TABLE

# Modes in which another block moves the arms; on return the commands start from the measured joints.
NOT_OWNED = tuple(mode for mode, row in TABLE.items() if row.hands != "kinematic_approach")


class KinematicApproach(Looks):
    """The mathematics of the stage: one step, of whichever mode it is."""

    def step(self, time: float, memory: Memory, inputs: Inputs) -> tuple[Memory, Command]:
        """One tick -> new memory (with status, plan and request in it), command."""
        state, mode, turn = inputs.state, inputs.mode, inputs.turn
        measured = np.concatenate([state.left_arm, state.right_arm])
        m = memory
        mine_again = m.activation < 0 or (mode.activation != m.activation and m.mode in NOT_OWNED)
        if mode.activation != m.activation:
            m = changed(m, activation=mode.activation, mode=mode.mode, phase="start", since=time, looks=())
            m = changed(m, status=Status(time=time, activation=mode.activation, state="idle"))
        if mine_again or mode.mode in NOT_OWNED:
            m = changed(m, q=measured, path=None)
        if mode.mode == Mode.IDLE and m.X_OA0 is not None:
            m = changed(m, X_OA0=None)  # a new run counts from its own beginning
        if mode.mode in NOT_OWNED:
            return m, Command(time=time)
        run = {
            Mode.MEASURE: self._measure,
            Mode.REACH: self._reach,
            Mode.FOLD: self._fold,
            Mode.VERIFY: self._verify,
        }
        if mode.mode in run:
            m = run[Mode(mode.mode)](time, m, inputs)
        else:
            m = self._homing(time, m, self._valve(m, state, turn) if m.phase == "start" else None, inputs)
        if m.path is not None:
            m = changed(m, q=m.path.sample(time))
        gripper = np.array([self.robot.opening, self.config.gripper_force])
        arms = self.robot.split(m.q)
        command = Command(
            time=time, left_arm=arms[LEFT], right_arm=arms[RIGHT], left_gripper=gripper, right_gripper=gripper
        )
        return m, command

    # ------------------------------------------------------------ reach
    def _reach(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(m, time, "running")
            m = self._move(time, m, m.plan.q_standoff, m.plan.X_BA, m.plan.posture)
        if m.phase == "planning":
            m = self._follow(time, m, inputs.path)
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

    # ------------------------------------------------------------ fold
    def _fold(self, time: float, m: Memory, inputs: Inputs) -> Memory:
        if m.phase == "start":
            m = self._status(self._shifted(time, m, inputs.estimate, inputs.turn), time, "running")
        if m.phase in ("start", "planning", "moving"):
            m = self._homing(time, m, self._valve(m, inputs.state, inputs.turn), inputs)
            if m.phase == "blocked":
                return self._status(m, time, "failed", Verdict.REACH_LIMIT, "no collision-free path home")
        if m.phase == "home":
            m = self._status(changed(m, phase="end"), time, "succeeded", detail="arms home")
        return m
