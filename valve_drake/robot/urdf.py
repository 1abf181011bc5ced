"""Reading and checking a URDF: the tree of links and joints that it describes.

A file that cannot be used is refused in one line that names the file, the element and the value.
"""

import dataclasses as dc
import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from valve_drake.checks import ConfigError, shown
from valve_drake.robot import xml_file

MAX_LENGTH = 10.0  # of a joint's origin or a mesh: beyond it the numbers are millimetres [m]
MOVING = ("revolute", "continuous", "prismatic")
_TYPES = (*MOVING, "fixed", "floating", "planar")
_SHAPES = ("box", "cylinder", "sphere", "capsule", "mesh")
_OTHERS = {
    "sdf": "an SDF model needs no import: name it in robot.yaml",
    "mujoco": "MJCF is not read: export the robot as URDF",
    "COLLADA": "this is a mesh: name the URDF that uses it",
    "html": "this is a web page: save the raw file",
    "launch": "this is a launch file: name the URDF that it loads",
}


@dc.dataclass
class Joint:
    """One joint of the tree; its element is what is written in the end. Lengths [m], angles [rad]."""

    element: ET.Element
    name: str
    type: str
    parent: str
    child: str

    @property
    def moving(self) -> bool:
        return self.type in MOVING

    @property
    def axis(self) -> np.ndarray:
        """(3,) unit vector in the joint's frame."""
        axis = numbers(self.element.find("axis"), "xyz", 3, (1.0, 0.0, 0.0))
        return axis / np.linalg.norm(axis)

    @property
    def X(self) -> np.ndarray:
        """(4, 4) pose of the child in the parent at zero."""
        return pose(self.element)

    def limit(self, key: str) -> float | None:
        """`lower`, `upper`, `effort` or `velocity` as the file has it."""
        element = self.element.find("limit")
        return None if element is None or element.get(key) is None else float(element.get(key, ""))

    @property
    def range(self) -> tuple[float, float]:
        """Where it may stand; URDF's defaults are zero."""
        if self.type == "continuous" or self.element.find("limit") is None:
            return -math.inf, math.inf
        return self.limit("lower") or 0.0, self.limit("upper") or 0.0

    @property
    def mimic(self) -> tuple[str, float, float] | None:
        """The joint that it follows, multiplier, offset."""
        element = self.element.find("mimic")
        if element is None:
            return None
        return element.get("joint", ""), float(element.get("multiplier", "1")), float(element.get("offset", "0"))


@dc.dataclass
class Robot:
    """A checked URDF: the XML, and its links and joints by name, in the file's order."""

    element: ET.Element
    source: str
    name: str
    links: dict[str, ET.Element]
    joints: dict[str, Joint]
    root: str

    @property
    def above(self) -> dict[str, Joint]:
        """The joint that carries a link; none for the root."""
        return {joint.child: joint for joint in self.joints.values()}

    def below(self, link: str) -> list[Joint]:
        return [joint for joint in self.joints.values() if joint.parent == link]

    def path(self, link: str) -> list[Joint]:
        """The joints from the root to a link."""
        above, out = self.above, []
        while link in above:
            out.append(above[link])
            link = above[link].parent
        return out[::-1]

    def beyond(self, link: str) -> list[str]:
        """A link and all that it carries."""
        out = [link]
        for name in out:
            out += [joint.child for joint in self.below(name)]
        return out

    def poses(self, positions: dict[str, float] | None = None) -> dict[str, np.ndarray]:
        """(4, 4) pose of each link in the root. positions: of joints [m, rad], zero if not named; mimics follow."""
        positions = dict(positions or {})
        out = {self.root: np.eye(4)}
        for link in self.beyond(self.root):
            for joint in self.below(link):
                q, follows, seen = positions.get(joint.name, 0.0), joint.mimic, 0
                scale, offset = 1.0, 0.0
                while follows and seen < 8:  # a chain of followers
                    scale, offset = scale * follows[1], offset + scale * follows[2]
                    q = scale * positions.get(follows[0], 0.0) + offset
                    follows, seen = self.joints[follows[0]].mimic, seen + 1
                out[joint.child] = out[link] @ joint.X @ _moved(joint, q)
        return out


def read(path: Path) -> Robot:
    """The robot that a file describes. Raises ConfigError, one line."""
    return parse(xml_file.load(path, path.name), path.name)


