"""What travels between an operator and the program, as messages of the channels' table (stations/lcm_channels.py)."""

import dataclasses as dc
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from drake import lcmt_drake_signal, lcmt_header, lcmt_image

from valve_drake.messages import OperatorPacket, OperatorState
from valve_drake.operator.grammar import LONGEST
from valve_drake.stations.lcm_channels import LONGEST_NAME, WrongMessage, from_utime, read_named, signal, to_utime

RATE = 16000  # of the sound [Hz]
MOST_SAMPLES = 16000  # in one message
AGAIN = 0.4  # of sound that every message repeats: a bus keeps one message a channel until somebody asks for it [s]
MOST_COUNTED = 2**31 - 1  # samples of one sender, 37 hours: what the message's number has room for
LARGEST = 2.0**53  # whole numbers up to here are exact
_WORDS = "words"
_TEXTS = tuple(f.name for f in dc.fields(OperatorState) if f.type is str)
_NUMBERS = tuple(f.name for f in dc.fields(OperatorState) if f.type is not str)


@dc.dataclass(frozen=True)
class Sound:
    """A piece of sound. time: of its first sample, on the sender's clock [s]."""

    time: float
    sequence: int
    rate: int  # [Hz]
    samples: np.ndarray  # (n,) int16


class Tail:
    """A sender's sound with its last AGAIN seconds."""

    def __init__(self) -> None:
        self._samples = np.zeros(0, np.int16)
        self._count = 0  # samples so far

    def add(self, samples: np.ndarray, time: float) -> Sound:
        """What is to be sent when these (n,) have been heard; time: of the first of them [s]."""
        if self._count + len(samples) > MOST_COUNTED:  # the count begins anew, as another sender's does
            self._samples, self._count = np.zeros(0, np.int16), 0
        self._count += len(samples)
        joined = np.concatenate([self._samples, samples])
        before = len(joined) - len(samples)
        self._samples = joined[-round(AGAIN * RATE) :]
        return Sound(max(time - before / RATE, 0.0), self._count - len(joined), RATE, joined)


class News:
    """What of each message's sound was not there before."""

    def __init__(self) -> None:
        self._next = 0  # the sample that follows the last one

    def take(self, sound: Sound) -> Sound | None:
        """The new part; None: there is none. A count that begins anew, or is far behind, is another sender's."""
        behind = self._next - sound.sequence - len(sound.samples)
        if behind > MOST_SAMPLES or (sound.sequence == 0 and self._next > MOST_SAMPLES):
            self._next = 0
        old = max(self._next - sound.sequence, 0)
        if old >= len(sound.samples):
            return None
        self._next = sound.sequence + len(sound.samples)
        return Sound(sound.time + old / RATE, sound.sequence + old, sound.rate, sound.samples[old:])


def _named(values: Mapping[str, float], texts: Mapping[str, str]) -> lcmt_drake_signal:
    """Numbers under their names, and texts as 1 under `<name>: <text>`; a text that is too long is cut, and what is no
    character (a name's bytes that are not UTF-8) is a question mark."""
    named = (f"{name}: {text}"[:LONGEST_NAME] for name, text in texts.items() if text)
    return signal(dict(values) | {name.encode("utf-8", "replace").decode(): 1.0 for name in named})


def _read(message: lcmt_drake_signal, names: tuple[str, ...]) -> tuple[dict[str, float], dict[str, str]]:
    """Numbers and texts by name; `names`: of the texts. Raises WrongMessage."""
    values, texts = {}, {}
    for key, value in read_named(message).items():
        name, colon, text = key.partition(": ")
        if colon and name in names:
            texts[name] = text
        elif math.isfinite(value):
            values[key] = value
        else:
            raise WrongMessage("a number that is not finite")
    return values, texts


def _whole(values: Mapping[str, float], name: str, least: int = 0) -> int:
    value = values.get(name, 0.0)
    if not (least <= value < LARGEST and value == int(value)):
        raise WrongMessage(f"{name} must be a whole number from {least}, got {value:g}")
    return int(value)


