"""A model folder from a URDF: what is read, mended, converted, drafted, and refused in one line."""

import importlib.util
import json
import re
import struct
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from valve_drake import cli, yaml_file
from valve_drake.checks import ConfigError
from valve_drake.robot import drafting, packages, urdf, xml_file
from valve_drake.robot.mending import mend

HAS_TRIMESH = importlib.util.find_spec("trimesh") is not None and importlib.util.find_spec("collada") is not None
needs_trimesh = pytest.mark.skipif(not HAS_TRIMESH, reason="the extra `robots` is not installed")

MASS = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
LIMIT = '<limit lower="-1" upper="1" effort="20" velocity="2"/>'
BOX = '<geometry><box size="0.2 0.2 0.2"/></geometry>'


def link(name, inside=MASS):
    return f'<link name="{name}">{inside}</link>'


def joint(name, parent, child, inside=LIMIT, kind="revolute", axis="0 0 1", xyz="0 0 0", rpy="0 0 0"):
    where = f'<origin xyz="{xyz}" rpy="{rpy}"/><parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{where}<axis xyz="{axis}"/>{inside}</joint>'


def robot(*parts, name="thing"):
    return f'<robot name="{name}">{"".join(parts)}</robot>'


def read(*parts):
    return urdf.parse(robot(*parts).encode(), "thing.urdf")


def mended(*parts):
    found = read(*parts)
    return found, mend(found)


def drake(text, folder=None):
    """The plant of a URDF's text, with geometry."""
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
    parser = Parser(plant)
    parser.SetStrictParsing()
    if folder is None:
        parser.AddModelsFromString(text, "urdf")
    else:
        parser.AddModels(str(folder))
    plant.Finalize()
    return plant, scene_graph, builder.Build()


def advance(diagram):
    """A step of physics: a mass matrix that is singular is found out."""
    from pydrake.systems.analysis import Simulator

    Simulator(diagram).AdvanceTo(0.005)


def text_of(found):
    import xml.etree.ElementTree as ET

    return ET.tostring(found.element, encoding="unicode")


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not XML: no element found (line 1, column 1)"),
        ("hello", "not XML: syntax error (line 1, column 1)"),
        ("<robot><link name='a'></robot>", "not XML: mismatched tag (line 1, column 25)"),
        ('<!DOCTYPE r [<!ENTITY a "aa">]><robot>&a;</robot>', "line 1: a document type (<!DOCTYPE ...>) is not read"),
        ("<a>" * 80 + "</a>" * 80, "line 1: more than 64 levels or 200000 elements"),
        ("<sdf/>", "its root element is <sdf>: an SDF model needs no import: name it in robot.yaml"),
        ("<mujoco/>", "its root element is <mujoco>: MJCF is not read: export the robot as URDF"),
        ("<robot/>", "no <link> in it"),
        (robot(link("a"), link("a")), "two links are named 'a'"),
        (robot(link("")), "a <link> has no name (number 1 of the file)"),
        (robot(link("a&#10;model: b")), r"a link's name must be of printable characters, got 'a\nmodel: b'"),
        (robot(link("a"), link("b")), "must be one tree, but 2 links hang on no joint: ['a', 'b']"),
        (robot(link("a"), joint("j", "a", "c")), "joint 'j': its child is no link of the file: 'c'"),
        (
            robot(link("a"), link("b"), joint("j", "a", "b"), joint("k", "a", "b")),
            "link 'b' hangs on two joints: 'j', 'k'",
        ),
        (
            robot(link("a"), link("b"), link("c"), joint("j", "b", "c"), joint("k", "c", "b")),
            "link 'b' hangs in a ring of joints",
        ),
        (robot(link("a"), link("b"), joint("j", "a", "b", kind="screw")), "joint 'j': type must be one of"),
        (
            robot('<xacro:include filename="arm.xacro"/>', link("a")),
            "'<xacro:include>' is xacro that is not expanded: xacro FILE.xacro > FILE.urdf does it",
        ),
        (
            robot(link("a"), link("b"), joint("${side}_j", "a", "b")),
            "'${side}_j' is xacro that is not expanded",
        ),
        (
            robot(link("a"), link("b"), joint("j", "a", "b", '<limit lower="1" upper="-1"/>')),
            "joint 'j': limit lower must be below upper, got 1 and -1",
        ),
        (
            robot(link("a"), link("b"), joint("j", "a", "b", '<limit lower="low" upper="1"/>')),
            "joint 'j': limit lower must be a finite number, got 'low'",
        ),
        (robot(link("a"), link("b"), joint("j", "a", "b", axis="0 0 0")), "joint 'j': axis xyz must not be 0"),
        (
            robot(link("a"), link("b"), joint("j", "a", "b", xyz="0 0 nan")),
            "joint 'j': origin xyz must be 3 finite numbers, got '0 0 nan'",
        ),
        (
            robot(link("a"), link("b"), joint("j", "a", "b", xyz="0 0 320")),
            "joint 'j': joint origin is 320 m away: lengths must be metres, these are millimetres",
        ),
        (
            robot(link("a", '<visual><geometry><box size="1 0 1"/></geometry></visual>')),
            "link 'a': box size must be > 0, got '1 0 1'",
        ),
        (
            robot(link("a", '<visual><geometry><box size="200 300 100"/></geometry></visual>')),
            "link 'a': box size must be metres, got 300",
        ),
        (robot(link("a", "<visual><geometry/></visual>")), "link 'a': visual geometry must be one of box"),
        (
            robot(link("a", '<inertial><mass value="heavy"/></inertial>')),
            "link 'a': mass value must be a finite number",
        ),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_by_name_and_place(text, says):
    with pytest.raises(ConfigError) as caught:
        urdf.parse(text.encode(), "thing.urdf")
    assert str(caught.value).startswith(f"thing.urdf: {says}") and "\n" not in str(caught.value)


def test_a_file_that_is_too_large_is_refused_before_it_is_parsed(tmp_path, monkeypatch):
    monkeypatch.setattr(xml_file, "MAX_BYTES", 100)
    (tmp_path / "a.urdf").write_text(robot(link("a")) + " " * 100)
    with pytest.raises(ConfigError, match="a.urdf: larger than 0.0001 MB"):
        urdf.read(tmp_path / "a.urdf")


def test_only_what_is_read_is_checked():
    read(link("a", MASS + '<collision_checking><origin xyz="?"/><capsule name="test"/></collision_checking>'))


def test_prefixes_that_nobody_declared_are_read():
    found, lines = mended("<gazebo><controller:imu><x:y/></controller:imu></gazebo>", link("a"))
    assert list(found.links) == ["a"] and lines == ["left out, as no part of the model: 1 <gazebo>"]


# ---------------------------------------------------------------- what is mended


TWO = (link("a"), link("b"), link("c"), joint("j", "a", "b", '<limit lower="0" upper="0.5" effort="9" velocity="1"/>'))


def follower(mimic, limits='<limit lower="0" upper="0.5" effort="9" velocity="1"/>'):
    return joint("k", "a", "c", f"{limits}<mimic {mimic}/>")


def test_a_mimic_against_its_own_limits_turns_the_way_that_fits_them():
    found, lines = mended(*TWO, follower('joint="j" multiplier="-1"'))
    assert found.joints["k"].mimic == ("j", 1.0, 0.0)
    assert lines == [
        "joint 'k': follows 'j' by -1, to -0.5 .. 0, against its own limits 0 .. 0.5: by 1, which fits them"
    ]


