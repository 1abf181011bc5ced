"""Do the arms touch anything? A model of robot, valve and panel for planning, apart from the simulated plant."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from pydrake.geometry import (
    CollisionFilterDeclaration,
    CollisionFilterManager,
    GeometryId,
    GeometrySet,
    QueryObject,
    SignedDistancePair,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from valve_drake.checks import shown
from valve_drake.frames import compose, inverse
from valve_drake.messages import SIDES
from valve_drake.robot import description, xml_file
from valve_drake.robot.robot import Robot
from valve_drake.valve.valve import PLATE, turned

LEVEL = 0.3  # vertical part of the panel's plane, below which nothing tells how the panel lies
FAR = np.column_stack([np.eye(3), [0.0, 0.0, -50.0]])  # out of the way: the valve's pose while none is known


def stem_angle(X_BA: np.ndarray) -> float:
    """The angle of A's x axis from the horizontal, positive counter-clockwise as seen from the robot [rad].

    Zero where the axis is upright: nothing tells how the panel lies then.
    """
    x, y = X_BA[2, 0], X_BA[2, 1]  # heights of A's axes
    return math.atan2(x, -y) if math.hypot(x, y) > LEVEL else 0.0


def srdf_pairs(path: Path) -> set[tuple[str, str]]:
    """The pairs of links that an SRDF file says need no check. Raises ConfigError if it is no such file."""
    found = xml_file.read(path, f"collision.srdf must be an SRDF file, got {shown(path.name)}").iter(
        "disable_collisions"
    )
    return {(pair.get("link1", ""), pair.get("link2", "")) for pair in found}


def exclude(
    plant: MultibodyPlant,
    filters: CollisionFilterManager,
    model: ModelInstanceIndex,
    pairs: Iterable[tuple[str, str]],
) -> None:
    """The shapes of these pairs of the model's links are not looked at from now on."""

    def shapes(link: str) -> GeometrySet:
        return GeometrySet(plant.GetCollisionGeometriesForBody(plant.GetBodyByName(link, model)))

    for a, b in sorted(pairs):
        filters.Apply(CollisionFilterDeclaration().ExcludeBetween(shapes(a), shapes(b)))


