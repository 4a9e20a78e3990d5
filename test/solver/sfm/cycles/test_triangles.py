"""Which triangles are looked at where there are many, and where edges are parallel."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph
from rotavg_ros.solver.sfm.cycles.triangles import Triangles
from test.solver.graphs import measured, random_truth


def complete(cameras: int, seed: int) -> ViewGraph:
    return measured(random_truth(cameras, seed), *np.triu_indices(cameras, k=1))


@pytest.mark.parametrize("run", [1, 40])
def test_each_component_has_its_own_however_nodes_are_mixed(run: int) -> None:
    """Evenly spread over its own paths, as if it were alone; nodes of both follow each other in turn."""
    sizes, most = (20, 30), torch.tensor([150, 400])
    alone = [complete(size, seed) for seed, size in enumerate(sizes)]
    number = [2 * torch.arange(20), torch.cat((2 * torch.arange(20) + 1, torch.arange(40, 50)))]
    source, target = (
        torch.cat([of[getattr(graph, end)] for of, graph in zip(number, alone, strict=True)])
        for end in ("source", "target")
    )
    order = torch.argsort(source * 50 + target)
    measurements = torch.cat([graph.target_from_source for graph in alone])
    together = ViewGraph.create(source[order], target[order], measurements[order])
    component = torch.zeros(50, dtype=torch.int64)
    component[number[1]] = 1
    found = Triangles.of(together, most, component=component, run=run)
    for which, (graph, of) in enumerate(zip(alone, number, strict=True)):
        mine = component[together.source[found.edge[0]]] == which
        ends = torch.stack((together.source[found.edge[:, mine]], together.target[found.edge[:, mine]]))
        expected = Triangles.of(graph, int(most[which]), run=run)
        assert 0 < len(expected.angle) <= most[which] + run
        expected_ends = torch.stack((of[graph.source[expected.edge]], of[graph.target[expected.edge]]))
        assert sorted(ends.flatten(0, 1).T.tolist()) == sorted(expected_ends.flatten(0, 1).T.tolist())


def test_runs_have_many_triangles_of_few_edges() -> None:
    graph = complete(60, 3)
    spread, runs = (Triangles.of(graph, 2000, run=run) for run in (1, 200))
    assert len(runs.angle) <= 2000 and len(spread.angle) <= 2000
    # A path goes on from its first edge.
    assert len(runs.edge[0].unique()) < 0.2 * len(spread.edge[0].unique())
    for run in (1, 7, 10**9):
        assert len(Triangles.of(graph, 10**6, run=run).angle) == 60 * 59 * 58 / 6


@pytest.mark.parametrize("seed", [0, 1])
def test_each_of_several_edges_between_two_cameras_closes_triangles(seed: int) -> None:
    """Against all triples of edges."""
    rng = np.random.default_rng(seed)
    pairs = np.concatenate(np.triu_indices(6, k=1)).reshape(2, -1)
    source, target = pairs[:, np.sort(rng.integers(0, pairs.shape[1], 40))]
    graph = measured(random_truth(6, seed), source, target, Rotation.random(40, rng))
    found = Triangles.of(graph, 10**6)
    expected = {
        (one, two, three)
        for one, two, three in permutations(range(40), 3)
        if target[one] == source[two] and (source[one], target[two]) == (source[three], target[three])
    }
    assert len(found.angle) == len(expected)
    assert {tuple(edge) for edge in found.edge.T.tolist()} == expected


def test_of_very_many_parallel_edges_some_close_each_path() -> None:
    """Eight of sixty-four, evenly spread."""
    source, target = np.concatenate(([[0], [1]], [[1], [2]], np.tile([[0], [2]], 64)), axis=1)
    found = Triangles.of(measured(random_truth(3, 0), source, target), 10**6)
    order = np.argsort(3 * source + target, kind="stable")
    closing = np.flatnonzero((source[order] == 0) & (target[order] == 2))
    assert found.edge[2].tolist() == order[closing[::8]].tolist()