def test_a_mimic_that_no_sign_makes_fit_gets_the_limits_that_it_asks_for():
    found, lines = mended(*TWO, follower('joint="j" multiplier="2" offset="3"'))
    assert found.joints["k"].range == (3.0, 4.0) and found.joints["k"].mimic == ("j", 2.0, 3.0)
    assert lines == ["joint 'k': follows 'j' by 2, to 3 .. 4, against its own limits 0 .. 0.5: the limits are 3 .. 4"]


@pytest.mark.parametrize(
    ("mimic", "why"),
    [
        ('joint="nobody"', "there is no joint 'nobody'"),
        ('joint="k"', "'k' and 'k' follow each other"),
    ],
)
def test_a_mimic_that_follows_nothing_is_left_out(mimic, why):
    found, lines = mended(*TWO, follower(mimic))
    assert found.joints["k"].mimic is None and lines == [f"joint 'k': its mimic is left out: {why}"]


def test_a_mimic_that_fits_stays_as_it_is():
    found, lines = mended(*TWO, follower('joint="j"'))
    assert found.joints["k"].mimic == ("j", 1.0, 0.0) and lines == []
    plant, _, _ = drake(text_of(found))
    assert plant.num_constraints() == 1 and plant.num_actuators() == 1


@pytest.mark.parametrize(
    ("inertia", "moments"),
    [
        ('ixx="1" iyy="1" izz="5"', (2.5, 2.5, 5.0)),
        ('ixx="-1" iyy="1" izz="1"', None),
        ('ixx="1" iyy="1" izz="1" ixy="2"', None),
    ],
)
def test_an_inertia_of_no_body_becomes_the_nearest_of_a_body(inertia, moments):
    part = f'<inertial><mass value="2"/><inertia {inertia}/></inertial>'
    found, lines = mended(link("a"), link("b", part), joint("j", "a", "b"))
    assert len(lines) == 1 and "are of no body" in lines[0]
    plant, _, diagram = drake(text_of(found))
    J = plant.GetBodyByName("b").default_spatial_inertia()
    assert J.IsPhysicallyValid() and J.get_mass() == 2.0
    if moments:
        got = J.CalcRotationalInertia().CalcPrincipalMomentsOfInertia()
        assert np.allclose(sorted(got), moments, rtol=1e-3)
    advance(diagram)


@pytest.mark.parametrize(
    ("part", "says"),
    [
        ("", "link 'b': moves and has no mass: 10 g"),
        ('<inertial><mass value="1"/></inertial>', "link 'b': has mass but no inertia: that of a ball of 30 mm"),
        (
            '<inertial><mass value="0"/><inertia ixx="1" iyy="1" izz="1"/></inertial>',
            "link 'b': its mass is 0: it has no inertia either",
        ),
    ],
)
def test_a_link_without_mass_gets_the_least_that_moves(part, says):
    found, lines = mended(link("a"), link("b", part), joint("j", "a", "b"))
    assert lines[0].startswith(says)
    advance(drake(text_of(found))[2])


def test_a_frame_without_mass_stays_without():
    found, lines = mended(link("a"), link("tool", ""), joint("j", "a", "tool", "", "fixed"))
    assert lines == [] and found.links["tool"].find("inertial") is None


@pytest.mark.parametrize(
    ("kind", "inside", "says"),
    [
        ("continuous", '<limit lower="0" upper="0" effort="9" velocity="1"/>', "is continuous, so its limits 0 and 0"),
        ("revolute", '<limit lower="0" upper="0" effort="9" velocity="1"/>', "its limits are both 0: it is fixed"),
        ("revolute", "", "has no limits: it turns without end"),
        (
            "revolute",
            '<limit lower="0" upper="1" effort="-9" velocity="1"/>',
            "its effort limit is -9: without the sign",
        ),
        ("revolute", '<limit lower="0" upper="1" effort="9" velocity="-2"/>', "its velocity limit is -2: without"),
        ("revolute", '<limit lower="0" upper="1" effort="9" velocity="0"/>', "its velocity limit is 0: left out"),
        ("revolute", '<limit lower="0" upper="1" effort="9" velocity="inf"/>', "has no velocity limit"),
        ("revolute", LIMIT + '<dynamics damping="-1"/>', "its damping is -1: 0"),
        ("revolute", LIMIT + '<dynamics friction="3"/>', "its friction is left out: Drake's joints have none"),
    ],
)
def test_what_drake_ends_the_program_over_is_mended(kind, inside, says):
    found, lines = mended(link("a"), link("b"), joint("j", "a", "b", inside, kind))
    assert lines[0].startswith(f"joint 'j': {says}")
    plant, _, diagram = drake(text_of(found))
    for index in plant.GetJointIndices():
        q = plant.get_joint(index)
        assert np.all(q.position_lower_limits() <= q.position_upper_limits()) and np.all(q.velocity_upper_limits() > 0)
    advance(diagram)


def test_every_joint_with_an_effort_has_an_actuator_of_that_limit():
    limits = [20.0, 1000.0, 0.0]
    names = "bcd"
    parts = [link(x) for x in "abcd"]
    parts += [joint(f"j{x}", "a", x, LIMIT.replace("20", f"{limit:g}")) for x, limit in zip(names, limits)]
    found, lines = mended(*parts, '<transmission name="t"/>')
    plant, _, _ = drake(text_of(found))
    got = {
        plant.get_joint_actuator(i).name(): plant.get_joint_actuator(i).effort_limit()
        for i in plant.GetJointActuatorIndices()
    }
    assert got == {"jb": 20.0, "jc": 1000.0}
    assert "no effort limit, so no actuator: 'jd'" in lines


def test_a_world_is_no_part_of_the_robot():
    for kind, root in (("floating", "a"), ("fixed", "world_link")):
        found, lines = mended(link("world", ""), link("a"), joint("w", "world", "a", "", kind))
        assert found.root == root and len(lines) == 1
        plant, _, _ = drake(text_of(found))
        assert plant.num_positions() == 7, "it hangs on nothing"


def test_the_same_mend_of_many_is_one_line():
    parts = [link(x) for x in "abcdefghij"]
    parts += [joint(f"j{x}", "a", x, LIMIT + '<dynamics friction="1"/>') for x in "bcdefghij"]
    _, lines = mended(*parts)
    assert lines == ["joints 'jb', 'jc', 'jd', 'je', and 5 more: its friction is left out: Drake's joints have none"]


# ---------------------------------------------------------------- where files are found


