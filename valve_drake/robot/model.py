"""The robot's model in Drake, made from its description; names of joints and frames in it."""

import contextlib
import dataclasses as dc
import difflib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Frame,
    Joint,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)

from valve_drake import resources
from valve_drake.checks import ConfigError, shown
from valve_drake.messages import SIDES
from valve_drake.robot import packages, xml_file
from valve_drake.robot.description import RobotDescription, model_file
from valve_drake.robot.pads import PadPoints, add_points, contact_points
from valve_drake.robot.paint import painted

CARRIAGE = 0.01  # mass of each that a model without planar joints gets [kg]
EFFORT, BASE_EFFORT = 100.0, 2000.0  # of a joint whose file states none, of an added base joint [N or N m]


@dc.dataclass(frozen=True)
class Mimic:
    """A joint that follows another: its position is multiplier times the other's, plus offset."""

    joint: str
    follows: str
    multiplier: float
    offset: float


def parse(
    plant: MultibodyPlant, path: Path, colors: Mapping[str, Sequence[float]] = MappingProxyType({})
) -> ModelInstanceIndex:
    """Adds the one model of a file. colors: of its materials, in the place of the file's own.

    Raises ConfigError if Drake cannot read it, or it holds several.
    """
    parser = Parser(plant)
    known = parser.package_map()
    known.AddPackageXml(str(resources.models() / "package.xml"))
    for name, folder in packages.named_in(path, known.Contains):
        known.Add(name, str(folder))
    try:
        models: list[ModelInstanceIndex]
        if colors:
            kind = "urdf" if path.suffix.lower() == ".urdf" else "sdf"
            models = parser.AddModelsFromString(painted(path, colors), kind)
        else:
            models = parser.AddModels(str(path))
    except ConfigError:
        raise
    except (RuntimeError, ValueError) as error:
        raise ConfigError(f"model {path} cannot be read: {_first(str(error))}") from error
    if len(models) != 1:
        raise ConfigError(f"model {path} must hold one model, got {len(models)}")
    return models[0]


