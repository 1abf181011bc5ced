"""A voice radio: what its listener gets of what was said into it.

Band, clipping, noise and dropouts, in the order in which a hand-held radio adds them. One pure function: the same
sound, radio and seed give the same samples.
"""

import dataclasses as dc
import math

import numpy as np
from scipy import signal

RATE = 16000  # samples of all sound in this package [1/s]
LEVEL = 0.05  # of speech that leaves the radio, its root mean square where it is loud [of full scale]


@dc.dataclass(frozen=True)
class Radio:
    """low, high: the band that passes [Hz]. snr: speech over noise, both in the band [dB]; inf: no noise.

    clipping: speech is cut at this many times its own root mean square; inf: never. A voice's peaks lie at 4 to 6.
    dropouts: how many each second; each lasts 20 to 80 ms and leaves the noise alone.
    """

    low: float = 300.0
    high: float = 3400.0
    snr: float = 20.0
    clipping: float = 3.0
    dropouts: float = 0.2


CLEAN = Radio(snr=math.inf, clipping=math.inf, dropouts=0.0)  # the band alone
AT_20_DB = Radio(snr=20.0)
AT_10_DB = Radio(snr=10.0)


def transmit(sound: np.ndarray, radio: Radio, seed: int, level: float | None = None) -> np.ndarray:
    """Sound (n,) at RATE, in parts of full scale -> what is received (n,), float32 within [-1, 1].

    level: the root mean square of the speech in `sound`; None: it is measured (`loudness`). What is received has the
    level LEVEL, as the automatic gain of a receiver makes it. Without speech the noise is what it would be beside it.
    """
    if len(sound) == 0:
        return np.zeros(0, np.float32)
    rng = np.random.default_rng(seed)
    band = signal.butter(4, (radio.low, radio.high), "bandpass", fs=RATE, output="sos")
    x = np.asarray(sound, float)
    if level is None:
        level = loudness(x)
    x = x * (LEVEL / level if level > 0 else 0.0)
    if math.isfinite(radio.clipping):
        most = radio.clipping * LEVEL
        x = np.clip(x, -most, most)
    gone = np.zeros(len(x), bool)
    for _ in range(rng.poisson(radio.dropouts * len(x) / RATE)):
        begin = int(rng.uniform(0, len(x)))
        gone[begin : begin + int(rng.uniform(0.02, 0.08) * RATE)] = True
    x = np.where(gone, 0.0, x)
    if math.isfinite(radio.snr):  # white before the filter, so that the part that passes has the wanted power
        share = (radio.high - radio.low) / (RATE / 2)
        x = x + rng.normal(0.0, LEVEL * 10 ** (-radio.snr / 20) / math.sqrt(share), len(x))
    return np.clip(signal.sosfilt(band, x), -1.0, 1.0).astype(np.float32)


def loudness(sound: np.ndarray) -> float:
    """The root mean square of the loud part of a sound (n,): of each 20 ms within 20 dB of the loudest; 0: silence."""
    block = RATE // 50
    n = len(sound) // block
    if n == 0:
        return 0.0
    power = np.square(sound[: n * block].reshape(n, block)).mean(1)
    loud = power[power > 0.01 * power.max()]
    return math.sqrt(loud.mean()) if len(loud) else 0.0
