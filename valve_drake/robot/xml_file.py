"""Reading XML (URDF, SDF, SRDF): the only module that calls an XML parser for models of robots and valves.

No entities, and bounds on size, depth and number of elements. Prefixes of names (`drake:mimic`, `controller:x` in what
Gazebo reads) are part of the name, declared or not: Drake reads them so, too.
"""

import xml.etree.ElementTree as ET
from pathlib import Path
from xml.parsers import expat

from valve_drake.checks import ConfigError, shown

MAX_BYTES = 16_000_000  # of a file; the largest robot descriptions have 1 MB
MAX_ELEMENTS = 200_000  # of a file
MAX_DEPTH = 64  # of nested elements


def read(path: Path, source: str) -> ET.Element:
    """The root element of a file. Raises ConfigError, one line that begins with `source`, as `load` and `parse` do."""
    return parse(load(path, source), source)


def load(path: Path, source: str) -> bytes:
    """The bytes of a file. Raises ConfigError: it cannot be read, it is larger than MAX_BYTES."""
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{source}: {shown(str(path))} cannot be read ({error.strerror})") from error
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{source}: larger than {MAX_BYTES / 1e6:g} MB")
    return data


def parse(data: bytes, source: str) -> ET.Element:
    """The root element. Raises ConfigError: not XML, a document type (so any entity), too deep, too many elements."""
    builder, depth, count = ET.TreeBuilder(), 0, 0
    parser = expat.ParserCreate()
    parser.buffer_text = True

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MAX_DEPTH or count > MAX_ELEMENTS:
            raise ConfigError(
                f"{source}: line {parser.CurrentLineNumber}: more than {MAX_DEPTH} levels or {MAX_ELEMENTS} elements"
            )
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse(*_: object) -> None:
        raise ConfigError(f"{source}: line {parser.CurrentLineNumber}: a document type (<!DOCTYPE ...>) is not read")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
        return builder.close()
    except expat.ExpatError as error:
        what = expat.ErrorString(error.code)
        raise ConfigError(f"{source}: not XML: {what} (line {error.lineno}, column {error.offset + 1})") from error
    except (ValueError, LookupError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{source}: not XML: {error}") from error
