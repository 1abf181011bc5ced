"""Images made beside the run: a process for the left eye of each pair and one for the right.

After the contact physics, rendering costs most of a run's time, and an image depends only on the positions at its
capture. So its rendering begins at the capture if a block will probably look at it, and the image is fetched when one
does: the same bits as `CameraRig.frame`, sooner. A wrong guess costs time and changes no result.
"""

import collections
import contextlib
import dataclasses as dc
import multiprocessing.connection
import multiprocessing.context
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import cv2
import numpy as np

from valve_drake import profiling
from valve_drake.beside import can_fork, fork
from valve_drake.checks import OperationFailed
from valve_drake.messages import CAMERAS, HEAD, WRISTS, CameraFrame
from valve_drake.stations import render_egl
from valve_drake.stations.camera_rig import CameraRig, Capture, decoded
from valve_drake.stations.contract import MATE

WORKERS = 2  # one for each eye of a pair, see `_worker`
NICENESS = 5  # of the processes: the run goes first where processors are few. 0 where a late image does more harm
KEPT = 8  # captures of a camera that may still be asked for


@dc.dataclass
class _Worker:
    process: "subprocess.Popen[bytes] | multiprocessing.context.ForkProcess"
    wait: Callable[[], int]  # until it has ended -> its exit code, or minus the signal that ended it
    wire: multiprocessing.connection.Connection

    @property
    def pid(self) -> int:
        pid = self.process.pid
        assert pid is not None  # it was started
        return pid


class CameraWorkers:
    """Makes images in other processes while open. Use: `with CameraWorkers(*rig) as workers:`; rig: of CameraRig.

    niceness: of the processes, as os.nice takes it. Entering raises OperationFailed if they cannot be started.

    A process with one thread is forked, which spares the workers the imports and each a rig of its own; one with more
    cannot be forked safely, and starts new ones. So it is cheapest to enter before anything that keeps a thread.
    """

    def __init__(self, *rig: Any, niceness: int = NICENESS) -> None:
        self._rig = rig
        self._niceness = niceness
        self._workers: list[_Worker] = []
        self._captures: dict[str, collections.deque[Any]] = {name: collections.deque(maxlen=KEPT) for name in CAMERAS}
        self._asked: dict[str, dict[int, Capture]] = {name: {} for name in CAMERAS}
        self._made: dict[tuple[str, int], CameraFrame] = {}
        self._spent: dict[int, list[float]] = {}  # by process: until it was ready, and since [s]
        self._read: dict[str, tuple[int, int]] = {}  # sequence read last, and how many captures after the one before

    def __enter__(self) -> "CameraWorkers":
        rig = CameraRig(*self._rig) if _can_fork() else None
        try:
            self._start(rig)
        except BaseException as error:  # those that run already must not stay
            self.__exit__()
            if isinstance(error, OSError):
                raise OperationFailed(f"no process to render in can be started: {error.strerror}") from error
            raise
        return self

    def _start(self, rig: CameraRig | None) -> None:
        for _ in range(WORKERS):
            here, there = socket.socketpair()
            wire = multiprocessing.connection.Connection(here.detach())
            with there:
                if rig is not None:
                    mine = [*(worker.wire for worker in self._workers), wire]
                    copy, wait = _fork(rig, there.fileno(), self._niceness, mine)
                    self._workers.append(_Worker(copy, wait, wire))
                else:
                    process, wait = _spawn(there.fileno(), self._niceness)
                    self._workers.append(_Worker(process, wait, wire))
                    _send(wire, self._rig)

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.wire.close()
            worker.process.terminate()  # the closed wire would end it, but only after the image that it makes
        for worker in self._workers:
            worker.wait()
        self._workers = []

    @property
    def spent(self) -> tuple[float, float]:
        """Processor time of the processes, until they could make images and for those that have come [s]."""
        return sum(s[0] for s in self._spent.values()), sum(s[1] for s in self._spent.values())

    def captured(self, name: str, capture: Capture) -> None:
        """Begins the image if the reader's habit says that this one will be looked at."""
        self._captures[name].append(capture)
        last, stride = self._read.get(name, (0, 0))
        if stride and capture.sequence == last + stride:
            self._ask(name, capture)

    def frame(self, name: str, capture: Capture) -> CameraFrame:
        """The image of a capture. Raises OperationFailed if the process that makes it has ended."""
        self._ask(name, capture)
        mate = MATE[name]  # a block that reads one eye reads the other next
        for other in self._captures[mate]:
            if (other.sequence, other.time) == (capture.sequence, capture.time):
                self._ask(mate, other)
        while (name, capture.sequence) not in self._made:
            self._receive(name)
        last, stride = self._read.get(name, (capture.sequence, 0))
        self._read[name] = (capture.sequence, capture.sequence - last if capture.sequence > last else stride)
        frame = self._made[name, capture.sequence]
        if frame.image.size == 0:  # decoded where it is looked at: pixels cost more on their way than a JPEG
            frame = self._made[name, capture.sequence] = decoded(frame)
        for sequence in [s for s in self._asked[name] if s < capture.sequence and (name, s) in self._made]:
            del self._asked[name][sequence], self._made[name, sequence]
        return frame

    def _ask(self, name: str, capture: Capture) -> None:
        asked = self._asked[name].get(capture.sequence)
        if asked is not None and asked.time == capture.time and np.array_equal(asked.q, capture.q):
            return
        if asked is not None:  # a simulation begun anew
            while (name, capture.sequence) not in self._made:
                self._receive(name)
            del self._made[name, capture.sequence]
        self._asked[name][capture.sequence] = capture
        with self._wire(name) as wire:
            _send(wire, (name, capture))

    def _receive(self, name: str) -> None:
        with self._wire(name) as wire:
            with profiling.work(profiling.WAITING):
                wire.poll(None)
            frame, *spent = _recv(wire)
        self._spent[self._worker(name).pid] = spent
        self._made[frame.camera, frame.sequence] = frame

    def _receive_all(self) -> None:
        """What is there; nobody waits."""
        for name in HEAD:  # one camera of each process
            while self._workers and self._worker(name).wire.poll():
                self._receive(name)

    def _worker(self, name: str) -> _Worker:
        """One process for the left eye of each pair, one for the right."""
        pair = HEAD if name in HEAD else WRISTS
        return self._workers[pair.index(name)]

    @contextlib.contextmanager
    def _wire(self, name: str) -> Iterator[multiprocessing.connection.Connection]:
        """The wire to the process that makes this camera's images; names it if it has ended."""
        worker = self._worker(name)
        try:
            yield worker.wire
        except (EOFError, OSError) as error:
            code = worker.wait()
            raise OperationFailed(f"the process that renders {name} ended with code {code}") from error


