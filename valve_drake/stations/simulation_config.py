"""Scenario key `simulation`: everything about the simulated world, each number fixed or drawn from the seed."""

import dataclasses as dc
import typing

from valve_drake.checks import require, require_in


@dc.dataclass
class Uniform:
    """A number drawn evenly from [min, max]; in YAML `!Uniform {min: 0.81, max: 1.22}`."""

    min: float = 0.0
    max: float = 0.0


Number = typing.Union[float, Uniform]


@dc.dataclass
class ValveConfig:
    """Where the valve is and how it turns."""

    height: Number = 1.0  # of the axis over the floor [m]
    yaw: Number = 0.0  # of the panel [rad]
    tilt: Number = 0.0  # of the panel, positive leans away from the robot at its top [rad]
    bar_angle: Number = 0.0  # of the bar with the valve closed, from level, counter-clockwise for the robot [rad]
    friction: Number = 5.1  # Coulomb, break-away and running [N m]
    travel: float = 1.5708  # between the end stops [rad]
    stop_play: float = 0.035  # how far beyond closed and open the stops are [rad]
    position: Number = -1.0  # opened so far at the start [rad]; -1: where the command has its work to do
    seized: bool = False  # does not turn at all


@dc.dataclass
class StartConfig:
    """Where the robot starts."""

    distance: Number = 3.0  # base to valve, along the floor [m]
    bearing: Number = 0.0  # of the robot, seen from the valve, off the panel's normal [rad]
    heading: Number = 0.0  # of the robot, off the direction to the valve [rad]


@dc.dataclass
class LightConfig:
    """Light and the cameras' colour."""

    intensity: Number = 1.0  # of the lamps
    azimuth: Number = 0.6  # of the main lamp [rad]
    fill: float = 0.0  # two more lamps of this intensity, for pictures
    red_gain: Number = 1.0  # white balance
    blue_gain: Number = 1.0


@dc.dataclass
class CameraConfig:
    """The cameras behind the lens."""

    noise: Number = 2.0  # standard deviation of a pixel [grey levels]
    blur: Number = 0.5  # standard deviation of the optical blur [px]
    head_period: float = 0.125  # [s]
    wrist_period: float = 0.0625
    latency: float = 0.0625  # from the capture to the image being there: exposure, compression, wire [s]
    wrist_focal: Number = 480.0  # [px]
    jpeg_quality: int = 95
    supersample: int = 1  # 2: rendered at twice the size and averaged


@dc.dataclass
class ErrorConfig:
    """How far the machine is from its own data sheet. Standard deviations unless stated."""

    head_yaw: float = 0.0002  # right head camera against the calibration, relative yaw [rad]
    head_rotation: float = 0.0003  # other rotations of the head cameras [rad]
    head_mount: float = 0.002  # of the head on the neck, rotation [rad]
    odometry_scale: float = 0.01  # of distance and of angle
    odometry_noise: float = 0.002  # of the measured speeds, relative
    wrench_noise_force: float = 0.5  # [N]
    wrench_noise_torque: float = 0.02  # [N m]
    wrench_bias_force: float = 2.0  # [N]
    wrench_bias_torque: float = 0.1  # [N m]
    arm_offset: float = 0.001  # of each arm joint's zero [rad]


@dc.dataclass
class SimulationConfig:
    valve: ValveConfig = dc.field(default_factory=ValveConfig)
    start: StartConfig = dc.field(default_factory=StartConfig)
    light: LightConfig = dc.field(default_factory=LightConfig)
    camera: CameraConfig = dc.field(default_factory=CameraConfig)
    error: ErrorConfig = dc.field(default_factory=ErrorConfig)

    def check(self) -> None:
        """Raises ConfigError on the first value out of range. Distributions are checked at both ends."""
        ranges = {
            "valve.height": (0.5, 1.6),
            "valve.yaw": (-1.0, 1.0),
            "valve.tilt": (-0.4, 0.4),
            "valve.bar_angle": (-0.8, 0.8),
            "valve.friction": (0.0, 30.0),
            "valve.travel": (0.1, 20.0),
            "valve.stop_play": (0.0, 0.5),
            "valve.position": (-1.0, 20.0),
            "start.distance": (0.9, 8.0),
            "start.bearing": (-1.4, 1.4),
            "start.heading": (-3.1416, 3.1416),
            "light.intensity": (0.1, 3.0),
            "light.azimuth": (-3.1416, 3.1416),
            "light.fill": (0.0, 1.0),
            "light.red_gain": (0.3, 2.0),
            "light.blue_gain": (0.3, 2.0),
            "camera.noise": (0.0, 20.0),
            "camera.blur": (0.0, 5.0),
            "camera.head_period": (1 / 32, 2.0),
            "camera.wrist_period": (1 / 32, 2.0),
            "camera.latency": (0.0, 0.5),
            "camera.wrist_focal": (200.0, 900.0),
            "camera.jpeg_quality": (50, 100),
            "camera.supersample": (1, 4),
            **{f"error.{field.name}": (0.0, 10.0) for field in dc.fields(ErrorConfig)},
        }
        for key, (low, high) in ranges.items():
            group, name = key.split(".")
            value = getattr(getattr(self, group), name)
            ends = (value.min, value.max) if isinstance(value, Uniform) else (value,)
            for end in ends:
                require_in(end, low, high, f"simulation.{key}")
            if isinstance(value, Uniform):
                require(value.min <= value.max, f"simulation.{key}", "a range with min <= max", (value.min, value.max))
        for key in ("head_period", "wrist_period", "latency"):
            ticks = getattr(self.camera, key) * 128
            require(ticks == int(ticks), f"simulation.camera.{key}", "a multiple of 1/128 s", getattr(self.camera, key))
