"""Levenberg-Marquardt: the one minimizer of sums of squares, for poses and calibrations."""

import math
from collections.abc import Callable
from typing import Any

import cv2

_FIRST_DAMPING = 1e-4  # relative to H's diagonal; raise it for starts from which the full step leads astray
_LEAST_DAMPING, _LEAST_AFTER_FAILURE = 1e-9, 1e-5  # the first keeps a singular H positive definite
_MOST_DAMPING = 1e8  # steps that this makes move nothing


def minimize(
    problem: Callable[..., Any],
    state: Any,
    moved: Callable[..., Any],
    *,
    steps: int = 200,
    enough: float = 1e-24,
    relative: float = 1e-12,
    at: Any = None,
) -> tuple[Any, Any]:
    """The best state from `state` on, and what `problem` gives there.

    problem(state): the cost r.r, H = J^T J (n, n), g = J^T r (n,), and what else the caller wants back; the cost is
    infinite where there is none, also of the first state, which then comes back. moved(state, step (n,)): the state
    after a step. It ends when a step is expected to lower the cost by less than `enough` + `relative` of it, or after
    `steps`. at: problem(state), if it is known.
    """
    at = at or problem(state)
    damping = _FIRST_DAMPING
    for _ in range(steps if math.isfinite(at[0]) else 0):
        cost, H, g = at[:3]
        damped = H.copy()
        damped.flat[:: len(H) + 1] += damping * (H.diagonal() + 1e-12)
        step = cv2.solve(damped, -g, flags=cv2.DECOMP_CHOLESKY)[1][:, 0]  # a fifth of the time of numpy's
        gain = -2 * (g @ step) - step @ H @ step  # the decrease that the linear model expects
        trial_state = moved(state, step)
        trial = problem(trial_state)
        if trial[0] <= cost:
            state, at, damping = trial_state, trial, max(damping / 10, _LEAST_DAMPING)
        else:
            damping = max(damping * 10, _LEAST_AFTER_FAILURE)
        if gain < enough + relative * cost or damping > _MOST_DAMPING:
            break
    return state, at
