"""robot.yaml's `pad`: a grid of small spheres on the surfaces of a gripper's pads, which carry the contact.

A hand that is held by a convex hull touches at one point, which jumps as it slips; a grid of points holds a bar as two
flat pads do. Their material is that of our own robot's pads.
"""

import dataclasses as dc
from collections.abc import Callable

import numpy as np
from pydrake.geometry import AddContactMaterial, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import Frame, Joint

RADIUS = 0.004  # of each sphere [m]
PROUD = 0.0005  # how far they stand out of the surface: the model's own shape must not touch first [m]
COUNT = 3, 2  # along x and z of the grip
STIFFNESS, DISSIPATION = 5e4, 5.0  # of each [N/m], [s/m]


@dc.dataclass(frozen=True)
class PadPoints:
    """The middles of one pad's spheres, in its frame (K, 3) [m]."""

    frame: str
    points: np.ndarray


def contact_points(
    plant: MultibodyPlant,
    grip: Frame,
    pads: tuple[Frame, Frame],
    joint: Joint,
    follow: Callable[[np.ndarray], None],
    at: list[float],
    size: list[float],
) -> list[PadPoints]:
    """Where the spheres of one gripper are on its pads. The grid is level when the gripper is shut.

    at: middle of the surface, in the first pad's frame; of the second one's its mirror image beyond y = 0 of the grip.
    follow: puts the joints that follow others where they belong, in the plant's positions.
    """
    context = plant.CreateDefaultContext()
    first = np.array(at)
    mirrored = plant.CalcPointsPositions(context, pads[0], first, grip)[:, 0] * [1, -1, 1]
    surfaces = first, plant.CalcPointsPositions(context, grip, mirrored, pads[1])[:, 0]
    q = np.array(plant.GetPositions(context))

    def places(position: float) -> list[np.ndarray]:
        q[joint.position_start()] = position
        follow(q)
        plant.SetPositions(context, q)
        return [plant.CalcPointsPositions(context, pad, p, grip)[:, 0] for pad, p in zip(pads, surfaces)]

    limits = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
    shut = min(limits, key=lambda position: abs(float(np.subtract(*places(position))[1])))
    opened = limits[1] if shut == limits[0] else limits[0]
    sign = float(np.sign(np.subtract(*places(opened))[1]))  # of the first pad's side
    middles = places(shut)
    x, z = (np.linspace(-length / 2, length / 2, count) for length, count in zip(size, COUNT))
    out = []
    for pad, middle, side in zip(pads, middles, (sign, -sign)):
        inside = side * (RADIUS - PROUD)
        grid = np.array([middle + [dx, inside, dz] for dx in x for dz in z])
        out.append(PadPoints(pad.name(), plant.CalcPointsPositions(context, grip, grid.T, pad).T))
    return out


def add_points(plant: MultibodyPlant, frame: Frame, points: np.ndarray, friction: float) -> None:
    """Adds the spheres to a plant with geometry that is not finalized."""
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=DISSIPATION,
        point_stiffness=STIFFNESS,
        friction=CoulombFriction(friction, friction),
        properties=properties,
    )
    X_LinkPad = frame.GetFixedPoseInBodyFrame()
    for k, point in enumerate(points):
        X = RigidTransform(X_LinkPad.multiply(point))
        plant.RegisterCollisionGeometry(frame.body(), X, Sphere(RADIUS), f"pad_{k}", properties)
