"""teaching.py: the lesson over the station contract, against the simulated cameras' true geometry; when it is due."""

import dataclasses as dc
from pathlib import Path

import numpy as np
import pytest
from robot_variants import part, put, variant

from valve_drake import cli, resources, teaching
from valve_drake import scenario as scenarios
from valve_drake.behaviors.taught import load_made_for, load_taught, save_taught
from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.diagram import robot_of
from valve_drake.messages import SIDES, HandleMark
from valve_drake.rehearsal import beside
from valve_drake.robot import description
from valve_drake.stations.faults import FaultConfig

SHIPPED = resources.models() / "taught" / "hands.yaml"


@pytest.fixture(scope="module")
def taught():
    patch = pytest.MonkeyPatch()
    patch.setattr(teaching, "IMAGES", 2)
    try:
        return teaching.teach(scenarios.load())[0]
    finally:
        patch.undo()


@pytest.mark.system
def test_the_shipped_references_are_current(taught):
    shipped = load_taught(SHIPPED)
    for side in SIDES:
        np.testing.assert_allclose(taught[side].feature, shipped[side].feature, rtol=0.01)
        scale = np.abs(shipped[side].jacobian).max(axis=1, keepdims=True)
        assert np.abs((taught[side].jacobian - shipped[side].jacobian) / scale).max() < 0.05
    scenario = scenarios.load()
    assert teaching.made_for(robot_of(scenario), scenario.valve) == load_made_for(SHIPPED)


@pytest.mark.system
def test_the_view_direction_learned_from_images_is_the_cameras(taught):
    for side, sign in zip(SIDES, (-1.0, 1.0)):
        true = np.array([sign * 0.075, 0.0, 0.13])  # from the camera to the grip point, models/robot/robot.sdf
        assert np.degrees(np.arccos(taught[side].view @ true / np.linalg.norm(true))) < 5.0


@pytest.mark.system
def test_the_lesson_over_the_wire_is_the_same_but_for_the_encoders_errors(taught, monkeypatch):
    """The twin's hands are on the handles within a few millimeters, as an operator would put them."""
    monkeypatch.setattr(teaching, "IMAGES", 2)
    scenario = scenarios.load("hardware.scenario.yaml", ["simulation.start.at_valve=true", "hardware.lockstep=true"])
    with beside(scenario) as (link, twin):
        over, pictures = teaching.teach(scenario, link=link)
        assert not twin.dropped and not link.dropped
    for side in SIDES:
        assert np.linalg.norm(taught[side].displacement(over[side].feature)) < 0.005
        scale = np.abs(taught[side].jacobian).max(axis=1, keepdims=True)
        assert np.abs((over[side].jacobian - taught[side].jacobian) / scale).max() < 0.05
        assert pictures[side].shape == (480, 640, 3)


@pytest.mark.system
def test_a_mark_out_of_sight_is_one_clear_line():
    scenario = scenarios.load(None, ["handle_marker.segmentation.min_area=200000"])
    with pytest.raises(ConfigError, match="no mark in 8 of 8 left wrist images"):
        teaching.teach(scenario)


@pytest.mark.system
def test_noise_that_hides_the_mark_in_some_images_does_not_end_it(monkeypatch):
    find, count = teaching.find_mark, iter(range(10**6))

    def noisy(image, config):
        return find(image, config) if next(count) % 8 > 0 else HandleMark(reason="noise")

    monkeypatch.setattr(teaching, "find_mark", noisy)
    taught, _ = teaching.teach(scenarios.load(None))
    assert set(taught) == set(SIDES)
    monkeypatch.setattr(teaching, "find_mark", lambda image, config: HandleMark(reason="noise"))
    with pytest.raises(ConfigError, match="no mark in 8 of 8 left wrist images: noise"):
        teaching.teach(scenarios.load(None))


@pytest.mark.system
def test_a_contact_a_fault_and_the_operator_end_the_lesson(monkeypatch):
    with pytest.raises(OperationFailed, match="stopped by the operator"):
        teaching.teach(scenarios.load(), stop=lambda: True)
    monkeypatch.setattr(teaching, "TOUCH", 0.01)
    with pytest.raises(OperationFailed, match="teach: the (left|right) hand touches something: 0 N|[1-9] N more"):
        teaching.teach(scenarios.load())
    monkeypatch.undo()
    scenario = scenarios.load("hardware.scenario.yaml", ["simulation.start.at_valve=true", "hardware.lockstep=true"])
    scenario.faults = [FaultConfig(kind="estop", device="robot", start=1.0)]
    with beside(scenario) as (link, _), pytest.raises(OperationFailed, match="the robot reports its emergency stop"):
        teaching.teach(scenario, link=link)


def test_a_robot_that_does_not_reach_is_one_clear_line(tmp_path):
    def short(model):
        for side in SIDES:
            put(part(model, "link", f"{side}_forearm"), "pose", "0.05 0 0 0 0 0")

    scenario = scenarios.load(None, [f"robot={variant(tmp_path, short)}"])
    with pytest.raises(ConfigError, match=r"teach: the hands do not reach the handles of a valve at 1.2 m"):
        teaching.teach(scenario)


# ---------------------------------------------------------------- when it is due


