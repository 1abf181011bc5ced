"""base_approach on ports. The mathematics: base_approach.py."""

from typing import Any

from valve_drake.behaviors.base_approach import BaseApproachConfig, Memory, step
from valve_drake.messages import Command, ModeState, RectangleEstimate, RobotState, Stance, Status, StereoPosition
from valve_drake.ports import TICK, Block, Inputs

NO_POSITION, NO_ESTIMATE, NO_STANCE = StereoPosition(), RectangleEstimate(), Stance()


class BaseApproachSystem(Block):
    """Driving to the valve and back; 1/64 s (wheels and neck need no more), slot 1.

    | port | dir | type |
    |---|---|---|
    | robot_state | in | RobotState |
    | mode | in | ModeState |
    | position | in | StereoPosition (may be open) |
    | estimate | in | RectangleEstimate (may be open) |
    | stance | in | Stance of kinematic_approach (may be open) |
    | command | out | Command: base_twist in its modes |
    | status | out | Status |
    """

    INPUTS = {
        "robot_state": RobotState,
        "mode": ModeState,
        "position": StereoPosition,
        "estimate": RectangleEstimate,
        "stance": Stance,
    }
    OUTPUTS = {"command": Command, "status": Status}

    def __init__(self, config: BaseApproachConfig, name: str = "base_approach"):
        config.check()
        self.config = config
        super().__init__(name, period=2 * TICK)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: Inputs, memory: Memory) -> tuple[Memory, dict[str, Any]]:
        position, estimate, stance = inputs.position, inputs.estimate, inputs.stance
        memory, command, status = step(
            self.config,
            memory,
            time,
            self.period,
            inputs.robot_state,
            inputs.mode,
            NO_POSITION if position is None else position,
            NO_ESTIMATE if estimate is None else estimate,
            NO_STANCE if stance is None else stance,
        )
        return memory, {"command": command, "status": status}
