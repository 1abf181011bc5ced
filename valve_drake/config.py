"""What a scenario is made of: dataclasses whose every field states its bounds and what it is, beside its default.

    @dc.dataclass
    class DriveConfig(Config):
        KEY = "drive"
        speed: float = number(0.3, 0.01, 1.0, "along the floor; lower it if the base overshoots [m/s]")

`Config.check` walks the fields; rules between fields are `relations`. `build` makes a Config of a YAML file's tree,
`tree` is the way back, `leaves` lists all keys. Every numeric field needs bounds: a test sees to that.
"""

import copy
import dataclasses as dc
import math
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

from valve_drake import yaml_file
from valve_drake.checks import ConfigError, require, require_in, shown

_RULE = "rule"  # in a field's metadata
UNIFORM = "!Uniform"  # the tag of a distribution

Bound: typing.TypeAlias = float | Sequence[float] | Mapping[str, float]  # of all, of each place in a list, by name


@dc.dataclass(frozen=True)
class Rule:
    """What a field's value may be."""

    about: str = ""  # what it is, its unit in brackets at the end
    low: Bound | None = None
    high: Bound | None = None
    options: tuple[str, ...] = ()  # a text is one of these
    count: tuple[int, int] = (0, 100)  # of a list: least and most entries
    names: tuple[str, ...] = ()  # a group of keys has no others than these
    complete: bool = False  # and has all of them
    any_name: bool = False  # a group of keys may have any name

    def bounds(self, place: int | str) -> tuple[float, float]:
        """Bounds of a list's entry or of a group's key (whichever it is, of a single number)."""
        return _at(self.low, place), _at(self.high, place)


def _at(bound: Bound | None, place: int | str) -> float:
    if bound is None:
        raise TypeError("a number without bounds")
    if isinstance(bound, Mapping):
        return bound[str(place)]
    return bound if isinstance(bound, int | float) else bound[int(place)]


def number(default: Any, low: float, high: float, about: str) -> Any:
    """A number, or for a field of type Number a distribution, within [low, high]."""
    return dc.field(default=default, metadata={_RULE: Rule(about, low, high)})


def numbers(default: Sequence[float], low: Bound, high: Bound, about: str, count: tuple[int, int] | None = None) -> Any:
    """A list of numbers, as many as the default has; count: or that many, least and most."""
    rule = Rule(about, low, high, count=count or (len(default), len(default)))
    return dc.field(default_factory=lambda: list(default), metadata={_RULE: rule})


def table(
    default: Mapping[str, float], low: Bound, high: Bound, about: str, names: Sequence[str], complete: bool = False
) -> Any:
    """Numbers by name."""
    rule = Rule(about, low, high, names=tuple(names), complete=complete)
    return dc.field(default_factory=lambda: dict(default), metadata={_RULE: rule})


def texts(default: Mapping[str, str], about: str) -> Any:
    """Texts by name; the names are those of the default."""
    rule = Rule(about, names=tuple(default))
    return dc.field(default_factory=lambda: dict(default), metadata={_RULE: rule})


def names(about: str, count: tuple[int, int]) -> Any:
    """A list of texts, empty by default; count: least and most entries."""
    return dc.field(default_factory=list, metadata={_RULE: Rule(about, count=count)})


def named(about: str, low: Bound | None = None, high: Bound | None = None, count: tuple[int, int] = (0, 100)) -> Any:
    """A group of keys of any name, empty by default; low, high, count: of what stands under each."""
    return dc.field(default_factory=dict, metadata={_RULE: Rule(about, low, high, count=count, any_name=True)})


def choice(default: str, options: Sequence[str], about: str) -> Any:
    """One of these texts."""
    return dc.field(default=default, metadata={_RULE: Rule(about, options=tuple(options))})


def plain(default: str | bool, about: str) -> Any:
    """A text, or a truth value."""
    return dc.field(default=default, metadata={_RULE: Rule(about)})


def about(words: str) -> dict[str, Rule]:
    """Metadata of a field without bounds."""
    return {_RULE: Rule(words)}


@dc.dataclass
class Uniform:
    """A number drawn evenly from [min, max]; in YAML `!Uniform {min: 0.81, max: 1.22}`."""

    min: float = 0.0
    max: float = 0.0


if typing.TYPE_CHECKING:
    Number: typing.TypeAlias = float  # as the blocks see it: resolved
else:
    Number = float | Uniform


