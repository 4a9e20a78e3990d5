"""Robust Gauss–Newton refinement of an SfM view-graph: ℓ½ iteratively reweighted least squares on the tangent space.

After Chatterjee & Govindu (2018), started from a good initialisation and weighted by CleanNet's scores. The residual of
an edge is a rotation of the world frame, so its three components share one Laplacian. Well-knit graphs are solved by
conjugate gradients, the others by factorisation (see ``conjugate_gradients.py`` and ``laplacian.py``).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.conjugate_gradients import NotConvergedError, WeightedAdjacency, solve_laplacian
from rotavg_ros.solver.algebra.laplacian import LaplacianSystem
from rotavg_ros.solver.algebra.residuals import SLICE_EDGES, EdgeResiduals
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.threads import for_each, slices, stretches
from rotavg_ros.view_graph import ViewGraph

DEFAULT_STEPS = 3
# |r|^(−3/2) is the weight of ρ = |r|^½; residuals below this angle count as this.
_SMOOTHING = np.radians(0.5)
_CONVERGED_STEP = np.radians(0.001)
_MIN_PRIOR = 1e-6
# A graph with fewer neighbours than this has separators, which a sparse factorisation finds.
_WELL_KNIT_DEGREE = 12
# Measured on one core, in seconds. Conjugate gradients: so many iterations of a fixed cost and one per edge. A complete
# factorisation: the cube of the nodes, and what it costs to lay an edge into the matrix.
_ITERATIONS, _PER_ITERATION, _PER_ITERATION_AND_EDGE = 20, 1e-4, 3e-9
_PER_CUBED_NODE, _PER_FACTORISED_EDGE = 5e-11, 1e-7


def refine(
    graph: ViewGraph,
    body_from_world: Tensor,
    prior_weight: Tensor | None,
    roots: np.ndarray | Tensor,
    num_steps: int,
    *,
    component: Tensor | None = None,
    edges: SortedEdges | None = None,
) -> Tensor:
    """At most ``num_steps`` reweighted least-squares steps.

    Args:
        body_from_world: ``(N, 4)`` start.
        prior_weight: ``(M,)`` in [0, 1], multiplied to every robust weight; default 1.
        roots: a node of each connected component, in the components' order; they are held fixed.
        component: ``(N,)`` connected components; default: computed.
        edges: the graph's edges sorted; default: computed.

    Returns:
        ``(N, 4)`` float64 orientations.
    """
    edges = SortedEdges.of(graph) if edges is None else edges
    component = graph.components() if component is None else component
    root = torch.as_tensor(roots, device=graph.device)[component]
    prior = torch.ones_like(graph.precision) if prior_weight is None else prior_weight.double().clamp(min=_MIN_PRIOR)
    by_iteration = graph.device.type != "cpu" or _iterating_is_cheaper(graph)
    orientations = body_from_world.double()
    for _ in range(num_steps):
        weight, force = _weights_and_forces(graph, orientations, prior)
        if by_iteration:
            try:
                step = solve_laplacian(WeightedAdjacency(edges, weight), force)
            except NotConvergedError:
                by_iteration = False
        if not by_iteration:
            step = _factorise_and_solve(graph, weight, force, root)
        step = step - step[root]
        orientations = rotations.normalize(rotations.multiply(orientations, rotations.exp(step)))
        if float(step.abs().amax()) < _CONVERGED_STEP:
            break
    return orientations


def _iterating_is_cheaper(graph: ViewGraph) -> bool:
    """Whether conjugate gradients beat a factorisation, which fills in where every node has many neighbours."""
    if 2 * graph.num_edges < _WELL_KNIT_DEGREE * graph.num_nodes:
        return False
    iterating = _ITERATIONS * (_PER_ITERATION + _PER_ITERATION_AND_EDGE * graph.num_edges)
    return iterating < _PER_CUBED_NODE * graph.num_nodes**3 + _PER_FACTORISED_EDGE * graph.num_edges


def _weights_and_forces(graph: ViewGraph, orientations: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Every edge's robust weight ``(M,)``, and the sum of weighted residuals that pull at each node ``(N, 3)``."""
    residuals = EdgeResiduals(graph, orientations)
    weight = torch.empty_like(prior)
    parts = stretches(slices(graph.num_edges, SLICE_EDGES, graph.device))
    forces = [orientations.new_zeros(3, graph.num_nodes) for _ in parts]

    def walk(part: int) -> None:
        for edges in parts[part]:
            vector = residuals.vectors(edges)
            weight[edges] = prior[edges] * ((vector * vector).sum(dim=0) + _SMOOTHING**2) ** -0.75
            pull = vector * weight[edges]
            forces[part].index_add_(1, graph.target[edges], pull)
            forces[part].index_add_(1, graph.source[edges], pull.neg_())

    for_each(walk, range(len(parts)))
    return weight, torch.stack(forces).sum(dim=0).t().contiguous()


def _factorise_and_solve(graph: ViewGraph, weight: Tensor, force: Tensor, root: Tensor) -> Tensor:
    """The same step ``(N, 3)`` by a factorisation on the CPU."""
    roots = np.unique(root.cpu().numpy())
    ends = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    system = LaplacianSystem(graph.num_nodes, *ends, weight.cpu().numpy(), roots)
    return torch.from_numpy(system.solve(force.cpu().numpy())).to(force.device)