def parse(data: bytes, source: str) -> Robot:
    """The robot that a URDF's bytes describe. Raises ConfigError, one line that begins with `source`."""
    element = xml_file.parse(data, source)
    if element.tag != "robot":
        hint = _OTHERS.get(element.tag, "a URDF begins with <robot>")
        raise ConfigError(f"{source}: its root element is <{element.tag[:40]}>: {hint}")
    _refuse_xacro(element, source)
    name = element.get("name", "").strip() or Path(source).stem
    if not name.isprintable():
        raise ConfigError(f"{source}: the robot's name must be of printable characters, got {shown(name)}")
    links = _named(element, "link", source)
    if not links:
        raise ConfigError(f"{source}: no <link> in it")
    joints = {}
    for key, item in _named(element, "joint", source).items():
        ends = {}
        for end in ("parent", "child"):
            found = item.find(end)
            ends[end] = "" if found is None else found.get("link", "")
            if ends[end] not in links:
                raise ConfigError(f"{source}: joint {shown(key)}: its {end} is no link of the file: {shown(ends[end])}")
        kind = item.get("type", "")
        if kind not in _TYPES:
            raise ConfigError(
                f"{source}: joint {shown(key)}: type must be one of {', '.join(_TYPES)}, got {shown(kind)}"
            )
        joints[key] = Joint(item, key, kind, ends["parent"], ends["child"])
    robot = Robot(element, source, name, links, joints, _root(links, joints, source))
    _check_numbers(robot)
    return robot


def numbers(element: ET.Element | None, key: str, count: int, default: tuple[float, ...]) -> np.ndarray:
    """(count,) the numbers of an attribute. Raises ValueError."""
    text = None if element is None else element.get(key)
    if text is None:
        return np.array(default, float)
    values = np.array([float(word) for word in text.split()])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError
    return values


def pose(element: ET.Element) -> np.ndarray:
    """(4, 4) what its <origin> says."""
    origin = element.find("origin")
    X = np.eye(4)
    X[:3, :3] = rotation(numbers(origin, "rpy", 3, (0.0, 0.0, 0.0)))
    X[:3, 3] = numbers(origin, "xyz", 3, (0.0, 0.0, 0.0))
    return X


