"""Images made beside the run: a process for the left eye of each pair and one for the right.

After the contact physics, rendering costs most of a run's time, and an image depends only on the positions at its
capture. So its rendering begins at the capture if a block will probably look at it, and the image is fetched when one
does: the same bits as `CameraRig.frame`, sooner. A wrong guess costs time and changes no result.
"""

import collections
import contextlib
import dataclasses as dc
import multiprocessing.connection
import os
import pickle
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from valve_drake.checks import OperationFailed
from valve_drake.messages import CameraFrame
from valve_drake.ports import profile
from valve_drake.stations.camera_rig import CameraRig, Capture
from valve_drake.stations.contract import CAMERAS, HEAD, MATE, WRISTS

WORKERS = 2
KEPT = 8  # captures of a camera that may still be asked for


@dc.dataclass
class _Worker:
    process: subprocess.Popen[bytes]
    wire: multiprocessing.connection.Connection


class CameraWorkers:
    """Makes images in other processes while open; `start` says of what. Use: `with CameraWorkers() as workers:`."""

    def __init__(self) -> None:
        self._workers: list[_Worker] = []
        self._captures: dict[str, collections.deque[Any]] = {name: collections.deque(maxlen=KEPT) for name in CAMERAS}
        self._asked: dict[str, dict[int, Capture]] = {name: {} for name in CAMERAS}
        self._made: dict[tuple[str, int], CameraFrame] = {}
        self._read: dict[str, tuple[int, int]] = {}  # sequence read last, and how many captures after the one before

    def __enter__(self) -> "CameraWorkers":
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.wire.close()
            worker.process.terminate()  # the closed wire would end it, but only after the image that it makes
        for worker in self._workers:
            worker.process.wait()
        self._workers = []

    def start(self, *rig: object) -> "CameraWorkers":
        """Starts the processes. rig: the arguments of CameraRig."""
        for _ in range(WORKERS):
            here, there = socket.socketpair()
            with there:
                code = f"from valve_drake.stations.camera_workers import serve; serve({there.fileno()})"
                process = subprocess.Popen(
                    [sys.executable, "-c", code],
                    pass_fds=[there.fileno()],
                    start_new_session=True,  # a terminal's signals are for the run, which decides when this ends
                )
            worker = _Worker(process, multiprocessing.connection.Connection(here.detach()))
            _send(worker.wire, rig)
            self._workers.append(worker)
        return self

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
            frame, seconds = _recv(wire)
        profile.render_worker_seconds += seconds
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
            code = worker.process.wait()
            raise OperationFailed(f"the process that renders {name} ended with code {code}") from error


def _send(wire: multiprocessing.connection.Connection, thing: Any) -> None:
    # Not wire.send: it pickles into a buffer, and CPython 3.12 crashes when that of a failed call is garbage-collected.
    wire.send_bytes(pickle.dumps(thing, pickle.HIGHEST_PROTOCOL))


def _recv(wire: multiprocessing.connection.Connection) -> Any:
    return pickle.loads(wire.recv_bytes())


def serve(fd: int) -> None:
    """The other process: builds the rig, makes what it is asked for, ends when nobody is left to ask."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the run decides when it ends
    os.nice(5)  # the run goes first where processors are few
    cv2.setNumThreads(1)
    wire = multiprocessing.connection.Connection(fd)
    try:
        rig = CameraRig(*_recv(wire))
        while True:
            name, capture = _recv(wire)
            begin = time.process_time()
            frame = rig.frame(name, capture)
            _send(wire, (frame, time.process_time() - begin))
    except (EOFError, ConnectionError):
        pass