def test_a_package_is_found_where_people_have_it(tmp_path, monkeypatch):
    for variable in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "GAZEBO_MODEL_PATH"):
        monkeypatch.delenv(variable, raising=False)

    def put(*folders, xml=""):
        folder = tmp_path.joinpath(*folders)
        (folder / "meshes").mkdir(parents=True)
        (folder / "meshes" / "a.stl").write_text("mine")
        if xml:
            (folder / "package.xml").write_text(f"<package><name>{xml}</name></package>")
        return folder / "meshes" / "a.stl"

    def found(name, beside=None):
        return packages.resolve(f"package://{name}/meshes/a.stl", beside, "here")

    above = put("checkout-of-mine", xml="my_arm")
    (tmp_path / "checkout-of-mine" / "urdf").mkdir()
    assert found("my_arm", tmp_path / "checkout-of-mine" / "urdf") == above, "by the name in package.xml"
    beside = put("src", "hand_description")
    (tmp_path / "src" / "arm_description" / "urdf").mkdir(parents=True)
    assert found("hand_description", tmp_path / "src" / "arm_description" / "urdf") == beside
    deep = put("ws", "stack", "folder", xml="deep")
    monkeypatch.setenv("ROS_PACKAGE_PATH", f"{tmp_path / 'nowhere'}:{tmp_path / 'ws'}")
    assert found("deep") == deep
    ament = put("install", "share", "ament_one")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    assert found("ament_one") == ament
    wheel = put("site-packages", "cmeel.prefix", "share", "some-robots")
    other = put("site-packages", "my_urdf")
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "site-packages")])
    assert found("some-robots") == wheel and found("my-urdf") == other
    assert packages.resolve("package:///my-urdf/meshes/a.stl", None, "here") == other
    assert packages.resolve("model://my_urdf/meshes/a.stl", None, "here") == other
    assert packages.resolve(f"file://{other}", None, "here") == other
    assert packages.resolve("../meshes/a.stl", above.parent.parent / "urdf", "here").samefile(above)


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("package://no_such_package/a.stl", "no package 'no_such_package' beside the file, in ROS_PACKAGE_PATH"),
        ("package://folder/b.stl", "package 'folder' has no file 'b.stl'"),
        ("b.stl", "no such file"),
        ("https://example.com/b.stl", "a file must be named by a path or package://, model:// or file://"),
        ("file:///b.stl", "no such file"),
    ],
)
def test_a_file_that_is_nowhere_is_named(tmp_path, url, says):
    (tmp_path / "folder").mkdir()
    with pytest.raises(ConfigError) as caught:
        packages.resolve(url, tmp_path / "folder", "arm.urdf: link 'a'")
    assert str(caught.value).startswith(f"arm.urdf: link 'a': {says}") and "\n" not in str(caught.value)


# ---------------------------------------------------------------- meshes

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = np.array(
    [
        [0, 2, 1],
        [1, 2, 3],
        [4, 5, 6],
        [5, 7, 6],
        [0, 1, 4],
        [1, 5, 4],
        [2, 6, 3],
        [3, 6, 7],
        [0, 4, 2],
        [2, 4, 6],
        [1, 3, 5],
        [3, 7, 5],
    ]
)
"""A box (1, 1, 1), its faces counterclockwise from outside: the sides -x, +x, -y, +y, -z, +z."""


def box(size=(0.2, 0.3, 0.4)):
    return (CORNERS - 0.5) * size


def stl_ascii(path, points=None, faces=FACES):
    points = box() if points is None else points
    lines = ["solid box"]
    for face in faces:
        lines += [
            "facet normal 0 0 0",
            "outer loop",
            *(f"vertex {x} {y} {z}" for x, y, z in points[face]),
            "endloop",
            "endfacet",
        ]
    path.write_text("\n".join([*lines, "endsolid box"]))


def stl_binary(path, points=None, faces=FACES):
    points = box() if points is None else points
    data = struct.pack("<80sI", b"binary", len(faces))
    for face in faces:
        data += struct.pack("<12fH", 0, 0, 0, *points[face].ravel(), 0)
    path.write_bytes(data)


def obj_plain(path, points=None, faces=FACES):
    points = box() if points is None else points
    rows = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces]
    path.write_text("\n".join(rows))


def dae(path, unit="1", points=None, color="0.8 0.1 0.2 1", head=""):
    points = box() if points is None else points
    floats = " ".join(str(x) for x in points.ravel())
    path.write_text(f"""<?xml version="1.0"?>{head}
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="{unit}"/><up_axis>Z_UP</up_axis></asset>
<library_effects><effect id="e"><profile_COMMON><technique sid="t">
<phong><diffuse><color>{color}</color></diffuse></phong></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="{points.size}">{floats}</float_array><technique_common>
<accessor source="#pa" count="{len(points)}" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles material="s" count="{len(FACES)}"><input semantic="VERTEX" source="#v" offset="0"/>
<p>{" ".join(map(str, FACES.ravel()))}</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="sc"><node><instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="s" target="#m"/></technique_common></bind_material></instance_geometry></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#sc"/></scene></COLLADA>""")


def glb(path, boxes, y_up=False, picture=b""):
    """boxes: (points, linear colour) each a mesh of its own. picture: a PNG, whose middle is the colour of each."""
    chunks, views, accessors, meshes, materials = b"", [], [], [], []
    for k, (points, color) in enumerate(boxes):
        points = points @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if y_up else points
        for data, target, kind, count, component in (
            (points.astype("<f4").tobytes(), 34962, "VEC3", len(points), 5126),
            (FACES.astype("<u2").tobytes(), 34963, "SCALAR", FACES.size, 5123),
        ):
            views.append({"buffer": 0, "byteOffset": len(chunks), "byteLength": len(data), "target": target})
            accessor = {"bufferView": len(views) - 1, "componentType": component, "count": count, "type": kind}
            if kind == "VEC3":
                accessor |= {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
            accessors.append(accessor)
            chunks += data + b"\0" * (-len(data) % 4)
        materials.append({"pbrMetallicRoughness": {"baseColorFactor": color}})
        step = 3 if picture else 2
        primitive = {"attributes": {"POSITION": step * k}, "indices": step * k + 1, "material": k}
        if picture:
            data = np.full((len(points), 2), 0.5, "<f4").tobytes()
            views.append({"buffer": 0, "byteOffset": len(chunks), "byteLength": len(data)})
            accessors.append(
                {"bufferView": len(views) - 1, "componentType": 5126, "count": len(points), "type": "VEC2"}
            )
            chunks += data
            primitive["attributes"]["TEXCOORD_0"] = step * k + 2
            materials[-1]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
        meshes.append({"primitives": [primitive]})
    images = {}
    if picture:
        views.append({"buffer": 0, "byteOffset": len(chunks), "byteLength": len(picture)})
        chunks += picture + b"\0" * (-len(picture) % 4)
        images = {"images": [{"bufferView": len(views) - 1, "mimeType": "image/png"}], "textures": [{"source": 0}]}
    tree = {
        **images,
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(boxes)))}],
        "nodes": [{"mesh": k} for k in range(len(boxes))],
        "meshes": meshes,
        "materials": materials,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(chunks)}],
    }
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    parts = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(chunks), 0x004E4942) + chunks
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(parts)) + parts)


def mesh_link(file, scale="", collision="", extra=""):
    scale = f' scale="{scale}"' if scale else ""
    mesh = f'<visual><geometry><mesh filename="{file}"{scale}/></geometry>{extra}</visual>'
    if collision:
        mesh += f'<collision><geometry><mesh filename="{collision}"{scale}/></geometry></collision>'
    return link("a", MASS + mesh)


def imported(tmp_path, *parts, out="out", arguments=()):
    (tmp_path / "thing.urdf").write_text(robot(*parts))
    code = cli.main(["import-robot", str(tmp_path / "thing.urdf"), "-o", str(tmp_path / out), *arguments])
    return code, tmp_path / out


def obj_of(folder, name):
    from valve_drake.stations.render_egl import read_obj

    return read_obj(str(folder / "meshes" / name), 0.0)


