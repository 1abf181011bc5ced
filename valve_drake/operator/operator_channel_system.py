"""Block `operator_channel`: the operators' channel on ports. No mathematics here."""

from valve_drake.messages import (
    HandleMarks,
    ModeState,
    OperatorCommand,
    OperatorPackets,
    OperatorState,
    RectangleEstimate,
    Status,
)
from valve_drake.operator.operator_channel import OperatorChannelConfig, State, seen, step
from valve_drake.ports import Block, Inputs, Outputs


class OperatorChannelInputs(Inputs):
    packets: OperatorPackets = OperatorPackets()
    local: OperatorCommand = OperatorCommand()
    mode: ModeState
    turning: Status
    estimate: RectangleEstimate
    marks: HandleMarks


class OperatorChannelSystem(Block[OperatorChannelInputs, State]):
    """Decides what operators' words come to; 1/32 s, slot 2, just before the supervisor.

    port      dir  type               notes
    --------  ---  -----------------  --------------------------------------------------
    packets   in   OperatorPackets    what has arrived on the wire
    local     in   OperatorCommand    the program's own command: Ctrl-C
    mode      in   ModeState
    turning   in   Status             of hybrid_rotation
    estimate  in   RectangleEstimate  what the cameras see, for the operator
    marks     in   HandleMarks
    command   out  OperatorCommand
    state     out  OperatorState      the answer; what the desk shows

    full, most: what `open` alone asks for, and the largest turn [rad].
    """

    OUTPUTS = {"command": OperatorCommand, "state": OperatorState}

    def __init__(self, config: OperatorChannelConfig, full: float, most: float, name: str = "operator_channel"):
        config.check()
        self.config = config
        self._full, self._most = full, most
        super().__init__(name, period=1 / 32, slot=2)

    def initial(self) -> State:
        return State()

    def step(self, time: float, inputs: OperatorChannelInputs, memory: State) -> tuple[State, Outputs]:
        mode = inputs.mode
        sees = seen(mode, inputs.estimate, inputs.marks)
        after = step(
            self.config, self._full, self._most, memory, time, inputs.packets, inputs.local, mode, inputs.turning, sees
        )
        outputs: Outputs = {}
        if after.command is not memory.command:
            outputs["command"] = after.command
        if after.shown is not memory.shown:
            outputs["state"] = after.shown
        return after, outputs
