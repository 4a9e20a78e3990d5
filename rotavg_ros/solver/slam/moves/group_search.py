"""A second opinion on a solution that believes groups of closures which judged as one are false."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from torch import Tensor

from rotavg_ros.solver.slam.moves.slip_doubt import Doubt
from rotavg_ros.solver.slam.moves.slip_search import grouped_cost, prior_log_odds
from rotavg_ros.solver.slam.moves.truncated_cost import TruncatedCost
from rotavg_ros.solver.slam.noise.model import agree, noise_between_neighbours
from rotavg_ros.solver.slam.passes.alternation import SlamEstimate, Start
from rotavg_ros.solver.slam.preparation import Prepared

# So often are false groups looked for; where there are some, others may show only without them.
_MAX_ROUNDS = 4
# A difference of so many nats is none.
_TIE = 1.0


class Refinement(Protocol):
    """Refines from a start; the order of elimination, ``(K,)``, is given where it is known."""

    def __call__(self, start: Start, rank: np.ndarray | None = None) -> SlamEstimate: ...


def without_false_groups(
    refine: Refinement,
    estimate: SlamEstimate,
    prepared: Prepared,
    log_odds: np.ndarray,
    doubt: Doubt,
) -> SlamEstimate:
    """``estimate`` refined without false groups as long as there are some and it is worth it, else as it is.

    Args:
        log_odds: ``(E,)`` prior log-odds of each edge to be good, beyond the common outlier share; ±inf decide it.
        doubt: in ``estimate``.
    """
    if not estimate.in_false_group.any():
        return estimate
    graph, pairs, by_chain = prepared.closure_graph, prepared.pairs, prepared.noise
    noise = noise_between_neighbours(pairs, by_chain.components)
    is_agreed = agree(pairs, noise)
    cost = TruncatedCost.create(graph, noise, prior_log_odds(graph, noise, log_odds), estimate.rank)

    def is_better(found: Tensor, before: Tensor) -> bool:
        """Whether corrections ``(K, 4)`` are, if groups have one reason to be wrong and odometry may have slipped.

        If it has, good closures look like false groups, and then there are many of them. So where that is in doubt, or
        groups do not tell, the solution must be better with closures counted one by one, too.
        """
        if_grouped = [grouped_cost(cost, cost.descend(correction), pairs, is_agreed) for correction in (found, before)]
        lost = if_grouped[0] - if_grouped[1]
        if doubt == Doubt.NONE and lost < -_TIE:
            return True
        return lost < _TIE and cost.total(found) < cost.total(before)

    for _ in range(_MAX_ROUNDS):
        false = estimate.in_false_group
        # What the network said for them goes by their agreement.
        log_odds = np.where(false, np.minimum(log_odds, 0.0), log_odds)
        probability = np.where(false, 0.0, estimate.inlier_probability)
        without = refine(Start(graph, estimate.correction, probability, by_chain, log_odds), estimate.rank)
        if not is_better(without.correction, estimate.correction):
            break
        estimate = without
        if not estimate.in_false_group.any():
            break
    return estimate
