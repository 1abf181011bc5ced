"""One way to refuse a bad value: a line that names the key, the rule and the value."""

import math
from collections.abc import Iterable


class ConfigError(ValueError):
    """A scenario, file or argument that cannot be used. Its text is one clear line for the user."""


class OperationFailed(RuntimeError):
    """What was asked for could not be done. Its text is one clear line for the user."""


def require(ok: bool, key: str, rule: str, value: object) -> None:
    """Raises ConfigError "<key> must be <rule>, got <value>" unless `ok`."""
    if not ok:
        raise ConfigError(f"{key} must be {rule}, got {value!r}")


def require_positive(config: object, block: str, names: Iterable[str]) -> None:
    """Every named field of `config` is a finite number above zero."""
    for name in names:
        value = getattr(config, name)
        good = isinstance(value, int | float) and math.isfinite(value) and value > 0
        require(good, f"{block}.{name}", "a finite number > 0", value)


def require_in(value: float, low: float, high: float, key: str) -> None:
    """`value` is a finite number within [low, high]."""
    good = isinstance(value, int | float) and math.isfinite(value) and low <= value <= high
    require(good, key, f"within [{low:g}, {high:g}]", value)
