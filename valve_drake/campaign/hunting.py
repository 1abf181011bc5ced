"""Finding failures: draws are chosen where runs have failed or come close to it, by the cross-entropy method.

The first batch covers the ranges of all distributions evenly (Sobol's points). Of each later one a third does so at
random; the rest are drawn about the runs with the least margins so far, as widely as these lie apart. A batch depends
on the hunt's seed and the records before it alone: a hunt that is broken off goes on as it would have gone.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import qmc

from valve_drake.behaviors.hybrid_rotation_config import HybridRotationConfig
from valve_drake.campaign.trial import AT_ANGLE, Record, turned

BATCH = 8  # runs that are chosen at a time, however many run at a time; raise it for many workers
EXPLORE = 1 / 3  # of a batch, anywhere; raise it if a hunt keeps to one kind of failure
KEEP = 0.2  # of all runs so far, those with the least margins, and
FEWEST = 4  # at least so many, are what is drawn about
NARROWEST = 0.02  # of the draws about a run, as a share of a distribution's range

# Where a figure of a run is as good as a failure; the margin is what is left of the worst one.
_EDGES = {
    "angle": AT_ANGLE,  # true minus asked [rad]
    "honesty": 0.05,  # of the valve's way not held by both pads of a hand
    "turn_peak_hand_force_N": HybridRotationConfig.force_trip,  # ends the turn
    "peak_internal_force_N": HybridRotationConfig.force_trip,
    "retries": 4.0,
}


def margin(record: Record) -> float:
    """How far a run was from failing: 0 is a failure, 1 is perfect."""
    if not turned(record):
        return 0.0
    asked, true = record.get("valve_angle_command_rad"), record.get("valve_angle_true_rad")
    held = record.get("contact_honesty")
    figures = dict(record)
    figures["angle"] = None if asked is None or true is None else abs(true - asked)
    figures["honesty"] = None if not held else 1.0 - min(held.values())
    used = [value / edge for name, edge in _EDGES.items() if (value := figures.get(name)) is not None]
    return max(0.0, 1.0 - max(used, default=0.0))


def propose(seen: Sequence[tuple[np.ndarray, float]], count: int, dimensions: int, seed: int, batch: int) -> np.ndarray:
    """The next runs' places within the ranges of the distributions -> (count, dimensions) in [0, 1].

    seen: place and margin of every run before this batch, in their order. seed, batch: of the random numbers.
    """
    rng = np.random.default_rng([seed, batch])
    anywhere: np.ndarray = qmc.Sobol(dimensions, rng=rng).random(1 << (count - 1).bit_length())[:count]
    if not seen:
        return anywhere
    order = sorted(range(len(seen)), key=lambda k: (seen[k][1], k))
    best = np.array([seen[k][0] for k in order[: max(FEWEST, math.ceil(KEEP * len(seen)))]])
    width = np.maximum(best.std(axis=0) * len(best) ** (-1 / (dimensions + 4)), NARROWEST)
    near = best[rng.integers(len(best), size=count)] + width * rng.standard_normal((count, dimensions))
    near = np.abs(near)
    near = 1.0 - np.abs(1.0 - near % 2.0)  # reflected at both ends
    return np.where(rng.random((count, 1)) < EXPLORE, anywhere, near)
