"""Every file that a command writes: checked before the work starts, written whole or not at all.

`check` refuses a name that would destroy something; `write` and `replacing` put the data under a temporary name in the
same folder first, so that the file is the old one or the new one, never half of one. A log that grows while a robot
moves is claimed by recording/container.py, which keeps to the same rules.
"""

import contextlib
import json
import math
import mmap
import os
import secrets
import stat
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import IO, Any, TypeAlias

from valve_drake.checks import ConfigError, OperationFailed, shown

PathLike: TypeAlias = str | os.PathLike[str]


def check(
    path: PathLike,
    option: str,
    inputs: Iterable[PathLike] = (),
    made_before: Callable[[Path], bool] | None = None,
    overwrite: bool | None = None,
    new_folders: bool = False,
) -> Path:
    """The file to write for `path`, links followed. Nothing is created or changed.

    option: what named the path, for the error line. inputs: files that it must not be, by identity and not by name:
    what the command reads (and the unfinished FILE.active of it), and what else it writes.
    made_before: says whether an existing file is a product of the same kind, which may be replaced.
    overwrite: whether any existing file may be replaced; None where a command has no --overwrite. An empty one may.
    new_folders: the folder may not exist yet; the caller makes it.
    Raises ConfigError, one line, for a path that must not or cannot be written.
    """
    target, existing = _target(path, option, new_folders)
    for other in inputs:
        for name in (Path(other), Path(f"{os.fspath(other)}.active")):
            if _same(target, name):
                raise _refusal(option, f"another file than {shown(name)}", path)
    free = existing is None or existing.st_size == 0  # an empty file, as of mktemp, holds nothing
    if not free and not overwrite and not (made_before is not None and made_before(target)):
        hint = "" if overwrite is None else " (--overwrite replaces it)"
        raise _refusal(option, "a file that does not exist yet" + hint, path)
    folder = target.parent
    while new_folders and not os.path.lexists(folder):
        folder = folder.parent
    if not os.access(folder, os.W_OK | os.X_OK):
        raise _refusal(option, "in a folder that can be written", path)
    return target


def check_folder(
    path: PathLike,
    option: str,
    names: Iterable[str],
    inputs: Iterable[PathLike] = (),
    made_before: Callable[[Path], bool] | None = None,
) -> Path:
    """A folder to put the files `names` into; it may not exist yet. Nothing is created.

    Each of the files is checked as `check` does. Raises ConfigError, one line.
    """
    folder, inputs = Path(path), tuple(inputs)
    for name in names:
        check(folder / name, option, inputs, made_before, new_folders=True)
    return folder


def holds(path: Path, text: str) -> bool:
    """Whether a file holds this text, for `made_before`; the file may be of any size and kind."""
    try:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return data.find(text.encode()) >= 0
    except (OSError, ValueError):  # cannot be read, or is empty
        return False


def json_text(tree: Any, indent: int | None = None) -> str:
    """A tree as JSON that every reader takes: numbers that are not finite, which JSON does not know, are null."""
    return json.dumps(finite(tree), indent=indent, allow_nan=False)


def finite(tree: Any) -> Any:
    """A tree of dicts and lists with None for every number that is not finite."""
    if isinstance(tree, dict):
        return {key: finite(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [finite(value) for value in tree]
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def parse_json(data: bytes) -> Any:
    """What JSON holds; NaN and infinities, which others write, are None. Raises ValueError, nothing else."""
    try:
        return json.loads(data, parse_constant=lambda name: None)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def make_folder(path: PathLike) -> None:
    """Creates a folder and those above it. Raises OperationFailed."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OperationFailed(f"folder {str(path)!r} cannot be made: {error.strerror}") from error


def write(path: PathLike, data: bytes | str) -> None:
    """Writes a whole file; text as UTF-8, but "\\udcXX" for the bytes of a name that is not. Raises OperationFailed."""
    with replacing(path) as file:
        file.write(data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data)


@contextlib.contextmanager
def replacing(path: PathLike) -> Iterator[IO[bytes]]:
    """A new file to write to, which becomes `path` on leaving without an exception; else no trace of it is left.

    Raises OperationFailed if it cannot be, also for what is no regular file.
    """
    try:
        target, _ = _target(path, "output")
    except ConfigError as error:  # the work is done: what `check` has passed has changed since
        raise OperationFailed(str(error)) from None
    temporary = target.with_name(f".valve-drake-{secrets.token_hex(8)}.tmp")
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            with os.fdopen(descriptor, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, target)
        except BaseException:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
            raise
    except OSError as error:
        raise OperationFailed(f"{str(path)!r} cannot be written: {error.strerror or error}") from error


def _target(path: PathLike, option: str, new_folders: bool = False) -> tuple[Path, os.stat_result | None]:
    """The file behind `path`, and its status if it exists. Raises ConfigError unless it is or can be a regular file."""
    target = Path(path)
    if os.path.islink(target):
        target = Path(os.path.realpath(target))
    if target.name in ("", ".."):
        raise _refusal(option, "the name of a file", path)
    folder = target.parent
    while new_folders and not os.path.lexists(folder):
        folder = folder.parent
    mode = _mode(folder, option, path)
    if mode is None or not stat.S_ISDIR(mode):
        raise _refusal(option, "in a folder that exists", path)
    try:
        existing = os.stat(path)
    except FileNotFoundError:
        if os.path.islink(target):
            raise _refusal(option, "a link that leads somewhere", path) from None
        return target, None
    except (OSError, ValueError) as error:
        raise _refusal(option, f"a name that can be written ({_words(error)})", path) from None
    if not stat.S_ISREG(existing.st_mode):
        kind = "a folder" if stat.S_ISDIR(existing.st_mode) else "a device, pipe or socket"
        raise _refusal(option, f"a regular file and not {kind}", path)
    if not _same(target, Path(path)):
        raise _refusal(option, "a file with a name of its own", path)
    return target, existing


def _mode(path: Path, option: str, named: PathLike) -> int | None:
    """The type and permissions of a file; None if it does not exist."""
    try:
        return os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        raise _refusal(option, f"a name that can be written ({_words(error)})", named) from None


def _same(a: Path, b: Path) -> bool:
    try:
        return os.path.samefile(a, b)
    except (OSError, ValueError):  # one of them does not exist: they are one file if their names lead to one place
        return os.path.realpath(a) == os.path.realpath(b)


def _words(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _refusal(option: str, rule: str, path: PathLike) -> ConfigError:
    return ConfigError(f"{option} must be {rule}, got {shown(os.fspath(path))}")
