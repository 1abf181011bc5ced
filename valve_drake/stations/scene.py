"""The simulated world as one MultibodyPlant: robot, valve, laboratory. Used by the simulated station, once with
physics and once each for the cameras and the 3D view, and by pictures in the documents."""

import dataclasses as dc
from collections.abc import Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from valve_drake import resources
from valve_drake.frames import make, rot_x, rot_y, rot_z
from valve_drake.robot import description, model
from valve_drake.robot.description import RobotDescription
from valve_drake.stations.rails import add_cover, add_stand
from valve_drake.stations.simulation_config import StartConfig, ValveConfig
from valve_drake.valve.model import add_valve
from valve_drake.valve.valve import Valve

SEIZED = 1e4  # friction of a valve that does not turn [N m]


@dc.dataclass(frozen=True)
class Scene:
    """What was added to a plant."""

    robot: ModelInstanceIndex
    valve: ModelInstanceIndex


def parse(plant: MultibodyPlant, name: str) -> ModelInstanceIndex:
    """Adds models/<name>/<name>.sdf."""
    return model.parse(plant, resources.models() / name / f"{name}.sdf")


def add_robot(
    plant: MultibodyPlant, robot: RobotDescription | None, place: Sequence[float] = (0.0, 0.0, 0.0)
) -> ModelInstanceIndex:
    """Adds the robot; None: our own. place: of a fixed base, x, y, heading in W."""
    given = description.load(description.find(description.OURS)) if robot is None else robot
    return model.add_robot(plant, given, place)


def panel_pose(valve: ValveConfig) -> np.ndarray:
    """X_WP: the panel's axis point, z into the panel -> (3, 4)."""
    R0 = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return make(rot_z(valve.yaw) @ rot_y(valve.tilt) @ R0, np.array([0, 0, valve.height]))


def _marker_offset(valve: ValveConfig, size: Sequence[float]) -> np.ndarray | None:
    """X_VM: a marker that was stuck on by hand, in the place where it is believed to be (3, 4). None of it dips into
    the face that carries it."""
    tilt, place = valve.marker_tilt, valve.marker_place
    if not any((*tilt, *place)):
        return None
    lift = abs(tilt[0]) * size[1] / 2 + abs(tilt[1]) * size[0] / 2
    return make(rot_x(tilt[0]) @ rot_y(tilt[1]) @ rot_z(tilt[2]), np.array([*place, -lift]))


def start_pose(start: StartConfig, valve: ValveConfig) -> np.ndarray:
    """Base (x, y, heading) in W -> (3,)."""
    bearing = valve.yaw + start.bearing
    xy = -start.distance * np.array([np.cos(bearing), np.sin(bearing)])
    return np.array([xy[0], xy[1], bearing + start.heading])


def add_scene(
    plant: MultibodyPlant,
    valve: ValveConfig,
    shape: Valve,
    robot: RobotDescription | None = None,
    place: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    laboratory: bool = True,
) -> Scene:
    """Adds everything to a plant that is not finalized. The valve's limits and friction are those of the config.

    place: where a fixed base is bolted down, x, y, heading in W; others are put there by their joints.
    """
    robot_model = add_robot(plant, robot, place)
    valve_model = add_valve(plant, shape, _marker_offset(valve, shape.marker.size))
    X_WP = panel_pose(valve)
    frame, X_FP = add_stand(plant, valve, X_WP)
    plant.WeldFrames(frame, plant.GetFrameByName("valve_axis", valve_model), X_FP)  # mounts the panel in the room
    add_cover(plant, valve, shape, X_WP)
    if laboratory and (resources.models() / "laboratory" / "laboratory.sdf").is_file():
        parse(plant, "laboratory")
    stem = plant.GetJointByName("stem", valve_model)
    # The joint's zero is the bar level; closed is at bar_angle.
    low, high = sorted([valve.bar_angle, valve.bar_angle + shape.sense * valve.travel])
    stem.set_position_limits([low - valve.stop_play], [high + valve.stop_play])
    # Coulomb friction: a servo to zero speed that cannot exceed the friction torque.
    friction = plant.GetJointActuatorByName("stem", valve_model)
    friction.set_controller_gains(PdControllerGains(p=1e-4, d=1e5))
    friction.set_effort_limit(SEIZED if valve.seized else max(valve.friction, 1e-6))
    return Scene(robot_model, valve_model)
