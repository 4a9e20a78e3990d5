"""Refinement's two ways to solve its systems: conjugate gradients and factorisation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, rotations
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe
from rotavg_ros.solver.algebra.conjugate_gradients import NotConvergedError, WeightedAdjacency, solve_laplacian
from rotavg_ros.solver.algebra.laplacian import LaplacianSystem
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.sfm import round_refinement as refinement
from rotavg_ros.view_graph import EdgeKind
from test.solver.graphs import as_quaternions, measured, random_truth


def _band(num_nodes: int, reach: int) -> ViewGraph:
    """A street: every node sees the next few, so that what is far apart is badly knit together."""
    step = np.arange(1, reach + 1)
    source = np.repeat(np.arange(num_nodes), reach)
    target = source + np.tile(step, num_nodes)
    inside = target < num_nodes
    noise = Rotation.from_rotvec(0.05 * np.random.default_rng(0).standard_normal((int(inside.sum()), 3)))
    return measured(random_truth(num_nodes, 0), source[inside], target[inside], noise)


def _two_components() -> ViewGraph:
    parts = [
        PaperRecipe(cameras=(60, 60), pair_share=(0.4, 0.4)).sample(np.random.default_rng(seed)).graph
        for seed in (0, 1)
    ]
    source, target = (torch.cat((getattr(parts[0], end), getattr(parts[1], end) + 60)) for end in ("source", "target"))
    return ViewGraph.create(source, target, torch.cat([part.target_from_source for part in parts]))


@pytest.mark.parametrize("graph", [_two_components(), _band(400, 8)], ids=["well-knit", "falls-back"])
def test_both_ways_give_the_same_orientations(monkeypatch: pytest.MonkeyPatch, graph: ViewGraph) -> None:
    start = rotations.random(graph.num_nodes, generator=torch.Generator().manual_seed(0))
    component = graph.components()
    roots = np.unique(component.numpy(), return_index=True)[1]
    answers = []
    for iterate in (True, False):
        monkeypatch.setattr(refinement, "_iterating_is_cheaper", lambda _, iterate=iterate: iterate)
        answers.append(refinement.refine(graph, start, None, roots, 3))
    assert float(rotations.angle_between(*answers).max()) < 1e-6
    # The roots stay where they were.
    assert float(rotations.angle_between(answers[0][roots], start[roots]).max()) < 1e-12


def test_conjugate_gradients_are_numpys_least_squares() -> None:
    graph = _two_components()
    rng = np.random.default_rng(0)
    weight, difference = rng.uniform(0.01, 10, graph.num_edges), rng.standard_normal((graph.num_edges, 3))
    incidence = np.zeros((graph.num_edges, graph.num_nodes))
    incidence[np.arange(graph.num_edges), graph.target] = 1
    incidence[np.arange(graph.num_edges), graph.source] = -1
    root_weight = np.sqrt(weight)[:, None]
    expected, *_ = np.linalg.lstsq(root_weight * incidence, root_weight * difference)
    adjacency = WeightedAdjacency(SortedEdges.of(graph), torch.from_numpy(weight))
    found = solve_laplacian(adjacency, torch.from_numpy(incidence.T @ (weight[:, None] * difference))).numpy()
    for part in (slice(0, 60), slice(60, 120)):
        np.testing.assert_allclose(found[part] - found[part][0], expected[part] - expected[part][0], atol=1e-8)


def test_a_badly_knit_graph_is_given_up() -> None:
    graph = _band(3000, 2)
    adjacency = WeightedAdjacency(SortedEdges.of(graph), torch.ones(graph.num_edges, dtype=torch.float64))
    pull = torch.zeros(3000, 1, dtype=torch.float64)
    pull[0], pull[-1] = 1.0, -1.0
    with pytest.raises(NotConvergedError):
        solve_laplacian(adjacency, pull)


def test_the_choice_knows_chains_from_crowds() -> None:
    crowd = PaperRecipe(cameras=(600, 600), pair_share=(0.2, 0.2)).sample(np.random.default_rng(0)).graph
    assert refinement._iterating_is_cheaper(crowd)
    assert not refinement._iterating_is_cheaper(_band(600, 3))


def test_a_dense_factorisation_and_a_sparse_one_agree_with_iteration() -> None:
    graph = PaperRecipe(cameras=(100, 100), pair_share=(0.3, 0.3)).sample(np.random.default_rng(3)).graph
    ends = graph.source.numpy(), graph.target.numpy()
    weight = np.random.default_rng(4).uniform(1e-6, 1e3, graph.num_edges)
    difference = np.random.default_rng(5).standard_normal((graph.num_edges, 2))
    system = LaplacianSystem(100, *ends, weight, np.array([7]))
    force = torch.from_numpy(system.incidence_sum(weight[:, None] * difference))
    found = solve_laplacian(WeightedAdjacency(SortedEdges.of(graph), torch.from_numpy(weight)), force).numpy()
    np.testing.assert_allclose(found - found[7], system.fit(difference), atol=1e-7)


def test_kinds_do_not_matter() -> None:
    """Refinement of SfM graphs sees measurements, not what measured them."""
    truth = random_truth(30, 2)
    source = np.repeat(np.arange(29), 1)
    graph = measured(truth, source, source + 1, kind=np.full(29, EdgeKind.ODOMETRY))
    start = as_quaternions(truth)
    refined = refinement.refine(graph, start, None, np.array([0]), 2)
    assert float(rotations.angle_between(refined, start).max()) < 1e-7
