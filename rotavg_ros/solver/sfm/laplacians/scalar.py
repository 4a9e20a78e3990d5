"""The Laplacian of a well-knit graph with a scalar weight per edge, solved without a factorisation."""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.sparse.conjugate_gradients import Stop, conjugate_gradients
from rotavg_ros.solver.sfm.laplacians.block import MAX_ITERATIONS, Arrivals, Components, arriving

# Share of the first residual at which iterations end. What two parts differ by that only rejected edges join leaves a
# residual of about their weight over that of all edges, so it has to be far smaller than that.
_SOLVED = 1e-10


class ScalarLaplacian:
    """``L`` of a graph of N nodes and M edges.

    Args:
        edges: the graph's, sorted.
        weight: ``(M,)`` positive.
        component: ``(N,)``; each is solved by itself.
    """

    def __init__(self, edges: SortedEdges, weight: Tensor, component: Tensor) -> None:
        self._components = Components(component, int(component.max()) + 1)
        self._adjacency = Arrivals(edges).symmetric(weight)
        self._degree = arriving(self._adjacency, weight.new_ones(1, edges.num_nodes))[0]

    def solve(self, force: Tensor) -> tuple[Tensor, bool]:
        """``L⁻¹ force`` ``(k, N)``, up to a constant in every component, and whether the iterations converged.

        Args:
            force: ``(k, N)``; each row sums to zero over every component.
        """
        # An isolated node has no force.
        degree = torch.where(self._degree > 0, self._degree, 1.0)
        stop = Stop(0.0, _SOLVED, MAX_ITERATIONS)
        solution, is_solved = conjugate_gradients(self._product, lambda x: x / degree, force, self._components, stop)
        return solution, is_solved is None or bool(is_solved.all())

    def _product(self, x: Tensor) -> Tensor:
        return self._degree * x - arriving(self._adjacency, x)
