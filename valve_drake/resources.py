"""Where models/ and diagrams/ lie: beside the package in a checkout, inside it in an installed wheel."""

from pathlib import Path

from valve_drake.checks import MAX_SHOWN, ConfigError, shown

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
    """`path` as given if it is a regular file, else below `base`. Raises ConfigError if neither is."""
    for candidate in (Path(path), base / path):
        try:
            if candidate.is_file():
                return candidate
        except (OSError, ValueError):  # a name that is too long, or that no file can have
            pass
    raise ConfigError(f"no such file: {path if 0 < len(path) <= MAX_SHOWN else shown(path)}")
