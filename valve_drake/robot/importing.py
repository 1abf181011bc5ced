"""A robot from its URDF: a model folder that Drake and the renderers read, and the draft of its robot.yaml.

Meshes become OBJ (meshes.py), what Drake refuses is mended (mending.py), and what names and tree tell becomes the draft
(drafting.py). The kinematics stay those of the file, but for a `base_footprint` on the floor where the root is not
there.
"""

import dataclasses as dc
import re
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from valve_drake import outputs
from valve_drake.checks import ConfigError, shown
from valve_drake.robot import drafting, meshes, packages, urdf
from valve_drake.robot.mending import mend
from valve_drake.robot.meshes import Part, Rgba, Surface
from valve_drake.robot.urdf import Joint, Robot

GREY: Rgba = (0.7, 0.7, 0.7, 1.0)  # of shapes without a colour
FLOOR = 0.02  # how far below or above the floor the lowest shape may lie [m]; more, and a base_footprint is added
MOST_LOST = 4  # missing files, after the first, that a line names
FOOTPRINT = "base_footprint"
_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # glTF's axes to a robot's


@dc.dataclass
class Report:
    """What an import made of a file, and what is left to do. Lines of text in plain words."""

    robot: str
    urdf: Path
    files: list[Path]
    mended: list[str]
    notes: list[str]
    todo: list[str]
    counts: dict[str, int]  # links, joints, meshes, faces, hulls, hull_points
    mesh_bytes: int
    seconds: float

    def lines(self) -> list[str]:
        """The report for a person."""
        n = self.counts
        head = (
            f"{self.urdf}: {n['links']} links, {n['joints']} joints that move, "
            f"{n['meshes']} meshes of {n['faces']} faces, "
            f"{n['hulls']} convex hulls, {self.mesh_bytes / 1e6:.2f} MB, in {self.seconds:.1f} s"
        )
        out = [head, *(f"mended: {line}" for line in self.mended), *(f"note: {line}" for line in self.notes)]
        draft = next((path.name for path in self.files if path.name == "robot.yaml"), None)
        return out + [f"to do in {draft}: {line}" for line in self.todo if draft]

    def as_dict(self) -> dict[str, object]:
        """The report for a program."""
        return {
            "robot": self.robot,
            "urdf": str(self.urdf),
            "files": [str(path) for path in self.files],
            "mended": self.mended,
            "notes": self.notes,
            "todo": self.todo,
            **self.counts,
            "mesh_bytes": self.mesh_bytes,
            "seconds": round(self.seconds, 3),
        }


