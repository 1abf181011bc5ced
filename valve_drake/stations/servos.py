"""What a robot's model file leaves to the simulation: servos of its joints, and which of its shapes may touch."""

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from valve_drake.collision import CollisionModel, exclude
from valve_drake.messages import SIDES
from valve_drake.robot.robot import Robot

FULL = 0.03  # a servo without gains in the file gives its full effort this far off; raise it if it shakes [rad, m]
GRIP_STIFFNESS, GRIP_DAMPING = 2e4, 2e2  # of such a gripper's actuator, along half the opening [N/m, N s/m]
DAMPING = 0.03  # of such a servo, as a share of its stiffness; raise it if it swings [s]


def add_servos(plant: MultibodyPlant, model: ModelInstanceIndex, robot: Robot) -> None:
    """Gains for all of the robot's actuators: robot.yaml's stiffness, else those of the file, else by the effort.

    For a plant that is not finalized.
    """
    wanted = {
        joint: stiffness
        for side in SIDES
        for joint, stiffness in zip(robot.arms[side].names, robot.description.arm(side).stiffness)
    }
    grippers = {gripper.joint: gripper for gripper in robot.grippers.values()}
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        if actuator.model_instance() != model:
            continue
        stiffness = wanted.get(actuator.joint().name())
        if stiffness is None and actuator.has_controller():
            continue
        gripper = grippers.get(actuator.joint().name())
        if gripper is not None:
            lever = gripper.lever(gripper.position(robot.opening / 2))
            gains = PdControllerGains(p=GRIP_STIFFNESS * lever**2, d=GRIP_DAMPING * lever**2)
        else:
            stiffness = actuator.effort_limit() / FULL if stiffness is None else stiffness
            gains = PdControllerGains(p=stiffness, d=DAMPING * stiffness)
        actuator.set_controller_gains(gains)


def ignore_touching(plant: MultibodyPlant, scene_graph: SceneGraph, model: ModelInstanceIndex, robot: Robot) -> None:
    """Links that may touch do not collide (robot.yaml's `collision`).

    For a plant that is finalized.
    """
    exclude(plant, scene_graph.collision_filter_manager(), model, CollisionModel(robot).ignored)
