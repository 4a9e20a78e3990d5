"""Flip single labels, many at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode

# If a batch does not lower F, the surest part of it is tried.
_PART = 0.25
# F that falls by less, in nats, has not fallen.
_LEAST_GAIN = 0.01


def flipped(mode: Mode) -> Mode:
    """All labels flipped that leave-one-out log-odds speak against, as long as F falls."""
    problem = mode.problem
    is_told = np.isinf(problem.log_odds)
    share = 1.0
    for _ in range(problem.limits.flip_rounds):
        good = mode.state.is_good
        log_odds = mode.left_out.log_odds
        wrong = np.flatnonzero(~is_told & ((log_odds > 0) != good))
        if len(wrong) == 0:
            break
        wrong = wrong[np.argsort(-np.abs(log_odds[wrong]), kind="stable")]
        wrong = wrong[: max(1, int(share * len(wrong)))]
        trusted = mode.state.trusted.copy()
        trusted[wrong] = ~good[wrong]
        tried = Mode(problem, *polish(problem, replace(mode.state, trusted=trusted)), mode.origin)
        if tried.cost < mode.cost - _LEAST_GAIN:
            mode, share = tried, 1.0
        elif len(wrong) == 1:
            break
        else:
            share *= _PART
    return mode
