"""A start to which every edge contributes, rather than those of a tree.

Let A be the block matrix with R_vu at (v, u) and its transpose at (u, v) for each edge u→v, and D the nodes' degrees.
If all edges are exact, the eigenvectors of the three largest eigenvalues of D^(−1/2) A D^(−1/2) are D^(1/2) R (Singer
2011; Arie-Nachimson et al. 2012). False edges act as noise that averages out: where cameras are a few edges apart, as
in a random graph, eigenvectors tolerate more false edges than a tree does. Where cameras are many edges apart, the
eigenvalues are close, and other starts are better.

A fixed number of powers, begun at given orientations, does not converge to eigenvectors but is as good a start. The
result depends neither on the order of nodes and edges nor on the frame of any camera.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.view_graph import ViewGraph

_POWERS = 30
# Number of powers between orthonormalisations of the columns; these grow by a factor of 2³² at most in between.
_BETWEEN = 5
# Floor of squared lengths, numerical.
_LEAST = 1e-12


def spectral(graph: ViewGraph, body_from_world: Tensor, component: Tensor, weight: Tensor) -> Tensor:
    """Orientations ``(N, 4)`` float64 near the leading eigenvectors, for each component independently.

    Args:
        graph: N nodes, M edges.
        body_from_world: ``(N, 4)``, where the powers begin.
        component: ``(N,)`` component of every node.
        weight: ``(M,)`` weights of the edges.
    """
    count, nodes = int(component.max()) + 1, graph.num_nodes
    leaving, arriving = torch.cat((graph.source, graph.target)), torch.cat((graph.target, graph.source))
    degree = weight.new_zeros(nodes).index_add_(0, leaving, weight.repeat(2))
    scale = degree.clamp(min=_LEAST).rsqrt()
    # Matrix entries in rows, ``(3, 3, 1, 2 M)`` and ``(3, 3, N)``: summing columns by node is many times as fast.
    matrix = rotations.to_matrix(graph.target_from_source.double()).permute(1, 2, 0)
    matrix = torch.cat((matrix, matrix.transpose(0, 1)), dim=2)
    matrix = (matrix * (weight.repeat(2) * scale[leaving] * scale[arriving])).float()[:, :, None]
    block = rotations.to_matrix(body_from_world.double()).permute(1, 2, 0) * degree.sqrt()
    for _ in range(_POWERS // _BETWEEN):
        rows = block.float()
        for _ in range(_BETWEEN):
            # Eigenvalues lie between −1 and 1; after adding 1, the largest are also largest in magnitude.
            sent = (matrix * rows.flatten(0, 1).index_select(1, leaving).view(1, 3, 3, -1)).sum(dim=1)
            rows = rows.flatten(0, 1).index_add(1, arriving, sent.flatten(0, 1)).view(3, 3, nodes)
        block = _orthonormal(rows.double(), component, count)
    block = block.permute(2, 0, 1).contiguous()
    # The eigenvectors may describe a mirrored world.
    handed = block.new_zeros(count).index_add_(0, component, torch.linalg.det(block))
    block[:, :, 2] *= torch.where(handed < 0, -1.0, 1.0)[component, None]
    left, _, right = torch.linalg.svd(block)
    left[:, :, 2] *= torch.linalg.det(left @ right)[:, None]
    return rotations.from_matrix(left @ right)


def _orthonormal(block: Tensor, component: Tensor, count: int) -> Tensor:
    """The nearest blocks ``(3, 3, N)`` with orthonormal columns in each component, so that no axis is preferred."""
    products = (block[:, :, None] * block[:, None]).sum(dim=0)
    gram = block.new_zeros(9, count).index_add_(1, component, products.flatten(0, 1)).t().view(count, 3, 3)
    value, vector = torch.linalg.eigh(gram)
    root = (vector * value.clamp(min=_LEAST).rsqrt()[:, None]) @ vector.mT
    return torch.einsum("abn,nbc->acn", block, root[component])