def _first(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return shown(lines[0]).strip("'\"") if lines else "no reason given"


def add_robot(
    plant: MultibodyPlant, robot: RobotDescription, place: Sequence[float] = (0.0, 0.0, 0.0)
) -> ModelInstanceIndex:
    """Adds the robot to a plant that is not finalized: welds, frames, base joints, actuators, gravity.

    place: x, y, heading where a fixed base is bolted to the floor; another one is put anywhere by its joints [m, rad].
    Raises ConfigError in one line: a name that the model lacks, a file that cannot be read.
    """
    path = model_file(robot)
    model = parse(plant, path, robot.colors)
    efforts = {name: effort for name, effort, _ in _file_joints(path) if effort is not None}
    if robot.weld:
        with _free_of_constraints(plant, model, robot, "weld must be empty"):
            _weld(plant, model, robot)
    for name, frame in robot.frames.items():
        if plant.HasFrameNamed(name, model):
            raise ConfigError(f"frames.{name}: the model has a frame of this name")
        link = frame_named(plant, model, frame.link, f"frames.{name}.link")
        X = RigidTransform(RollPitchYaw(frame.rpy), frame.xyz)
        plant.AddFrame(FixedOffsetFrame(name, link, X, model))
    base = frame_named(plant, model, robot.base.frame, "base.frame")
    if not base_chain(plant, model, base.body()):
        root = _root(plant, model, base.body())
        hangs = root.index() == plant.world_body().index()  # by a weld of the file
        if hangs and robot.base.drive != "fixed":
            raise ConfigError("base.drive must be fixed for a model that is welded to the world")
        carried = root.body_frame() if hangs else _carried(plant, model, root, base)
        if robot.base.drive != "fixed":
            _add_carriages(plant, model, root, carried)
        else:
            with _free_of_constraints(plant, model, robot, "base.drive must be one that moves"):
                _bolt(plant, model, root, base.body(), carried, place)
    for key, name in named_joints(robot):
        joint = joint_named(plant, model, name, key)
        if joint.num_velocities() != 1:
            raise ConfigError(f"{key} must be a joint with one axis, got {shown(name)} ({joint.type_name()})")
        if not _has_actuator(plant, joint):
            plant.AddJointActuator(name, joint, efforts.get(name, EFFORT))
    for side in SIDES:
        _check_pads(plant, model, robot, side)
    stronger = {robot.gripper(side).joint: robot.gripper(side).effort for side in SIDES if robot.gripper(side).effort}
    for index in plant.GetJointActuatorIndices():  # those of one model are not known before the plant is finalized
        actuator = plant.get_joint_actuator(index)
        if actuator.model_instance() == model and actuator.joint().name() in stronger:
            actuator.set_effort_limit(stronger[actuator.joint().name()])
    if robot.counterbalanced:
        plant.set_gravity_enabled(model, False)
    if any(robot.pad.size) and plant.geometry_source_is_registered():
        for side, pads in _pad_points(robot).items():
            for k, pad in enumerate(pads):
                frame = frame_named(plant, model, pad.frame, f"grippers.{side}.pads[{k}]")
                add_points(plant, frame, pad.points, robot.pad.friction)
    return model


def _check_pads(plant: MultibodyPlant, model: ModelInstanceIndex, robot: RobotDescription, side: str) -> None:
    """Raises ConfigError for a pad that the arm does not carry, as one of the other hand."""
    last = robot.arm(side).joints[-1]

    def carried(name: str, key: str) -> bool:
        body = frame_named(plant, model, name, key).body()
        while (joint := parent_joint(plant, model, body)) is not None and joint.name() != last:
            body = joint.parent_body()
        return joint is not None

    if not carried(f"{side}_grip", f"frames.{side}_grip"):
        return  # the arm's joints are wrong, and are told so
    for k, pad in enumerate(robot.gripper(side).pads):
        key = f"grippers.{side}.pads[{k}]"
        if not carried(pad, key):
            raise ConfigError(f"{key} must be beyond {last}, got {shown(pad)}")


def _pad_points(robot: RobotDescription) -> dict[str, list[PadPoints]]:
    """The contact points of both grippers, by a model without shapes that stands apart."""
    plant = MultibodyPlant(0.0)
    model = add_robot(plant, robot)
    plant.Finalize()
    follow, out = follower(plant, model, mimics(robot)), {}
    for side in SIDES:
        key, spec = f"grippers.{side}", robot.gripper(side)
        a, b = (frame_named(plant, model, name, f"{key}.pads[{k}]") for k, name in enumerate(spec.pads))
        grip = frame_named(plant, model, f"{side}_grip", f"frames.{side}_grip")
        joint = joint_named(plant, model, spec.joint, f"{key}.joint")
        limits = [*joint.position_lower_limits(), *joint.position_upper_limits()]
        if not np.isfinite(limits).all():
            raise ConfigError(f"{key}.joint must be a joint with limits, got {shown(spec.joint)}")
        out[side] = contact_points(plant, grip, (a, b), joint, follow, robot.pad.at, robot.pad.size)
    return out


@contextlib.contextmanager
def _free_of_constraints(
    plant: MultibodyPlant, model: ModelInstanceIndex, robot: RobotDescription, refusal: str
) -> Iterator[None]:
    """Drake removes no joint while the plant has constraints: they are taken out and put back.

    Raises ConfigError with the refusal for constraints other than mimics.
    """
    followers = mimics(robot)
    constraints = plant.GetConstraintIds()
    known = sum(mimic is not None for _, _, mimic in _file_joints(model_file(robot)))
    if len(constraints) > known:
        raise ConfigError(f"{refusal} for a model with constraints other than mimics")
    for constraint in constraints:
        plant.RemoveConstraint(constraint)
    yield
    for mimic in followers:
        pair = [joint_named(plant, model, name, f"mimic of {mimic.joint}") for name in (mimic.joint, mimic.follows)]
        plant.AddCouplerConstraint(*pair, mimic.multiplier, mimic.offset)


def _weld(plant: MultibodyPlant, model: ModelInstanceIndex, robot: RobotDescription) -> None:
    for k, name in enumerate(robot.weld):
        joint = joint_named(plant, model, name, f"weld[{k}]")
        parent, child = joint.frame_on_parent(), joint.frame_on_child()
        for index in plant.GetJointActuatorIndices():
            actuator = plant.get_joint_actuator(index)
            if actuator.joint().index() == joint.index():
                plant.RemoveJointActuator(actuator)
        try:
            plant.RemoveJoint(joint)
        except RuntimeError as error:
            raise ConfigError(f"weld[{k}]: {shown(name)} cannot be welded: {_first(str(error))}") from error
        plant.WeldFrames(parent, child)


def named_joints(robot: RobotDescription) -> Iterator[tuple[str, str]]:
    """Key and name of every joint that moves, base apart."""
    for k, name in enumerate(robot.lift.joints):
        yield f"lift.joints[{k}]", name
    for key in ("waist", "tilt", "pan"):
        if name := getattr(robot.gaze, key):
            yield f"gaze.{key}", name
    for side in SIDES:
        for k, name in enumerate(robot.arm(side).joints):
            yield f"arms.{side}.joints[{k}]", name
        yield f"grippers.{side}.joint", robot.gripper(side).joint


def _has_actuator(plant: MultibodyPlant, joint: Joint) -> bool:
    return any(plant.get_joint_actuator(i).joint().index() == joint.index() for i in plant.GetJointActuatorIndices())


def parent_joint(plant: MultibodyPlant, model: ModelInstanceIndex, body: RigidBody) -> Joint | None:
    """The joint that carries a body."""
    for index in plant.GetJointIndices(model):
        joint = plant.get_joint(index)
        if joint.child_body().index() == body.index():
            return joint
    return None


def base_chain(plant: MultibodyPlant, model: ModelInstanceIndex, body: RigidBody) -> list[Joint]:
    """The moving joints between the world and the base's body, the world's first."""
    chain: list[Joint] = []
    while (joint := parent_joint(plant, model, body)) is not None:
        if joint.type_name() != "weld":
            chain.insert(0, joint)
        body = joint.parent_body()
    return chain


def _root(plant: MultibodyPlant, model: ModelInstanceIndex, body: RigidBody) -> RigidBody:
    """The body that carries this one and hangs on nothing itself."""
    while (joint := parent_joint(plant, model, body)) is not None:
        body = joint.parent_body()
    return body


def _carried(plant: MultibodyPlant, model: ModelInstanceIndex, root: RigidBody, base: Frame) -> Frame:
    """The base's frame B as one of the model's root, to which welds hold it: what stands on the floor and is driven."""
    X_RootB = base.GetFixedPoseInBodyFrame()
    joint = parent_joint(plant, model, base.body())
    while joint is not None and joint.child_body().index() != root.index():
        assert isinstance(joint, WeldJoint)  # no joint between root and base moves
        X_ParentChild = (
            joint.frame_on_parent().GetFixedPoseInBodyFrame()
            @ joint.X_FM()
            @ joint.frame_on_child().GetFixedPoseInBodyFrame().inverse()
        )
        X_RootB = X_ParentChild @ X_RootB
        joint = parent_joint(plant, model, joint.parent_body())
    if X_RootB.IsExactlyIdentity():
        return root.body_frame()
    return plant.AddFrame(FixedOffsetFrame("base_on_root", root.body_frame(), X_RootB, model))


def _bolt(
    plant: MultibodyPlant,
    model: ModelInstanceIndex,
    root: RigidBody,
    base: RigidBody,
    carried: Frame,
    place: Sequence[float],
) -> None:
    """Welds a fixed robot to the floor; one that its file welds to the world stands there instead."""
    X_WPlace = RigidTransform(RollPitchYaw(0.0, 0.0, place[2]), [place[0], place[1], 0.0])
    if root.index() != plant.world_body().index():
        plant.WeldFrames(plant.world_frame(), carried, X_WPlace)
        return
    joint = parent_joint(plant, model, base)
    assert joint is not None  # the base hangs on the world
    while joint.parent_body().index() != root.index():
        joint = parent_joint(plant, model, joint.parent_body())
        assert joint is not None
    parent, child = joint.frame_on_parent(), joint.frame_on_child()
    assert isinstance(joint, WeldJoint)  # no joint of a fixed base moves
    X_WChild = parent.GetFixedPoseInBodyFrame() @ joint.X_FM()
    plant.RemoveJoint(joint)
    plant.WeldFrames(plant.world_frame(), child, X_WPlace @ X_WChild)


def _add_carriages(plant: MultibodyPlant, model: ModelInstanceIndex, body: RigidBody, carried: Frame) -> None:
    """The joints base_x, base_y and base_yaw between the world and the model's root; they move its frame `carried`."""
    little = SpatialInertia(CARRIAGE, [0, 0, 0], UnitInertia.SolidSphere(0.05))
    parent = plant.world_body()
    for name, axis in (("base_x", [1, 0, 0]), ("base_y", [0, 1, 0]), ("base_yaw", [0, 0, 1])):
        child = body if name == "base_yaw" else plant.AddRigidBody(f"{name}_carriage", model, little)
        kind = RevoluteJoint if name == "base_yaw" else PrismaticJoint
        moved = carried if name == "base_yaw" else child.body_frame()
        joint = plant.AddJoint(kind(name, parent.body_frame(), moved, axis))
        plant.AddJointActuator(name, joint, BASE_EFFORT)
        parent = child


# ---------------------------------------------------------------- names


def joint_named(plant: MultibodyPlant, model: ModelInstanceIndex, name: str, key: str) -> Joint:
    """Raises ConfigError with the names that are near."""
    if plant.HasJointNamed(name, model):
        return plant.GetJointByName(name, model)
    raise _unknown("joint", name, key, (plant.get_joint(i).name() for i in plant.GetJointIndices(model)))


def frame_named(plant: MultibodyPlant, model: ModelInstanceIndex, name: str, key: str) -> Frame:
    """A frame or a link's own frame. Raises ConfigError with the names that are near."""
    if plant.HasFrameNamed(name, model):
        return plant.GetFrameByName(name, model)
    raise _unknown("frame", name, key, (plant.get_frame(i).name() for i in plant.GetFrameIndices(model)))


def _unknown(what: str, name: str, key: str, known: Iterable[str]) -> ConfigError:
    near = difflib.get_close_matches(name, list(known), 3, 0.6)
    hint = f"; near it: {', '.join(near)}" if near else ""
    return ConfigError(f"{key} must be a {what} of the model, got {shown(name)}{hint}")


# ---------------------------------------------------------------- what Drake does not tell of a file


def _file_joints(path: Path) -> Iterator[tuple[str, float | None, Mimic | None]]:
    """Name, effort limit and mimic of every joint of an SDF or URDF file, as they are written."""
    if path.suffix.lower() not in (".sdf", ".urdf", ".xml"):
        return
    for joint in xml_file.read(path, f"model {path}").iter("joint"):
        name = joint.get("name")
        if name is None:  # within a URDF transmission
            continue
        limit = joint.find("limit")  # URDF
        text = limit.get("effort") if limit is not None else joint.findtext("axis/limit/effort")
        try:
            effort = float(text) if text else None
            yield name, effort if effort and effort > 0 else None, _mimic(name, joint)
        except ValueError as error:
            raise ConfigError(f"model {path}: joint {shown(name)} has a limit or mimic that is no number") from error


def _mimic(name: str, joint: ET.Element) -> Mimic | None:
    for element in joint.iter():
        if element.tag.rpartition(":")[2] == "mimic" and (follows := element.get("joint")):

            def value(key: str, default: str, element: ET.Element = element) -> float:
                return float(element.get(key) or element.findtext(key) or default)

            return Mimic(name, follows, value("multiplier", "1"), value("offset", "0"))
    return None


def mimics(robot: RobotDescription) -> tuple[Mimic, ...]:
    """The joints that follow others, a leader before its followers. Drake has them, but not for Python."""
    found = {m.joint: m for _, _, m in _file_joints(model_file(robot)) if m is not None and m.joint not in robot.weld}
    out: list[Mimic] = []

    def add(mimic: Mimic, depth: int = 0) -> None:
        if mimic in out:
            return
        if depth > len(found):
            raise ConfigError(f"model {model_file(robot)}: joint {shown(mimic.joint)} follows itself")
        if mimic.follows in found:
            add(found[mimic.follows], depth + 1)
        out.append(mimic)

    for mimic in found.values():
        add(mimic)
    return tuple(out)


def follower(
    plant: MultibodyPlant, model: ModelInstanceIndex, following: Iterable[Mimic]
) -> Callable[[np.ndarray], None]:
    """What puts the joints that follow others where they belong, in the positions of a finalized plant."""

    def slot(name: str) -> int:
        start: int = joint_named(plant, model, name, "model: mimic").position_start()
        return start

    table = [(slot(m.joint), slot(m.follows), m.multiplier, m.offset) for m in following]

    def follow(q: np.ndarray) -> None:
        for joint, leader, multiplier, offset in table:
            q[joint] = multiplier * q[leader] + offset

    return follow
