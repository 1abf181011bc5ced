"""Real time: a loop that is held to the wall's clock, and how well it kept it.

A tick that is late is not made up for: the next one begins a full period after it did, so that commands never come in
bursts. What was late is counted.
"""

import dataclasses as dc
import math
import time as wall
from collections.abc import Callable

import numpy as np

from valve_drake.messages import Message
from valve_drake.ports import TICK

PACE = "/pace"  # its topic
SHORTEST = 1e-6  # a tick's time that is told from a shorter one [s]
BINS_A_DECADE = 500  # of a tick's time: each is 0.5 % wide, which is how exactly its quantiles are known
_BINS = 8 * BINS_A_DECADE  # up to 100 s


@dc.dataclass(frozen=True, eq=False)
class Pace(Message):
    """How a paced loop has kept its time since its beginning; logged as /pace every second.

    A tick's time: from reading the station to its last command's being published. Median and p99 to 0.5 %.
    """

    time: float = 0.0  # [s]
    ticks: int = 0
    missed: int = 0  # ticks that ended, with all that follows the commands, after the next one should have begun
    lost: float = 0.0  # by how much wall time has run ahead [s]
    median: float = 0.0  # of a tick's time [s]
    p99: float = 0.0
    longest: float = 0.0

    def as_json(self) -> dict[str, float]:
        """What `run --json` says of it."""
        times = {f"{name}_ms": 1e3 * getattr(self, name) for name in ("median", "p99", "longest")}
        return {"ticks": self.ticks, "missed": self.missed, "lost_s": self.lost, **times}


class Pacer:
    """Holds ticks of `period` seconds to the wall's clock. idle(seconds): passes some of the time until the next.

    Ticks' times are counted by their lengths and not kept: a loop may run for days, and a report is made within a tick.
    """

    def __init__(self, period: float = TICK, idle: Callable[[float], None] = wall.sleep):
        self._period = period
        self._idle = idle
        self.due = math.nan  # when the present tick began, or the next one will [s, wall]
        self._counts = np.zeros(_BINS, np.int64)  # ticks by the decimal logarithm of their time
        self._sums = np.zeros(_BINS)  # of the times in each bin [s]
        self._ticks = 0
        self._longest = 0.0
        self._missed = 0
        self._lost = 0.0

    def tick(self, work: Callable[[], None], rest: Callable[[], None] = lambda: None) -> None:
        """Waits until a tick is due, then does its work, whose time is taken, and the rest of it."""
        if math.isnan(self.due):
            self.due = wall.monotonic()
        self.wait(self.due)
        begin = wall.monotonic()
        work()
        self._count(wall.monotonic() - begin)
        rest()
        end = wall.monotonic()
        self.due += self._period
        if end > self.due:
            self._missed += 1
            self._lost += end - self.due
            self.due = end

    def _count(self, seconds: float) -> None:
        decades = math.log10(max(seconds / SHORTEST, 1.0))
        k = min(int(decades * BINS_A_DECADE), _BINS - 1)
        self._counts[k] += 1
        self._sums[k] += seconds
        self._ticks += 1
        self._longest = max(self._longest, seconds)

    @property
    def lost(self) -> float:
        """By how much the loop is behind the wall's clock [s]."""
        return self._lost

    def wait(self, until: float) -> None:
        """Until the wall's clock says so."""
        while (left := until - wall.monotonic()) > 0:
            self._idle(left)

    def report(self, time: float) -> Pace:
        """How it went so far. time: of the loop's own clock [s]."""
        return Pace(
            time=time,
            ticks=self._ticks,
            missed=self._missed,
            lost=self._lost,
            median=self._quantile(0.5),
            p99=self._quantile(0.99),
            longest=self._longest,
        )

    def _quantile(self, share: float) -> float:
        """Below which so many of the ticks' times are: the mean of those in its bin [s]."""
        if not self._ticks:
            return 0.0
        k = int(np.searchsorted(np.cumsum(self._counts), share * self._ticks))
        return float(self._sums[k] / self._counts[k])