def import_robot(model: str, out: Path | None = None, overwrite: bool = False, picture: Path | None = None) -> Report:
    """Writes <out>/<name>.urdf, meshes/*.obj, LICENSE and robot.yaml for a URDF named by a path or a package:// URL.

    out: a folder, by default the robot's name. What an import has made before is made again, but for a robot.yaml,
    which is left as it is unless `overwrite`. picture: a PNG of the model, at zero. Raises ConfigError for what cannot
    be used, OperationFailed if it cannot be written.
    """
    start = time.perf_counter()
    path = packages.resolve(model, None, "MODEL")
    robot = urdf.read(path)
    mended = mend(robot)
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", robot.name).strip("._") or "robot"
    folder = Path(name) if out is None else out
    license_file = packages.license_of(path)
    firm = [f"{name}.urdf", *(["LICENSE"] if license_file else [])]
    inputs = [path, *([license_file] if license_file else [])]

    def check(names: list[str]) -> None:
        for each in names:
            outputs.check(folder / each, "-o", inputs, _made_before, overwrite, new_folders=True)

    check(firm)  # before the long work
    if picture is not None:
        outputs.check(picture, "--picture", [*inputs, *(folder / each for each in firm)], None, overwrite)
    words = [*robot.links, *(mesh.get("filename", "") for mesh in robot.element.iter("mesh"))]
    converter = _Converter(robot, path)
    converter.convert()
    notes = converter.notes
    notes += _on_the_floor(robot, converter.boxes)
    mended += drafting.couple_fingers(robot)
    found = drafting.guess(robot, converter.boxes, converter.points, converter.used, words)
    text, todo = drafting.draft(robot, found, f"{name}.urdf", mended)
    keep = (folder / "robot.yaml").exists() and not overwrite
    if keep:
        notes.append(f"{folder / 'robot.yaml'} exists and is left as it is (--overwrite replaces it)")
    if license_file is None:
        notes.append("no licence was found beside the model: ask its authors before you pass it on")
    products: dict[str, str | bytes] = {f"meshes/{key}": value for key, value in converter.files.items()}
    products[f"{name}.urdf"] = _xml(robot, path)
    if license_file is not None:
        products["LICENSE"] = license_file.read_bytes()
    if not keep:
        products["robot.yaml"] = text
    inputs += converter.read
    check([key for key in products if key != "robot.yaml"])
    if not keep:
        outputs.check(folder / "robot.yaml", "-o", inputs, None, overwrite, new_folders=True)
    outputs.make_folder(folder / "meshes" if converter.files else folder)
    for key, data in products.items():
        outputs.write(folder / key, data)
    files = [folder / key for key in products]
    if picture is not None:
        outputs.write(picture, _portrait(folder / f"{name}.urdf", robot, converter.boxes))
        files.append(picture)
    return Report(
        robot=robot.name,
        urdf=folder / f"{name}.urdf",
        files=files,
        mended=mended,
        notes=notes,
        todo=[] if keep else todo,
        counts={
            "links": len(robot.links),
            "joints": sum(joint.moving for joint in robot.joints.values()),
            "meshes": len(converter.files) - converter.hulls,
            "faces": converter.faces,
            "hulls": converter.hulls,
            "hull_points": converter.hull_points,
        },
        mesh_bytes=sum(len(data) for data in converter.files.values()),
        seconds=time.perf_counter() - start,
    )


def _portrait(path: Path, robot: Robot, boxes: dict[str, np.ndarray]) -> bytes:
    from valve_drake.robot.portrait import portrait

    poses = robot.poses({joint.name: float(np.clip(0.0, *joint.range)) for joint in robot.joints.values()})
    corners = [drafting.corners_in(poses[link], box) for link, box in boxes.items()]
    return portrait(path, _box(np.concatenate(corners)) if corners else np.array([[-1.0, -1, 0], [1, 1, 1]]))


def _made_before(path: Path) -> bool:
    """A URDF or an OBJ of an import, or the licence that lies beside such a URDF."""
    if path.name == "LICENSE":
        return any(meshes.made_before(other) for other in path.parent.glob("*.urdf"))
    return meshes.made_before(path)


