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


STEP_MOST = 500  # pairs that the sequential test is made for; fixed before any run, as the test demands
STEP_LEVEL = 0.05


@dc.dataclass(frozen=True)
class Sequential:
    """What a test says that may be asked after every run.

    verdict: of B against A, as in Paired. pairs: how many it took to tell, or that there were. more: about so many
    further pairs would tell if they went on as now, up to STEP_MOST; None where that would not do.
    """

    verdict: str
    pairs: int
    more: int | None


def sequential(a: Sequence[bool], b: Sequence[bool]) -> Sequential | None:
    """STEP (Snyder et al., 2025) on the runs in their order, at 5 % for each direction; None: it is not installed.

    It compares two rates and makes no use of the pairs having a seed in common.
    """
    try:
        from sequentialized_barnard_tests import Hypothesis, MirroredStepTest
    except ImportError:
        return None
    # The package brings the decision table of this n_max and alpha; it would compute any other first.
    test = MirroredStepTest(Hypothesis.P0LessThanP1, n_max=STEP_MOST, alpha=STEP_LEVEL, random_seed=1)
    pairs = list(zip(a, b, strict=True))
    words = {"AcceptAlternative": "better", "AcceptNull": "worse"}
    for k in range(STEP_MOST if pairs else 0):  # what there is, and then the same over again
        decision = test.step(*map(int, pairs[k % len(pairs)])).decision.name
        if decision in words and k < len(pairs):
            return Sequential(words[decision], k + 1, None)
        if decision in words:
            return Sequential("cannot tell yet", len(pairs), k + 1 - len(pairs))
    return Sequential("cannot tell yet", len(pairs), None)


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