@needs_trimesh
@pytest.mark.parametrize("kind", ["stl_ascii", "stl_binary", "obj_plain", "dae", "glb", "STL upper case", "inside out"])
def test_every_kind_of_mesh_becomes_an_obj_with_flat_sides_and_sharp_edges(tmp_path, kind):
    suffix = {"stl_ascii": "stl", "stl_binary": "stl", "obj_plain": "obj", "STL upper case": "STL", "inside out": "stl"}
    file = tmp_path / f"part.{suffix.get(kind, kind)}"
    match kind:
        case "dae":
            dae(file)
        case "glb":
            glb(file, [(box(), [0.5, 0.5, 0.5, 1.0])])
        case "inside out":
            stl_binary(file, faces=FACES[:, ::-1])
        case "obj_plain":
            obj_plain(file)
        case "stl_ascii":
            stl_ascii(file)
        case _:
            stl_binary(file)
    code, folder = imported(tmp_path, mesh_link(file.name))
    assert code == 0
    P, N, _, order = obj_of(folder, "part.obj")
    assert np.allclose(P.min(axis=0), [-0.1, -0.15, -0.2]) and np.allclose(P.max(axis=0), [0.1, 0.15, 0.2])
    P, N = P[order].reshape(-1, 3, 3), N[order].reshape(-1, 3, 3)
    outward = np.cross(P[:, 1] - P[:, 0], P[:, 2] - P[:, 0])
    assert len(P) == 12 and np.all(np.einsum("ij,ij->i", outward, P.mean(axis=1)) > 0), "from outside"
    flat = outward / np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.allclose(N, flat[:, None], atol=1e-3), "a box has no smooth edges"


@needs_trimesh
def test_round_things_are_smooth(tmp_path):
    angle = np.linspace(0, 2 * np.pi, 33)[:-1]
    ring = np.stack([0.1 * np.cos(angle), 0.1 * np.sin(angle)], axis=1)
    points = np.concatenate([np.c_[ring, np.full(32, z)] for z in (0.0, 0.2)])
    faces = [[k, (k + 1) % 32, 32 + k] for k in range(32)] + [
        [(k + 1) % 32, 32 + (k + 1) % 32, 32 + k] for k in range(32)
    ]
    stl_binary(tmp_path / "tube.stl", points, np.array(faces))
    code, folder = imported(tmp_path, mesh_link("tube.stl"))
    P, N, _, _ = obj_of(folder, "tube.obj")
    radial = P * [1, 1, 0] / 0.1
    assert code == 0 and np.allclose(N, radial, atol=0.1) and np.abs(N - radial).max() < 0.1


@needs_trimesh
def test_units_scales_and_mirrors_are_in_the_mesh(tmp_path):
    dae(tmp_path / "mm.dae", unit="0.001", points=box() * 1000)
    stl_binary(tmp_path / "big.stl", box() * 1000)
    stl_binary(tmp_path / "one.stl", box() + [0.5, 0, 0])
    parts = [
        mesh_link("mm.dae"),
        link("b", mesh_link("big.stl", "0.001 0.001 0.001").split(">", 1)[1].rsplit("<", 1)[0]),
        link("c", mesh_link("one.stl", "-1 1 1").split(">", 1)[1].rsplit("<", 1)[0]),
        joint("j", "a", "b", "", "fixed"),
        joint("k", "a", "c", "", "fixed"),
    ]
    code, folder = imported(tmp_path, *parts)
    assert code == 0
    for name in ("mm.obj", "big.obj"):
        assert np.allclose(np.ptp(obj_of(folder, name)[0], axis=0), [0.2, 0.3, 0.4])
    P, N, _, order = obj_of(folder, "one.obj")
    assert np.isclose(P[:, 0].mean(), -0.5)
    assert np.all(np.einsum("ij,ij->i", N, P - [-0.5, 0, 0]) > 0), "the right side is still out"
    assert "scale" not in (folder / "thing.urdf").read_text()


@needs_trimesh
def test_colours_stay_one_a_visual(tmp_path):
    white, red = [1.0, 1.0, 1.0, 1.0], [0.2140411, 0.0, 0.0, 1.0]
    glb(tmp_path / "two.glb", [(box(), white), (box() + [0.5, 0, 0], red)])
    stl_binary(tmp_path / "bare.stl")
    dae(tmp_path / "painted.dae", color="0.25 0.5 0.75 1")
    paint = '<material name="Mine"><color rgba="0.1 0.2 0.3 1"/></material>'
    inner = "".join(
        f'<visual><geometry><mesh filename="{file}"/></geometry>{paint}</visual>'
        for file in ("two.glb", "bare.stl", "painted.dae")
    )
    code, folder = imported(tmp_path, link("a", MASS + inner + f"<visual>{BOX}{paint}</visual><visual>{BOX}</visual>"))
    assert code == 0
    plant, scene_graph, _ = drake("", folder / "thing.urdf")
    inspector = scene_graph.model_inspector()
    body = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName("a").index())
    from pydrake.geometry import Mesh, Role

    got = []
    for geometry in inspector.GetGeometries(body, Role.kPerception):
        shape = inspector.GetShape(geometry)
        color = inspector.GetPerceptionProperties(geometry).GetProperty("phong", "diffuse")
        name = Path(shape.source().path()).stem if isinstance(shape, Mesh) else "box"
        got.append((name, tuple(round(v, 3) for v in (color.r(), color.g(), color.b()))))
    assert sorted(got) == [
        ("bare", (0.1, 0.2, 0.3)),
        ("box", (0.1, 0.2, 0.3)),
        ("box", (0.7, 0.7, 0.7)),
        ("painted", (0.251, 0.502, 0.749)),  # the mesh's own colour, in steps of 1/255
        ("two_1", (1.0, 1.0, 1.0)),
        ("two_2", (0.502, 0.0, 0.0)),  # linear 0.214, as a screen shows it
    ]


@needs_trimesh
def test_a_picture_on_a_mesh_is_one_colour_and_needs_its_reader(tmp_path, capsys, monkeypatch):
    import cv2

    picture = np.full((4, 4, 3), (20, 40, 200), np.uint8)  # BGR
    png = cv2.imencode(".png", picture)[1].tobytes()
    glb(tmp_path / "a.glb", [(box(), [1.0, 1.0, 1.0, 1.0])], picture=png)
    with monkeypatch.context() as context:
        context.setitem(sys.modules, "PIL", None)
        context.setitem(sys.modules, "PIL.Image", None)
        assert imported(tmp_path, mesh_link("a.glb"))[0] == 2
        assert "link 'a': PIL is missing, which reads the pictures of 'a.glb'" in capsys.readouterr().err
    pytest.importorskip("PIL.Image", exc_type=ImportError)
    code, folder = imported(tmp_path, mesh_link("a.glb"))
    assert code == 0 and 'rgba="0.784 0.157 0.078 1"' in (folder / "thing.urdf").read_text()
    assert "note: mesh a.glb: its picture (texture) is one colour, the mean" in capsys.readouterr().out


@needs_trimesh
@pytest.mark.parametrize("y_up", [False, True])
def test_a_glb_lies_as_the_collision_shape_does(tmp_path, y_up, capsys):
    glb(tmp_path / "arm.glb", [(box(), [1.0, 1.0, 1.0, 1.0])], y_up)
    stl_binary(tmp_path / "solid.stl")
    code, folder = imported(tmp_path, mesh_link("arm.glb", collision="solid.stl"))
    assert code == 0 and np.allclose(np.ptp(obj_of(folder, "arm.obj")[0], axis=0), [0.2, 0.3, 0.4])
    assert ("turned from y up" in capsys.readouterr().out) == y_up


