"""ℓ1 rotation averaging by Weiszfeld's algorithm on SO(3) (Hartley, Aftab & Trumpf, CVPR 2011).

Every neighbour of a node predicts its orientation; the node moves towards their geodesic median by one Weiszfeld step,
the mean of the residual vectors in its tangent space, each divided by its own length. The paper visits the nodes one
after the other. Here all move at once, by half of their step: the edges' two ends share what separates them, which
keeps the sum of the residuals falling where full steps would swap two nodes for ever.

News travels one edge a sweep, so long chains with few closures (SLAM) are the method's weak side; dense graphs take
tens of sweeps, sparse ones hundreds.

Warm start: in place of the spanning tree's orientations.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.baselines.start import start_orientations, usable_edges
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.view_graph import ViewGraph

_MAX_SWEEPS = 2000
# The largest step of any node, in radians, that ends the sweeps.
_CONVERGED_STEP = 1e-4
# Residuals below this angle count as this: a node would never leave a prediction that it meets exactly, such as the
# spanning tree's that it started from.
_SMOOTHING = np.radians(1.0)


def weiszfeld(graph: ViewGraph, start: Tensor | None = None) -> Tensor:
    """Orientations of least summed angular residual, body_from_world ``(N, 4)`` float64.

    Noise-free graphs to rounding from a cold start.

    Args:
        start: body_from_world ``(N, 4)``; default: composed along a spanning tree.
    """
    graph = usable_edges(graph)
    body_from_world, _ = start_orientations(graph, start)
    incidence = _incidence(graph)
    ends = abs(incidence)
    for _ in range(_MAX_SWEEPS):
        residual = edge_residual(body_from_world, graph.target_from_source, graph.source, graph.target)
        vector = rotations.log(residual).numpy()
        weight = 1 / np.sqrt((vector**2).sum(axis=1, keepdims=True) + _SMOOTHING**2)
        # A node without an edge has neither pull nor weight.
        step = 0.5 * (incidence @ (weight * vector)) / np.maximum(ends @ weight, np.finfo(np.float64).tiny)
        body_from_world = rotations.multiply(body_from_world, rotations.exp(torch.from_numpy(step)))
        if np.linalg.norm(step, axis=1).max(initial=0.0) < _CONVERGED_STEP:
            break
    return rotations.normalize(body_from_world)


def _incidence(graph: ViewGraph) -> csr_array:
    """``(N, M)``: +1 where an edge ends, −1 where it starts."""
    edge = np.arange(graph.num_edges)
    nodes = np.concatenate((graph.target.numpy(), graph.source.numpy()))
    signs = np.repeat([1.0, -1.0], graph.num_edges)
    return csr_array((signs, (nodes, np.tile(edge, 2))), shape=(graph.num_nodes, graph.num_edges))
