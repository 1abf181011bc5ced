"""The simulated world as one MultibodyPlant: robot, valve, laboratory. Used by the simulated station, once with
physics and once each for the cameras and the 3D view, and by pictures in the documents."""

import dataclasses as dc

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from valve_drake import resources
from valve_drake.frames import make, rot_y, rot_z
from valve_drake.robot import description, model
from valve_drake.robot.description import RobotDescription
from valve_drake.stations.simulation_config import StartConfig, ValveConfig

MARKER_RED = (0.80, 0.06, 0.05, 1.0)
MARKER_THICKNESS = 1e-5  # a sticker: a plate would show its rim to a camera from above [m]
SEIZED = 1e4  # friction of a valve that does not turn [N m]


@dc.dataclass(frozen=True)
class Scene:
    """What was added to a plant."""

    robot: ModelInstanceIndex
    valve: ModelInstanceIndex


def parse(plant: MultibodyPlant, name: str) -> ModelInstanceIndex:
    """Adds models/<name>/<name>.sdf."""
    return model.parse(plant, resources.models() / name / f"{name}.sdf")


def add_robot(plant: MultibodyPlant, robot: RobotDescription | None) -> ModelInstanceIndex:
    """Adds the robot; None: our own."""
    return model.add_robot(plant, description.load(description.find(description.OURS)) if robot is None else robot)


def panel_pose(valve: ValveConfig) -> np.ndarray:
    """X_WP: the panel's axis point, z into the panel -> (3, 4)."""
    R0 = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return make(rot_z(valve.yaw) @ rot_y(valve.tilt) @ R0, np.array([0, 0, valve.height]))


def start_pose(start: StartConfig, valve: ValveConfig) -> np.ndarray:
    """Base (x, y, heading) in W -> (3,)."""
    bearing = valve.yaw + start.bearing
    xy = -start.distance * np.array([np.cos(bearing), np.sin(bearing)])
    return np.array([xy[0], xy[1], bearing + start.heading])


def add_scene(
    plant: MultibodyPlant,
    valve: ValveConfig,
    marker_size: tuple[float, float],
    robot: RobotDescription | None = None,
    *,
    laboratory: bool = True,
) -> Scene:
    """Adds everything to a plant that is not finalized. The valve's limits and friction are those of the config."""
    robot_model = add_robot(plant, robot)
    valve_model = parse(plant, "valve")
    X_WP = panel_pose(valve)
    plant.WeldFrames(  # mounts the panel in the room
        plant.world_frame(),
        plant.GetFrameByName("valve_axis", valve_model),
        RigidTransform(RotationMatrix(X_WP[:, :3]), X_WP[:, 3]),
    )
    if laboratory and (resources.models() / "laboratory" / "laboratory.sdf").is_file():
        parse(plant, "laboratory")
    frame = plant.GetFrameByName("marker", valve_model)
    X_LinkMarker = frame.GetFixedPoseInBodyFrame()
    plate = RigidTransform([0, 0, MARKER_THICKNESS / 2])
    plant.RegisterVisualGeometry(
        frame.body(), X_LinkMarker @ plate, Box(*marker_size, MARKER_THICKNESS), "marker", np.array(MARKER_RED)
    )
    stem = plant.GetJointByName("stem", valve_model)
    # The joint's zero is the bar level; closed is at bar_angle.
    stem.set_position_limits([valve.bar_angle - valve.stop_play], [valve.bar_angle + valve.travel + valve.stop_play])
    # Coulomb friction: a servo to zero speed that cannot exceed the friction torque.
    friction = plant.GetJointActuatorByName("stem", valve_model)
    friction.set_controller_gains(PdControllerGains(p=1e-4, d=1e5))
    friction.set_effort_limit(SEIZED if valve.seized else max(valve.friction, 1e-6))
    return Scene(robot_model, valve_model)
