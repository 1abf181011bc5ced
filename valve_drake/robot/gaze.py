"""How a robot's torso turns its eyes: the gaze, and the joints that make it."""

import dataclasses as dc

import numpy as np


@dc.dataclass(frozen=True, eq=False)
class Gaze:
    """The gaze is waist, tilt and pan: positive to the left, down, to the left (3,) [rad]. What a robot lacks is 0.

    joints: which of the torso's joints they are; None: there is none. Lift and waist come first, tilt and pan last.
    rest: the torso at home (n,). signs: 1 for a joint that grows as the gaze does, else -1 (3,).
    """

    joints: tuple[int | None, int | None, int | None]
    rest: np.ndarray
    signs: np.ndarray = dc.field(default_factory=lambda: np.ones(3))

    @property
    def held(self) -> int:
        """How many of the torso's joints are lift and waist."""
        return len(self.rest) - sum(joint is not None for joint in self.joints[1:])

    @property
    def plain(self) -> bool:
        """Whether the torso is the gaze."""
        return self.joints == (0, 1, 2) and len(self.rest) == 3 and bool((self.signs > 0).all())

    def of(self, torso: np.ndarray) -> np.ndarray:
        """The gaze of the torso's joints (n,) -> (3,)."""
        found: np.ndarray = self.signs * [0.0 if joint is None else torso[joint] for joint in self.joints]
        return found

    def torso(self, gaze: np.ndarray, posture: np.ndarray | None = None) -> np.ndarray:
        """The torso's joints for a gaze (3,) -> (n,). posture: lift and waist, of which the lift counts; None: home."""
        torso, turned = self.rest.copy(), self.signs * gaze
        if posture is not None:
            torso[: len(posture)] = posture
        for joint, angle in zip(self.joints, turned):
            if joint is not None:
                torso[joint] = angle
        return torso
