"""The valve as one value: what its keys refuse, its grasps and marks, its model in Drake."""

import re

import numpy as np
import pytest
from pydrake.geometry import Box
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from robot_facts import ROBOT

from valve_drake import resources
from valve_drake import scenario as scenarios
from valve_drake.behaviors.stance_config import StanceConfig
from valve_drake.behaviors.stance_search import Stances
from valve_drake.checks import ConfigError
from valve_drake.collision import CollisionModel
from valve_drake.diagram import make_blocks
from valve_drake.frames import compose, inverse, make, rot_y, rot_z, wrap
from valve_drake.robot import description
from valve_drake.robot.robot import Robot
from valve_drake.valve.model import add_valve, marker_frame
from valve_drake.valve.valve import HandleConfig, Valve, heading, turned

OURS = description.find(description.OURS)
FACING = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # R of an upright valve straight ahead
WHEEL = """
valve:
  model: ""
  handles:
  - {kind: rim, xyz: [0.15, 0, 0]}
  - {kind: rim, xyz: [-0.075, 0.1299, 0]}
  - {kind: rim, xyz: [-0.075, -0.1299, 0]}
  spokes: 3
"""


def valve(text: str) -> Valve:
    scenario = scenarios.parse(text, "a file")
    scenario.check()
    return scenario.valve


PANEL = "valve: {marker: {carrier: panel, size: [0.06, 0.06], xyz: %s}}"
HANDLES = "valve: {model: '', handles: [%s]}"
RIMS = "{kind: rim, xyz: [0.2, 0, 0]}, {kind: rim, xyz: [-0.2, 0, 0]}"
GOOD = "{xyz: [0.15, 0, 0]}, {xyz: [-0.15, 0, 0]}"

