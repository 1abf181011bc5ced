"""Where the files lie that a robot description names: package://, model:// and file:// URLs, and relative paths.

Packages are looked for beside the file and in the folders above it, in ROS_PACKAGE_PATH, in the share/ folders of
AMENT_PREFIX_PATH and CMAKE_PREFIX_PATH, in GAZEBO_MODEL_PATH, and in what `pip` has installed.
"""

import importlib.metadata
import itertools
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import unquote

from valve_drake.checks import ConfigError, shown

MAX_CRAWLED = 4  # levels of folders below an entry of ROS_PACKAGE_PATH that a package may lie in
MAX_ABOVE = 8  # folders above a file that may hold its package
MAX_LICENSE = 1_000_000  # of a licence's text [bytes]
_URL = re.compile(rb"""(?:package|model)://[^"'<>\s]+""")
_NAME = re.compile(rb"<name>\s*([^<\s]+)\s*</name>")
_LICENSES = ("LICENSE", "LICENSE.txt", "LICENSE.md", "LICENCE", "LICENCE.txt", "COPYING", "COPYING.txt", "license.txt")


def resolve(url: str, beside: Path | None, what: str) -> Path:
    """The file that a URL or path names. beside: the folder of the file that names it.

    Raises ConfigError "<what>: ...": no such package, no such file in it, no such file.
    """
    scheme, _, rest = url.partition("://")
    if not rest:
        path = Path(url)
        path = path if path.is_absolute() or beside is None else beside / path
        if _is_file(path):
            return path
        raise ConfigError(f"{what}: no such file: {shown(str(path))}")
    rest = unquote(rest)
    if scheme == "file":
        if _is_file(Path(rest)):
            return Path(rest)
        raise ConfigError(f"{what}: no such file: {shown(rest)}")
    if scheme not in ("package", "model"):
        raise ConfigError(
            f"{what}: a file must be named by a path or package://, model:// or file://, got {shown(url)}"
        )
    name, _, inside = rest.lstrip("/").partition("/")  # some write package:///name
    found = []
    for folder in packages(name, beside):
        if _is_file(folder / inside):
            return folder / inside
        found.append(folder)
    if found:
        raise ConfigError(
            f"{what}: package {shown(name)} has no file {shown(inside)} (looked in {shown(str(found[0]))})"
        )
    raise ConfigError(
        f"{what}: no package {shown(name)} beside the file, in ROS_PACKAGE_PATH, AMENT_PREFIX_PATH or a wheel"
    )


def resolve_nearby(url: str, beside: Path, what: str) -> tuple[Path, str]:
    """The file that a URL or path names, and a line to say where its package is nowhere: a folder above the file that
    names it, and has such a file, is taken for one that was renamed. Raises ConfigError as `resolve` does."""
    try:
        return resolve(url, beside, what).resolve(), ""
    except ConfigError:
        scheme, _, rest = url.partition("://")
        name, _, inside = unquote(rest).lstrip("/").partition("/")
        if scheme not in ("package", "model") or not inside or any(packages(name, beside)):
            raise
        folder = beside.resolve()
        for one in [folder, *folder.parents][:MAX_ABOVE]:
            if _is_file(one / inside):
                words = f"package {shown(name)} is nowhere: its files are taken from {shown(one.name)}, which has them"
                return (one / inside).resolve(), words
        raise


def packages(name: str, beside: Path | None) -> Iterator[Path]:
    """The folders that may be the package `name`, the nearest first."""
    if not name or name in (".", ".."):
        return
    seen = set()
    for folder in itertools.chain(_above(name, beside), _crawled(name), _prefixed(name), _installed(name)):
        if folder not in seen and folder.is_dir():
            seen.add(folder)
            yield folder


def named_in(path: Path, known: Callable[[str], bool] = lambda name: False) -> Iterator[tuple[str, Path]]:
    """The packages whose files a model file names, and where they are; without those that are nowhere, and without
    the known ones, which need not be looked for."""
    found = set()
    for match in _URL.finditer(path.read_bytes()):
        url = match[0].decode("utf-8", "replace")
        name, _, inside = unquote(url.partition("://")[2]).lstrip("/").partition("/")
        if name not in found and not known(name):
            folder = next((f for f in packages(name, path.parent) if _is_file(f / inside)), None)
            if folder is not None:
                found.add(name)
                yield name, folder


def license_of(path: Path) -> Path | None:
    """The licence that lies with a file: in a folder above it up to its package, else in the wheel it came in."""
    folder = path.resolve().parent
    for _ in range(MAX_ABOVE):
        for name in _LICENSES:
            if _is_file(folder / name) and (folder / name).stat().st_size <= MAX_LICENSE:
                return folder / name
        if (folder / "package.xml").is_file() or (folder / ".git").exists() or folder.parent == folder:
            break
        folder = folder.parent
    wheel = wheel_of(path)
    return None if wheel is None else wheel[2]


def wheel_of(path: Path) -> tuple[str, str, Path | None] | None:
    """The installed wheel that a file came in: its name, version, and licence; None for any other file."""
    path = path.resolve()
    for entry in dict.fromkeys(sys.path):
        top = Path(entry).resolve() if entry else None
        if top is None or top not in path.parents or not any(top.glob("*.dist-info")):
            continue
        inside = path.relative_to(top).as_posix()
        for wheel in importlib.metadata.distributions(path=[str(top)]):
            files = [file.as_posix() for file in wheel.files or ()]
            if inside in files:
                texts = [top / file for file in files if ".dist-info/" in file and Path(file).name in _LICENSES]
                return wheel.metadata["Name"], wheel.version, next(filter(_is_file, texts), None)
    return None


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False


def _own_name(folder: Path) -> str | None:
    """The name in its package.xml or manifest; None for a folder that is no package."""
    try:
        with open(folder / "package.xml", "rb") as file:
            found = _NAME.search(file.read(20_000))
        return found[1].decode("utf-8", "replace") if found else None
    except OSError:
        return None


def _above(name: str, beside: Path | None) -> Iterator[Path]:
    folder = None if beside is None else beside.resolve()
    for _ in range(MAX_ABOVE):
        if folder is None:
            return
        if name in (folder.name, _own_name(folder)):
            yield folder
        yield folder / name
        if folder.parent == folder:
            return
        folder = folder.parent


def _entries(*variables: str) -> list[Path]:
    return [Path(entry) for key in variables for entry in os.environ.get(key, "").split(os.pathsep) if entry]


def _crawled(name: str) -> Iterator[Path]:
    for top in _entries("ROS_PACKAGE_PATH", "GAZEBO_MODEL_PATH", "GZ_SIM_RESOURCE_PATH"):
        yield top / name
        for folder, folders, _ in os.walk(top):
            if name in (Path(folder).name, own := _own_name(Path(folder))):
                yield Path(folder)
            if own is not None or len(Path(folder).relative_to(top).parts) >= MAX_CRAWLED:
                folders.clear()  # packages do not lie in packages
            folders[:] = [one for one in folders if not one.startswith(".")]


def _prefixed(name: str) -> Iterator[Path]:
    for prefix in [*_entries("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"), Path(sys.prefix)]:
        yield prefix / "share" / name


def _installed(name: str) -> Iterator[Path]:
    for entry in dict.fromkeys(sys.path):
        if not entry:
            continue
        for base in (Path(entry), Path(entry) / "cmeel.prefix" / "share", Path(entry) / "share"):
            yield base / name
            yield base / name.replace("-", "_")
        yield Path(entry) / name / "share" / name
