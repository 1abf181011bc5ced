"""What a URDF says that Drake refuses, warns of, or would obey to the robot's harm: mended in place, each in a line.

Nothing else of the kinematics is touched. A mend takes what the file itself says elsewhere (a mimic follows its limits,
an inertia keeps its axes) and otherwise the least that works. Masses [kg], inertias [kg m2], efforts [N m, N].
"""

import math
import re
import xml.etree.ElementTree as ET

import numpy as np

from valve_drake.checks import ConfigError, shown
from valve_drake.robot.urdf import Joint, Robot

LEAST_MASS = 0.01  # of a link that moves on its own and has none [kg]
LEAST_INERTIA = 1e-5  # its principal moments [kg m2]
TOLERANCE = 1e-6  # of a range [rad, m]; of an inertia, relative to its largest moment: files have few digits
MAX_NAMES = 6  # of joints or links in a line
WORLDS = ("world", "map", "odom", "odom_combined")  # links that stand for the room

_KEPT = {
    "robot": ("link", "joint", "material"),
    "link": ("inertial", "visual", "collision"),
    "joint": ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
    "inertial": ("origin", "mass", "inertia"),
    "visual": ("origin", "geometry", "material"),
    "collision": ("origin", "geometry"),
}
_ATTRIBUTES = {"link": ("name",), "joint": ("name", "type")}
_OF_ONE = re.compile(r"(joint|link) ('[^']*'): (.*)", re.DOTALL)
_INERTIA = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def mend(robot: Robot) -> list[str]:
    """Mends the robot's XML and its joints -> a line for each mend. Raises ConfigError for what nobody can guess."""
    lines = _left_out(robot)
    lines += _world(robot)
    for joint in robot.joints.values():
        lines += _joint(robot, joint)
    for joint in robot.joints.values():
        lines += _mimic(robot, joint)
    for name in robot.links:
        lines += _inertia(robot, name)
    lines += _massless(robot)
    lines += _actuators(robot)
    return _grouped(lines)


def _grouped(lines: list[str]) -> list[str]:
    """The same mend of several joints or links as one line."""
    found: dict[tuple[str, str], list[str]] = {}
    for line in lines:
        match = _OF_ONE.fullmatch(line)
        kind, name, rest = match.groups() if match else ("", "", line)
        found.setdefault((kind, rest), []).append(name)
    lines = []
    for (kind, rest), names in found.items():
        if len(names) > MAX_NAMES:
            names = [*names[: MAX_NAMES - 2], f"and {len(names) - MAX_NAMES + 2} more"]
        lines.append(f"{kind}{'s' * (len(names) > 1)} {', '.join(names)}: {rest}" if kind else rest)
    return lines


def _left_out(robot: Robot) -> list[str]:
    """Drops what is not robot: simulator plugins, sensors, controllers."""
    dropped: dict[str, int] = {}
    todo = [robot.element]
    for element in todo:
        for part in list(element):
            if part.tag in _KEPT[element.tag]:
                if part.tag in _KEPT:
                    todo.append(part)
            elif not part.tag.startswith("drake:"):
                element.remove(part)
                dropped[part.tag] = dropped.get(part.tag, 0) + 1
        for key in _ATTRIBUTES.get(element.tag, ()) and list(element.attrib):
            if key not in _ATTRIBUTES[element.tag]:
                del element.attrib[key]
    if not dropped:
        return []
    return ["left out, as no part of the model: " + ", ".join(f"{n} <{tag}>" for tag, n in sorted(dropped.items()))]


def _world(robot: Robot) -> list[str]:
    """A root that stands for the room: the base of robot.yaml moves in it, so the model must not hang on it."""
    below = robot.below(robot.root)
    if robot.root in WORLDS and len(below) == 1 and robot.links[robot.root].find("inertial") is None:
        joint = below[0]
        if joint.type in ("floating", "planar"):
            robot.element.remove(robot.links.pop(robot.root))
            robot.element.remove(joint.element)
            del robot.joints[joint.name]
            old, robot.root = robot.root, joint.child
            return [
                f"link {shown(old)} and its {joint.type} joint are left out: the base of robot.yaml moves the robot"
            ]
    if robot.root == "world":  # Drake takes it for the room itself
        new = "world_link"
        while new in robot.links:
            new += "_"
        robot.links = {new if name == "world" else name: link for name, link in robot.links.items()}
        robot.links[new].set("name", new)
        for joint in robot.joints.values():
            if joint.parent == "world":
                joint.parent = new
                parent = joint.element.find("parent")
                assert parent is not None
                parent.set("link", new)
        robot.root = new
        return [f"link 'world' is named {shown(new)}: the base of robot.yaml carries the robot, not the room"]
    return []


