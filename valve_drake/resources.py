"""Where models/ and diagrams/ lie: beside the package in a checkout, inside it in an installed wheel."""

from pathlib import Path

from valve_drake.checks import ConfigError

_HERE = Path(__file__).resolve().parent


def folder(name: str) -> Path:
    """The folder `models` or `diagrams`. Raises ConfigError where the installation lacks it."""
    for base in (_HERE.parent, _HERE):
        if (base / name).is_dir():
            return base / name
    raise ConfigError(f"the installation of valve_drake has no {name}/ folder")


def models() -> Path:
    return folder("models")


def diagrams() -> Path:
    return folder("diagrams")


def find(path: str, base: Path) -> Path:
    """`path` as given if it exists, else below `base`. Raises ConfigError if neither does."""
    for candidate in (Path(path), base / path):
        if candidate.is_file():
            return candidate
    raise ConfigError(f"no such file: {path}")
