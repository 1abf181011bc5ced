"""Block `supervisor`: the transitions on ports. No mathematics here."""

from valve_drake.messages import Health, ModeState, OperatorCommand, SelectorReport, Status
from valve_drake.ports import Block, Inputs, Outputs
from valve_drake.supervisor.supervisor import State, SupervisorConfig, step
from valve_drake.task.modes import BEHAVIORS


class SupervisorInputs(Inputs):
    operator: OperatorCommand = OperatorCommand()
    health: Health | None = None  # a station that reports nothing is a fault
    selector: SelectorReport | None = None


class SupervisorSystem(Block[SupervisorInputs, State]):
    """Changes the mode, and nobody else does; 1/32 s, slot 3.

    port                dir  type             notes
    ------------------  ---  ---------------  ---------------------------------
    operator            in   OperatorCommand
    health              in   Health           of the station; open: a fault
    selector            in   SelectorReport
    (every behaviour)   in   Status           one port each, named after it
    mode                out  ModeState
    """

    INPUTS = dict.fromkeys(BEHAVIORS, Status())
    OUTPUTS = {"mode": ModeState}

    def __init__(self, config: SupervisorConfig, name: str = "supervisor", *, opening: float = 1.0):
        """opening: 1 if the valve opens counter-clockwise, -1 if clockwise."""
        config.check()
        self.config, self._opening = config, opening
        super().__init__(name, period=1 / 32, slot=3)

    def initial(self) -> State:
        return State()

    def step(self, time: float, inputs: SupervisorInputs, memory: State) -> tuple[State, Outputs]:
        statuses = {name: inputs[name] for name in BEHAVIORS}
        state = step(
            self.config, memory, time, statuses, inputs.health, inputs.operator, inputs.selector, self._opening
        )
        return state, {"mode": state.message(time, self.config)}
