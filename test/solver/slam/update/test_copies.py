"""Graphs that state some measurements again, while they grow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.solver import KeptLabels, Solution, solve
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.view_graph import EdgeKind, ViewGraph

from .test_memory import drawn, grown, until


def with_copies(graph: ViewGraph, edges: list[int]) -> tuple[ViewGraph, torch.Tensor]:
    """The graph in which some edges are stated again at once, every second one the other way; and what each says as."""
    says_as = torch.arange(graph.num_edges)
    says_as = torch.sort(torch.cat((says_as, torch.tensor(edges)))).values
    again = torch.zeros(len(says_as), dtype=torch.bool)
    again[1:] = says_as[1:] == says_as[:-1]
    return graph.select_edges(says_as).reverse_edges(again & (says_as % 2 == 0)), says_as


@pytest.mark.parametrize("with_places", [False, True])
def test_copies_change_no_tick(with_places: bool) -> None:
    case = drawn("building: 30 % random", 1)
    graph = replace(case.graph, translation=torch.from_numpy(case.edge_translation) if with_places else None)
    before, after = until(graph, 290), until(graph, 300)
    copied = [3, 40, 41, *torch.nonzero(~before.is_odometry)[::5, 0].tolist()]
    more = [*copied, after.num_edges - 1, after.num_edges - 2]
    kept: dict[bool, tuple[Solution, Solution, Solution]] = {}
    for has_copies in (False, True):
        known = with_copies(before, copied)[0] if has_copies else before
        now = with_copies(after, more)[0] if has_copies else after
        first = solve(known, profile="slam")
        memory = first.memory
        assert isinstance(memory, SlamMemory) and memory.labels is not None
        labels = KeptLabels.of_arrays(known, memory.labels.arrays())
        start = grown(now, first)
        by_tangent = replace(memory, update_work=1e9)
        found = [solve(now, profile="slam", warm_start=start, memory=each) for each in (memory, labels)]
        found.append(solve(now, profile="slam", warm_start=start, memory=by_tangent, work=1e4))
        assert all("refine" not in one.stage_seconds for one in found)
        kept[has_copies] = found[0], found[1], found[2]
    says_as = with_copies(after, more)[1]
    for plain, told in zip(kept[False], kept[True], strict=True):
        off = rotations.angle_between(plain.body_from_world, told.body_from_world)
        assert np.degrees(float(off.max())) < 1e-4
        torch.testing.assert_close(told.outlier_score, plain.outlier_score[says_as], atol=1e-6, rtol=0)
        torch.testing.assert_close(told.uncertainty, plain.uncertainty, atol=1e-6, rtol=1e-5)
        assert (told.edge_precision is None) is not with_places


def test_a_copy_under_another_number_leaves_ticks_short() -> None:
    """It had made every later tick a whole search."""
    case = drawn("building: 30 % random", 1)
    graph, online = until(case.graph, 120), OnlineEstimator(EstimatorOptions(keyframe_source="edges"))
    edges = list(zip(graph.source.tolist(), graph.target.tolist(), graph.target_from_source.tolist(), strict=True))

    def give(edge: int, edge_id: int) -> None:
        source, target, rotation = edges[edge]
        ends = KeyframeReference("r", source), KeyframeReference("r", target)
        assert online.add_edge(EdgeMeasurement(edge_id, *ends, rotation, int(graph.kind[edge]))) is None

    order = torch.argsort((graph.kind != EdgeKind.ODOMETRY).long(), stable=True).tolist()
    for edge in order[:-2]:
        give(edge, edge)
    assert online.tick() is not None
    for edge, edge_id in ((order[-3], 10_000), (order[-2], order[-2]), (order[-1], order[-1])):
        give(edge, edge_id)
        answer = online.tick()
        assert answer is not None and set(answer.stage_seconds) == {"update"}
    score = dict(zip(answer.edge_id.tolist(), answer.outlier_score.tolist(), strict=True))
    assert score[10_000] == score[order[-3]]
