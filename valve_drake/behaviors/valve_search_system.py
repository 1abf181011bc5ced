"""valve_search on ports. The mathematics: valve_search.py."""

from typing import Any

from valve_drake.behaviors.valve_search import HeadPose, Memory, ValveSearchConfig, step
from valve_drake.messages import Command, ModeState, RectangleEstimate, RobotState, Status, StereoPosition
from valve_drake.ports import TICK, Block, Inputs

NO_POSITION, NO_ESTIMATE = StereoPosition(), RectangleEstimate()


class ValveSearchSystem(Block):
    """Search and gaze; 1/64 s (wheels and neck need no more), slot 1.

    | port | dir | type |
    |---|---|---|
    | robot_state | in | RobotState |
    | mode | in | ModeState |
    | position | in | StereoPosition (may be open) |
    | estimate | in | RectangleEstimate (may be open) |
    | command | out | Command: torso always, base_twist in search |
    | status | out | Status |

    head_pose: base (x, y, heading) in O, torso (3,) -> X_OL (3, 4).
    """

    INPUTS = {
        "robot_state": RobotState,
        "mode": ModeState,
        "position": StereoPosition,
        "estimate": RectangleEstimate,
    }
    OUTPUTS = {"command": Command, "status": Status}

    def __init__(self, config: ValveSearchConfig, head_pose: HeadPose, name: str = "valve_search"):
        config.check()
        self.config = config
        self.head_pose = head_pose
        super().__init__(name, period=2 * TICK)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: Inputs, memory: Memory) -> tuple[Memory, dict[str, Any]]:
        position, estimate = inputs.position, inputs.estimate
        memory, command, status = step(
            self.config,
            memory,
            time,
            self.period,
            inputs.robot_state,
            inputs.mode,
            NO_POSITION if position is None else position,
            NO_ESTIMATE if estimate is None else estimate,
            self.head_pose,
        )
        return memory, {"command": command, "status": status}
