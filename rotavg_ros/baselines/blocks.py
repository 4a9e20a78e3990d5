"""Symmetric block matrices of a view-graph: block (v, u) is the relative rotation ``R_v R_uᵀ`` of an edge u→v."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import bsr_array
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.errors import UserError
from rotavg_ros.view_graph import ViewGraph

# An iteration holds about a dozen arrays of 72 bytes per block: 4 GB at this many.
MAX_BLOCKS = 4_000_000


@dataclass(frozen=True)
class BlockPattern:
    """Which 3 × 3 blocks of a symmetric ``3N × 3N`` matrix are known: those of the M edges, then the N diagonal ones.

    Attributes:
        num_nodes, num_edges: N, M.
        row, column: ``(M + N,)`` node numbers of the blocks; an edge's are its target and its source.
        share: ``(M + N,)`` one over the number of edges that join the same two nodes, so that parallel edges count as
            their mean; 1 on the diagonal.
    """

    num_nodes: int
    num_edges: int
    row: np.ndarray
    column: np.ndarray
    share: np.ndarray
    # Order of the M blocks, their M mirror images and the diagonal, row by row; and where rows start.
    _order: np.ndarray
    _row_starts: np.ndarray
    _columns: np.ndarray

    @classmethod
    def of(cls, graph: ViewGraph) -> BlockPattern:
        """The pattern of a graph.

        Raises:
            UserError: more blocks than :data:`MAX_BLOCKS`.
        """
        n, m = graph.num_nodes, graph.num_edges
        if n + m > MAX_BLOCKS:
            raise UserError(
                f"{n} nodes and {m} edges are too many for arrigoni and wang, which hold {MAX_BLOCKS} blocks at most; "
                "use chatterjee, weiszfeld or neurora"
            )
        source, target, diagonal = graph.source.numpy(), graph.target.numpy(), np.arange(n)
        pair = np.minimum(source, target) * n + np.maximum(source, target)
        _, inverse, count = np.unique(pair, return_inverse=True, return_counts=True)
        rows, columns = np.concatenate((target, source, diagonal)), np.concatenate((source, target, diagonal))
        order = np.lexsort((columns, rows))
        return cls(
            n,
            m,
            row=np.concatenate((target, diagonal)),
            column=np.concatenate((source, diagonal)),
            share=np.concatenate((1 / count[inverse], np.ones(n))),
            _order=order,
            _row_starts=np.concatenate(([0], np.cumsum(np.bincount(rows, minlength=n)))),
            _columns=columns[order],
        )

    def known_blocks(self, graph: ViewGraph) -> np.ndarray:
        """The measured relative rotations and identities, ``(M + N, 3, 3)``."""
        measured = rotations.to_matrix(graph.target_from_source).numpy()
        return np.concatenate((measured, np.broadcast_to(np.eye(3), (self.num_nodes, 3, 3))))

    def product_blocks(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """The pattern's blocks of ``left rightᵀ``, ``(M + N, 3, 3)``, from factors ``(3N, k)``."""
        left, right = (factor.reshape(self.num_nodes, 3, -1) for factor in (left, right))
        return np.asarray(left[self.row] @ right[self.column].transpose(0, 2, 1))

    def matrix(self, blocks: np.ndarray) -> bsr_array:
        """The symmetric sparse matrix of these ``(M + N, 3, 3)`` blocks; the mean of parallel ones."""
        shared = blocks * self.share[:, None, None]
        edges, diagonal = shared[: self.num_edges], shared[self.num_edges :]
        data = np.concatenate((edges, edges.transpose(0, 2, 1), diagonal))[self._order]
        size = 3 * self.num_nodes
        return bsr_array((data, self._columns, self._row_starts), shape=(size, size))


def nearest_rotations(blocks: np.ndarray) -> Tensor:
    """Quaternions ``(N, 4)`` of the rotations closest to blocks ``(N, 3, 3)`` known up to one orthogonal factor.

    Orthogonal factors come with either sign of the determinant; the one that suits most blocks is taken.
    """
    if np.sign(np.linalg.det(blocks)).sum() < 0:
        blocks = -blocks
    left, _, right = np.linalg.svd(blocks)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return rotations.from_matrix(torch.from_numpy(left @ right))
