"""Edges that the user has rejected: they change nothing but the frame of parts that they alone join."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeLabel, Solution, ViewGraph, rotations, solve
from rotavg_ros.baselines import residual_score
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.neurora.numbers import NUMBERS
from test.solver.graphs import as_quaternions, measured, random_truth, small_noise

CLUSTER = 10


def mostly_false(cameras: int, false_share: float, seed: int = 0) -> tuple[ViewGraph, torch.Tensor]:
    """All pairs; good edges are exact about z, false ones turn about the world's vertical. With which are false."""
    rng = np.random.default_rng(seed)
    source, target = np.array(list(combinations(range(cameras), 2))).T
    truth, is_false = random_truth(cameras, seed), rng.random(len(source)) < false_share
    noise = Rotation.from_rotvec(rng.normal(size=(len(source), 3)) * [0.02, 0.02, 0.002])
    turn = Rotation.from_rotvec(rng.uniform(1, 3, (len(source), 1)) * [0, 0, 1])
    good, false = noise * truth[target] * truth[source].inv(), truth[target] * turn * truth[source].inv()
    relative = np.where(is_false[:, None], false.as_quat(), good.as_quat())
    return ViewGraph.create(source, target, relative, num_nodes=cameras), torch.from_numpy(is_false)


def with_rejected(graph: ViewGraph, is_rejected: torch.Tensor) -> ViewGraph:
    return replace(graph, label=torch.where(is_rejected, int(EdgeLabel.REJECTED), int(EdgeLabel.AUTOMATIC)))


def two_clusters(joined_by: int, seed: int = 0) -> tuple[ViewGraph, torch.Tensor, Rotation]:
    """Two clusters, every pair of each measured, joined by edges of any rotation; which are these; the truth."""
    inner = np.array(list(combinations(range(CLUSTER), 2)))
    number = np.arange(joined_by)
    between = np.stack((number % CLUSTER, CLUSTER + (3 * number + number // CLUSTER) % CLUSTER), axis=1)
    source, target = np.concatenate((inner, inner + CLUSTER, between)).T
    truth, is_between = random_truth(2 * CLUSTER, seed), np.arange(len(source)) >= 2 * len(inner)
    graph = measured(truth, source, target, small_noise(len(source), 0.5, seed))
    relative = graph.target_from_source.clone()
    relative[is_between] = as_quaternions(random_truth(joined_by, seed + 1))
    return replace(graph, target_from_source=relative), torch.from_numpy(is_between), truth


def errors_deg(found: Solution, truth: Rotation, cameras: slice) -> torch.Tensor:
    return torch.rad2deg(orientation_errors(found.body_from_world[cameras], as_quaternions(truth[cameras])))


@pytest.mark.parametrize("method", ["neurora", "neurora-v1", "spt", "spt-paper", "cleannet-spt-paper"])
def test_a_graph_with_rejected_edges_is_solved_as_the_graph_without(method: str) -> None:
    graph, is_false = mostly_false(30, 0.7)
    told = solve(with_rejected(graph, is_false), method=method)
    without = solve(graph.select_edges(~is_false), method=method)
    assert torch.equal(told.body_from_world, without.body_from_world)
    assert torch.equal(told.outlier_score[~is_false], without.outlier_score)
    assert torch.allclose(told.uncertainty, without.uncertainty, rtol=0, atol=0, equal_nan=True)
    assert bool((told.outlier_score[is_false] == 1).all())


def test_rejected_edges_do_not_make_residuals_seem_large() -> None:
    """Of answers by others, too: seven tenths of false edges have a median residual of a hundred degrees."""
    graph, is_false = mostly_false(60, 0.7)
    graph = with_rejected(graph, is_false)
    score = solve(graph).outlier_score[~is_false]
    assert float(score.median()) < 1e-3
    score = residual_score(graph, solve(graph).body_from_world, NUMBERS.outlier_angle)
    assert float(score[~is_false].median()) < 1e-3
    assert bool((score[is_false] == 1).all())


@pytest.mark.parametrize("joined_by", [1, 20])
def test_of_parts_that_only_rejected_edges_join_it_is_said_that_nothing_is_known(joined_by: int) -> None:
    graph, is_between, truth = two_clusters(joined_by)
    found = solve(with_rejected(graph, is_between))
    apart = solve(graph.select_edges(~is_between))
    assert bool((found.component == 0).all())
    here, there = slice(0, CLUSTER), slice(CLUSTER, 2 * CLUSTER)
    for cameras in (here, there):
        assert float(errors_deg(found, truth, cameras).max()) < 1
    assert torch.equal(found.uncertainty[here], apart.uncertainty[here])
    assert torch.allclose(found.uncertainty[there], torch.tensor(rotations.RANDOM_VARIANCE).double().sqrt())
    if joined_by == 1:
        assert float(residuals(graph, found)[is_between].max()) < 1e-6


def residuals(graph: ViewGraph, found: Solution) -> torch.Tensor:
    """``(M,)`` rad."""
    at_source, at_target = found.body_from_world[graph.source], found.body_from_world[graph.target]
    return rotations.angle_between(rotations.multiply(graph.target_from_source, at_source), at_target)


def test_the_common_frame_does_not_depend_on_how_rejected_edges_are_listed() -> None:
    graph, is_between, _ = two_clusters(20)
    graph = with_rejected(graph, is_between)
    order = torch.from_numpy(np.random.default_rng(0).permutation(graph.num_edges))
    turned_round = torch.arange(graph.num_edges) % 3 == 0
    other = graph.reverse_edges(turned_round).select_edges(order)
    one, another = solve(graph), solve(other)
    assert float(rotations.angle_between(one.body_from_world, another.body_from_world).max()) < 1e-5


@pytest.mark.parametrize("method", ["neurora", "spt"])
def test_a_camera_whose_edges_are_all_rejected(method: str) -> None:
    graph, _ = mostly_false(8, 0.0)
    graph = with_rejected(graph, graph.target == 7)
    found = solve(graph, method=method)
    assert bool((found.component == 0).all())
    assert float(residuals(graph, found)[graph.target == 7].min()) < 1e-6
    assert bool(found.uncertainty[:7].isfinite().all()) == (method == "neurora")
    if method == "neurora":
        assert float(found.uncertainty[7]) == pytest.approx(rotations.RANDOM_VARIANCE**0.5)
    else:
        assert bool(found.uncertainty.isnan().all())


def test_a_graph_of_nothing_but_rejected_edges() -> None:
    graph, _ = mostly_false(5, 0.0)
    found = solve(with_rejected(graph, torch.ones(graph.num_edges, dtype=torch.bool)))
    assert bool((found.outlier_score == 1).all())
    assert bool((found.component == 0).all())
    assert float(found.uncertainty[0]) == 0.0
    assert torch.allclose(found.uncertainty[1:], torch.tensor(rotations.RANDOM_VARIANCE).double().sqrt())
