"""Laplacian systems whose weights are 3 × 3 matrices, by conjugate gradients.

The weight of an edge u→v is ``w (S_u + T_v)``: w is a scalar for each edge; S_u and T_v are 3 × 3 matrices for each
node. So no matrix of an edge is ever formed, and a product with the whole takes two products with sparse matrices of
scalars, W over the edges as they run and Wᵀ:

    (L x)_v = D_v x_v − (W S x)_v − T_v (W x)_v − (Wᵀ T x)_v − S_v (Wᵀ x)_v
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.conjugate_gradients import Stop, conjugate_gradients
from rotavg_ros.solver.algebra.laplacian import LaplacianSystem
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.threads import for_each, threads_on
from rotavg_ros.solver.sfm.noise_shape import NoiseShape
from rotavg_ros.view_graph import ViewGraph

_MAX_ITERATIONS = 300
# With fewer edges a product takes less time than waking another worker.
_WORTH_WORKERS = 50_000
Preconditioner = Callable[[Tensor], Tensor]


class Arrivals:
    """The sparsity patterns of W and Wᵀ: which nodes' edges arrive at a node, as given and reversed.

    Args:
        edges: of the graph, sorted.
    """

    def __init__(self, edges: SortedEdges) -> None:
        self.num_nodes = edges.num_nodes
        self._patterns = []
        for chosen in (~edges.is_reversed, edges.is_reversed):
            rows = chosen.nonzero().squeeze(1)
            first = torch.searchsorted(rows, edges.first.long(), out_int32=True)
            self._patterns.append((first, edges.source.index_select(0, rows), edges.edge.index_select(0, rows)))

    def matrices(self, weight: Tensor) -> list[Tensor]:
        """W and Wᵀ ``(N, N)`` of the edges' ``weight`` ``(M,)``."""
        size = (self.num_nodes, self.num_nodes)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
            return [
                torch.sparse_csr_tensor(first, source, weight.index_select(0, edge), size, check_invariants=False)
                for first, source, edge in self._patterns
            ]


class BlockLaplacian:
    """``L`` of a graph, in the weights' precision. Vectors have their components in rows, ``(3, N)``.

    Args:
        arrivals: the graph's.
        weight: ``(M,)`` positive.
        shape: what the ends say, S and T.
        component: ``(N,)``; each of the C components is solved by itself.

    Attributes:
        weight_sum: ``(N,)`` the weights of each node's edges, added up.
    """

    def __init__(self, arrivals: Arrivals, weight: Tensor, shape: NoiseShape, component: Tensor) -> None:
        self._matrices = arrivals.matrices(weight)
        self._threads = threads_on(weight.device) if len(weight) > _WORTH_WORKERS else 1
        self._components = _Components(component, int(component.max()) + 1)
        # (3, 3, N): what is said of an edge at the end that it comes from, and at the one where it arrives.
        at_source, at_target = (end.to(weight).contiguous() for end in (shape.at_source, shape.at_target))
        self._far, self._near = (at_source, at_target), (at_target, at_source)
        one = weight.new_ones(1, arrivals.num_nodes)
        self._diagonal = torch.zeros_like(at_source)
        self.weight_sum = weight.new_zeros(arrivals.num_nodes)
        for matrix, near, far in zip(self._matrices, self._near, self._far, strict=True):
            arriving = _arriving(matrix, torch.cat((far.flatten(0, 1), one)))
            self._diagonal += arriving[:9].view_as(far) + arriving[9] * near
            self.weight_sum += arriving[9]

    def product(self, x: Tensor) -> Tensor:
        """``L x`` ``(3, N)``."""
        parts = [x] * 2

        def one_way(number: int) -> None:
            arriving = _arriving(self._matrices[number], torch.cat((_apply(self._far[number], x), x)))
            parts[number] = _apply(self._near[number], arriving[3:]).add_(arriving[:3])

        for_each(one_way, (0, 1), self._threads)
        return _apply(self._diagonal, x).sub_(parts[0]).sub_(parts[1])

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
    ) -> tuple[Tensor, bool]:
        """``L⁻¹ force`` ``(3, N)``, up to a constant in every component, and whether it is as good as asked for.

        Args:
            force: sums to zero over every component.
            precondition: an approximate solution.
            tolerance: largest entry of the preconditioned residual, in the unknowns' unit.
            relative_tolerance: the same as a share of what it is at zero; the larger of the two counts.
        """
        stop = Stop(tolerance, relative_tolerance, _MAX_ITERATIONS)
        return conjugate_gradients(self.product, precondition, force, self._components, stop)


class _Components:
    """The components of a graph, each a system by itself; vectors are ``(3, N)``.

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


def factorised(graph: ViewGraph, weight: Tensor, shape: NoiseShape, roots: Tensor) -> Preconditioner:
    """A preconditioner for graphs that are not well knit: the same Laplacian with round weights, factorised."""
    at_source, at_target = (end.diagonal().sum(dim=1) for end in (shape.at_source, shape.at_target))
    trace = at_source[graph.source] + at_target[graph.target]
    ends = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    system = LaplacianSystem(graph.num_nodes, *ends, (weight * trace / 3).cpu().numpy(), roots.cpu().numpy())
    return lambda x: torch.from_numpy(system.solve(x.t().cpu().double().numpy())).t().to(x)


def _arriving(matrix: Tensor, rows: Tensor) -> Tensor:
    """``matrix @ rowsᵀ``, components in rows again, ``(k, N)``; sparse products want them side by side."""
    return (matrix @ rows.t().contiguous()).t().contiguous()


def _apply(matrices: Tensor, x: Tensor) -> Tensor:
    """Each of the matrices ``(3, 3, N)`` to its vector of ``(3, N)``."""
    return (matrices * x).sum(dim=1)
