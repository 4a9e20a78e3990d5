"""Which loop closures agree with each other.

Two good closures whose ends are near each other along the odometry measure nearly the same drift, so their residuals
differ only by their own noise and that of the few steps between them. A false closure agrees with none, or with others
of its group.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree

from rotavg_ros import rotations
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph

_NUM_NEIGHBOURS = 16


@dataclass(frozen=True)
class AgreementPairs:
    """Every closure with its nearest ones (C closures, P ≤ C · k pairs, k ≤ 16, grouped by ``first``).

    Attributes:
        first, second: ``(P,)`` closures, numbered 0 … C − 1.
        steps: ``(P,)`` odometry steps between their ends, summed over both ends.
        squared_angle: ``(P,)`` rad², squared angle between their residuals.
    """

    first: np.ndarray
    second: np.ndarray
    steps: np.ndarray
    squared_angle: np.ndarray


_NO_PAIRS = AgreementPairs(np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0), np.empty(0))


def closure_ends(graph: ClosureGraph, closure: np.ndarray) -> np.ndarray:
    """``(C, 2)`` both ends of closures (edges of the graph), in steps along the odometry, the earlier first."""
    ends = np.stack((graph.position[graph.source[closure]], graph.position[graph.target[closure]]), axis=1)
    return np.sort(ends, axis=1)


def agreement_pairs(graph: ClosureGraph) -> AgreementPairs:
    """The closures nearest to every closure, by steps along the odometry, that connect the same chains."""
    closure = np.flatnonzero(graph.is_closure)
    count = min(_NUM_NEIGHBOURS, len(closure) - 1)
    if count < 1:
        return _NO_PAIRS
    residual = graph.residual[torch.from_numpy(closure)]
    # Residuals are comparable in one direction only: old → new.
    turned = torch.from_numpy(graph.position[graph.source[closure]] > graph.position[graph.target[closure]])[:, None]
    residual = torch.where(turned, rotations.inverse(residual), residual)
    ends = closure_ends(graph, closure)
    steps, neighbour = KDTree(ends).query(ends, k=count + 1, p=1)
    # Each closure finds itself, but not always first if others share its ends.
    itself = neighbour == np.arange(len(closure))[:, None]
    itself[~itself.any(axis=1), -1] = True
    first = np.repeat(np.arange(len(closure)), count)
    second = neighbour[~itself]
    # The angle between two rotations is twice that between their quaternions as 4-vectors. Angles are squared, so the
    # 1e-8 rad that the cosine cannot resolve do not matter.
    cosine = (residual[:, None] * residual[second].view(len(closure), count, 4)).sum(dim=2).abs().flatten()
    pairs = AgreementPairs(first, second, steps[~itself], ((2 * cosine.clamp(max=1).acos()) ** 2).numpy())
    return _between_same_chains(pairs, graph, closure)


def _between_same_chains(pairs: AgreementPairs, graph: ClosureGraph, closure: np.ndarray) -> AgreementPairs:
    """The pairs whose closures connect the same two chains; between others the number of steps is undefined."""
    chain = graph.chain
    chains = np.sort(np.stack((chain[graph.source[closure]], chain[graph.target[closure]]), axis=1), axis=1)
    if (chains == chains[0]).all():
        return pairs
    kept = (chains[pairs.first] == chains[pairs.second]).all(axis=1)
    return AgreementPairs(pairs.first[kept], pairs.second[kept], pairs.steps[kept], pairs.squared_angle[kept])
