"""Scenario key `simulation`: everything about the simulated world, each number fixed or drawn from the seed."""

import dataclasses as dc
import math

from valve_drake.checks import require
from valve_drake.config import Config, Number, choice, number, numbers, plain
from valve_drake.messages import HEAD, SIDES
from valve_drake.ports import TICK


@dc.dataclass
class ValveConfig(Config):
    """Where the valve is and how it turns."""

    KEY = "simulation.valve"
    height: Number = number(1.0, 0.5, 1.6, "of the axis over the floor [m]")
    yaw: Number = number(0.0, -1.0, 1.0, "of the panel [rad]")
    tilt: Number = number(
        0.0, -0.4, 1.5708, "of the panel; positive leans away from the robot at its top, 1.5708 is flat [rad]"
    )
    bar_angle: Number = number(
        0.0, -0.8, 0.8, "of the bar with the valve closed, from level, counter-clockwise for the robot [rad]"
    )
    friction: Number = number(5.1, 0.0, 30.0, "Coulomb, break-away and running [N m]")
    friction_open: Number = number(
        -1.0, -1.0, 30.0, "the same where it is open, rising evenly with the angle; -1: as closed [N m]"
    )
    travel: float = number(1.5708, 0.1, 20.0, "between the end stops [rad]")
    stop_play: float = number(0.035, 0.0, 0.5, "how far beyond closed and open the stops are [rad]")
    position: Number = number(
        -1.0, -1.0, 20.0, "opened so far at the start; -1: where the command has its work to do [rad]"
    )
    seized: bool = plain(False, "does not turn at all")
    pushed_at: Number = number(
        -1.0, -1.0, 8.0, "its stand is pushed aside once a hand is so near its axis; -1: never [m]"
    )
    pushed_by: Number = number(0.1, -0.3, 0.3, "so far; positive to the right as the robot sees it [m]")
    pushed_after: Number = number(0.0, 0.0, 60.0, "later by so long, in which it creeps by 4 mm [s]")
    covered_at: Number = number(
        -1.0, -1.0, 8.0, "the upper half of its marker is covered once a hand is so near its axis; -1: never [m]"
    )
    covered_for: Number = number(5.0, 0.1, 600.0, "for so long [s]")
    marker_place: list[float] = numbers(
        [0.0, 0.0], -0.05, 0.05, "where the marker really is, off its place along x and y of V [m]"
    )
    marker_tilt: list[float] = numbers([0.0, 0.0, 0.0], -0.2, 0.2, "how it really lies, about x, y, z of V [rad]")


@dc.dataclass
class StartConfig(Config):
    """Where the robot starts."""

    KEY = "simulation.start"
    distance: Number = number(3.0, 0.4, 8.0, "base to valve, along the floor [m]")
    bearing: Number = number(0.0, -1.4, 1.4, "of the robot, seen from the valve, off the panel's normal [rad]")
    heading: Number = number(0.0, -math.pi, math.pi, "of the robot, off the direction to the valve [rad]")
    at_valve: bool = plain(False, "instead: where the hands reach, both on the handles, as a lesson of `teach` begins")


@dc.dataclass
class LightConfig(Config):
    """Light and the cameras' colour."""

    KEY = "simulation.light"
    intensity: Number = number(1.0, 0.1, 3.0, "of the lamps")
    azimuth: Number = number(0.6, -math.pi, math.pi, "of the main lamp [rad]")
    fill: float = number(0.0, 0.0, 1.0, "two more lamps of this intensity, for pictures")
    off_at: Number = number(-1.0, -1.0, 600.0, "the lamps go out, and with them all light; -1: never [s]")
    off_for: float = number(3.0, 0.1, 60.0, "for so long [s]")
    red_gain: Number = number(1.0, 0.3, 2.0, "white balance")
    blue_gain: Number = number(1.0, 0.3, 2.0, "white balance")


