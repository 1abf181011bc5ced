"""supervisor on ports. The mathematics: supervisor.py."""

from typing import Any

from valve_drake.messages import Health, ModeState, OperatorCommand, SelectorReport, Status
from valve_drake.ports import Block, Inputs
from valve_drake.supervisor.supervisor import BEHAVIORS, State, SupervisorConfig, step


class SupervisorSystem(Block):
    """Changes the mode, and nobody else does; 1/32 s, slot 3.

    | port | dir | type |
    |---|---|---|
    | operator | in | OperatorCommand (may be open) |
    | health | in | Health (open counts as a fault) |
    | selector | in | SelectorReport (may be open) |
    | valve_search, base_approach, kinematic_approach, image_servo, hybrid_rotation | in | Status (may be open) |
    | mode | out | ModeState |
    """

    INPUTS = {"operator": OperatorCommand, "health": Health, "selector": SelectorReport} | dict.fromkeys(
        BEHAVIORS, Status
    )
    OUTPUTS = {"mode": ModeState}

    def __init__(self, config: SupervisorConfig, name: str = "supervisor"):
        config.check()
        self.config = config
        super().__init__(name, period=1 / 32, slot=3)

    def initial(self) -> State:
        return State()

    def step(self, time: float, inputs: Inputs, memory: State) -> tuple[State, dict[str, Any]]:
        statuses = {name: getattr(inputs, name) for name in BEHAVIORS}
        state = step(self.config, memory, time, statuses, inputs.health, inputs.operator, inputs.selector)
        return state, {"mode": state.message(time)}