@dc.dataclass
class Config:
    """Base of all groups of keys. KEY: where such a group stands in a scenario."""

    KEY: ClassVar[str] = ""
    FORMER: ClassVar[Mapping[str, str]] = {}  # keys by the names that they had: refused in a scenario, read in a log

    def check(self, key: str | None = None) -> None:
        """Raises ConfigError that names the key, the rule and the value. key: of this group (default: KEY)."""
        key = self.KEY if key is None else key
        for field in dc.fields(self):
            _check(getattr(self, field.name), field.type, rule_of(field), f"{key}.{field.name}" if key else field.name)
        self.relations(key)

    def relations(self, key: str) -> None:
        """Rules between fields, which are all within their bounds. Raises ConfigError."""


def rule_of(field: "dc.Field[Any]") -> Rule:
    return field.metadata.get(_RULE, Rule())


# ---------------------------------------------------------------- checks


def _is_config(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Config)


def _check(value: Any, kind: Any, rule: Rule, key: str) -> None:
    """One value of a field of type `kind`."""
    arguments = typing.get_args(kind)
    origin = typing.get_origin(kind)
    if _is_config(kind):
        value.check(key)
    elif origin is list:
        least, most = rule.count
        words = f"{least} values" if least == most else f"{least} to {most} values"
        require(isinstance(value, list) and least <= len(value) <= most, key, words, value)
        for k, item in enumerate(value):
            _check_item(item, arguments[0], rule, k, f"{key}[{k}]")
    elif origin is dict:
        _check_names(value, rule, key)
        for name, item in value.items():
            inner = f"{key}.{name}"
            if typing.get_origin(arguments[1]) is list:
                _check(item, arguments[1], rule, inner)
            else:
                _check_item(item, arguments[1], rule, name, inner)
    else:
        _check_item(value, kind, rule, 0, key)


def _check_names(value: Any, rule: Rule, key: str) -> None:
    require(isinstance(value, dict), key, "a group of keys", value)
    if rule.any_name:
        return
    unknown = [name for name in value if name not in rule.names]
    missing = [name for name in rule.names if name not in value] if rule.complete else []
    require(not unknown, key, f"given for {', '.join(rule.names)}", ", ".join(unknown))
    require(not missing, key, f"given for all of {', '.join(rule.names)}", ", ".join(value))


def _check_item(value: Any, kind: Any, rule: Rule, place: int | str, key: str) -> None:
    if _is_config(kind):
        value.check(key)
    elif kind is bool:
        require(isinstance(value, bool), key, "true or false", value)
    elif kind is str:
        require(isinstance(value, str), key, "text", value)
        require(
            not rule.options or value in rule.options,
            key,
            " or ".join(option or '""' for option in rule.options),
            value,
        )
    elif isinstance(value, Uniform):
        for end in (value.min, value.max):
            require_in(end, *rule.bounds(place), key)
        require(value.min <= value.max, key, "a range with min <= max", (value.min, value.max))
    else:
        if kind is int:
            require(isinstance(value, int) and not isinstance(value, bool), key, "a whole number", value)
        require_in(value, *rule.bounds(place), key)


# ---------------------------------------------------------------- from and to trees


def build(default: Config, given: yaml_file.Tree, source: str, unknown: list[str] | None = None) -> Any:
    """A copy of `default` with the values of a tree; lists are replaced, groups of keys are merged.

    unknown: gets the names of keys that there are none of; None: they are refused.
    Raises ConfigError: unknown key, wrong type. Bounds are not checked here.
    """
    return _build(given, type(default), default, "", source, unknown)


def _build(given: Any, kind: Any, default: Any, key: str, source: str, unknown: list[str] | None) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if _is_config(kind) or kind is Uniform:
        default = kind() if default is None else default
        fields = {field.name: field for field in dc.fields(kind)}
        values = {name: copy.deepcopy(getattr(default, name)) for name in fields}
        for name, item in _group(given, key, source).items():
            inner = f"{key}.{name}" if key else name
            former = getattr(kind, "FORMER", {})
            if name in former:
                if unknown is None:
                    raise ConfigError(f"{source}: {inner} is now called {kind.KEY}.{former[name]}")
                name = former[name]  # a log keeps the name that the key had
            if name in fields:
                values[name] = _build(item, fields[name].type, values[name], inner, source, unknown)
            elif unknown is None:
                raise ConfigError(f"{source}: unknown key {inner}; known here: {', '.join(sorted(fields))}")
            else:
                unknown.append(inner)
        return kind(**values)
    if origin is list:
        if not isinstance(given, list):
            raise _wrong(given, "a list", key, source)
        return [_build(item, arguments[0], None, f"{key}[{k}]", source, unknown) for k, item in enumerate(given)]
    if origin is dict:
        items = _group(given, key, source).items()
        return dict(default or {}) | {
            name: _build(item, arguments[1], None, f"{key}.{name}", source, unknown) for name, item in items
        }
    if origin in (typing.Union, types.UnionType):  # Number
        if isinstance(given, yaml_file.Tagged):
            if not isinstance(given.tree, dict) or not {"min", "max"} <= set(given.tree):
                raise _wrong(given.tree, f"{UNIFORM} {{min: a, max: b}}", key, source)
            return _build(given.tree, Uniform, None, key, source, unknown)
        if not isinstance(given, (int, float)):
            raise _wrong(given, f"a finite number or {UNIFORM} {{min: a, max: b}}", key, source)
        kind = float
    return _scalar(given, kind, key, source)


