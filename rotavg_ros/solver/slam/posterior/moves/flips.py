"""Flip single labels, many at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode

# If a batch does not lower F, the surest part of it is tried.
_PART = 0.25
# Labels are flipped that log-odds speak against by so many nats; the others are undecided either way.
_DECIDED = 1.0
# F may fall so many times as fast as in the last round.
_HOPE = 3
# F that falls by less, in nats, has not fallen.
_LEAST_GAIN = 0.1


def flipped(mode: Mode, limit: float = np.inf) -> Mode:
    """All labels flipped that leave-one-out log-odds speak against, as long as F falls.

    Args:
        mode: where to begin.
        limit: nats. It is given up where F, falling a few times as fast as in the last round, would not come below.
    """
    problem, begun = mode.problem, mode
    is_told = np.isinf(problem.log_odds)
    share = 1.0
    for rounds_left in range(problem.limits.flip_rounds - 1, -1, -1):
        good = mode.state.is_good
        log_odds = mode.left_out.log_odds
        wrong = np.flatnonzero(~is_told & np.where(good, log_odds < -_DECIDED, log_odds > _DECIDED))
        if len(wrong) == 0:
            break
        wrong = wrong[np.argsort(-np.abs(log_odds[wrong]), kind="stable")]
        wrong = wrong[: max(1, int(share * len(wrong)))]
        trusted = mode.state.trusted.copy()
        trusted[wrong] = ~good[wrong]
        tried = _polished(mode, trusted, problem.limits.trial_solves)
        gain = mode.cost - tried.cost
        if gain > _LEAST_GAIN:
            mode, share = tried, 1.0
            if mode.cost - _HOPE * rounds_left * gain > limit:
                return mode
        elif len(wrong) == 1:
            break
        else:
            share *= _PART
    return mode if mode is begun else _polished(mode, mode.state.trusted, problem.limits.polish_solves)


def _polished(mode: Mode, trusted: np.ndarray, solves: int) -> Mode:
    state = replace(mode.state, trusted=trusted)
    return Mode(mode.problem, *polish(mode.problem, state, solves), mode.origin)