@needs_trimesh
def test_a_collision_mesh_becomes_its_hull(tmp_path):
    inner = np.concatenate([box(), box() * 0.3])
    stl_binary(tmp_path / "solid.stl", inner, np.concatenate([FACES, FACES + 8]))
    sheet = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * 0.2
    stl_binary(tmp_path / "sheet.stl", sheet, np.array([[0, 1, 2], [0, 2, 3]]))
    flat = '<collision><geometry><mesh filename="sheet.stl"/></geometry></collision>'
    code, folder = imported(
        tmp_path, mesh_link("solid.stl", collision="solid.stl"), link("b", MASS + flat), joint("j", "a", "b")
    )
    text = (folder / "meshes" / "solid_hull.obj").read_text()
    assert code == 0 and text.count("\nv ") == 8 and text.count("\nf ") == 6
    plant, scene_graph, diagram = drake("", folder / "thing.urdf")
    from pydrake.geometry import Convex, Role

    inspector = scene_graph.model_inspector()
    shapes = [inspector.GetShape(g) for g in inspector.GetAllGeometryIds(Role.kProximity)]
    assert len(shapes) == 2 and all(isinstance(shape, Convex) for shape in shapes)
    advance(diagram)


@needs_trimesh
@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda p: None, "thing.urdf: link 'a': no such file"),
        (
            lambda p: stl_binary(p / "a.stl", box() * 1000),
            "link 'a': mesh 'a.stl' is 400 m long: its lengths must be metres",
        ),
        (lambda p: (p / "a.stl").write_bytes(b"solid nothing at all"), "thing.urdf: link 'a'"),
        (lambda p: (p / "a.stl").write_bytes(b""), "thing.urdf: link 'a'"),
        (lambda p: (p / "a.stl").write_bytes(b"\xff" * 90), "thing.urdf: link 'a'"),
        (lambda p: (p / "a.stl").write_bytes(struct.pack("<80sI", b"", 4_000_000_000)), "thing.urdf: link 'a'"),
        (lambda p: (p / "a.stl").mkdir(), "thing.urdf: link 'a': no such file"),
        (lambda p: stl_binary(p / "a.stl", box() * np.nan), "thing.urdf: link 'a'"),
    ],
)
def test_a_mesh_that_cannot_be_used_is_named_with_its_link(tmp_path, capsys, make, says):
    make(tmp_path)
    code, folder = imported(tmp_path, mesh_link("a.stl"))
    err = capsys.readouterr().err
    assert code == 2 and says in err and err.count("\n") == 1 and not folder.exists()


@needs_trimesh
def test_all_meshes_that_are_missing_are_named_in_one_line(tmp_path, capsys):
    parts = [link(name, mesh_link(f"{name}.stl").split(">", 1)[1].rsplit("<", 1)[0]) for name in "abcdefg"]
    joints = [joint(f"j{name}", "a", name, kind="fixed") for name in "bcdefg"]
    stl_binary(tmp_path / "c.stl", box())
    code, _ = imported(tmp_path, *parts, *joints)
    err = capsys.readouterr().err
    assert code == 2 and err.count("\n") == 1 and "link 'a': no such file" in err
    assert "and 5 more: b.stl, d.stl, e.stl, f.stl, ..." in err


@needs_trimesh
def test_a_package_that_was_renamed_is_the_folder_that_has_its_files(tmp_path, capsys):
    (tmp_path / "arm_fork" / "meshes").mkdir(parents=True)
    (tmp_path / "arm_fork" / "urdf").mkdir()
    stl_binary(tmp_path / "arm_fork" / "meshes" / "a.stl", box())
    model = tmp_path / "arm_fork" / "urdf" / "arm.urdf"
    for package, code in (("arm_of_theirs", 0), ("urdf", 2)):  # the second is there, and lacks the file
        model.write_text(robot(mesh_link(f"package://{package}/meshes/a.stl")))
        assert cli.main(["import-robot", str(model), "-o", str(tmp_path / package)]) == code
    out, err = capsys.readouterr()
    assert "note: package 'arm_of_theirs' is nowhere: its files are taken from 'arm_fork', which has them" in out
    assert "package 'urdf' has no file 'meshes/a.stl'" in err


@needs_trimesh
def test_a_dae_with_entities_is_not_read(tmp_path, capsys):
    dae(tmp_path / "a.dae", head='<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>')
    assert imported(tmp_path, mesh_link("a.dae"))[0] == 2
    assert "a DAE with a document type, or not in UTF-8, is not read" in capsys.readouterr().err


@needs_trimesh
def test_a_dae_whose_material_is_broken_keeps_its_shape(tmp_path, capsys):
    dae(tmp_path / "a.dae")
    text = (tmp_path / "a.dae").read_text()
    (tmp_path / "a.dae").write_text(text.replace('<instance_effect url="#e"/>', '<instance_effect url="#nothing"/>'))
    paint = '<material name="Mine"><color rgba="0.1 0.2 0.3 1"/></material>'
    code, folder = imported(tmp_path, mesh_link("a.dae", extra=paint))
    assert code == 0 and len(obj_of(folder, "a.obj")[3]) == 36
    assert "note: mesh a.dae: its materials are broken" in capsys.readouterr().out
    assert 'name="Mine"' in (folder / "thing.urdf").read_text()


def test_without_the_mesh_reader_the_line_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    monkeypatch.setitem(sys.modules, "collada", None)
    stl_binary(tmp_path / "a.stl")
    assert imported(tmp_path, mesh_link("a.stl"))[0] == 2
    assert capsys.readouterr().err.endswith("is missing, which reads meshes: pip install 'valve-drake[robots]'\n")
    assert imported(tmp_path, link("a", MASS + f"<visual>{BOX}</visual>"))[0] == 0, "shapes need no reader"


# ---------------------------------------------------------------- the folder


def test_nothing_that_exists_is_overwritten_unasked(tmp_path, capsys):
    parts = link("a", MASS + f"<visual>{BOX}</visual>")
    code, folder = imported(tmp_path, parts)
    assert code == 0
    (folder / "robot.yaml").write_text("mine")
    code, _ = imported(tmp_path, parts)
    assert code == 0 and (folder / "robot.yaml").read_text() == "mine", (
        "the model is made again, robot.yaml is the user's"
    )
    assert "robot.yaml exists and is left as it is (--overwrite replaces it)" in capsys.readouterr().out
    (folder / "thing.urdf").write_text("mine")
    code, _ = imported(tmp_path, parts)
    assert code == 2 and (folder / "thing.urdf").read_text() == "mine"
    assert "-o must be a file that does not exist yet (--overwrite replaces it)" in capsys.readouterr().err
    code, _ = imported(tmp_path, parts, arguments=["--overwrite"])
    assert code == 0 and (folder / "robot.yaml").read_text().startswith("# Draft")
    assert imported(tmp_path, parts, out=".", arguments=["--overwrite"])[0] == 2, "never over what it reads"
    assert (tmp_path / "thing.urdf").read_text() == robot(parts)


def test_the_licence_goes_with_the_model_or_its_lack_is_said(tmp_path, capsys):
    parts = link("a", MASS + f"<visual>{BOX}</visual>")
    (tmp_path / "package.xml").write_text("<package><name>thing</name></package>")
    assert imported(tmp_path, parts)[0] == 0
    assert "no licence was found beside the model" in capsys.readouterr().out
    (tmp_path / "LICENSE").write_text("Do what you like.")
    code, folder = imported(tmp_path, parts, out="other")
    assert code == 0 and (folder / "LICENSE").read_text() == "Do what you like."


