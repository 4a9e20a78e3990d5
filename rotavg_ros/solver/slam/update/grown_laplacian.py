"""The Laplacian of a closure graph that has grown by a handful of edges, solved from an older factorisation.

Between two ticks the graph gains a stretch of odometry and a few closures, and some of its segments are cut in two
where a new closure ends. Odometry alone changes nothing about the nodes that there were (a stretch hangs loose, and two
halves in a row are the whole), so it is eliminated exactly. New closures are of low rank: one solve each, done once.
What remains, weights of old closures that have changed, is left to conjugate gradients.

Dense products are torch's, which inside a solve keep to one thread; numpy's wait for each other (``threads.py``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.linalg import splu

from rotavg_ros.solver.algebra.conjugate_gradients import Stop, iterate
from rotavg_ros.solver.algebra.laplacian import (
    FactorisedLaplacian,
    incidence_matrix,
    root_stiffness,
    solve_in_parts,
)
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph

# Conjugate gradients end at a step that no orientation could be seen to take, or at a thousandth of the first one.
_SETTLED = Stop(tolerance=float(np.radians(0.002)), relative_tolerance=1e-3, max_iterations=12)


@dataclass(frozen=True)
class OlderFactor:
    """A closure graph's Laplacian as it once was (K' nodes), and what has been solved with it since.

    Attributes:
        nodes: ``(K',)`` view-graph nodes, ascending.
        roots: of these, those that are tied to zero.
        num_edges: of the view-graph at that time.
        solve: ``L⁻¹ b`` for ``(K', k)`` columns.
        num_entries: numbers that the factorisation consists of.
        closures: ``(r,)`` view-graph edges that came later, ascending.
        columns: ``(K', r)`` float32, solutions for a unit force between the ends of each.
    """

    nodes: np.ndarray
    roots: np.ndarray
    num_edges: int
    solve: Callable[[np.ndarray], np.ndarray]
    num_entries: int
    closures: np.ndarray
    columns: np.ndarray

    @classmethod
    def of(cls, graph: ClosureGraph, factorised: FactorisedLaplacian) -> OlderFactor:
        """What has just been factorised."""
        nothing = np.empty(0, dtype=np.int64), np.empty((graph.num_nodes, 0), dtype=np.float32)
        roots, num_edges = graph.nodes[graph.roots], len(graph.segment_of_edge)
        return cls(graph.nodes, roots, num_edges, factorised.solve, factorised.num_entries, *nothing)

    def fits(self, graph: ClosureGraph) -> bool:
        """Whether the graph has the same components as before."""
        return np.array_equal(graph.nodes[graph.roots], self.roots)


class GrownLaplacian:
    """The present graph's system (K nodes, E edges), for one choice of weights after another.

    Attributes:
        factor: the older factorisation, with a column for each of the closures that have come since.
        closures: ``(r,)`` edges of the closure graph that these closures are.
    """

    def __init__(self, older: OlderFactor, graph: ClosureGraph, weight: np.ndarray) -> None:
        """Eliminate what is new.

        Args:
            older: of a graph with the same components, see :meth:`OlderFactor.fits`.
            weight: ``(E,)``; later ones must leave the segments as they are.
        """
        self._graph, self._solve_older = graph, older.solve
        self._incidence = incidence_matrix(graph.num_nodes, graph.source, graph.target)
        self._differences = self._incidence.T.tocsr()
        place = np.minimum(np.searchsorted(graph.nodes, older.nodes), graph.num_nodes - 1)
        # Where a chain ended there need be no node any more.
        self._older_row = np.flatnonzero(graph.nodes[place] == older.nodes)
        self._known, self._num_older = place[self._older_row], len(older.nodes)
        is_new = np.ones(graph.num_nodes, dtype=bool)
        is_new[self._known] = False
        self._new = np.flatnonzero(is_new)
        self._factorise_odometry(weight, is_new)
        later = np.flatnonzero(graph.view_graph_edge >= older.num_edges)
        later = later[np.argsort(graph.view_graph_edge[later])]
        self.closures = graph.num_segments + later
        self.factor = self._with_columns(older, graph.view_graph_edge[later])
        columns = self._spread(self._forces(self.closures)[self._new], self.factor.columns)
        self._between = self._difference(columns).astype(np.float64)
        self._columns = torch.from_numpy(columns)
        self.reweight(weight)

    def reweight(self, weight: np.ndarray) -> None:
        """Put other weights ``(E,)`` into force."""
        self.weight = weight
        self._stiffness = root_stiffness(weight)
        inner = torch.from_numpy(np.diag(1 / weight[self.closures]) + self._between)
        self._inner = torch.cholesky_inverse(torch.linalg.cholesky(inner))

    def fit(self, difference: np.ndarray) -> np.ndarray | None:
        """Node values ``(K, k)`` whose differences over the edges fit ``(E, k)`` best; None if that takes too long."""
        forces = np.asarray(self._incidence @ (self.weight[:, None] * difference))
        return iterate(self._product, self._precondition, forces, _SETTLED)

    def prediction_variance(self) -> np.ndarray:
        """Of what the rest of the graph predicts of each new closure, ``(r,)``, old ones weighing what they did."""
        return np.asarray(1 / self._inner.diagonal().numpy() - 1 / self.weight[self.closures])

    def _product(self, values: np.ndarray) -> np.ndarray:
        image = self._incidence @ (self.weight[:, None] * (self._differences @ values))
        image[self._graph.roots] += self._stiffness * values[self._graph.roots]
        return np.asarray(image)

    def _precondition(self, forces: np.ndarray) -> np.ndarray:
        """Woodbury's identity: the older system with new odometry, and the new closures."""
        values = self._spread(forces[self._new], self._at_older(forces))
        forces_of_closures = self._inner @ torch.from_numpy(self._difference(values))
        values -= (self._columns @ forces_of_closures.float()).numpy()
        return values

    def _factorise_odometry(self, weight: np.ndarray, is_new: np.ndarray) -> None:
        """The block of the new nodes, of segments alone, and what couples it with the others."""
        graph, number = self._graph, np.cumsum(is_new) - 1
        segment = np.flatnonzero((is_new[graph.source] | is_new[graph.target])[: graph.num_segments])
        ends = np.concatenate((graph.source[segment], graph.target[segment]))
        others = np.concatenate((graph.target[segment], graph.source[segment]))
        weights = np.tile(weight[segment], 2)[is_new[ends]]
        ends, others = number[ends[is_new[ends]]], others[is_new[ends]]
        inner, count = is_new[others], len(self._new)
        diagonal = np.bincount(ends, weights, count)
        rows = np.concatenate((ends[inner], np.arange(count)))
        columns = np.concatenate((number[others[inner]], np.arange(count)))
        values = np.concatenate((-weights[inner], diagonal))
        block = csc_array(coo_array((values, (rows, columns)), shape=(count, count)))
        self._solve_new = partial(solve_in_parts, splu(block)) if count else np.asarray
        coupling = -weights[~inner], (ends[~inner], others[~inner])
        self._coupling = csr_array(coo_array(coupling, shape=(count, graph.num_nodes)))

    def _with_columns(self, older: OlderFactor, closures: np.ndarray) -> OlderFactor:
        """Solve for those closures ``(r,)`` of the view-graph that have come since the last time."""
        fresh = self.closures[len(older.closures) :]
        if len(fresh) == 0:
            return older
        columns = self._at_older(self._forces(fresh).toarray()).astype(np.float32)
        return replace(older, closures=closures, columns=np.concatenate((older.columns, columns), axis=1))

    def _forces(self, edges: np.ndarray) -> csr_array:
        """Unit forces between the ends of edges, ``(K, k)``."""
        return csr_array(incidence_matrix(self._graph.num_nodes, self._graph.source[edges], self._graph.target[edges]))

    def _at_older(self, forces: np.ndarray) -> np.ndarray:
        """The older system's nodes ``(K', k)`` under forces ``(K, k)``; those on new odometry act on its ends."""
        forces = forces - self._coupling.T @ self._solve_new(forces[self._new])
        at_older = np.zeros((self._num_older, forces.shape[1]))
        at_older[self._older_row] = forces[self._known]
        return self._solve_older(at_older)

    def _spread(self, forces: np.ndarray | csr_array, at_older: np.ndarray) -> np.ndarray:
        """From the older system's nodes ``(K', k)``, and the forces on new ones, to all nodes ``(K, k)``."""
        values = np.zeros((self._graph.num_nodes, at_older.shape[1]), dtype=at_older.dtype)
        values[self._known] = at_older[self._older_row]
        values[self._new] = self._solve_new(np.asarray(forces - self._coupling @ values))
        return values

    def _difference(self, values: np.ndarray) -> np.ndarray:
        """Node values ``(K, k)`` → differences over the new closures ``(r, k)``."""
        graph = self._graph
        return np.asarray(values[graph.target[self.closures]] - values[graph.source[self.closures]])
