"""Do the arms touch anything? A model of robot, valve and panel for planning, apart from the simulated plant."""

import numpy as np
from pydrake.geometry import CollisionFilterDeclaration, GeometryId, GeometrySet, QueryObject, SignedDistancePair
from pydrake.math import RigidTransform, RotationMatrix

from valve_drake.frames import compose, make
from valve_drake.messages import SIDES
from valve_drake.perception.marker import Marker
from valve_drake.robot.robot import Robot

FAR = np.column_stack([np.eye(3), [0.0, 0.0, -50.0]])  # out of the way: the valve's pose while none is known


class CollisionModel:
    """Robot at the base's origin with its head at home, lift and waist as asked, and a valve that can be put anywhere.

    ignored: pairs of links that may touch, since they do at home (robot.yaml's `collision.ignore`).
    clearance: least distance that counts as free; a larger one forbids poses near the valve [m]; None: the robot's.
    opening: of both grippers [m]; None: the robot's.
    """

    def __init__(self, robot: Robot, marker: Marker, clearance: float | None = None, opening: float | None = None):
        shared = robot.model
        self._plant, self._scene_graph, self._valve = shared.plant, shared.scene_graph, shared.valve
        self._root = shared.diagram.CreateDefaultContext()
        self._context = self._plant.GetMyMutableContextFromRoot(self._root)
        self._clearance = robot.description.collision.padding if clearance is None else clearance
        self._panel_depth = marker.panel_depth
        self._arms = robot.slots([name for side in SIDES for name in robot.arms[side].names])
        self._posture = robot.slots(robot.posture.names)
        self._rest = robot.rest(robot.opening if opening is None else opening)
        self.ignored: set[tuple[str, str]] = set()
        if robot.description.collision.ignore:
            self._ignore(self._near(None, robot.home))

    def _ignore(self, pairs: list[SignedDistancePair]) -> None:
        """These pairs of shapes may touch from now on."""
        inspector = self._scene_graph.model_inspector()

        def link(shape: GeometryId) -> str:
            body = self._plant.GetBodyFromFrameId(inspector.GetFrameId(shape))
            name: str = body.name()
            return name

        self.ignored = {(link(pair.id_A), link(pair.id_B)) for pair in pairs}
        filters = self._scene_graph.collision_filter_manager(self._scene_graph.GetMyMutableContextFromRoot(self._root))
        for pair in pairs:
            both = GeometrySet(pair.id_A), GeometrySet(pair.id_B)
            filters.Apply(CollisionFilterDeclaration().ExcludeBetween(*both))

    def _pose(self, X_BV: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None) -> QueryObject:
        """Poses the model and returns the geometry query for it."""
        plant, context = self._plant, self._context
        positions = self._rest.copy()
        positions[self._arms] = q
        if posture is not None and len(posture):
            positions[self._posture] = posture
        plant.SetPositions(context, positions)
        X_BP = FAR if X_BV is None else compose(X_BV, make(np.eye(3), np.array([0, 0, self._panel_depth])))
        frame = plant.GetFrameByName("valve_axis", self._valve)
        X_PLink = frame.GetFixedPoseInBodyFrame().inverse()
        X = RigidTransform(RotationMatrix.ProjectToRotationMatrix(X_BP[:, :3]), X_BP[:, 3]) @ X_PLink
        plant.SetFreeBodyPose(context, frame.body(), X)
        return self._scene_graph.get_query_output_port().Eval(self._scene_graph.GetMyContextFromRoot(self._root))

    def is_free(self, X_BV: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None = None) -> bool:
        """True if no two bodies are nearer than the clearance.

        X_BV: marker in the base (None: no valve); q: both arms; posture: lift and waist (None or empty: at home).
        """
        return len(self._near(X_BV, q, posture)) == 0

    def touching(self, X_BV: np.ndarray | None, q: np.ndarray) -> list[str]:
        """Names of the pairs that are nearer than the clearance, for messages."""
        name = self._scene_graph.model_inspector().GetName
        pairs = self._near(X_BV, q)
        return [f"{name(p.id_A)} - {name(p.id_B)}: {1e3 * p.distance:.0f} mm" for p in pairs]

    def _near(
        self, X_BV: np.ndarray | None, q: np.ndarray, posture: np.ndarray | None = None
    ) -> list[SignedDistancePair]:
        """All pairs of shapes that are nearer than the clearance."""
        pairs: list[SignedDistancePair] = self._pose(X_BV, q, posture).ComputeSignedDistancePairwiseClosestPoints(
            self._clearance
        )
        return pairs