def test_a_robot_that_hangs_above_its_floor_gets_a_footprint(tmp_path):
    code, folder = imported(tmp_path, link("torso", MASS + f'<visual><origin xyz="0 0 -0.8"/>{BOX}</visual>'))
    found = urdf.read(folder / "thing.urdf")
    assert code == 0 and found.root == "base_footprint"
    assert np.allclose(found.poses()["torso"][:3, 3], [0, 0, 0.9])


def test_the_report_is_one_object_for_programs(tmp_path, capsys):
    code, folder = imported(tmp_path, link("a", MASS + f"<visual>{BOX}</visual>"), arguments=["--json"])
    report = json.loads(capsys.readouterr().out)
    assert code == 0 and report["robot"] == "thing" and report["urdf"] == str(folder / "thing.urdf")
    assert set(report) >= {"files", "mended", "notes", "todo", "links", "joints", "meshes", "mesh_bytes", "seconds"}


def test_the_picture_shows_the_robot_and_is_overwritten_only_if_asked(tmp_path, capsys):
    import cv2

    paint = '<material name="Mine"><color rgba="0.9 0.1 0.1 1"/></material>'
    parts, picture = link("a", MASS + f"<visual>{BOX}{paint}</visual>"), tmp_path / "a.png"
    code, folder = imported(tmp_path, parts, arguments=["--picture", str(picture)])
    image = cv2.imread(str(picture)).astype(float)
    assert code == 0 and image.shape == (600, 960, 3)
    red = (image[:, :, 2] > 2 * image[:, :, 1]) & (image[:, :, 2] > 60)
    for half in (red[:, :480], red[:, 480:]):
        assert 0.05 < half.mean() < 0.6, "the box fills a good part of each view"
    before = picture.read_bytes()
    assert imported(tmp_path, parts, arguments=["--picture", str(picture)])[0] == 2
    assert "--picture must be a file that does not exist yet" in capsys.readouterr().err
    assert picture.read_bytes() == before
    urdf_of = str(tmp_path / "thing.urdf")
    assert imported(tmp_path, parts, arguments=["--overwrite", "--picture", urdf_of])[0] == 2, "never over the model"


# ---------------------------------------------------------------- the draft


def two_arms(count=5, left="left", right="right", gripper="{0}_gripper"):
    """A base with a lift, a head, and two arms of `count` joints with a gripper of two sliding fingers."""
    geometry = f"<collision>{BOX}</collision>"
    limit = '<limit lower="-2" upper="2" effort="30" velocity="2"/>'
    parts = [
        link("base_link", MASS + f'<collision><origin xyz="0 0 0.1"/>{BOX}</collision>'),
        link("torso"),
        link("pan"),
        link("head"),
    ]
    parts += [
        joint(
            "lift_joint",
            "base_link",
            "torso",
            '<limit lower="0" upper="0.4" effort="900" velocity="0.05"/>',
            "prismatic",
        )
    ]
    parts += [joint("head_pan_joint", "torso", "pan", limit, xyz="0 0 0.6")]
    parts += [joint("head_tilt_joint", "pan", "head", limit, axis="0 1 0")]
    for side in (left, right):
        eye = f"{side}_eye_optical_frame"
        parts += [link(eye, ""), joint(f"{side}_eye_joint", "head", eye, "", "fixed", rpy="-1.5708 0 -1.5708")]
        parent = "torso"
        for k in range(count):
            name = f"{side}_arm_{k + 1}"
            axis = ("0 0 1", "0 1 0", "1 0 0")[k % 3]
            parts += [
                link(name),
                joint(
                    f"{name}_joint",
                    parent,
                    name,
                    limit,
                    axis=axis,
                    xyz=f"0.2 {0.2 * (1 if side == left else -1) * (k == 0)} 0",
                ),
            ]
            parent = name
        palm = gripper.format(side)
        parts += [
            link(palm, MASS + geometry),
            joint(f"{side}_ft_sensor_joint", parent, palm, "", "fixed", xyz="0.1 0 0"),
        ]
        for k, sign in ((1, 1), (2, -1)):
            finger = f"{palm}_finger_{k}"
            shape = '<collision><origin xyz="0.02 0 0"/><geometry><box size="0.04 0.01 0.02"/></geometry></collision>'
            follows = f'<mimic joint="{palm}_finger_1_joint"/>' if k == 2 else ""
            slide = f'<limit lower="0" upper="0.045" effort="60" velocity="0.1"/>{follows}'
            parts += [link(finger, MASS + shape)]
            parts += [
                joint(f"{finger}_joint", palm, finger, slide, "prismatic", f"0 {sign} 0", xyz=f"0.08 {sign * 0.006} 0")
            ]
    return parts


def test_the_draft_knows_arms_grippers_head_and_lift(tmp_path):
    code, folder = imported(tmp_path, *two_arms())
    tree = yaml_file.read(folder / "robot.yaml")
    assert code == 0 and tree["model"] == "thing.urdf"
    for side in ("left", "right"):
        arm = tree["arms"][side]
        assert arm["joints"] == [f"{side}_arm_{k}_joint" for k in range(1, 6)]
        assert len(arm["home"]) == len(arm["work"]) == len(arm["stiffness"]) == 5
        assert arm["sensor"] == f"{side}_ft_sensor_joint"
        gripper = tree["grippers"][side]
        assert gripper["joint"] == f"{side}_gripper_finger_1_joint"
        assert gripper["pads"] == [f"{side}_gripper_finger_1", f"{side}_gripper_finger_2"]
        grip = tree["frames"][f"{side}_grip"]
        assert grip["link"] == f"{side}_gripper" and np.allclose(grip["xyz"], [0.1, 0, 0])
        R = urdf.rotation(np.array(grip["rpy"]))
        assert np.allclose(R[:, 2], [1, 0, 0], atol=1e-3) and np.allclose(np.abs(R[:, 1]), [0, 1, 0], atol=1e-3)
    assert tree["opening"] == 0.085 and "of 0.092" in (folder / "robot.yaml").read_text(), "what a run uses of it"
    assert np.allclose(tree["pad"]["at"], [0.02, -0.005, 0]) and np.allclose(tree["pad"]["size"], [0.01, 0.016])
    assert tree["lift"] == {"joints": ["lift_joint"], "home": [0.2], "speed": [0.05]}
    assert tree["gaze"]["pan"] == "head_pan_joint" and tree["gaze"]["tilt"] == "head_tilt_joint"
    assert tree["cameras"]["head_left"] == "left_eye_optical_frame"
    assert tree["base"]["frame"] == "base_link" and tree["base"]["drive"] == "fixed"
    assert len(tree["arm_speed"]) == 5 and "weld" not in tree


def test_the_draft_of_an_arm_without_a_fixed_joint_states_how_well_its_torques_are_read(tmp_path):
    turns = '<axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="20" velocity="2"/></joint>'
    parts = [
        part.replace('type="fixed"', 'type="revolute"').replace("</joint>", turns) if "ft_sensor" in part else part
        for part in two_arms(6)
    ]
    code, folder = imported(tmp_path, *parts)
    arm = yaml_file.read(folder / "robot.yaml")["arms"]["left"]
    assert code == 0 and arm["sensor"] == "torque" and len(arm["torque_noise"]) == len(arm["joints"]) == 7
    assert arm["torque_noise"][-1] == 0.1 and "TODO arms.*.torque_noise" in (folder / "robot.yaml").read_text()


