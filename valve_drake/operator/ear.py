"""Sound for the operator's desk: where it comes from, in pieces of PIECE seconds, and what makes words of it."""

import collections
import importlib
import queue
import wave
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from valve_drake.checks import ConfigError, OperationFailed, require, require_in
from valve_drake.operator.grammar import Heard
from valve_drake.operator.wire import RATE

PIECE = 0.08  # [s]
LONGEST_FILE = 3600.0  # [s]
SECONDS = 600  # of sound that may wait


class Recogniser(Protocol):
    """Makes words of a stream of sound: valve_drake.voice.recogniser."""

    def push(self, samples: np.ndarray) -> list[Heard]:
        """Takes in the next samples (n,) int16 at RATE -> the utterances that they complete, in order.

        What is not believed comes too, with a score below grammar.SURE. begin and end: seconds since the first sample.
        `stop` is told as soon as it is heard, also in the midst of a sentence. No samples complete nothing.
        """
        ...


class Beside:
    """A recogniser in a thread of its own: whoever has to answer a robot in time does not wait for it.

    The samples are heard one piece after the other, so that the words and their order are the recogniser's.
    """

    def __init__(self, recogniser: Recogniser) -> None:
        self._recogniser = recogniser
        self._worker = ThreadPoolExecutor(1, "ear")
        self._pieces: collections.deque[tuple[Future[list[Heard]], int]] = collections.deque()  # and their samples

    def push(self, samples: np.ndarray) -> list[Heard]:
        """Takes in the next samples (n,) -> the utterances that earlier ones have completed by now, in order.

        Raises what the recogniser raised at one of them.
        """
        if len(samples):
            self._pieces.append((self._worker.submit(self._recogniser.push, samples), len(samples)))
        out: list[Heard] = []
        while self._pieces and self._pieces[0][0].done():
            out += self._pieces.popleft()[0].result()
        return out

    @property
    def busy(self) -> bool:
        """Some samples are not heard yet, or what they completed was not asked for."""
        return bool(self._pieces)

    @property
    def late(self) -> float:
        """How much sound waits to be heard [s]."""
        return sum(count for _, count in self._pieces) / RATE

    def close(self) -> None:
        """What is not heard yet never is."""
        self._worker.shutdown(wait=False, cancel_futures=True)


def recogniser() -> Recogniser:
    """The program's own. Raises ConfigError if it is not installed."""
    try:
        made: Recogniser = importlib.import_module("valve_drake.voice.recogniser").Recogniser()
    except ImportError as error:
        raise ConfigError(f"listening needs the extra `voice`: pip install 'valve-drake[voice]' ({error})") from error
    return made


def read_wav(path: Path, option: str) -> np.ndarray:
    """The samples of a WAV file of 16 bits as (n,) int16 at RATE; the first channel, resampled if need be.

    Raises ConfigError naming `option`.
    """
    try:
        with wave.open(str(path), "rb") as file:
            width, channels, rate = file.getsampwidth(), file.getnchannels(), file.getframerate()
            length = file.getnframes()
            require(width == 2, option, "a WAV file of 16 bits", path)
            require_in(rate, 8000, 192000, f"{option}: sample rate of {path}")
            require_in(length / rate, 0.0, LONGEST_FILE, f"{option}: seconds of {path}")
            require_in(channels, 1, 8, f"{option}: channels of {path}")
            data = file.readframes(length)
    except (OSError, EOFError, wave.Error) as error:
        raise ConfigError(f"{option}: {path} cannot be read as a WAV file: {error}") from error
    whole = len(data) // (2 * channels)
    samples = np.frombuffer(data, "<i2", whole * channels).reshape(whole, channels)[:, 0]
    return samples.astype(np.int16) if rate == RATE else resampled(samples, rate)


def resampled(samples: np.ndarray, rate: int) -> np.ndarray:
    """(n,) int16 at `rate` [Hz] -> (m,) int16 at RATE."""
    from scipy.signal import resample_poly

    common = int(np.gcd(rate, RATE))
    out = resample_poly(samples.astype(float), RATE // common, rate // common)
    return np.clip(np.round(out), -(2**15), 2**15 - 1).astype(np.int16)


def pieces(samples: np.ndarray) -> Iterator[np.ndarray]:
    """Cut into pieces of PIECE seconds, the last one filled up with silence."""
    size = round(PIECE * RATE)
    for start in range(0, len(samples), size):
        piece = samples[start : start + size]
        yield np.pad(piece, (0, size - len(piece)))


class Microphone:
    """Pieces from this machine's microphone, as they come. Raises ConfigError, OperationFailed where there is none."""

    def __init__(self) -> None:
        try:
            import sounddevice
        except (ImportError, OSError) as error:  # the second one: no PortAudio on this machine
            raise ConfigError(
                f"--voice microphone needs sounddevice: pip install 'valve-drake[voice]' ({error})"
            ) from error
        self._queue: queue.Queue[np.ndarray] = queue.Queue(maxsize=round(SECONDS / PIECE))
        try:
            self._stream = sounddevice.InputStream(
                samplerate=RATE, channels=1, dtype="int16", blocksize=round(PIECE * RATE), callback=self._take
            )
            self._stream.start()
        except sounddevice.PortAudioError as error:
            raise OperationFailed(f"the microphone cannot be opened: {error}") from error

    def _take(self, data: np.ndarray, frames: int, time: Any, status: Any) -> None:
        try:
            self._queue.put_nowait(data[:, 0].copy())
        except queue.Full:
            pass

    def ready(self) -> list[np.ndarray]:
        """Pieces that have come since the last call."""
        out = []
        while not self._queue.empty():
            out.append(self._queue.get_nowait())
        return out
