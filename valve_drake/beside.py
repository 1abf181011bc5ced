"""Work beside the run, in copies of this process (fork): they share what it has imported and built."""

import contextlib
import gc
import mmap
import multiprocessing.context
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from valve_drake import profiling

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # that the program answers in its own way
_DONE, _FAILED = b"d", b"f"
PATIENCE = 0.02  # longer waits in all than the work would have taken here are a sign of a busy machine [s]
REST = 512  # questions that are then answered here; raise it where a busy machine stays busy
harmless_threads = 0  # of whoever runs the program in a process of its own: they hold no lock that a copy may need


def can_fork() -> bool:
    """Whether a copy of this process would work: it must have no threads but harmless ones."""
    try:
        return len(os.listdir("/proc/self/task")) <= 1 + harmless_threads
    except OSError:  # no Linux
        return False


def fork(work: Callable[..., object], *arguments: Any) -> multiprocessing.context.ForkProcess:
    """A copy of this process does `work`, untroubled by the terminal's signals, and ends."""
    process = multiprocessing.context.ForkProcess(target=_in_copy, args=(work, *arguments), daemon=True)
    old = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # until the copy has put away the program's answers
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old)
    return process


def _in_copy(work: Callable[..., object], *arguments: Any) -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    os.setpgid(0, 0)  # a terminal's signals are for the run; in its session Linux weighs both by their niceness
    gc.freeze()  # what was copied stays shared
    work(*arguments)


class Beside:
    """A pure function of a vector, computed in a copy of this process while this one does something else.

        with Beside(f, 3, 2) as beside:  # f: (3,) -> (2,)
            beside.begin(question)
            ...
            answer = beside.answer(question)  # f(question), to the bit

    What was not begun, or another question, or one that the copy failed at, is computed here: so a guess that turns
    out wrong costs time and changes nothing. All of it is computed here where no copy can be made (`can_fork`), and for
    a while where no processor is free for the copy: then waiting for it takes longer than the work.
    """

    def __init__(self, function: Callable[[np.ndarray], np.ndarray], asks: int, answers: int):
        self._function = function
        memory = np.frombuffer(mmap.mmap(-1, 8 * (asks + answers + 1)), float)  # shared with the copy
        self._question, self._answer, self._clock = memory[:asks], memory[asks:-1], memory[-1:]
        self._asked = b""  # the question that the copy is at, as bytes
        self._process: multiprocessing.context.ForkProcess | None = None
        self._wires: tuple[int, ...] = ()  # here: to write to, to read from
        self._lock = threading.Lock()
        self._begun = 0.0  # `spent` when it was asked
        self._won = 0.0  # time that the copy has saved of late, negative if it has cost some [s]
        self._rest = 0  # questions that will not be begun

    @property
    def spent(self) -> float:
        """Processor time of the copy [s]."""
        return float(self._clock[0])

    def __enter__(self) -> Self:
        if can_fork():
            ask, asked = os.pipe()
            told, tell = os.pipe()
            self._process = fork(self._serve, ask, tell, (asked, told))
            os.close(ask)
            os.close(tell)
            self._wires = (asked, told)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for wire in self._wires:
            os.close(wire)  # which ends the copy
        self._wires, self._asked = (), b""
        if self._process is not None:
            self._process.join()

    def begin(self, question: np.ndarray) -> None:
        """Begins what will probably be asked. What was begun before and never asked for is waited for and lost."""
        with self._lock:
            self._finish()
            if self._rest > 0:
                self._rest -= 1
            elif self._wires:
                self._question[:] = question
                self._begun, start = self.spent, time.perf_counter()
                with contextlib.suppress(OSError):  # the copy has ended
                    os.write(self._wires[0], _DONE)
                    self._asked = question.tobytes()
                self._won -= time.perf_counter() - start

    def answer(self, question: np.ndarray) -> np.ndarray:
        """The function's value."""
        with self._lock:
            if self._asked and self._asked == question.tobytes() and self._finish():
                return self._answer.copy()
        return self._function(question)

    def _finish(self) -> bool:
        """Waits until the copy has nothing to do -> whether it has answered what it was asked."""
        if not self._asked:
            return False
        self._asked = b""
        start = time.perf_counter()
        with profiling.work(profiling.WAITING):
            done = os.read(self._wires[1], 1) == _DONE  # nothing at all, if it has ended
        self._won = min(self._won + self.spent - self._begun - (time.perf_counter() - start), PATIENCE)
        if self._won < -PATIENCE:
            self._won, self._rest = 0.0, REST
        return done

    def _serve(self, ask: int, tell: int, others: Sequence[int]) -> None:
        for wire in others:
            os.close(wire)
        with contextlib.suppress(OSError, AttributeError):  # Linux: whoever asks goes on, also on a single processor
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        while os.read(ask, 1):  # until nobody is left to ask
            try:
                self._answer[:] = self._function(self._question)
                word = _DONE
            except Exception:  # it is told where the question is computed again
                word = _FAILED
            self._clock[0] = time.process_time()
            try:
                os.write(tell, word)
            except OSError:
                return
