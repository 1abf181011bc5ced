"""The valve's model in Drake, for the simulated plant, the cameras and the controllers: of a file, or made of its keys.

Links `wheel` and `panel`, joint `stem` between them; frames `valve_axis` (the axis at the panel's surface), `marker`
and `handle_1`, `handle_2`, ... A file that has frames of these names must have them where the keys say.
"""

import math
from pathlib import Path

import numpy as np
from pydrake.geometry import Box, Cylinder, ProximityProperties, Shape
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Frame,
    ModelInstanceIndex,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
)

from valve_drake import resources
from valve_drake.checks import ConfigError, require
from valve_drake.frames import compose, inverse, make, rot_z
from valve_drake.perception import marker
from valve_drake.robot.description import find_package_file
from valve_drake.robot.model import frame_named, joint_named, parent_joint, parse
from valve_drake.valve.valve import PLATE, SPOKE, Valve

RED, GREEN = (0.80, 0.06, 0.05, 1.0), (0.05, 0.55, 0.15, 1.0)
STEEL, DARK = (0.70, 0.71, 0.73, 1.0), (0.08, 0.085, 0.095, 1.0)
FACE, ENAMEL = (0.78, 0.78, 0.77, 1.0), (0.52, 0.56, 0.61, 1.0)
STICKER = 1e-5  # thickness of the marker: a plate would show its rim to a camera from above [m]
MARK = (*marker.MARK, 0.001)  # a green mark: along its handle, across it, thick [m]
FRICTION, STIFFNESS, DISSIPATION = 0.8, 5e4, 5.0  # of a handle under a pad [-, N/m, s/m]
TORQUE = 5.1  # effort limit of the stem's friction until a scene sets it [N m]
CLEARLY = 0.02  # spokes that are so much farther from the handles are worth another place [rad]
SEGMENTS = 40  # of a rim
ON_MODEL = 0.001  # by which a model's frame may differ from the keys [m, rad]
BEHIND = 0.05  # of a crank's arm behind its handle, where fingers have room [m]
STRAIGHT = 0.02  # sine of the angle to the radius below which a bar goes straight out from the axis
HUB = 0.03  # radius of a made valve's hub and stem [m]


def add_valve(plant: MultibodyPlant, valve: Valve, X_VM: np.ndarray | None = None) -> ModelInstanceIndex:
    """Adds the valve to a plant that is not finalized. X_VM: where the marker really is, in V (3, 4); None: there.

    Raises ConfigError: a file that cannot be read, a link or frame that it lacks or has elsewhere.
    """
    model = _read(plant, valve) if valve.model else _made(plant, valve)
    wheel, panel = (plant.GetBodyByName(name, model) for name in ("wheel", "panel"))
    X_PA = inverse(valve.X_AP())
    carrier = panel if valve.fixed else wheel  # of the marker
    # In the file the wheel's own frame is valve_axis, with the stem at zero.
    places = {f"handle_{k + 1}": make(np.eye(3), np.array(h.xyz)) for k, h in enumerate(valve.handles)}
    places["marker"] = valve.X_AV()
    for name, X_AF in places.items():
        X_WheelF = compose(X_PA, X_AF)
        body = carrier if name == "marker" else wheel
        if not plant.HasFrameNamed(name, model):
            plant.AddFrame(FixedOffsetFrame(name, body.body_frame(), _rigid(X_WheelF), model))
            continue
        frame = plant.GetFrameByName(name, model)
        found = frame.GetFixedPoseInBodyFrame().GetAsMatrix34()
        key = "valve.marker" if name == "marker" else f"valve.handles[{int(name[7:]) - 1}]"
        if name == "marker":
            own = frame.body().name()
            require(
                own == body.name(),
                "valve.marker.carrier",
                f"where valve.model has its frame marker, {own}",
                body.name(),
            )
        off = np.abs(found - X_WheelF).max(axis=0)
        place = np.round(compose(valve.X_AP(), found)[:, 3], 4).tolist()
        require(
            off[3] < ON_MODEL, f"{key}.xyz", f"where valve.model has its frame {name}, {place}", X_AF[:, 3].tolist()
        )
        if name == "marker":
            rpy = [round(angle, 4) + 0.0 for angle in RollPitchYaw(RotationMatrix(found[:, :3])).vector().tolist()]
            turned = bool(off[:3].max() < ON_MODEL)
            require(turned, f"{key}.rpy", f"as valve.model has its frame {name}, {rpy}", valve.marker.rpy)
    X_WheelM = compose(X_PA, valve.X_AV())
    if X_VM is not None:
        X_WheelM = compose(X_WheelM, X_VM)
        plant.AddFrame(FixedOffsetFrame("true_marker", carrier.body_frame(), _rigid(X_WheelM), model))
    at = _rigid(compose(X_WheelM, make(np.eye(3), np.array([0, 0, STICKER / 2]))))
    plant.RegisterVisualGeometry(carrier, at, Box(*valve.marker.size, STICKER), "marker", np.array(RED))
    for k, obstacle in enumerate(valve.obstacles):
        X = _rigid(compose(X_PA, make(np.eye(3), np.array(obstacle.xyz))))
        _solid(plant, panel, X, Box(*obstacle.size), f"obstacle_{k + 1}", ENAMEL)
    return model


