"""Triangles of a view-graph: three edges whose rotations should compose to none."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.running.threads import for_each, slices
from rotavg_ros.view_graph import ViewGraph

# Paths that a thread looks at before it takes others.
_SLICE_PATHS = 8192


@dataclass(frozen=True)
class Triangles:
    """T triangles of a graph of M edges, on its device.

    Attributes:
        edge: ``(3, T)``.
        angle: ``(T,)`` rad, by which each does not close.
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
        """Of a graph whose edges run from lower to higher nodes.

        Args:
            graph: M edges.
            most: triangles at most; so many paths of two edges are looked at, evenly spread over all.
            among: ``(M,)`` bool: triangles that have one of these edges alone; default: all.
            component: ``(N,)`` of every node; then ``most`` is ``(C,)``, of each.
            run: so many paths that follow each other are looked at together, the last of these perhaps beyond ``most``:
                of a few edges many triangles, not of many few.
        """
        key, source, target, order = graph.source * graph.num_nodes + graph.target, graph.source, graph.target, None
        if not bool((key[1:] >= key[:-1]).all()):  # a canonical form is sorted, and copies of a large one cost memory
            key, order = key.sort(stable=True)
            source, target = source[order], target[order]
        first = torch.searchsorted(source, torch.arange(graph.num_nodes + 1, device=graph.device))
        # Each edge u→v is followed by every edge v→w.
        count = (first[1:] - first[:-1])[target]
        up_to = count.cumsum(0)
        paths = int(up_to[-1]) if graph.num_edges else 0
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
            wanted = source[one] * graph.num_nodes + target[two]
            three = torch.searchsorted(key, wanted).clamp(max=max(graph.num_edges - 1, 0))
            edge = torch.stack((one, two, three))[:, key[three] == wanted]
            edge = edge if order is None else order[edge]
            edge = edge if among is None else edge[:, among[edge].any(dim=0)]
            measured = [graph.target_from_source[each].double() for each in edge]
            passed = rotations.multiply(measured[1], measured[0])
            found[number] = edge, rotations.angle_between(passed, measured[2])

        for_each(look, range(len(parts)))
        edges, angles = zip(*found, strict=True) if found else ((path.new_empty(3, 0),), (path.new_empty(0).double(),))
        return cls(torch.cat(edges, dim=1), torch.cat(angles))

    def votes(self, closing: float, num_edges: int) -> Tensor:
        """``(M,)`` how many triangles of each edge close, to within about ``closing`` rad."""
        vote = torch.exp(-((self.angle / closing) ** 2) / 2)
        return torch.bincount(self.edge.ravel(), vote.repeat(3), num_edges)

    def contradicting(self, rejected: Tensor, group: Tensor, num_groups: int, closing: float) -> Tensor:
        """Triangles with a rejected edge that close to within ``closing`` rad, beyond those that do so by chance.

        By chance triangles close by any rotation near none, of which one in 27 is three times as near.

        Args:
            rejected: ``(M,)`` bool.
            group: ``(M,)`` of each edge, the same for all of a triangle.
            num_groups: how many there are.
            closing: rad.

        Returns:
            ``(num_groups,)`` their number, in standard deviations of what is by chance.
        """
        is_rejected = rejected[self.edge].any(dim=0)
        near, nearest = (
            torch.bincount(group[self.edge[0, is_rejected & (self.angle < limit)]], minlength=num_groups)
            for limit in (3 * closing, closing)
        )
        by_chance = near.double() / 27
        return (nearest - by_chance) / (by_chance + 1).sqrt()


def _spread(count: Tensor, up_to: Tensor, group: Tensor, most: Tensor, run: int) -> Tensor:
    """Paths, ``most`` of each group at most, evenly spread over its own whatever others there are.

    Args:
        count: ``(M,)`` paths that begin with each edge.
        up_to: ``(M,)`` the same summed up: paths are numbered so.
        group: ``(M,)`` of each edge.
        most: ``(C,)``.
        run: so many follow each other.
    """
    by_group = group.argsort(stable=True)
    ends = count[by_group].cumsum(0)  # of the paths, had they been numbered group by group
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