@dc.dataclass
class CameraConfig(Config):
    """The cameras behind the lens."""

    KEY = "simulation.camera"
    noise: Number = number(2.0, 0.0, 20.0, "standard deviation of a pixel [grey levels]")
    blur: Number = number(
        0.5, 0.0, 5.0, "standard deviation of the optical blur; what the lens's map blurs, 0.4, is the least [px]"
    )
    head_period: float = number(0.125, 1 / 32, 2.0, "between two captures of a head camera [s]")
    wrist_period: float = number(0.0625, 1 / 32, 2.0, "between two captures of a wrist camera [s]")
    slowest_period: float = number(
        0.25, 1 / 32, 0.5, "to which a twin slows its cameras down when it cannot keep real time [s]"
    )
    latency: float = number(
        0.0625, 0.0, 0.5, "from the capture to the image being there: exposure, compression, wire [s]"
    )
    wrist_focal: Number = number(480.0, 200.0, 900.0, "[px]")
    jpeg_quality: int = number(95, 50, 100, "of JPEG")
    renderer: str = choice("egl", ("egl", "vtk"), "egl: this program's own (render_egl.py); vtk: Drake's, slower")
    supersample: int = number(2, 1, 4, "of egl: points a side of a pixel where edges are measured; vtk has four points")

    def relations(self, key: str) -> None:
        for name in ("head_period", "wrist_period", "latency"):
            ticks = getattr(self, name) / TICK
            require(ticks == int(ticks), f"{key}.{name}", "a multiple of 1/128 s", getattr(self, name))

    def period(self, camera: str) -> float:
        """Between two captures of a camera [s]."""
        return self.head_period if camera in HEAD else self.wrist_period


@dc.dataclass
class ErrorConfig(Config):
    """How far the machine is from its own data sheet. Standard deviations unless stated."""

    KEY = "simulation.error"
    head_yaw: float = number(0.0002, 0.0, 0.1, "right head camera against the calibration, relative yaw [rad]")
    head_rotation: float = number(0.0003, 0.0, 0.1, "other rotations of the head cameras [rad]")
    head_mount: float = number(0.002, 0.0, 0.1, "of the head on the neck, rotation [rad]")
    odometry_scale: float = number(0.01, 0.0, 0.5, "of distance and of angle")
    odometry_noise: float = number(0.002, 0.0, 0.5, "of the measured speeds, relative")
    wrench_noise_force: float = number(0.5, 0.0, 50.0, "[N]")
    wrench_noise_torque: float = number(0.02, 0.0, 5.0, "[N m]")
    wrench_bias_force: float = number(2.0, 0.0, 50.0, "[N]")
    wrench_bias_torque: float = number(0.1, 0.0, 5.0, "[N m]")
    arm_offset: float = number(0.001, 0.0, 0.1, "of each arm joint's encoder, against its true zero [rad]")


@dc.dataclass
class MishapConfig(Config):
    """What goes wrong in the middle of a run. -1: it does not."""

    KEY = "simulation.mishap"
    grip_lost_at: Number = number(-1.0, -1.0, 20.0, "the valve is so far from closed when a hand lets go [rad]")
    grip_lost_for: float = number(1.5, 0.1, 60.0, "until it obeys again [s]")
    grip_lost_hand: str = choice("left", SIDES, "that lets go")
    wheel_slip_at: Number = number(-1.0, -1.0, 600.0, "the base does not go as its wheels turn [s]")
    wheel_slip_for: float = number(1.0, 0.1, 60.0, "[s]")
    wheel_slip_share: float = number(0.5, 0.0, 0.9, "of their way that is lost")
    operator_stop_at: Number = number(-1.0, -1.0, 600.0, "the operator stops the run [s]")
    operator_go_after: float = number(3.0, 0.5, 60.0, "it has stopped, the operator gives the command again [s]")


@dc.dataclass
class SimulationConfig(Config):
    """Scenario key `simulation`."""

    KEY = "simulation"
    valve: ValveConfig = dc.field(default_factory=ValveConfig)
    start: StartConfig = dc.field(default_factory=StartConfig)
    light: LightConfig = dc.field(default_factory=LightConfig)
    camera: CameraConfig = dc.field(default_factory=CameraConfig)
    error: ErrorConfig = dc.field(default_factory=ErrorConfig)
    mishap: MishapConfig = dc.field(default_factory=MishapConfig)
