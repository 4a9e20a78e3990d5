"""One form for all descriptions of the same view-graph.

The names of the nodes, the order and direction of the edges, copies of an edge, and the choice of the cameras' axes
carry no information about the orientations. The canonical form chooses them by the measurements alone:

- Of edges that state the same rotation between the same nodes, one is kept, with the highest precision stated.
- Nodes are sorted by a weighted number of walks: k_v = Σ_u (½ + w_uv) k_u, iterated a few times from k = 1. w_uv is the
  cosine of half an edge's angle, which none of those choices changes.
- Edges run from the earlier node to the later one and are sorted by both, parallel ones by w, x, y and z.
- Cameras' axes: those of the second moment Σ s sᵀ of all edges, where s is x, y, z of an edge's quaternion. Turning the
  cameras' axes by A, R̃_uv → A R̃_uv A⁻¹, turns every s by A, and so the moment's axes. y has the largest moment, z the
  least. An axis is directed so that Σ_v |b_v|² b_v has a positive component along it, where b_v = Σ_u s_uv over the
  edges that arrive at v. This sum is odd in s, but does not depend on the direction in which an edge was stated.

If the data are the same for several nodes or axes, any of them is taken, since it makes no difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.medians import median_by_group
from rotavg_ros.solver.algebra.residuals import SLICE_EDGES
from rotavg_ros.solver.algebra.sorted_edges import sorted_by_node
from rotavg_ros.solver.running.threads import for_each, slices, threads_on
from rotavg_ros.view_graph import EdgeKind, ViewGraph, mean_precision

# Edges of a walk: enough to distinguish nodes that differ only in distant edges, at little cost compared to a solve.
_WALK_LENGTH = 4
# Most edges of a component that determine its axes; on the synthetic recipes, to about half a degree.
_MOST_EDGES = 1 << 15
# Quaternions are the same if no entry differs by more: far below any measurement's noise, far above rounding errors.
_SAME = 1e-9
# With fewer edges a sum takes less time than waking another worker.
_WORTH_WORKERS = 50_000


@dataclass(frozen=True)
class CanonicalForm:
    """A view-graph of N nodes, M edges and C components in canonical form, and how to get back.

    Attributes:
        graph: in canonical form, with K ≤ M edges, without translations; of copies, the highest precision is kept, and
            the information of highest mean precision.
        component: ``(N,)`` component of each canonical node.
        node: ``(N,)`` node of the given graph that each canonical node is.
        edge: ``(M,)`` int32, canonical edge that stands for each edge of the given graph.
        canonical_from_body: ``(C, 4)`` the canonical axes of each component's cameras.
    """

    graph: ViewGraph
    component: Tensor
    node: Tensor
    edge: Tensor
    canonical_from_body: Tensor

    @classmethod
    def of(cls, graph: ViewGraph, component: Tensor | None = None, own_axes: bool = True) -> CanonicalForm:
        """The canonical form of a graph.

        Args:
            component: ``(N,)`` the graph's connected components; default: computed.
            own_axes: whether the measurements determine the cameras' axes; otherwise the axes stay as given.
        """
        component = graph.components() if component is None else component
        form, has_parallels = _form(graph, component, own_axes)
        if not has_parallels:
            return form
        kept, copy_of = _without_copies(graph)
        graph = _stating_the_highest(graph, kept, copy_of)
        # Different rotations between the same nodes are sorted by their angles; the sorting by nodes keeps this order.
        by_angle = graph.target_from_source[kept, 3].argsort(stable=True)
        form, _ = _form(graph.select_edges(kept[by_angle]), component, own_axes)
        order = _parallels_in_order(form.graph)
        moved, place = torch.empty_like(form.edge), torch.empty_like(form.edge)
        moved[order] = torch.arange(len(order), dtype=moved.dtype, device=moved.device)
        place[by_angle] = moved[form.edge]
        return replace(form, graph=form.graph.select_edges(order), edge=place[copy_of])

    def first_nodes(self) -> Tensor:
        """``(C,)`` the canonical node of the first node of each component of the given graph."""
        nodes = torch.full((len(self.canonical_from_body),), len(self.node), device=self.node.device)
        first = nodes.scatter_reduce(0, self.component, self.node, "amin")
        place = torch.empty_like(self.node)
        place[self.node] = torch.arange(len(self.node), device=self.node.device)
        return place[first]

    def of_nodes(self, value: Tensor) -> Tensor:
        """Values ``(N,)`` of the canonical graph's nodes → of the given one's."""
        return torch.empty_like(value).scatter_(0, self.node, value)

    def orientations(self, body_from_world: Tensor) -> Tensor:
        """Orientations of the canonical graph → of the given one, ``(N, 4)``."""
        axes = rotations.inverse(self.canonical_from_body)[self.component]
        given = torch.empty_like(body_from_world)
        given[self.node] = rotations.multiply(axes.to(body_from_world), body_from_world)
        return given

    def canonical_orientations(self, body_from_world: Tensor) -> Tensor:
        """Orientations of the given graph → of the canonical one, ``(N, 4)``."""
        axes = self.canonical_from_body[self.component].to(body_from_world)
        return rotations.canonical(rotations.multiply(axes, body_from_world[self.node]))


def _form(graph: ViewGraph, component: Tensor, own_axes: bool) -> tuple[CanonicalForm, bool]:
    """The form of a graph without copies, and whether it has several edges between any two nodes."""
    node = _nodes_in_order(graph, component)
    rank = torch.empty_like(node)
    rank[node] = torch.arange(len(node), device=node.device)
    component = component[node]
    stated = _StatedEdges.of(graph, rank)
    low, order = stated.in_order(graph.num_nodes)
    count = int(component.max()) + 1 if len(component) else 0
    if own_axes:
        some = evenly_spread(component.index_select(0, low) if count > 1 else low, count, _MOST_EDGES)
        chosen = order.index_select(0, some)
        higher, rows = stated.higher(chosen), stated.upwards(chosen).t().contiguous()
        axes = _axes(low.index_select(0, some), higher, rows, component)
    else:
        axes = torch.eye(3, dtype=graph.target_from_source.dtype, device=graph.device).expand(count, 3, 3)
    high, edge, measured = torch.empty_like(low), torch.empty_like(order), torch.empty_like(graph.target_from_source)
    place = torch.arange(len(low), dtype=order.dtype, device=low.device)

    def write(part: slice) -> None:
        chosen = order[part]
        high[part] = stated.higher(chosen)
        edge.index_copy_(0, chosen.long(), place[part])
        upwards = stated.upwards(chosen)
        measured[part] = _of_one_sign(_turned(upwards, axes, component, low[part]) if own_axes else upwards)

    for_each(write, slices(len(low), SLICE_EDGES, low.device))
    # One number each, expanded to M rows: with millions of edges, columns that nobody reads would take much memory.
    kind, precision, steps = (
        torch.full_like(column[:1], value).expand(len(column))
        for column, value in ((graph.kind, EdgeKind.LOOP_CLOSURE), (graph.precision, torch.nan), (graph.steps, 1.0))
    )
    label = graph.label[:1].expand(len(low))
    if bool((graph.label != label).any()):
        label = graph.label.index_select(0, order)
    if bool(graph.precision.isfinite().any()):
        precision = graph.precision.index_select(0, order)
    information = None
    if graph.information is not None:
        is_reversed = stated.source > stated.target
        information = _seen_from_the_higher(graph, is_reversed).index_select(0, order)
        of_edge = axes[component.index_select(0, low)]
        information = of_edge @ information @ of_edge.mT
    canonical = ViewGraph(graph.num_nodes, low, high, measured, kind, precision, label, steps, information=information)
    has_parallels = bool(((low[1:] == low[:-1]) & (high[1:] == high[:-1])).any())
    return CanonicalForm(canonical, component, node, edge, rotations.from_matrix(axes)), has_parallels


class _StatedEdges(NamedTuple):
    """Edges as stated, between nodes given by their rank.

    Attributes:
        source, target: ``(M,)`` int32.
        target_from_source: ``(M, 4)``.
    """

    source: Tensor
    target: Tensor
    target_from_source: Tensor

    @classmethod
    def of(cls, graph: ViewGraph, rank: Tensor) -> _StatedEdges:
        """Given the ``rank`` ``(N,)`` of every node."""
        source, target = (torch.empty_like(end, dtype=torch.int32) for end in (graph.source, graph.target))
        short = rank.int()

        def write(part: slice) -> None:
            for ranks, end in ((source, graph.source), (target, graph.target)):
                ranks[part] = short.index_select(0, end[part])

        for_each(write, slices(len(source), SLICE_EDGES, source.device))
        return cls(source, target, graph.target_from_source)

    def in_order(self, num_nodes: int) -> tuple[Tensor, Tensor]:
        """Sort by the lower end, then by the higher one: sorted lower ends ``(M,)`` int64, and the order, int32."""
        _, by_high = sorted_by_node(torch.maximum(self.source, self.target), num_nodes)
        low = torch.minimum(self.source, self.target).index_select(0, by_high)
        first, by_low = sorted_by_node(low, num_nodes)
        nodes = torch.arange(num_nodes, device=low.device)
        return nodes.repeat_interleave(first.diff(), output_size=len(low)), by_high.index_select(0, by_low)

    def higher(self, edges: Tensor) -> Tensor:
        """The higher end of some edges ``(k,)``."""
        return torch.maximum(self.source.index_select(0, edges), self.target.index_select(0, edges))

    def upwards(self, edges: Tensor) -> Tensor:
        """Measurements ``(k, 4)`` of some edges ``(k,)``, from the lower to the higher end."""
        is_reversed = self.source.index_select(0, edges) > self.target.index_select(0, edges)
        signs = self.target_from_source.new_tensor([[1.0, 1.0, 1.0, 1.0], [-1.0, -1.0, -1.0, 1.0]])
        return signs.index_select(0, is_reversed.int()).mul_(self.target_from_source.index_select(0, edges))


def _without_copies(graph: ViewGraph) -> tuple[Tensor, Tensor]:
    """Indices ``(K,)`` of the edges without copies, and which of these stands for each edge ``(M,)``."""
    is_forward = (graph.source < graph.target)[:, None]
    number = (graph.target_from_source / _SAME).round().long()
    number[:, :3] *= torch.where(is_forward, 1, -1)
    number = torch.where(((number[:, 3] == 0) & _is_negative(number))[:, None], -number, number)
    low, high = torch.minimum(graph.source, graph.target), torch.maximum(graph.source, graph.target)
    content = torch.cat((torch.stack((low, high, graph.label), dim=1), number), dim=1)
    _, group = torch.unique(content, dim=0, return_inverse=True)
    every = torch.arange(graph.num_edges, device=group.device)
    first = torch.full_like(every, graph.num_edges).scatter_reduce(0, group, every, "amin")[group]
    is_kept = first == every
    return is_kept.nonzero().squeeze(1), (is_kept.cumsum(0) - 1)[first]


def _parallels_in_order(graph: ViewGraph) -> Tensor:
    """Indices ``(M,)`` by which edges between the same nodes are sorted: by w, x, y, z and label.

    Args:
        graph: sorted by nodes, in canonical axes.
    """
    is_next = (graph.source[1:] == graph.source[:-1]) & (graph.target[1:] == graph.target[:-1])
    none = is_next.new_zeros(1)
    is_second = torch.cat((none, is_next))
    parallel = (is_second | torch.cat((is_next, none))).nonzero().squeeze(1)
    pair = (~is_second).cumsum(0)[parallel]
    number = (graph.target_from_source[parallel] / _SAME).round().long()
    order = torch.arange(len(parallel), device=parallel.device)
    # By what counts least first, since the sorting is stable.
    for key in (graph.label[parallel], *(number[:, entry] for entry in (2, 1, 0, 3)), pair):
        order = order[key[order].argsort(stable=True)]
    every = torch.arange(graph.num_edges, device=parallel.device)
    every[parallel] = parallel[order]
    return every


def _is_negative(number: Tensor) -> Tensor:
    """``(K,)`` whether the first of x, y, z that is not zero is negative, of quaternions ``(K, 4)`` in whole units."""
    return (number[:, :3].sign() * number.new_tensor([4, 2, 1])).sum(dim=1) < 0


def _of_one_sign(measured: Tensor) -> Tensor:
    """Quaternions ``(K, 4)`` in canonical axes; half turns get the sign that makes the first entry positive."""
    half_turn = (measured[:, 3].abs() < _SAME).nonzero().squeeze(1)
    if len(half_turn):
        chosen = measured[half_turn]
        is_negative = _is_negative((chosen / _SAME).round())
        measured[half_turn] = torch.where(is_negative[:, None], -chosen, chosen)
    return measured


def _stating_the_highest(graph: ViewGraph, kept: Tensor, copy_of: Tensor) -> ViewGraph:
    """The graph, its ``kept`` edges with the highest precision and the best information of any of their copies."""
    if graph.information is not None:
        graph = replace(graph, information=_best_information(graph, kept, copy_of))
    if not bool(graph.precision.isfinite().any()):
        return graph
    stated = graph.precision.nan_to_num(nan=0.0)
    highest = stated.new_zeros(len(kept)).scatter_reduce(0, copy_of, stated, "amax")
    precision = graph.precision.clone()
    precision[kept] = torch.where(highest > 0, highest, torch.nan)
    return replace(graph, precision=precision)


def _seen_from_the_higher(graph: ViewGraph, is_reversed: Tensor) -> Tensor:
    """Information ``(M, 3, 3)`` in the target's frame; in the source's frame if the edge is to be reversed."""
    assert graph.information is not None
    seen = rotations.turn_form(rotations.inverse(graph.target_from_source), graph.information)
    return torch.where(is_reversed[:, None, None], seen, graph.information)


def _best_information(graph: ViewGraph, kept: Tensor, copy_of: Tensor) -> Tensor:
    """Information ``(M, 3, 3)``; a ``kept`` row has that of its copy of highest mean precision.

    Copies of the same mean precision that differ are averaged, so that their order does not matter.
    """
    is_reversed = graph.source > graph.target
    information = _seen_from_the_higher(graph, is_reversed)
    stated = mean_precision(information).nan_to_num(nan=0.0)
    highest = stated.new_zeros(len(kept)).scatter_reduce(0, copy_of, stated, "amax")
    is_best = (stated >= (1 - _SAME) * highest[copy_of]) & (stated > 0)
    best, place = information[is_best], copy_of[is_best]
    count = torch.bincount(place, minlength=len(kept))
    mean = best.new_zeros(len(kept), 3, 3).index_add_(0, place, best) / count[:, None, None]  # NaN where none is
    chosen = information.clone()
    chosen[kept] = mean
    as_stated = rotations.turn_form(graph.target_from_source, chosen)
    return torch.where(is_reversed[:, None, None], as_stated, chosen)


def _nodes_in_order(graph: ViewGraph, component: Tensor) -> Tensor:
    """The nodes ``(N,)`` in canonical order, component by component."""
    weight = 0.5 + graph.target_from_source[:, 3]
    walks = torch.ones(graph.num_nodes, dtype=weight.dtype, device=weight.device)
    for _ in range(_WALK_LENGTH):
        walks = _collected((graph.source, graph.target), weight, walks)
    by_walks = walks.argsort(stable=True)
    return by_walks[component[by_walks].argsort(stable=True)]


def _collected(ends: Sequence[Tensor], weight: Tensor, value: Tensor) -> Tensor:
    """Sums ``(N,)`` over each node's edges: ``weight`` ``(M,)`` times ``value`` ``(N,)`` of the other end.

    Args:
        ends: both ends of the edges, ``(M,)``.
    """
    sums = [torch.zeros_like(value) for _ in ends]

    def collect(number: int) -> None:
        sums[number].index_add_(0, ends[number], weight * value.index_select(0, ends[1 - number]))

    for_each(collect, range(2), threads_on(value.device) if len(weight) > _WORTH_WORKERS else 1)
    return sums[0] + sums[1]


def _axes(source: Tensor, target: Tensor, rows: Tensor, component: Tensor) -> Tensor:
    """Canonical axes ``(C, 3, 3)`` of the cameras of each component, one axis per row.

    Args:
        source, target: ``(M,)`` of edges, from lower to higher nodes.
        rows: ``(4, M)`` their measurements.
        component: ``(N,)`` of every node.
    """
    count = int(component.max()) + 1 if len(component) else 0
    of_edge = component.index_select(0, source)
    main = torch.linalg.eigh(_moments(rows[:3], of_edge, count)).eigenvectors
    # The main axis is last. A rotation is a twist about it and a swing, in either order; the swing's vector lies in the
    # plane of the first two coordinates.
    first, second, along = _in_axes(main.mT, rows[:3], component, source)
    length = (along * along + rows[3] * rows[3]).sqrt().clamp(min=_SAME)  # hypot takes ten times as long
    along, cosine = along / length, rows[3] / length
    before = torch.stack((cosine * first - along * second, cosine * second + along * first))
    after = torch.stack((cosine * first + along * second, cosine * second - along * first))
    moment = _moments(before, of_edge, count) + _moments(after, of_edge, count)
    in_plane = torch.linalg.eigh(moment).eigenvectors[:, :, 1]
    axes = torch.stack(((main[:, :, :2] @ in_plane[:, :, None]).squeeze(2), main[:, :, 2]), dim=1)
    directed = rows[:3] * (rows[3] >= _SAME)  # half turns point either way
    arriving = rows.new_zeros(3, len(component)).index_add_(1, target, directed).index_add_(1, source, -directed)
    skew = _sums((arriving * arriving).sum(dim=0) * arriving, component, count)
    axes = torch.where(axes @ skew[:, :, None] < 0, -axes, axes)
    return torch.cat((axes, torch.linalg.cross(axes[:, :1], axes[:, 1:])), dim=1)


def evenly_spread(group: Tensor, num_groups: int, largest: int) -> Tensor:
    """Indices of evenly spread members, at most about ``largest`` of each group ``(M,)``."""
    if num_groups == 1:
        return torch.arange(0, len(group), 1 + max(0, len(group) - 1) // largest, device=group.device)
    order = group.sort(stable=True).indices
    count = torch.bincount(group, minlength=num_groups)
    ordered = group[order]
    rank = torch.arange(len(group), device=group.device) - (count.cumsum(0) - count)[ordered]
    stride = (count + largest - 1).div(largest, rounding_mode="floor")[ordered]
    return order[rank % stride == 0]


def _moments(rows: Tensor, group: Tensor, count: int) -> Tensor:
    """Robust second moments ``(C, k, k)`` of the columns of ``(k, M)`` by group ``(M,)``, up to their scale."""
    square = (rows * rows).sum(dim=0)
    typical = median_by_group(square, group, count)
    weighted = rows / (square + (typical if count == 1 else typical[group]).clamp(min=_SAME**2))
    if count == 1:
        return (weighted @ rows.t())[None]
    return _sums((weighted[:, None] * rows[None]).flatten(0, 1), group, count).reshape(count, len(rows), len(rows))


def _sums(rows: Tensor, group: Tensor, count: int) -> Tensor:
    """Sums ``(C, k)`` of the columns of ``(k, M)`` by group ``(M,)``."""
    if count == 1:
        return rows.sum(dim=1)[None]
    return rows.new_zeros(len(rows), count).index_add_(1, group, rows).t()


def _in_axes(axes: Tensor, vectors: Tensor, component: Tensor, source: Tensor) -> Tensor:
    """Vectors ``(3, M)`` of edges, in the axes ``(C, 3, 3)`` of the components of their sources."""
    if len(axes) == 1:
        return axes[0] @ vectors
    return (axes.permute(1, 2, 0)[:, :, component[source]] * vectors).sum(dim=1)


def _turned(measured: Tensor, axes: Tensor, component: Tensor, source: Tensor) -> Tensor:
    """Quaternions ``(M, 4)`` of edges, in the axes ``(C, 3, 3)`` of the components of their sources."""
    if len(axes) == 1:
        turn = torch.eye(4, dtype=axes.dtype, device=axes.device)
        turn[:3, :3] = axes[0].t()
        return torch.matmul(measured, turn)
    rows = measured.t().contiguous()
    return torch.cat((_in_axes(axes, rows[:3], component, source), rows[3:])).t()
