"""The scenario: one typed field for every block, and the world around it. Load, check, override, sample, save.

A scenario file is YAML with this file's names; what it leaves out has its default. Numbers of the simulated world
may be distributions (`!Uniform {min: 0.81, max: 1.22}`): `resolve` draws them from the seed, each from a stream of its
own name, so that a new key changes no other number.
"""

import dataclasses as dc
import math
import typing
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed

from valve_drake import resources
from valve_drake.behaviors.base_approach import BaseApproachConfig
from valve_drake.behaviors.grasp_geometry import StanceConfig
from valve_drake.behaviors.hybrid_rotation import HybridRotationConfig
from valve_drake.behaviors.image_servo import ImageServoConfig
from valve_drake.behaviors.kinematic_approach import KinematicApproachConfig
from valve_drake.behaviors.valve_search import ValveSearchConfig
from valve_drake.checks import ConfigError, require, require_in
from valve_drake.perception.color_segmentation import ColorSegmentationConfig
from valve_drake.perception.handle_marker import HandleMarkerConfig
from valve_drake.perception.line_fitting import LineFittingConfig
from valve_drake.perception.marker import Marker
from valve_drake.perception.rectangle_estimator import RectangleEstimatorConfig
from valve_drake.perception.stereo_positioning import StereoPositioningConfig
from valve_drake.stations.faults import FaultConfig
from valve_drake.stations.lcm_channels import HardwareConfig
from valve_drake.stations.simulation_config import SimulationConfig, Uniform
from valve_drake.supervisor.command_selector import CommandSelectorConfig
from valve_drake.supervisor.supervisor import SupervisorConfig

PLATE = 0.15  # the valve's face that carries the marker, square [m]
DEFAULT = "simulated.scenario.yaml"
STATIONS = ("simulated", "hardware", "replay")


@dc.dataclass
class Scenario:
    """Everything that a run depends on."""

    seed: int = 0
    station: str = "simulated"
    command: str = "open"  # open | close
    angle: float = 1.5707963267948966  # to turn [rad]
    time_limit: float = 240.0  # of the whole run [s]
    head_calibration: str = "calibration/head.yaml"  # a path, or one below models/
    taught: str = "taught/hands.yaml"  # the same
    marker: Marker = dc.field(default_factory=Marker)
    color_segmentation: ColorSegmentationConfig = dc.field(default_factory=ColorSegmentationConfig)
    line_fitting: LineFittingConfig = dc.field(default_factory=LineFittingConfig)
    stereo_positioning: StereoPositioningConfig = dc.field(default_factory=StereoPositioningConfig)
    rectangle_estimator: RectangleEstimatorConfig = dc.field(default_factory=RectangleEstimatorConfig)
    handle_marker: HandleMarkerConfig = dc.field(default_factory=HandleMarkerConfig)
    valve_search: ValveSearchConfig = dc.field(default_factory=ValveSearchConfig)
    base_approach: BaseApproachConfig = dc.field(default_factory=BaseApproachConfig)
    stance: StanceConfig = dc.field(default_factory=StanceConfig)
    kinematic_approach: KinematicApproachConfig = dc.field(default_factory=KinematicApproachConfig)
    image_servo: ImageServoConfig = dc.field(default_factory=ImageServoConfig)
    hybrid_rotation: HybridRotationConfig = dc.field(default_factory=HybridRotationConfig)
    supervisor: SupervisorConfig = dc.field(default_factory=SupervisorConfig)
    command_selector: CommandSelectorConfig = dc.field(default_factory=CommandSelectorConfig)
    simulation: SimulationConfig = dc.field(default_factory=SimulationConfig)
    hardware: HardwareConfig = dc.field(default_factory=HardwareConfig)
    faults: list[FaultConfig] = dc.field(default_factory=list)  # of the twin

    def check(self) -> None:
        """Raises ConfigError that names the key, the rule and the value."""
        require(0 <= self.seed < 2**31, "seed", "within [0, 2^31)", self.seed)
        require(self.station in STATIONS, "station", " or ".join(STATIONS), self.station)
        require(self.command in ("open", "close"), "command", "open or close", self.command)
        require_in(self.angle, 0.01, 6.29, "angle")
        require_in(self.time_limit, 0.1, 3600.0, "time_limit")
        for length in self.marker.size:
            require(length <= PLATE, "marker.size", f"not larger than the panel's face of {PLATE} m", self.marker.size)
        for field in dc.fields(self):
            value = getattr(self, field.name)
            for part in value if isinstance(value, list) else [value]:
                if dc.is_dataclass(part):
                    part.check()


def load(path: str | None = None, overrides: typing.Sequence[str] = ()) -> Scenario:
    """The scenario of a file (a path, or a name in diagrams/; None: the default one) with `key=value` overrides.

    Raises ConfigError: no such file, not YAML, unknown key, wrong type, value out of range.
    """
    file = resources.find(path or DEFAULT, resources.diagrams())
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file.name}: cannot be read ({type(error).__name__})") from error
    return with_overrides(parse(text, file.name), overrides)


