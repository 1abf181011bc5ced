"""The wrist wrench of a hand without a force sensor: computed from what its arm's joints report, in every station."""

from collections.abc import Mapping

from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, OutputPort

from valve_drake.messages import SIDES
from valve_drake.ports import PythonSystem
from valve_drake.robot.robot import Robot

READ = ("position", "velocity", "torque")  # of the arm, as its ports of the contract are called


class TorqueWrenchSystem(PythonSystem):
    """`Robot.torque_wrench` on ports.

    port                        dir  type       notes
    --------------------------  ---  ---------  ------------------------------------------
    position, velocity, torque  in   vector     of the arm, measured [rad, rad/s, N m]
    torso                       in   vector     measured [m, rad]
    wrench                      out  vector(6)  the world on the hand, at and in G [N m, N]
    """

    def __init__(self, robot: Robot, side: str):
        super().__init__()
        self.set_name(f"{side}_torque_wrench")
        count, held = len(robot.arms[side]), len(robot.posture)
        arm = [self.DeclareVectorInputPort(name, count) for name in READ]
        torso = self.DeclareVectorInputPort("torso", len(robot.torso))

        def calc(context: Context, output: BasicVector) -> None:
            position, velocity, torque = (port.Eval(context) for port in arm)
            posture = torso.Eval(context)[:held]
            output.SetFromVector(robot.torque_wrench(side, position, velocity, torque, posture))

        self.DeclareVectorOutputPort("wrench", 6, calc)


def add_torque_wrenches(
    robot: Robot | None, builder: DiagramBuilder, measured: Mapping[str, OutputPort]
) -> dict[str, OutputPort]:
    """The wrenches of the hands that have no sensor: port of the contract -> what shows it. measured: the same of the
    joints' reports. robot: None: one whose hands have sensors."""
    out: dict[str, OutputPort] = {}
    for side in SIDES:
        if robot is None or not robot.feels_by_torque(side):
            continue
        wrench = builder.AddSystem(TorqueWrenchSystem(robot, side))
        for name in READ:
            builder.Connect(measured[f"{side}_arm.{name}_measured"], wrench.GetInputPort(name))
        builder.Connect(measured["torso.position_measured"], wrench.GetInputPort("torso"))
        out[f"{side}_wrist.wrench"] = wrench.GetOutputPort("wrench")
    return out