def words_message(packet: OperatorPacket, to: int) -> lcmt_drake_signal:
    """operator.words, for the program with the number `to`."""
    numbers = {"to": to, "instance": packet.speaker, "sequence": packet.sequence}
    numbers |= {name: getattr(packet, name) for name in ("score", "said", "begin", "end", "typed", "leaves")}
    message = _named({name: float(value) for name, value in numbers.items()}, {_WORDS: packet.words})
    message.timestamp = to_utime(packet.sent)
    return message


def read_words(message: lcmt_drake_signal) -> tuple[int, OperatorPacket]:
    """For whom it is, and the packet. Raises WrongMessage."""
    values, texts = _read(message, (_WORDS,))
    words, score = texts.get(_WORDS, ""), values.get("score", 0.0)
    if len(words) > LONGEST:
        raise WrongMessage(f"more than {LONGEST} characters of words")
    if not 0 <= score <= 1:
        raise WrongMessage(f"score must be within [0, 1], got {score:g}")
    said, begin, end = (values.get(name, 0.0) for name in ("said", "begin", "end"))
    packet = OperatorPacket(
        speaker=_whole(values, "instance", 1),
        sent=from_utime(message.timestamp),
        sequence=_whole(values, "sequence"),
        words=words,
        score=score,
        said=said,
        begin=begin,
        end=end,
        typed=values.get("typed") == 1.0,
        leaves=values.get("leaves") == 1.0,
    )
    if not said <= packet.sent + 1e-3:  # the stamp is rounded
        raise WrongMessage("words that will be said later")
    return _whole(values, "to"), packet


def report_message(state: OperatorState, program: int) -> lcmt_drake_signal:
    """operator.report of the program with this number."""
    numbers = {"instance": float(program)} | {name: float(getattr(state, name)) for name in _NUMBERS}
    return _named(numbers, {name: getattr(state, name) for name in _TEXTS})


def read_report(message: lcmt_drake_signal) -> tuple[int, OperatorState]:
    """The program's number, and its answer. Raises WrongMessage."""
    values, texts = _read(message, _TEXTS)
    known: dict[str, Any] = dict(texts)
    for field in dc.fields(OperatorState):
        if field.name in values:
            known[field.name] = _whole(values, field.name) if field.type is int else values[field.name]
            if field.type is bool:
                known[field.name] = values[field.name] == 1.0
    return _whole(values, "instance", 1), OperatorState(**known)


def sound_message(sound: Sound) -> lcmt_image:
    """operator.audio."""
    image = lcmt_image()
    image.header = lcmt_header()
    image.header.utime, image.header.seq = to_utime(sound.time), sound.sequence
    image.header.frame_name = str(sound.rate)
    image.width, image.height = len(sound.samples), 1
    image.data = np.ascontiguousarray(sound.samples, "<i2").tobytes()
    image.size = image.row_stride = len(image.data)
    image.pixel_format, image.channel_type = image.PIXEL_FORMAT_GRAY, image.CHANNEL_TYPE_INT16
    image.compression_method = image.COMPRESSION_METHOD_NOT_COMPRESSED
    return image


def read_sound(image: lcmt_image) -> Sound:
    """The sound of operator.audio. Raises WrongMessage."""
    kind = (image.pixel_format, image.channel_type, image.compression_method, image.height)
    if kind != (image.PIXEL_FORMAT_GRAY, image.CHANNEL_TYPE_INT16, image.COMPRESSION_METHOD_NOT_COMPRESSED, 1):
        raise WrongMessage("not one row of INT16")
    if not 0 < image.width <= MOST_SAMPLES or image.size != 2 * image.width:
        raise WrongMessage(f"{image.width} samples in {image.size} bytes, want 1 to {MOST_SAMPLES} of 2 bytes")
    if image.header.frame_name != str(RATE):
        raise WrongMessage(f"want {RATE} Hz")
    if image.header.seq < 0:
        raise WrongMessage(f"piece {image.header.seq}, want 0 or more")
    samples = np.frombuffer(bytes(image.data), "<i2").astype(np.int16)
    return Sound(from_utime(image.header.utime), image.header.seq, RATE, samples)
