"""One way to refuse a bad value: a line that names the key, the rule and the value."""

import reprlib
from pathlib import PurePath
from typing import Any

MAX_SHOWN = 200  # characters of a value in an error


class ConfigError(ValueError):
    """A scenario, file or argument that cannot be used. Its text is one clear line for the user."""


class OperationFailed(RuntimeError):
    """What was asked for could not be done. Its text is one clear line for the user."""


class _Short(reprlib.Repr):
    """repr() with a bound on what it reads of a value, and numpy's numbers and arrays as plain ones."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 4
        self.maxdict = self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = 24
        self.maxstring = self.maxother = self.maxlong = MAX_SHOWN

    def repr1(self, x: Any, level: int) -> str:
        if isinstance(x, PurePath):
            x = str(x)
        elif hasattr(x, "tolist") and getattr(x, "size", 0) <= 1000:
            x = x.tolist()
        if isinstance(x, int) and x.bit_length() > 256:
            return f"a whole number of {x.bit_length()} bits"
        return super().repr1(x, level)


_SHORT = _Short()


def shown(value: object) -> str:
    """A value for an error line: as Python writes it, printable, at most MAX_SHOWN characters."""
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in _SHORT.repr(value))
    return text if len(text) <= MAX_SHOWN else text[: MAX_SHOWN - 3] + "..."


def require(ok: bool, key: str, rule: str, value: object) -> None:
    """Raises ConfigError "<key> must be <rule>, got <value>" unless `ok`."""
    if not ok:
        raise ConfigError(f"{key} must be {rule}, got {shown(value)}")


def is_number(value: object) -> bool:
    """Whether it is a finite number; a truth value is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -1e300 <= value <= 1e300


def require_in(value: float, low: float, high: float, key: str) -> None:
    """Raises ConfigError unless `value` is a finite number within [low, high]."""
    require(is_number(value) and low <= value <= high, key, f"within [{low:g}, {high:g}]", value)
