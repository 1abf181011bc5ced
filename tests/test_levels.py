"""The levels of the task: every scenario is found by its name, has a stance, and its valve can be built."""

import math

import numpy as np
import pytest
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from valve_drake import named_files, resources
from valve_drake import scenario as scenarios
from valve_drake.behaviors.grasp_geometry import Turn
from valve_drake.behaviors.stance_search import Stances
from valve_drake.behaviors.taught import load_taught
from valve_drake.checks import ConfigError
from valve_drake.collision import CollisionModel
from valve_drake.diagram import robot_of
from valve_drake.frames import compose, inverse, planar
from valve_drake.stations.scene import add_scene, panel_pose
from valve_drake.valve.valve import turned

LEVELS = sorted(path.name.split(".")[0] for path in (resources.diagrams() / "levels").iterdir())
WORK = [name for name in LEVELS if name[:6] in ("level1", "level2", "level3", "level4")]  # that must succeed


def test_all_levels_are_there():
    assert len(WORK) == 12
    assert all(scenarios.load(name) for name in LEVELS)


@pytest.mark.system
@pytest.mark.parametrize("name", WORK)
def test_a_level_has_a_stance_from_which_its_turn_is_made_and_its_valve_turns_as_far(name):
    scenario = scenarios.resolve(scenarios.load(name, ["seed=2"]))
    shape, valve = scenario.valve, scenario.simulation.valve
    robot, taught = robot_of(scenario), load_taught(named_files.find(scenario, "taught"))
    view = {side: reference.view for side, reference in taught.items()}
    stances = Stances(robot, shape, scenario.stance, view, CollisionModel(robot).is_free)
    X_OA = turned(compose(panel_pose(valve), inverse(shape.X_AP())), valve.bar_angle + valve.position)
    place, margin = stances.find(X_OA, scenario.angle, np.array([-2.0, 0.0]))
    assert margin > 0.3
    X_BA, left = compose(inverse(planar(*place.base)), X_OA), scenario.angle
    while left > 1e-9:
        arc = stances.best_arc(Turn(X_BA, left, posture=place.posture))
        assert arc.turn > 0.3 or arc.turn == pytest.approx(left)
        X_BA, left = turned(X_BA, arc.turn), left - arc.turn
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.01)
    scene = add_scene(plant, valve, shape, robot.description, laboratory=False)
    stem = plant.GetJointByName("stem", scene.valve)
    room = stem.position_upper_limits()[0] - stem.position_lower_limits()[0]
    assert room >= scenario.angle
    assert scenario.time_limit > 60.0 + 25.0 * scenario.angle


def test_a_scenario_states_what_differs_from_another(tmp_path):
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first.write_text("angle: 0.5\nsimulation: {valve: {friction: 3.0, height: 0.9}}\n")
    second.write_text(f"like: {first}\nsimulation: {{valve: {{friction: 4.0}}}}\n")
    found = scenarios.load(str(second))
    assert (found.angle, found.simulation.valve.friction, found.simulation.valve.height) == (0.5, 4.0, 0.9)
    for text in (f"like: {second}\n", "like: 3\n", "like: nothing.yaml\n"):
        second.write_text(text)
        with pytest.raises(ConfigError, match="like must be the name of a scenario|no such file"):
            scenarios.load(str(second))


def test_a_level_is_found_by_its_bare_name_and_by_its_file():
    for name in ("level3_full_turn", "level3_full_turn.scenario.yaml", "levels/level3_full_turn.scenario.yaml"):
        assert scenarios.load(name).angle == pytest.approx(2 * math.pi)
    assert scenarios.load("hardware").station == "hardware"