def _read(plant: MultibodyPlant, valve: Valve) -> ModelInstanceIndex:
    """Adds the model of a file, which is to be put together as the ones that are made here. Raises ConfigError."""
    key = "valve.model"
    try:
        model = parse(plant, _file(valve.model))
    except ConfigError as error:
        text = str(error)
        raise ConfigError(text if text.startswith(key) else f"{key}: {text}") from error
    stem = joint_named(plant, model, "stem", f"{key}: stem")
    axis = frame_named(plant, model, "valve_axis", f"{key}: valve_axis")
    wheel, panel = (frame_named(plant, model, name, f"{key}: {name}").body() for name in ("wheel", "panel"))

    def must(ok: bool, rule: str) -> None:
        require(ok, key, rule, valve.model)

    level = axis.body().index() == panel.index() and axis.GetFixedPoseInBodyFrame().IsNearlyIdentity(ON_MODEL)
    must(level, "one whose frame valve_axis is the link panel's own")
    ends = stem.parent_body().index(), stem.child_body().index()
    between = isinstance(stem, RevoluteJoint) and ends == (panel.index(), wheel.index())
    must(between, "one whose joint stem is revolute, from the link panel to the link wheel")
    X_PanelF = stem.frame_on_parent().GetFixedPoseInBodyFrame()
    X_PanelWheel = X_PanelF @ stem.frame_on_child().GetFixedPoseInBodyFrame().inverse()
    must(X_PanelWheel.IsNearlyIdentity(ON_MODEL), "one whose links panel and wheel share a frame with the stem at zero")
    off_axis = np.abs([*X_PanelF.translation()[:2], *(X_PanelF.rotation() @ stem.revolute_axis() + [0, 0, 1])]).max()
    must(bool(off_axis < ON_MODEL), "one whose joint stem turns about -z of the link panel, through its origin")
    actuators = (plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices())
    driven = any(actuator.joint().index() == stem.index() and actuator.name() == "stem" for actuator in actuators)
    must(driven, "one whose joint stem has an actuator of its name (an effort limit)")
    must(parent_joint(plant, model, panel) is None, "one whose link panel hangs on nothing: the scene puts it anywhere")
    return model


def _file(name: str) -> Path:
    if name.startswith("package://"):
        return find_package_file(name, "valve.model")
    try:
        return resources.find(name, resources.models())
    except ConfigError as error:
        raise ConfigError(f"valve.model: {error}") from error


def marker_frame(plant: MultibodyPlant, model: ModelInstanceIndex) -> Frame:
    """Where the marker really is."""
    name = "true_marker" if plant.HasFrameNamed("true_marker", model) else "marker"
    return plant.GetFrameByName(name, model)


def _rigid(X: np.ndarray) -> RigidTransform:
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(X[:, :3]), X[:, 3])


# ---------------------------------------------------------------- made of the keys


