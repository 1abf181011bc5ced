"""command_selector on ports. The mathematics: command_selector.py."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, State

from valve_drake.messages import Command, Health, ModeState, RobotState, SelectorReport
from valve_drake.ports import Block, Inputs
from valve_drake.supervisor.command_selector import (
    BEHAVIORS,
    PORTS,
    CommandSelectorConfig,
    Memory,
    outputs,
    start,
    step,
)


class CommandSelectorSystem(Block):
    """The only writer to the robot; 1/128 s, slot 2.

    | port | dir | type |
    |---|---|---|
    | mode | in | ModeState |
    | robot_state | in | RobotState |
    | health | in | Health |
    | valve_search, base_approach, kinematic_approach, image_servo, hybrid_rotation | in | Command (may be open) |
    | base.twist_command | out | 2: forward [m/s], yaw rate [rad/s] |
    | torso.position_command | out | 3 [rad] |
    | left_arm.position_command, right_arm.position_command | out | 6 [rad] |
    | left_gripper.position_command, right_gripper.position_command | out | 1: opening [m] |
    | left_gripper.force_limit, right_gripper.force_limit | out | 1 [N] |
    | report | out | SelectorReport |

    initial: what the output vectors hold until the first robot state, by port name.
    """

    INPUTS = {"mode": ModeState, "robot_state": RobotState, "health": Health} | dict.fromkeys(BEHAVIORS, Command)
    OUTPUTS = PORTS | {"report": SelectorReport}

    def __init__(
        self, config: CommandSelectorConfig, initial: Mapping[str, np.ndarray], name: str = "command_selector"
    ):
        config.check()
        self.config = config
        self._start = start(config, initial)
        super().__init__(name, slot=2)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._hold_initial)

    def initial(self) -> Memory:
        return self._start

    def _hold_initial(self, context: Context, state: State) -> None:
        # The plant reads the ports before the first step; a simulator that is initialised again changes nothing.
        for port, value in outputs(self.memory(context)).items():
            state.get_mutable_discrete_state(int(self._held[port])).SetFromVector(value)

    def step(self, time: float, inputs: Inputs, memory: Memory) -> tuple[Memory, dict[str, Any]]:
        commands = {name: getattr(inputs, name) for name in BEHAVIORS}
        memory, report = step(
            self.config, memory, time, self.period, inputs.mode, inputs.robot_state, inputs.health, commands
        )
        return memory, outputs(memory) | {"report": report}
