"""Whose turn it is on the processor: a paced loop goes before the machine's other programs, its renderers go last.

On a machine with something else to do, a loop of 128 Hz is late because it waits for a processor, not because its work
takes long. Linux has a class for such loops (SCHED_FIFO). Who may use it is the administrator's decision
(RLIMIT_RTPRIO, CAP_SYS_NICE), so it is asked for, and not needed where the machine has a processor to spare.
"""

import contextlib
import os
import sys
import threading
from collections.abc import Iterator

HIGHEST = 50  # priority that may be asked for: the kernel's own threads, which serve the network, have 50 and above
YIELDING = 10  # niceness of a renderer: beside a busy program it keeps a tenth of a processor, and does not starve


@contextlib.contextmanager
def goes_first(priority: int) -> Iterator[bool]:
    """While it is open, this process's threads run before the machine's other programs, the calling one first.

    -> whether the system permits it. priority: of the calling thread, up to HIGHEST; below 2 nothing is asked for.
    """
    before = _raised(priority) if priority > 1 and sys.platform == "linux" else {}
    try:
        yield bool(before)
    finally:
        for thread, (policy, parameter) in before.items():
            with contextlib.suppress(OSError):  # the thread has ended
                os.sched_setscheduler(thread, policy, parameter)


def hurries(process: int, hurried: bool) -> None:
    """Lets another process go before the machine's other programs, but after the paced loops, or no longer."""
    with contextlib.suppress(OSError):  # not permitted, or it has ended
        for thread in map(int, os.listdir(f"/proc/{process}/task")):
            parameter = os.sched_param(1 if hurried else 0)
            os.sched_setscheduler(thread, os.SCHED_FIFO if hurried else os.SCHED_OTHER, parameter)


def _raised(priority: int) -> dict[int, tuple[int, os.sched_param]]:
    """Gives all threads the priority, the others one less -> what each had before; nothing if it is not permitted."""
    before: dict[int, tuple[int, os.sched_param]] = {}
    here = threading.get_native_id()
    others = [thread for thread in map(int, os.listdir("/proc/self/task")) if thread != here]
    with contextlib.suppress(OSError):  # not permitted, or a thread has ended
        for thread in (here, *others):
            had = os.sched_getscheduler(thread), os.sched_getparam(thread)
            os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority - (thread != here)))
            before[thread] = had
    return before