def rotation(rpy: np.ndarray) -> np.ndarray:
    """(3, 3) of roll, pitch and yaw about fixed x, y, z [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _moved(joint: Joint, q: float) -> np.ndarray:
    X = np.eye(4)
    if joint.type == "prismatic":
        X[:3, 3] = q * joint.axis
    elif joint.moving and q:
        x, y, z = joint.axis
        K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        X[:3, :3] += math.sin(q) * K + (1 - math.cos(q)) * K @ K
    return X


def _refuse_xacro(element: ET.Element, source: str) -> None:
    for item in element:
        if item.tag.startswith("xacro:"):
            text = f"<{item.tag}>"
        elif item.tag in ("link", "joint", "material"):
            found = next((v for part in item.iter() for v in part.attrib.values() if "${" in v or "$(" in v), None)
            inner = next((part.tag for part in item.iter() if part.tag.startswith("xacro:")), None)
            if found is None and inner is None:
                continue
            text = found or f"<{inner}>"
        else:
            continue
        raise ConfigError(
            f"{source}: {shown(text)} is xacro that is not expanded: xacro FILE.xacro > FILE.urdf does it"
        )


def _named(element: ET.Element, tag: str, source: str) -> dict[str, ET.Element]:
    out: dict[str, ET.Element] = {}
    for item in element.findall(tag):
        name = item.get("name", "")
        if not name:
            raise ConfigError(f"{source}: a <{tag}> has no name (number {len(out) + 1} of the file)")
        if not name.isprintable():
            raise ConfigError(f"{source}: a {tag}'s name must be of printable characters, got {shown(name)}")
        if name in out:
            raise ConfigError(f"{source}: two {tag}s are named {shown(name)}")
        out[name] = item
    return out


def _root(links: dict[str, ET.Element], joints: dict[str, Joint], source: str) -> str:
    above: dict[str, Joint] = {}
    for joint in joints.values():
        if joint.child in above:
            first = above[joint.child].name
            raise ConfigError(
                f"{source}: link {shown(joint.child)} hangs on two joints: {shown(first)}, {shown(joint.name)}"
            )
        above[joint.child] = joint
    roots = [name for name in links if name not in above]
    if len(roots) > 1:
        raise ConfigError(f"{source}: must be one tree, but {len(roots)} links hang on no joint: {shown(roots[:5])}")
    reached = set(roots)
    children: dict[str, list[str]] = {}
    for joint in joints.values():
        children.setdefault(joint.parent, []).append(joint.child)
    todo = list(roots)
    while todo:
        reached.update(found := children.get(todo.pop(), []))
        todo += found
    if len(reached) < len(links):
        lost = next(name for name in links if name not in reached)
        raise ConfigError(f"{source}: link {shown(lost)} hangs in a ring of joints")
    return roots[0]


def _check_numbers(robot: Robot) -> None:
    """All that is read as numbers later, and the sizes that Drake would end the program over."""
    for name, link in robot.links.items():
        where = f"{robot.source}: link {shown(name)}"
        for part in link:
            if part.tag == "inertial":
                _check_inertial(part, where)
            elif part.tag in ("visual", "collision"):
                _check_shape(part, where)
    for joint in robot.joints.values():
        _check_joint(joint, f"{robot.source}: joint {shown(joint.name)}")
    for material in robot.element.findall("material"):
        for color in material.iter("color"):
            _row(color, "rgba", 4, f"{robot.source}: material {shown(material.get('name'))}")


def _row(element: ET.Element, key: str, count: int, where: str) -> np.ndarray | None:
    """(count,) numbers; None where the attribute is missing. Raises ConfigError."""
    if element.get(key) is None:
        return None
    try:
        return numbers(element, key, count, ())
    except ValueError:
        rule = "a finite number" if count == 1 else f"{count} finite numbers"
        raise ConfigError(f"{where}: {element.tag} {key} must be {rule}, got {shown(element.get(key))}") from None


def _check_origin(part: ET.Element, where: str) -> None:
    for origin in part.findall("origin"):
        xyz = _row(origin, "xyz", 3, where)
        _row(origin, "rpy", 3, where)
        if xyz is not None and np.linalg.norm(xyz) > MAX_LENGTH:
            raise ConfigError(
                f"{where}: {part.tag} origin is {np.linalg.norm(xyz):g} m away: lengths must be metres, these are "
                "millimetres"
            )


def _check_inertial(part: ET.Element, where: str) -> None:
    _check_origin(part, where)
    for mass in part.findall("mass"):
        _row(mass, "value", 1, where)
    for inertia in part.findall("inertia"):
        for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"):
            _row(inertia, key, 1, where)


def _check_shape(part: ET.Element, where: str) -> None:
    _check_origin(part, where)
    for color in part.iterfind("material/color"):
        _row(color, "rgba", 4, where)
    shapes = part.findall("geometry/*")
    tags = [item.tag for item in shapes]
    if len(tags) != 1 or not (tags[0] in _SHAPES or tags[0].startswith("drake:")):
        raise ConfigError(f"{where}: {part.tag} geometry must be one of {', '.join(_SHAPES)}, got {shown(tags)}")
    shape = shapes[0]
    if shape.tag == "mesh":
        scale = _row(shape, "scale", 3, where)
        if scale is not None and not np.all(np.abs(scale) > 1e-9):
            raise ConfigError(f"{where}: mesh scale must not be 0, got {shown(shape.get('scale'))}")
    for key in {"box": ["size"], "sphere": ["radius"]}.get(shape.tag, ["radius", "length"]):
        if shape.tag == "mesh" or shape.tag.startswith("drake:"):
            break
        sizes = _row(shape, key, 3 if shape.tag == "box" else 1, where)
        if sizes is None or not np.all(sizes > 0):
            raise ConfigError(f"{where}: {shape.tag} {key} must be > 0, got {shown(shape.get(key))}")
        if sizes.max() > MAX_LENGTH:
            raise ConfigError(f"{where}: {shape.tag} {key} must be metres, got {sizes.max():g}")


def _check_joint(joint: Joint, where: str) -> None:
    _check_origin(joint.element, where)
    for axis in joint.element.findall("axis"):
        xyz = _row(axis, "xyz", 3, where)
        if xyz is not None and joint.moving and np.linalg.norm(xyz) < 1e-9:
            raise ConfigError(f"{where}: axis xyz must not be 0, got {shown(axis.get('xyz'))}")
    for part in joint.element:
        if part.tag in ("limit", "dynamics", "mimic"):
            for key in ("lower", "upper", "effort", "velocity", "damping", "friction", "multiplier", "offset"):
                if key not in ("effort", "velocity") or _finite(part.get(key)):
                    _row(part, key, 1, where)
    low, high = joint.range if joint.moving else (0.0, 0.0)
    if low > high:
        raise ConfigError(f"{where}: limit lower must be below upper, got {low:g} and {high:g}")


def _finite(text: str | None) -> bool:
    """Not "inf", which some files have where there is no limit."""
    try:
        return text is None or math.isfinite(float(text))
    except ValueError:
        return True