def test_a_camera_that_looks_along_x_gets_a_frame_that_looks_along_z(tmp_path):
    straight = [part.replace('rpy="-1.5708 0 -1.5708"', 'rpy="0 0 0"') for part in two_arms()]
    code, folder = imported(tmp_path, *(part.replace("eye_optical_frame", "eye_link") for part in straight))
    tree = yaml_file.read(folder / "robot.yaml")
    assert code == 0 and tree["cameras"]["head_left"] == "head_left_camera"
    frame = tree["frames"]["head_left_camera"]
    R = urdf.rotation(np.array(frame["rpy"]))
    assert frame["link"] == "left_eye_link" and np.allclose(R, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-4)


def test_the_draft_of_a_whole_robot_is_a_robot(tmp_path):
    from valve_drake.robot.robot import Robot

    wheels = [
        part for k in "ab" for part in (link(f"wheel_{k}"), joint(f"w{k}", "base_link", f"wheel_{k}", kind="fixed"))
    ]
    code, folder = imported(tmp_path, *two_arms(7), *wheels)
    assert yaml_file.read(folder / "robot.yaml")["base"]["drive"] == "differential"
    found = Robot.load(folder / "robot.yaml")
    assert code == 0 and len(found.arms["left"].names) == 7
    assert found.grippers["left"].openings.max() > 0.09


@pytest.mark.parametrize(
    ("left", "right"), [("l", "r"), ("L", "R"), ("LShoulder", "RShoulder"), ("Left", "Right"), ("LEFT", "RIGHT")]
)
def test_the_sides_are_told_by_any_usual_name(left, right):
    found = read(*two_arms(7, left, right))
    mend(found)
    guess = drafting.guess(found, {}, {}, {}, [])
    assert guess.arms["left"][0] == f"{left}_arm_1_joint" and len(guess.arms["right"]) == 7
    assert guess.second_eye == f"{right}_eye_optical_frame"


def renumbered(part):
    """Links and joints that count on from the left arm to the right one: the names are no mirror images."""
    return re.sub(
        r"(left|right)_arm_(\d)", lambda m: f"idx{m[2] if m[1] == 'left' else int(m[2]) + 10}_{m[1][0]}_arm", part
    )


@pytest.mark.parametrize(
    "parts",
    [two_arms(7, "one", "two"), two_arms(7, "arm_b", "arm_a"), [renumbered(part) for part in two_arms(7)]],
    ids=["no sides", "other letters", "numbers that run on"],
)
def test_arms_whose_names_do_not_tell_their_side_are_told_by_their_place(parts):
    found = read(*parts)
    mend(found)
    guess = drafting.guess(found, {}, {}, {}, [])
    shoulders = [found.poses()[found.joints[guess.arms[side][0]].child][1, 3] for side in ("left", "right")]
    assert shoulders == [0.2, -0.2] and [len(arm) for arm in guess.arms.values()] == [7, 7]
    assert guess.by_place and guess.pan == "head_pan_joint"


def test_of_four_arms_those_in_front_are_taken():
    behind = [part.replace("left_", "rear_l_").replace("right_", "rear_r_") for part in two_arms(6)]
    behind = [part.replace('xyz="0.2 0.2 0"', 'xyz="-0.3 0.2 0"').replace('xyz="0.2 -0.2 0"', 'xyz="-0.3 -0.2 0"')
              for part in behind if "rear_" in part]  # fmt: skip
    front = [part.replace("left_", "fl_").replace("right_", "fr_") for part in two_arms(6)]
    found = read(*front, *(part.replace("_l_", "_x_").replace("_r_", "_y_") for part in behind))
    mend(found)
    assert drafting.find_arms(found)["left"][0] == "fl_arm_1_joint"


def test_arms_of_different_numbers_of_joints_keep_all_of_theirs(tmp_path):
    limit = '<axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="20" velocity="1"/></joint>'
    parts = [
        part.replace('type="fixed"', 'type="revolute"').replace("</joint>", limit) if "left_ft_sensor_joint" in part
        else part for part in two_arms(6)
    ]  # fmt: skip
    code, folder = imported(tmp_path, *parts)
    arms = yaml_file.read(folder / "robot.yaml")["arms"]
    assert code == 0 and [len(arms[side]["joints"]) for side in ("left", "right")] == [7, 6]
    assert [len(arms[side]["speed"]) for side in ("left", "right")] == [7, 6] and arms["left"]["speed"][-1] == 0.6
    from valve_drake.robot.robot import Robot

    assert len(Robot.load(folder / "robot.yaml").arms["left"]) == 7


def each_finger_driven(parts):
    return [re.sub(r"<mimic [^>]*/>", "", part) for part in parts]


def test_fingers_that_both_have_a_motor_and_mirror_each_other_move_together(tmp_path, capsys):
    code, folder = imported(tmp_path, *each_finger_driven(two_arms(6)))
    says = "joint 'left_gripper_finger_2_joint': follows 'left_gripper_finger_1_joint' by 1: its finger is"
    assert code == 0 and says in capsys.readouterr().out
    text = (folder / "thing.urdf").read_text()
    assert text.count("<mimic") == 2 and text.count("finger_2_joint_transmission") == 0
    tree = yaml_file.read(folder / "robot.yaml")
    assert tree["grippers"]["left"]["joint"] == "left_gripper_finger_1_joint" and "weld" not in tree
    from valve_drake.robot.robot import Robot

    assert Robot.load(folder / "robot.yaml").grippers["left"].openings.max() > 0.09


@pytest.mark.parametrize(
    ("old", "new"),
    [('axis xyz="0 -1 0"', 'axis xyz="0 1 0"'), ('upper="0.045" effort="60"', 'upper="0.02" effort="60"')],
    ids=["both to one side", "one goes farther"],
)
def test_fingers_that_do_not_mirror_each_other_are_left_alone(old, new):
    parts = [part.replace(old, new) if "finger_2_joint" in part else part for part in each_finger_driven(two_arms(6))]
    found = read(*parts)
    mend(found)
    assert drafting.couple_fingers(found) == []


def test_a_crooked_finger_holds_with_its_end(tmp_path):
    """Its root reaches beyond the middle, under the other finger's: that is not what grips."""
    root = '<collision><origin xyz="-0.05 {0} 0"/><geometry><box size="0.02 0.08 0.02"/></geometry></collision></link>'
    parts = [
        part.replace("</link>", root.format(-0.03 if "finger_1" in part else 0.03))
        if part.startswith("<link") and "_finger_" in part else part for part in two_arms(6)
    ]  # fmt: skip
    code, folder = imported(tmp_path, *parts)
    tree = yaml_file.read(folder / "robot.yaml")
    assert code == 0 and tree["opening"] == 0.085 and "of 0.092" in (folder / "robot.yaml").read_text()
    assert np.allclose(tree["pad"]["at"], [0.02, -0.005, 0]) and np.allclose(tree["frames"]["left_grip"]["xyz"][1], 0)


