"""Laplacian systems whose weights are 3 × 3 matrices, by conjugate gradients.

The weight of an edge between u and v is ``a_u S_u + a_v S_v``: S is a 3 × 3 matrix for each node, a_u and a_v are two
scalars for each edge. So no edge's matrix is ever formed, and a product with L takes two products with sparse matrices
of scalars. A has the coefficient a_v of v's own matrix in row v and column u; Aᵀ has that of u's:

    (L x)_v = D_v x_v − S_v (A x)_v − (Aᵀ S x)_v
"""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.residuals import SLICE_EDGES
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.sparse.conjugate_gradients import Stop, conjugate_gradients
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianSystem
from rotavg_ros.solver.running.threads import for_each, slices, threads_on
from rotavg_ros.solver.sfm.noise_shape import NoiseShape
from rotavg_ros.view_graph import ViewGraph

MAX_ITERATIONS = 300
# With fewer edges a product takes less time than waking another worker.
_WORTH_WORKERS = 50_000
Preconditioner = Callable[[Tensor], Tensor]


class SplitWeights(NamedTuple):
    """Weights of M edges: positive weights ``(M,)``, and the share ``(M,)`` of each that has its source's matrix."""

    total: Tensor
    source_share: Tensor


class Arrivals:
    """The sparsity pattern of A: which nodes' edges arrive at a node, either way.

    Args:
        edges: of the graph, sorted.
    """

    def __init__(self, edges: SortedEdges) -> None:
        self.num_nodes = edges.num_nodes
        self._edges = edges
        # Where what belongs to either end's matrix stands: first of all edges' targets, then of their sources.
        num_edges = len(edges.edge) // 2
        self._arrives = edges.edge + num_edges * edges.is_reversed.int()
        self._leaves = edges.edge + num_edges * (~edges.is_reversed).int()

    def by_end(self, weights: SplitWeights) -> Tensor:
        """What belongs to either end's matrix, first of all edges' targets, then of their sources, ``(2M,)``."""
        num_edges = len(weights.total)
        by_end = weights.total.new_empty(2, num_edges)

        def write(edges: slice) -> None:
            torch.mul(weights.total[edges], weights.source_share[edges], out=by_end[1, edges])
            torch.sub(weights.total[edges], by_end[1, edges], out=by_end[0, edges])

        for_each(write, slices(num_edges, SLICE_EDGES, by_end.device))
        return by_end.view(-1)

    def own(self, by_end: Tensor) -> Tensor:
        """A ``(N, N)``, of what :meth:`by_end` gives. An edge arrives at its target, reversed at its source."""
        return self._matrix(by_end.index_select(0, self._arrives))

    def others(self, by_end: Tensor) -> Tensor:
        """Aᵀ ``(N, N)``."""
        return self._matrix(by_end.index_select(0, self._leaves))

    def symmetric(self, value: Tensor) -> Tensor:
        """The matrix ``(N, N)`` that has the value of each edge, ``(M,)``, for both its ends."""
        return self._matrix(value.index_select(0, self._edges.edge))

    def _matrix(self, values: Tensor) -> Tensor:
        """``(N, N)``, given what arrives."""
        edges, size = self._edges, (self.num_nodes, self.num_nodes)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
            return torch.sparse_csr_tensor(edges.first, edges.source, values, size, check_invariants=False)


class Laplacian(ABC):
    """``L`` of a graph. Vectors have their components in rows, ``(3, N)``.

    Args:
        diagonal: ``(3, 3, N)`` the blocks on its diagonal.
        component: ``(N,)``; each of the C components is solved by itself.

    Attributes:
        weight_sum: ``(N,)`` the scalar weights of each node's edges, added up.
    """

    def __init__(self, diagonal: Tensor, weight_sum: Tensor, component: Tensor) -> None:
        self._components = Components(component, int(component.max()) + 1)
        self._diagonal, self.weight_sum = diagonal, weight_sum

    @abstractmethod
    def product(self, x: Tensor) -> Tensor:
        """``L x`` ``(3, N)``."""

    def at_nodes(self, x: Tensor) -> Tensor:
        """``D x`` ``(3, N)``: the diagonal's blocks alone."""
        return _apply(self._diagonal, x)

    def diagonal_solve(self) -> Preconditioner:
        """A preconditioner for well-knit graphs: what solves by the blocks on the diagonal alone."""
        blocks = self._diagonal.permute(2, 0, 1)
        isolated = blocks.diagonal(dim1=1, dim2=2).sum(dim=1) <= 0
        unit = torch.eye(3, dtype=blocks.dtype, device=blocks.device)
        # Unlike inv, inv_ex does not stop to look whether all went well.
        inverse = torch.linalg.inv_ex(blocks + isolated[:, None, None] * unit).inverse
        return partial(_apply, inverse.permute(1, 2, 0).contiguous())

    def solve(
        self, force: Tensor, precondition: Preconditioner, tolerance: float, relative_tolerance: float
    ) -> tuple[Tensor, Tensor | None]:
        """``L⁻¹ force`` ``(3, N)``, up to a constant in every component, and where it is as good as asked for.

        That is ``(C,)`` bool; None: everywhere.

        Args:
            force: sums to zero over every component.
            precondition: an approximate solution.
            tolerance: largest entry of the preconditioned residual, in the unknowns' unit.
            relative_tolerance: the same as a share of what it is at zero; the larger of the two counts.
        """
        stop = Stop(tolerance, relative_tolerance, MAX_ITERATIONS)
        return conjugate_gradients(self.product, precondition, force, self._components, stop)