def _made(plant: MultibodyPlant, valve: Valve) -> ModelInstanceIndex:
    model = plant.AddModelInstance("valve")
    radius = max(math.hypot(*handle.xyz[:2]) for handle in valve.handles)
    disc = UnitInertia.SolidCylinder(radius, 0.05, [0, 0, 1])
    wheel = plant.AddRigidBody("wheel", model, SpatialInertia(1.6, [0, 0, 0], disc))
    panel = plant.AddRigidBody("panel", model, SpatialInertia(25.0, [0, 0, 0], UnitInertia.SolidBox(0.8, 0.8, 0.02)))
    plant.AddFrame(FixedOffsetFrame("valve_axis", panel.body_frame(), RigidTransform(), model))
    stem = plant.AddJoint(RevoluteJoint("stem", panel.body_frame(), wheel.body_frame(), [0, 0, -1]))
    plant.AddJointActuator("stem", stem, TORQUE)
    p, m = valve.panel, valve.marker
    plate = RigidTransform([0, 0, 0.01])
    _solid(plant, panel, plate, Box(p.width, p.height, 0.02), PLATE, ENAMEL)
    X_PA = inverse(valve.X_AP())
    # the hub, from the panel to the grip plane, and the post that carries the marker's face
    _solid(plant, wheel, RigidTransform([0, 0, -p.depth / 2 - 0.005]), Cylinder(HUB, p.depth - 0.01), "hub", DARK)
    X_face = compose(X_PA, valve.X_AV(), make(np.eye(3), np.array([0, 0, 0.003])))  # 1 mm behind the marker
    carrier = panel if valve.fixed else wheel
    _solid(plant, carrier, _rigid(X_face), Box(m.face, m.face, 0.004), "face", FACE)
    foot = np.array([m.xyz[0], m.xyz[1], p.depth if valve.fixed else 0.0])
    if math.hypot(*m.xyz[:2]) > HUB and not valve.fixed:  # an arm from the hub to below the face
        _beam(plant, wheel, X_PA, np.zeros(3), foot, 0.016, "face_arm", STEEL, solid=True)
    rise = foot[2] - m.xyz[2] - 0.005  # to within the face
    if rise > 0.005:
        X_post = compose(X_PA, make(np.eye(3), foot + [0, 0, -rise / 2]))
        _solid(plant, carrier, _rigid(X_post), Cylinder(0.02, rise), "post", STEEL)
    for k, handle in enumerate(valve.handles):
        d, xyz, w = handle.direction(), np.array(handle.xyz), handle.width
        if handle.kind == "rim":
            continue
        name, half = f"{handle.kind}_{k + 1}", handle.length / 2
        start = np.array([0.0, 0.0, handle.xyz[2]])
        out = xyz - start
        if abs(out[0] * d[1] - out[1] * d[0]) < STRAIGHT * math.hypot(out[0], out[1]):  # it goes on as it comes
            end = xyz + math.copysign(1.0, out @ d) * d * half
            _beam(plant, wheel, X_PA, start, end, w, name, STEEL, solid=True, thick=_thick(w, m.mark_height))
            continue
        # A crank: its arm comes from behind, beside the length that is free for a hand.
        inwards = -math.copysign(1.0, out @ d) * d
        foot, rise = xyz + inwards * (half + w / 2), max(min(BEHIND, p.depth - w - handle.xyz[2]), 0.0)
        behind = np.array([0.0, 0.0, rise])
        _beam(plant, wheel, X_PA, start + behind, foot + behind, w, f"{name}_arm", STEEL, solid=True)
        if rise > 0:
            X_riser = compose(X_PA, make(rot_z(math.atan2(d[1], d[0])), foot + behind / 2))
            _solid(plant, wheel, _rigid(X_riser), Box(w, w, rise + w), f"{name}_riser", STEEL, holds=True)
        ends = foot + inwards * w / 2, xyz - inwards * half
        _beam(plant, wheel, X_PA, *ends, w, name, STEEL, solid=True, thick=_thick(w, m.mark_height))
    _rim(plant, wheel, X_PA, valve)
    for k, handle in enumerate(valve.handles):
        d = handle.direction()
        R = np.column_stack([d, [-d[1], d[0], 0.0], [0.0, 0.0, 1.0]])
        X_mark = compose(X_PA, make(R, np.array(handle.xyz) + [0, 0, -m.mark_height]))
        plant.RegisterVisualGeometry(wheel, _rigid(X_mark), Box(*MARK), f"mark_{k + 1}", np.array(GREEN))
    return model


