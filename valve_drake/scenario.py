"""The scenario: one group of keys for every block, and the world around it. Load, check, override, sample.

A scenario file is YAML with this file's names; what it leaves out has its default. Numbers of the simulated world
may be distributions (`!Uniform {min: 0.81, max: 1.22}`): `resolve` draws them from the seed, each from a stream of its
own name, so that a new key changes no other number. `valve-drake scenario` prints every key with its bounds.
"""

import dataclasses as dc
import re
import typing
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from valve_drake import config, resources, yaml_file
from valve_drake.behaviors.base_approach import BaseApproachConfig
from valve_drake.behaviors.hybrid_rotation_config import HybridRotationConfig
from valve_drake.behaviors.image_servo import ImageServoConfig
from valve_drake.behaviors.kinematic_approach import KinematicApproachConfig
from valve_drake.behaviors.stance_config import StanceConfig
from valve_drake.behaviors.stance_planner import StancePlannerConfig
from valve_drake.behaviors.valve_search import ValveSearchConfig
from valve_drake.checks import ConfigError, require, shown
from valve_drake.config import Config, Uniform, choice, number, plain
from valve_drake.operator.operator_channel import OperatorChannelConfig
from valve_drake.perception.color_segmentation import ColorSegmentationConfig
from valve_drake.perception.handle_marker import HandleMarkerConfig
from valve_drake.perception.line_fitting import LineFittingConfig
from valve_drake.perception.matching import StereoPositioningConfig
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig
from valve_drake.stations.faults import FaultConfig
from valve_drake.stations.lcm_channels import HardwareConfig
from valve_drake.stations.simulation_config import SimulationConfig
from valve_drake.supervisor.command_selector import CommandSelectorConfig
from valve_drake.supervisor.supervisor import SupervisorConfig
from valve_drake.valve.valve import Valve

DEFAULT = "simulated.scenario.yaml"
LEVELS, ENDING = "levels", ".scenario.yaml"  # in diagrams/; of scenarios' files
# Keys of older versions: a log that has them can still be replayed.
RETIRED = (
    "base_approach.panel_behind",
    "base_approach.arms_still",
    "base_approach.arms_wait",
    "base_approach.arms_patience",
    *(
        f"command_selector.{name}"
        for name in ("arm_limit", "arm_speed", "arm_acceleration", "torso_low", "torso_high", "torso_speed")
    ),
    "command_selector.torso_acceleration",
    "color_segmentation.every",
    "handle_marker.every",
    "handle_marker.lines.single_camera",
    "hybrid_rotation.opening",
    *(
        f"marker.{name}"
        for name in ("size", "handle_radius", "mark_depth", "handle_depth", "panel_depth", "handle_width")
    ),
    "image_servo.opening",
    "kinematic_approach.home",
    "kinematic_approach.opening",
    "kinematic_approach.stance_period",
    *(
        f"handle_marker.segmentation.{name}"
        for name in ("min_opponent", "min_green_area", "min_fill", "border", "follow", "full_every", "every")
    ),
)
STATIONS = ("simulated", "hardware", "replay")


@dc.dataclass
class Scenario(Config):
    """Everything that a run depends on."""

    seed: int = number(0, 0, 2**31 - 1, "of all random numbers")
    station: str = choice("simulated", STATIONS, "the robot that the blocks are wired to")
    command: str = choice("open", ("open", "close"), "what to do with the valve")
    angle: float = number(1.5707963267948966, 0.01, 12.6, "to turn [rad]")
    time_limit: float = number(240.0, 0.1, 3600.0, "of the whole run; operators end theirs themselves [s]")
    robot: str = plain("robot/robot.yaml", "a path, one below models/, or a package:// URL")
    head_calibration: str = plain("", "in the place of the robot's: a path, or one below models/")
    taught: str = plain("", "in the place of the robot's: a path, or one below models/")
    valve: Valve = dc.field(default_factory=Valve)
    color_segmentation: ColorSegmentationConfig = dc.field(default_factory=ColorSegmentationConfig)
    line_fitting: LineFittingConfig = dc.field(default_factory=LineFittingConfig)
    stereo_positioning: StereoPositioningConfig = dc.field(default_factory=StereoPositioningConfig)
    rectangle_estimator: RectangleEstimatorConfig = dc.field(default_factory=RectangleEstimatorConfig)
    handle_marker: HandleMarkerConfig = dc.field(default_factory=HandleMarkerConfig)
    valve_search: ValveSearchConfig = dc.field(default_factory=ValveSearchConfig)
    base_approach: BaseApproachConfig = dc.field(default_factory=BaseApproachConfig)
    stance: StanceConfig = dc.field(default_factory=StanceConfig)
    stance_planner: StancePlannerConfig = dc.field(default_factory=StancePlannerConfig)
    kinematic_approach: KinematicApproachConfig = dc.field(default_factory=KinematicApproachConfig)
    image_servo: ImageServoConfig = dc.field(default_factory=ImageServoConfig)
    hybrid_rotation: HybridRotationConfig = dc.field(default_factory=HybridRotationConfig)
    supervisor: SupervisorConfig = dc.field(default_factory=SupervisorConfig)
    command_selector: CommandSelectorConfig = dc.field(default_factory=CommandSelectorConfig)
    operator_channel: OperatorChannelConfig = dc.field(default_factory=OperatorChannelConfig)
    simulation: SimulationConfig = dc.field(default_factory=SimulationConfig)
    hardware: HardwareConfig = dc.field(default_factory=HardwareConfig)
    faults: list[FaultConfig] = dc.field(
        default_factory=list, metadata=config.about("that the twin simulates (valve_drake/stations/faults.py)")
    )

    def relations(self, key: str) -> None:
        """What the blocks have to agree on."""
        limit = self.supervisor.angle_limit
        require(self.angle <= limit, "angle", f"at most supervisor.angle_limit, {limit:g}", self.angle)
        selector = self.command_selector
        for name in ("kinematic_approach.gripper_force", "image_servo.gripper_force", "hybrid_rotation.grip_force",
                     "hybrid_rotation.open_force"):  # fmt: skip
            block, _, force = name.partition(".")
            most, value = selector.gripper_force, getattr(getattr(self, block), force)
            require(value <= most, name, f"at most command_selector.gripper_force, {most:g}", value)


