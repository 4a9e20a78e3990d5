"""Laplacian systems of large, well-knit view-graphs, by conjugate gradients (Hestenes & Stiefel 1952).

A factorisation of a graph whose nodes have dozens of random neighbours fills in completely. The spectrum of its
normalised Laplacian, though, lies close around one (Chung, Lu & Vu 2003), so that conjugate gradients with the degrees
as preconditioner need a few dozen products with a sparse matrix. All tensors are on the graph's device.
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from rotavg_ros.solver.abandonment import stop_if_abandoned
from rotavg_ros.solver.parallel import for_each, num_workers
from rotavg_ros.solver.sorted_edges import SortedEdges, Tile

# Preconditioned residuals are in the unknowns' unit (radians): below this no unknown would still move.
_TOLERANCE = 1e-10
MAX_ITERATIONS = 200


class NotConvergedError(ArithmeticError):
    """The iteration limit was reached: the graph is not well enough knit."""


class WeightedAdjacency:
    """The symmetric matrix of edge weights, ``(N, N)``, and its row sums; cut into stretches for the workers."""

    def __init__(self, edges: SortedEdges, weight: Tensor) -> None:
        """Take ``weight`` ``(M,)`` float64, of the graph's edges."""
        num_nodes = edges.num_nodes
        values = weight.index_select(0, edges.edge)
        threads = num_workers() if weight.device.type == "cpu" else 1
        stretches = edges.tiles(-(-max(len(values), 1) // threads))
        self._blocks = [(tile.nodes, _block(edges, values, tile)) for tile in stretches]
        ones = weight.new_ones(num_nodes, 1)
        self.degree = self.product(ones)

    def product(self, x: Tensor) -> Tensor:
        """``A x`` for ``(N, k)`` columns."""
        result = torch.empty_like(x)

        def multiply(block: tuple[slice, Tensor]) -> None:
            rows, matrix = block
            result[rows] = matrix @ x

        for_each(multiply, self._blocks)
        return result


def solve_laplacian(adjacency: WeightedAdjacency, right_hand_side: Tensor) -> Tensor:
    """Solve ``(D − A) x = b`` for ``(N, k)`` columns; each component's mean of ``x`` is whatever it happens to be.

    Args:
        right_hand_side: columns that sum to zero over every component, as forces between nodes do.

    Raises:
        NotConvergedError: not within :data:`MAX_ITERATIONS` iterations.
    """
    # A node without edges has degree zero, and nothing to do.
    inverse_degree = torch.where(adjacency.degree > 0, 1 / adjacency.degree, 0.0)
    solution = torch.zeros_like(right_hand_side)
    residual = right_hand_side.clone()
    scaled = residual * inverse_degree
    direction = scaled.clone()
    energy = (residual * scaled).sum(dim=0)
    for _ in range(MAX_ITERATIONS):
        stop_if_abandoned()
        if float(scaled.abs().amax()) < _TOLERANCE:
            return solution
        image = adjacency.degree * direction - adjacency.product(direction)
        # A column that is solved to the last bit has nothing left to divide.
        curvature = (direction * image).sum(dim=0)
        length = torch.where(curvature > 0, energy / curvature, 0.0)
        solution += length * direction
        residual -= length * image
        scaled = residual * inverse_degree
        previous, energy = energy, (residual * scaled).sum(dim=0)
        direction = scaled + torch.where(previous > 0, energy / previous, 0.0) * direction
    raise NotConvergedError(f"conjugate gradients did not converge in {MAX_ITERATIONS} iterations")


def _block(edges: SortedEdges, values: Tensor, tile: Tile) -> Tensor:
    """Rows of the matrix, sparse."""
    first = edges.first[tile.nodes.start : tile.nodes.stop + 1] - tile.edges.start
    size = (tile.nodes.stop - tile.nodes.start, edges.num_nodes)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(
            first, edges.source[tile.edges], values[tile.edges], size, check_invariants=False
        )
