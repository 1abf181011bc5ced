"""Settings of the block `rectangle_estimator`."""

import dataclasses as dc

from valve_drake.checks import require
from valve_drake.config import Config, choice, number

METHODS = ("refined", "paper")


@dc.dataclass
class RectangleEstimatorConfig(Config):
    """Scenario key `rectangle_estimator`."""

    KEY = "rectangle_estimator"
    method: str = choice("refined", METHODS, "of the pose")
    fine_step: str = choice(
        "paper", ("paper", "exact", "none"), "of method paper: paper = eq. (22), (23); exact = ray and plane"
    )
    loss: str = choice("tukey", ("tukey", "huber", "none"), "of the edge points' residuals")
    loss_width: float = number(4.7, 1.0, 1e6, "residual beyond which a point counts less [sigma]")
    min_sigma: float = number(0.01, 1e-6, 10.0, "an edge point is not believed better than this [px]")
    side_bias: float = number(0.003, 0.0, 10.0, "what all points of a side have in common: lens, plate, renderer [px]")
    yaw_sigma: float = number(
        0.0, 0.0, 0.2, "of the head cameras' relative yaw, then estimated as well; 0 = known [rad]"
    )
    square_tolerance: float = number(0.05, 0.0, 1.0, "sides that differ by less do not tell which is X [relative]")
    ambiguity_gate: float = number(
        9.0, 0.0, 1e6, "chi^2 by which the mirror image must be worse; below, the track decides"
    )
    max_residual: float = number(0.8, 1e-3, 100.0, "rms of the edge points about the fit [px]")
    epipolar_gate: float = number(
        4.0, 0.01, 100.0, "distance of the right centre from the left one's epipolar line that is allowed [px]"
    )
    size_gate: float = number(
        0.1, 1e-3, 10.0, "difference of distance by triangulation and by the fit that is allowed [relative]"
    )
    min_distance: float = number(0.25, 0.01, 100.0, "of a marker [m]")
    max_distance: float = number(6.0, 0.01, 100.0, "of a marker [m]")
    max_tilt: float = number(1.3, 0.1, 1.56, "of the marker against the line of sight [rad]")
    max_iterations: int = number(15, 1, 200, "of the refinement")
    track_timeout: float = number(3.0, 0.0, 3600.0, "the X axis is not followed over a longer gap [s]")

    def relations(self, key: str) -> None:
        ordered = self.min_distance <= self.max_distance
        require(ordered, f"{key}.max_distance", f"at least min_distance, {self.min_distance:g}", self.max_distance)
