"""The program's end of the operators' wire: gathers what arrives, for the diagram, and says what the robot answers."""

import time as wall
from collections.abc import Callable
from typing import Any

from valve_drake.messages import OperatorPacket, OperatorPackets, OperatorState
from valve_drake.operator.wire import News, Sound, read_sound, read_words, report_message
from valve_drake.stations.bus import ANNOUNCED, BadMessage, Bus
from valve_drake.stations.lcm_channels import CHANNELS, CONTROLLER, OPERATOR, REPORT, WORDS, WrongMessage

MOST = 64  # packets, and pieces of sound, that are kept until they are fetched; a desk sends 8 a second


class OperatorLink:
    """Keeps what operators' desks have sent, as a socket does, outside the Context.

    bus: of the robot's link, where there is one; else `alone`: it sees to it that this program is the only one there.
    """

    def __init__(self, bus: Bus, alone: bool = True):
        self.bus = bus
        self.dropped: dict[str, int] = {}  # bad messages, by channel
        self._alone = alone
        self._packets: list[OperatorPacket] = []
        self._sounds: list[Sound] = []
        self._news = News()
        self._count = 0
        self._told: OperatorState | None = None
        self._told_at = float("-inf")
        bus.listen(OPERATOR, self._hear, between=OPERATOR)

    def _hear(self, key: str, message: Any) -> None:
        try:
            if isinstance(message, BadMessage):
                raise WrongMessage(message.words)
            if key == WORDS:
                to, packet = read_words(message)
                if to == self.bus.instance and len(self._packets) < MOST:  # else it is another program's, or of old
                    self._packets.append(packet)
            else:
                sound = self._news.take(read_sound(message))
                if sound is not None and len(self._sounds) < MOST:
                    self._sounds.append(sound)
        except WrongMessage:
            device = CHANNELS[key].key
            self.dropped[device] = self.dropped.get(device, 0) + 1

    def claim(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Makes sure that this is the only program there. Raises OperationFailed if it is not."""
        if not self._alone:
            return
        alone = self.bus.claim(CONTROLLER)
        while True:
            self.bus.pump()
            if alone() or stop():
                return
            wall.sleep(2e-3)

    def take(self, time: float) -> OperatorPackets | None:
        """What has arrived since the last time, at `time` of the diagram; None: nothing."""
        for _ in range(MOST):  # who floods the bus must not hold the run up
            if not self.bus.pump():
                break
        if not self._packets:
            return None
        self._count += 1
        packets, self._packets = tuple(self._packets), []
        return OperatorPackets(time, self._count, packets)

    def sounds(self) -> list[Sound]:
        """The same of sound."""
        sounds, self._sounds = self._sounds, []
        return sounds

    def tell(self, state: OperatorState) -> None:
        """Says what the robot answers, when it is new or due. To be called some 32 times a second."""
        now = self.bus.clock()
        if self._alone:
            self.bus.announce(CONTROLLER)
        if state is not self._told or now - self._told_at >= ANNOUNCED:
            self._told, self._told_at = state, now
            self.bus.send(REPORT, report_message(state, self.bus.instance))

    def pass_time(self, seconds: float) -> None:
        """Listens while there is nothing else to do: a channel has room for one message."""
        wall.sleep(min(seconds, 2e-3))
        self.bus.pump()
