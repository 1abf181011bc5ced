"""Settings of the search for a stance and for grasps."""

import dataclasses as dc

import numpy as np

from valve_drake.checks import require
from valve_drake.config import Config, number

MAX_PLACES = 40  # distances of one search for a stance: it must end while the robot waits


@dc.dataclass
class StanceConfig(Config):
    """Scenario key `stance`: which places to stand at are tried."""

    KEY = "stance"
    distance_min: float = number(0.0, 0.0, 3.0, "least distance that is tried, base to panel; 0: the robot's [m]")
    distance_max: float = number(0.0, 0.0, 3.0, "largest distance that is tried; 0: the robot's [m]")
    distance_step: float = number(0.02, 0.005, 0.2, "between two distances; halving it doubles the search [m]")
    aside: float = number(0.12, 0.0, 0.5, "to either side that is tried where straight before the valve fails [m]")
    lift_step: float = number(0.08, 0.01, 1.0, "between two heights of a lift that are tried [m]")
    standoff: float = number(
        0.12, 0.02, 0.3, "hands start and end this far from the grasp, along the wrist camera's view [m]"
    )
    arc_step: float = number(
        0.27, 0.1, 1.0, "between two angles of the turn that are checked; halving it doubles the search [rad]"
    )
    arc_least: float = number(0.4, 0.1, 3.0, "a grasp that turns less is no use, unless that is all that is left [rad]")
    margin_enough: float = number(0.9, 0.01, 1.0, "the search ends at the first stance with this arm margin")
    margin_good: float = number(0.5, 0.01, 1.0, "with a stance of this arm margin nothing less simple is tried")
    margin_min: float = number(0.15, 0.01, 1.0, "least arm margin that is accepted (1 is comfortable)")

    def relations(self, key: str) -> None:
        for name in ("distance_min", "distance_max"):
            value = getattr(self, name)
            require(value == 0 or value >= 0.3, f"{key}.{name}", "0 (the robot's) or at least 0.3", value)

    def distances(self, stand: tuple[float, float]) -> np.ndarray:
        """What is tried, from near to far (K,) [m]. stand: the robot's. Raises ConfigError: none, or too many.

        A robot whose arms reach far has too many by the default step: then it is a wider one.
        """
        low, high = self.distance_min or stand[0], self.distance_max or stand[1]
        require(low <= high, f"{self.KEY}.distance_min", f"at most the largest distance, {high:g}", low)
        least, step = (high - low) / (MAX_PLACES - 1), self.distance_step
        few = high - low <= (MAX_PLACES - 1) * step
        if not few and step == StanceConfig.distance_step:
            return np.linspace(low, high, MAX_PLACES)
        require(few, f"{self.KEY}.distance_step", f"at least {least:.3g}: {MAX_PLACES} distances", step)
        return np.arange(low, high + 1e-9, step)
