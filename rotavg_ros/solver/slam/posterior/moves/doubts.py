"""Moves that reject all good closures of little evidence at once.

False closures that agree with odometry by chance bend the map, so each supports the others: no single flip rejects one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from rotavg_ros.solver.slam.posterior.em import step
from rotavg_ros.solver.slam.posterior.left_out import leave_one_out
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.state import State

# Closures with log-odds of being good below these, in nats, are rejected together.
_WEAK = (1.0, 3.0, 5.0)
# A single one is flipped anyway.
_LEAST_MEMBERS = 2


def propose_doubts(mode: Mode) -> Iterator[Proposal]:
    """Proposes to reject the good closures of weak evidence; those that the rest supports are flipped back.

    Where the rest supports each of them, all would be. Otherwise how many come back cannot be predicted.
    """
    problem, closure = mode.problem, mode.problem.closure
    may_be_false = ~mode.is_false & ~np.isinf(problem.log_odds[closure])
    before = _LEAST_MEMBERS - 1
    for weak in _WEAK:
        members = np.flatnonzero(may_be_false & (mode.left_out.log_odds[closure] < weak))
        if len(members) > before:
            before = len(members)
            if not _are_supported(mode, members):
                yield Proposal("doubt", 0.0, partial(_without, mode, members), problem.limits.slack)


def _are_supported(mode: Mode, members: np.ndarray) -> bool:
    """Whether each of some closures is likelier good than false by what is left without all of them."""
    left = step(mode.problem, _without(mode, members))
    told = leave_one_out(mode.problem, left.state, left.factorised).log_odds
    return bool((told[mode.problem.closure[members]] > 0).all())


def _without(mode: Mode, members: np.ndarray) -> State:
    trusted = mode.state.trusted.copy()
    trusted[mode.problem.closure[members]] = 0.0
    return replace(mode.state, trusted=trusted)