WRONG = {
    "valve: {colour: red}": "unknown key valve.colour",
    "valve: {marker: {sise: [0.1, 0.1]}}": "unknown key valve.marker.sise",
    "valve: {marker: {size: [0.1]}}": "valve.marker.size must be 2 values",
    "valve: {marker: {size: [98, 100]}}": "valve.marker.size[0] must be within [0.005, 2]",
    "valve: {marker: {size: [0.1, 0.02]}}": "valve.marker.size must be of an aspect up to 3:1",
    "valve: {marker: {size: [0.2, 0.2]}}": "valve.marker.size must be not larger than the face",
    "valve: {marker: {xyz: [0, 0, 0.2]}}": "valve.marker.xyz must be before the panel",
    "valve: {marker: {rpy: [1.2, 0, 0]}}": "valve.marker.rpy must be facing the robot",
    PANEL % "[0, -0.2, 0.085]": "valve.marker.xyz must be at least 0.223 m off the axis on a panel",
    PANEL % "[0, -0.4, 0.085]": "valve.marker.xyz must be at most 0.235 m off the axis on a panel",
    "valve: {marker: {carrier: panel}, handles: [{xyz: [0.2, 0, 0]}, {xyz: [-0.2, 0, 0]}]}": (
        "valve.marker.carrier must be wheel: a panel's marker beside these handles, 0.301 m off the axis, is not seen"
    ),
    "valve: {marker: {carrier: door}}": "valve.marker.carrier must be wheel or panel",
    "valve: {model: '', marker: {mark_height: 0.001}}": "valve.marker.mark_height must be at least 0.003 on handles",
    "valve: {opens: left}": "valve.opens must be counter_clockwise or clockwise",
    HANDLES % "{xyz: [0.15, 0, 0]}": "valve.handles must be 2 to 12 places",
    HANDLES % (GOOD + ", {xyz: [0.15, 0]}"): "valve.handles[2].xyz must be 3 values",
    HANDLES % (GOOD + ", {xyz: [0.02, 0, 0]}"): "valve.handles[2].xyz must be at least 0.05 m off the axis",
    HANDLES % (GOOD + ", {xyz: [0.15, 0.1, 0.3]}"): "valve.handles[2].xyz must be before the panel",
    HANDLES % (GOOD + ", {xyz: [0, 0.15, 0], kind: knob}"): "valve.handles[2].kind must be bar or lever or rim",
    HANDLES % (GOOD + ", {xyz: [0, 0.15, 0], width: 0.2}"): "valve.handles[2].width must be within",
    HANDLES % (GOOD + ", {xyz: [0, 0.15, 0], along: [0, 0, 1]}"): "valve.handles[2].along must be a direction across",
    HANDLES % "{xyz: [0.15, 0, 0]}, {xyz: [0.14, 0.05, 0]}": "valve.handles must be two of them at least 0.12 m apart",
    HANDLES % "{kind: bar}, {kind: bar}": (
        "valve.handles[1].xyz must be a place of its own, 0.02 m or more from valve.handles[0], got [0.15, 0.0, 0.0]"
    ),
    HANDLES % (GOOD + ", {xyz: [0.15, 0.01, 0]}"): "valve.handles[2].xyz must be a place of its own",
    HANDLES % "{xyz: [0.1, 0, 0], length: 0.25}, {xyz: [-0.1, 0, 0]}": (
        "valve.handles[0].length must be at most 0.2: it reaches beyond the axis, got 0.25"
    ),
    "valve: {model: '', marker: {xyz: [0, 0, 0.05]}}": (
        "valve.marker.xyz must be before the valve's bars and spokes, z at most -0.0125: they hide it, got [0.0"
    ),
    HANDLES[:-1] % RIMS + ", marker: {xyz: [0, 0, 0]}}": (
        "valve.marker.xyz must be before the valve's bars and spokes, z at most -0.008"
    ),
    HANDLES % "{xyz: [0.15, 0, 0]}, {xyz: [0.15, 0, -0.2]}": "two of them at least 0.12 m apart across the axis",
    HANDLES % "{xyz: [0.15, 0, 0], kind: rim}, {xyz: [-0.2, 0, 0], kind: rim}": "as far from the axis as all others",
    HANDLES
    % "{xyz: [0.2, 0, 0], kind: rim}, {xyz: [-0.2, 0, 0.05], kind: rim}": "as high over the panel (z) as all others",
    HANDLES
    % "{xyz: [0.2, 0, 0], kind: rim}, {xyz: [-0.2, 0, 0], kind: rim, width: 0.04}": "as wide as all others on the",
    "valve: {handles: 3}": "valve.handles must be a list",
    "valve: {panel: {depth: -1}}": "valve.panel.depth must be within",
    "valve: {obstacles: [{size: [1, 1]}]}": "valve.obstacles[0].size must be 3 values",
}


def test_a_marker_behind_the_bars_is_seen_where_none_passes_before_it():
    aside = "{model: '', marker: {xyz: [0, 0.12, 0.03], size: [0.06, 0.06], face: 0.07}}"
    assert valve("valve: " + aside).marker.xyz == [0, 0.12, 0.03]
    with pytest.raises(ConfigError, match="valve.marker.xyz must be before the valve's bars and spokes"):
        valve("valve: " + aside.replace("0.12, 0.03", "0.03, 0.03"))


def test_a_marker_too_small_to_be_seen_from_anywhere_is_refused_with_the_size_that_will_do():
    """60 px^2 are needed. Wherever a run starts, it is the same: campaigns draw that."""
    said = set()
    for distance in (2.5, 5.0):
        with pytest.raises(ConfigError) as error:
            make_blocks(
                scenarios.load(
                    None,
                    [f"simulation.start.distance={distance}", "valve.model=''", "valve.marker.size=[0.006, 0.006]"],
                )
            )
        said.add(str(error.value))
    words = r"valve\.marker\.size must be at least \[(0\.\d+), \1\]: .* color_segmentation.min_area is 60"
    (line,) = said
    found = re.match(words, line)
    assert found and float(found[1]) > 0.006, line
    enough = float(found[1]) + 0.001
    make_blocks(scenarios.load(None, ["valve.model=''", f"valve.marker.size=[{enough}, {enough}]"]))


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_valve_is_refused_in_one_line_that_names_the_key(text):
    with pytest.raises(ConfigError) as error:
        valve(text)
    assert WRONG[text] in str(error.value) and "\n" not in str(error.value)


