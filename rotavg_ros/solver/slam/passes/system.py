"""The sparse system that every pass of the SLAM refinement solves, and what it tells of each edge's prediction."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from rotavg_ros.solver.algebra.laplacian import FactorisedLaplacian, LaplacianPattern
from rotavg_ros.solver.algebra.probes import likeliest_leverage, probe_signs
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph

_NUM_PROBES = 48
# So many rows of probes stay in a core's cache.
_EDGES_AT_ONCE = 1024
# From so many nodes on, a system is solved from an earlier factorisation.
ITERATING_PAYS = 4000
# An edge that alone holds two parts of the graph together has leverage 1; it cannot be judged by the others.
_MAX_LEVERAGE = 0.999


class StaleFactorError(ArithmeticError):
    """An earlier factorisation is no longer near enough."""


class System(Protocol):
    """Of a closure graph (K nodes, E edges).

    Attributes:
        prediction_variance: ``(E,)`` rad², of what the rest of the graph predicts of each edge: its effective
            resistance without the edge itself, which does not depend on the edge's own weight.
    """

    prediction_variance: np.ndarray

    def solve(self, weight: np.ndarray, residual: np.ndarray, *, refresh: bool, is_near: bool) -> np.ndarray:
        """Corrections ``(K, 3)`` that fit residuals ``(E, 3)`` best under weights ``(E,)``.

        Args:
            refresh: predictions are asked for next.
            is_near: the weights are nearly those of the last time.

        Raises:
            StaleFactorError: everything has to be factorised anew, which this system does not.
        """

    def predict(self, weight: np.ndarray) -> None:
        """Estimate ``prediction_variance`` anew, under the weights last solved with."""


class WholeSystem:
    """Factorised as often as weights change much; predictions of all edges from random right-hand sides.

    Attributes:
        pattern: of the graph.
        probes: ``(E, k)`` signs ±1.
        sampled_weight: ``(E,)`` the weights under which the samples were last drawn.
    """

    def __init__(self, graph: ClosureGraph, rank: np.ndarray | None = None) -> None:
        """Take a graph and the order of elimination ``(K,)`` where it is known."""
        self.pattern = LaplacianPattern(graph.num_nodes, graph.source, graph.target, graph.roots, rank)
        self.probes = probe_signs(graph.nodes[graph.source], graph.nodes[graph.target], _NUM_PROBES)
        self.prediction_variance = np.full(len(graph.source), np.inf)
        self._system: FactorisedLaplacian | None = None
        self._factorised: FactorisedLaplacian | None = None
        self._samples: np.ndarray | None = None
        self.sampled_weight = np.empty(0)

    @property
    def factorised(self) -> FactorisedLaplacian:
        """The last factorisation."""
        assert self._factorised is not None
        return self._factorised

    @property
    def samples(self) -> np.ndarray:
        """Errors ``(K, probes)`` as they might be under the weights last factorised; drawn when they are asked for."""
        if self._samples is None:
            self._samples = self.factorised.samples(self.probes)
            self.sampled_weight = self.factorised.weight
        return self._samples

    def solve(self, weight: np.ndarray, residual: np.ndarray, *, refresh: bool, is_near: bool) -> np.ndarray:
        """See :class:`System`."""
        # A pass after one that has not settled weighs as that did.
        if self._system is None or not np.array_equal(weight, self._system.weight):
            if self._system is None or refresh or not (is_near and self.pattern.num_nodes >= ITERATING_PAYS):
                self._system = self._factorised = self.pattern.factorize(weight)
                self._samples = None if refresh else self._samples
            else:
                self._system = self.pattern.near(weight, self.factorised)
        return self._system.fit(residual)

    def predict(self, weight: np.ndarray) -> None:
        """See :class:`System`."""
        scale, samples = np.sqrt(weight), self.samples
        square, product = np.empty(len(scale)), np.empty(len(scale))
        for start in range(0, len(scale), _EDGES_AT_ONCE):
            edges = slice(start, start + _EDGES_AT_ONCE)
            difference = samples.take(self.pattern.target[edges], axis=0)
            difference -= samples.take(self.pattern.source[edges], axis=0)
            np.einsum("ek,ek->e", difference, difference, out=square[edges])
            np.einsum("ek,ek->e", difference, self.probes[edges].astype(np.float64), out=product[edges])
        leverage = likeliest_leverage(weight * square / _NUM_PROBES, scale * product / _NUM_PROBES)
        leverage = np.minimum(leverage, _MAX_LEVERAGE)
        self.prediction_variance = leverage / (weight * (1 - leverage))


def leverage(weight: np.ndarray, prediction_variance: np.ndarray) -> np.ndarray:
    """Of every edge, ``(E,)``: how far its own measurement decides what is estimated of it."""
    gain = weight * prediction_variance
    return np.asarray(np.minimum(gain / (1 + gain), _MAX_LEVERAGE))
