"""The wiring, the names, and the direction of imports."""

import ast
import re
from pathlib import Path

import pytest

import valve_drake
from valve_drake import diagram as mut
from valve_drake import drawing, resources
from valve_drake import scenario as scenarios
from valve_drake.ports import Block

PACKAGE = Path(valve_drake.__file__).parent


@pytest.fixture(scope="module")
def system():
    return mut.make_diagram(scenarios.resolve(scenarios.load()))


def test_the_reviewed_wiring_list_is_current(system):
    """If this fails: look at the difference, then run `valve-drake draw`."""
    reviewed = (resources.diagrams() / "simulated.wiring.txt").read_text()
    assert drawing.wiring_text(system.diagram) == reviewed


def test_the_drawing_is_current(system):
    assert drawing.svg(system.diagram) == (resources.diagrams() / "simulated.svg").read_text()


def test_a_block_without_a_place_of_its_own_is_drawn_too(system, monkeypatch):
    places = {name: place for name, place in drawing.PLACES.items() if name != "image_servo"}
    monkeypatch.setattr(drawing, "PLACES", places)
    drawn = drawing.svg(system.diagram)
    assert drawn.count(">image_servo<") == 1
    assert len(re.findall("marker-end", drawn)) == len(
        re.findall("marker-end", (resources.diagrams() / "simulated.svg").read_text())
    )


def test_every_input_of_every_block_is_connected(system):
    sources = set(system.diagram.connection_map())
    for block in system.diagram.GetSystems():
        for k in range(block.num_input_ports()):
            port = block.get_input_port(k)
            wired = any(s is block and int(i) == k for s, i in sources)
            assert wired or port.get_name() == mut.OPERATOR, port.GetFullDescription()


def test_every_output_but_telemetry_has_a_reader(system):
    read = {(s.get_name(), int(i)) for s, i in system.diagram.connection_map().values()}
    unread = {
        f"{block.get_name()}.{block.get_output_port(k).get_name()}"
        for block in system.diagram.GetSystems()
        for k in range(block.num_output_ports())
        if (block.get_name(), k) not in read
    }
    assert {name for name in unread if not name.startswith("station.truth.")} == {"image_servo.servo"}


@pytest.fixture(scope="module")
def listening():
    """The diagram of a run that listens to operators."""
    return mut.make_diagram(scenarios.resolve(scenarios.load(None, ["operator_channel.wire=lcm"])))


def test_operators_stand_before_the_supervisors_port_and_change_no_other_arrow(system, listening):
    before, after = set(mut.wiring(system.diagram)), set(mut.wiring(listening.diagram))
    assert before < after
    assert all("operator_channel." in line for line in after - before)
    assert "operator_channel.command -> supervisor.operator" in after
    names = {listening.diagram.get_input_port(k).get_name() for k in range(listening.diagram.num_input_ports())}
    assert names == {mut.OPERATOR, mut.PACKETS}
    assert system.operator_channel is None and listening.operator_channel is not None
    test_one_name_for_block_module_class_and_scenario_key(listening)
    assert ">operator_channel<" in drawing.svg(listening.diagram)


def test_one_name_for_block_module_class_and_scenario_key(system):
    keys = set(vars(scenarios.Scenario()))
    for block in system.diagram.GetSystems():
        if not isinstance(block, Block):
            continue
        name = block.get_name()
        module = type(block).__module__
        assert module.rsplit(".", 1)[-1] == f"{name}_system"
        assert type(block).__name__ == "".join(part.title() for part in name.split("_")) + "System"
        assert name in keys or name == "robot_state"


def test_the_supervisor_alone_writes_the_mode_and_command_selector_alone_writes_to_the_robot(system):
    for line in mut.wiring(system.diagram):
        source, target = line.split(" -> ")
        if target.endswith(".mode"):
            assert source == "supervisor.mode"
        if target.startswith("station."):
            assert source.startswith("command_selector.")


def _imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


MODULES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_one_way(path):
    name = path.relative_to(PACKAGE)
    part = name.parts[0] if len(name.parts) > 1 else ""
    imports = _imports(path)
    mathematics = part in ("behaviors", "perception", "supervisor", "camera") and not name.stem.endswith("_system")
    if mathematics or str(name) in (
        "messages.py",
        "frames.py",
        "checks.py",
        "robot/kinematics.py",
        "robot/description.py",
    ):
        assert not any(i.startswith("pydrake") for i in imports), "mathematics stands without Drake"
    if part in ("robot", "valve", "camera") or str(name) in ("collision.py", "memory.py", "motion.py", "ports.py"):
        assert not any(i.startswith("valve_drake.behaviors") for i in imports), "behaviors stand on it"
    if part in ("behaviors", "perception", "supervisor"):
        own = "valve_drake." + ".".join(name.with_suffix("").parts)
        for i in imports:
            assert not i.startswith(("valve_drake.stations", "valve_drake.diagram", "valve_drake.recording"))
            if i.endswith("_system"):
                assert i == own, "blocks never import each other"
    if part != "commands" and str(name) not in ("runner.py", "cli.py", "__main__.py", "teaching.py", "drawing.py"):
        assert not any(i in ("valve_drake.cli", "valve_drake.runner") for i in imports)
    renders = ("diagram.py", "teaching.py", "analysis/rendered_bound.py")  # with the simulated station's cameras
    assert "valve_drake.stations.simulated" not in imports or str(name) in renders