MODELS = {
    "valve: {model: nothing.sdf}": "valve.model: no such file: nothing.sdf",
    "valve: {model: robot/robot.sdf}": "valve.model: stem must be a joint of the model",
    "valve: {handles: [{xyz: [0.2, 0, 0]}, {xyz: [-0.15, 0, 0]}]}": "valve.handles[0].xyz must be where valve.model",
    "valve: {marker: {xyz: [0.06, 0, -0.041]}}": "valve.marker.xyz must be where valve.model has its frame marker",
    "valve: {marker: {rpy: [0.5, 0, 0]}}": "valve.marker.rpy must be as valve.model has its frame marker, [0.0, ",
    PANEL % "[0, -0.23, 0.085]": "valve.marker.carrier must be where valve.model has its frame marker, wheel",
    "valve: {panel: {depth: 0.12}}": "where valve.model has its frame",
}


@pytest.mark.parametrize("text", MODELS)
def test_a_model_that_contradicts_the_keys_is_refused_in_one_line(text):
    with pytest.raises(ConfigError) as error:
        add_valve(MultibodyPlant(0.0), valve(text))
    assert MODELS[text] in str(error.value) and "\n" not in str(error.value)


STEM = '<joint name="stem" type="revolute">'
HANGS = '<joint name="bolts" type="fixed"><parent>world</parent><child>panel</child></joint></model>'
BUILT = {
    "a stem that does not turn": ("revolute", "fixed", "joint stem is revolute, from the link panel to the link wheel"),
    "a stem that slides": ("revolute", "prismatic", "joint stem is revolute, from the link panel to the link wheel"),
    "a stem that turns the other way": ("<xyz>0 0 -1</xyz>", "<xyz>0 0 1</xyz>", "stem turns about -z of the link"),
    "a stem that lies across": ("<xyz>0 0 -1</xyz>", "<xyz>1 0 0</xyz>", "stem turns about -z of the link panel"),
    "a stem beside the axis": (STEM, f"{STEM}<pose>0.05 0 0 0 0 0</pose>", "stem turns about -z of the link panel"),
    "a stem that nothing drives": ("<effort>5.1</effort>", "<effort>0</effort>", "joint stem has an actuator of its"),
    "a wheel that stands turned": (
        "<pose>0 0 0 0 0 0</pose>",
        "<pose>0 0 0.02 0 0 0.3</pose>",
        "links panel and wheel share a frame with the stem at zero",
    ),
    "a panel that hangs on the world": ("</model>", HANGS, "link panel hangs on nothing: the scene puts it anywhere"),
}


@pytest.mark.parametrize("case", BUILT)
def test_a_model_that_is_put_together_otherwise_is_refused_in_one_line(tmp_path, case):
    old, new, words = BUILT[case]
    text = (resources.models() / "valve" / "valve.sdf").read_text()
    assert old in text
    text = text.replace("../meshes/", "package://valve_drake_models/meshes/").replace(old, new, 1)
    (tmp_path / "mine.sdf").write_text(text)
    with pytest.raises(ConfigError) as error:
        Robot.load(OURS, valve(f"valve: {{model: {tmp_path}/mine.sdf}}"))
    line = str(error.value)
    assert line.startswith("valve.model must be one whose ") and words in line and "\n" not in line


def test_a_model_that_is_damaged_is_refused_by_its_key_and_not_the_robots(tmp_path):
    (tmp_path / "mine.sdf").write_text("<sdf version='1.9'><model name='valve'>")
    with pytest.raises(ConfigError, match=r"^valve.model: model .*mine.sdf cannot be read: [^\n]*$"):
        Robot.load(OURS, valve(f"valve: {{model: {tmp_path}/mine.sdf}}"))


