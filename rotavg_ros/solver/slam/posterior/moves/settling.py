"""Treats labels as probabilities for a while, which passes barriers that stop single flips."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from rotavg_ros.solver.slam.posterior.em import settle
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal


def propose_settling(mode: Mode) -> Iterator[Proposal]:
    """Settles labels from the current state, if the label of at least one closure is uncertain.

    Labels that CleanNet and all other edges decide would not change as probabilities. The effect beyond the first label
    that changes cannot be predicted.
    """
    problem = mode.problem
    first = float(np.abs(mode.left_out.log_odds[problem.closure]).min(initial=np.inf))
    yield Proposal("settle", first, partial(settle, problem, mode.state), problem.limits.slack)