def _joint(robot: Robot, joint: Joint) -> list[str]:
    where, lines = f"joint {shown(joint.name)}", []
    if joint.type in ("floating", "planar"):
        raise ConfigError(
            f"{robot.source}: {where}: {joint.type} joints are for the base alone, "
            f"and link {shown(joint.parent)} is no world"
        )
    element, limit = joint.element, joint.element.find("limit")
    if joint.type == "fixed":
        for tag in ("axis", "limit", "dynamics"):
            for part in element.findall(tag):
                element.remove(part)
        return []
    if joint.type == "continuous" and limit is not None and (limit.get("lower") or limit.get("upper")):
        lower, upper = limit.attrib.pop("lower", "0"), limit.attrib.pop("upper", "0")
        lines.append(f"{where}: is continuous, so its limits {lower} and {upper} are left out (Drake would obey them)")
    if joint.type != "continuous" and limit is None:
        lines.append(f"{where}: has no limits: it turns without end")
        if joint.type == "prismatic":
            raise ConfigError(f"{robot.source}: {where}: is prismatic and must have a <limit>")
        joint.type = "continuous"
        element.set("type", "continuous")
    if joint.type == "revolute" and joint.range == (0.0, 0.0):
        lines.append(f"{where}: its limits are both 0: it is fixed")
        _fix(joint)
        return lines
    if limit is not None:
        for key in ("effort", "velocity"):
            text = limit.get(key)
            if text is None or not math.isfinite(float(text)):
                limit.attrib.pop(key, None)
                lines.append(f"{where}: has no {key} limit")
            elif float(text) < 0:
                limit.set(key, text.strip().lstrip("-"))
                lines.append(f"{where}: its {key} limit is {text}: without the sign")
            elif float(text) == 0:
                del limit.attrib[key]
                lines.append(f"{where}: its {key} limit is 0: left out")
    dynamics = element.find("dynamics")
    if dynamics is not None:
        if float(dynamics.get("damping", "0")) < 0:
            lines.append(f"{where}: its damping is {dynamics.get('damping')}: 0")
            dynamics.set("damping", "0")
        if float(dynamics.attrib.pop("friction", "0")):
            lines.append(f"{where}: its friction is left out: Drake's joints have none")
    return lines


def _fix(joint: Joint) -> None:
    joint.type = "fixed"
    joint.element.set("type", "fixed")
    for tag in ("axis", "limit", "dynamics", "mimic"):
        for part in joint.element.findall(tag):
            joint.element.remove(part)


def _mimic(robot: Robot, joint: Joint) -> list[str]:
    where, follows, element = f"joint {shown(joint.name)}", joint.mimic, joint.element.find("mimic")
    if follows is None or element is None:
        return []
    name, scale, offset = follows
    leader = robot.joints.get(name)

    def alone(why: str) -> list[str]:
        joint.element.remove(element)
        return [f"{where}: its mimic is left out: {why}"]

    if not joint.moving:
        return alone(f"the joint is {joint.type}")
    if leader is None:
        return alone(f"there is no joint {shown(name)}")
    chain, one = {joint.name}, leader
    while one.mimic is not None and one.mimic[0] in robot.joints:
        if one.name in chain:
            break
        chain.add(one.name)
        one = robot.joints[one.mimic[0]]
    if one.name in chain and one.mimic is not None:
        return alone(f"{shown(joint.name)} and {shown(name)} follow each other")
    if not leader.moving:
        if abs(offset) > TOLERANCE:
            return alone(f"joint {shown(name)} is fixed")
        _fix(joint)
        return [f"{where}: follows {shown(name)}, which is fixed: it is fixed"]
    (low, high), (least, most) = joint.range, leader.range
    if not all(map(math.isfinite, (low, high, least, most))) or scale == 0:
        return []
    asked = sorted((scale * least + offset, scale * most + offset))
    other = sorted((-scale * least + offset, -scale * most + offset))
    if _overlap(asked, (low, high)) > TOLERANCE or most - least < TOLERANCE:
        return []
    said = (
        f"{where}: follows {shown(name)} by {scale:g}, to {_range(*asked)}, against its own limits {_range(low, high)}"
    )
    if _overlap(other, (low, high)) >= other[1] - other[0] - TOLERANCE:
        element.set("multiplier", f"{-scale:g}")
        return [f"{said}: by {-scale:g}, which fits them"]
    limit = joint.element.find("limit")
    assert limit is not None
    limit.set("lower", f"{asked[0]:.9g}")
    limit.set("upper", f"{asked[1]:.9g}")
    return [f"{said}: the limits are {_range(*asked)}"]


