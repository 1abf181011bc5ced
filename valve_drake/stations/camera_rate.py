"""How many images a twin makes: fewer while it cannot keep real time, and never so few that a camera looks dead.

The plant has to keep to the wall's clock, its images need not: a camera of half the rate makes the program slower, a
robot that is late makes it wrong. So the cameras' periods are doubled while time is lost or a renderer cannot follow,
down to a floor, and halved again when there has been room for a while.
"""

import dataclasses as dc
import math
from collections.abc import Callable, Mapping

from valve_drake.checks import require
from valve_drake.messages import CAMERAS
from valve_drake.stations.simulation_config import CameraConfig

SECOND = 1.0  # between two judgements [s, wall]
BEHIND = 0.03  # share of a second that may be lost; raise it for a machine whose clock stutters
# Seconds without loss before the cameras are faster again; doubled whenever that was too early, up to the other.
ROOM, MOST_ROOM = 4, 64
HOPELESS = 0.5  # share of a second that was lost: no program can work with that, and it is told why


@dc.dataclass(frozen=True)
class Limits:
    """What the periods of a twin's cameras may be [s]."""

    fastest: dict[str, float]
    slowest: float  # the floor
    age: float  # of a camera, after which the program calls it dead


def limits(camera: CameraConfig, max_age: Mapping[str, float]) -> Limits:
    """Of a scenario. max_age: of a device, after which the program calls it dead [s]. Two images are never farther
    apart than the floor and the time that the second one takes, so the floor is at most half of the least such age.

    Raises ConfigError for a camera that is slower than that by its own period.
    """
    least = min(max_age[name] for name in CAMERAS)
    fastest = {name: camera.period(name) for name in CAMERAS}
    for key, period in (("head_period", camera.head_period), ("wrist_period", camera.wrist_period)):
        rule = f"for a twin at most half of supervisor.max_age of the cameras, {least / 2:g} s"
        require(period <= least / 2, f"simulation.camera.{key}", rule, period)
    slowest = max(min(camera.slowest_period, least / 2), *fastest.values())
    return Limits(fastest, slowest, least)


class CameraRate:
    """Slows the cameras by a factor, a power of two. notice: tells the user, one line."""

    def __init__(self, limits: Limits, notice: Callable[[str], None]):
        self.limits = limits
        self.factor = self.largest = 1  # now, and so far
        self.trouble = ""  # why no program can work with this twin now
        self.loops_first = False  # the twin's loop goes before the machine's other programs
        self._notice = notice
        self._most = {  # a camera captures at multiples of its own period only
            camera: 2 ** math.floor(math.log2(limits.slowest / period)) for camera, period in limits.fastest.items()
        }
        self._calm, self._patience = 0, ROOM
        self._told_floor = False

    def period(self, camera: str) -> float:
        """Between two images, now [s]."""
        return min(self.factor, self._most[camera]) * self.limits.fastest[camera]

    def judge(self, lost: float, took: Mapping[str, float]) -> None:
        """After a second. lost: share of it by which the twin fell behind the clock. took: by camera, the mean time
        that one of its images needed, from the capture [s]."""
        self.trouble = f"the twin is {100 * lost:.0f} % slower than real time" if lost > HOPELESS else ""
        late = {camera: time for camera, time in took.items() if time > self.period(camera)}
        if lost > BEHIND or late:
            if self._calm < 2 and self.factor < self.largest:  # it has just been made faster
                self._patience = min(2 * self._patience, MOST_ROOM)
            self._calm = 0
            self._slower(lost, late)
            return
        self._calm += 1
        room = all(2 * time < self.period(camera) for camera, time in took.items())
        if self._calm >= self._patience and room and self.factor > 1:
            self.factor //= 2
            self._calm = 0

    def _slower(self, lost: float, late: Mapping[str, float]) -> None:
        words = f"is {100 * lost:.0f} % slower than real time"
        if late and lost <= BEHIND:
            camera = max(late, key=lambda name: late[name])
            words = f"needs {1e3 * late[camera]:.0f} ms for an image of {camera}"
        if self.factor < max(self._most.values()):
            self.factor *= 2
            if self.factor > self.largest:
                self.largest = self.factor
                self._notice(f"the twin {words}: its cameras go down to {self._rates()}; {self._help()}")
        elif lost > BEHIND and not self._told_floor:
            self._told_floor = True
            self._notice(
                f"the twin {words} with its cameras at the floor, {self._rates()}: it goes on, slower; {self._help()}"
            )

    def _help(self) -> str:
        allowed = "" if self.loops_first else ", or leave to go before them (docs/hardware.md)"
        return f"fewer programs beside it, or --set simulation.camera.supersample=1{allowed}, would help"

    def _rates(self) -> str:
        """For people."""
        rates = sorted({1 / self.period(camera) for camera in CAMERAS})
        return " and ".join(f"{rate:.3g}" for rate in rates) + " Hz"