def with_overrides(scenario: Scenario, overrides: typing.Sequence[str]) -> Scenario:
    """The scenario with `key=value` overrides, checked. Raises ConfigError as `load` does."""
    for override in overrides:
        key, equals, value = override.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set {override}: want key=value, e.g. simulation.valve.friction=7.3")
        lines = key.strip().split(".")
        text = "".join("  " * k + f"{name}:\n" for k, name in enumerate(lines[:-1]))
        text += "  " * (len(lines) - 1) + f"{lines[-1]}: {value}\n"
        scenario = parse(text, f"--set {key}", scenario)
    scenario.check()
    return scenario


def dump(scenario: Scenario) -> str:
    """All values, defaults included, as YAML that `load` reads."""
    return yaml_dump_typed(scenario, schema=Scenario)


def resolve(scenario: Scenario) -> Scenario:
    """Every distribution replaced by a number drawn from the seed; the valve's start set for the command."""

    def draw(key: str, value: Any) -> Any:
        if isinstance(value, Uniform):
            stream = np.random.Generator(np.random.SFC64([scenario.seed, zlib.crc32(key.encode())]))
            return float(stream.uniform(value.min, value.max))
        if dc.is_dataclass(value):
            return dc.replace(
                value, **{f.name: draw(f"{key}.{f.name}", getattr(value, f.name)) for f in dc.fields(value)}
            )
        return value

    out = dc.replace(scenario, simulation=draw("simulation", scenario.simulation))
    valve = out.simulation.valve
    if valve.position < 0:
        valve.position = valve.travel if scenario.command == "close" else 0.0
    return out


def parse(text: str, source: str, defaults: Scenario | None = None) -> Scenario:
    """A scenario from YAML text on top of `defaults`; `source` is named in errors."""
    scenario = Scenario() if defaults is None else defaults
    try:
        tree = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise ConfigError(f"{source}: not YAML" + (f" (line {mark.line + 1})" if mark else "")) from error
    if tree is None:
        return scenario
    _check_types(tree, Scenario, "", source)
    try:
        return yaml_load_typed(schema=Scenario, data=text, defaults=scenario, retain_map_defaults=True)
    except Exception as error:  # whatever the type check above let pass
        raise ConfigError(f"{source}: {str(error).splitlines()[0]}") from error


class _Tagged(dict):
    """A YAML mapping with a tag such as !Uniform."""


class _Loader(yaml.SafeLoader):
    pass


def _tagged(loader: yaml.SafeLoader, suffix: str, node: yaml.Node) -> _Tagged:
    if suffix != "Uniform" or not isinstance(node, yaml.MappingNode):
        raise ConfigError(f"unknown tag !{suffix}; distributions are written !Uniform {{min: a, max: b}}")
    return _Tagged(loader.construct_mapping(node))


_Loader.add_multi_constructor("!", _tagged)


def _check_types(value: Any, kind: Any, key: str, source: str) -> None:
    """Says which key is unknown or of a wrong type (Drake's reader names neither)."""
    at = f"{source}: {key}" if key else source
    if dc.is_dataclass(kind):
        if not isinstance(value, dict) or isinstance(value, _Tagged) and kind is not Uniform:
            raise ConfigError(f"{at} must be a group of keys, got {value!r}")
        fields = {f.name: f.type for f in dc.fields(kind)}
        for name, item in value.items():
            inner = f"{key}.{name}" if key else str(name)
            if name not in fields:
                near = ", ".join(sorted(fields))
                raise ConfigError(f"{source}: unknown key {inner}; known here: {near}")
            _check_types(item, fields[name], inner, source)
        return
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Union:
        if isinstance(value, _Tagged):
            return _check_types(value, Uniform, key, source)
        kind = float
    if origin is list:
        if not isinstance(value, list):
            raise ConfigError(f"{at} must be a list, got {value!r}")
        for k, item in enumerate(value):
            _check_types(item, arguments[0], f"{key}[{k}]", source)
        return None
    if origin is dict:
        if not isinstance(value, dict):
            raise ConfigError(f"{at} must be a group of keys, got {value!r}")
        for name, item in value.items():
            _check_types(item, arguments[1], f"{key}.{name}", source)
        return None
    number = isinstance(value, int | float) and not isinstance(value, bool)
    good = {
        float: number and math.isfinite(value) if number else False,
        int: isinstance(value, int) and not isinstance(value, bool),
        bool: isinstance(value, bool),
        str: isinstance(value, str),
    }[kind]
    if not good:
        words = {float: "a finite number", int: "a whole number", bool: "true or false", str: "text"}
        raise ConfigError(f"{at} must be {words[kind]}, got {value!r}")
    return None


def save(scenario: Scenario, path: Path) -> None:
    """Writes `dump` to a file."""
    path.write_text(dump(scenario), encoding="utf-8")
