"""Edges that the user has accepted: they bind, and where they cannot it is said."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeLabel, ViewGraph, rotations, solve, solve_batch
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe
from rotavg_ros.metrics import orientation_errors
from test.solver.graphs import as_quaternions, random_truth, small_noise

CAMERAS = 12
TURN = Rotation.from_rotvec([0.0, 1.5, 0.0])
METHODS = ["neurora", "neurora-without-both", "neurora-without-cleannet", "neurora-round", "neurora-half-norm"]


def accepting(graph: ViewGraph, accepted: torch.Tensor) -> ViewGraph:
    return replace(graph, label=torch.where(accepted, int(EdgeLabel.ACCEPTED), int(EdgeLabel.AUTOMATIC)))


def residuals_deg(graph: ViewGraph, body_from_world: torch.Tensor) -> torch.Tensor:
    predicted = rotations.multiply(graph.target_from_source, body_from_world[graph.source])
    return torch.rad2deg(rotations.angle_between(predicted, body_from_world[graph.target]))


def triangle(misfit: float) -> ViewGraph:
    """Three edges, the last of which is off by ``misfit`` rad."""
    truth = random_truth(3, 3)
    relative = [truth[1] * truth[0].inv(), truth[2] * truth[1].inv(), truth[2] * truth[0].inv()]
    relative[2] = Rotation.from_rotvec([misfit, 0, 0]) * relative[2]
    return ViewGraph.create([0, 1, 0], [1, 2, 2], Rotation.concatenate(relative).as_quat())


def beside_a_cluster(true: int, false: int, seed: int = 0) -> tuple[ViewGraph, torch.Tensor, Rotation]:
    """A camera that true edges join to a cluster, and false ones that agree that it is turned. With its edges."""
    inner = np.array(list(combinations(range(CAMERAS), 2)))
    own = np.stack((np.arange(true + false), np.full(true + false, CAMERAS)), axis=1)
    source, target = np.concatenate((inner, own)).T
    truth, number = random_truth(CAMERAS + 1, seed), np.arange(len(source)) - len(inner)
    true_relative = truth[target] * truth[source].inv()
    relative = np.where((number >= true)[:, None], (TURN * true_relative).as_quat(), true_relative.as_quat())
    noisy = small_noise(len(source), 0.3, seed) * Rotation.from_quat(relative)
    return ViewGraph.create(source, target, noisy.as_quat()), torch.from_numpy(number), truth


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [1, 2])
def test_edges_in_series_are_not_to_blame_if_they_are_accepted(method: str, count: int) -> None:
    graph = triangle(1.5)
    accepted = torch.arange(3) < count
    found = solve(accepting(graph, accepted), method=method)
    residual = residuals_deg(graph, found.body_from_world)
    assert float(residual[accepted].max()) < 1
    assert float(residual.sum()) == pytest.approx(np.degrees(1.5), abs=0.1)
    assert float(found.outlier_score[~accepted].min()) > (0.99 if count == 2 else 0.3)
    assert found.warnings == ()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("true", "false"), [(1, 3), (2, 2), (2, 5)])
def test_accepted_edges_hold_a_camera_against_more_that_agree(method: str, true: int, false: int) -> None:
    graph, number, truth = beside_a_cluster(true, false)
    accepted = (number >= 0) & (number < true)
    found = solve(accepting(graph, accepted), method=method)
    errors = torch.rad2deg(orientation_errors(found.body_from_world, as_quaternions(truth)))
    assert float(errors.max()) < 2
    assert bool((found.outlier_score[accepted] == 0).all())
    assert float(found.outlier_score[number >= true].min()) > 0.99
    assert float(torch.rad2deg(found.uncertainty.max())) < 3
    assert found.warnings == ()


def test_labels_bind_in_their_own_component() -> None:
    graph, number, truth = beside_a_cluster(2, 9)
    accepted = (number >= 0) & (number < 2)
    both = ViewGraph.create(
        *(torch.cat((end, end + CAMERAS + 1)) for end in (graph.source, graph.target)),
        graph.target_from_source.repeat(2, 1),
        label=torch.cat((accepted, torch.zeros_like(accepted))).long(),
    )
    errors = [
        float(torch.rad2deg(orientation_errors(part, as_quaternions(truth)).max()))
        for part in solve(both).body_from_world.split(CAMERAS + 1)
    ]
    assert errors[0] < 2
    assert errors[1] > 80


@pytest.mark.parametrize("method", ["spt", "spt-paper", "cleannet-spt"])
def test_trees_run_along_accepted_edges(method: str) -> None:
    """Two chains of accepted edges across a cluster, which no tree of shortest paths would take."""
    graph, number, _ = beside_a_cluster(1, 5)
    is_next = (graph.target - graph.source == 2) & (number < 0)
    accepted = is_next | (number == 0)
    found = solve(accepting(graph, accepted), method=method)
    tolerance = 1e-4 if method != "cleannet-spt" else 20.0  # CleanNet rectifies what it is composed of
    assert float(residuals_deg(graph, found.body_from_world)[accepted].max()) < tolerance


def test_accepting_good_edges_helps() -> None:
    """Sparse pairs, two fifths false, half of the good edges accepted."""
    ratios = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        truth, pairs = random_truth(40, seed), {(i, i + 1) for i in range(39)}
        while len(pairs) < 120:
            low, high = sorted(rng.choice(40, 2, replace=False).tolist())
            pairs.add((low, high))
        source, target = np.array(sorted(pairs)).T
        noise, is_false = small_noise(len(source), 1.0, seed), rng.random(len(source)) < 0.4
        relative = (noise * truth[target] * truth[source].inv()).as_quat()
        relative[is_false] = Rotation.random(int(is_false.sum()), rng).as_quat()
        graph = ViewGraph.create(source, target, relative)
        chosen = torch.from_numpy((rng.random(len(source)) < 0.5) & ~is_false)
        found = [solve(accepting(graph, accepted)).body_from_world for accepted in (torch.zeros_like(chosen), chosen)]
        errors = [float(orientation_errors(one, as_quaternions(truth)).mean()) for one in found]
        ratios.append(errors[1] / errors[0])
        assert float(residuals_deg(graph, found[1])[chosen].max()) < 20
    assert np.exp(np.mean(np.log(ratios))) < 0.9


def test_an_accepted_edge_weighs_as_a_good_one_not_more() -> None:
    """With noise alone it hardly matters to the accuracy which edges are accepted."""
    recipe = PaperRecipe(cameras=(40, 40), pair_share=(0.4, 0.4), outlier_share=(0, 0), noise_deg=(2, 2))
    ratios = []
    for seed in range(4):
        sample = recipe.sample(np.random.default_rng(seed))
        chosen = torch.arange(sample.graph.num_edges) % 4 == 0
        graphs = sample.graph, accepting(sample.graph, chosen)
        errors = [orientation_errors(solve(graph).body_from_world, sample.body_from_world).mean() for graph in graphs]
        ratios.append(float(errors[1] / errors[0]))
    assert np.mean(ratios) < 1.05


def test_accepted_edges_that_contradict_each_other_are_told() -> None:
    graph = triangle(1.5)
    (warning,) = solve(accepting(graph, torch.ones(3, dtype=torch.bool))).warnings
    assert warning.startswith("3 of 3 accepted edges are more than 20° off in the answer, up to 29°")
    assert solve(accepting(triangle(0.1), torch.ones(3, dtype=torch.bool))).warnings == ()
    (first, second) = solve_batch([accepting(each, torch.ones(3, dtype=torch.bool)) for each in (graph, triangle(0.1))])
    assert (first.warnings, second.warnings) == ((warning,), ())
