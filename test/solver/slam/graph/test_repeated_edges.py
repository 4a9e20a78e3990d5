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


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 3))])
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


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 2))])
def test_of_copies_that_state_other_precisions_the_highest_counts(seed: int) -> None:
    """Whichever comes first; one that states none says nothing of it."""
    graph, rng = _noisy_graph(60, 30, seed), np.random.default_rng(seed)
    count = graph.num_edges
    stated = torch.from_numpy(rng.lognormal(4.0, 1.0, (3, count)))
    stated[2] = torch.nan
    highest = replace(graph, precision=stated[:2].amax(dim=0))
    once = solve(highest)
    for order in ((0, 1, 2), (2, 1, 0)):
        copies = torch.arange(count).repeat(3)
        repeated = replace(graph.select_edges(copies), precision=stated[list(order)].flatten())
        often = solve(repeated)
        assert float(rotations.angle_between(once.body_from_world, often.body_from_world).max()) < 1e-6
        torch.testing.assert_close(often.outlier_score, once.outlier_score[copies], atol=1e-6, rtol=0)


def test_measurements_that_differ_are_all_kept() -> None:
    graph = _noisy_graph(20, 10, 0)
    twice = torch.arange(graph.num_edges).repeat(2)
    again = graph.select_edges(twice)
    turn = rotations.exp(torch.tensor([[0.0, 0.0, 1e-4]], dtype=torch.float64))
    measurement = again.target_from_source.clone()
    measurement[graph.num_edges :] = rotations.multiply(measurement[graph.num_edges :], turn)
    assert first_of_each(replace(again, target_from_source=measurement)) is None
    labelled = again.label.clone()
    labelled[graph.num_edges :] = EdgeLabel.REJECTED
    assert first_of_each(replace(again, label=labelled)) is None
    first, says_as = first_of_each(again) or (None, None)
    np.testing.assert_array_equal(first, np.arange(graph.num_edges))
    np.testing.assert_array_equal(says_as, twice)


@pytest.mark.parametrize("digits", [6, 7, 9])
def test_both_ways_with_the_digits_of_a_file(digits: int) -> None:
    """Every edge again in the other direction, computed before rounding: each once, half turns among them."""
    graph = _noisy_graph(60, 30, 0)
    half_turn = rotations.exp(torch.tensor([[0.0, 0.0, torch.pi]], dtype=torch.float64))
    measurement = graph.target_from_source.clone()
    measurement[-1] = half_turn
    rng = np.random.default_rng(0)
    translation = torch.from_numpy(
        rng.normal(size=(graph.num_edges, 3)) * 10.0 ** rng.integers(-2, 3, (graph.num_edges, 1))
    )
    graph = replace(graph, target_from_source=measurement, translation=translation)
    back = -rotations.rotate(graph.target_from_source, translation)
    every = torch.arange(graph.num_edges)
    twice = replace(_turned(graph.select_edges(every.repeat(2)), every), translation=torch.cat((back, translation)))
    rounded = replace(
        twice,
        target_from_source=_with_digits(twice.target_from_source, digits),
        translation=_with_digits(twice.translation, digits),
    )
    first, says_as = first_of_each(rounded) or (None, None)
    np.testing.assert_array_equal(first, every)
    np.testing.assert_array_equal(says_as, every.repeat(2))


def _with_digits(values: torch.Tensor | None, digits: int) -> torch.Tensor:
    assert values is not None
    return torch.tensor(
        [[float(f"{value:.{digits}g}") for value in row] for row in values.tolist()], dtype=torch.float64
    )


def test_no_translation_is_not_one_of_zero() -> None:
    graph = _noisy_graph(20, 10, 0)
    again = graph.select_edges(torch.arange(graph.num_edges).repeat(2))
    translation = torch.zeros(again.num_edges, 3, dtype=torch.float64)
    translation[graph.num_edges :] = torch.nan
    assert first_of_each(replace(again, translation=translation)) is None