class _Converter:
    """Makes OBJ of a robot's meshes and materials of its colours, in its XML."""

    def __init__(self, robot: Robot, path: Path):
        self._robot, self._folder = robot, path.parent
        self.files: dict[str, str] = {}
        self.boxes: dict[str, np.ndarray] = {}  # link -> (2, 3) of its shapes, see drafting.Boxes
        self.points: dict[str, np.ndarray] = {}  # link -> (n, 3), see drafting.Points
        self.notes: list[str] = []
        self.used: dict[str, Rgba] = {}  # materials
        self.faces = self.hulls = self.hull_points = 0
        self._paths: dict[str, Path] = {}
        self._surfaces: dict[Path, Surface] = {}
        self._made: dict[tuple[object, ...], list[tuple[str, Part]]] = {}
        self._colors = self._materials()
        self._turn: np.ndarray | None = None  # of glTF meshes

    @property
    def read(self) -> list[Path]:
        return list(self._surfaces)

    def convert(self) -> None:
        self._load()
        self._turn = self._gltf_turn()
        for name, link in self._robot.links.items():
            corners = [self._convert(name, link, shape, shape.tag == "visual") for shape in list(self._shapes(link))]
            if corners:
                self.points[name] = points = np.concatenate(corners)
                self.boxes[name] = np.stack([points.min(axis=0), points.max(axis=0)])
        for element in self._robot.element.findall("material"):
            self._robot.element.remove(element)
        for k, (name, rgba) in enumerate(self.used.items()):
            material = ET.Element("material", {"name": name})
            ET.SubElement(material, "color", {"rgba": " ".join(f"{value:g}" for value in rgba)})
            self._robot.element.insert(k, material)

    def _shapes(self, link: ET.Element) -> Iterator[ET.Element]:
        for tag in ("visual", "collision"):
            yield from link.findall(tag)

    def _load(self) -> None:
        """Reads every mesh once, so that those that are missing are told before any is converted."""
        self._find()
        for name, link in self._robot.links.items():
            for shape in self._shapes(link):
                mesh = shape.find("geometry/mesh")
                if mesh is None:
                    continue
                path = self._path(name, mesh)
                if path in self._surfaces:
                    continue
                where = self._where(name)
                self._surfaces[path] = surface = meshes.read(path, where)
                size = np.ptp(surface.points, axis=0).max() * np.abs(self._scale(mesh)).max()
                if size > urdf.MAX_LENGTH:
                    raise ConfigError(
                        f"{where}: mesh {shown(path.name)} is {size:.4g} m long: its lengths must be metres, these are "
                        'millimetres: scale="0.001 0.001 0.001"'
                    )
                if shape.tag == "visual":
                    self.notes += [f"mesh {path.name}: {note}" for note in surface.notes]

    def _find(self) -> None:
        """Raises ConfigError: the first mesh that is missing, and the names of the others."""
        first: ConfigError | None = None
        lost: dict[str, None] = {}
        for name, link in self._robot.links.items():
            for shape in self._shapes(link):
                if (mesh := shape.find("geometry/mesh")) is None:
                    continue
                try:
                    self._path(name, mesh)
                except ConfigError as error:
                    first = first or error
                    lost[mesh.get("filename", "")] = None
        if first is None:
            return
        others = list(lost)[1:]
        more = f"; and {len(others)} more: {', '.join(others[:MOST_LOST])}" if others else ""
        raise ConfigError(f"{first}{more}{', ...' if len(others) > MOST_LOST else ''}")

    def _where(self, link: str) -> str:
        return f"{self._robot.source}: link {shown(link)}"

    def _path(self, link: str, mesh: ET.Element) -> Path:
        url = mesh.get("filename", "")
        if not url:
            raise ConfigError(f"{self._where(link)}: a <mesh> has no filename")
        if url not in self._paths:
            self._paths[url], note = packages.resolve_nearby(url, self._folder, self._where(link))
            if note and note not in self.notes:
                self.notes.append(note)
        return self._paths[url]

    def _scale(self, mesh: ET.Element) -> np.ndarray:
        return urdf.numbers(mesh, "scale", 3, (1.0, 1.0, 1.0))

    def _materials(self) -> dict[str, Rgba | None]:
        """The colours that names of materials stand for; None for those of pictures."""
        out: dict[str, Rgba | None] = {}
        for material in self._robot.element.iter("material"):
            name, color = material.get("name", ""), material.find("color")
            if color is not None and out.get(name) is None:
                out[name] = self._rgba(color)
            elif material.find("texture") is not None:
                out.setdefault(name, None)
        return out

    def _rgba(self, color: ET.Element) -> Rgba:
        r, g, b, a = np.clip(urdf.numbers(color, "rgba", 4, GREY), 0, 1).tolist()
        return r, g, b, a

    def _material(self, color: Rgba, name: str = "") -> str:
        """A name for a colour: the one that it has in the file if it is that colour's, else one of its numbers."""
        for known, other in self.used.items():
            if other == color and name in ("", known):
                return known
        if not name or name in self.used:
            name = "color_" + "".join(f"{round(255 * value):02x}" for value in color)
        self.used[name] = color
        return name

    def _look(self, visual: ET.Element) -> tuple[str, Rgba]:
        """The material that the file gives a visual."""
        material = visual.find("material")
        if material is None:
            return "", GREY
        name, color = material.get("name", ""), material.find("color")
        return name, self._rgba(color) if color is not None else self._colors.get(name) or GREY

    def _gltf_turn(self) -> np.ndarray | None:
        """How glTF meshes lie: as they are, as robots' files mostly have them, or with y up as the format has it.

        The collision shapes of their links decide.
        """
        as_is = turned = 0.0
        count = 0
        for name, link in self._robot.links.items():
            seen = [v for v in link.findall("visual") if self._is_gltf(name, v)]
            solid = [self._corners(name, shape, None) for shape in link.findall("collision")]
            if not seen:
                continue
            count += 1
            if solid:
                box = _box(np.concatenate(solid))
                as_is += np.abs(_box(np.concatenate([self._corners(name, v, None) for v in seen])) - box).sum()
                turned += np.abs(_box(np.concatenate([self._corners(name, v, _Y_UP) for v in seen])) - box).sum()
        if not count:
            return None
        if turned < 0.8 * as_is:
            self.notes.append("GLB meshes are turned from y up to z up: so they fit the collision shapes")
            return _Y_UP
        self.notes.append("GLB meshes lie as they are, without a turn from y up")
        return None

    def _is_gltf(self, link: str, shape: ET.Element) -> bool:
        mesh = shape.find("geometry/mesh")
        return mesh is not None and self._path(link, mesh).suffix.lower() in (".glb", ".gltf")

    def _corners(self, link: str, shape: ET.Element, turn: np.ndarray | None) -> np.ndarray:
        """(n, 3) points that span a shape, in its link."""
        X, mesh = urdf.pose(shape), shape.find("geometry/mesh")
        if mesh is not None:
            points = self._surfaces[self._path(link, mesh)].points
            if turn is not None and self._is_gltf(link, shape):
                points = points @ turn.T
            points = points * self._scale(mesh)
        else:
            points = drafting.corners_in(np.eye(4), _primitive(shape))
        return points @ X[:3, :3].T + X[:3, 3]

    def _convert(self, link: str, element: ET.Element, shape: ET.Element, visual: bool) -> np.ndarray:
        """Replaces a shape's mesh by OBJ, a shape for each colour -> its points in the link."""
        corners = self._corners(link, shape, self._turn)
        mesh = shape.find("geometry/mesh")
        name, color = self._look(shape) if visual else ("", GREY)
        for material in shape.findall("material"):
            shape.remove(material)
        if mesh is None:
            if visual:
                ET.SubElement(shape, "material", {"name": self._material(color, name)})
            return corners
        path, scale = self._path(link, mesh), self._scale(mesh)
        if not visual:
            mesh.attrib = {"filename": f"meshes/{self._hull(link, path, scale, mesh)}"}
            for child in list(mesh):
                mesh.remove(child)
            ET.SubElement(mesh, "drake:declare_convex")
            return corners
        at = list(element).index(shape)
        element.remove(shape)
        label = shape.get("name") or f"{link}_visual_{at}"
        parts = self._visual(path, scale, self._is_gltf(link, shape), mesh)
        for k, (file, part) in enumerate(parts):
            each = ET.Element("visual", {"name": label if len(parts) == 1 else f"{label}_{k + 1}"})
            origin = shape.find("origin")
            if origin is not None:
                each.append(origin)
            geometry = ET.SubElement(each, "geometry")
            ET.SubElement(geometry, "mesh", {"filename": f"meshes/{file}"})
            own = self._material(color, name) if part.color is None else self._material(part.color)
            ET.SubElement(each, "material", {"name": own})
            element.insert(at + k, each)
        return corners

    def _visual(self, path: Path, scale: np.ndarray, gltf: bool, mesh: ET.Element) -> list[tuple[str, Part]]:
        turn = self._turn if gltf else None
        key = (path, *scale, "visual")
        if key not in self._made:
            self._made[key] = made = []
            surface = self._surfaces[path]
            for k, part in enumerate(surface.parts):
                own = meshes.placed(part, scale, turn)
                if not len(own.faces):
                    continue
                file = self._name(path.stem + (f"_{k + 1}" if len(surface.parts) > 1 else ""))
                self.files[file] = meshes.obj_text(own, _title(mesh))
                self.faces += len(own.faces)
                made.append((file, own))
        return self._made[key]

    def _hull(self, link: str, path: Path, scale: np.ndarray, mesh: ET.Element) -> str:
        key = (path, *scale, "hull")
        if key not in self._made:
            surface = self._surfaces[path]
            gltf = path.suffix.lower() in (".glb", ".gltf")
            points = surface.points if self._turn is None or not gltf else surface.points @ self._turn.T
            file = self._name(path.stem + "_hull")
            text, count = meshes.hull_text(points * scale, _title(mesh), self._where(link))
            self.files[file] = text
            self.hulls, self.hull_points = self.hulls + 1, self.hull_points + count
            self._made[key] = [(file, surface.parts[0])]
        return self._made[key][0][0]

    def _name(self, stem: str) -> str:
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", stem)
        name, k = f"{stem}.obj", 1
        while name.lower() in (taken.lower() for taken in self.files):
            k += 1
            name = f"{stem}_{k}.obj"
        return name


