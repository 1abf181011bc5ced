"""robot.yaml's `colors`: a model file's text with other colours for its materials (URDF) or visuals (SDF)."""

import difflib
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from valve_drake.checks import ConfigError, shown
from valve_drake.robot import xml_file


def painted(path: Path, colors: Mapping[str, Sequence[float]]) -> str:
    """The URDF or SDF text of a model, to be parsed anywhere: its files are named by full paths.

    colors: name -> red, green, blue, opacity (4,). Raises ConfigError that names the key: a colour for what the model
    lacks, a file of another kind; or the file, if it is no XML.
    """
    if path.suffix.lower() not in (".urdf", ".sdf", ".xml"):
        raise ConfigError(f"colors must be none for a model that is neither URDF nor SDF, got {shown(path.name)}")
    root = xml_file.read(path, f"model {path}")
    places: dict[str, list[ET.Element]] = {}
    for name, place in _places(root):
        places.setdefault(name, []).append(place)
    for name, rgba in colors.items():
        if name not in places:
            near = difflib.get_close_matches(name, places, 3, 0.6)
            hint = f"; near it: {', '.join(near)}" if near else ""
            raise ConfigError(f"colors.{name} must be a material of the model, got {shown(name)}{hint}")
        text = " ".join(f"{value:g}" for value in rgba)
        for place in places[name]:
            _paint(place, text)
    for element in root.iter("mesh"):
        if (file := element.get("filename")) and "://" not in file:
            element.set("filename", _url(path, file))
    for element in root.iter("uri"):
        file = (element.text or "").strip()
        if file and "://" not in file:
            element.text = _url(path, file)
    return ET.tostring(root, encoding="unicode")


def _url(path: Path, file: str) -> str:
    """A file that the model at `path` names by a path."""
    return f"file://{(path.parent / file).absolute()}"


def _places(root: ET.Element) -> Iterator[tuple[str, ET.Element]]:
    """Every element that may be painted, by name."""
    for material in root.iter("material"):
        if name := material.get("name"):  # URDF
            yield name, material
    if root.tag == "sdf":
        for visual in root.iter("visual"):
            yield visual.get("name", ""), visual


def _paint(place: ET.Element, rgba: str) -> None:
    if place.tag == "material":
        for color in place.iter("color"):
            color.set("rgba", rgba)
        return
    for material in place.findall("material"):
        place.remove(material)
    material = ET.SubElement(place, "material")
    for name in ("ambient", "diffuse"):
        ET.SubElement(material, name).text = rgba
