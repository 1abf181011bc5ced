"""The joints that are commanded by position, by group: what sizes and names follow from."""

import dataclasses as dc

GROUPS = ("torso", "left_arm", "right_arm")


@dc.dataclass(frozen=True)
class Groups:
    """Names of a robot's joints, as in its model, in the order of every vector of the group.

    torso: lift and waist, if there are, then the head's tilt and pan; arms: from the shoulder on.
    """

    torso: tuple[str, ...]
    left_arm: tuple[str, ...]
    right_arm: tuple[str, ...]

    def names(self, group: str) -> tuple[str, ...]:
        """Of one of GROUPS."""
        joints: tuple[str, ...] = getattr(self, group)
        return joints

    def size(self, kind: int | str) -> int:
        """Of a vector: a number as it is, or how many joints a group has."""
        return kind if isinstance(kind, int) else len(self.names(kind))