class CollisionModel:
    """Robot at its base's origin, head at home, lift and waist as asked; the valve of its model can be anywhere.

    The panel stays level while the valve turns: the stem's angle is that of A's x axis against the horizontal.

    ignored: pairs of links that may touch (robot.yaml's `collision`).
    clearance: least distance that counts as free; a larger one forbids poses near the valve [m]; None: the robot's.
    opening: of both grippers [m]; None: the robot's.
    """

    def __init__(self, robot: Robot, clearance: float | None = None, opening: float | None = None):
        shared = robot.model
        self._follow = robot.follow if robot.couples else None
        self._robot = shared.robot
        self._plant, self._scene_graph, self._valve = shared.plant, shared.scene_graph, shared.valve
        self._root = shared.diagram.CreateDefaultContext()
        self._context = self._plant.GetMyMutableContextFromRoot(self._root)
        self._clearance = robot.description.collision.padding if clearance is None else clearance
        self._X_AP = shared.shape.X_AP()
        self._stem = shared.plant.GetJointByName("stem", shared.valve).position_start()
        self._arms = robot.slots([name for side in SIDES for name in robot.arms[side].names])
        self._posture = robot.slots(robot.posture.names)
        self._rest = robot.rest(robot.opening if opening is None else opening)
        self._home = robot.home
        self._held = {side: robot.forward(side, robot.split(robot.home)[side]) for side in SIDES}
        last = {side: self._plant.GetJointByName(robot.arms[side].names[-1], self._robot).index() for side in SIDES}
        self._hands = {side: set(self._plant.GetBodiesKinematicallyAffectedBy([last[side]])) for side in SIDES}
        self.ignored: set[tuple[str, str]] = set()
        described = robot.description.collision
        if described.srdf:
            path = description.find_file(described.srdf, "collision.srdf")
            plant, model = self._plant, shared.robot
            self._ignore({pair for pair in srdf_pairs(path) if all(plant.HasBodyNamed(name, model) for name in pair)})
        if described.ignore:
            self._ignore({(self._link(pair.id_A), self._link(pair.id_B)) for pair in self._near(None, robot.home)})

    @property
    def pairs(self) -> int:
        """How many pairs of shapes is_free goes through."""
        query = self._scene_graph.get_query_output_port().Eval(self._scene_graph.GetMyContextFromRoot(self._root))
        return len(query.inspector().GetCollisionCandidates())

    def _link(self, shape: GeometryId) -> str:
        frame = self._scene_graph.model_inspector().GetFrameId(shape)
        name: str = self._plant.GetBodyFromFrameId(frame).name()
        return name

    def _ignore(self, pairs: set[tuple[str, str]]) -> None:
        """These pairs of links may touch from now on."""
        self.ignored |= pairs
        root = self._scene_graph.GetMyMutableContextFromRoot(self._root)
        exclude(self._plant, self._scene_graph.collision_filter_manager(root), self._robot, pairs)

    def _pose(self, X_BA: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None) -> QueryObject:
        """Poses the model and returns the geometry query for it."""
        plant, context = self._plant, self._context
        positions = self._rest.copy()
        positions[self._arms] = q
        if posture is not None and len(posture):
            positions[self._posture] = posture
        if self._follow is not None:
            self._follow(positions)
        angle = 0.0 if X_BA is None else stem_angle(X_BA)
        X_BP = FAR if X_BA is None else compose(turned(X_BA, -angle), self._X_AP)
        positions[self._stem] = angle
        plant.SetPositions(context, positions)
        frame = plant.GetFrameByName("valve_axis", self._valve)
        X_PLink = frame.GetFixedPoseInBodyFrame().inverse()
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(X_BP[:, :3]), X_BP[:, 3]) @ X_PLink
        plant.SetFreeBodyPose(context, frame.body(), X)
        return self._scene_graph.get_query_output_port().Eval(self._scene_graph.GetMyContextFromRoot(self._root))

    def is_free(self, X_BA: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None = None) -> bool:
        """True if no two bodies are nearer than the clearance.

        X_BA: the valve in the base (None: no valve); q: both arms; posture: lift and waist (None or empty: at home).
        """
        return len(self._near(X_BA, q, posture)) == 0

    def touching(self, X_BA: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None = None) -> list[str]:
        """The pairs of shapes that are nearer than the clearance, as link::shape, for messages; as of is_free."""
        inspector = self._scene_graph.model_inspector()

        def name(shape: GeometryId) -> str:
            return f"{self._link(shape)}::{inspector.GetName(shape).rpartition('::')[2]}"

        pairs = self._near(X_BA, q, posture)
        return [f"{name(p.id_A)} - {name(p.id_B)}: {1e3 * p.distance:.0f} mm" for p in pairs]

    def at_handle(self, side: str, X_AG: np.ndarray) -> list[str]:
        """What of the valve that turns, or of a made panel's PLATE, an open hand at X_AG touches, by shape.

        That is the same wherever arm and valve are.
        """
        plant, inspector = self._plant, self._scene_graph.model_inspector()
        wheel, panel = (plant.GetBodyByName(name, self._valve).index() for name in ("wheel", "panel"))
        found = []
        for pair in self._near(compose(self._held[side], inverse(X_AG)), self._home):
            shapes = {plant.GetBodyFromFrameId(inspector.GetFrameId(s)).index(): s for s in (pair.id_A, pair.id_B)}
            for body in {wheel, panel} & shapes.keys() if self._hands[side] & shapes.keys() else ():
                name = inspector.GetName(shapes[body]).rpartition("::")[2]
                if body == wheel or name == PLATE:
                    found.append(name)
        return sorted(set(found))

    def held_at(self, side: str, X_AG: np.ndarray) -> list[str]:
        """What of the valve that turns is where a hand at X_AG grips, by shape."""
        inspector = self._scene_graph.model_inspector()
        wheel = self._plant.GetBodyByName("wheel", self._valve)
        query = self._pose(compose(self._held[side], inverse(X_AG)), self._home, None)
        inside = query.ComputeSignedDistanceToPoint(self._held[side][:, 3], 0.0)
        own = set(self._plant.GetCollisionGeometriesForBody(wheel))
        return sorted({inspector.GetName(at.id_G).rpartition("::")[2] for at in inside if at.id_G in own})

    def _near(
        self, X_BA: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None = None
    ) -> list[SignedDistancePair]:
        """All pairs of shapes that are nearer than the clearance."""
        pairs: list[SignedDistancePair] = self._pose(X_BA, q, posture).ComputeSignedDistancePairwiseClosestPoints(
            self._clearance
        )
        return pairs
