"""The station contract: the ports that every station exports, and nothing else. Controllers read nothing but these.

A station is a Diagram: simulated, hardware or replay. Only the simulated one may add ports whose names begin with
`truth.`; the recorder alone reads them.
"""

import dataclasses as dc
from collections.abc import Callable, Mapping

from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem, OutputPort, PortDataType

from valve_drake.messages import CAMERAS, HEAD, SIDES, WRISTS, CameraFrame, Health
from valve_drake.robot.groups import Groups

MATE = {HEAD[0]: HEAD[1], HEAD[1]: HEAD[0], WRISTS[0]: WRISTS[1], WRISTS[1]: WRISTS[0]}  # the other one of a pair
TRUTH = "truth."
SAID_BY = {  # devices that a robot may lack (Groups.absent) -> the port that shows what they say
    "base": "base.odometry",
    "torso": "torso.position_measured",
    **{f"{side}_wrist_sensor": f"{side}_wrist.wrench" for side in SIDES},
}


@dc.dataclass(frozen=True)
class PortSpec:
    """One row of the contract. kind: size of a vector, the group of Groups that it is of, or a message class."""

    name: str
    direction: str  # in | out
    kind: int | str | type
    unit: str
    notes: str = ""


def _both(name: str, direction: str, kind: int | str, unit: str, notes: str = "") -> list[PortSpec]:
    """A row for each side; kind "arm": that side's."""
    kinds = {side: f"{side}_arm" if kind == "arm" else kind for side in SIDES}
    return [PortSpec(f"{side}_{name}", direction, kinds[side], unit, notes) for side in SIDES]


CONTRACT: tuple[PortSpec, ...] = (
    PortSpec(
        "base.twist_command", "in", "twist", "m/s, rad/s", "those that the base has of forward, sideways, yaw rate"
    ),
    PortSpec("torso.position_command", "in", "torso", "rad, m", "lift, waist, tilt, pan, as far as there are"),
    *_both("arm.position_command", "in", "arm", "rad"),
    *_both("gripper.position_command", "in", 1, "m", "opening between the pads"),
    *_both("gripper.force_limit", "in", 1, "N", "of the finger actuator"),
    PortSpec("base.odometry", "out", "odometry", "m, rad, m/s, rad/s", "x, y, heading, and these speeds; drifts"),
    PortSpec("torso.position_measured", "out", "torso", "rad, m"),
    *_both("arm.position_measured", "out", "arm", "rad"),
    *_both("arm.velocity_measured", "out", "arm", "rad/s"),
    *_both("arm.torque_measured", "out", "arm", "N m"),
    *_both("gripper.position_measured", "out", 1, "m"),
    *_both("gripper.force_measured", "out", 1, "N"),
    *_both("wrist.wrench", "out", 6, "N m, N", "at and in the sensor frame; load felt by the sensor, with gravity"),
    *(PortSpec(f"{camera}.image", "out", CameraFrame, "") for camera in CAMERAS),
    PortSpec("health", "out", Health, "s", "age of every device's last report, faults, e-stop"),
)


def vectors(groups: Groups, direction: str = "") -> dict[str, int]:
    """The contract's vector ports for a robot, of one direction or of both: name -> size."""
    rows = [spec for spec in CONTRACT if direction in ("", spec.direction)]
    return {spec.name: groups.size(spec.kind) for spec in rows if not isinstance(spec.kind, type)}


def ports_of(station: Diagram) -> dict[str, tuple[str, int | str]]:
    """Every port of a diagram: name -> (direction, vector size or "abstract")."""
    found = {}
    for direction, count, get in (
        ("in", station.num_input_ports(), station.get_input_port),
        ("out", station.num_output_ports(), station.get_output_port),
    ):
        for k in range(count):
            port = get(k)
            vector = port.get_data_type() == PortDataType.kVectorValued
            found[port.get_name()] = (direction, port.size() if vector else "abstract")
    return found


def check_contract(station: Diagram, groups: Groups) -> None:
    """Raises TypeError that lists every missing, extra or different port."""
    sizes = vectors(groups)
    found = {name: row for name, row in ports_of(station).items() if not name.startswith(TRUTH)}
    wanted = {s.name: (s.direction, sizes.get(s.name, "abstract")) for s in CONTRACT}
    wrong = [f"missing {name}" for name in wanted if name not in found]
    wrong += [f"extra {name}" for name in found if name not in wanted]
    wrong += [
        f"{name} is {found[name]}, not {wanted[name]}"
        for name in wanted
        if name in found and found[name] != wanted[name]
    ]
    if wrong:
        raise TypeError(f"{station.get_name()} breaks the station contract: " + "; ".join(wrong))


def station_of(
    name: str,
    inputs: LeafSystem,
    outputs: LeafSystem,
    groups: Groups,
    computed: Callable[[DiagramBuilder, Mapping[str, OutputPort]], Mapping[str, OutputPort]] = lambda *_: {},
) -> Diagram:
    """The station as a Diagram: one system has the contract's input ports under their names, one the output ports.

    computed: adds what makes some output ports of the others -> these.
    """
    builder = DiagramBuilder()
    for system in {id(system): system for system in (outputs, inputs)}.values():
        builder.AddSystem(system)
    ports = {spec.name: outputs.GetOutputPort(spec.name) for spec in CONTRACT if spec.direction == "out"}
    ports |= computed(builder, ports)
    for spec in CONTRACT:
        if spec.direction == "in":
            builder.ExportInput(inputs.GetInputPort(spec.name), spec.name)
        else:
            builder.ExportOutput(ports[spec.name], spec.name)
    station = builder.Build()
    station.set_name(name)
    check_contract(station, groups)
    return station
