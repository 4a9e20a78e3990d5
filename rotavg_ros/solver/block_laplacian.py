"""Laplacian systems whose weights are 3 × 3 matrices, by conjugate gradients.

The weight of an edge u→v is ``w (S_u + T_v)``: a number of the edge times the sum of what its two ends say. So no
matrix of an edge is ever formed, and a product with the whole takes two products with sparse matrices of numbers, W
over the edges as they run and Wᵀ:

    (L x)_v = D_v x_v − (W S x)_v − T_v (W x)_v − (Wᵀ T x)_v − S_v (Wᵀ x)_v
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from rotavg_ros.solver.laplacian import LaplacianSystem
from rotavg_ros.solver.noise_shape import NoiseShape
from rotavg_ros.solver.parallel import for_each
from rotavg_ros.solver.sorted_edges import SortedEdges
from rotavg_ros.view_graph import ViewGraph

_MAX_ITERATIONS = 300
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
            before = torch.cat((chosen.new_zeros(1, dtype=torch.int32), chosen.cumsum(0, dtype=torch.int32)))
            self._patterns.append((before[edges.first], edges.source[chosen], edges.edge[chosen]))

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
    """``L`` of a graph.

    Args:
        arrivals: the graph's.
        weight: ``(M,)`` float64, positive.
        shape: what the ends say, S and T.
        component: ``(N,)``; each of the C components is solved by itself.
    """

    def __init__(self, arrivals: Arrivals, weight: Tensor, shape: NoiseShape, component: Tensor) -> None:
        self._matrices = arrivals.matrices(weight)
        self._near = (shape.at_target, shape.at_source)
        self._far = (shape.at_source, shape.at_target)
        self._component = component
        self._num_components = int(component.max()) + 1
        degree = weight.new_ones(arrivals.num_nodes, 1)
        self._diagonal = torch.zeros_like(shape.at_source)
        for matrix, near, far in zip(self._matrices, self._near, self._far, strict=True):
            self._diagonal += (matrix @ far.flatten(1)).view_as(far) + (matrix @ degree)[:, :, None] * near

    def product(self, x: Tensor) -> Tensor:
        """``L x`` ``(N, 3)``."""
        parts = [x] * 2

        def one_way(number: int) -> None:
            far, near = self._far[number], self._near[number]
            arriving = self._matrices[number] @ torch.cat((_apply(far, x), x), dim=1)
            parts[number] = arriving[:, :3] + _apply(near, arriving[:, 3:])

        for_each(one_way, (0, 1))
        return _apply(self._diagonal, x) - parts[0] - parts[1]

    def diagonal_solve(self) -> Preconditioner:
        """A preconditioner for well-knit graphs: what solves by the blocks on the diagonal alone."""
        isolated = self._diagonal.diagonal(dim1=1, dim2=2).sum(dim=1) <= 0
        inverse = torch.linalg.inv(self._diagonal + isolated[:, None, None] * torch.eye(3).to(self._diagonal))
        return lambda x: _apply(inverse, x)

    def solve(
        self, force: Tensor, precondition: Preconditioner, tolerance: float, relative_tolerance: float
    ) -> tuple[Tensor, bool]:
        """``L⁻¹ force`` ``(N, 3)``, up to a constant in every component, and whether it is as good as asked for.

        Args:
            force: sums to zero over every component.
            precondition: an approximate solution.
            tolerance: largest entry of the preconditioned residual, in the unknowns' unit.
            relative_tolerance: the same as a share of what it is at zero; the larger of the two counts.
        """
        solution, residual = torch.zeros_like(force), force.clone()
        scaled = precondition(residual)
        direction, energy = scaled.clone(), self._dot(residual, scaled)
        goal = (relative_tolerance * self._largest(scaled)).clamp(min=tolerance)
        for _ in range(_MAX_ITERATIONS):
            is_open = self._largest(scaled) > goal
            if not bool(is_open.any()):
                return solution, True
            image = self.product(direction)
            curvature = self._dot(direction, image)
            length = torch.where(is_open & (curvature > 0), energy / curvature, 0.0)[self._component, None]
            solution += length * direction
            residual -= length * image
            scaled = precondition(residual)
            previous, energy = energy, self._dot(residual, scaled)
            ratio = torch.where(previous > 0, energy / previous, 0.0)
            direction = scaled + ratio[self._component, None] * direction
        return solution, False

    def _dot(self, a: Tensor, b: Tensor) -> Tensor:
        """Inner products ``(C,)`` by component."""
        return a.new_zeros(self._num_components).index_add_(0, self._component, (a * b).sum(dim=1))

    def _largest(self, x: Tensor) -> Tensor:
        """Largest absolute entries ``(C,)`` by component."""
        return x.new_zeros(self._num_components).scatter_reduce(0, self._component, x.abs().amax(dim=1), "amax")


def factorised(graph: ViewGraph, weight: Tensor, shape: NoiseShape, roots: Tensor) -> Preconditioner:
    """A preconditioner for graphs that are not well knit: the same Laplacian with round weights, factorised."""
    trace = (shape.at_source[graph.source] + shape.at_target[graph.target]).diagonal(dim1=1, dim2=2).sum(dim=1)
    ends = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    system = LaplacianSystem(graph.num_nodes, *ends, (weight * trace / 3).cpu().numpy(), roots.cpu().numpy())
    return lambda x: torch.from_numpy(system.solve(x.cpu().numpy())).to(x)


def _apply(matrices: Tensor, x: Tensor) -> Tensor:
    """Each of ``(N, 3, 3)`` to its vector of ``(N, 3)``."""
    return (matrices * x[:, None, :]).sum(dim=2)
