"""docs/your_stage.md is true: its blocks, put into a copy of the program, make a stage with a mode of its own."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from valve_drake.recording.reader import LogReader

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "your_stage.md").read_text()
BLOCKS = re.findall(r"^```(python|diff) (\S+)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def apply(kind: str, path: Path, text: str) -> None:
    """Writes a file, or replaces the one place where a diff's old lines stand by its new ones."""
    if kind == "python":
        assert not path.exists(), path
        path.write_text(text)
        return
    lines = text.splitlines(keepends=True)
    old = "".join(line[1:] for line in lines if line[0] in " -")
    new = "".join(line[1:] for line in lines if line[0] in " +")
    before = path.read_text()
    assert before.count(old) == 1, f"{path.name} has not once:\n{old}"
    path.write_text(before.replace(old, new))


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    """A copy of the program with the page's stage in it."""
    top = tmp_path_factory.mktemp("program")
    for folder in ("valve_drake", "models", "diagrams"):
        shutil.copytree(ROOT / folder, top / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for kind, name, text in BLOCKS:
        apply(kind, top / name, text)
    return top


def python(top: Path, *words: str) -> str:
    environment = os.environ | {"PYTHONPATH": str(top)}
    done = subprocess.run([sys.executable, *words], cwd=top, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


IN_THE_DIAGRAM = """
import valve_drake
from valve_drake import diagram, scenario
from valve_drake.task.modes import document
print(valve_drake.__file__)
print("\\n".join(diagram.wiring(diagram.make_diagram(scenario.resolve(scenario.load())).diagram)))
print(document())
"""


@pytest.mark.system
def test_the_page_has_two_files_and_its_changes_fit_the_program(program):
    assert [name for kind, name, _ in BLOCKS if kind == "python"] == [
        "valve_drake/behaviors/nod.py",
        "valve_drake/behaviors/nod_system.py",
    ]
    out = python(program, "-c", IN_THE_DIAGRAM)
    assert out.startswith(str(program))
    for line in (
        "nod.command -> command_selector.nod",
        "nod.status -> supervisor.nod",
        "robot_state.robot_state -> nod.robot_state",
        "supervisor.mode -> nod.mode",
        "| nod | nod | the head nods: the camera has seen the turn | 6 s |  |",
    ):
        assert line in out.splitlines()


@pytest.mark.slow
def test_the_robot_nods_when_the_camera_has_seen_the_turn(program):
    log = program / "nod.mcap"
    words = ["run", "--seed", "1", "--no-html", "--json", "--log", str(log)]
    result = json.loads(python(program, "-m", "valve_drake", *words).splitlines()[-1])
    assert result["verdict"] == "turned" and result["reason"].startswith("camera sees")
    modes = [message.mode for _, _, message in LogReader(log).messages(["/supervisor/mode"])]
    order = list(dict.fromkeys(modes))
    assert order[order.index("verify") : order.index("verify") + 3] == ["verify", "nod", "retreat"]
