"""A replay in two halves at once, in two processes: is everything as it was recorded?

Each half steps some of the blocks and shows what the others sent as it was recorded. If all that both make is what was
recorded, all blocks together make it, too: the first message in time that they made otherwise would come of a block
whose inputs were as recorded until then, and so the half that has this block would have made it. If anything differs,
this says so and no more: how it spreads, only all blocks together show.
"""

import contextlib
import multiprocessing.connection
import pickle
import socket
from collections.abc import Callable, Iterator

from valve_drake.analysis.comparison import TopicDifference
from valve_drake.beside import can_fork, fork
from valve_drake.diagram import recorded_from
from valve_drake.recording.recorder_system import Signal

# The half of the other process takes about half of the time, and what it exchanges with the rest is recorded whole.
BESIDE = frozenset(
    (
        "color_segmentation",
        "line_fitting",
        "stereo_positioning",
        "rectangle_estimator",
        "handle_marker",
        "hybrid_rotation",
    )
)
BOTH = "robot_state"  # no log holds all of its messages
_MACHINE = "station"
JOINED_FROM = {"measured": _MACHINE, "commanded": "command_selector"}  # whose ports the recorder's joined ones are


def plays(beside: bool) -> Callable[[str], bool]:
    """Which blocks a half steps, by name."""
    return lambda block: block == BOTH or (block in BESIDE) == beside


def topics_beside(table: list[Signal]) -> set[str]:
    """The topics that the half in the other process makes, whole ones of the recorder's table, and the machine's."""
    owners: dict[str, set[str]] = {}
    for row in table:
        owners.setdefault(row.topic, set()).update(map(_owner, row.inputs))
    return {topic for topic, blocks in owners.items() if blocks <= {*BESIDE, _MACHINE}}


def _owner(port: str) -> str:
    """The block that a port of the recorder shows."""
    return JOINED_FROM.get(port) or recorded_from(port).partition(".")[0]


class Different(Exception):
    """Something is not as it was recorded."""


Topics = dict[str, TopicDifference]


@contextlib.contextmanager
def beside(work: Callable[[], Topics]) -> Iterator[Callable[[bool], Topics]]:
    """Does `work` in a copy of this process -> what tells what it has come to; nothing before it is done, unless it is
    told to wait.

    That raises Different if the work has failed, in whatever way. Raises Different where no copy can be made.
    """
    if not can_fork():
        raise Different
    here, there = socket.socketpair()
    wire = multiprocessing.connection.Connection(here.detach())
    with there:
        process = fork(_answer, work, there, wire)

    found: list[Topics | None] = []

    def topics(wait: bool) -> Topics:
        if not found:
            if not wire.poll(None if wait else 0):
                return {}
            try:
                found.append(pickle.loads(wire.recv_bytes()))
            except EOFError:
                found.append(None)
        if found[0] is None:
            raise Different
        return found[0]

    try:
        yield topics
    finally:
        wire.close()
        process.terminate()
        process.join()


def _answer(work: Callable[[], Topics], there: socket.socket, mine: multiprocessing.connection.Connection) -> None:
    """In the copy. mine: of the process that asks."""
    mine.close()
    found: Topics | None
    try:
        found = work()
    except Exception:  # all blocks together will fail in the same way, and say so
        found = None
    multiprocessing.connection.Connection(there.detach()).send_bytes(pickle.dumps(found))