def _send(wire: multiprocessing.connection.Connection, thing: Any) -> None:
    # Not wire.send: it pickles into a buffer, and CPython 3.12 crashes when that of a failed call is garbage-collected.
    wire.send_bytes(pickle.dumps(thing, pickle.HIGHEST_PROTOCOL))


def _recv(wire: multiprocessing.connection.Connection) -> Any:
    return pickle.loads(wire.recv_bytes())


def _can_fork() -> bool:
    """Whether a copy of this process would work: also without OpenGL, that is no copy of its own."""
    return can_fork() and not render_egl.is_open()


def _fork(
    rig: CameraRig, fd: int, niceness: int, mine: Sequence[multiprocessing.connection.Connection]
) -> tuple[multiprocessing.context.ForkProcess, Callable[[], int]]:
    """A copy of this process serves `fd`; mine: wires of this process, that the copy must not keep open."""
    process = fork(_serve_copy, rig, fd, niceness, mine)

    def wait() -> int:
        process.join()
        return process.exitcode or 0

    return process, wait


def _serve_copy(rig: CameraRig, fd: int, niceness: int, mine: Sequence[multiprocessing.connection.Connection]) -> None:
    for wire in mine:
        wire.close()
    serve(fd, niceness, rig)


def _spawn(fd: int, niceness: int) -> tuple[subprocess.Popen[bytes], Callable[[], int]]:
    """A new process serves `fd`."""
    code = f"from valve_drake.stations.camera_workers import serve; serve({fd}, {niceness})"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        pass_fds=[fd],
        process_group=0,  # as in a copy
    )
    return process, process.wait


def serve(fd: int, niceness: int, rig: CameraRig | None = None) -> None:
    """The other process: makes what it is asked for with a rig that it has or is told of, ends when nobody is left to
    ask."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run decides when it ends
    os.environ.setdefault("LP_NUM_THREADS", "0")  # of Mesa: handing an image's tiles to threads takes 3 % more
    os.nice(niceness)
    cv2.setNumThreads(1)
    wire = multiprocessing.connection.Connection(fd)
    try:
        if rig is None:
            rig = CameraRig(*_recv(wire))
        start_up = time.process_time()
        while True:
            name, capture = _recv(wire)
            frame = rig.exposed(name, capture)
            _send(wire, (frame, start_up, time.process_time() - start_up))
    except (EOFError, ConnectionError):
        pass