def test_grasps_run_along_the_handle_and_close_across_it():
    shape = valve(WHEEL)
    for k, handle in enumerate(shape.handles):
        for sign in (1.0, -1.0):
            X_AG = shape.grasp(k, sign)
            assert X_AG[:, :3].T @ X_AG[:, :3] == pytest.approx(np.eye(3)) and X_AG[2, 2] == 1
            radial = np.array(handle.xyz) / 0.15
            assert X_AG[:, 0] @ radial == pytest.approx(0, abs=1e-3)  # round the rim
            assert abs(X_AG[:, 1] @ radial) == pytest.approx(1, abs=1e-3)  # the fingers are inside and outside of it


def test_the_marks_of_our_valve_are_beside_its_marker():
    target = Valve().target()
    assert target.marks.tolist() == [[0.15, 0, 0.028], [-0.15, 0, 0.028]]
    aside = valve("valve: {marker: {xyz: [0, 0.06, -0.041], rpy: [0, 0, 1.5707963267948966]}}").target()
    assert aside.marks == pytest.approx(np.array([[-0.06, -0.15, 0.028], [-0.06, 0.15, 0.028]]))


@pytest.mark.parametrize("text", ["", WHEEL])
def test_a_model_has_its_frames_where_the_keys_say_and_handles_of_the_width(text):
    """Fingers that are as far apart as a handle is wide touch it, and it turns under them about the axis."""
    shape = valve(text)
    robot = Robot.load(OURS, shape)
    plant, model = robot.model.plant, robot.model.valve
    context = plant.CreateDefaultContext()
    axis = plant.GetFrameByName("valve_axis", model)
    for angle in (0.0, 0.6):
        plant.GetJointByName("stem", model).set_angle(context, angle)
        X_PA = turned(inverse(shape.X_AP()), angle)
        for k, handle in enumerate(shape.handles):
            frame = plant.GetFrameByName(f"handle_{k + 1}", model)
            X = plant.CalcRelativeTransform(context, axis, frame).GetAsMatrix34()
            assert X == pytest.approx(compose(X_PA, make(np.eye(3), np.array(handle.xyz))), abs=1e-3)
        X = plant.CalcRelativeTransform(context, axis, marker_frame(plant, model)).GetAsMatrix34()
        assert X == pytest.approx(compose(X_PA, shape.X_AV()), abs=1e-9)
    query = robot.model.scene_graph.get_query_output_port()
    root = robot.model.diagram.CreateDefaultContext()
    inner = plant.GetMyMutableContextFromRoot(root)
    X_WP = plant.CalcRelativeTransform(inner, plant.world_frame(), axis).GetAsMatrix34()
    found = query.Eval(robot.model.scene_graph.GetMyContextFromRoot(root))
    wheel = set(plant.GetCollisionGeometriesForBody(plant.GetBodyByName("wheel", model)))
    for k, handle in enumerate(shape.handles):
        X_AG = shape.grasp(k, 1.0)
        for side in (1.0, -1.0):
            p_A = X_AG[:, 3] + X_AG[:, 1] * side * handle.width / 2
            p_W = compose(X_WP, inverse(shape.X_AP()), make(np.eye(3), p_A))[:, 3]
            near = [d for d in found.ComputeSignedDistanceToPoint(p_W, 0.02) if d.id_G in wheel]
            assert min(abs(d.distance) for d in near) < 1e-3


