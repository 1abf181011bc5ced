"""What hybrid_rotation can be told."""

import dataclasses as dc

from valve_drake.checks import require
from valve_drake.config import Config, number


@dc.dataclass
class HybridRotationConfig(Config):
    """Scenario key `hybrid_rotation`."""

    KEY = "hybrid_rotation"
    damping: float = number(
        4000.0,
        500.0,
        20000.0,
        "D of each hand, stable with 20 ms of delay each way; higher: larger forces, lower: it oscillates [N s/m]",
    )
    angular_damping: float = number(256.0, 16.0, 2000.0, "the same for rotations [N m s/rad]")
    filter: float = number(
        10.0, 1.0, 60.0, "low-pass of the wrenches; lower it for a noisy sensor, which also slows the reaction [Hz]"
    )
    rate: float = number(0.105, 0.005, 0.5, "of the turn, at most [rad/s]")
    ramp: float = number(0.5, 0.05, 5.0, "time from rest to full rate, and back [s]")
    slow: float = number(0.006, 5e-4, 0.1, "least rate near the goal [rad/s]")
    torque_limit: float = number(
        14.0, 1.0, 16.0, "on the valve; the rate falls to zero over its last 30 %; raise it for a stiff valve [N m]"
    )
    gentle: float = number(
        0.86, 0.1, 1.0, "share of torque_limit until the turn has stalled once; 1: all of it from the beginning"
    )
    lead_limit: float = number(0.05, 0.005, 0.2, "commanded minus measured angle, at most [rad]")
    force_trip: float = number(55.0, 10.0, 55.0, "force on one hand that ends the turn [N]")
    squeeze: float = number(0.0, 0.0, 30.0, "internal force along the bar, positive compresses it [N]")
    tolerance: float = number(0.001, 1e-4, 0.05, "of the turned angle as the hands measure it [rad]")
    stall_time: float = number(2.0, 0.2, 30.0, "without progress, then it is a stall [s]")
    stall_angle: float = number(0.01, 0.001, 0.2, "that counts as progress [rad]")
    back_off: float = number(
        0.07, 0.005, 0.5, "turned the other way after a stall, to tell a stop from a stuck valve [rad]"
    )
    grip_force: float = number(70.0, 5.0, 100.0, "of the finger actuator [N]")
    grip_margin: float = number(0.005, 5e-4, 0.02, "a grasp is an opening within this of the handle's width [m]")
    tug_force: float = number(8.0, 1.0, 30.0, "pull on each hand that proves the grasp [N]")
    tug_speed: float = number(0.006, 0.001, 0.02, "pulls a hand with at most this times `damping` [m/s]")
    tug_reach: float = number(0.012, 0.002, 0.05, "a hand that moves farther without force has missed the handle [m]")
    close_time: float = number(4.0, 0.5, 30.0, "deadline for closing [s]")
    relax: float = number(
        0.6, 0.05, 10.0, "the hands yield for this long before they open, until the forces have decayed [s]"
    )
    open_force: float = number(40.0, 5.0, 100.0, "of the finger actuator while opening [N]")
    retreat: float = number(0.12, 0.02, 0.3, "hands drawn back after opening [m]")
    retreat_speed: float = number(0.10, 0.01, 0.3, "[m/s]")
    tare_time: float = number(0.2, 0.02, 2.0, "time constant of zeroing the wrist sensors at the stand-off [s]")

    def relations(self, key: str) -> None:
        require(self.slow <= self.rate, f"{key}.slow", f"at most rate, {self.rate:g}", self.slow)
        highest = self.force_trip / self.damping
        gentle = self.tug_speed <= highest
        require(gentle, f"{key}.tug_speed", f"at most force_trip / damping, {highest:.3g}", self.tug_speed)
