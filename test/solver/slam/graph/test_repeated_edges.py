"""What a graph states twice counts once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import EdgeLabel, ViewGraph, rotations, solve
from rotavg_ros.solver.slam.graph.repeated_edges import first_of_each
from test.solver.graphs import measured, random_truth, slam_edges, small_noise


def _noisy_graph(num_nodes: int, num_closures: int, seed: int) -> ViewGraph:
    source, target, kind = slam_edges(num_nodes, num_closures, seed)
    noise = small_noise(len(source), 0.5, seed + 1)
    return measured(random_truth(num_nodes, seed), source, target, noise, kind=kind)


def _turned(graph: ViewGraph, edges: torch.Tensor) -> ViewGraph:
    """The same measurements, some of them written the other way round."""
    source, target, measurement = graph.source.clone(), graph.target.clone(), graph.target_from_source.clone()
    source[edges], target[edges] = graph.target[edges], graph.source[edges]
    measurement[edges] = rotations.canonical(rotations.inverse(graph.target_from_source[edges]))
    return replace(graph, source=source, target=target, target_from_source=measurement)


@pytest.mark.parametrize("seed", range(3))
def test_repetitions_change_nothing(seed: int) -> None:
    """Edges that are there up to five times, in either direction and any order: the answer of the graph without."""
    graph = _noisy_graph(60, 30, seed)
    rng = np.random.default_rng(seed)
    copies = torch.from_numpy(
        rng.permutation(np.repeat(np.arange(graph.num_edges), rng.integers(1, 6, graph.num_edges)))
    )
    repeated = _turned(graph.select_edges(copies), torch.from_numpy(rng.random(len(copies)) < 0.5))
    once, often = solve(graph), solve(repeated)
    angle = rotations.angle_between(once.body_from_world, often.body_from_world)
    assert float(angle.max()) < 1e-6
    torch.testing.assert_close(often.outlier_score, once.outlier_score[copies], atol=1e-6, rtol=0)


def test_measurements_that_differ_are_all_kept() -> None:
    graph = _noisy_graph(20, 10, 0)
    twice = torch.arange(graph.num_edges).repeat(2)
    again = graph.select_edges(twice)
    turn = rotations.exp(torch.tensor([[0.0, 0.0, 1e-6]], dtype=torch.float64))
    measurement = again.target_from_source.clone()
    measurement[graph.num_edges :] = rotations.multiply(measurement[graph.num_edges :], turn)
    assert first_of_each(replace(again, target_from_source=measurement)) is None
    labelled = again.label.clone()
    labelled[graph.num_edges :] = EdgeLabel.REJECTED
    assert first_of_each(replace(again, label=labelled)) is None
    first, says_as = first_of_each(again) or (None, None)
    np.testing.assert_array_equal(first, np.arange(graph.num_edges))
    np.testing.assert_array_equal(says_as, twice)
