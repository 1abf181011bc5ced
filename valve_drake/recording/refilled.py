"""Serialises messages that differ in numbers only by writing the numbers into the bytes of a template.

Protobuf writes a double as its 8 bytes. A message in which nothing changes but doubles and the time is thus the same
string of bytes with others in known places; to fill them in costs a tenth of building and serialising it anew.
"""

import operator
import struct
from collections.abc import Sequence

from google.protobuf.message import Message as Proto
from google.protobuf.timestamp_pb2 import Timestamp

from valve_drake.recording.schemas import Encoded

STAMP = Timestamp(seconds=2**31, nanos=999_999_999)  # placeholder for the time in a form; the longest encoding there is
_STAMP = STAMP.SerializeToString()
_SLOTS = 0x7A5A_C3A5_3C96_0000  # the bits of slot 0, which nothing else in a form has


def slot(k: int) -> float:
    """What stands for the k-th number in a form."""
    return struct.unpack("<d", struct.pack("<Q", _SLOTS + k))[0]


class Refilled:
    """A form: a message with slot(0) ... slot(count - 1) for its numbers, and STAMP for the time."""

    def __init__(self, form: Proto, count: int):
        self._kind = type(form)
        data = form.SerializeToString(deterministic=True)
        slots = {k: data.index(struct.pack("<Q", _SLOTS + k)) for k in range(count)}
        order = sorted(slots, key=lambda k: slots[k])
        self._arrange = operator.itemgetter(*order)
        begins, ends = [0, *(slots[k] + 8 for k in order)], [*(slots[k] for k in order), len(data)]
        between = [data[begin:end] for begin, end in zip(begins, ends)]
        self._pieces: list[bytes | None] = [piece for part in between for piece in (part, None)][:-1]
        self._pack = struct.Struct("<" + "d".join(f"{len(part)}s" for part in between)).pack
        self._timed = _STAMP in data

    def fill(self, when: int, numbers: Sequence[float]) -> Encoded:
        """The message with these numbers at `when` [ns]."""
        pieces = self._pieces.copy()
        pieces[1::2] = self._arrange(numbers)
        data = self._pack(*pieces)
        return Encoded(self._kind, data.replace(_STAMP, _stamp(when)) if self._timed else data)


def _stamp(when: int) -> bytes:
    """A Timestamp as long as STAMP: its varints are padded with zeros, which protobuf allows."""
    seconds, nanos = divmod(when, 1_000_000_000)
    return b"\x08" + _varint5(seconds) + b"\x10" + _varint5(nanos)


def _varint5(n: int) -> bytes:
    return bytes([n & 0x7F | 0x80, n >> 7 & 0x7F | 0x80, n >> 14 & 0x7F | 0x80, n >> 21 & 0x7F | 0x80, n >> 28 & 0x7F])
