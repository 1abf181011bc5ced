"""Block `robot_state`: gathers the station's joint-side measurements of one instant into one message."""

from typing import Any

import numpy as np

from valve_drake.messages import POSE_HISTORY, SIDES, RobotState
from valve_drake.ports import TICK, Block, Inputs, Outputs

HISTORY = round(POSE_HISTORY / TICK)  # samples of the head's motion that are kept


class RobotStateSystem(Block[Inputs, np.ndarray]):
    """All measurement ports of the station in, `robot_state` out (slot 0 of every tick).

    The ports are those of stations/contract.py, same names. The message also carries the head's motion of the
    last second, so that an image can be placed where the head was when it was taken.
    """

    INPUTS = {
        "base.odometry": 5,
        "torso.position_measured": 3,
        **{
            f"{side}_{name}": size
            for side in SIDES
            for name, size in {
                "arm.position_measured": 6,
                "arm.velocity_measured": 6,
                "arm.torque_measured": 6,
                "gripper.position_measured": 1,
                "gripper.force_measured": 1,
                "wrist.wrench": 6,
            }.items()
        },
    }
    OUTPUTS = {"robot_state": RobotState}

    def __init__(self, name: str = "robot_state"):
        super().__init__(name, slot=0)

    def initial(self) -> np.ndarray:
        return np.zeros((0, 7))

    def step(self, time: float, inputs: Inputs, memory: np.ndarray) -> tuple[np.ndarray, Outputs]:
        read = {name: inputs[name] for name in self.INPUTS}
        for vector in read.values():
            vector.setflags(write=False)  # read once, kept by the message: or it would copy it
        odometry, torso = read["base.odometry"], read["torso.position_measured"]
        kept = memory[-(HISTORY - 1) :]
        history = np.empty((len(kept) + 1, 7))
        history[:-1] = kept
        history[-1] = (time, *odometry.tolist()[:3], *torso.tolist())
        history.setflags(write=False)  # as above
        sides: dict[str, Any] = {}
        for side in SIDES:
            sides[f"{side}_arm"] = read[f"{side}_arm.position_measured"]
            sides[f"{side}_arm_velocity"] = read[f"{side}_arm.velocity_measured"]
            sides[f"{side}_arm_torque"] = read[f"{side}_arm.torque_measured"]
            sides[f"{side}_gripper"] = read[f"{side}_gripper.position_measured"].item()
            sides[f"{side}_gripper_force"] = read[f"{side}_gripper.force_measured"].item()
            sides[f"{side}_wrench"] = read[f"{side}_wrist.wrench"]
        return history, {"robot_state": RobotState(time=time, odometry=odometry, torso=torso, history=history, **sides)}
