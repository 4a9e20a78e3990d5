"""Weights and forces of edges at given orientations."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.residuals import SLICE_EDGES, EdgeResiduals
from rotavg_ros.solver.running.threads import for_each, slices, stretches
from rotavg_ros.solver.sfm.laplacians.block import SplitWeights
from rotavg_ros.solver.sfm.laplacians.groups import Group
from rotavg_ros.solver.sfm.step.measure import Expected, Measure
from rotavg_ros.solver.sfm.symmetric_rows import distinct_entries, full, turned


class Pull(NamedTuple):
    """Weights and forces of the edges at given orientations.

    Attributes:
        weights: the edges' robust weights.
        matrix: ``(6, M)`` entries of the weights times the noise's shape, where edges have units of their own.
        force: ``(3, N)`` sum of the weighted residuals at each node.
    """

    weights: SplitWeights
    matrix: Tensor | None
    force: Tensor


def pulled(group: Group, orientations: Tensor, measure: Measure, prior: Tensor, dtype: torch.dtype) -> Pull:
    """At orientations ``(N, 4)``, given the group's own measure and prior weights ``(K,)``."""
    graph = group.graph
    measured = group.measured if dtype == torch.float32 else None
    residuals = EdgeResiduals(graph, orientations.to(dtype), measured)
    rows, prior = measure.rows(dtype), prior.to(dtype)
    held = None if measure.source_share is None else measure.source_share.to(dtype)
    is_held = measure.is_held
    share = torch.empty_like(prior) if held is None or is_held is not None else held
    weights = SplitWeights(torch.empty_like(prior), share)
    matrix = None if measure.unit is None else prior.new_empty(6, graph.num_edges)
    parts = stretches(slices(graph.num_edges, SLICE_EDGES, graph.device))
    # Components in rows: adding columns up by node is a dozen times as fast as adding up rows.
    forces = [rows.new_zeros(3, graph.num_nodes) for _ in parts]

    def walk(part: int) -> None:
        for edges in parts[part]:
            source, target = graph.source[edges], graph.target[edges]
            at_source, at_target = rows.index_select(1, source), rows.index_select(1, target)
            vector = measure.in_units(residuals.vectors(edges), edges)
            shares = (None if value is None else value[edges] for value in (held, is_held))
            expected = Expected.of(vector, at_source, at_target, *shares)
            robust = measure.weigh(expected.square + expected.variance, edges).mul_(prior[edges])
            weights.total[edges] = robust
            if share is not held:
                weights.source_share[edges] = expected.source_share
            pull = measure.in_units(expected.pull.mul_(robust), edges)
            if matrix is not None and measure.unit is not None:
                information = Expected.information(at_source, at_target, expected.source_share)
                in_world = turned(information, full(measure.unit[:, edges].to(dtype)))
                matrix[:, edges] = robust * distinct_entries(in_world)
            forces[part].index_add_(1, target, pull)
            forces[part].index_add_(1, source, pull.neg_())  # with alpha = -1 it takes six times as long

    for_each(walk, range(len(parts)))
    return Pull(weights, matrix, torch.stack(forces).sum(dim=0))
