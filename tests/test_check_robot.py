"""check-robot: what it says of our robot, of robots that lack something, and of real ones of installed wheels."""

import json
import shutil
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from robot_facts import ROBOT
from robot_variants import fixed, part, put, stiff_neck, variant, without_base_joints, without_gaze

from valve_drake import cli, named_files, robot_check, robot_check_page, yaml_file
from valve_drake import scenario as scenarios
from valve_drake.behaviors.valve_search import ValveSearchConfig
from valve_drake.camera.lens import load_head
from valve_drake.checks import ConfigError
from valve_drake.robot import packages
from valve_drake.robot_check import DOUBTFUL, MISSING, NOTE, Report
from valve_drake.robot_sight import sees

FEW = (0.8, 1.0)  # heights: a whole table takes long


@pytest.fixture(autouse=True)
def few_rows(monkeypatch):
    monkeypatch.setattr(robot_check, "HEIGHTS", FEW)
    monkeypatch.setattr(robot_check, "TILTS", (0.0,))


def checked(path, *overrides, **kwargs) -> Report:
    scenario = scenarios.load(None, ["simulation.valve.height=1.0", *overrides])
    scenario.robot = str(path)
    return robot_check.check(scenario, str(path), **kwargs)


def said(report, level):
    return [f"{finding.stage} {finding.key}: {finding.text}" for finding in report.findings if finding.level == level]


