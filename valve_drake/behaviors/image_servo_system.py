"""Block `image_servo`: stage 4 on ports. No mathematics here."""

from valve_drake.behaviors import blind_servo
from valve_drake.behaviors.blind_servo import BlindServo
from valve_drake.behaviors.image_servo import ImageServo, Memory
from valve_drake.messages import Command, GraspPlan, HandleMarks, ModeState, RobotState, ServoState, Status
from valve_drake.ports import TICK, Block, Inputs, Outputs
from valve_drake.task.modes import owned


class ImageServoInputs(Inputs):
    robot_state: RobotState
    mode: ModeState
    marks: HandleMarks
    plan: GraspPlan = GraspPlan()


class ImageServoSystem(Block[ImageServoInputs, Memory | blind_servo.Memory]):
    """Servos both hands onto the taught images of their green marks, or without a camera to the planned grasps.

    port         dir  type         notes
    -----------  ---  -----------  -----------------------------------------
    robot_state  in   RobotState
    mode         in   ModeState
    marks        in   HandleMarks
    plan         in   GraspPlan    read by hands without a camera
    command      out  Command      arms and grippers (open), in mode servo
    status       out  Status
    servo        out  ServoState   telemetry
    """

    AWAKE = frozenset(owned("image_servo"))
    OUTPUTS = {"command": Command, "status": Status, "servo": ServoState}

    def __init__(self, law: ImageServo | BlindServo, name: str = "image_servo"):
        self._law = law
        super().__init__(name)

    def initial(self) -> Memory | blind_servo.Memory:
        return Memory() if isinstance(self._law, ImageServo) else blind_servo.Memory()

    def step(
        self, time: float, inputs: ImageServoInputs, memory: Memory | blind_servo.Memory
    ) -> tuple[Memory | blind_servo.Memory, Outputs]:
        law, state, mode = self._law, inputs.robot_state, inputs.mode
        after: Memory | blind_servo.Memory
        if isinstance(law, ImageServo):
            assert isinstance(memory, Memory)
            after, command, servo = law.step(time, TICK, memory, state, mode, inputs.marks)
        else:
            assert isinstance(memory, blind_servo.Memory)
            after, command, servo = law.step(time, TICK, memory, state, mode, inputs.plan)
        return after, {"command": command, "status": after.status, "servo": servo}
