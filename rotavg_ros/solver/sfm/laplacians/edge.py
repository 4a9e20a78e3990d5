"""Laplacian systems in which every edge has a 3 × 3 weight of its own.

Edges that state about which axes they are exact have such weights W, and no matrices of their ends stand for them as
in :mod:`rotavg_ros.solver.sfm.laplacians.block`. A product takes six products with sparse matrices of scalars, one for
each entry of W:

    (L x)_v = D_v x_v − Σ_u W_uv x_u,     D_v = Σ_u W_uv
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.sfm.laplacians.block import Arrivals, Laplacian, arriving
from rotavg_ros.solver.sfm.symmetric_rows import ENTRIES, full


class MatrixWeights(NamedTuple):
    """Matrix weights of M edges.

    Attributes:
        matrix: ``(6, M)`` entries of W.
        total: ``(M,)`` the scalar weights in them.
    """

    matrix: Tensor
    total: Tensor


class EdgeLaplacian(Laplacian):
    """``L`` of a graph, in the weights' precision. Vectors have their components in rows, ``(3, N)``.

    Args:
        arrivals: the graph's.
        weights: of the edges.
        component: ``(N,)``; each of the C components is solved by itself.
    """

    def __init__(self, arrivals: Arrivals, weights: MatrixWeights, component: Tensor) -> None:
        *self._entries, total = (arrivals.symmetric(values) for values in (*weights.matrix, weights.total))
        one = weights.total.new_ones(1, arrivals.num_nodes)
        diagonal = full(torch.cat([arriving(entry, one) for entry in self._entries]))
        super().__init__(diagonal, arriving(total, one)[0], component)

    def product(self, x: Tensor) -> Tensor:
        """``L x`` ``(3, N)``."""
        result = self.at_nodes(x)
        for (row, column), entry in zip(ENTRIES, self._entries, strict=True):
            if row == column:
                result[row] -= arriving(entry, x[row : row + 1])[0]
            else:
                seen = arriving(entry, x[[column, row]])
                result[row] -= seen[0]
                result[column] -= seen[1]
        return result