def test_obstacles_keep_the_arms_away_and_do_not_turn():
    X_BA = make(FACING, np.array([0.72, 0.0, 1.0]))
    text = "valve: {obstacles: [{xyz: [0.3, 0, -0.3], size: [0.2, 0.2, 0.4]}]}"
    blocked = CollisionModel(Robot.load(OURS, valve(text)))
    q = ROBOT.home.copy()
    X_BG = make(FACING @ np.diag([-1.0, -1, 1]), np.array([0.45, -0.3, 1.0]))
    q[6:] = ROBOT.inverse("right", X_BG, ROBOT.arms["right"].work)
    assert CollisionModel(ROBOT).is_free(X_BA, q)
    assert not blocked.is_free(X_BA, q) and "obstacle_1" in str(blocked.touching(X_BA, q))
    assert not blocked.is_free(turned(X_BA, 1.0), q)  # the valve turned, the box has not
    assert blocked.is_free(X_BA, ROBOT.home)


def test_heading_is_that_of_the_axis_or_of_the_view_where_the_axis_is_upright():
    viewer = np.array([0.0, 0.0])
    for tilt in (0.0, 0.8):
        X = make(rot_z(0.4) @ rot_y(tilt) @ FACING, np.array([2.0, 0.0, 1.0]))
        assert heading(X, viewer) == pytest.approx(0.4)
    X = make(rot_z(0.4) @ rot_y(np.pi / 2) @ FACING, np.array([2.0, 2.0, 0.8]))
    assert heading(X, viewer) == pytest.approx(np.pi / 4)


def test_handles_run_outwards_or_round_the_axis_unless_they_say_otherwise():
    for kind, along in (("bar", [0.6, 0.8, 0]), ("lever", [0.6, 0.8, 0]), ("rim", [-0.8, 0.6, 0])):
        assert HandleConfig(kind=kind, xyz=[0.09, 0.12, 0.0]).direction() == pytest.approx(along)
    given = HandleConfig(xyz=[0.09, 0.12, 0.0], along=[0.0, 2.0, 0.0])
    assert given.direction().tolist() == [0, 1, 0]


