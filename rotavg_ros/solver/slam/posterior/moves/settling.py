"""Labels as probabilities for a while: it comes past what stops single flips."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from rotavg_ros.solver.slam.posterior.em import settle
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal


def propose_settling(mode: Mode) -> Iterator[Proposal]:
    """Labels settled from where they are, which is worth trying if one of them is open.

    Labels that CleanNet and all other edges decide would be as probabilities what they are. What comes after the first
    one that changes is not known before.
    """
    problem = mode.problem
    first = float(np.abs(mode.left_out.log_odds[problem.closure]).min(initial=np.inf))
    yield Proposal("settle", first, partial(settle, problem, mode.state), problem.limits.slack)
