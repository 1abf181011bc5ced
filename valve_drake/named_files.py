"""The files that a scenario names: its robot, and what that is used with. A scenario's own key goes before the robot's.

head = load_head(named_files.find(scenario, "head_calibration"))
"""

from pathlib import Path

from valve_drake import resources
from valve_drake.checks import ConfigError
from valve_drake.robot import description as descriptions
from valve_drake.scenario import Scenario

MADE_BY = {"head_calibration": "valve-drake calibrate stereo", "taught": "valve-drake teach"}


def find(scenario: Scenario, key: str) -> Path:
    """The file of `robot`, `head_calibration` or `taught`. Raises ConfigError: none is named, or it is not there."""
    if key == "robot":
        return descriptions.find(scenario.robot)
    own = {"head_calibration": scenario.head_calibration, "taught": scenario.taught}[key]
    if own:
        return resources.find(own, resources.models())
    name: str = getattr(descriptions.load(descriptions.find(scenario.robot)), key)
    if not name:
        raise ConfigError(f"{scenario.robot}: {key} must be given: `{MADE_BY[key]}` makes it")
    return descriptions.find_file(name, f"{scenario.robot}: {key}")