def _group(given: Any, key: str, source: str) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise _wrong(given, "a group of keys", key, source)
    return given


def _scalar(given: Any, kind: type, key: str, source: str) -> Any:
    if kind is float and type(given) in (int, float) and math.isfinite(given):
        return float(given)
    if kind is not float and type(given) is kind:
        return given
    words = {float: "a finite number", int: "a whole number", bool: "true or false", str: "text"}
    raise _wrong(given, words[kind], key, source)


def _wrong(given: Any, words: str, key: str, source: str) -> ConfigError:
    return ConfigError(f"{source}: {key} must be {words}, got {shown(given)}".replace(":  must", " must"))


def tree(value: Any) -> yaml_file.Tree:
    """A Config, or a part of one, as plain values."""
    if isinstance(value, Uniform):
        return yaml_file.Tagged(UNIFORM, {"min": value.min, "max": value.max})
    if isinstance(value, Config):
        return {field.name: tree(getattr(value, field.name)) for field in dc.fields(value)}
    if isinstance(value, list):
        return [tree(item) for item in value]
    if isinstance(value, dict):
        return {name: tree(item) for name, item in value.items()}
    return value


def key_names(given: yaml_file.Tree, key: str = "") -> set[str]:
    """The dotted names of all values in a tree."""
    if not isinstance(given, dict):
        return {key}
    return {inner for name, item in given.items() for inner in key_names(item, f"{key}.{name}" if key else name)}


@dc.dataclass(frozen=True)
class Leaf:
    """One field of a Config that is no Config itself."""

    key: str
    kind: Any
    rule: Rule
    value: Any


def leaves(config: Config, key: str = "") -> Iterator[Leaf]:
    """All of them, in order."""
    for field in dc.fields(config):
        inner = f"{key}.{field.name}" if key else field.name
        value = getattr(config, field.name)
        if isinstance(value, Config):
            yield from leaves(value, inner)
        else:
            yield Leaf(inner, field.type, rule_of(field), value)


def describe(config: Config, indent: str = "") -> Iterator[str]:
    """Lines of YAML that hold all keys; a comment beside each says what it is, its unit and its bounds."""
    for field in dc.fields(config):
        value, rule = getattr(config, field.name), rule_of(field)
        if isinstance(value, Config):
            yield f"{indent}{field.name}:"
            yield from describe(value, indent + "  ")
        elif isinstance(value, dict):
            yield _commented(f"{indent}{field.name}:", rule.about)
            for name, item in value.items():
                yield _commented(_entry(name, item, indent + "  "), _bounds(rule, name))
        elif isinstance(value, list) and any(isinstance(item, Config) for item in value):
            yield _commented(f"{indent}{field.name}:", rule.about)
            yield from (f"{indent}{line}" for line in yaml_file.dump(tree(value)).splitlines())
        else:
            options = f"one of {', '.join(option or repr(option) for option in rule.options)}" if rule.options else ""
            limits = _bounds(rule, 0) if not isinstance(value, list) else _bounds(rule, None)
            words = ", ".join(part for part in (rule.about, limits, options) if part)
            yield _commented(_entry(field.name, value, indent), words)


def _entry(name: str, value: Any, indent: str) -> str:
    return indent + yaml_file.dump({name: tree(value)}, width=100_000).rstrip("\n")


def _commented(text: str, words: str) -> str:
    return f"{text:<40}  # {words}" if words else text


def _bounds(rule: Rule, place: int | str | None) -> str:
    """In words; place None: of a whole list."""
    if rule.low is None or rule.high is None:
        return ""
    sides = (rule.low, rule.high) if place is None else rule.bounds(place)
    low, high = (f"{side:g}" if isinstance(side, int | float) else f"({_join(side)})" for side in sides)
    return f"within [{low}, {high}]"


def _join(side: Bound) -> str:
    assert not isinstance(side, int | float | Mapping)
    return ", ".join(f"{item:g}" for item in side)
