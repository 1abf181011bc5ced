"""Reading and writing YAML: the only module that calls the YAML library.

Numbers, truth values and null are those of YAML 1.2 (its core schema): 1e2 is a number, 010 is ten, and `1:30`, `yes`
and dates are text. A file is refused, in one line, where it would otherwise mean something that nobody sees: a key that
stands twice, a tag that nobody asked for, a number that does not fit.
"""

import copy
import dataclasses as dc
import math
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from valve_drake.checks import ConfigError, shown

MAX_BYTES = 1_000_000  # of a file
MAX_VALUES = 50_000  # of a file, with aliases expanded
MAX_DEPTH = 32  # of nested lists and mappings

Tree: TypeAlias = Any  # dict with text as keys, list, str, int, float, bool, None, or what a handler of a tag returns
Tags: TypeAlias = Mapping[str, Callable[[Tree], Any]]  # tag as written (!Uniform, !!opencv-matrix) -> its handler


@dc.dataclass(frozen=True)
class Tagged:
    """A value that carries a tag of its own: what `dump` writes with it, and a handler may return."""

    tag: str
    tree: Tree

    def __repr__(self) -> str:
        """As a file has it, for error lines."""
        if not isinstance(self.tree, dict):
            return f"{self.tag} {shown(self.tree)}"
        return f"{self.tag} {{{', '.join(f'{key}: {shown(value)}' for key, value in self.tree.items())}}}"


_NULL = {"", "~", "null", "Null", "NULL"}
_BOOL = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_INT = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_SPECIAL = re.compile(r"([-+]?)\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)")
_STANDARD = "tag:yaml.org,2002:"  # what !! stands for


def read(path: str | Path, tags: Tags | None = None, source: str = "", room: int = 1) -> Tree:
    """The one document of a file, as `parse` gives it; None for an empty file. `source`: in errors, else the path.

    room: for a file that may be so many times as large as others.
    Raises ConfigError as `parse` does, and if the file cannot be read.
    """
    return parse(read_text(path, source, room), source or str(path), tags, room)


