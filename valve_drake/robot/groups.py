"""The joints that are commanded by position, by group, and the base's speeds: what sizes and names follow from."""

import dataclasses as dc

from valve_drake.robot.drive import SPEEDS

GROUPS = ("torso", "left_arm", "right_arm")
POSE = ("x", "y", "heading")  # of the base, by its odometry [m, rad]


@dc.dataclass(frozen=True)
class Groups:
    """Names of a robot's joints, as in its model, in the order of every vector of the group.

    torso: lift and waist, then the head's tilt and pan, as far as there are; arms: from the shoulder on.
    twist: the speeds that the base has (drive.py). absent: devices of the contract that the robot does not have, whose
    ports no device speaks for.
    """

    torso: tuple[str, ...]
    left_arm: tuple[str, ...]
    right_arm: tuple[str, ...]
    twist: tuple[str, ...] = SPEEDS["differential"]
    absent: tuple[str, ...] = ()

    @property
    def odometry(self) -> tuple[str, ...]:
        """What the base's odometry tells."""
        return (*POSE, *self.twist)

    def names(self, group: str) -> tuple[str, ...]:
        """Of one of GROUPS, of `twist` or `odometry`."""
        names: tuple[str, ...] = getattr(self, group)
        return names

    def size(self, kind: int | str) -> int:
        """Of a vector: a number as it is, or how many names a group has."""
        return kind if isinstance(kind, int) else len(self.names(kind))