@pytest.mark.system
def test_our_robot_is_usable_and_its_table_is_that_of_the_stances(tmp_path, capsys):
    page = tmp_path / "ours.html"
    assert cli.main(["check-robot", "robot/robot.yaml", "--json", "--html", str(page)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["usable"] and not [f for f in found["findings"] if f["level"] != NOTE]
    assert [row["joint"] for row in found["groups"]["left_arm"]] == list(ROBOT.arms["left"].names)
    assert found["grippers"]["left"]["opens_m"] == pytest.approx(0.09, abs=1e-6) and found["grippers"]["left"][
        "room_m"
    ] == pytest.approx(0.03)
    assert {row["height"] for row in found["reach"]} == {0.8, 0.81, 1.0, 1.22}
    assert all(row["serves"] and row["margin"] > 0.5 and 0.1 < row["effort"] < 0.6 for row in found["reach"])
    assert found["hidden_share"] == {"left": 0.0, "right": 0.0} and found["processor_s"] < 30
    text = page.read_text()
    assert robot_check_page.is_page(page) and text.count("data:image/png") == 4 and "left_arm_1" in text
    assert cli.main(["check-robot", "robot/robot.yaml", "--html", str(page)]) == 0  # its own page may be replaced
    assert "robot/robot.yaml: robot is usable" in capsys.readouterr().out


def test_the_effort_of_a_turn_is_that_of_the_law_of_the_lever():
    """With hands that weigh nothing, twice the friction asks twice the effort."""
    weightless = {}
    for friction in (5.0, 10.0):
        report = checked("robot/robot.yaml", f"simulation.valve.friction={friction}")
        weightless[friction] = next(row for row in report.reach if row.height == 1.0)
        assert report.friction == friction
    assert weightless[10.0].margin == weightless[5.0].margin
    assert weightless[5.0].effort < weightless[10.0].effort < 2 * weightless[5.0].effort


def at(path, value):
    def change(given):
        *inner, last = path.split(".")
        for name in inner:
            given = given[name]
        given[last] = value

    return change


def weak(model):
    put(part(model, "joint", "left_arm_3"), "axis/limit/effort", "6")


def crossed(given):
    for side, sign in (("left", -1), ("right", 1)):
        given["arms"][side]["home"] = [0, sign * 1.57, 0, 0, 0, 0]


def narrow(given):
    given.update(opening=0.05, collision={"padding": 0.01})


def off_the_hand(model):
    part(model, "frame", "left_wrist_camera").set("attached_to", "left_forearm")


LACKS = {
    "no second eye": (None, at("head_calibration", ""), MISSING, "search head_calibration: none: there is no"),
    "a calibration that is not there": (None, at("head_calibration", "h.yaml"), MISSING, "head_calibration: no such"),
    "no tilt": (None, at("gaze.tilt", ""), DOUBTFUL, "search gaze: neck_pitch moves the eyes and is not named: give"),
    "no wrist camera": (None, at("cameras.right_wrist", ""), MISSING, "servo cameras.right_wrist: no camera"),
    "a camera on the forearm": (off_the_hand, None, MISSING, "left_wrist: left_forearm does not move with the hand"),
    "nothing taught": (None, at("taught", ""), NOTE, "servo taught: none yet"),
    "references of another opening": (None, at("opening", 0.08), DOUBTFUL, "servo taught: of an opening of 85 mm, not"),
    "small hands": (None, at("opening", 0.03), MISSING, "grasp opening: the fingers open by 90 mm, from 0 to 90 mm"),
    "narrow hands": (None, narrow, DOUBTFUL, "the hand must come within 12 mm of its middle"),
    "arms too weak for their weight": (weak, None, MISSING, "reach counterbalanced: false, but the weight asks"),
    "soft servos": (
        None,
        at("arms.left.stiffness", [100, 100, 60, 30, 20, 15]),
        DOUBTFUL,
        "reach arms.*.stiffness: ",
    ),
    "arms before the eyes": (
        None,
        at("arms.left.home", [-0.9, -0.4, 0, 0, 0, 0]),
        MISSING,
        "search arms.*.home: folded, the robot hides",
    ),
    "a home that touches": (
        None,
        crossed,
        MISSING,
        "reach arms.*.home: touches or is nearer than collision.padding",
    ),
    "a home in which the arms are in each other": (
        None,
        lambda given: (crossed(given), given.update(collision={"ignore": "touching_at_home"})),
        DOUBTFUL,
        "`collision` has it that they may touch",
    ),
    "a base that is bolted down": (
        without_base_joints,
        fixed,
        NOTE,
        "approach base.drive: fixed: the valve has to be within reach",
    ),
    "a model that contradicts it": (None, at("gaze.pan", "neck"), MISSING, "load : gaze.pan must be a joint of"),
}  # fmt: skip


QUICK = ("no second eye", "no tilt", "narrow hands", "a model that contradicts it")
CASES = [case if case in QUICK else pytest.param(case, marks=pytest.mark.system) for case in LACKS]


@pytest.mark.parametrize("case", CASES)
def test_what_a_robot_lacks_is_said_with_its_key(case, tmp_path, monkeypatch):
    monkeypatch.setattr(robot_check, "_reach", lambda *arguments: None)  # it takes long, and is no matter here
    edit, change, level, words = LACKS[case]
    path = variant(tmp_path, edit or (lambda model: None), change or (lambda given: None))
    report = checked(path)
    assert any(words in line for line in said(report, level)), report.findings
    assert report.usable == (level != MISSING)
    assert all("\n" not in line for line in robot_check_page.lines(report))


@pytest.mark.parametrize(
    "yaw, heading, seen", [(1.5, 0.0, True), (1.5, 1.0, True), (1.5, 2.2, False), (0.0, np.pi, False)]
)
def test_what_is_beside_or_behind_a_robot_is_not_seen(yaw, heading, seen):
    """A point straight behind the eyes of a head that does not pan is projected into the image, too."""
    head, base = load_head(named_files.find(scenarios.load(), "head_calibration")), np.array([-1.5, 0.0, heading])
    points = np.zeros((4, 3)) + [0, 0, ROBOT.X_BL(ROBOT.torso.home)[2, 3]]
    found = sees(
        ROBOT, head, ValveSearchConfig(yaw_limit=yaw, sweep_yaw=min(yaw, 1.4)), base, ROBOT.posture.home, points
    )
    assert found == seen


@pytest.mark.system
def test_a_head_that_does_not_turn_sees_valves_of_some_heights_from_the_stance(tmp_path):
    path = variant(tmp_path, lambda model: stiff_neck(model, 0.6), without_gaze)
    report = checked(path, "simulation.valve.height=!Uniform {min: 0.9, max: 1.3}")
    upright = {row.height: row for row in report.reach if row.tilt == 0}
    assert 0 < upright[1.0].seen_to < 2 and upright[0.8].seen_to == 0 and upright[1.3].seen_to == 0
    assert any("gaze.tilt: the eyes do not see the whole marker" in line for line in said(report, DOUBTFUL))
    assert any("m from there back to 2 m" in finding.text for finding in report.findings)
    low = checked(path, "simulation.valve.height=0.75")
    assert any("at 0.75" in line and "from where its hands reach it" in line for line in said(low, MISSING))
    ours = checked("robot/robot.yaml")
    assert all(row.seen_to == 4.0 for row in ours.reach) and not said(ours, DOUBTFUL)


@pytest.mark.system
def test_a_fixed_robot_is_shown_before_the_valve_and_one_without_a_calibration_is_not_said_to_see_nothing(tmp_path):
    path = variant(tmp_path, without_base_joints, lambda given: (fixed(given), given.pop("head_calibration")))
    report = checked(path, pictures=True)
    assert any(title.startswith("at a valve") for title in report.pictures)
    assert all(row.seen_to is None for row in report.reach)
    assert "not seen" not in robot_check_page.page(report)


@pytest.mark.system
def test_a_valve_out_of_reach_is_refused_and_one_of_several_is_doubtful(capsys):
    assert cli.main(["check-robot", "robot/robot.yaml", "--set", "simulation.valve.height=1.6"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("not usable yet")
    assert lines[1] == "missing: reach: the scenario's valve at 1.6 m is out of reach"  # what is missing comes first
    report = checked("robot/robot.yaml", "simulation.valve.height=!Uniform {min: 0.9, max: 1.6}")
    assert report.usable and "reach : the scenario's valve at 1.6 m is out of reach" in said(report, DOUBTFUL)


def test_a_valve_that_no_hand_can_hold_is_said_once_and_nothing_is_reached_for(tmp_path):
    near = "[{xyz: [0.06, 0, 0]}, {xyz: [-0.06, 0, 0]}]"
    report = checked("robot/robot.yaml", "valve.model=''", f"valve.handles={near}")
    missing = said(report, MISSING)
    assert len(missing) == 1 and missing[0].startswith("grasp : valve.handles[0].xyz must be at least 0.1")
    assert not report.reach
    assert "valve.handles[0].xyz" in robot_check_page.page(report)


@pytest.mark.system
def test_a_shape_that_is_larger_than_its_link_is_named_where_it_keeps_the_hands_off_the_valve(tmp_path):
    """As a capsule of a wrist that reaches to the finger tips: the arms would get there."""

    def sleeve(model):
        for side in ("left", "right"):
            shape = """<collision name="sleeve"><pose>0.2 0 0 0 0 0</pose><geometry><box>
                <size>0.4 0.03 0.03</size></box></geometry></collision>"""
            part(model, "link", f"{side}_wrist_2").append(ElementTree.fromstring(shape))

    ignore = at("collision", {"ignore": "touching_at_home"})  # the sleeve is about the hand's own shapes
    lines = said(checked(variant(tmp_path, sleeve, ignore)), MISSING)
    words = "reach collision: links in the way are all that keeps it from 1 m, mostly "
    (line,) = [line for line in lines if line.startswith(words)]
    assert "wheel" in line and line.endswith(": smaller shapes of that link in the model")


def test_a_wrong_file_is_bad_input(tmp_path, capsys):
    assert cli.main(["check-robot", str(tmp_path / "nobody.yaml")]) == 2
    path = variant(tmp_path, change=at("opening", "wide"))
    assert cli.main(["check-robot", str(path)]) == 2
    said = capsys.readouterr()
    assert "opening must be a finite number, got 'wide'" in said.err and not said.out
    assert cli.main(["check-robot", "robot/robot.yaml", "--html", str(path)]) == 2  # a robot's file is no page of ours


# ---------------------------------------------------------------- real robots

TIAGO = "package://example-robot-data/robots/tiago_pro_description/robots/tiago_pro.urdf"
BAXTER = "package://example-robot-data/robots/baxter_description/urdf/baxter.urdf"
VEGA = "package://dexmate_urdf/robots/humanoid/vega_1/vega_1_gripper.urdf"
# Of each draft: model, what it says, whether all that it says is missing, and where its hands reach.
REAL = {
    "tiago_pro": (
        TIAGO,
        [
            (MISSING, "search head_calibration: none: there is no second eye"),
            (NOTE, "servo servo: none"),
            (MISSING, "reach : the scenario's valve at 0.5 m is out of reach"),
            (DOUBTFUL, "grasp grippers.left: its motor closes with"),
            (NOTE, "grasp opening: the fingers open by 71 mm"),
        ],
        {0.5: False, 1.2: True},
    ),
    "baxter": (
        BAXTER,
        [
            (NOTE, "search gaze.tilt: none: the head does not turn up or down"),
            (NOTE, "approach base.drive: fixed"),
            (DOUBTFUL, "grasp opening: the fingers open by 42 mm"),
            (MISSING, "grasp : opening must be wider, or frames."),
        ],
        {},
    ),
    "vega_1": (
        VEGA,
        [
            (MISSING, "search head_calibration: none: there is no second eye"),
            (DOUBTFUL, "grasp pad.at: open, the fingers' shapes are"),
        ],
        {0.5: False, 1.0: False},
    ),
}


@pytest.mark.robots
@pytest.mark.parametrize("name", REAL)
def test_real_robots_of_installed_wheels_are_imported_and_judged(name, tmp_path, monkeypatch, capsys):
    pytest.importorskip("trimesh")
    model, wanted, reach = REAL[name]
    try:
        packages.resolve(model, None, "MODEL")
    except ConfigError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(robot_check, "HEIGHTS", tuple(reach))
    assert cli.main(["import-robot", model, "-o", str(tmp_path / name)]) == 0
    capsys.readouterr()
    file = tmp_path / name / "robot.yaml"
    start = time.process_time()
    page = tmp_path / "page.html"
    code = cli.main(["check-robot", str(file), "--set", "simulation.valve.height=0.5", "--json", "--html", str(page)])
    assert code == 1 and time.process_time() - start < 60
    found = json.loads(capsys.readouterr().out)
    lines = [(f["level"], f"{f['stage']} {f['key']}: {f['text']}") for f in found["findings"]]
    for level, words in wanted:
        assert any(level == at and words in line for at, line in lines), lines
    served = {row["height"]: row["serves"] for row in found["reach"]}
    assert {height: served[height] for height in reach} == reach
    assert page.read_text().count("data:image/png") >= 2
    assert yaml_file.read(file)["model"].endswith(".urdf") and np.isfinite(found["processor_s"])


@pytest.mark.robots
def test_tiago_pro_filled_in_reaches_what_its_draft_does_not(tmp_path, monkeypatch, capsys):
    """examples/tiago_pro.robot.yaml beside the imported model, as docs/your_robot.md has it."""
    pytest.importorskip("trimesh")
    try:
        packages.resolve(TIAGO, None, "MODEL")
    except ConfigError as error:
        pytest.skip(str(error))
    reach = {0.81: True, 1.0: True, 1.2: True, 1.6: False}
    monkeypatch.setattr(robot_check, "HEIGHTS", tuple(reach))
    assert cli.main(["import-robot", TIAGO, "-o", str(tmp_path / "tiago_pro")]) == 0
    capsys.readouterr()
    file = tmp_path / "tiago_pro" / "robot.yaml"
    shutil.copy(Path(__file__).parents[1] / "examples" / "tiago_pro.robot.yaml", file)
    cli.main(["check-robot", str(file), "--json", "--html", str(tmp_path / "page.html")])
    found = json.loads(capsys.readouterr().out)
    served = {row["height"]: row["serves"] for row in found["reach"]}
    assert {height: served[height] for height in reach} == reach, found["reach"]
    assert not [f for f in found["findings"] if f["level"] == MISSING], found["findings"]
