"""taught: references survive a file, and a bad file is refused with its name and the key."""

import numpy as np
import pytest
import yaml

from valve_drake import cli, resources
from valve_drake.behaviors.taught import TaughtReference, load_made_for, load_taught, save_taught
from valve_drake.checks import ConfigError
from valve_drake.messages import LEFT, RIGHT, SIDES

CORNERS = np.array([[300.0, 200], [350, 200], [350, 320], [300, 320]])


def reference(seed: int = 0) -> TaughtReference:
    rng = np.random.default_rng(seed)
    jacobian = np.diag([40.0, 40, 0.06]) @ (np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
    return TaughtReference(np.array([3.3, 2.8, 0.0106]), jacobian, 8900.0 + seed, CORNERS + seed)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "hands.yaml"
    save_taught({LEFT: reference(1), RIGHT: reference(2)}, path, "two lines\nof words")
    return path


def test_what_is_saved_is_loaded_bit_by_bit(file):
    loaded = load_taught(file)
    assert tuple(loaded) == SIDES
    for seed, side in ((1, LEFT), (2, RIGHT)):
        for name in ("feature", "jacobian", "area", "corners"):
            assert np.array_equal(getattr(loaded[side], name), getattr(reference(seed), name)), name
    assert file.read_text().startswith("# two lines\n# of words\n")


def test_displacement_undoes_the_jacobian():
    taught = reference()
    d = np.array([0.01, -0.02, 0.03])
    assert taught.displacement(taught.feature + taught.jacobian @ d) == pytest.approx(d)
    assert taught.displacement(taught.feature) == pytest.approx(np.zeros(3))


def test_along_the_view_the_feature_only_shrinks():
    """s = M p / c: a camera that moves along its view of the mark scales s, and nearer is smaller."""
    taught = reference()
    assert np.linalg.norm(taught.view) == pytest.approx(1)
    change = taught.jacobian @ taught.view
    assert np.cross(change, taught.feature) == pytest.approx(np.zeros(3), abs=1e-9)
    assert change @ taught.feature < 0


def test_the_shipped_references_look_at_the_grip_point_from_outside_the_hand():
    taught = load_taught(resources.models() / "taught" / "hands.yaml")
    for side, s in ((LEFT, 1), (RIGHT, -1)):
        view = taught[side].view
        # The camera sits at (s 75, 0, -130) mm of the grip point; the mark lies off that line by the handle's depth.
        assert view @ [-s * 0.075, 0, 0.13] / np.hypot(0.075, 0.13) > 0.998
        x, y = taught[side].corners.T
        polygon = abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))) / 2
        assert taught[side].area == pytest.approx(polygon, rel=0.01)
        assert taught[side].feature[2] == pytest.approx(taught[side].area ** -0.5, rel=0.01)


def change(path, edit) -> None:
    data = yaml.safe_load(path.read_text())
    edit(data)
    path.write_text(yaml.safe_dump(data))


@pytest.mark.parametrize(
    "edit, words",
    [
        (lambda d: d.pop("left"), "a mapping of left and right"),
        (lambda d: d["left"].pop("area"), r"left\.area"),
        (lambda d: d.update(right=[1, 2]), r"right\.feature"),
        (lambda d: d["right"].update(feature=[1, 2]), r"right\.feature must be \(3,\) finite numbers"),
        (lambda d: d["right"].update(feature=[1, 2, "x"]), r"right\.feature"),
        (lambda d: d["left"].update(corners=[[1, 2]] * 3), r"left\.corners must be \(4, 2\)"),
        (lambda d: d["left"].update(jacobian=[[1, 2, float("nan")]] * 3), r"left\.jacobian"),
        (lambda d: d["left"].update(jacobian=[[1, 2, 3]] * 3), r"left\b.*[jJ]acobian must be well conditioned"),
        (lambda d: d["right"].update(jacobian=[[0, 0, 0]] * 3), r"right\b.*[jJ]acobian must be well conditioned"),
        (lambda d: d["left"].update(area=0.0), r"left\.area"),
        (lambda d: d["left"].update(area=True), r"left\.area"),
        (lambda d: d["left"].update(area="8900"), r"left\.area"),
        (lambda d: d["right"].update(feature=["3.3", "2.8", "0.01"]), r"right\.feature must be \(3,\) finite numbers"),
        (lambda d: d["left"].update(feature=[0, 0, 0]), r"left\.feature\[2\] must be > 0, got 0"),
        (lambda d: d["left"].update(feature=[3.3, 2.8, -0.01]), r"left\.feature\[2\] must be > 0, got -0.01"),
        (lambda d: d.update(made_for="me"), r"made_for must be a mapping of robot, marker"),
        (lambda d: d.update(made_for={"robot": "a", "marker": "b"}), r"made_for must be a mapping of robot, marker"),
        (lambda d: d.update(made_for={"robot": "a", "marker": 3, "opening": 0.08}), r"made_for must be a mapping"),
        (lambda d: d.update(made_for={"robot": "a", "marker": "b", "opening": True}), r"made_for must be a mapping"),
    ],
)
def test_a_bad_file_is_refused_by_name_and_key(file, edit, words):
    change(file, edit)
    with pytest.raises(ConfigError, match=words) as error:
        load_taught(file)
        load_made_for(file)
    assert str(file) in str(error.value)


def test_a_file_that_is_not_there_or_no_yaml_is_refused_in_one_line(tmp_path):
    bad = tmp_path / "bad.yaml"
    bad.write_text("left: [1, 2")
    binary = tmp_path / "picture.png"
    binary.write_bytes(b"\x89PNG\xff\xfe")
    empty = tmp_path / "empty.yaml"
    empty.write_text("")
    for path in (tmp_path / "none.yaml", bad, binary, empty, tmp_path):
        with pytest.raises(ConfigError) as error:
            load_taught(path)
        assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_foreign_file_is_neither_shown_nor_kept(tmp_path, capsys):
    """A scenario's `taught` could name any file of the machine: the error does not print it, no log attaches it."""
    secret = tmp_path / "secret"
    secret.write_text("root:x:0:0\ndaemon:x:1:1\n")
    log = tmp_path / "run.mcap"
    for name in ("taught", "head_calibration"):
        assert cli.main(["run", "--set", f"{name}={secret}", "--duration", "0.01", "--log", str(log), "--no-html"]) == 2
        said = capsys.readouterr()
        assert "daemon" not in said.out + said.err and said.err.count("\n") == 1 and str(secret) in said.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["secret"]