def _overlap(a: "list[float]", b: tuple[float, float]) -> float:
    return min(a[1], b[1]) - max(a[0], b[0])


def _range(low: float, high: float) -> str:
    return f"{low:.4g} .. {high:.4g}"


def _inertia(robot: Robot, name: str) -> list[str]:
    inertial = robot.links[name].find("inertial")
    if inertial is None:
        return []
    where, mass, element = f"link {shown(name)}", inertial.find("mass"), inertial.find("inertia")
    m = 0.0 if mass is None else float(mass.get("value", "0"))
    if m <= 0:
        robot.links[name].remove(inertial)
        nothing = element is None or not any(float(element.get(key, "0")) for key in _INERTIA)
        return [] if m == 0 and nothing else [f"{where}: its mass is {m:g}: it has no inertia either"]
    if element is None:
        element = ET.SubElement(inertial, "inertia", dict.fromkeys(_INERTIA, "0"))
    xx, yy, zz, xy, xz, yz = (float(element.get(key, "0")) for key in _INERTIA)
    J = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    size = max(np.abs(J).max(), 1e-12)
    # S, the second moments of the mass: an inertia is one of a body just if S has no negative eigenvalue.
    S = np.trace(J) / 2 * np.eye(3) - J
    values, axes = np.linalg.eigh(S)
    if not J.any():
        radius2 = 0.4 * 0.03**2  # of a ball of 30 mm
        J = m * radius2 * np.eye(3)
        said = f"{where}: has mass but no inertia: that of a ball of 30 mm, {m * radius2:.2g} kg m2"
    elif values[0] < -TOLERANCE * size:
        # A little above 0: Drake measures about other points and in other axes, and rounds.
        S = axes @ np.diag(np.maximum(values, 1e-4 * max(values[-1], 1e-9))) @ axes.T
        moments = np.linalg.eigvalsh(J)
        J = np.trace(S) * np.eye(3) - S
        said = (
            f"{where}: its moments of inertia {_moments(moments)} are of no body (two must make up the third): "
            f"{_moments(np.linalg.eigvalsh(J))}"
        )
    else:
        return []
    for key, value in zip(_INERTIA, (J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2])):
        element.set(key, f"{value:.9g}")
    return [said]


def _moments(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"


def _massless(robot: Robot) -> list[str]:
    """A joint that moves nothing: Drake's mass matrix would be singular."""
    lines = []
    for joint in robot.joints.values():
        if not joint.moving:
            continue
        carried, heavy = [joint.child], False
        for name in carried:
            heavy = heavy or robot.links[name].find("inertial") is not None
            carried += [other.child for other in robot.below(name)]
        if heavy:
            continue
        inertial = ET.Element("inertial")
        ET.SubElement(inertial, "mass", {"value": f"{LEAST_MASS:g}"})
        values = [LEAST_INERTIA] * 3 + [0.0] * 3
        ET.SubElement(inertial, "inertia", {key: f"{value:g}" for key, value in zip(_INERTIA, values)})
        robot.links[joint.child].insert(0, inertial)
        lines.append(f"link {shown(joint.child)}: moves and has no mass: {LEAST_MASS * 1e3:g} g")
    return lines


def _actuators(robot: Robot) -> list[str]:
    """A transmission for each joint that can be driven: it is how Drake learns an effort limit."""
    without = []
    for joint in robot.joints.values():
        if not joint.moving or joint.mimic is not None:
            continue
        if not (joint.limit("effort") or 0) > 0:
            without.append(joint.name)
            continue
        item = ET.SubElement(robot.element, "transmission", {"name": f"{joint.name}_transmission"})
        ET.SubElement(item, "type").text = "transmission_interface/SimpleTransmission"
        ET.SubElement(item, "joint", {"name": joint.name})
        ET.SubElement(item, "actuator", {"name": joint.name})
    return [f"no effort limit, so no actuator: {', '.join(map(shown, without))}"] if without else []
