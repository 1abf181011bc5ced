"""Block `robot_state`: gathers the station's joint-side measurements of one instant into one message."""

from typing import Any

import numpy as np

from valve_drake.messages import POSE_HISTORY, SIDES, RobotState
from valve_drake.ports import TICK, Block, Inputs, Outputs
from valve_drake.robot.groups import Groups
from valve_drake.stations.contract import vectors

FIELDS = {  # of the message -> port, of each side
    "arm": "arm.position_measured",
    "arm_velocity": "arm.velocity_measured",
    "arm_torque": "arm.torque_measured",
    "wrench": "wrist.wrench",
}
HISTORY = round(POSE_HISTORY / TICK)  # samples of the head's motion that are kept


class RobotStateSystem(Block[Inputs, np.ndarray]):
    """All measurement ports of the station in, `robot_state` out (slot 0 of every tick).

    The ports are those of stations/contract.py, same names. The message also carries the head's motion of the
    last second, so that an image can be placed where the head was when it was taken.
    """

    OUTPUTS = {"robot_state": RobotState}

    def __init__(self, groups: Groups, name: str = "robot_state"):
        self.INPUTS = self._sizes = vectors(groups, "out")
        self._columns = 4 + groups.size("torso")
        self._fields = {"torso": "torso.position_measured"} | {  # of the message -> port
            f"{side}_{field}": f"{side}_{port}" for side in SIDES for field, port in FIELDS.items()
        }
        super().__init__(name, slot=0)

    def initial(self) -> np.ndarray:
        return np.zeros((0, self._columns))

    def initial_outputs(self) -> Outputs:
        zeros: dict[str, Any] = {field: np.zeros(self._sizes[port]) for field, port in self._fields.items()}
        odometry = np.zeros(self._sizes["base.odometry"])
        return {"robot_state": RobotState(odometry=odometry, history=np.zeros((0, self._columns)), **zeros)}

    def step(self, time: float, inputs: Inputs, memory: np.ndarray) -> tuple[np.ndarray, Outputs]:
        read = {name: inputs[name] for name in self.INPUTS}
        for vector in read.values():
            vector.setflags(write=False)  # read once, kept by the message: or it would copy it
        odometry, torso = read["base.odometry"], read["torso.position_measured"]
        kept = memory[-(HISTORY - 1) :]
        history = np.empty((len(kept) + 1, self._columns))
        history[:-1] = kept
        history[-1] = (time, *odometry.tolist()[:3], *torso.tolist())
        history.setflags(write=False)  # as above
        joints: dict[str, Any] = {field: read[port] for field, port in self._fields.items()}
        for side in SIDES:
            joints[f"{side}_gripper"] = read[f"{side}_gripper.position_measured"].item()
            joints[f"{side}_gripper_force"] = read[f"{side}_gripper.force_measured"].item()
        return history, {"robot_state": RobotState(time=time, odometry=odometry, history=history, **joints)}