def test_a_head_is_told_by_its_joints_names_or_by_where_it_is():
    plain = [re.sub(r"name=\"head\"|link=\"head\"", lambda m: m[0].replace("head", "h2"), part) for part in two_arms(6)]
    blind = [part for part in plain if "eye" not in part]
    nameless = [part.replace("head_pan_joint", "joint_h_1").replace("head_tilt_joint", "joint_h_2") for part in blind]
    for parts, names in ((blind, ("head_pan_joint", "head_tilt_joint")), (nameless, ("joint_h_1", "joint_h_2"))):
        found = read(*parts)
        mend(found)
        guess = drafting.guess(found, {}, {}, {}, [])
        assert (guess.pan, guess.tilt) == names and guess.eye is not None and guess.eye[0] == "h2"


def test_a_robot_without_cameras_gets_a_place_for_an_eye_and_hands_that_need_none(tmp_path):
    from valve_drake.robot.robot import Robot

    code, folder = imported(tmp_path, *(part for part in two_arms(6) if "eye" not in part))
    tree = yaml_file.read(folder / "robot.yaml")
    assert code == 0 and tree["cameras"] == {"head_left": "left_eye"} and tree["servo"] == "none"
    assert tree["frames"]["left_eye"]["link"] == "head"
    eye = Robot.load(folder / "robot.yaml").X_BL(np.array([0.2, 0, 0]))
    assert np.allclose(eye[:, 2], [1, 0, 0], atol=1e-3) and np.allclose(eye[:, 0], [0, -1, 0], atol=1e-3)


def test_joints_below_both_arms_are_named_as_candidates_of_a_lift(tmp_path):
    parts = [part.replace('type="prismatic"', 'type="revolute"').replace('axis xyz="0 0 1"', 'axis xyz="0 1 0"')
             if "lift_joint" in part else part for part in two_arms(6)]  # fmt: skip
    code, folder = imported(tmp_path, *parts)
    assert code == 0 and yaml_file.read(folder / "robot.yaml")["weld"] == ["lift_joint"]
    assert "# TODO lift: lift_joint: below both arms" in (folder / "robot.yaml").read_text()


def test_a_draft_has_no_value_that_a_robot_yaml_may_not_have(tmp_path):
    """Hands without fingers, a base without shapes: what is not told is asked for and not written as zero."""
    from valve_drake.robot import description

    bare = [part for part in two_arms(4) if "finger" not in part]
    bare[0] = link("base_link", MASS)
    code, folder = imported(tmp_path, *bare)
    text = (folder / "robot.yaml").read_text()
    for asked in ("base.footprint:", "grippers.left: no moving", "opening:", "arms.left.joints: a run needs 5 joints"):
        assert f"# TODO {asked}" in text or f" TODO {asked}" in text
    with pytest.raises(ConfigError, match="arms.left.joints must be 5 to 10 joints"):
        description.load(folder / "robot.yaml")
    assert code == 0 and "opening" not in yaml_file.parse(text, "robot.yaml")


def test_legs_are_no_arms_and_a_wrist_may_be_named_after_its_gripper():
    renamed = [part.replace("_arm_5", "_gripper_yaw") for part in two_arms(5)]
    legs = [part.replace("_arm_", "_knee_") for part in two_arms(7) if "_arm_" in part and "ft_sensor" not in part]
    found = read(*renamed, *legs)
    mend(found)
    arms = drafting.find_arms(found)
    assert arms["left"] == [*(f"left_arm_{k}_joint" for k in range(1, 5)), "left_gripper_yaw_joint"]


def test_the_draft_says_what_it_cannot_know(tmp_path, capsys):
    code, folder = imported(tmp_path, link("base", MASS + f"<visual>{BOX}</visual>"))
    text = (folder / "robot.yaml").read_text()
    assert code == 0 and "TODO arms: no two chains of 4 joints" in text and "TODO gaze" in text
    assert "to do in robot.yaml: arms: no two chains of 4 joints" in capsys.readouterr().out
    assert "arms" not in yaml_file.parse(text, "robot.yaml")


def test_colours_of_the_marks_are_painted_over(tmp_path):
    inner = "".join(
        f'<visual>{BOX}<material name="{name}"><color rgba="{rgba}"/></material></visual>'
        for name, rgba in (
            ("Tip", "0 0.8 0 1"),
            ("Lamp", "0.8 0 0 1"),
            ("Shell", "0.8 0.8 0.8 1"),
            ("Sky", "0 0 0.8 1"),
        )
    )
    _, folder = imported(tmp_path, link("a", MASS + inner))
    assert set(yaml_file.read(folder / "robot.yaml")["colors"]) == {"Tip", "Lamp"}


# ---------------------------------------------------------------- real robots


def test_the_pr2_stands_on_its_footprint_and_obeys_its_limits():
    from valve_drake import resources

    folder = resources.models() / "pr2"
    found = urdf.read(folder / "pr2.urdf")
    assert found.root == "base_footprint" and sum(f.stat().st_size for f in (folder / "meshes").iterdir()) < 1_000_000
    poses, lowest = found.poses(), []
    for name, element in found.links.items():
        for visual in element.findall("visual"):
            mesh = visual.find("geometry/mesh")
            if mesh is not None:
                X = poses[name] @ urdf.pose(visual)
                lowest.append((obj_of(folder, Path(mesh.get("filename")).name)[0] @ X[2, :3] + X[2, 3]).min())
    assert abs(min(lowest)) < 0.01, "the wheels touch the floor"
    plant, _, _ = drake("", folder / "pr2.urdf")
    actuators = [plant.get_joint_actuator(k) for k in plant.GetJointActuatorIndices()]
    efforts = {actuator.joint().name(): actuator.effort_limit() for actuator in actuators}
    assert {"torso_lift_joint", "head_pan_joint", "r_gripper_l_finger_joint"} <= set(efforts)
    assert efforts["l_shoulder_lift_joint"] == 30.0 and efforts["r_wrist_flex_joint"] == 10.0
    for side in "lr":
        follows = found.joints[f"{side}_gripper_r_parallel_root_joint"].mimic
        assert follows == (f"{side}_gripper_l_finger_joint", 1.0, 0.0)


@pytest.mark.robots
@needs_trimesh
@pytest.mark.parametrize(
    ("model", "arm", "most_seconds"),
    [
        ("package://example-robot-data/robots/pr2_description/urdf/pr2.urdf", 7, 60),
        ("package://example-robot-data/robots/tiago_pro_description/robots/tiago_pro.urdf", 7, 60),
        ("package://example-robot-data/robots/baxter_description/urdf/baxter.urdf", 7, 60),
        ("package://dexmate_urdf/robots/humanoid/vega_1/vega_1_gripper.urdf", 7, 60),
    ],
)
def test_robots_of_installed_wheels_become_models_that_drake_reads(tmp_path, capsys, model, arm, most_seconds):
    try:
        packages.resolve(model, None, "MODEL")
    except ConfigError as error:
        pytest.skip(str(error))
    start = time.process_time()
    assert cli.main(["import-robot", model, "-o", str(tmp_path / "out"), "--json"]) == 0
    assert time.process_time() - start < most_seconds
    report = json.loads(capsys.readouterr().out)
    plant, _, diagram = drake("", report["urdf"])
    advance(diagram)
    tree = yaml_file.read(tmp_path / "out" / "robot.yaml")
    assert all(len(tree["arms"][side]["joints"]) == arm for side in ("left", "right"))
    assert all(len(tree["grippers"][side]["pads"]) == 2 for side in ("left", "right"))
    assert (tmp_path / "out" / "LICENSE").stat().st_size > 500
