"""Edges that the user has rejected: a graph is solved without them, and they only give its parts a common frame.

A rejected edge says nothing of orientations, of noise, or of other edges. But parts that only rejected edges join are
of one component of the given graph, so they need one frame: each is turned as a whole so that the rejected edges of a
tree of parts fit. How far such a part is really turned is not known, and its variance says so.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.canonical_form import CanonicalForm
from rotavg_ros.solver.algebra.spanning_forest import compose_orientations, shortest_path_forest
from rotavg_ros.solver.estimate import Estimate
from rotavg_ros.view_graph import ViewGraph


def in_one_frame(graph: ViewGraph, component: Tensor, part: Tensor, estimate: Estimate, is_refined: bool) -> Estimate:
    """An estimate in which each part has a frame of its own → one in which each component has.

    Args:
        graph: N nodes, with the rejected edges.
        component, part: ``(N,)`` the components of all edges, and of those that are not rejected.
        estimate: its variances are relative to the first node of each part.
        is_refined: whether the method states variances.
    """
    orientations, variance = estimate.body_from_world, estimate.variance
    turn = _turns(graph, part, orientations).to(orientations)
    if is_refined:
        # Components and parts are numbered by their first nodes; a component's first node is that of its first part.
        first = torch.full_like(part, len(part)).scatter_reduce(0, component, part, "amin")
        is_first, is_alone = part == first[component], torch.bincount(part)[part] == 1
        variance = (
            variance.to(orientations).masked_fill(is_alone, 0.0).masked_fill(~is_first, rotations.RANDOM_VARIANCE)
        )
    return replace(estimate, body_from_world=rotations.multiply(orientations, turn[part]), variance=variance)


def _turns(graph: ViewGraph, part: Tensor, body_from_world: Tensor) -> Tensor:
    """How each part's world is turned, ``(P, 4)``, so that the rejected edges of a tree of the parts fit."""
    source, target = part[graph.source], part[graph.target]
    between = (source != target).nonzero()[:, 0]
    # With W the turns, R̃ = R_v W_v (R_u W_u)⁻¹ is the same as W_v W_u⁻¹ = R_v⁻¹ R̃ R_u.
    stated = rotations.multiply(
        rotations.inverse(body_from_world[graph.target[between]]),
        rotations.multiply(graph.target_from_source[between], body_from_world[graph.source[between]]),
    )
    ends = source[between].cpu(), target[between].cpu()
    parts = ViewGraph.create(*ends, stated.cpu(), num_nodes=int(part.max()) + 1)
    # Which edges the tree has must not depend on the order in which they were given.
    form = CanonicalForm.of(parts, own_axes=False)
    return form.orientations(compose_orientations(shortest_path_forest(form.graph), form.graph))
