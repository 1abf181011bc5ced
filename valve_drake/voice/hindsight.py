"""The last seconds of a stream of sound: how loudly somebody speaks now, and what a judge makes of them."""

import collections
import math
from typing import Optional

import numpy as np

from valve_drake.voice.embedding import BLOCK
from valve_drake.voice.judge import Judge, Look
from valve_drake.voice.radio import RATE

KEPT = 9.0  # of sound [s]; a sentence is 8 s at most
QUIETEST = -60.0  # level of a step that counts as silence, digital silence too [dB of full scale]
FLOOR = 50  # steps whose quietest is the noise: 4 s; raise it for speakers who never pause
ABOVE = 3.0  # of the noise, from which somebody speaks: a step of steady noise stays within 1 dB [dB]
BELOW = 30.0  # of the loudest step, down to which somebody still speaks; below it a room may echo [dB]


class Hindsight:
    """judge: who is asked about the sound; None: nobody, `second` is None."""

    def __init__(self, judge: Judge | None) -> None:
        self._judge = judge
        self._sound = np.zeros(int(KEPT * RATE), np.int16)
        self._heard = 0
        self._levels: collections.deque[float] = collections.deque(maxlen=FLOOR)

    @property
    def second(self) -> Optional["Hindsight"]:
        return self if self._judge is not None else None

    def push(self, block: np.ndarray) -> float | None:
        """The next (BLOCK,) int16 -> the level of the speech in it [dB of full scale]; None: nobody speaks."""
        self._sound = np.concatenate([self._sound[BLOCK:], block])
        self._heard = min(self._heard + BLOCK, len(self._sound))
        power = float(np.mean(np.square(block / 32768)))
        level = max(10 * math.log10(max(power, 1e-12)), QUIETEST)
        self._levels.append(level)
        return level if level > max(min(self._levels) + ABOVE, max(self._levels) - BELOW) else None

    def look(self, back: float, seconds: float) -> Look:
        """At the last `back` seconds, filled up to `seconds`."""
        assert self._judge is not None
        count = min(round(back * RATE), self._heard)
        return self._judge.look(self._sound[len(self._sound) - count :], seconds)
