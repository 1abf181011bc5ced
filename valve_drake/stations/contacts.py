"""What touches what in the simulated plant: whether both pads of a hand hold the valve, and what touches besides.

A hand holds by its pads (`grippers.SIDE.pads` of robot.yaml) on the valve's moving part. Its other fingers may touch
that part, too, and fingers each other: they neither hold nor collide. Every other contact of the robot is a collision,
also one with itself.
"""

from collections.abc import Iterable

import numpy as np
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, Joint, ModelInstanceIndex, RevoluteJoint
from pydrake.systems.framework import Context

from valve_drake.frames import cross
from valve_drake.messages import SIDES, Contacts
from valve_drake.robot.robot import Robot

EVERY = 8  # ticks between two looks, 1/16 s: a touch may be shorter, but twice as many cost 1 % of a run
MOST = 8  # pairs of bodies that are named at a time, the hardest ones; raise it if a robot falls into a heap
SIZE = 7 + 3 * MOST  # of what `ContactReader.look` gives
NOTHING = np.zeros(SIZE)
NONE = Contacts()

# Where a contact counts: at one of the four pads (left first), at the rest of the left or of the right arm, nowhere.
_ARM, _NOWHERE = 4, 6
_Kind = tuple[int, float, tuple[int, int] | None]
_ONE_OF = np.eye(_NOWHERE + 1)
_OF_HAND = np.array([[1.0, 1, 0, 0, 1, 0, 0], [0, 0, 1, 1, 0, 1, 0]])


