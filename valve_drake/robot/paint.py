"""robot.yaml's `colors`: a model file's text with other colours for its materials (URDF) or visuals (SDF)."""

import difflib
import xml.dom.minidom as minidom
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from xml.dom.minidom import Document, Element

from valve_drake.checks import ConfigError, shown


def painted(path: Path, colors: Mapping[str, Sequence[float]]) -> str:
    """The URDF or SDF text of a model, to be parsed anywhere: its files are named by full paths.

    colors: name -> red, green, blue, opacity (4,). Raises ConfigError that names the key: a colour for what the model
    lacks, a file of another kind.
    """
    if path.suffix.lower() not in (".urdf", ".sdf", ".xml"):
        raise ConfigError(f"colors must be none for a model that is neither URDF nor SDF, got {shown(path.name)}")
    document = minidom.parse(str(path))
    top = document.documentElement
    assert top is not None  # minidom reads no document without one
    places: dict[str, list[Element]] = {}
    for name, place in _places(document, top):
        places.setdefault(name, []).append(place)
    for name, rgba in colors.items():
        if name not in places:
            near = difflib.get_close_matches(name, places, 3, 0.6)
            hint = f"; near it: {', '.join(near)}" if near else ""
            raise ConfigError(f"colors.{name} must be a material of the model, got {shown(name)}{hint}")
        text = " ".join(f"{value:g}" for value in rgba)
        for place in places[name]:
            _paint(document, place, text)
    for element in document.getElementsByTagName("mesh"):
        if (file := element.getAttribute("filename")) and "://" not in file:
            element.setAttribute("filename", f"file://{(path.parent / file).absolute()}")
    for element in document.getElementsByTagName("uri"):
        file = "".join(node.data for node in element.childNodes if node.nodeType == node.TEXT_NODE).strip()
        if file and "://" not in file:
            _write(document, element, f"file://{(path.parent / file).absolute()}")
    return top.toxml()


def _places(document: Document, top: Element) -> Iterator[tuple[str, Element]]:
    """Every element that may be painted, by name."""
    for material in document.getElementsByTagName("material"):
        if name := material.getAttribute("name"):  # URDF
            yield name, material
    if top.tagName == "sdf":
        for visual in document.getElementsByTagName("visual"):
            yield visual.getAttribute("name"), visual


def _paint(document: Document, place: Element, rgba: str) -> None:
    if place.tagName == "material":
        for color in place.getElementsByTagName("color"):
            color.setAttribute("rgba", rgba)
        return
    for material in place.getElementsByTagName("material"):
        place.removeChild(material)
    material = document.createElement("material")
    for name in ("ambient", "diffuse"):
        inner = document.createElement(name)
        _write(document, inner, rgba)
        material.appendChild(inner)
    place.appendChild(material)


def _write(document: Document, element: Element, text: str) -> None:
    while element.firstChild is not None:
        element.removeChild(element.firstChild)
    element.appendChild(document.createTextNode(text))
