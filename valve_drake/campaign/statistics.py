"""What may be said of success rates: exact intervals, and paired comparisons."""

import dataclasses as dc
import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

CONFIDENCE = 0.95


def interval(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Clopper-Pearson's exact interval of a success rate; (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    found = stats.binomtest(successes, trials).proportion_ci(confidence, method="exact")
    return float(found.low), float(found.high)


@dc.dataclass(frozen=True)
class Paired:
    """Two programs on the same seeds.

    better, worse: seeds on which only B, or only A, succeeded. p: McNemar's exact test, two-sided.
    verdict: of B against A: "better", "worse" or "cannot tell yet". more: about so many further runs would tell, if
    the seeds on which they differ went on as now; None where there is nothing to go by.
    """

    both: int
    better: int
    worse: int
    neither: int
    p: float
    verdict: str
    more: int | None


def compare(a: Sequence[bool], b: Sequence[bool], level: float = 1 - CONFIDENCE) -> Paired:
    """a, b: success of each program, seed by seed."""
    pairs = list(zip(a, b, strict=True))
    better, worse = pairs.count((False, True)), pairs.count((True, False))
    p = mcnemar(better, worse)
    telling = p < level
    verdict = "cannot tell yet" if not telling else "better" if better > worse else "worse"
    more = None if telling else _more(better, worse, len(pairs), level)
    return Paired(pairs.count((True, True)), better, worse, pairs.count((False, False)), p, verdict, more)


def mcnemar(better: int, worse: int) -> float:
    """The exact two-sided test that pairs which differ, differ to both sides alike."""
    return float(stats.binomtest(better, better + worse, 0.5).pvalue) if better + worse else 1.0


def _more(better: int, worse: int, trials: int, level: float) -> int | None:
    """How many more trials until the test tells, at the present rates of both kinds of difference."""
    if better == worse:
        return None
    factor = 1.0
    while factor < 1e4:
        factor *= 1.05
        if mcnemar(round(better * factor), round(worse * factor)) < level:
            return math.ceil(trials * (factor - 1))
    return None


@dc.dataclass(frozen=True)
class Difference:
    """Mean of B minus A over the seeds that both have, with its interval."""

    mean: float
    low: float
    high: float
    pairs: int


def difference(a: Sequence[float], b: Sequence[float]) -> Difference | None:
    """Student's interval of the mean of paired differences; None below two pairs."""
    d = np.asarray(b, float) - np.asarray(a, float)
    d = d[np.isfinite(d)]
    if len(d) < 2:
        return None
    half = float(stats.t.ppf(0.5 + CONFIDENCE / 2, len(d) - 1) * d.std(ddof=1) / math.sqrt(len(d)))
    mean = float(d.mean())
    return Difference(mean, mean - half, mean + half, len(d))