def read_text(path: str | Path, source: str = "", room: int = 1) -> str:
    """The text of a file. Raises ConfigError: no such file, no regular file, larger than MAX_BYTES, not UTF-8."""
    most = room * MAX_BYTES
    source = source or str(path)
    try:
        if not Path(path).is_file():
            raise ConfigError(f"{source}: no such file")
        with open(path, "rb") as file:
            data = file.read(most + 1)
        if len(data) > most:
            raise ConfigError(f"{source}: larger than {most / 1e6:g} MB")
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{source}: cannot be read: not text in UTF-8") from error
    except (OSError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{source}: cannot be read ({getattr(error, 'strerror', None) or error})") from error


def parse(text: str, source: str, tags: Tags | None = None, room: int = 1) -> Tree:
    """The one document of a text; None for an empty one. `source` is named in errors.

    Raises ConfigError: not YAML, a key that stands twice, an unknown tag or a value that its tag does not allow,
    a number that does not fit into 64 bits, too deep, too long, several documents.
    """
    trees = documents(text, source, tags, room)
    if len(trees) > 1:
        raise ConfigError(f"{source} must be one YAML document, got {len(trees)}")
    return trees[0] if trees else None


def documents(text: str, source: str, tags: Tags | None = None, room: int = 1) -> list[Tree]:
    """All documents of a text but the empty ones. Raises ConfigError as `parse` does."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        text.encode()  # the library in C cannot say that a text has half a surrogate pair
        trees = _Builder(yaml.parse(text, Loader=loader), source, tags or {}, room * MAX_VALUES).documents()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        raise ConfigError(f"{source}: not YAML" + (f" (line {mark.line + 1})" if mark else "")) from error
    except UnicodeEncodeError as error:
        raise ConfigError(f"{source}: not YAML (not text in UTF-8)") from error
    return [tree for tree in trees if tree is not None]


def dump(tree: Tree, comment: str = "", width: int = 110) -> str:
    """A tree as text that `parse` reads back bit for bit, below lines of comment. width: of its lines [characters]."""
    lines = "".join(f"# {line}\n" for line in comment.splitlines())
    return lines + yaml.dump(tree, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=width)


class _Dumper(yaml.SafeDumper):
    """Quotes text that YAML 1.2 would read as a number, too (1e2)."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_tagged(dumper: yaml.SafeDumper, data: Tagged) -> yaml.Node:
    node = dumper.represent_data(data.tree)
    node.tag, node.flow_style = data.tag, True
    return node


def _represent_list(dumper: yaml.SafeDumper, data: list[Tree]) -> yaml.Node:
    """Lists of numbers or texts in a line."""
    nested = any(isinstance(item, list | dict) for item in data)
    return dumper.represent_sequence(_STANDARD + "seq", data, flow_style=not nested)


_Dumper.add_representer(Tagged, _represent_tagged)
_Dumper.add_representer(list, _represent_list)
_Dumper.add_implicit_resolver(_STANDARD + "float", re.compile(rf"^(?:{_FLOAT.pattern}|{_INT.pattern})$"), None)


class _Builder:
    """Makes trees of the parser's events. The library's own constructor is not used: it reads YAML 1.1, takes the last
    of two equal keys, and lets a few aliases stand for gigabytes."""

    def __init__(self, events: Iterator[yaml.Event], source: str, tags: Tags, most: int) -> None:
        self.events = events
        self.source = source
        self.tags = tags
        self.most = most  # values
        self.values = 0  # so far, with aliases expanded
        self.anchors: dict[str, tuple[Tree, int]] = {}  # name -> its tree, and how many values that is

    def documents(self) -> list[Tree]:
        trees = []
        for event in self.events:
            if isinstance(event, yaml.DocumentStartEvent):
                self.anchors = {}
                trees.append(self.tree(next(self.events), "", 0))
        return trees

    def error(self, event: yaml.Event, key: str, text: str) -> ConfigError:
        subject = f"{self.source}: {key}" if key else self.source
        return ConfigError(f"{subject} {text} (line {event.start_mark.line + 1})")

    def count(self, event: yaml.Event, more: int) -> None:
        self.values += more
        if self.values > self.most:
            raise self.error(event, "", f"has more than {self.most} values, aliases expanded")

    def tree(self, event: yaml.Event, key: str, depth: int) -> Tree:
        """The tree that begins with `event`; `key` leads to it."""
        if depth > MAX_DEPTH:
            raise self.error(event, "", f"is nested deeper than {MAX_DEPTH}")
        if isinstance(event, yaml.AliasEvent):
            return self.alias(event, key)
        before = self.values
        self.count(event, 1)
        if isinstance(event, yaml.ScalarEvent):
            tree = self.scalar(event, key)
        else:
            is_map = isinstance(event, yaml.MappingStartEvent)
            tree = self.mapping(key, depth) if is_map else self.list(key, depth)
            tree = self.tagged(event, tree, key, "!!map" if is_map else "!!seq")
        if event.anchor:
            self.anchors[event.anchor] = (tree, self.values - before)
        return tree

    def alias(self, event: yaml.AliasEvent, key: str) -> Tree:
        if event.anchor not in self.anchors:
            raise self.error(event, key, f"is an alias of {shown(event.anchor)}, which is not defined before")
        tree, size = self.anchors[event.anchor]
        self.count(event, size)
        return copy.deepcopy(tree)

    def mapping(self, key: str, depth: int) -> dict[str, Tree]:
        """Keys are names: their text as written, whatever type YAML would give them."""
        tree: dict[str, Tree] = {}
        lines: dict[str, int] = {}
        while not isinstance(event := next(self.events), yaml.MappingEndEvent):
            text = isinstance(event, yaml.ScalarEvent) and event.tag in (None, "!", _STANDARD + "str")
            if not text or event.anchor:
                raise self.error(event, key, "must have plain text as its keys")
            self.count(event, 1)
            name, line = event.value, event.start_mark.line + 1
            inner = f"{key}.{name}" if key else name
            if name in lines:
                raise ConfigError(f"{self.source}: key {inner} stands twice (lines {lines[name]} and {line})")
            lines[name] = line
            tree[name] = self.tree(next(self.events), inner, depth + 1)
        return tree

    def list(self, key: str, depth: int) -> list[Tree]:
        tree: list[Tree] = []
        while not isinstance(event := next(self.events), yaml.SequenceEndEvent):
            tree.append(self.tree(event, f"{key}[{len(tree)}]", depth + 1))
        return tree

    def tagged(self, event: yaml.Event, tree: Tree, key: str, standard: str) -> Tree:
        """`tree` as its tag wants it."""
        tag = event.tag and event.tag.replace(_STANDARD, "!!")
        if tag in (None, "!", standard):
            return tree
        if tag not in self.tags:
            known = f"; known here: {', '.join(sorted(self.tags))}" if self.tags else ""
            raise self.error(event, key, f"has the unknown tag {tag}{known}")
        try:
            return self.tags[tag](tree)
        except (TypeError, ValueError) as error:
            raise self.error(event, key, f"is no {tag}: {error}") from error

    def scalar(self, event: yaml.ScalarEvent, key: str) -> Tree:
        text = event.value
        if event.tag is None:
            return self.plain(event, key) if event.implicit[0] else text
        kind = event.tag.removeprefix(_STANDARD)
        if kind not in ("null", "bool", "int", "float"):
            return self.tagged(event, text, key, "!!str")
        value = self.plain(event, key)
        if kind == "float" and type(value) is int:
            value = float(value)
        if type(value).__name__ != ("NoneType" if kind == "null" else kind):
            raise self.error(event, key, f"is no !!{kind}: {shown(text)}")
        return value

    def plain(self, event: yaml.ScalarEvent, key: str) -> Tree:
        """A text without quotes: null, a truth value, a number, else itself."""
        text = event.value
        if text in _NULL:
            return None
        if text in _BOOL:
            return _BOOL[text]
        if special := _SPECIAL.fullmatch(text):
            return math.nan if text.lower() == ".nan" else float(special[1] + "inf")
        whole = _INT.fullmatch(text)
        if not whole and not _FLOAT.fullmatch(text):
            return text
        value: float = math.inf
        if not whole:
            value = float(text)
        elif len(text) <= 64:  # longer: Python itself may refuse to read it
            value = int(text, {"0x": 16, "0o": 8}.get(text[:2], 10))
        if whole and not -(2**63) <= value < 2**64:
            raise self.error(event, key, f"must be a number of 64 bits, got {shown(text)}")
        if math.isinf(value):
            raise self.error(event, key, f"must be a finite number, got {shown(text)}")
        return value