def former_names() -> dict[str, str]:
    """Keys that were renamed: the old key of a log's scenario -> the key of today."""
    kinds = [type(value) for value in vars(Scenario()).values() if isinstance(value, Config)]
    return {f"{kind.KEY}.{old}": f"{kind.KEY}.{new}" for kind in kinds for old, new in kind.FORMER.items()}


def load(path: str | None = None, overrides: typing.Sequence[str] = ()) -> Scenario:
    """The scenario of a file (a path, or a name in diagrams/; None: the default one) with `key=value` overrides.

    A name needs neither its folder `levels` nor its ending. A file that begins `like: FILE` states only what differs
    from that one. Raises ConfigError: no such file, not YAML, unknown key, wrong type, value out of range.
    """
    return with_overrides(_load(DEFAULT if path is None else path, 0), overrides)


def _load(name: str, depth: int) -> Scenario:
    file = _find(name)
    given = yaml_file.parse(yaml_file.read_text(file, file.name), file.name, TAGS)
    base = Scenario()
    if isinstance(given, dict) and "like" in given:
        like = given.pop("like")
        if not isinstance(like, str) or depth == 3:
            raise ConfigError(f"{file.name}: like must be the name of a scenario, at most 3 deep, got {shown(like)}")
        base = _load(like, depth + 1)
    return config.build(base, {} if given is None else given, file.name)


def _find(name: str) -> Path:
    """A path as it is; a plain name may lack its folder or ending. Raises ConfigError."""
    folder = resources.diagrams()
    if re.fullmatch(r"[\w.-]{1,80}", name, re.ASCII) and not Path(name).is_file():
        for inner in (folder / f"{name}{ENDING}", folder / LEVELS / name, folder / LEVELS / f"{name}{ENDING}"):
            if inner.is_file():
                return inner
    return resources.find(name, folder)


def with_overrides(scenario: Scenario, overrides: typing.Sequence[str]) -> Scenario:
    """The scenario with `key=value` overrides, checked. Raises ConfigError as `load` does."""
    for override in overrides:
        key, value = split_override(override)
        given = yaml_file.parse(value, f"--set {key}", TAGS)
        for name in reversed(key.split(".")):
            given = {name: given}
        scenario = config.build(scenario, given, "--set")
    scenario.check()
    return scenario


def split_override(override: str) -> tuple[str, str]:
    """`key=value` -> key, value. Raises ConfigError."""
    key, equals, value = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ConfigError(f"--set must be key=value, e.g. simulation.valve.friction=7.3, got {shown(override)}")
    return key, value


TAGS: yaml_file.Tags = {config.UNIFORM: lambda given: yaml_file.Tagged(config.UNIFORM, given)}


def parse(text: str, source: str, defaults: Scenario | None = None, unknown: list[str] | None = None) -> Scenario:
    """A scenario from YAML text on top of `defaults`; `source` is named in errors.

    unknown: gets the names of keys that this program does not have; None: they are refused. Bounds are not checked.
    """
    scenario = Scenario() if defaults is None else defaults
    given = yaml_file.parse(text, source, TAGS)
    if unknown is not None and isinstance(given, dict):
        given = _of_today(given)
    return config.build(scenario, {} if given is None else given, source, unknown)


def _of_today(given: dict[str, Any]) -> dict[str, Any]:
    """A log's scenario from when the marker stood on its own: its size, the one key of it that could be changed."""
    marker = given.get("marker")
    if "valve" in given or not isinstance(marker, dict) or "size" not in marker:
        return given
    rest = {name: value for name, value in given.items() if name != "marker"}
    return rest | {"valve": {"marker": {"size": marker["size"]}}}


def dump(scenario: Scenario) -> str:
    """All values, defaults included, as YAML that `load` reads."""
    return yaml_file.dump(config.tree(scenario))


def resolve(scenario: Scenario) -> Scenario:
    """Every distribution replaced by a number drawn from the seed; the valve's start set for the command."""

    def draw(key: str, value: Any) -> Any:
        if isinstance(value, Uniform):
            stream = np.random.Generator(np.random.SFC64([scenario.seed, zlib.crc32(key.encode())]))
            return float(stream.uniform(value.min, value.max))
        if dc.is_dataclass(value) and not isinstance(value, type):
            return dc.replace(
                value, **{f.name: draw(f"{key}.{f.name}", getattr(value, f.name)) for f in dc.fields(value)}
            )
        return value

    out = dc.replace(scenario, simulation=draw("simulation", scenario.simulation))
    valve = out.simulation.valve
    if valve.position < 0:
        valve.position = valve.travel if scenario.command == "close" else 0.0
    return out
