"""Refinement that knows the noise's shape, and what it is made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, rotations, solve
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.sfm import refinement as sfm_refinement
from rotavg_ros.solver.sfm import round_refinement as refinement
from rotavg_ros.solver.sfm.block_laplacian import Arrivals, BlockLaplacian, factorised
from rotavg_ros.solver.sfm.noise_shape import NoiseShape, scatter
from rotavg_ros.view_graph import EdgeLabel
from test.solver.graphs import as_quaternions, measured, random_truth


def _roots(graph: ViewGraph) -> torch.Tensor:
    return torch.from_numpy(np.unique(graph.components().numpy(), return_index=True)[1])


def _crowd(
    seed: int, cameras: int = 80, sd_deg: tuple[float, float, float] = (8, 5, 0.5)
) -> tuple[ViewGraph, Rotation]:
    """Cameras that see two fifths of each other, a tenth of it wrong, with noise in the source camera's frame."""
    rng = np.random.default_rng(seed)
    source, target = np.triu_indices(cameras, k=1)
    seen = rng.random(len(source)) < 0.4
    noise = Rotation.from_rotvec(np.radians(sd_deg) * rng.standard_normal((int(seen.sum()), 3)))
    wrong = rng.random(len(noise)) < 0.1
    noise = Rotation.from_quat(np.where(wrong[:, None], Rotation.random(len(noise), rng).as_quat(), noise.as_quat()))
    truth = random_truth(cameras, seed)
    return measured(truth, source[seen], target[seen], noise), truth


def _mean_error_deg(orientations: torch.Tensor, truth: Rotation) -> float:
    return float(torch.rad2deg(orientation_errors(orientations, as_quaternions(truth))).mean())


def _side_by_side(one: ViewGraph, other: ViewGraph) -> ViewGraph:
    source, target = (
        torch.cat((getattr(one, end), getattr(other, end) + one.num_nodes)) for end in ("source", "target")
    )
    return ViewGraph.create(source, target, torch.cat((one.target_from_source, other.target_from_source)))


@pytest.mark.parametrize("is_factorised", [False, True])
def test_block_systems_are_numpys_least_squares(is_factorised: bool) -> None:
    graph = _side_by_side(_crowd(0, 25)[0], _crowd(1, 15)[0])
    graph = replace(graph, num_nodes=41)  # the last node has no edge
    rng = np.random.default_rng(2)
    weight = torch.from_numpy(rng.uniform(0.1, 10, graph.num_edges))
    factors = rng.standard_normal((2, 41, 3, 3))
    shape = NoiseShape(*(torch.from_numpy(f @ f.transpose(0, 2, 1) + 0.1 * np.eye(3)) for f in factors))
    dense = np.zeros((41, 3, 41, 3))
    for edge in range(graph.num_edges):
        u, v = int(graph.source[edge]), int(graph.target[edge])
        block = float(weight[edge]) * (shape.at_source[u] + shape.at_target[v]).numpy()
        for row, column, sign in ((u, u, 1), (v, v, 1), (u, v, -1), (v, u, -1)):
            dense[row, :, column] += sign * block
    system = BlockLaplacian(Arrivals(SortedEdges.of(graph)), weight, shape, graph.components())
    x = torch.from_numpy(rng.standard_normal((3, 41)))
    force = np.einsum("uivj,jv->iu", dense, x.numpy())
    np.testing.assert_allclose(system.product(x), force, atol=1e-9)

    roots = _roots(graph)
    precondition = factorised(graph, weight, shape, roots) if is_factorised else system.diagonal_solve()
    found, is_solved = system.solve(torch.from_numpy(force), precondition, 1e-12, 0.0)
    assert is_solved
    root = roots[graph.components()]
    np.testing.assert_allclose(found - found[:, root], x - x[:, root], atol=1e-8)


def test_scatter_finds_each_groups_shape_among_outliers() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([np.diag([9.0, 4.0, 0.25]), [[2.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 1.0]]]) * 1e-3
    group = torch.from_numpy(rng.integers(0, 2, 12_000))
    vectors = np.einsum("kij,kj->ki", np.linalg.cholesky(covariance)[group], rng.standard_normal((len(group), 3)))
    wrong = rng.random(len(group)) < 0.1
    vectors[wrong] = Rotation.random(int(wrong.sum()), rng).as_rotvec()
    found = scatter(torch.from_numpy(vectors), group, 3).numpy()
    for number in range(2):
        expected = covariance[number] / np.trace(covariance[number])
        np.testing.assert_allclose(found[number] / np.trace(found[number]), expected, atol=0.05)
    assert np.isfinite(found[2]).all()  # nobody is in the last group


