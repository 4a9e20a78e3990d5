"""A truncated least-squares cost on a closure graph, in which odometry may slip, and its descent from a start.

An edge costs a quarter of its squared residual in units of its variance, but at most the cost of a wrong edge: the
log-odds of being good of an edge with zero residual, or twice that if one slip does not suffice. Costs are in nats.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianPattern
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.model import NoiseModel

# Before the optimum is reached residuals are larger than at the optimum: variances are multiplied by this.
_SLACK = 2.0
_SETTLING_STEPS = 2
# Factors of the annealing per step; the larger one is used while the loss is so convex that no edge stands out.
_ANNEALING_FACTOR, _COARSE_FACTOR = 1.4, 2.0
_COARSE_CONVEXITY = 100.0
_DESCENT_STEPS = 8
_SETTLED_STEP = np.radians(0.03)
# Odometry does not drift evenly: this share of segments has this many times the variance that its length implies.
_UNEVEN_SHARE = 0.1
_UNEVEN_RATIO = 16.0
# A slip is less than a right angle; a segment that turns by more has slipped twice.
_MAX_SLIP = np.pi / 2
_COSINE_OF_MAX_SLIP = np.cos(_MAX_SLIP / 2)
# Maximum number of steps of a segment that count for a slip: the exact step in a long segment does not matter.
_MAX_LOCATED_STEPS = 3.0
# Rounding error of a real part.
_ROUNDING = 1e-9
# Least weight, so that a graph that falls apart without its wrong edges remains solvable.
_MIN_WEIGHT = 1e-9


@dataclass(frozen=True)
class TruncatedCost:
    """The cost of the edges of ``graph`` (E edges).

    Attributes:
        graph: the closure graph.
        variance: ``(E,)`` rad² per component.
        cap: ``(E,)`` cost of a wrong edge, ≥ 0.
        measured: ``(4, E)``, the graph's residuals, components in rows.
        cap_of_two: ``(E,)`` cost of an edge that is wrong by more than one slip.
        uneven_cost: ``(E,)`` prior cost of a segment that drifts more than by its length; inf for closures.
        reach: ``(E,)`` real part of a residual above which an edge costs less than a wrong one.
    """

    graph: ClosureGraph
    variance: np.ndarray
    cap: np.ndarray
    measured: np.ndarray
    cap_of_two: np.ndarray
    uneven_cost: np.ndarray
    reach: np.ndarray

    @staticmethod
    def create(graph: ClosureGraph, noise: NoiseModel, log_odds: np.ndarray) -> TruncatedCost:
        """From the noise and each edge's prior log-odds of being good, ``(E,)``; ±inf decide it."""
        variance = graph.own_steps * np.where(graph.is_odometry, noise.step_variance, noise.closure_variance)
        # Without the edge, the path around passes at least one further closure; for a segment, two.
        around = variance + np.where(graph.is_odometry, 2.0, 1.0) * noise.closure_variance
        cap = noise.inlier_log_odds(np.zeros(len(variance)), around) + np.clip(log_odds, -100, 100)
        cap = np.maximum(cap, 0.0)
        uneven = float(noise.components / 2 * np.log(_UNEVEN_RATIO) - np.log(_UNEVEN_SHARE))
        # The squared residual, in units of the variance, at which a good edge costs as much as a wrong one.
        limit = 2 * _SLACK * np.where(graph.is_odometry, np.maximum(cap, _UNEVEN_RATIO * (cap - uneven)), cap)
        reach = np.cos(np.minimum(np.sqrt(limit * variance), np.pi) / 2) - _ROUNDING
        measured = np.ascontiguousarray(graph.residual.numpy().T)
        cap_of_two = np.where(graph.is_odometry, 2 * cap, cap)
        uneven_cost = np.where(graph.is_odometry, uneven, np.inf)
        return TruncatedCost(graph, variance, cap, measured, cap_of_two, uneven_cost, reach)

    @cached_property
    def pattern(self) -> LaplacianPattern:
        """The graph's Laplacian."""
        graph = self.graph
        return LaplacianPattern(graph.num_nodes, graph.source, graph.target, graph.roots)

    def residual(self, correction: Tensor) -> Tensor:
        """``(E, 4)`` of either sign."""
        return torch.from_numpy(self._residual(_rows(correction)).T)

    def _residual(self, correction: np.ndarray) -> np.ndarray:
        return quaternion_rows.residual(correction, self.measured, self.graph.source, self.graph.target)

    def of_edges(self, residual: Tensor) -> np.ndarray:
        """Cost of every edge with residuals ``(E, 4)``."""
        return self.of_cosines(residual[:, 3])

    def of_cosines(self, cosine: Tensor) -> np.ndarray:
        """The same from the residuals' real parts ``(E, …)``; the 1e-8 rad that these do not resolve cost nothing."""
        cosines = np.abs(cosine.numpy())
        if cosines.ndim == 1:
            wrong = np.where(cosines < _COSINE_OF_MAX_SLIP, self.cap_of_two, self.cap)
            return np.asarray(np.minimum(self._if_good(_squared_angle(cosines), slice(None)), wrong))
        costs = np.where(cosines < _COSINE_OF_MAX_SLIP, self.cap_of_two[:, None], self.cap[:, None])
        # Most turned edges are beyond reach, and the arc cosine takes longer than everything else.
        near = np.flatnonzero(cosines > self.reach[:, None])
        good = self._if_good(_squared_angle(cosines.take(near)), near // cosines.shape[1])
        costs.put(near, np.minimum(good, costs.take(near)))
        return costs

    def _if_good(self, square: np.ndarray, edge: np.ndarray | slice) -> np.ndarray:
        """Cost of certain edges if they are not wrong, by their squared residuals in rad²."""
        usual = square / (2 * _SLACK * self.variance[edge])
        return np.asarray(np.minimum(usual, self.uneven_cost[edge] + usual / _UNEVEN_RATIO))

    def total(self, correction: Tensor) -> float:
        """Cost of a solution ``(K, 4)``, in nats."""
        return float(self.of_edges(self.residual(correction)).sum())

    def descend(self, correction: Tensor) -> Tensor:
        """Gauss–Newton with Geman–McClure weights, the smooth sibling of the truncated cost; corrections ``(K, 4)``."""
        scale, rows = 2 * self.cap, _rows(correction)
        for _ in range(_DESCENT_STEPS):
            vectors, square = self._vectors(rows)
            rows, moved = self._step(rows, vectors, (scale / (square + scale + 1e-12)) ** 2)
            if moved < _SETTLED_STEP:
                break
        return _tensor(rows)

    def anneal(self, correction: Tensor) -> Tensor:
        """The same, with a loss that is annealed from least squares (graduated non-convexity, Yang et al. 2020).

        The start ``(K, 4)`` only affects the linearisation of rotations.
        """
        scale, rows = 2 * self.cap, _rows(correction)
        for _ in range(_SETTLING_STEPS):
            rows, _ = self._step(rows, self._vectors(rows)[0], np.ones(len(scale)))
        vectors, square = self._vectors(rows)
        convexity = float((2 * square / np.maximum(scale, 1e-12)).max(initial=0.0, where=scale > 0)) + 1
        while convexity > 1 / _ANNEALING_FACTOR:
            annealed = max(convexity, 1.0) * scale + 1e-12
            rows, _ = self._step(rows, vectors, (annealed / (square + annealed)) ** 2)
            convexity /= _COARSE_FACTOR if convexity > _COARSE_CONVEXITY else _ANNEALING_FACTOR
            vectors, square = self._vectors(rows)
        return _tensor(rows)

    def _vectors(self, correction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals as rotation vectors ``(E, 3)`` in radians, and their squares in units of the variance ``(E,)``."""
        vectors = quaternion_rows.log(self._residual(correction))
        return vectors.T, np.einsum("ie,ie->e", vectors, vectors) / self.variance

    def _step(self, correction: np.ndarray, vectors: np.ndarray, factor: np.ndarray) -> tuple[np.ndarray, float]:
        """The next corrections ``(4, K)``, and the largest component of a node's turn in radians."""
        step = self.pattern.factorize(np.maximum(factor, _MIN_WEIGHT) / self.variance).fit(vectors)
        turned = quaternion_rows.multiply(correction, quaternion_rows.exp(step.T))
        return quaternion_rows.normalize(turned), float(np.abs(step).max(initial=0.0))


def no_slip_log_odds(steps: np.ndarray, components: int, slip_probability: float) -> np.ndarray:
    """Prior log-odds that segments are sound, relative to a slip that is uniform over turns of less than a right angle.

    Args:
        steps: ``(E,)`` odometry steps in each.
        components: 1 or 3.
        slip_probability: per step.
    """
    narrower = np.log(2.0) if components == 1 else np.log(2 / (1 - np.cos(np.pi / 4)))
    none = np.log1p(-slip_probability) * np.minimum(steps, _MAX_LOCATED_STEPS)
    return np.asarray(none - np.log(-np.expm1(none)) - narrower)


def _squared_angle(cosine: np.ndarray) -> np.ndarray:
    """Squared angles, rad², of rotations by their real parts ≥ 0."""
    return np.asarray((2 * np.arccos(np.minimum(cosine, 1.0))) ** 2)


def _rows(quaternions: Tensor) -> np.ndarray:
    """``(n, 4)`` → components in rows."""
    return np.ascontiguousarray(quaternions.numpy().T)


def _tensor(rows: np.ndarray) -> Tensor:
    """The inverse, w ≥ 0."""
    return rotations.canonical(torch.from_numpy(np.ascontiguousarray(rows.T)))