def _box(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _primitive(shape: ET.Element) -> np.ndarray:
    """(2, 3) the corners of a box, cylinder, sphere or capsule."""
    half = np.zeros(3)
    for item in shape.iterfind("geometry/*"):
        if item.tag == "box":
            half = urdf.numbers(item, "size", 3, ()) / 2
        elif item.tag in ("cylinder", "capsule", "sphere"):
            radius = float(item.get("radius", "0"))
            length = float(item.get("length", "0"))
            end = {"cylinder": 0.0}.get(item.tag, radius)
            half = np.array([radius, radius, length / 2 + end])
    return np.stack([-half, half])


def _title(mesh: ET.Element) -> str:
    """Where a mesh is from, without the folders of one machine."""
    url = mesh.get("filename", "")
    return url if url.startswith(("package://", "model://")) else Path(url).name


def _on_the_floor(robot: Robot, boxes: dict[str, np.ndarray]) -> list[str]:
    """Adds a base_footprint where the root is not on the floor: the planar base moves there."""
    poses = robot.poses()
    arms = {link for arm in drafting.find_arms(robot).values() for link in robot.beyond(robot.joints[arm[0]].child)}
    heights = [drafting.corners_in(poses[link], box)[:, 2].min() for link, box in boxes.items() if link not in arms]
    if not heights:
        return []
    lowest = min(heights)
    if abs(lowest) <= FLOOR or FOOTPRINT in robot.links:
        if abs(lowest) > FLOOR:
            return [f"the lowest shape is {lowest * 1e3:.0f} mm above {FOOTPRINT}: is that the floor?"]
        return []
    link, joint = ET.Element("link", {"name": FOOTPRINT}), ET.Element("joint", {"type": "fixed"})
    joint.set("name", FOOTPRINT + "_joint")
    ET.SubElement(joint, "origin", {"xyz": f"0 0 {-lowest:.4f}", "rpy": "0 0 0"})
    ET.SubElement(joint, "parent", {"link": FOOTPRINT})
    ET.SubElement(joint, "child", {"link": robot.root})
    for element in (joint, link):
        robot.element.insert(list(robot.element).index(robot.links[robot.root]), element)
    robot.links = {FOOTPRINT: link, **robot.links}
    name = FOOTPRINT + "_joint"
    robot.joints = {name: Joint(joint, name, "fixed", FOOTPRINT, robot.root), **robot.joints}
    old, robot.root = robot.root, FOOTPRINT
    way = "below" if lowest < 0 else "above"
    return [f"link '{FOOTPRINT}' is added, {abs(lowest):.3f} m {way} {shown(old)}: there is the lowest shape"]


def _xml(robot: Robot, path: Path) -> str:
    """The model as URDF; path: of the file that it is made from."""
    root = robot.element
    root.attrib = {"name": robot.name, "xmlns:drake": "http://drake.mit.edu"}
    for part in root.iter():
        part.tail = None
        if part.text is not None and not part.text.strip():
            part.text = None
    ET.indent(root)
    origin = path.name if (wheel := packages.wheel_of(path)) is None else f"{path.name} of {wheel[0]} {wheel[1]}"
    origin = re.sub(r"-{2,}", "-", origin)
    comment = f"<!-- {meshes.MARK} from {origin}; edit that, or this if you will not import it again. -->"
    return f'<?xml version="1.0"?>\n{comment}\n{ET.tostring(root, encoding="unicode")}\n'