def test_noise_that_is_exact_about_one_axis_is_made_use_of() -> None:
    graph, truth = _crowd(3)
    start = as_quaternions(Rotation.from_rotvec(0.1 * np.random.default_rng(0).standard_normal((80, 3))) * truth)
    shaped = sfm_refinement.refine(graph, start, _roots(graph))
    round_noise = refinement.refine(graph, start, None, _roots(graph), 20)
    assert _mean_error_deg(shaped, truth) < 0.6 * _mean_error_deg(round_noise, truth)


def test_round_noise_costs_nothing() -> None:
    graph, truth = _crowd(4, sd_deg=(6, 6, 6))
    start = as_quaternions(truth)
    shaped = sfm_refinement.refine(graph, start, _roots(graph))
    round_noise = refinement.refine(graph, start, None, _roots(graph), 20)
    assert _mean_error_deg(shaped, truth) < 1.05 * _mean_error_deg(round_noise, truth)


def test_exact_measurements_give_exact_orientations() -> None:
    """Although a tenth of the edges is wrong."""
    graph, truth = _crowd(9, sd_deg=(0, 0, 0))
    start = as_quaternions(Rotation.from_rotvec(0.05 * np.random.default_rng(0).standard_normal((80, 3))) * truth)
    assert _mean_error_deg(sfm_refinement.refine(graph, start, _roots(graph)), truth) < 1e-4


def test_a_bad_start_takes_more_coarse_steps() -> None:
    graph, truth = _crowd(5)
    lost = Rotation.from_rotvec(0.7 * np.random.default_rng(1).standard_normal((80, 3)))
    near = sfm_refinement.refine(graph, as_quaternions(truth), _roots(graph))
    far = sfm_refinement.refine(graph, as_quaternions(lost * truth), _roots(graph))
    assert _mean_error_deg(far, truth) < 1.25 * _mean_error_deg(near, truth)


def test_directions_and_order_of_edges_do_not_matter() -> None:
    graph, truth = _crowd(6)
    rng = np.random.default_rng(0)
    start = as_quaternions(Rotation.from_rotvec(0.05 * rng.standard_normal((80, 3))) * truth)
    expected = sfm_refinement.refine(graph, start, _roots(graph))
    backwards = replace(
        graph,
        source=graph.target,
        target=graph.source,
        target_from_source=rotations.inverse(graph.target_from_source),
    )
    shuffled = backwards.select_edges(torch.from_numpy(rng.permutation(graph.num_edges)))
    assert float(rotations.angle_between(sfm_refinement.refine(shuffled, start, _roots(graph)), expected).max()) < 1e-4


def test_components_are_refined_as_if_alone() -> None:
    graphs = [_crowd(7, 60)[0], _crowd(8, 40, (1, 1, 0.2))[0]]
    starts = [as_quaternions(_crowd(7, 60)[1]), rotations.random(40, generator=torch.Generator().manual_seed(0))]
    together = sfm_refinement.refine(_side_by_side(*graphs), torch.cat(starts), torch.tensor([0, 60]))
    alone = [sfm_refinement.refine(graph, start, _roots(graph)) for graph, start in zip(graphs, starts, strict=True)]
    assert float(rotations.angle_between(together, torch.cat(alone)).max()) < 1e-6


def test_a_street_takes_a_factorisation() -> None:
    """Each camera sees the next two alone: conjugate gradients by themselves would not get to the end."""
    rng = np.random.default_rng(0)
    truth = random_truth(600, 0)
    source = np.repeat(np.arange(598), 2)
    graph = measured(truth, source, source + np.tile([1, 2], 598))
    turned = Rotation.from_rotvec(0.02 * rng.standard_normal((600, 3))) * truth
    refined = sfm_refinement.refine(graph, as_quaternions(turned), _roots(graph))
    assert _mean_error_deg(refined, truth) < 0.01


def test_rejected_edges_have_no_say() -> None:
    sample = PaperRecipe(cameras=(60, 60), pair_share=(0.4, 0.4), outlier_share=(0.3, 0.3)).sample(
        np.random.default_rng(0)
    )
    label = torch.where(sample.is_outlier, EdgeLabel.REJECTED, EdgeLabel.AUTOMATIC)
    told = solve(replace(sample.graph, label=label), profile="sfm")
    without = solve(sample.graph.select_edges(~sample.is_outlier), profile="sfm")
    errors = [_mean_error_deg(x.body_from_world, Rotation.from_quat(sample.body_from_world)) for x in (told, without)]
    assert errors[0] < 1.2 * errors[1]
