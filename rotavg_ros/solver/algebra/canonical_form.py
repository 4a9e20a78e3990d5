"""One form for all descriptions of the same view-graph.

Names of the nodes, order and direction of the edges, copies of an edge and the choice of the cameras' axes say nothing
about the orientations. Here they are chosen anew, by what was measured alone:

- Of edges that state the same rotation between the same nodes, one is kept.
- Nodes are sorted by a weighted number of walks, k_v = Σ_u (½ + w_uv) k_u, a few times over, begun with k = 1. w_uv is
  the cosine of half an edge's angle, which none of those choices changes.
- Edges run from the earlier node to the later one and are sorted by both.
- Cameras' axes: those of the second moment Σ s sᵀ of all edges, where s is x, y, z of an edge's quaternion. Turning the
  cameras' axes by A, R̃_uv → A R̃_uv A⁻¹, turns every s by A, and the moment's axes with them. y has the largest moment,
  z the least. An axis points to where Σ_v |b_v|² b_v does, b_v = Σ_u s_uv over the edges that arrive at v; this is odd
  in s, but the same whichever way an edge was stated.

Where the data are the same for several nodes or axes, any of them is taken, since then it makes no difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.medians import median_by_group
from rotavg_ros.solver.algebra.sorted_edges import sorted_by_node
from rotavg_ros.view_graph import ViewGraph

# So often walks grow by an edge: enough to tell apart what only distant edges tell apart, little beside a solve.
_WALK_LENGTH = 4
# Quaternions are the same if no entry differs by more: far below any measurement, far above rounding.
_SAME = 1e-9


@dataclass(frozen=True)
class CanonicalForm:
    """A view-graph of N nodes, M edges and C components in canonical form, and how to get back.

    Attributes:
        graph: in canonical form, with K ≤ M edges, without translations.
        component: ``(N,)`` of its nodes.
        node: ``(N,)`` which of the given graph's nodes each is.
        edge: ``(M,)`` which of its edges stands for each of the given graph's.
        canonical_from_body: ``(C, 4)`` the canonical axes of each component's cameras.
    """

    graph: ViewGraph
    component: Tensor
    node: Tensor
    edge: Tensor
    canonical_from_body: Tensor

    @classmethod
    def of(cls, graph: ViewGraph, component: Tensor | None = None) -> CanonicalForm:
        """Of a graph; ``component`` ``(N,)`` as it numbers its own, default: computed."""
        component = graph.components() if component is None else component
        kept, copy_of = _without_copies(graph)
        once = replace(graph if kept is None else graph.select_edges(kept), translation=None)
        node = _nodes_in_order(once, component)
        rank = torch.empty_like(node)
        rank[node] = torch.arange(len(node), device=node.device)
        source, target = rank[once.source], rank[once.target]
        low, high = torch.minimum(source, target), torch.maximum(source, target)
        order = _by_both_ends(low, high, graph.num_nodes)
        if bool(_is_parallel(low, high, order).any()):  # rotations between the same nodes by their angles
            by_angle = once.target_from_source[:, 3].argsort(stable=True)
            order = by_angle[_by_both_ends(low[by_angle], high[by_angle], graph.num_nodes)]
        once, low, high = once.select_edges(order), low[order], high[order]
        axes = _axes(once, component)
        vector = _turned(axes, once.target_from_source[:, :3], component[once.source])
        vector = torch.where((source <= target)[order, None], vector, -vector)
        quaternion = torch.cat((vector, once.target_from_source[:, 3:]), dim=1)
        canonical = replace(once, source=low, target=high, target_from_source=quaternion)
        place = torch.empty_like(order)
        place[order] = torch.arange(len(order), device=order.device)
        edge = place if copy_of is None else place[copy_of]
        return cls(canonical, component[node], node, edge, rotations.from_matrix(axes))

    def orientations(self, body_from_world: Tensor) -> Tensor:
        """Those of the canonical graph → those of the given one, ``(N, 4)``."""
        axes = rotations.inverse(self.canonical_from_body)[self.component]
        given = torch.empty_like(body_from_world)
        given[self.node] = rotations.multiply(axes.to(body_from_world), body_from_world)
        return given

    def canonical_orientations(self, body_from_world: Tensor) -> Tensor:
        """The other way round, ``(N, 4)``."""
        axes = self.canonical_from_body[self.component].to(body_from_world)
        return rotations.canonical(rotations.multiply(axes, body_from_world[self.node]))


def _without_copies(graph: ViewGraph) -> tuple[Tensor | None, Tensor | None]:
    """Indices ``(K,)`` of the edges without copies, and ``(M,)`` which of these stands for each; None: all differ."""
    low, high = torch.minimum(graph.source, graph.target), torch.maximum(graph.source, graph.target)
    order = _by_both_ends(low, high, graph.num_nodes)
    again = _is_parallel(low, high, order)
    if not bool(again.any()):
        return None, None
    # Only pairs of nodes with several edges are looked at closely.
    no = again.new_zeros(1)
    close = order[torch.cat((again, no)) | torch.cat((no, again))]
    stated = graph.target_from_source[close]
    forward = torch.where((graph.source < graph.target)[close, None], stated, rotations.inverse(stated))
    number = (forward / _SAME).round().long()
    # Half turns have two quaternions.
    leading = number[:, :3].sign() * torch.tensor([4, 2, 1], device=number.device)
    number = torch.where(((number[:, 3] == 0) & (leading.sum(dim=1) < 0))[:, None], -number, number)
    content = torch.cat(((low * graph.num_nodes + high)[close, None], number, graph.label[close, None]), dim=1)
    _, group = torch.unique(content, dim=0, return_inverse=True)
    first = torch.full((int(group.max()) + 1,), graph.num_edges, device=group.device)
    first = first.scatter_reduce(0, group, close, "amin")
    stands_for = torch.arange(graph.num_edges, device=close.device)
    stands_for[close] = first[group]
    is_kept = stands_for == torch.arange(graph.num_edges, device=close.device)
    place = is_kept.cumsum(0) - 1
    return is_kept.nonzero().squeeze(1), place[stands_for]


def _is_parallel(low: Tensor, high: Tensor, order: Tensor) -> Tensor:
    """``(M - 1,)`` whether an edge has the ends of the one before it, in an order by both ends."""
    low, high = low[order], high[order]
    return (low[1:] == low[:-1]) & (high[1:] == high[:-1])


def _by_both_ends(low: Tensor, high: Tensor, num_nodes: int) -> Tensor:
    """The order of edges by ``low`` and then by ``high``, ``(M,)``."""
    _, by_high = sorted_by_node(high.int(), num_nodes)
    _, by_low = sorted_by_node(low.int()[by_high.long()], num_nodes)
    return by_high.long()[by_low.long()]


def _nodes_in_order(graph: ViewGraph, component: Tensor) -> Tensor:
    """The nodes ``(N,)`` in canonical order, component by component."""
    weight = 0.5 + graph.target_from_source[:, 3]
    walks = torch.ones(graph.num_nodes, dtype=weight.dtype, device=weight.device)
    for _ in range(_WALK_LENGTH):
        walks = _collected(graph, weight * walks[graph.source], weight * walks[graph.target])
    by_walks = walks.argsort(stable=True)
    return by_walks[component[by_walks].argsort(stable=True)]


def _collected(graph: ViewGraph, at_target: Tensor, at_source: Tensor) -> Tensor:
    """Sums ``(N,)`` of what edges ``(M,)`` bring to their ends."""
    ends = ((graph.target, at_target), (graph.source, at_source))
    into, out_of = (torch.bincount(end, weight, minlength=graph.num_nodes) for end, weight in ends)
    return into + out_of


def _axes(graph: ViewGraph, component: Tensor) -> Tensor:
    """Canonical axes ``(C, 3, 3)``, in rows, of the cameras of each component."""
    count = int(component.max()) + 1 if len(component) else 0
    rows, of_edge = graph.target_from_source.t().contiguous(), component[graph.source]
    _, axes = torch.linalg.eigh(_moments(rows[:3], of_edge, count))
    main = axes[:, :, 2]
    off_main = torch.eye(3, dtype=main.dtype, device=main.device) - main[:, :, None] * main[:, None]
    # The main axis has no swing; it is kept apart from the others by a moment below zero.
    swings = _moments(_swings(main, rows, of_edge), of_edge.repeat(2), count)
    _, axes = torch.linalg.eigh(
        off_main @ swings @ off_main
        - swings.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None] * main[:, :, None] * main[:, None]
    )
    arriving = torch.stack([_collected(graph, row, -row) for row in rows[:3]])
    skew = _sums((arriving * arriving).sum(dim=0) * arriving, component, count)
    x, y = (_towards(axis, skew) for axis in (axes[:, :, 2], main))
    return torch.stack((x, y, torch.linalg.cross(x, y)), dim=1)


def _moments(rows: Tensor, group: Tensor, count: int) -> Tensor:
    """Robust second moments ``(G, 3, 3)`` of the columns of ``(3, M)`` by group ``(M,)``, up to their scale."""
    square = (rows * rows).sum(dim=0)
    typical = square.median()[None] if count == 1 else median_by_group(square, group, count)[group]
    weighted = rows / (square + typical.clamp(min=_SAME**2))
    return _sums((weighted[:, None] * rows[None]).flatten(0, 1), group, count).reshape(count, 3, 3)


def _swings(axis: Tensor, rows: Tensor, group: Tensor) -> Tensor:
    """What is left of rotations ``(4, M)`` without their turn about the axes ``(C, 3)`` of their groups, ``(3, 2M)``.

    R̃ = T S = S' T with a turn T about the axis: x, y, z of S, and then of S'.
    """
    along = axis.t()[:, group] if len(axis) > 1 else axis.t()
    vector = rows[:3]
    sine, cosine = (along * vector).sum(dim=0), rows[3]
    off_axis = vector - along * sine
    across = torch.linalg.cross(along.expand_as(vector), vector, dim=0)
    length = (sine * sine + cosine * cosine).sqrt().clamp(min=_SAME)
    before, after = cosine * off_axis - sine * across, cosine * off_axis + sine * across
    return torch.cat((before / length, after / length), dim=1)


def _sums(rows: Tensor, group: Tensor, count: int) -> Tensor:
    """Sums ``(G, k)`` of the columns of ``(k, M)`` by group ``(M,)``."""
    if count == 1:
        return rows.sum(dim=1)[None]
    return rows.new_zeros(len(rows), count).index_add_(1, group, rows).t()


def _towards(axis: Tensor, direction: Tensor) -> Tensor:
    """The axes ``(C, 3)``, each turned round if it points away from its direction ``(C, 3)``."""
    return torch.where((axis * direction).sum(dim=1, keepdim=True) < 0, -axis, axis)


def _turned(axes: Tensor, vectors: Tensor, group: Tensor) -> Tensor:
    """Vectors ``(M, 3)`` as the axes ``(C, 3, 3)`` of their groups have them."""
    if len(axes) == 1:
        return vectors @ axes[0].t()
    return (axes[group] @ vectors[:, :, None]).squeeze(2)
