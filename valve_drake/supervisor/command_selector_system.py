"""Block `command_selector`: arbitration and limits on ports. No mathematics here."""

from collections.abc import Mapping

import numpy as np

from valve_drake.messages import Command, Health, ModeState, RobotState, SelectorReport
from valve_drake.ports import Block, Inputs, Outputs
from valve_drake.robot.drive import DIFFERENTIAL, Drive
from valve_drake.robot.kinematics import Joints
from valve_drake.supervisor.command_selector import (
    SOURCE,
    CommandSelectorConfig,
    Memory,
    changes,
    outputs,
    ports,
    start,
    step,
)
from valve_drake.task.modes import BEHAVIORS

# Who commands a group in a mode: the others' commands are not read, which would take a tenth of a step.
_COMMANDING = {mode: tuple(name for name in BEHAVIORS if name in row.values()) for mode, row in SOURCE.items()}


class CommandSelectorInputs(Inputs):
    mode: ModeState
    robot_state: RobotState
    health: Health


class CommandSelectorSystem(Block[CommandSelectorInputs, Memory]):
    """The only writer to the robot; 1/128 s, slot 2.

    port                             dir  type            notes
    -------------------------------  ---  --------------  --------------------------------
    mode                             in   ModeState
    robot_state                      in   RobotState
    health                           in   Health          of the station
    (every behaviour)                in   Command         one port each, named after it
    base.twist_command               out  vector          the speeds that the base has [m/s, rad/s]
    torso.position_command           out  vector          [m, rad]
    {side}_arm.position_command      out  vector          [rad]
    {side}_gripper.position_command  out  vector(1)       opening [m]
    {side}_gripper.force_limit       out  vector(1)       [N]
    report                           out  SelectorReport

    initial: what the output vectors hold until the first robot state, by port name. torso, arms, drive: of the
    robot, the arms by side.
    """

    INPUTS = dict.fromkeys(BEHAVIORS, Command())

    def __init__(
        self,
        config: CommandSelectorConfig,
        initial: Mapping[str, np.ndarray],
        torso: Joints,
        arms: Mapping[str, Joints],
        drive: Drive = DIFFERENTIAL,
        name: str = "command_selector",
    ):
        config.check()
        self.config = config
        self._start = start(config, initial, torso, arms, drive)
        self.OUTPUTS = ports(self._start.bounds) | {"report": SelectorReport}
        super().__init__(name, slot=2)

    def initial(self) -> Memory:
        return self._start

    def initial_outputs(self) -> Outputs:
        return super().initial_outputs() | outputs(self._start)  # the plant reads the ports before the first step

    def step(self, time: float, inputs: CommandSelectorInputs, memory: Memory) -> tuple[Memory, Outputs]:
        mode = inputs.mode
        commands = {name: inputs[name] for name in _COMMANDING[mode.mode]}
        after, report = step(self.config, memory, time, self.period, mode, inputs.robot_state, inputs.health, commands)
        return after, changes(after, memory) | {"report": report}