class ContactReader:
    """Makes `Contacts` of the contact results of a plant that holds the robot and the valve."""

    def __init__(self, plant: MultibodyPlant, robot_model: ModelInstanceIndex, valve: ModelInstanceIndex, robot: Robot):
        """The plant is finalized, and both grippers are open in its default Context."""
        stem = plant.GetJointByName("stem", valve)
        assert isinstance(stem, RevoluteJoint)
        self._stem = stem
        self._wheel = _carried(plant, [stem])
        self._ours = {int(index) for index in plant.GetBodyIndices(robot_model)}
        self._names = [plant.get_body(BodyIndex(k)).name() for k in range(plant.num_bodies())]
        self._place: dict[int, int] = {}  # body of an arm or of its hand -> where its contacts with the wheel count
        self._fingers: set[int] = set()
        self._grips: list[Frame] = []  # of each side; y closes
        self._first: list[float] = []  # on which side of the grip's y = 0 the first pad is
        self._kinds: dict[tuple[int, int], _Kind] = {}  # of pairs that have met
        context = plant.CreateDefaultContext()
        for k, side in enumerate(SIDES):
            arm = [plant.GetJointByName(name, robot_model) for name in robot.arms[side].names]
            hand = _carried(plant, arm[-1:])
            joints = [plant.get_joint(index) for index in plant.GetJointIndices(robot_model)]
            inner = [j for j in joints if int(j.child_body().index()) in hand and j.index() != arm[-1].index()]
            self._fingers |= _carried(plant, inner)
            pads = [plant.GetFrameByName(name, robot_model) for name in robot.description.gripper(side).pads]
            self._place |= dict.fromkeys(_carried(plant, arm[:1]), _ARM + k)
            self._place |= {int(pad.body().index()): 2 * k + which for which, pad in enumerate(pads)}
            self._grips.append(plant.GetFrameByName(f"{side}_grip", robot_model))
            at = np.array(robot.description.pad.at)
            self._first.append(float(np.sign(plant.CalcPointsPositions(context, pads[0], at, self._grips[k])[1, 0])))

    def look(self, results: ContactResults, context: Context) -> np.ndarray:
        """The contacts in `results`, of the plant in `context`, in numbers (SIZE,): pads, slips, internal force; then
        of each pair its two bodies and the force. `message` says what they are."""
        places, signs, contacts = [], [], []
        touching: dict[tuple[int, int], np.ndarray] = {}
        for k in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(k)
            pair = int(contact.bodyA_index()), int(contact.bodyB_index())
            place, sign, collision = self._kinds.get(pair) or self._kind(*pair)
            if collision:
                touching[collision] = touching.get(collision, np.zeros(3)) + sign * contact.contact_force()
            if place != _NOWHERE:
                places.append(place)
                signs.append(sign)
                contacts.append(contact)
        if not touching and not contacts:
            return NOTHING
        found = np.zeros(SIZE)
        if contacts:
            forces = np.array([contact.contact_force() for contact in contacts]) * np.array(signs)[:, None]  # on it [N]
            points = np.array([contact.contact_point() for contact in contacts])
            speeds = np.array([contact.slip_speed() for contact in contacts])
            sizes = np.sqrt(np.einsum("ij,ij->i", forces, forces))
            rows = np.column_stack([forces, cross(points, forces), sizes[:, None] * points, sizes, sizes * speeds])
            sums = _ONE_OF[:, places] @ rows  # by place
            for k, grip in enumerate(self._grips):
                pads = sums[2 * k : 2 * k + 2]
                if pads[:, 9].any():
                    y = grip.CalcPoseInWorld(context).rotation().col(1)
                    found[2 * k : 2 * k + 2] = self._first[k] * np.array([-1.0, 1.0]) * (pads[:, :3] @ y)
                    found[4 + k] = pads[:, 10].sum() / (pads[:, 9].sum() + 1e-9)
            found[6] = self._internal(_OF_HAND @ sums, context)
        others = sorted(
            ((*pair, float(np.linalg.norm(force))) for pair, force in touching.items()), key=lambda t: -t[2]
        )
        found[7 : 7 + 3 * len(others[:MOST])] = np.ravel(others[:MOST])
        return found

    def message(self, found: np.ndarray, time: float, before: Contacts) -> Contacts:
        """What `look` has found; `before`, the last message, if it is nothing again."""
        if not found.any():
            return before if _is_none(before) else Contacts(time=time)
        pairs = [row for row in found[7:].reshape(MOST, 3) if row[0] > 0]  # the world, body 0, is never the first
        return Contacts(
            time=time,
            left_pads=found[0:2],
            right_pads=found[2:4],
            left_slip=float(found[4]),
            right_slip=float(found[5]),
            internal_force=float(found[6]),
            touching=tuple(f"{self._names[int(a)]}, {self._names[int(b)]}" for a, b, _ in pairs),
            forces=np.array([force for _, _, force in pairs]),
        )

    def _kind(self, a: int, b: int) -> _Kind:
        """Of a contact of two bodies: where it counts; 1 if its force is on the second of them when the robot's is
        named first and the valve's moving part last, else -1; both in that order if it is a collision."""

        def rank(body: int) -> tuple[bool, bool, int]:
            return body in self._wheel, body not in self._ours, body

        first, second = sorted((a, b), key=rank)
        place = self._place.get(first, _NOWHERE) if second in self._wheel else _NOWHERE
        meant = place < _ARM or (place != _NOWHERE and first in self._fingers)
        meant |= {first, second} <= self._fingers  # of a hand that closes on nothing
        collision = None if meant or first not in self._ours else (first, second)
        kind = self._kinds[a, b] = (place, 1.0 if first == a else -1.0, collision)
        return kind

    def _internal(self, hands: np.ndarray, context: Context) -> float:
        """The largest part of a hand's force that does not turn the valve [N].

        hands: of each, the sums over its contacts of force, moment about W, force's size times place, size (2, 11).

        What turns it is the least set of forces at the hands that has all hands' moment about the axis. The rest, which
        the hands bear between them or by way of the stem, is internal: it moves nothing.
        """
        X_WJ = self._stem.frame_on_parent().CalcPoseInWorld(context)
        axis, origin = X_WJ.rotation().multiply(self._stem.revolute_axis()), X_WJ.translation()
        hands = hands[hands[:, 9] > 0]
        forces = hands[:, :3]
        moment = float(((hands[:, 3:6] - cross(np.tile(origin, (len(hands), 1)), forces)) @ axis).sum())
        ways = cross(np.tile(axis, (len(hands), 1)), hands[:, 6:9] / hands[:, 9:10] - origin)  # per turn [m/rad]
        square = float((ways**2).sum())
        rest = forces - (moment / square if square > 0 else 0.0) * ways
        return float(np.sqrt((rest**2).sum(axis=1).max(initial=0.0)))


def _is_none(contacts: Contacts) -> bool:
    return not (contacts.touching or contacts.internal_force or contacts.left_pads.any() or contacts.right_pads.any())


def _carried(plant: MultibodyPlant, joints: Iterable[Joint]) -> set[int]:
    """The bodies that move with any of these joints; those that are fast carry none."""
    moving = [joint.index() for joint in joints if joint.num_velocities()]
    return {int(index) for index in plant.GetBodiesKinematicallyAffectedBy(moving)} if moving else set()
