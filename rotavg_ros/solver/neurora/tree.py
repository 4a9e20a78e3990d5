"""The bootstrap (NeuRoRA §4.2): orientations along a shortest-path tree that avoids outliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.medians import median_by_group
from rotavg_ros.solver.algebra.relaxed_forest import RelaxedForest, cheapest_forest, hubs
from rotavg_ros.solver.algebra.residuals import EdgeResiduals
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.spanning_forest import compose
from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.running.threads import for_each, threads_on
from rotavg_ros.view_graph import EdgeLabel

# Number of edges that decide which of two trees fits better.
_MISFIT_SAMPLE = 16_384
# With fewer edges, comparing takes less time than waking another worker.
_WORTH_WORKERS = 8_192


class Bootstrapped(NamedTuple):
    """FineNet's start.

    Attributes:
        body_from_world: ``(N, 4)`` float64.
        roots: ``(C,)`` the trees' roots, in the order of the components.
        parent, parent_edge: ``(N,)`` the trees: a root is its own parent, and its edge is -1.
        cleaned: without CleanNet's corrections where the uncorrected measurements were better.
    """

    body_from_world: Tensor
    roots: Tensor
    parent: Tensor
    parent_edge: Tensor
    cleaned: Cleaned


def bootstrap(cleaned: Cleaned, component: Tensor | None = None) -> Bootstrapped:
    """Orientations along a shortest-path tree that avoids outliers.

    A tree is composed of the rectified or of the original measurements, whichever fit the original ones better: where
    the noise is far below that of CleanNet's training, rectifying does harm.

    Args:
        component: ``(N,)`` the graph's connected components; default: computed.
    """
    component = cleaned.graph.components() if component is None else component
    degree = cleaned.edges.degree
    ends = cleaned.graph.source, cleaned.graph.target
    fewest = torch.minimum(*(degree.float().index_select(0, end) for end in ends))
    cost = NUMBERS.edge_cost + NUMBERS.outlier_cost * cleaned.outlier_probability + NUMBERS.fringe_cost / fewest
    parent, parent_edge, roots = _accepted_first(cleaned, cost, hubs(cleaned.edges, component), component)
    rectified, raw = (compose(parent, parent_edge, graph) for graph in (cleaned.graph, cleaned.measured))
    rectified_misfit, raw_misfit = _misfits(cleaned, (rectified, raw), component)
    raw_is_better = raw_misfit <= rectified_misfit
    if not bool(raw_is_better.any()):
        return Bootstrapped(rectified, roots, parent, parent_edge, cleaned)
    chosen = raw_is_better[component][:, None]
    relative = torch.where(
        chosen[cleaned.graph.source], cleaned.measured.target_from_source, cleaned.graph.target_from_source
    )
    cleaned = replace(cleaned, graph=replace(cleaned.graph, target_from_source=relative))
    return Bootstrapped(torch.where(chosen, raw, rectified), roots, parent, parent_edge, cleaned)


def breadth_first(cleaned: Cleaned, component: Tensor | None = None) -> Bootstrapped:
    """The paper's tree as its text has it: fewest inlier edges from the node that has most of them.

    An edge is an inlier if its outlier probability is below ε. Parts of a component that no inlier edge joins are
    joined by as few outliers as possible; the paper does not say how.

    Args:
        component: ``(N,)`` the graph's connected components; default: computed.
    """
    component = cleaned.graph.components() if component is None else component
    is_inlier = cleaned.is_inlier
    # No path is longer than this, so that one outlier costs more than any number of inliers.
    cost = torch.where(is_inlier, 1.0, float(cleaned.graph.num_nodes))
    roots = hubs(cleaned.edges.select(is_inlier), component)
    parent, parent_edge, roots = _accepted_first(cleaned, cost, roots, component)
    return Bootstrapped(compose(parent, parent_edge, cleaned.graph), roots, parent, parent_edge, cleaned)


def _accepted_first(cleaned: Cleaned, cost: Tensor, roots: Tensor, component: Tensor) -> RelaxedForest:
    """Shortest paths from the ``roots`` ``(C,)``; what accepted edges join is entered once, and left along these.

    The parts that accepted edges join have trees of their own. Shortest paths between the parts join these trees.
    """
    graph, edges = cleaned.measured, cleaned.edges
    accepted = (graph.label == EdgeLabel.ACCEPTED).nonzero()[:, 0]
    if len(accepted) == 0:
        return cheapest_forest(graph, edges, cost, roots, component)
    within = graph.select_edges(accepted)
    part, of_part = within.components(), SortedEdges.of(within)
    inner = cheapest_forest(within, of_part, cost[accepted], hubs(of_part, part), part)
    source, target = part[graph.source], part[graph.target]
    between = (source != target).nonzero()[:, 0]
    parts = replace(
        graph.select_edges(between), num_nodes=int(part.max()) + 1, source=source[between], target=target[between]
    )
    outer = cheapest_forest(parts, SortedEdges.of(parts), cost[between], part[roots], parts.components())
    joining = (accepted[inner.parent_edge[inner.parent_edge >= 0]], between[outer.parent_edge[outer.parent_edge >= 0]])
    chosen = torch.cat(joining)
    tree = graph.select_edges(chosen)
    parent, parent_edge, _ = cheapest_forest(tree, SortedEdges.of(tree), cost[chosen], roots, component)
    is_child = parent_edge >= 0
    parent_edge[is_child] = chosen[parent_edge[is_child]]
    return RelaxedForest(parent, parent_edge, roots)


def _misfits(cleaned: Cleaned, candidates: Sequence[Tensor], component: Tensor) -> list[Tensor]:
    """Median angle per component between the inliers as measured and as each of ``candidates`` predicts them."""
    sample = cleaned.is_inlier.nonzero().squeeze(1)
    sample = sample[:: 1 + len(sample) // _MISFIT_SAMPLE]
    edges = cleaned.measured.select_edges(sample)
    count, of_edge = int(component.max()) + 1, component[edges.source]
    misfits = [of_edge.new_empty(0, dtype=torch.float32) for _ in candidates]

    def compare(number: int) -> None:
        residual = EdgeResiduals(edges, candidates[number].float()).quaternions(slice(0, edges.num_edges))
        angle = 2 * torch.atan2((residual[:3] * residual[:3]).sum(dim=0).sqrt(), residual[3])
        misfits[number] = median_by_group(angle, of_edge, count)

    threads = threads_on(component.device) if edges.num_edges > _WORTH_WORKERS else 1
    for_each(compare, range(len(candidates)), threads)
    return misfits
