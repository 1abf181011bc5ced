"""What others than the robot move in the simulated scene: the valve's stand that is pushed aside, a cover before its
marker (scenario keys `simulation.valve.pushed_at`, `covered_at`).

Each is a body on a prismatic joint of its own, driven by a servo of the physics: nothing is put anywhere by hand, and
whoever stands in the way is pushed with at most EFFORT. Where a rail is says all that it does next, so that nothing
else has to be kept between two ticks: at its start it waits for a hand to come near, and once it has moved by BEGUN it
goes on.
"""

import dataclasses as dc
import math

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Frame,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
)

from valve_drake.frames import compose, inverse
from valve_drake.stations.simulation_config import ValveConfig
from valve_drake.valve.valve import Valve

STAND, COVER = "stand", "cover"  # model instances; of each its only body and its joint
MASS = {STAND: 5.0, COVER: 0.2}  # [kg]
SPEED = 0.25  # [m/s]
EFFORT = 150.0  # of a rail's servo [N]
STIFFNESS, DAMPING = 2e6, 2e4  # of it [N/m, N s/m]
BEGUN = 1e-3  # [m]
CREEP = 0.004  # a body moves so far while it stays [m]
THERE = 1e-5  # so near to a place a rail is there [m]
BEFORE = 0.015  # the cover is so far before the marker [m]
CLOTH = (0.45, 0.42, 0.36, 1.0)  # of the cover, RGBA


@dc.dataclass(frozen=True)
class Rail:
    """One of them, in a plant."""

    model: ModelInstanceIndex
    joint: str
    near: float  # it begins when a hand is so near the valve's axis [m]
    end: float  # where it stops [m]
    stay: float = math.inf  # on its way it stays there ... [m]
    stay_for: float = 0.0  # ... for so long [s]

    def desired(self, q: float, distance: float, step: float) -> tuple[float, float]:
        """Position and speed asked for at the end of a `step` [s]; q: now; distance: of the nearest hand."""
        way = math.copysign(1.0, self.end)
        done, whole = way * q, way * self.end
        if done < BEGUN and distance > self.near:
            return 0.0, 0.0
        speed, stop = SPEED, whole
        if done < self.stay - THERE:
            stop = min(whole, self.stay)
        elif done < self.stay + CREEP:
            speed = min(CREEP / self.stay_for, SPEED) if self.stay_for else SPEED
        if done + speed * step >= stop:
            return way * stop, 0.0
        return way * (done + speed * step), way * speed


def add_stand(plant: MultibodyPlant, valve: ValveConfig, X_WP: np.ndarray) -> tuple[Frame, RigidTransform]:
    """What the panel is mounted on -> the frame, and X_FP in it."""
    if valve.pushed_at < 0:
        return plant.world_frame(), _rigid(X_WP)
    return _carriage(plant, STAND, np.array([1.0, 0.0, 0.0]), X_WP).body_frame(), RigidTransform()


def add_cover(plant: MultibodyPlant, valve: ValveConfig, shape: Valve, X_WP: np.ndarray) -> None:
    """A cloth as large as the face that carries the marker. It hangs above and comes down before it, and touches
    nothing."""
    if valve.covered_at < 0:
        return
    body = _carriage(plant, COVER, np.array([0.0, 1.0, 0.0]), X_WP)
    p_PV = compose(inverse(shape.X_AP()), shape.X_AV())[:, 3]
    size = shape.marker.face
    start = RigidTransform(p_PV - [0.0, covered_way(shape) + size / 2, BEFORE])
    plant.RegisterVisualGeometry(body, start, Box(size, size, 1e-3), COVER, np.array(CLOTH))


def covered_way(shape: Valve) -> float:
    """How far the cover comes down until its lower edge is before the marker's middle [m]."""
    return 2.0 * shape.marker.face


def rails(plant: MultibodyPlant, valve: ValveConfig, shape: Valve) -> tuple[Rail, ...]:
    """Those that `add_stand` and `add_cover` have added."""
    out = []
    if valve.covered_at >= 0:
        way, model = covered_way(shape), plant.GetModelInstanceByName(COVER)
        out.append(Rail(model, COVER, valve.covered_at, 2.5 * way, way, valve.covered_for))
    if valve.pushed_at >= 0:
        model = plant.GetModelInstanceByName(STAND)
        out.append(Rail(model, STAND, valve.pushed_at, valve.pushed_by, 2 * BEGUN, valve.pushed_after))
    return tuple(out)


def _carriage(plant: MultibodyPlant, name: str, axis: np.ndarray, X_WP: np.ndarray) -> RigidBody:
    """A body at the panel's axis point that a servo moves along `axis` of P."""
    model = plant.AddModelInstance(name)
    plant.set_gravity_enabled(model, False)
    inertia = SpatialInertia(MASS[name], [0, 0, 0], UnitInertia.SolidBox(0.2, 0.2, 0.2))
    body = plant.AddRigidBody(name, model, inertia)
    begin = plant.AddFrame(FixedOffsetFrame(f"{name}_begin", plant.world_frame(), _rigid(X_WP), model))
    joint = plant.AddJoint(PrismaticJoint(name, begin, body.body_frame(), axis))
    servo = plant.AddJointActuator(name, joint, EFFORT)
    servo.set_controller_gains(PdControllerGains(p=STIFFNESS, d=DAMPING))
    return body


def _rigid(X: np.ndarray) -> RigidTransform:
    return RigidTransform(RotationMatrix(X[:, :3]), X[:, 3])
