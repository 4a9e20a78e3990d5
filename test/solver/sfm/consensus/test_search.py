"""Another answer, where edges that the first one rejects agree with each other; and no other one elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.algebra.residuals import EdgeResiduals
from rotavg_ros.solver.sfm.consensus.search import CONSENSUS, consensus
from rotavg_ros.view_graph import EdgeLabel

_WITHOUT = "neurora-without-consensus"


def _scans(seed: int, num_nodes: int = 60) -> tuple[ViewGraph, torch.Tensor]:
    """Scans while a sensor turns, registered pairwise: those that fail end near the identity or anywhere."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(6.0, 4.0, num_nodes))
    tilt = rng.normal(0.0, 15.0, (num_nodes, 2))
    truth = Rotation.from_euler("zyx", np.column_stack((yaw, tilt)), degrees=True)
    source, target = np.triu_indices(num_nodes, k=1)
    relative = truth[target] * truth[source].inv()
    count = len(source)
    is_good = rng.random(count) < 0.95 / (1 + np.exp((np.degrees(relative.magnitude()) - 40.0) / 5.0))
    noise = Rotation.from_rotvec(np.radians(0.5) * rng.standard_normal((count, 3)))
    near = Rotation.from_rotvec(np.radians(12.0) * rng.standard_normal((count, 3)))
    anywhere = Rotation.random(count, random_state=seed)
    failed = np.where(rng.random((count, 1)) < 0.6, near.as_quat(), anywhere.as_quat())
    measured = np.where(is_good[:, None], (relative * noise).as_quat(), failed)
    return ViewGraph.create(source, target, measured), torch.from_numpy(truth.as_quat())


def _error(graph: ViewGraph, truth: torch.Tensor, method: str = "neurora") -> float:
    answer = solve(graph, method=method, profile="sfm", device="cpu").body_from_world
    return float(torch.rad2deg(orientation_errors(answer, truth)).mean())


@pytest.mark.large
def test_failed_registrations_that_agree_are_seen_through() -> None:
    """A robust cost alone is drawn to where all scans look alike."""
    found = np.array([[_error(*_scans(seed), method) for method in (_WITHOUT, "neurora")] for seed in range(4)])
    assert (found[:, 0] > 10).all()
    assert (found[:, 1] < 2).all()


def test_it_is_told_and_scores_are_of_the_answer() -> None:
    graph, truth = _scans(0)
    solution = solve(graph, profile="sfm", device="cpu")
    assert any("agree among themselves" in warning for warning in solution.warnings)
    relative = Rotation.from_quat(truth[graph.target]) * Rotation.from_quat(truth[graph.source]).inv()
    noise = np.degrees((relative.inv() * Rotation.from_quat(graph.target_from_source)).magnitude())
    assert (((solution.outlier_score > 0.5).numpy() == (noise > 20)) | (abs(noise - 20) < 5)).mean() > 0.99


def test_neither_names_nor_axes_nor_directions_matter() -> None:
    graph, truth = _scans(1)
    answer = solve(graph, profile="sfm", device="cpu").body_from_world
    axes = Rotation.from_euler("xyz", (40, -70, 110), degrees=True)
    order = np.random.default_rng(0).permutation(graph.num_nodes)
    measured = axes * Rotation.from_quat(graph.target_from_source) * axes.inv()
    turned = ViewGraph.create(order[graph.target], order[graph.source], measured.inv().as_quat())
    again = solve(turned, profile="sfm", device="cpu").body_from_world.numpy()[order]
    there = torch.from_numpy((axes.inv() * Rotation.from_quat(again)).as_quat())
    assert float(torch.rad2deg(orientation_errors(there, answer)).max()) < 1e-3
    assert _error(graph, truth) < 1


@pytest.mark.parametrize(
    "recipe",
    [
        pytest.param(ReleasedRecipe((60, 120)), id="released", marks=pytest.mark.large),
        pytest.param(PaperRecipe((60, 120)), id="paper"),
    ],
)
def test_where_false_edges_do_not_agree_nothing_changes(recipe: ReleasedRecipe | PaperRecipe) -> None:
    for seed in range(6):
        graph = recipe.sample(np.random.default_rng(seed)).graph
        answers = [solve(graph, method=method, profile="sfm", device="cpu") for method in (_WITHOUT, "neurora")]
        assert torch.equal(answers[0].body_from_world, answers[1].body_from_world)
        assert torch.equal(answers[0].outlier_score, answers[1].outlier_score)


def test_components_are_judged_by_themselves() -> None:
    """The second is right as it is, in whatever gauge; the first is not."""
    (one, truth), (other, other_truth) = _scans(2), _scans(3)
    both = ViewGraph.create(
        torch.cat((one.source, other.source + one.num_nodes)),
        torch.cat((one.target, other.target + one.num_nodes)),
        torch.cat((one.target_from_source, other.target_from_source)),
    )
    start = torch.cat((solve(one, method=_WITHOUT, device="cpu").body_from_world, other_truth))
    component = torch.arange(2).repeat_interleave(one.num_nodes)
    found = consensus(both, start, component, CONSENSUS)
    assert found is not None and found.body_from_world is not None and found.weight is not None
    assert torch.equal(found.body_from_world[one.num_nodes :], other_truth)
    assert bool((found.weight[one.num_edges :] == 1).all())
    assert float(torch.rad2deg(orientation_errors(found.body_from_world[: one.num_nodes], truth)).mean()) < 5


def test_labels_count() -> None:
    """What a user accepts is good: it weighs in full, and an answer that contradicts it is not taken."""
    graph, truth = _scans(4)
    first = solve(graph, method=_WITHOUT, device="cpu").body_from_world
    error, residual = (torch.rad2deg(EdgeResiduals(graph, at.float()).angles()) for at in (truth, first))
    beside = (graph.target - graph.source) < 4
    for accepted in (beside & (error < 20), beside & (error > 20) & (residual < 20)):
        label = torch.where(accepted, int(EdgeLabel.ACCEPTED), int(EdgeLabel.AUTOMATIC))
        component = torch.zeros(graph.num_nodes, dtype=torch.int64)
        found = consensus(replace(graph, label=label), first, component, CONSENSUS)
        assert found is not None and found.body_from_world is not None and found.weight is not None
        assert bool((found.weight[accepted] == 1).all())
        found_residual = torch.rad2deg(EdgeResiduals(graph, found.body_from_world.float()).angles())
        assert float(found_residual[accepted].max()) < 20


def test_of_a_graph_that_is_too_large_it_is_said_that_there_may_be_another_answer() -> None:
    graph, _ = _scans(0)
    first = solve(graph, method=_WITHOUT, device="cpu").body_from_world
    small = replace(CONSENSUS, max_nodes=graph.num_nodes - 1)
    found = consensus(graph, first, torch.zeros(graph.num_nodes, dtype=torch.int64), small)
    assert found is not None and found.body_from_world is None
    assert "too large" in found.warnings[0]
