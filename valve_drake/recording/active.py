"""The log that is being written: FILE.active, owned by one process, until it is complete and becomes FILE.

FILE.active is created new and locked: two programs never write one log, and what a killed program left is never written
over. A name that is taken makes way for the next free one (run-7.mcap, run-7-2.mcap, ...).
"""

import contextlib
import errno
import fcntl
import itertools
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from valve_drake.checks import ConfigError, OperationFailed
from valve_drake.recording.container import active

NO_LINKS = (errno.EPERM, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)  # from file systems without hard links


class ActiveFile:
    """FILE.active, open as `file`, of a log that will be `path`: the name asked for or the next free one.

    A name is free if neither it, nor its FILE.active, nor FILE with one of the suffixes `companions` exists;
    overwrite: the name asked for may exist, and its companions. note: one line if another name was taken, else "".
    Missing folders are made. Raises ConfigError if no file can be created there.
    """

    def __init__(self, path: Path, companions: Sequence[str] = (), overwrite: bool = False):
        self.path, self.note, self._overwrite = path, "", False
        parents = (path.parent, *path.parent.parents)
        self._made = list(itertools.takewhile(lambda folder: not os.path.exists(folder), parents))
        self._where: Path | None = None  # once it is closed
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            try:
                self._claim(path, companions, overwrite)
            except OSError:
                os.close(self._folder)
                raise
        except OSError as error:
            self._remove_folders()
            raise ConfigError(f"log {str(path)!r} cannot be written: {error.strerror}") from None

    def _claim(self, path: Path, companions: Sequence[str], overwrite: bool) -> None:
        """Takes the first free name. Raises OSError."""
        reasons = []
        for self.path in _names(path):
            self._overwrite = overwrite and self.path == path
            reason = _taken(self.path, () if self._overwrite else ("", *companions)) or self._create()
            if not reason:
                break
            reasons.append(reason)
        if reasons:
            self.note = f"{reasons[0]}: this log is {str(self.path)!r}"

    def _create(self) -> str:
        """Creates and locks FILE.active -> why it cannot be, if another process was faster."""
        name = active(self.path).name
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            descriptor = os.open(name, flags, 0o666, dir_fd=self._folder)
        except FileExistsError:
            return f"{str(self.path)!r} is being written by another run"
        with contextlib.suppress(OSError):  # a file system without locks: the exclusive creation has to do
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.path.lexists(self.path) and not self._overwrite:  # published by another process just now
            os.unlink(name, dir_fd=self._folder)
            os.close(descriptor)
            return f"{str(self.path)!r} exists"
        self.file, self._identity = os.fdopen(descriptor, "wb"), os.fstat(descriptor)
        return ""

    def publish(self) -> None:
        """Makes the finished FILE.active the log FILE, in one step and lastingly. Raises OperationFailed, OSError."""
        self.file.flush()
        os.fsync(self.file.fileno())
        here, there = active(self.path).name, self.path.name
        if not self._in_place():
            raise OperationFailed(f"{str(active(self.path))!r} was moved or removed")
        if self._overwrite:
            os.replace(here, there, src_dir_fd=self._folder, dst_dir_fd=self._folder)
        else:
            try:
                self._rename_without_replacing(here, there)
            except FileExistsError:
                raise OperationFailed(f"{str(self.path)!r} was made by another program meanwhile") from None
        os.fsync(self._folder)
        self.close()

    def _rename_without_replacing(self, here: str, there: str) -> None:
        folder = self._folder
        try:
            os.link(here, there, src_dir_fd=folder, dst_dir_fd=folder, follow_symlinks=False)
        except OSError as error:
            if error.errno not in NO_LINKS:
                raise
            if os.path.lexists(self.path):
                raise FileExistsError from None
            os.rename(here, there, src_dir_fd=folder, dst_dir_fd=folder)
        else:
            os.unlink(here, dir_fd=folder)

    def discard(self) -> None:
        """Removes FILE.active, and the folders that were made for it: as if nothing had been begun."""
        if self._in_place():
            os.unlink(active(self.path).name, dir_fd=self._folder)
        self.close()
        self._remove_folders()

    def _remove_folders(self) -> None:
        for folder in self._made:
            with contextlib.suppress(OSError):  # something else has been put there
                folder.rmdir()

    def close(self) -> None:
        """Closes the file, which frees the lock, whatever its buffer still holds."""
        self._where = self.where()
        for close in (self.file.close, lambda: os.close(self._folder)):
            with contextlib.suppress(OSError):
                close()

    def where(self) -> Path | None:
        """Where FILE.active is, or was when it was closed, also if its folder was moved; None if it is gone."""
        if self.file.closed:
            return self._where
        if self._in_place():
            return active(self.path)
        try:
            moved = Path(os.readlink(f"/proc/self/fd/{self.file.fileno()}"))
            same = os.path.samestat(os.stat(moved), self._identity)
        except (OSError, ValueError):
            return None
        return moved if same else None

    def _in_place(self) -> bool:
        """Whether FILE.active is still this file, by its name and in its folder."""
        try:
            inside = os.stat(active(self.path).name, dir_fd=self._folder, follow_symlinks=False)
            named = os.stat(active(self.path), follow_symlinks=False)
        except (OSError, ValueError):
            return False
        return os.path.samestat(self._identity, inside) and os.path.samestat(self._identity, named)


def _names(path: Path) -> Iterator[Path]:
    """run-7.mcap, run-7-2.mcap, run-7-3.mcap, ..."""
    yield path
    for k in itertools.count(2):
        yield path.with_name(f"{path.stem}-{k}{path.suffix}")


def _taken(path: Path, suffixes: Sequence[str]) -> str:
    """Why a log cannot have this name, "" if it can; `suffixes`: of files beside it that count, "" the log itself."""
    unfinished = active(path)
    if os.path.lexists(unfinished):
        if _locked(unfinished):
            return f"{str(path)!r} is being written by another run"
        return f"{str(unfinished)!r} was left by a killed run and is kept (valve-drake recover makes a whole log of it)"
    for suffix in suffixes:
        file = path.with_suffix(suffix) if suffix else path
        if os.path.lexists(file):
            return f"{str(file)!r} exists"
    return ""


def is_being_written(path: Path) -> bool:
    """Whether a program writes this log right now."""
    return _locked(active(path))


def _locked(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False
