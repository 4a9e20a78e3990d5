"""Which closures agree: by hand, by how often good ones do, and the clique beside networkx's."""

from __future__ import annotations

from dataclasses import replace

import networkx
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.baselines.consistent_closures import agreement, consistent_closures, largest_clique
from rotavg_ros.datasets.dead_reckoning import chain_poses
from rotavg_ros.view_graph import ViewGraph

STEPS = 40


def square(
    closures: list[tuple[int, int]], planar: bool = True, seed: int | None = None
) -> tuple[ViewGraph, np.ndarray]:
    """Four laps around a square of ten steps, with exact measurements or noise of 1° and 0.05 m a component."""
    turn = Rotation.from_rotvec(np.outer(np.arange(STEPS), [0.0, 0.0, 0.2 * np.pi]))
    position = np.concatenate((np.zeros((1, 3)), np.cumsum(turn.apply([1.0, 0.0, 0.0])[:-1], axis=0)))
    source = np.array([*range(STEPS - 1), *(first for first, _ in closures)])
    target = np.array([*range(1, STEPS), *(second for _, second in closures)])
    rotation = turn[target].inv() * turn[source]
    shift = turn[source].inv().apply(position[target] - position[source])
    sigma = np.tile([np.radians(1.0), 0.05], (len(source), 1))
    if seed is not None:
        rng = np.random.default_rng(seed)
        mask = np.array([0.0, 0.0, 1.0]) if planar else np.ones(3)
        rotation = Rotation.from_rotvec(rng.normal(size=(len(source), 3)) * mask * sigma[:, :1]) * rotation
        shift = shift + rng.normal(size=shift.shape) * [1, 1, not planar] * sigma[:, 1:]
    kind = [0] * (STEPS - 1) + [1] * len(closures)
    return ViewGraph.create(source, target, rotation.as_quat(canonical=True), translation=shift, kind=kind), sigma


def kept(graph: ViewGraph, sigma: np.ndarray) -> list[bool]:
    assert graph.translation is not None
    found = consistent_closures(graph, sigma, chain_poses(graph, graph.translation.numpy()))
    assert found[: STEPS - 1].all()
    return found[STEPS - 1 :].tolist()


@pytest.mark.parametrize("planar", [True, False])
def test_two_that_are_off_are_left_out(planar: bool) -> None:
    """One joins a place 30 m off, one is turned by 90°; both from either side."""
    graph, sigma = square([(0, 10), (12, 2), (4, 24), (35, 5), (1, 31)], planar)
    assert kept(graph, sigma) == [True] * 5
    assert graph.translation is not None
    translation, rotation = graph.translation.clone(), graph.target_from_source.clone()
    translation[STEPS] += torch.tensor([30.0, 0.0, 0.0])
    rotation[STEPS + 2] = torch.tensor([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    spoiled = replace(graph, translation=translation, target_from_source=rotation)
    assert kept(spoiled, sigma) == [True, False, True, False, True]


def test_the_larger_of_two_groups_is_kept() -> None:
    graph, sigma = square([(0, 10), (1, 11), (2, 12), (20, 30), (21, 31)])
    assert graph.translation is not None
    translation = graph.translation.clone()
    # Two that agree with each other on a place 20 m ahead.
    translation[-2:] += torch.tensor([20.0, 0.0, 0.0])
    assert kept(replace(graph, translation=translation), sigma) == [True, True, True, False, False]


@pytest.mark.parametrize("planar", [True, False])
def test_good_closures_agree_as_often_as_the_quantile_says(planar: bool) -> None:
    """The covariance of a loop is that of its noise: lever arms, closures in both directions and all."""
    closures = [(first, second) for first in range(0, 20, 3) for second in range(22, 40, 5)]
    closures = [pair[::-1] if number % 2 else pair for number, pair in enumerate(closures)]
    shares = []
    for seed in range(40):
        graph, sigma = square(closures, planar, seed)
        assert graph.translation is not None
        odometry = chain_poses(graph, graph.translation.numpy())
        edges = np.arange(STEPS - 1, graph.num_edges)
        agrees = agreement(graph, sigma, odometry, edges, 0.9)
        shares.append(agrees[np.triu_indices(len(edges), 1)].mean())
    assert np.mean(shares) == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("seed", range(20))
def test_cliques_are_networkxs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    upper = np.triu(rng.random((25, 25)) < rng.uniform(0.2, 0.8), 1)
    agrees = upper | upper.T
    found = largest_clique(agrees)
    assert agrees[np.ix_(found, found)].sum() == len(found) * (len(found) - 1)
    largest, _ = networkx.max_weight_clique(networkx.from_numpy_array(agrees), weight=None)
    assert len(found) >= len(largest) - 1


def test_no_closures() -> None:
    assert kept(*square([])) == []
    assert kept(*square([(0, 10)])) == [True]
