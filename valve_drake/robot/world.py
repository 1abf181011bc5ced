"""The controllers' model of the world: the robot, and a valve that can be put anywhere."""

import dataclasses as dc

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Diagram, DiagramBuilder

from valve_drake.robot.description import RobotDescription
from valve_drake.robot.model import Mimic, add_robot, mimics
from valve_drake.valve.model import add_valve
from valve_drake.valve.valve import Valve


@dc.dataclass(frozen=True)
class Model:
    """The controllers' model of the world, apart from the simulated plant."""

    diagram: Diagram
    plant: MultibodyPlant
    scene_graph: SceneGraph
    robot: ModelInstanceIndex
    valve: ModelInstanceIndex
    shape: Valve  # what `valve` was made from
    mimics: tuple[Mimic, ...]


def make_model(robot: RobotDescription, valve: Valve) -> Model:
    """Raises ConfigError: what the robot's or the valve's file lacks."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    model = add_robot(plant, robot)
    valve_model = add_valve(plant, valve)
    plant.Finalize()
    return Model(builder.Build(), plant, scene_graph, model, valve_model, valve, mimics(robot))
