"""Every file of examples/ runs as its head says, prints what is true, and is short."""

import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from drawn_scene import Drawing, draw_valve, facing

from valve_drake import frames
from valve_drake.camera.lens import load_head
from valve_drake.perception.marker import Marker

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
HEAD = ROOT / "models" / "calibration" / "head.yaml"
X_LV = facing(0.9, pan=0.3, tilt=-0.1, x=0.05)


def run(capsys, monkeypatch, name: str, *words: str) -> str:
    monkeypatch.setattr(sys, "argv", [name, *words])
    runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
    return capsys.readouterr().out


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> list[str]:
    """A valve with its marker at X_LV, drawn into both cameras of the head."""
    head, folder, paths = load_head(HEAD), tmp_path_factory.mktemp("pair"), []
    for name, lens, X_CL in (("left", head.left, np.eye(3, 4)), ("right", head.right, frames.inverse(head.X_LR))):
        drawing = Drawing(lens)
        draw_valve(drawing, frames.compose(X_CL, X_LV), Marker())
        paths.append(str(folder / f"{name}.png"))
        cv2.imwrite(paths[-1], drawing.finish(np.random.default_rng(1))[:, :, ::-1])
    return paths


def test_an_example_is_short_and_says_how_to_run_it():
    assert len(EXAMPLES) == 3
    for path in EXAMPLES:
        text = path.read_text()
        assert len(text.splitlines()) < 60, path.name
        assert f"python examples/{path.name}" in text


def test_two_photographs_prints_the_pose(pair, capsys, monkeypatch):
    out = run(capsys, monkeypatch, "two_photographs.py", *pair, str(HEAD), "98x100").splitlines()
    found = np.array(out[0].split("[", 2)[2].split("]")[0].split(), float)
    assert np.allclose(found, 1e3 * X_LV[:, 3], atol=2.0)  # [mm]
    axis = np.array(out[1].split("[")[1].split("]")[0].split(), float)
    assert axis @ X_LV[:, 2] > np.cos(np.radians(1.0))


def test_two_photographs_says_why_there_is_no_rectangle(pair, capsys, monkeypatch, tmp_path):
    grey = str(tmp_path / "grey.png")
    cv2.imwrite(grey, np.full((480, 640, 3), 120, np.uint8))
    with pytest.raises(SystemExit, match="no rectangle: ."):
        run(capsys, monkeypatch, "two_photographs.py", grey, grey, str(HEAD), "98x100")


def test_one_stage_finds_the_marker_in_a_diagram_of_its_own(pair, capsys, monkeypatch):
    out = run(capsys, monkeypatch, "one_stage.py", pair[0]).splitlines()
    assert "may be the marker" in out[0]
    seen = np.array(out[0].split("[")[1].split("]")[0].replace(".", " ").split(), float)
    lens = load_head(HEAD).left
    assert np.allclose(seen, lens.project(X_LV[:2, 3] / X_LV[2, 3]), atol=3.0)  # [px]


@pytest.mark.system
def test_own_stage_adds_up_the_way_driven(capsys, monkeypatch):
    out = run(capsys, monkeypatch, "own_stage.py", "6")
    total, here = float(out.split(" m in ")[0]), float(out.split(", ")[1].split(" m")[0])
    assert 0.0 < here <= total < 5.0