def boxes(text: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The wheel's boxes of a valve that is made of its keys: name -> pose in A (3, 4), size (3,)."""
    shape = valve(text)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    model = add_valve(plant, shape)
    inspector = scene_graph.model_inspector()
    out = {}
    for shape_id in plant.GetCollisionGeometriesForBody(plant.GetBodyByName("wheel", model)):
        form, X = inspector.GetShape(shape_id), inspector.GetPoseInFrame(shape_id).GetAsMatrix34()
        if isinstance(form, Box):
            out[inspector.GetName(shape_id).rpartition("::")[2]] = compose(shape.X_AP(), X), form.size()
    return out


def test_a_bar_goes_straight_out_from_the_axis_whichever_way_its_direction_is_written():
    one = "valve: {model: '', handles: [{xyz: [0.15, 0, 0], length: 0.3%s}, {xyz: [-0.15, 0, 0]}]}"
    (X, size), (X_in, size_in) = boxes(one % "")["bar_1"], boxes(one % ", along: [-1, 0, 0]")["bar_1"]
    assert X[:, 3] == pytest.approx([0.15, 0, 0]) and size == pytest.approx([0.3, 0.025, 0.025])
    assert X_in[:, 3] == pytest.approx(X[:, 3]) and size_in == pytest.approx(size)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_handle_across_its_arm_is_a_crank_and_runs_where_its_grasp_is(sign):
    made = boxes(
        f"valve: {{model: '', handles: [{{xyz: [0.15, 0, 0], along: [0, {sign}, 0]}}, {{xyz: [-0.15, 0, 0]}}]}}"
    )
    X, size = made["bar_1"]
    assert abs(X[:, 0]) == pytest.approx([0, 1, 0], abs=1e-9)  # its length is along the handle
    ends = sorted(X[1, 3] + side * size[0] / 2 for side in (1, -1))
    assert X[[0, 2], 3] == pytest.approx([0.15, 0]) and size[1:] == pytest.approx([0.025, 0.025])
    free = [-0.03, 0.03]  # for a hand; beside it is the foot
    foot = 0 if abs(ends[0]) > abs(ends[1]) else 1
    assert ends[1 - foot] == pytest.approx(free[1 - foot]) and abs(ends[foot] - free[foot]) == pytest.approx(0.025)
    riser, tall = made["bar_1_riser"]
    assert riser[:, 3] == pytest.approx([0.15, np.sign(free[foot]) * 0.0425, 0.025]) and tall[2] == pytest.approx(0.075)
    arm, length = made["bar_1_arm"]
    both = [arm[:, 3] + side * arm[:, 0] * length[0] / 2 for side in (1, -1)]
    near, far = sorted(both, key=lambda end: float(np.hypot(*end[:2])))
    assert near == pytest.approx([0, 0, 0.05], abs=1e-9) and far[:2] == pytest.approx(riser[:2, 3])


def test_both_hands_hold_the_cranks_of_a_valve_that_is_made_of_its_keys():
    crank = "{xyz: [%s, 0, 0], along: [0, 1, 0]}"
    handles = f"[{crank % 0.15}, {crank % -0.15}]"
    shape = valve(f"valve: {{model: '', marker: {{size: [0.08, 0.08], face: 0.1}}, handles: {handles}}}")
    robot = Robot.load(OURS, shape)
    X_OA = compose(make(FACING, np.array([1.5, 0, 1.0])), inverse(shape.X_AP()))
    along = dict.fromkeys(("left", "right"), np.array([0.0, 0.0, 1.0]))
    stances = Stances(robot, shape, StanceConfig(), along, CollisionModel(robot).is_free)
    assert stances.find(X_OA, np.pi / 2)[1] > 0.5


@pytest.mark.parametrize(("handles", "spokes"), [((0, 180), 4), ((0, 180), 2), ((0, 100), 3), ((10, 200, 290), 1)])
def test_a_rims_spokes_are_as_far_from_its_handles_as_they_can_be(handles, spokes):
    degrees = np.radians(handles)
    places = ", ".join(f"{{kind: rim, xyz: [{0.15 * np.cos(a)}, {0.15 * np.sin(a)}, 0]}}" for a in degrees)
    made = boxes(f"valve: {{model: '', handles: [{places}], spokes: {spokes}}}")
    at = [np.arctan2(X[1, 3], X[0, 3]) for name, (X, _) in made.items() if name.startswith("spoke")]
    room = min(abs(wrap(a - float(b))) for a in at for b in degrees)
    turns = np.linspace(0, 2 * np.pi / spokes, 721)
    apart = [wrap(t + 2 * np.pi * k / spokes - float(b)) for t in turns for k in range(spokes) for b in degrees]
    best = np.abs(apart).reshape(len(turns), -1).min(1).max()
    assert len(at) == spokes and room > best - 0.03


def test_a_wheel_that_is_spread_evenly_keeps_its_spokes_half_way_between():
    made = boxes(WHEEL)
    at = sorted(np.arctan2(X[1, 3], X[0, 3]) for name, (X, _) in made.items() if name.startswith("spoke"))
    assert np.degrees(at) == pytest.approx([-180, -60, 60], abs=0.1) or np.degrees(at) == pytest.approx(
        [-60, 60, 180], abs=0.1
    )


@pytest.mark.parametrize("kind", ["bar", "rim", "crank"])
@pytest.mark.parametrize(("width", "high", "thick"), [(0.025, 0.013, 0.025), (0.06, 0.013, 0.025), (0.06, 0.04, 0.06)])
def test_green_marks_lie_on_wide_handles_and_not_within(kind, width, high, thick):
    along = ", along: [0, 1, 0]" if kind == "crank" else ""
    one = f"kind: {'bar' if kind == 'crank' else kind}, width: {width}{along}"
    places = f"{{xyz: [0.15, 0, 0], {one}}}, {{xyz: [-0.15, 0, 0], {one}}}"
    made = boxes(f"valve: {{model: '', marker: {{mark_height: {high}}}, handles: [{places}]}}")
    size = made["rim_1" if kind == "rim" else "bar_1"][1]
    assert width in size.tolist() and size[2] == pytest.approx(thick) and size[2] / 2 <= high - 0.0005 + 1e-9
