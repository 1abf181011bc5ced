"""Other robots for the tests: our own, its model and its robot.yaml edited."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

from valve_drake import yaml_file
from valve_drake.messages import SIDES
from valve_drake.robot import description

ElementTree.register_namespace("drake", "drake.mit.edu")
Model = ElementTree.Element
Edit = Callable[[Model], None]
Change = Callable[[dict[str, Any]], None]


def variant(folder: Path, edit: Edit = lambda model: None, change: Change = lambda given: None) -> Path:
    """The robot.yaml of our robot with its SDF model `edit`ed and its keys `change`d, in a folder."""
    source = description.find(description.OURS)
    tree = ElementTree.parse(source.with_name("robot.sdf"))
    model = tree.getroot().find("model")
    assert model is not None
    for uri in model.iter("uri"):
        uri.text = (uri.text or "").replace("../meshes", "package://valve_drake_models/meshes")
    edit(model)
    given = yaml_file.read(source)
    change(given)
    folder.mkdir(parents=True, exist_ok=True)
    tree.write(folder / "robot.sdf", encoding="unicode")
    path = folder / "robot.yaml"
    path.write_text(yaml_file.dump(given))
    return path


def part(model: Model, kind: str, name: str) -> Model:
    """The link, joint or frame of this name."""
    return next(element for element in model.iter(kind) if element.get("name") == name)


def put(element: Model, path: str, text: str) -> None:
    found = element.find(path)
    assert found is not None, path
    found.text = text


def seven_joints(model: Model) -> None:
    """A roll joint in the middle of each upper arm."""
    for side in SIDES:
        arm, roll = f"{side}_upper_arm", f"{side}_upper_arm_roll"
        model.append(
            ElementTree.fromstring(f"""<link name="{roll}"><pose relative_to="{arm}">0.18 0 0 0 0 0</pose><inertial>
            <mass>0.3</mass><inertia><ixx>1e-3</ixx><iyy>1e-3</iyy><izz>1e-3</izz></inertia></inertial></link>""")
        )
        model.append(
            ElementTree.fromstring(f"""<joint name="{side}_arm_roll" type="revolute"><parent>{arm}</parent>
            <child>{roll}</child><axis><xyz>1 0 0</xyz><limit><lower>-2.8</lower><upper>2.8</upper><effort>100</effort>
            <velocity>2.5</velocity></limit></axis></joint>""")
        )
        put(part(model, "joint", f"{side}_arm_3"), "parent", roll)


def with_roll(given: dict[str, Any]) -> None:
    for side in SIDES:
        arm = given["arms"][side]
        arm["joints"].insert(2, f"{side}_arm_roll")
        for name in ("home", "work"):
            arm[name].insert(2, 0.0)
    given["arm_speed"].insert(2, 1.2)
    given["collision"] = {"ignore": "touching_at_home"}  # the roll's link has no shape: upper arm and forearm overlap


def crooked_wrist(model: Model) -> None:
    """Other lengths, and wrist axes that do not meet."""
    for side in SIDES:
        put(part(model, "link", f"{side}_forearm"), "pose", "0.40 0 0 0 0 0")
        put(part(model, "link", f"{side}_wrist_1"), "pose", "0.29 0 0.03 0 0 0")
        put(part(model, "link", f"{side}_wrist_2"), "pose", "0.03 0 -0.03 0 0 0")
        put(part(model, "link", f"{side}_wrist_3"), "pose", "0.02 0.02 0.01 0 0 0")


def holonomic(given: dict[str, Any]) -> None:
    """A base that goes sideways, too."""
    given["base"] |= {"drive": "holonomic", "speed": [0.8, 0.5, 1.2], "acceleration": [0.8, 0.6, 2.0]}


def without_base_joints(model: Model) -> None:
    for kind, name in (("joint", "base_x"), ("joint", "base_y"), ("joint", "base_yaw"),
                       ("link", "base_x_carriage"), ("link", "base_y_carriage")):  # fmt: skip
        model.remove(part(model, kind, name))


def fixed(given: dict[str, Any]) -> None:
    """Bolted to the floor; the model is that `without_base_joints`."""
    given["base"] |= {"drive": "fixed", "speed": [], "acceleration": []}


def stiff_neck(model: Model, pitch: float, waist: bool = True) -> None:
    """A head that does not turn and looks down by `pitch` [rad]; without a waist too if asked for."""
    for name in ("neck_pitch", "neck_yaw", *([] if waist else ["waist"])):
        joint = part(model, "joint", name)
        joint.set("type", "fixed")
        for element in [element for element in joint if element.tag in ("axis", "dynamics")]:
            joint.remove(element)
    pose = part(model, "link", part(model, "joint", "neck_pitch").findtext("child") or "").find("pose")
    assert pose is not None
    x, y, z, roll, _, yaw = (pose.text or "").split()
    pose.text = f"{x} {y} {z} {roll} {pitch} {yaw}"


def without_gaze(given: dict[str, Any]) -> None:
    """Of that model with its waist; `without_waist` of that without."""
    del given["gaze"]["pan"], given["gaze"]["tilt"]


def without_waist(given: dict[str, Any]) -> None:
    without_gaze(given)
    del given["gaze"]["waist"]


def without_force_sensors(given: dict[str, Any]) -> None:
    """Forces by the joints' torques, which a gear's sensor reads to a tenth of a newton meter."""
    for side in SIDES:
        count = len(given["arms"][side]["joints"])
        given["arms"][side] |= {"sensor": "torque", "torque_noise": [0.1] * count, "torque_bias": [0.2] * count}
