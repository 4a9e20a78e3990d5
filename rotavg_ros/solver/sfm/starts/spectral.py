"""A start in which every edge has a say, and no tree decides.

Of the block matrix A, in which the edge u→v has R_vu at (v, u) and its transpose at (u, v), and D, the nodes' degrees,
the eigenvectors of D^(−1/2) A D^(−1/2) of the three largest eigenvalues are D^(1/2) R where all edges are exact (Singer
2011; Arie-Nachimson et al. 2012). False edges are noise to them that averages out: where cameras of a graph are a few
edges apart, as in a random one, they bear more false edges than a tree does. Where they are far apart, eigenvalues are
close, and other starts are better.

A fixed number of powers, begun at some orientations, is no converged eigenvector but as good a start. Neither the
order of nodes and edges matters nor the frame of any camera.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.view_graph import ViewGraph

_POWERS = 30
# Columns are made orthonormal after so many; until then they grow by a factor of 2³² at most.
_BETWEEN = 5
# Squared lengths are at least this, numerical.
_LEAST = 1e-12


def spectral(graph: ViewGraph, body_from_world: Tensor, component: Tensor, weight: Tensor) -> Tensor:
    """Orientations ``(N, 4)`` float64 near the leading eigenvectors, of each component by itself.

    Args:
        graph: N nodes, M edges.
        body_from_world: ``(N, 4)``, where powers begin.
        component: ``(N,)`` of every node.
        weight: ``(M,)`` of the edges.
    """
    source, target, count = graph.source, graph.target, int(component.max()) + 1
    degree = weight.new_zeros(graph.num_nodes).index_add_(0, source, weight).index_add_(0, target, weight)
    scale = degree.clamp(min=_LEAST).rsqrt()
    forward = rotations.to_matrix(graph.target_from_source.double())
    forward = (forward * (weight * scale[source] * scale[target])[:, None, None]).float()
    backward = forward.mT.contiguous()
    block = rotations.to_matrix(body_from_world.double()) * degree.sqrt()[:, None, None]
    for _ in range(_POWERS // _BETWEEN):
        block = block.float()
        for _ in range(_BETWEEN):
            # Eigenvalues lie between −1 and 1; with 1 added the largest ones are largest by amount, too.
            arriving = block.clone().index_add_(0, target, forward @ block[source])
            block = arriving.index_add_(0, source, backward @ block[target])
        block = _orthonormal(block.double(), component, count)
    # Eigenvectors may be those of a mirrored world.
    handed = block.new_zeros(count).index_add_(0, component, torch.linalg.det(block))
    block[:, :, 2] *= torch.where(handed < 0, -1.0, 1.0)[component, None]
    left, _, right = torch.linalg.svd(block)
    left[:, :, 2] *= torch.linalg.det(left @ right)[:, None]
    return rotations.from_matrix(left @ right)


def _orthonormal(block: Tensor, component: Tensor, count: int) -> Tensor:
    """Blocks ``(N, 3, 3)`` whose columns, of each component, are orthonormal: the nearest ones, so no axis is first."""
    gram = block.new_zeros(count, 3, 3).index_add_(0, component, block.mT @ block)
    value, vector = torch.linalg.eigh(gram)
    root = (vector * value.clamp(min=_LEAST).rsqrt()[:, None]) @ vector.mT
    orthonormal: Tensor = block @ root[component]
    return orthonormal
