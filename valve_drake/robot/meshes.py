"""Meshes as Drake's renderers want them: OBJ with normals, one colour a file; and their convex hulls for contact.

STL, DAE, GLB, glTF, OBJ and PLY are read by trimesh (the extra `robots`), in metres: a DAE by the unit that it states.
Corners are shaded smooth where the faces that meet there enclose less than CREASE, and flat elsewhere. Faces that are
listed the wrong way round are turned. Nothing is decimated.
"""

import dataclasses as dc
import io
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake.checks import ConfigError, shown

CREASE = 35.0  # faces that enclose more make an edge [deg]; lower it where round parts show facets' edges as smooth
MAX_BYTES = 200_000_000  # of a mesh's file
MAX_COLORS = 8  # of a mesh that paints its corners; more are a picture, of which the mean is taken
MARK = "made by valve-drake import-robot"  # in the head of what may be made again
SUFFIXES = (".stl", ".dae", ".glb", ".gltf", ".obj", ".ply")

INSTALL = "pip install 'valve-drake[robots]'"
_PICTURES = {".dae": b"<image", ".glb": b'"images"', ".gltf": b'"images"'}
_INSTANCE = re.compile(rb"<instance_geometry\b[^>]*\burl=[\"']#([^\"']+)")
_BINDING = re.compile(rb"<bind_material\b.*?</bind_material>", re.DOTALL)

Rgba = tuple[float, float, float, float]


@dc.dataclass
class Part:
    """Triangles of one colour. points (n, 3) [m], faces (m, 3), counterclockwise seen from outside; None: no colour."""

    points: np.ndarray
    faces: np.ndarray
    color: Rgba | None


@dc.dataclass
class Surface:
    """What a file holds, and remarks on what could not be kept."""

    parts: list[Part]
    notes: list[str]

    @property
    def points(self) -> np.ndarray:
        return np.concatenate([part.points for part in self.parts])

    @property
    def faces(self) -> int:
        return sum(len(part.faces) for part in self.parts)


def check_reader() -> None:
    """Raises ConfigError if trimesh or what it reads DAE with is missing."""
    try:
        import collada  # noqa: F401
        import trimesh  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"{error.name} is missing, which reads meshes: {INSTALL}") from None


def read(path: Path, what: str) -> Surface:
    """The triangles of a file, by colour. Raises ConfigError "<what>: ..." for what holds none or cannot be read."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ConfigError(f"{what}: a mesh must be one of {', '.join(SUFFIXES)}, got {shown(path.name)}")
    check_reader()
    import trimesh

    if path.stat().st_size > MAX_BYTES:
        raise ConfigError(f"{what}: {shown(str(path))} is larger than {MAX_BYTES / 1e6:g} MB")
    if suffix == ".dae":
        _refuse_entities(path, what)
    pictures = _PICTURES.get(suffix)
    if pictures and not _reads_pictures() and pictures in path.read_bytes():
        raise ConfigError(f"{what}: PIL is missing, which reads the pictures of {shown(path.name)}: {INSTALL}")
    try:
        scene, remarks = _load(trimesh, path)
        parts: list[Part] = []
        notes: list[str] = remarks
        order = {name: k for k, name in enumerate(scene.geometry)}
        nodes = [scene.graph[node] for node in scene.graph.nodes_geometry]  # whose own names may be drawn by chance
        for X, name in sorted(nodes, key=lambda node: (order[node[1]], np.asarray(node[0]).ravel().tolist())):
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
                parts += _parts(mesh, np.asarray(X, float), suffix, notes)
        if suffix == ".dae":
            unit = _dae_unit(scene)
            for part in parts:
                part.points = part.points * unit
    except (MemoryError, KeyboardInterrupt):
        raise
    except Exception as error:  # a file that is no such mesh raises anything
        reason = str(error).splitlines()[0][:160] if str(error) else type(error).__name__
        raise ConfigError(f"{what}: {shown(str(path))} cannot be read as {suffix[1:].upper()}: {reason}") from error
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise ConfigError(f"{what}: {shown(str(path))} holds no triangle")
    if not all(np.isfinite(part.points).all() for part in parts):
        raise ConfigError(f"{what}: {shown(str(path))} has points that are no numbers")
    return Surface(_merged(parts), list(dict.fromkeys(notes)))


def _load(trimesh: Any, path: Path) -> tuple[Any, list[str]]:
    """trimesh's scene, and remarks."""
    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # what it warns of shows in the result
    try:
        scene = trimesh.load_scene(str(path), process=False)
        if path.suffix.lower() != ".dae":
            return scene, []
        data = path.read_bytes()
        if all(any(name.startswith(one) for name in scene.geometry) for one in _dae_instances(data)):
            return scene, []
        # A part whose material is broken is left out with it: so all are read without.
        bare = _BINDING.sub(b"", data)
        resolver = trimesh.resolvers.FilePathResolver(str(path))
        scene = trimesh.load_scene(io.BytesIO(bare), file_type="dae", process=False, resolver=resolver)
        return scene, ["its materials are broken: it has the colour that the URDF gives"]
    finally:
        logger.setLevel(level)