class BlockLaplacian(Laplacian):
    """``L`` of a graph, in the weights' precision.

    Args:
        arrivals: the graph's.
        weights: of the edges.
        shape: S.
        component: ``(N,)``; each of the C components is solved by itself.
    """

    def __init__(self, arrivals: Arrivals, weights: SplitWeights, shape: NoiseShape, component: Tensor) -> None:
        self._threads = threads_on(component.device) if len(weights.total) > _WORTH_WORKERS else 1
        self._information = shape.information.to(weights.total).contiguous()
        one = weights.total.new_ones(1, arrivals.num_nodes)
        upper, lower = torch.triu_indices(3, 3, device=one.device)  # a symmetric matrix has six entries of its own
        rows = one, torch.cat((self._information[upper, lower], one))
        matrices, sums = [one, one], [one, one]
        by_end = arrivals.by_end(weights)

        def one_part(number: int) -> None:
            matrices[number] = (arrivals.own, arrivals.others)[number](by_end)
            sums[number] = arriving(matrices[number], rows[number])

        for_each(one_part, (1, 0), self._threads)  # the longer part first
        self._own, self._others = matrices
        own, others = sums[0][0], sums[1]
        of_others = torch.empty_like(self._information)
        of_others[upper, lower] = of_others[lower, upper] = others[:6]
        super().__init__(of_others + own * self._information, own + others[6], component)

    def product(self, x: Tensor) -> Tensor:
        """``L x`` ``(3, N)``."""
        parts = [x] * 2

        def one_part(number: int) -> None:
            if number == 0:
                parts[0] = _apply(self._information, arriving(self._own, x))
            else:
                parts[1] = arriving(self._others, _apply(self._information, x))

        for_each(one_part, (0, 1), self._threads)
        return self.at_nodes(x).sub_(parts[0]).sub_(parts[1])


class Components:
    """The components of a graph, each a system by itself; vectors are ``(k, N)``.

    Args:
        component: ``(N,)``.
    """

    def __init__(self, component: Tensor, count: int) -> None:
        self._component, self._count = component, count

    def spread(self, value: Tensor) -> Tensor:
        """What each node's component has, of ``(C,)``: ``(N,)``, or ``(1,)`` where there is but one."""
        return value if self._count == 1 else value[self._component]

    def dot(self, a: Tensor, b: Tensor) -> Tensor:
        if self._count == 1:  # index_add would take a node after the other
            return torch.dot(a.flatten(), b.flatten())[None]
        return a.new_zeros(self._count).index_add_(0, self._component, (a * b).sum(dim=0))

    def largest(self, x: Tensor) -> Tensor:
        if self._count == 1:
            return x.abs().max()[None]
        return x.new_zeros(self._count).scatter_reduce(0, self._component, x.abs().amax(dim=0), "amax")


def factorised(graph: ViewGraph, weight: Tensor, roots: Tensor) -> Preconditioner:
    """A preconditioner for graphs that are not well knit: the same Laplacian with round weights, factorised.

    Args:
        weight: ``(M,)`` mean of the diagonal of each edge's weight.
    """
    ends = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    system = LaplacianSystem(graph.num_nodes, *ends, weight.cpu().numpy(), roots.cpu().numpy())
    return lambda x: torch.from_numpy(system.solve(x.t().cpu().double().numpy())).t().to(x)


def arriving(matrix: Tensor, rows: Tensor) -> Tensor:
    """``matrix @ rowsᵀ``, components in rows again, ``(k, N)``; sparse products want them side by side."""
    return (matrix @ rows.t().contiguous()).t().contiguous()


def _apply(matrices: Tensor, x: Tensor) -> Tensor:
    """Each of the matrices ``(3, 3, N)`` to its vector of ``(3, N)``."""
    return (matrices * x).sum(dim=1)