@pytest.fixture
def lessons(monkeypatch, tmp_path):
    """The lessons that were given; they cost nothing, and teach what is shipped. The cache is empty."""
    given, taught = [], load_taught(SHIPPED)

    def teach(scenario, stop=None, link=None):
        given.append(scenario)
        return taught, {side: np.zeros((4, 4, 3), np.uint8) for side in SIDES}

    monkeypatch.setattr(teaching, "teach", teach)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return given


def changed(folder, **keys):
    return variant(folder, change=lambda given: given.update(keys))


def moved_camera(model):
    put(part(model, "frame", "left_wrist_camera"), "pose", "0.08 0 0.012 0 0.5 0")


CHANGES = {
    "opening": (lambda folder: changed(folder, opening=0.08), [], "an opening of 85 mm, not 80 mm"),
    "robot": (lambda folder: variant(folder, moved_camera), [], "another robot"),
    "marker": (variant, ["valve.marker.mark_height=0.012"], "another marker"),
    "nothing": (lambda folder: changed(folder, taught=""), [], "robot.yaml names no taught references"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_a_simulated_robots_hands_are_taught_when_they_have_to_be_and_once(case, lessons, tmp_path):
    make, overrides, words = CHANGES[case]
    scenario = scenarios.resolve(scenarios.load(None, [f"robot={make(tmp_path / 'robot')}", *overrides]))
    said = []
    ready = teaching.prepared(scenario, said.append)
    assert len(lessons) == 1 and words in said[0] and said[0].endswith("the hands are taught, once")
    assert Path(ready.taught).is_relative_to(tmp_path / "cache") and load_taught(ready.taught)
    again = teaching.prepared(dc.replace(scenario, seed=7), said.append)
    assert len(lessons) == 1 and again.taught == ready.taught and said[-1].endswith(f"{ready.taught} stands in")


@pytest.mark.parametrize("damage", ["", "left: [1", "left: {}\nright: {}\n"])
def test_kept_references_that_are_damaged_are_taught_anew(damage, lessons, tmp_path):
    scenario = scenarios.resolve(scenarios.load(None, [f"robot={changed(tmp_path / 'robot', opening=0.08)}"]))
    kept = Path(teaching.prepared(scenario).taught)
    kept.write_text(damage)
    assert teaching.prepared(scenario).taught == str(kept) and load_taught(kept) and len(lessons) == 2


def test_a_cache_that_cannot_be_is_told_before_the_lesson(lessons, tmp_path, monkeypatch):
    scenario = scenarios.resolve(scenarios.load(None, [f"robot={changed(tmp_path / 'robot', opening=0.08)}"]))
    (tmp_path / "file").write_text("mine")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(OperationFailed, match="cannot be made: Not a directory"):
        teaching.prepared(scenario)
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: Path("~nobody_of_this_name").expanduser())
    with pytest.raises(ConfigError, match="HOME or XDG_CACHE_HOME must be given"):
        teaching.prepared(scenario)
    assert not lessons


@pytest.mark.parametrize("case", CHANGES)
def test_a_real_robot_with_references_of_another_is_refused_with_what_to_do(case, lessons, tmp_path):
    make, overrides, words = CHANGES[case]
    overrides = [f"robot={make(tmp_path / 'robot')}", *overrides, "station=hardware"]
    with pytest.raises(ConfigError) as error:
        teaching.prepared(scenarios.resolve(scenarios.load(None, overrides)))
    line = str(error.value)
    assert words in line and line.endswith("put the hands on the handles and run `valve-drake teach SCENARIO`")
    assert not lessons and "\n" not in line


def test_the_shipped_references_need_no_lesson_and_old_ones_do(lessons, tmp_path):
    scenario = scenarios.resolve(scenarios.load())
    assert teaching.prepared(scenario) is scenario and not lessons
    longer = variant(tmp_path / "robot", lambda m: put(part(m, "link", "left_forearm"), "pose", "0.4 0 0 0 0 0"))
    robot = scenarios.resolve(scenarios.load(None, [f"robot={longer}"]))
    assert teaching.prepared(robot) is robot  # longer arms: the images at the handles are the same
    save_taught(load_taught(SHIPPED), tmp_path / "old.yaml", "without made_for")
    said = []
    teaching.prepared(dc.replace(scenario, taught=str(tmp_path / "old.yaml")), said.append)
    assert "old.yaml is of a robot, marker and opening that it does not name" in said[0] and len(lessons) == 1
    with pytest.raises(ConfigError, match="no such file"):  # a file that is named and not there is a mistake
        teaching.prepared(dc.replace(scenario, taught="nowhere.yaml"))


def test_teach_writes_where_the_robots_file_looks(lessons, tmp_path, capsys):
    robot = changed(tmp_path / "robot", taught="hands/hands.yaml")
    assert cli.main(["teach", "--set", f"robot={robot}"]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "robot" / "hands" / "hands.yaml")]
    assert load_made_for(tmp_path / "robot" / "hands" / "hands.yaml") == load_made_for(SHIPPED)
    bare = changed(tmp_path / "bare", taught="")
    assert cli.main(["teach", "--set", f"robot={bare}"]) == 0
    said = capsys.readouterr().out.replace("\n", " ")
    assert str(tmp_path / "bare" / "taught" / "hands.yaml") in said and "taught: taught/hands.yaml" in said
    assert description.load(robot).taught == str(tmp_path / "robot" / "hands" / "hands.yaml")
    assert teaching.place_of(scenarios.load()) == (SHIPPED.parent, "")
