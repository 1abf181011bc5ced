"""Block `image_servo`: stage 4 on ports. No mathematics here."""

from valve_drake.behaviors.image_servo import ImageServo, Memory
from valve_drake.messages import Command, HandleMarks, ModeState, RobotState, ServoState, Status
from valve_drake.ports import TICK, Block, Inputs, Outputs
from valve_drake.task.modes import owned


class ImageServoInputs(Inputs):
    robot_state: RobotState
    mode: ModeState
    marks: HandleMarks


class ImageServoSystem(Block[ImageServoInputs, Memory]):
    """Servos both hands onto the taught images of their green marks.

    port         dir  type         notes
    -----------  ---  -----------  -----------------------------------------
    robot_state  in   RobotState
    mode         in   ModeState
    marks        in   HandleMarks
    command      out  Command      arms and grippers (open), in mode servo
    status       out  Status
    servo        out  ServoState   telemetry
    """

    AWAKE = frozenset(owned("image_servo"))
    OUTPUTS = {"command": Command, "status": Status, "servo": ServoState}

    def __init__(self, law: ImageServo, name: str = "image_servo"):
        self._law = law
        super().__init__(name)

    def initial(self) -> Memory:
        return Memory()

    def step(self, time: float, inputs: ImageServoInputs, memory: Memory) -> tuple[Memory, Outputs]:
        memory, command, servo = self._law.step(time, TICK, memory, inputs.robot_state, inputs.mode, inputs.marks)
        return memory, {"command": command, "status": memory.status, "servo": servo}
