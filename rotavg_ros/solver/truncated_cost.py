"""A truncated least-squares cost on a closure graph, in which odometry may slip, and its descent from a start.

An edge costs half its squared residual in units of its variance, but no more than it takes to call it wrong: the
log-odds of being good that an edge without residual has; twice that if it takes two slips. So the cost counts, in nats,
how much is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.fine_net import edge_residual
from rotavg_ros.solver.laplacian import LaplacianPattern
from rotavg_ros.solver.noise_model import NoiseModel
from rotavg_ros.solver.residuals import EdgeResiduals
from rotavg_ros.view_graph import ViewGraph

# Estimates on the way to the optimum fit worse than the optimum: their variance counts this many times.
_SLACK = 2.0
_SETTLING_STEPS = 2
# By this the loss is annealed from step to step; by more while it is so convex that no edge stands out.
_ANNEALING_FACTOR, _COARSE_FACTOR = 1.4, 2.0
_COARSE_CONVEXITY = 100.0
_DESCENT_STEPS = 8
_SETTLED_STEP = np.radians(0.03)
# Odometry does not drift evenly: one segment in so many drifts by so much more (in variance) than its length tells.
_UNEVEN_SHARE = 0.1
_UNEVEN_RATIO = 16.0
# A slip is less than a right angle; a segment that turns by more has slipped twice.
_MAX_SLIP = np.pi / 2
# Weight of what is believed wrong: enough to keep a graph solvable that falls apart without it.
_MIN_WEIGHT = 1e-9


@dataclass(frozen=True)
class TruncatedCost:
    """The cost of the edges of ``graph`` (E edges).

    Attributes:
        graph: the closure graph.
        variance: ``(E,)`` rad² per component.
        cap: ``(E,)`` what a wrong edge costs, ≥ 0.
        pattern: the graph's Laplacian.
        edges: the graph's edges and residuals as edges between its corrections.
        uneven_cost: what a segment costs beforehand that drifts more than its length tells.
    """

    graph: ClosureGraph
    variance: np.ndarray
    cap: np.ndarray
    pattern: LaplacianPattern
    edges: ViewGraph
    uneven_cost: float

    @staticmethod
    def create(graph: ClosureGraph, noise: NoiseModel, log_odds: np.ndarray) -> TruncatedCost:
        """From the noise and each edge's prior log-odds of being good, ``(E,)``; ±inf decide it."""
        variance = graph.steps * np.where(graph.is_odometry, noise.step_variance, noise.closure_variance)
        # Without the edge, the way round passes at least one closure more; a segment's, two.
        around = variance + np.where(graph.is_odometry, 2.0, 1.0) * noise.closure_variance
        cap = noise.inlier_log_odds(np.zeros(len(variance)), around) + np.clip(log_odds, -100, 100)
        uneven = float(noise.components / 2 * np.log(_UNEVEN_RATIO) - np.log(_UNEVEN_SHARE))
        pattern = LaplacianPattern(graph.num_nodes, graph.source, graph.target, graph.roots)
        edges = ViewGraph.create(graph.source, graph.target, graph.residual, num_nodes=graph.num_nodes)
        return TruncatedCost(graph, variance, np.maximum(cap, 0.0), pattern, edges, uneven)

    def residual(self, correction: Tensor) -> Tensor:
        """``(E, 4)``."""
        graph = self.graph
        return edge_residual(correction, graph.residual, torch.from_numpy(graph.source), torch.from_numpy(graph.target))

    def of_edges(self, residual: Tensor) -> np.ndarray:
        """Cost of every edge with residuals ``(E, 4)``."""
        return self.of_cosines(residual[:, 3])

    def of_cosines(self, cosine: Tensor) -> np.ndarray:
        """The same from the residuals' real parts ``(E, …)``; the 1e-8 rad that these do not resolve cost nothing."""
        square = (2 * cosine.abs().clamp(max=1).acos().numpy().T) ** 2
        slips = np.where(self.graph.is_odometry & (square > _MAX_SLIP**2), 2.0, 1.0)
        return np.asarray(np.minimum(self._if_good(square), slips * self.cap).T)

    def _if_good(self, square: np.ndarray) -> np.ndarray:
        """Cost of edges that are not wrong, by their squared residuals ``(…, E)`` in rad²."""
        usual = square / (2 * _SLACK * self.variance)
        return np.where(self.graph.is_odometry, np.minimum(usual, self.uneven_cost + usual / _UNEVEN_RATIO), usual)

    def total(self, correction: Tensor) -> float:
        """Cost of a solution ``(K, 4)``, in nats."""
        return float(self.of_edges(self.residual(correction)).sum())

    def log_odds(self, correction: Tensor) -> np.ndarray:
        """``(E,)`` of each edge to be good, by its residual."""
        square = (rotations.log(self.residual(correction)) ** 2).sum(dim=1).numpy()
        return np.asarray(self.cap - self._if_good(square))

    def descend(self, correction: Tensor, trust: np.ndarray | None = None) -> Tensor:
        """Gauss–Newton with Geman–McClure weights, the smooth sibling of the truncated cost; corrections ``(K, 4)``.

        Args:
            correction: ``(K, 4)`` start.
            trust: ``(E,)`` factors on the weights; if given, the loss is annealed from least squares on (graduated
                non-convexity, Yang et al. 2020), and the start matters only as far as angles are not linear.
        """
        scale = 2 * self.cap
        if trust is None:
            for _ in range(_DESCENT_STEPS):
                vectors, square = self._vectors(correction)
                correction, moved = self._step(correction, vectors, (scale / (square + scale + 1e-12)) ** 2)
                if moved < _SETTLED_STEP:
                    break
            return correction
        for _ in range(_SETTLING_STEPS):
            correction, _ = self._step(correction, self._vectors(correction)[0], trust)
        vectors, square = self._vectors(correction)
        convexity = float((2 * square / np.maximum(scale, 1e-12)).max(initial=0.0, where=scale > 0)) + 1
        while convexity > 1 / _ANNEALING_FACTOR:
            annealed = max(convexity, 1.0) * scale + 1e-12
            correction, _ = self._step(correction, vectors, trust * (annealed / (square + annealed)) ** 2)
            convexity /= _COARSE_FACTOR if convexity > _COARSE_CONVEXITY else _ANNEALING_FACTOR
            vectors, square = self._vectors(correction)
        return correction

    def _vectors(self, correction: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """Residuals as rotation vectors ``(E, 3)`` in radians, and their squares in units of the variance ``(E,)``."""
        vectors = EdgeResiduals(self.edges, correction).vectors(slice(None)).numpy()
        return vectors.T, (vectors * vectors).sum(axis=0) / self.variance

    def _step(self, correction: Tensor, vectors: np.ndarray, factor: np.ndarray) -> tuple[Tensor, float]:
        """The next corrections, and the largest component of a node's turn in radians."""
        step = self.pattern.factorize(np.maximum(factor, _MIN_WEIGHT) / self.variance).fit(vectors)
        turned = rotations.multiply(correction, rotations.exp(torch.from_numpy(step)))
        return rotations.normalize(turned), float(np.abs(step).max(initial=0.0))