def _rim(plant: MultibodyPlant, wheel: RigidBody, X_PA: np.ndarray, valve: Valve) -> None:
    """A ring through the rim's handles, of straight pieces, one of them centred at each handle; and its spokes."""
    rims = [handle for handle in valve.handles if handle.kind == "rim"]
    if not rims:
        return
    z, width = rims[0].xyz[2], rims[0].width
    thick = _thick(width, valve.marker.mark_height)
    radius = math.hypot(*rims[0].xyz[:2])
    first = sorted(math.atan2(h.xyz[1], h.xyz[0]) for h in rims)
    count = SEGMENTS
    even = 2 * math.pi / len(rims)
    spread = all(abs((a - first[0]) / even - round((a - first[0]) / even)) < 0.01 for a in first)
    if spread:
        count = len(rims) * max(1, round(SEGMENTS / len(rims)))
    step = 2 * math.pi / count
    length = 2 * radius * math.tan(step / 2) + 0.2 * width
    for k in range(count):
        R = rot_z(first[0] + k * step)
        X = compose(X_PA, make(R, R @ np.array([radius, 0, 0]) + [0, 0, z]))
        _solid(plant, wheel, _rigid(X), Box(width, length, thick), f"rim_{k + 1}", STEEL, holds=True)
    between = _between(first, first[0] + even / 2 if spread else first[0], valve.spokes)
    for k in range(valve.spokes):
        direction = rot_z(between + 2 * math.pi * k / valve.spokes)[:, 0]
        end = direction * radius + [0, 0, z]
        _beam(plant, wheel, X_PA, np.array([0.0, 0.0, z]), end, SPOKE, f"spoke_{k + 1}", DARK, solid=True)


def _thick(width: float, mark_height: float) -> float:
    """Of a handle, along z of A [m]: a wide one is flat, or its green mark would be within it."""
    below = mark_height - MARK[2] / 2
    return width if width / 2 <= below + 1e-9 else 2 * below


def _between(handles: list[float], usual: float, spokes: int) -> float:
    """The angle of a spoke such that none is near a handle: the usual one, unless another is clearly farther [rad]."""
    if spokes == 0:
        return usual
    step = 2 * math.pi / spokes
    places = sorted(handle % step for handle in handles)
    gaps = [after - at for at, after in zip(places, [*places[1:], places[0] + step])]
    widest = max(range(len(gaps)), key=lambda k: gaps[k])
    room = min(abs((usual - place + step / 2) % step - step / 2) for place in places)
    return usual if room > gaps[widest] / 2 - CLEARLY else places[widest] + gaps[widest] / 2


def _beam(
    plant: MultibodyPlant,
    body: RigidBody,
    X_PA: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    width: float,
    name: str,
    color: tuple[float, ...],
    *,
    solid: bool,
    thick: float | None = None,
) -> None:
    """A bar between two points of A, level with z of A; thick: along z; None: a square one."""
    way = end - start
    length = float(np.linalg.norm(way))
    R = rot_z(math.atan2(way[1], way[0]))
    X = compose(X_PA, make(R, (start + end) / 2))
    _solid(plant, body, _rigid(X), Box(length, width, width if thick is None else thick), name, color, holds=solid)


def _solid(
    plant: MultibodyPlant,
    body: RigidBody,
    X: RigidTransform,
    shape: Shape,
    name: str,
    color: tuple[float, ...],
    *,
    holds: bool = False,
) -> None:
    """A shape that is seen and touched; holds: hands grip it."""
    plant.RegisterVisualGeometry(body, X, shape, name, np.array(color))
    if holds:
        properties = ProximityProperties()
        properties.AddProperty("material", "point_contact_stiffness", STIFFNESS)
        properties.AddProperty("material", "hunt_crossley_dissipation", DISSIPATION)
        properties.AddProperty("material", "coulomb_friction", CoulombFriction(FRICTION, FRICTION))
        plant.RegisterCollisionGeometry(body, X, shape, name, properties)
    else:
        plant.RegisterCollisionGeometry(body, X, shape, name, CoulombFriction(FRICTION, FRICTION))
