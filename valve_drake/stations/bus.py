"""One side's end of the LCM bus: its table's channels, signatures, and who else is on the bus.

Every process on a bus says a random number of its own, so that two robots, or two programs, notice each other.
`Bus.claim` listens before it speaks: who comes second is refused, and who is there already is not disturbed.
"""

import dataclasses as dc
import functools
import secrets
import time as wall
from collections.abc import Callable, Mapping
from typing import Any

from pydrake.lcm import DrakeLcm

from valve_drake.checks import OperationFailed
from valve_drake.stations.lcm_channels import (
    CHANNELS,
    PRESENCE,
    ROBOT,
    UNCOUNTED,
    Channel,
    HardwareConfig,
    WrongMessage,
    read_presence,
    signal,
)
from valve_drake.stations.network import check_route, group_of, only_own_groups
from valve_drake.stations.reports import Senders
from valve_drake.stations.signing import Forged, Seal, load_key

LISTEN = 0.5  # a newcomer listens for so long, then says that it is there and listens as long again [s]
ANNOUNCED = 0.125  # every process says so often that it is there [s]


@dc.dataclass(frozen=True)
class BadMessage:
    """What came on a channel and cannot be read; `words` say why."""

    words: str


class Bus:
    """One side's ends of all channels.

    heard(key, message): called from `pump` for what the other side sent; a BadMessage if it cannot be read.
    Raises ConfigError if the bus would reach further than `hardware.network` says, or for a bad key.
    """

    def __init__(self, config: HardwareConfig, lcm: DrakeLcm | None = None):
        self.config = config
        self.sent = 0  # messages that lock-step counts
        self.senders = Senders()
        self.clock = wall.monotonic
        self._seal = Seal(load_key(config.key_file)) if config.key_file else None
        self._names = {key: config.channels.get(key, row.default_name) for key, row in CHANNELS.items()}
        self._instance = float(1 + secrets.randbits(48))
        self._announced = float("-inf")
        self._group = group_of(config.lcm_url) if lcm is None else None
        if lcm is None:
            check_route(config.lcm_url, config.network)
            try:
                lcm = DrakeLcm(config.lcm_url)
            except RuntimeError as error:
                raise OperationFailed(f"LCM cannot open {config.lcm_url}: {str(error).splitlines()[0]}") from error
        self.lcm = lcm
        for role, key in PRESENCE.items():
            self._subscribe(CHANNELS[key], functools.partial(self._present, role))

    def listen(self, sender: str, heard: Callable[[str, Any], None], between: str = ROBOT) -> None:
        """Hears all that `sender` says between the program and a robot, or an operator."""
        for row in CHANNELS.values():
            if (row.sender, row.between) == (sender, between) and row.key not in PRESENCE.values():
                self._subscribe(row, heard)

    def _subscribe(self, row: Channel, heard: Callable[[str, Any], None]) -> None:
        def take(data: bytes) -> None:
            try:
                message = self._decoded(row, data)
            except Forged:
                message = BadMessage(f"{self.name(row.key)} carries what is not signed with hardware.key_file")
            if message is not None:
                heard(row.key, message)

        self.lcm.Subscribe(self.name(row.key), take)
        if self._group is not None:
            only_own_groups(self._group[1])

    def _decoded(self, row: Channel, data: bytes) -> Any | None:
        """The message, or None if it was taken before. Raises Forged."""
        if self._seal is not None:
            opened = self._seal.open(self.name(row.key), data)
            if opened is None:
                return None
            data = opened
        try:
            return row.kind.decode(data)
        except Exception:  # ValueError for another type; damaged bytes make a decoder raise anything
            return BadMessage(f"{self.name(row.key)} does not carry {row.kind.__name__}")

    def send(self, key: str, message: Any) -> None:
        """Publishes a message."""
        data = message.encode()
        self.lcm.Publish(self.name(key), data if self._seal is None else self._seal.close(self.name(key), data))
        self.sent += key not in UNCOUNTED

    def say(self, key: str, utime: int, values: Mapping[str, float]) -> None:
        """Publishes named numbers."""
        message = signal(values)
        message.timestamp = utime
        self.send(key, message)

    def pump(self) -> bool:
        """Hands out what has arrived -> whether there was any."""
        return self.lcm.HandleSubscriptions(0) > 0

    def excuse(self) -> str:
        """What may explain that nothing is heard, for the end of an error line."""
        stale = 0 if self._seal is None else self._seal.stale
        return f"; {stale} messages were signed too early or too late: do both clocks agree?" if stale else ""

    def name(self, key: str) -> str:
        """The channel's name on the wire."""
        return self._names[key]

    # ------------------------------------------------------------ who is there
    @property
    def instance(self) -> int:
        """This process's own number."""
        return int(self._instance)

    def _present(self, role: str, key: str, message: Any) -> None:
        try:
            number = 0.0 if isinstance(message, BadMessage) else read_presence(message)
        except WrongMessage:
            return
        if number not in (0.0, self._instance):
            self.senders.hear(role, number, self.clock())

    def others(self, role: str) -> int:
        """How many other processes say that they are in this role."""
        return self.senders.present(role, self.clock())

    def announce(self, role: str) -> None:
        """Says that this process is there, if it is due."""
        now = self.clock()
        if now - self._announced >= ANNOUNCED:
            self._announced = now
            self.say(PRESENCE[role], 0, {"instance": self._instance})

    def claim(self, role: str) -> Callable[[], bool]:
        """To be called, after a `pump`, until it says that this process may take the role.

        Raises OperationFailed when another one has it, or comes at the same time. Within a process nobody is waited
        for.
        """
        begun = self.clock()
        listen = LISTEN if self._group is not None else 0.0

        def alone() -> bool:
            if self.others(role):
                raise OperationFailed(f"another {WHO[role]} is on {self.config.lcm_url}: there can be one only")
            waited = self.clock() - begun
            if waited >= listen:
                self.announce(role)
            return waited >= 2 * listen

        return alone


WHO = {"robot": "robot or twin", "controller": "program", "operator": "operator's desk"}
