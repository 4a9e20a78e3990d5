"""Triangles of a view-graph: three edges whose rotations should compose to the identity."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.running.threads import for_each, slices
from rotavg_ros.view_graph import ViewGraph

# Number of paths that a thread examines at a time.
_SLICE_PATHS = 8192
# Largest number of parallel edges that close a path, evenly spread over all; bounds the number of triangles.
_MOST_CLOSING = 8


@dataclass(frozen=True)
class Triangles:
    """T triangles of a graph of M edges, on its device.

    Attributes:
        edge: ``(3, T)``.
        angle: ``(T,)`` rad, closing angles: the rotation angle left when the three are composed.
    """

    edge: Tensor
    angle: Tensor

    @classmethod
    def of(
        cls,
        graph: ViewGraph,
        most: int | Tensor,
        among: Tensor | None = None,
        component: Tensor | None = None,
        run: int = 1,
    ) -> Triangles:
        """Triangles of a graph whose edges run from lower to higher nodes.

        Args:
            graph: M edges.
            most: maximum number of two-edge paths that are examined, evenly spread, and so of triangles; parallel edges
                may close a path several times, up to eight.
            among: ``(M,)`` bool: only triangles with at least one of these edges; default: all.
            component: ``(N,)`` component of every node; ``most`` is then ``(C,)``, per component.
            run: number of consecutive paths examined together (the last run may exceed ``most``): this gives many
                triangles of a few edges rather than a few of many edges.
        """
        key, source, target, order = graph.source * graph.num_nodes + graph.target, graph.source, graph.target, None
        is_sorted, has_parallels = _looked_at(key)
        if not is_sorted:  # a canonical form is; copying it would cost memory
            key, order = key.sort(stable=True)
            _, has_parallels = _looked_at(key)
            source, target = source[order], target[order]
        first = torch.searchsorted(source, torch.arange(graph.num_nodes + 1, device=graph.device))
        # Each edge u→v is followed by every edge v→w.
        count = (first[1:] - first[:-1])[target]
        up_to = count.cumsum(0)
        paths = int(up_to[-1]) if graph.num_edges else 0
        run = min(run, max(paths, 1))  # a run may be longer than all of them, its indices need not be
        of_each = torch.as_tensor(most).reshape(-1)
        if len(of_each) == 1 or component is None:
            stride = run * max(1, -(-paths // int(of_each[0])))
            begin = torch.arange(0, paths, stride, device=graph.device)
            path = (begin[:, None] + torch.arange(run, device=graph.device)).ravel()
            path = path if run == 1 else path[path < paths]
        else:
            path = _spread(count, up_to, component[source], of_each.to(graph.device), run)
        parts = slices(len(path), _SLICE_PATHS, path.device)
        found = [(path.new_empty(3, 0), path.new_empty(0, dtype=torch.float64)) for _ in parts]

        def look(number: int) -> None:
            along = path[parts[number]]
            one = torch.searchsorted(up_to, along, right=True)
            two = first[target[one]] + along - (up_to[one] - count[one])
            edge = torch.stack(_closed(one, two, key, source[one] * graph.num_nodes + target[two], has_parallels))
            edge = edge if order is None else order[edge]
            edge = edge if among is None else edge[:, among[edge].any(dim=0)]
            measured = [graph.target_from_source[each].double() for each in edge]
            passed = rotations.multiply(measured[1], measured[0])
            found[number] = edge, rotations.angle_between(passed, measured[2])

        for_each(look, range(len(parts)))
        edges, angles = zip(*found, strict=True) if found else ((path.new_empty(3, 0),), (path.new_empty(0).double(),))
        return cls(torch.cat(edges, dim=1), torch.cat(angles))

    def votes(self, closing: float, num_edges: int) -> Tensor:
        """``(M,)`` number of triangles of each edge that close to within about ``closing`` rad."""
        vote = torch.exp(-((self.angle / closing) ** 2) / 2)
        return torch.bincount(self.edge.ravel(), vote.repeat(3), num_edges)

    def contradicting(self, rejected: Tensor, group: Tensor, num_groups: int, closing: float) -> Tensor:
        """Excess of triangles with a rejected edge that close to within ``closing`` rad over the number by chance.

        Random closing rotations are uniform near the identity, so 1 in 27 of those within three times ``closing`` is
        within ``closing``.

        Args:
            rejected: ``(M,)`` bool.
            group: ``(M,)`` group of each edge, the same for all edges of a triangle.
            num_groups: number of groups.
            closing: rad.

        Returns:
            ``(num_groups,)`` the excess, in standard deviations of the number by chance.
        """
        is_rejected = rejected[self.edge].any(dim=0)
        near, nearest = (
            torch.bincount(group[self.edge[0, is_rejected & (self.angle < limit)]], minlength=num_groups)
            for limit in (3 * closing, closing)
        )
        by_chance = near.double() / 27
        return (nearest - by_chance) / (by_chance + 1).sqrt()


def _looked_at(key: Tensor) -> tuple[bool, bool]:
    """Whether numbers are sorted, and whether neighbours are the same."""
    is_sorted, has_same = torch.stack(((key[1:] >= key[:-1]).all(), (key[1:] == key[:-1]).any())).tolist()
    return is_sorted, has_same


def _closed(
    one: Tensor, two: Tensor, key: Tensor, wanted: Tensor, has_parallels: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Paths of edges ``one`` and ``two`` ``(P,)``, each with every edge that closes it, ``(T,)``.

    Args:
        key: ``(M,)`` sorted, one number for both ends of each edge.
        wanted: ``(P,)`` that of the edges that close each path.
        has_parallels: whether any number is there twice.
    """
    begin = torch.searchsorted(key, wanted)
    is_closed = key[begin.clamp(max=len(key) - 1)] == wanted
    closed = is_closed.nonzero().squeeze(1)
    one, two, begin, wanted = (value[closed] for value in (one, two, begin, wanted))
    if not has_parallels:
        return one, two, begin
    parallel = torch.searchsorted(key, wanted, right=True) - begin
    taken = parallel.clamp(max=_MOST_CLOSING)
    path = torch.arange(len(one), device=one.device).repeat_interleave(taken)
    rank = torch.arange(len(path), device=one.device) - (taken.cumsum(0) - taken)[path]
    return one[path], two[path], begin[path] + rank * parallel[path] // taken[path]


def _spread(count: Tensor, up_to: Tensor, group: Tensor, most: Tensor, run: int) -> Tensor:
    """Paths, at most ``most`` of each group, evenly spread within the group and independent of other groups.

    Args:
        count: ``(M,)`` number of paths that begin with each edge.
        up_to: ``(M,)`` its cumulative sum, by which paths are numbered.
        group: ``(M,)`` group of each edge.
        most: ``(C,)``.
        run: number of consecutive paths taken together.
    """
    by_group = group.argsort(stable=True)
    ends = count[by_group].cumsum(0)  # ends of the edges' paths if these are numbered group by group
    paths = torch.bincount(group, weights=count.double(), minlength=len(most)).long()
    stride = run * (-(-paths // most)).clamp(min=1)
    taken = -(-paths // stride) * run
    which = torch.arange(len(taken), device=count.device).repeat_interleave(taken)
    rank = torch.arange(len(which), device=count.device) - (taken.cumsum(0) - taken)[which]
    number = rank // run * stride[which] + rank % run
    is_one = number < paths[which]
    numbered = ((paths.cumsum(0) - paths)[which] + number)[is_one]
    place = torch.searchsorted(ends, numbered, right=True)
    edge = by_group[place]
    return up_to[edge] - count[edge] + numbered - (ends[place] - count[edge])