def _dae_instances(data: bytes) -> set[str]:
    """The geometries that a DAE places."""
    return {name.decode("utf-8", "replace") for name in _INSTANCE.findall(data)}


def _reads_pictures() -> bool:
    try:
        import PIL.Image  # noqa: F401
    except ImportError:
        return False
    return True


def _refuse_entities(path: Path, what: str) -> None:
    with open(path, "rb") as file:
        head = file.read(1_000_000)
    if b"<!DOCTYPE" in head or b"<!ENTITY" in head or head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise ConfigError(f"{what}: {shown(str(path))}: a DAE with a document type, or not in UTF-8, is not read")


def _dae_unit(scene: Any) -> float:
    """What trimesh notes and does not apply: "0.001 * meters" [m]."""
    for mesh in scene.geometry.values():
        word = str(mesh.metadata.get("units", "")).split(" ")[0]
        try:
            return float(word)
        except ValueError:
            continue
    return 1.0


def _parts(mesh: Any, X: np.ndarray, suffix: str, notes: list[str]) -> list[Part]:
    points = np.asarray(mesh.vertices, float) @ X[:3, :3].T + X[:3, 3]
    faces = np.array(mesh.faces, int)
    corners = points[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if suffix == ".stl":
        given = np.asarray(mesh.face_normals, float)
    else:
        given = np.asarray(mesh.vertex_normals, float)[faces].sum(axis=1) @ np.linalg.inv(X[:3, :3])
    if len(given) == len(faces):
        against = np.einsum("ij,ij->i", cross, given) < -0.1 * np.linalg.norm(cross, axis=1)
        faces[against] = faces[against][:, ::-1]
    elif np.linalg.det(X[:3, :3]) < 0:
        faces = faces[:, ::-1]
    return [Part(points, faces[of], color) for of, color in _colored(mesh, len(faces), suffix, notes)]


def _colored(mesh: Any, count: int, suffix: str, notes: list[str]) -> list[tuple[np.ndarray, Rgba | None]]:
    """Which faces have which colour."""
    everything, visual = np.arange(count), mesh.visual
    kind = getattr(visual, "kind", None)
    if kind == "texture":
        material = visual.material
        image = getattr(material, "baseColorTexture", None)
        image = getattr(material, "image", None) if image is None else image
        factor = getattr(material, "baseColorFactor", None)
        factor = getattr(material, "diffuse", None) if factor is None else factor
        color = np.ones(4) if factor is None else np.asarray(factor, float)[:4] / 255
        color = np.append(color, np.ones(4 - len(color)))
        if suffix in (".glb", ".gltf"):  # its factors are linear; Drake's colours are what the screen shows
            color[:3] = _to_screen(color[:3])
        if image is not None and visual.uv is not None:
            texture = np.asarray(image.convert("RGBA"), float) / 255
            uv = np.asarray(visual.uv, float)[np.asarray(mesh.faces)].mean(axis=1) % 1.0
            rows = np.minimum(((1 - uv[:, 1]) * texture.shape[0]).astype(int), texture.shape[0] - 1)
            columns = np.minimum((uv[:, 0] * texture.shape[1]).astype(int), texture.shape[1] - 1)
            color = color * texture[rows, columns].mean(axis=0)
            notes.append("its picture (texture) is one colour, the mean")
        elif factor is None and image is None:
            return [(everything, None)]
        return [(everything, _rgba(color))]
    if kind in ("vertex", "face"):
        rows = np.asarray(visual.vertex_colors, float)[np.asarray(mesh.faces)].mean(axis=1) / 255
        if kind == "face":
            rows = np.asarray(visual.face_colors, float) / 255
        found, which = np.unique(np.round(rows, 2), axis=0, return_inverse=True)
        if len(found) > MAX_COLORS:
            notes.append("its painted corners are one colour, the mean")
            return [(everything, _rgba(rows.mean(axis=0)))]
        return [(everything[which.ravel() == k], _rgba(color)) for k, color in enumerate(found)]
    return [(everything, None)]


def _to_screen(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def _rgba(color: np.ndarray) -> Rgba:
    r, g, b, a = (round(float(value), 3) + 0.0 for value in np.clip(color, 0, 1))
    return r, g, b, a


def _merged(parts: list[Part]) -> list[Part]:
    """A part for each colour, its points merged."""
    out = []
    for color in dict.fromkeys(part.color for part in parts):
        same = [part for part in parts if part.color == color]
        starts = np.cumsum([0, *(len(part.points) for part in same)])
        points = np.concatenate([part.points for part in same])
        faces = np.concatenate([part.faces + start for part, start in zip(same, starts)])
        out.append(Part(points, faces, color))
    return out


def placed(part: Part, scale: np.ndarray, R: np.ndarray | None = None) -> Part:
    """Scaled along its axes (after a turn R); the right way round if the scale mirrors it. Points merged to 10 um."""
    points = (part.points if R is None else part.points @ R.T) * scale
    faces = part.faces[:, ::-1] if np.prod(scale) < 0 else part.faces
    grid, where = np.unique(np.round(points * 1e5).astype(np.int64), axis=0, return_inverse=True)
    faces = where.ravel()[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, faces = np.unique(faces, return_inverse=True)
    points, faces = grid[used] / 1e5, faces.reshape(-1, 3)
    if _inside_out(points, faces):
        faces = faces[:, ::-1]
    return Part(points, faces, part.color)


def _inside_out(points: np.ndarray, faces: np.ndarray) -> bool:
    """Whether a closed surface has its faces the wrong way round."""
    if not len(faces) or not closed(faces):
        return False
    a, b, c = points[faces].transpose(1, 0, 2)
    return bool(np.einsum("ij,ij->", a, np.cross(b, c)) < 0)


def closed(faces: np.ndarray) -> bool:
    """Whether each edge has one face on each side."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    n = int(faces.max()) + 1
    there, back = np.sort(ends[:, 0] * n + ends[:, 1]), np.sort(ends[:, 1] * n + ends[:, 0])
    return bool(np.array_equal(there, back))


def corner_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(m, 3, 3) unit normal of each corner of each face."""
    corners = points[faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # twice the face's
    length = np.linalg.norm(area, axis=1, keepdims=True)
    flat = area / np.maximum(length, 1e-15)
    order = np.argsort(faces.ravel(), kind="stable")  # corners by point
    face = (order // 3).astype(np.int64)
    counts = np.bincount(faces.ravel(), minlength=len(points))
    starts = np.concatenate([[0], np.cumsum(counts)])
    sums = np.zeros((faces.size, 3))
    level = np.cos(np.radians(CREASE))
    point_of = faces.ravel()[order]
    step = 0
    most = int(counts.max()) if len(counts) else 0
    position = np.arange(faces.size) - starts[point_of]
    while step < most:  # each corner with its neighbour `step` further on around their point
        live = np.nonzero(counts[point_of] > step)[0]
        other = starts[point_of[live]] + (position[live] + step) % counts[point_of[live]]
        mine, theirs = face[live], face[other]
        near = np.einsum("ij,ij->i", flat[mine], flat[theirs]) >= level
        sums[live[near]] += area[theirs[near]]
        step += 1
    norm = np.linalg.norm(sums, axis=1, keepdims=True)
    smooth = np.where(norm > 1e-15, sums / np.maximum(norm, 1e-15), flat[face])
    out = np.empty_like(smooth)
    out[order] = smooth
    return out.reshape(-1, 3, 3)


def obj_text(part: Part, title: str) -> str:
    """The part as OBJ: points to 10 um, normals to 0.1 %."""
    normals = np.round(corner_normals(part.points, part.faces).reshape(-1, 3), 3) + 0.0
    distinct, which = np.unique(normals, axis=0, return_inverse=True)
    points, at = part.points, part.faces.ravel() + 1
    lines = [f"# {MARK}\n# {title}\n"]
    lines.append("".join([f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in (np.round(points, 5) + 0.0).tolist()]))
    lines.append("".join([f"vn {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in distinct.tolist()]))
    rows = np.stack([at, which.ravel() + 1], axis=1).reshape(-1, 6).tolist()
    lines.append("".join([f"f {a}//{n} {b}//{o} {c}//{p}\n" for a, n, b, o, c, p in rows]))
    return "".join(lines)


def hull_text(points: np.ndarray, title: str, what: str) -> tuple[str, int]:
    """The convex hull of points (n, 3) as OBJ, and its number of points. Raises ConfigError."""
    from pydrake.geometry import Convex

    cloud = np.unique(np.round(points, 5), axis=0)
    try:
        hull = Convex(points=cloud.T, label=title).GetConvexHull()
    except Exception as error:
        size = np.ptp(cloud, axis=0)
        raise ConfigError(
            f"{what}: no convex hull of a mesh of {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} m"
        ) from error
    lines = [f"# {MARK}\n# {title}\n"]
    for k in range(hull.num_vertices()):
        x, y, z = (np.round(np.asarray(hull.vertex(k)), 6) + 0.0).tolist()
        lines.append(f"v {x:.9g} {y:.9g} {z:.9g}\n")
    for k in range(hull.num_elements()):
        element = hull.element(k)
        lines.append("f " + " ".join(str(element.vertex(i) + 1) for i in range(element.num_vertices())) + "\n")
    return "".join(lines), hull.num_vertices()


def made_before(path: Path) -> bool:
    """Whether a file is one of ours."""
    try:
        with open(path, "rb") as file:
            return MARK.encode() in file.read(400)
    except OSError:
        return False
