"""What training of robots' FineNet sees of a graph: a solved labelling whose truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.diagnosis import from_truth
from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.slam.fine_net.features import joined
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.sample import FineSample, Losses, Truth
from rotavg_ros.solver.slam.fine_net.tuning import Tuned, applied
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.posterior.solve import Drawn
from rotavg_ros.view_graph import ViewGraph

__all__ = ["FineSample", "Losses", "SlamFineNet", "SolvedRun", "losses_of", "losses_under", "solved_run"]

# Fewer tell nothing of how they differ.
_LEAST_CLOSURES = 6
# Where labels are wrong the map is, rad in the mean and at worst: no weights will mend it.
_MEAN_ERROR, _WORST_ERROR = 0.15, 0.6
# So many times each graph's edges err anew.
_FRESH = 4
# rad², of an edge that is exact.
_LEAST_VARIANCE = 1e-10


@dataclass(frozen=True)
class SolvedRun:
    """The best labelling of a graph whose truth is known.

    Attributes:
        tuned: the labelling, without FineNet.
        truth: of its key nodes and edges.
        first: what FineNet is trained on when it is applied once.
    """

    tuned: Tuned
    truth: Truth
    first: FineSample

    def again(self, network: SlamFineNet) -> FineSample:
        """What it is trained on when it is applied a second time, after itself."""
        return FineSample.of(applied(network, self.tuned), self.truth)


@torch.no_grad()
def solved_run(graph: ViewGraph, body_from_world: Tensor, is_false: Tensor, variance: Tensor) -> SolvedRun | None:
    """The posterior of a graph that states nothing twice, from its true labels on, without FineNet.

    Args:
        graph: N nodes, M edges.
        body_from_world: ``(N, 4)`` true orientations.
        is_false: ``(M,)`` bool, false closures and slips.
        variance: ``(M,)`` rad² per component, of each edge's actual noise.

    Returns:
        None where there are too few closures, or labels change so that the answer is wrong by so much that no weights
        will mend it.
    """
    if int((~graph.is_odometry).sum()) < _LEAST_CLOSURES:
        return None
    drawn = Drawn.of(graph, Networks("cpu").load(SlamCleanNet))
    mode = from_truth(drawn, body_from_world, is_false).modes[0]
    closure_graph = mode.problem.graph
    tuned = Tuned(mode.problem, mode.state, mode.evaluation.factorised)
    correction = np.ascontiguousarray(closure_graph.corrections(body_from_world).numpy().T)
    of_edges = _of_edges(closure_graph, np.where(is_false.numpy(), np.nan, variance.numpy()))
    truth = Truth(correction, of_edges)
    sample = FineSample.of(tuned, truth)
    mean, worst = sample.errors()
    return SolvedRun(tuned, truth, sample) if mean < _MEAN_ERROR and worst < _WORST_ERROR else None


def _of_edges(graph: ClosureGraph, variance: np.ndarray) -> np.ndarray:
    """``(E,)`` from ``(M,)``: a segment's is the sum over its edges."""
    is_passed = graph.segment_of_edge >= 0
    of_segments = np.bincount(graph.segment_of_edge[is_passed], variance[is_passed], minlength=graph.num_segments)
    return np.asarray(np.maximum(np.concatenate((of_segments, variance[graph.view_graph_edge])), _LEAST_VARIANCE))


def losses_of(network: SlamFineNet, samples: Sequence[FineSample], rng: np.random.Generator) -> Losses:
    """``(n,)`` each, of several graphs at once."""
    told = network(joined([sample.features for sample in samples])).double()
    return losses_under([*told.split([len(sample.used) for sample in samples])], samples, rng)


def losses_under(log_noise: Sequence[Tensor], samples: Sequence[FineSample], rng: np.random.Generator) -> Losses:
    """``(n,)`` each, for given logarithms of variances ``(E,)`` of each graph."""
    each = [
        sample.losses(noise, torch.from_numpy(rng.normal(size=(*sample.residual.shape, _FRESH))))
        for sample, noise in zip(samples, log_noise, strict=True)
    ]
    return Losses(*(torch.stack(values) for values in zip(*each, strict=True)))
