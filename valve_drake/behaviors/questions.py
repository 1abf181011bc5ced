"""A long check cut into portions: what it asks of the model is counted, since times would not be the same again.

The check is begun anew in every portion and gets the answers of the earlier ones, in the order of its asking, until it
asks something new. So it is written as if it ran through, and all that is kept between two portions is a tuple.
"""

import math
from collections.abc import Callable
from typing import TypeVar

UNITS = 12  # of a portion with redundant arms; a unit is about 0.1 to 0.3 ms
SOLVED = 1  # an inverse from its neighbour
SOUGHT = 3  # one from one of the places where a search begins
PAIRS_A_UNIT = 400  # pairs of shapes that a look at a pose goes through in a unit

Answer = TypeVar("Answer")


class Enough(Exception):
    """The portion is over."""


class Questions:
    """answers: of earlier portions. units: what this one may ask; at least one new question."""

    def __init__(self, answers: tuple[object, ...] = (), units: float = math.inf):
        self._answers, self._at, self._units, self._fresh = list(answers), 0, units, True

    def __call__(self, units: int, ask: Callable[[], Answer]) -> Answer:
        """The answer to the next question. Raises Enough if it has to wait for the next portion."""
        if self._at == len(self._answers):
            if units > self._units and not self._fresh:
                raise Enough
            self._units, self._fresh = self._units - units, False
            self._answers.append(ask())
        self._at += 1
        answer: Answer = self._answers[self._at - 1]  # type: ignore[assignment]
        return answer

    def answers(self) -> tuple[object, ...]:
        """All so far, for the next portion."""
        return tuple(self._answers)
