"""Faults of a robot and of the wire to it, for rehearsals: the twin has those that the scenario's key `faults` lists.

| kind      | what it does to `device` ("" is every device)                                            | numbers       |
|-----------|------------------------------------------------------------------------------------------|---------------|
| latency   | its messages, commands and reports, take `delay` +- `jitter` longer                      | delay, jitter |
| loss      | this share of its messages is lost                                                       | share         |
| duplicate | this share of its messages comes twice                                                   | share         |
| reorder   | this share of its messages is overtaken by the next one                                  | share         |
| frozen    | its reports and images repeat the last ones                                              |               |
| nan       | its reports are not numbers                                                              |               |
| dead      | it reports nothing, takes no commands: a camera without images, a driver that crashed    |               |
| restart   | as dead, and then its clock begins anew; needs a `duration`                              | duration      |
| stuck     | one joint of an arm or of the torso does not move                                        | joint         |
| estop     | the emergency stop of the whole robot is pressed                                         |               |

A fault begins `start` seconds after the run's beginning, or after `mode` was first entered, and lasts `duration`
(0: to the end). Random choices are drawn from the seed.
"""

import dataclasses as dc
import math
import zlib
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from valve_drake.checks import require
from valve_drake.config import Config, choice, number
from valve_drake.messages import DEVICES, Mode
from valve_drake.ports import TICK
from valve_drake.robot.description import MOST_JOINTS
from valve_drake.robot.groups import GROUPS
from valve_drake.stations.lcm_channels import CHANNELS

WIRE = ("latency", "loss", "duplicate", "reorder")
DEVICE = ("frozen", "nan", "dead", "restart", "stuck", "estop")


@dc.dataclass
class FaultConfig(Config):
    """One entry of the scenario's key `faults`."""

    KEY = "faults"
    kind: str = choice("latency", WIRE + DEVICE, "what goes wrong")
    device: str = choice("", ("", *DEVICES), "of which; empty: of all")
    mode: str = choice("", ("", *(mode.value for mode in Mode)), "begins with this mode; empty: with the run")
    start: float = number(0.0, 0.0, 3600.0, "after that [s]")
    duration: float = number(0.0, 0.0, 3600.0, "0: to the end [s]")
    share: float = number(0.0, 0.0, 1.0, "of messages")
    delay: float = number(0.0, 0.0, 5.0, "of messages [s]")
    jitter: float = number(0.0, 0.0, 5.0, "half the width of an even spread of the delay [s]")
    joint: int = number(0, 0, MOST_JOINTS + 2, "that is stuck")

    def relations(self, key: str) -> None:
        require(self.jitter <= self.delay, f"{key}.jitter", f"at most the delay, {self.delay:g}", self.jitter)
        if self.kind == "restart":
            require(self.duration > 0, f"{key}.duration", "> 0 for a restart", self.duration)
        if self.kind == "stuck":
            require(self.device in GROUPS, f"{key}.device", f"one of {', '.join(GROUPS)} for stuck", self.device)


class Faults:
    """Which faults act, and what they do. Times are the robot's [s]."""

    def __init__(self, faults: Iterable[FaultConfig], seed: int):
        self._faults = list(faults)
        self._draw = [
            np.random.Generator(np.random.SFC64([seed, zlib.crc32(f"{k} {f.kind} {f.device}".encode())]))
            for k, f in enumerate(self._faults)
        ]
        self._entered: dict[str, float] = {"": 0.0}
        self._kept: dict[str, Any] = {}  # a frozen device's last report, and a stuck joint's position

    def enter(self, mode: str, time: float) -> None:
        """The program has entered a mode."""
        self._entered.setdefault(mode, time)

    def _window(self, fault: FaultConfig) -> tuple[float, float]:
        begin = self._entered.get(fault.mode, math.inf) + fault.start
        return begin, begin + (fault.duration or math.inf)

    def _acting(self, kind: str, device: str, time: float) -> Iterable[tuple[FaultConfig, np.random.Generator]]:
        for fault, draw in zip(self._faults, self._draw):
            begin, end = self._window(fault)
            if fault.kind == kind and fault.device in ("", device) and begin <= time < end:
                yield fault, draw

    def acts(self, kind: str, device: str, time: float) -> bool:
        """Whether a fault of this kind acts on the device now."""
        return any(True for _ in self._acting(kind, device, time))

    def silent(self, device: str, time: float) -> bool:
        """The device neither reports nor listens."""
        return self.acts("dead", device, time) or self.acts("restart", device, time)

    def clock(self, device: str, time: float) -> float:
        """The device's clock: it begins anew when a restart is over."""
        ends = [self._window(f)[1] for f in self._faults if f.kind == "restart" and f.device in ("", device)]
        return time - max((end for end in ends if end <= time), default=0.0)

    def frozen(self, key: str, time: float, now: Any) -> Any:
        """The report `now`, or the one at which the device froze."""
        if self.acts("frozen", CHANNELS[key].device, time):
            return self._kept.setdefault(key, now)
        self._kept.pop(key, None)
        return now

    def stuck(self, device: str, time: float, command: np.ndarray, measured: np.ndarray) -> np.ndarray:
        """A position command (n,) with the stuck joints where they stand."""
        now = {fault.joint for fault, _ in self._acting("stuck", device, time)}
        for joint in {fault.joint for fault in self._faults if fault.kind == "stuck"} - now:
            self._kept.pop(f"{device} {joint}", None)  # it may have moved when it sticks again
        if now:
            command = command.copy()
        for joint in now:
            command[joint] = self._kept.setdefault(f"{device} {joint}", measured[joint])
        return command

    def arrivals(self, device: str, time: float) -> list[float]:
        """When a message that is sent now arrives: no time if it is lost, two if it comes twice."""
        if any(draw.random() < fault.share for fault, draw in self._acting("loss", device, time)):
            return []
        delay = sum(f.delay + f.jitter * draw.uniform(-1, 1) for f, draw in self._acting("latency", device, time))
        if any(draw.random() < fault.share for fault, draw in self._acting("reorder", device, time)):
            delay += 1.5 * TICK
        twice = any(draw.random() < fault.share for fault, draw in self._acting("duplicate", device, time))
        return [time + delay] * (2 if twice else 1)


class Wire:
    """One direction of the wire with its faults: messages in, and out when they are due."""

    def __init__(self, faults: Faults, deliver: Callable[[str, Any], None], newest_only: bool):
        """newest_only: of messages of one channel that are due at once the last one only is delivered, as a receiver
        with room for a single one would have it."""
        self._faults = faults
        self._deliver = deliver
        self._newest_only = newest_only
        self._waiting: list[tuple[float, str, Any]] = []

    def put(self, key: str, message: Any, time: float) -> None:
        """A message sent at `time` on the channel `key`."""
        for when in self._faults.arrivals(CHANNELS[key].device, time):
            self._waiting.append((when, key, message))

    def pass_on(self, time: float) -> None:
        """Delivers what is due, first due first."""
        due = sorted((item for item in self._waiting if item[0] <= time), key=lambda item: item[0])
        self._waiting = [item for item in self._waiting if item[0] > time]
        if self._newest_only:
            due = list({key: (when, key, message) for when, key, message in due}.values())
        for _, key, message in due:
            self._deliver(key, message)
