"""Signed messages: who has no key cannot speak on the bus, and what was said once cannot be said again.

With `hardware.key_file` both sides append to every message when it was sent and a MAC over that, the channel and the
message. What is not signed, signed with another key, for another channel, older than what was taken last, or sent
longer ago than WINDOW counts as none. Drake's own types stand before it, unchanged.
"""

import hashlib
import hmac
import os
import stat
import struct
import time as wall
from collections.abc import Callable
from pathlib import Path

from valve_drake.checks import ConfigError, shown

WINDOW = 2.0  # most that both sides' clocks may differ, delays included; raise it where clocks are not kept by NTP [s]
SHORTEST, LONGEST = 16, 4096  # of a key [bytes]
_TIME = struct.Struct(">q")  # [ns] since 1970
_MAC = 16  # bytes of the MAC that are sent
_TRAILER = _TIME.size + _MAC


def load_key(path: str | os.PathLike[str]) -> bytes:
    """The key in a file, white space at its ends left out. Raises ConfigError naming the file."""
    key = f"hardware.key_file: {shown(path)}"
    try:
        regular = stat.S_ISREG(os.stat(path).st_mode)
        data = _start(path).strip() if regular else b""
    except (OSError, ValueError) as error:
        reason = "does not exist" if isinstance(error, FileNotFoundError) else "cannot be read"
        raise ConfigError(f"{key} {reason}") from error
    if not regular:
        raise ConfigError(f"{key} is not a file")
    if not SHORTEST <= len(data) <= LONGEST:
        raise ConfigError(f"{key} must hold a key of {SHORTEST} to {LONGEST} bytes")
    return data


def _start(path: str | os.PathLike[str]) -> bytes:
    with Path(path).open("rb") as file:
        return file.read(LONGEST + 1)


class Forged(Exception):
    """A message without a signature, or with a wrong one."""


class Seal:
    """One side's signatures. clock: [ns] since 1970."""

    def __init__(self, key: bytes, clock: Callable[[], int] = wall.time_ns):
        self._key = key
        self._clock = clock
        self._begun = clock()  # what was sent before is another session's
        self._sent = 0
        self.stale = 0  # messages that were signed rightly, but at another time
        self._taken: dict[str, int] = {}  # channel -> when the last message that was taken had been sent

    def _mac(self, channel: str, sent: bytes, data: bytes) -> bytes:
        # A channel's name holds no null character: the parts cannot be shifted against each other.
        return hmac.new(self._key, channel.encode() + b"\0" + sent + data, hashlib.sha256).digest()[:_MAC]

    def close(self, channel: str, data: bytes) -> bytes:
        """The message with its signature."""
        self._sent = max(self._clock(), self._sent + 1)
        sent = _TIME.pack(self._sent)
        return data + sent + self._mac(channel, sent, data)

    def open(self, channel: str, signed: bytes) -> bytes | None:
        """The message without its signature; None if it is not later than the last one. Raises Forged."""
        if len(signed) < _TRAILER:
            raise Forged
        data, sent, mac = signed[:-_TRAILER], signed[-_TRAILER:-_MAC], signed[-_MAC:]
        if not hmac.compare_digest(mac, self._mac(channel, sent, data)):
            raise Forged
        (when,) = _TIME.unpack(sent)
        if when <= self._taken.get(channel, self._begun) or abs(self._clock() - when) > 1e9 * WINDOW:
            self.stale += 1
            return None
        self._taken[channel] = when
        return data
