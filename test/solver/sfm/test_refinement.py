"""Refinement that knows the noise's shape, and what it is made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csc_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, rotations, solve
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.sfm import refinement
from rotavg_ros.solver.sfm.laplacians import block
from rotavg_ros.solver.sfm.laplacians.block import Arrivals, BlockLaplacian, SplitWeights, factorised
from rotavg_ros.solver.sfm.noise_shape import NoiseShape, scatter
from rotavg_ros.solver.sfm.step.measure import Measure, l1_weight
from rotavg_ros.solver.sfm.step.problem import Problem
from rotavg_ros.solver.sfm.step.structure import Structure
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
    weights = SplitWeights(weight, torch.from_numpy(rng.uniform(0, 1, graph.num_edges)))
    factors = rng.standard_normal((41, 3, 3))
    information = factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(3)
    shape = NoiseShape(torch.from_numpy(information).permute(1, 2, 0))
    dense = np.zeros((41, 3, 41, 3))
    for edge in range(graph.num_edges):
        u, v = int(graph.source[edge]), int(graph.target[edge])
        share = float(weights.source_share[edge])
        block = float(weight[edge]) * (share * information[u] + (1 - share) * information[v])
        for row, column, sign in ((u, u, 1), (v, v, 1), (u, v, -1), (v, u, -1)):
            dense[row, :, column] += sign * block
    system = BlockLaplacian(Arrivals(SortedEdges.of(graph)), weights, shape, graph.components())
    x = torch.from_numpy(rng.standard_normal((3, 41)))
    force = np.einsum("uivj,jv->iu", dense, x.numpy())
    np.testing.assert_allclose(system.product(x), force, atol=1e-9)

    roots = _roots(graph)
    mean_weight = weight * shape.information.diagonal().sum(dim=1)[graph.source] / 3
    precondition = factorised(graph, mean_weight, roots) if is_factorised else system.diagonal_solve()
    found, is_solved = system.solve(torch.from_numpy(force), precondition, 1e-12, 0.0)
    assert is_solved is None
    root = roots[graph.components()]
    np.testing.assert_allclose(found - found[:, root], x - x[:, root], atol=1e-8)


def test_scatter_finds_each_groups_shape_among_outliers() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([np.diag([9.0, 4.0, 0.25]), [[2.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 1.0]]]) * 1e-3
    group = torch.from_numpy(rng.integers(0, 2, 12_000))
    vectors = np.einsum("kij,kj->ki", np.linalg.cholesky(covariance)[group], rng.standard_normal((len(group), 3)))
    wrong = rng.random(len(group)) < 0.1
    vectors[wrong] = Rotation.random(int(wrong.sum()), rng).as_rotvec()
    elsewhere = np.einsum("kij,kj->ki", Rotation.random(len(vectors), rng).as_matrix(), vectors)
    is_first = rng.random(len(vectors)) < 0.5
    frames = [np.where(here[:, None], vectors, elsewhere) for here in (is_first, ~is_first)]
    found = scatter((torch.from_numpy(frames[0].T.copy()), torch.from_numpy(frames[1].T.copy())), group, 3).numpy()
    for number in range(2):
        expected = covariance[number] / np.trace(covariance[number])
        np.testing.assert_allclose(found[number] / np.trace(found[number]), expected, atol=0.05)
    assert np.isfinite(found[2]).all()  # nobody is in the last group


def test_noise_that_is_exact_about_one_axis_is_made_use_of() -> None:
    graph, truth = _crowd(3)
    start = as_quaternions(Rotation.from_rotvec(0.1 * np.random.default_rng(0).standard_normal((80, 3))) * truth)
    shaped = refinement.refine(graph, start)
    round_noise = refinement.refine(graph, start, priors=refinement.ROUND)
    assert _mean_error_deg(shaped, truth) < 0.6 * _mean_error_deg(round_noise, truth)


def test_round_noise_costs_nothing() -> None:
    graph, truth = _crowd(4, sd_deg=(6, 6, 6))
    start = as_quaternions(truth)
    shaped = refinement.refine(graph, start)
    round_noise = refinement.refine(graph, start, priors=refinement.ROUND)
    assert _mean_error_deg(shaped, truth) < 1.05 * _mean_error_deg(round_noise, truth)


def test_exact_measurements_give_exact_orientations() -> None:
    """Although a tenth of the edges is wrong."""
    graph, truth = _crowd(9, sd_deg=(0, 0, 0))
    start = as_quaternions(Rotation.from_rotvec(0.05 * np.random.default_rng(0).standard_normal((80, 3))) * truth)
    assert _mean_error_deg(refinement.refine(graph, start), truth) < 1e-4


def test_a_bad_start_takes_more_coarse_steps() -> None:
    graph, truth = _crowd(5)
    lost = Rotation.from_rotvec(0.7 * np.random.default_rng(1).standard_normal((80, 3)))
    near = refinement.refine(graph, as_quaternions(truth))
    far = refinement.refine(graph, as_quaternions(lost * truth))
    assert _mean_error_deg(far, truth) < 1.25 * _mean_error_deg(near, truth)


def test_directions_and_order_of_edges_do_not_matter() -> None:
    graph, truth = _crowd(6)
    rng = np.random.default_rng(0)
    start = as_quaternions(Rotation.from_rotvec(0.05 * rng.standard_normal((80, 3))) * truth)
    expected = refinement.refine(graph, start)
    backwards = replace(
        graph,
        source=graph.target,
        target=graph.source,
        target_from_source=rotations.inverse(graph.target_from_source),
    )
    shuffled = backwards.select_edges(torch.from_numpy(rng.permutation(graph.num_edges)))
    assert float(rotations.angle_between(refinement.refine(shuffled, start), expected).max()) < 1e-4


def test_components_are_refined_as_if_alone() -> None:
    graphs = [_crowd(7, 60)[0], _crowd(8, 40, (1, 1, 0.2))[0]]
    starts = [as_quaternions(_crowd(7, 60)[1]), rotations.random(40, generator=torch.Generator().manual_seed(0))]
    together = refinement.refine(_side_by_side(*graphs), torch.cat(starts))
    alone = [refinement.refine(graph, start) for graph, start in zip(graphs, starts, strict=True)]
    assert float(rotations.angle_between(together, torch.cat(alone)).max()) < 1e-6


def test_a_street_takes_a_factorisation() -> None:
    """Each camera sees the next two alone: conjugate gradients by themselves would not get to the end."""
    rng = np.random.default_rng(0)
    truth = random_truth(600, 0)
    source = np.repeat(np.arange(598), 2)
    graph = measured(truth, source, source + np.tile([1, 2], 598))
    turned = Rotation.from_rotvec(0.02 * rng.standard_normal((600, 3))) * truth
    refined = refinement.refine(graph, as_quaternions(turned))
    assert _mean_error_deg(refined, truth) < 0.01


def test_a_coarse_step_along_a_long_ring_is_scipys_least_squares() -> None:
    """Where edges weigh differently by up to a million, single precision would turn cameras by anything."""
    cameras, rng = 2000, np.random.default_rng(0)
    source, truth = np.tile(np.arange(cameras), 2), random_truth(cameras, 0)
    target = (source + np.repeat([1, 2], cameras)) % cameras
    noise = Rotation.from_rotvec(0.01 * rng.standard_normal((len(source), 3)))
    graph, prior = measured(truth, source, target, noise), 10 ** rng.uniform(-6, 0, len(source))
    problem = Problem(graph, Structure.of(graph), refinement.PRIORS)
    measure = Measure(problem.round, problem.evenly(5e-5), l1_weight, np.array([True]))
    step = problem.step(as_quaternions(truth), measure, torch.from_numpy(prior), torch.tensor([True]))

    residual = (truth[target].inv() * Rotation.from_quat(graph.target_from_source.numpy()) * truth[source]).as_rotvec()
    weight = prior / np.sqrt((residual**2).sum(axis=1) + 1e-4)
    incidence = csc_array(
        (np.tile([1.0, -1.0], len(source)), np.stack((target, source), 1).ravel(), 2 * np.arange(len(source) + 1))
    )
    free = incidence[1:]  # the first camera is held fixed
    expected = np.zeros((3, cameras))
    expected[:, 1:] = spsolve(csc_array((free * weight) @ free.T), (free * weight) @ residual).T
    np.testing.assert_allclose(step.turn, expected, atol=0.03 * np.abs(expected).max())


def test_a_step_that_is_not_solved_for_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """One iteration is enough for round noise, with a factorisation, but not for noise that has a shape."""
    graph, truth = _crowd(3, 30)
    start = rotations.canonical(_disturbed(as_quaternions(truth), 3.0, 0))
    problem = Problem(graph, Structure.of(graph), refinement.PRIORS)
    ones = torch.ones(graph.num_edges)
    monkeypatch.setattr(block, "MAX_ITERATIONS", 1)
    settled = refinement.shaped_steps(problem, start, refinement.EdgeWeights(ones, ones), 10)
    torch.testing.assert_close(rotations.canonical(settled.orientations), start, atol=1e-12, rtol=0)
    found, _ = refinement.coarse_steps(problem, start, ones)
    assert _mean_error_deg(found, truth) < _mean_error_deg(start, truth)


def test_rejected_edges_have_no_say() -> None:
    sample = PaperRecipe(cameras=(60, 60), pair_share=(0.4, 0.4), outlier_share=(0.3, 0.3)).sample(
        np.random.default_rng(0)
    )
    label = torch.where(sample.is_outlier, EdgeLabel.REJECTED, EdgeLabel.AUTOMATIC)
    told = solve(replace(sample.graph, label=label), profile="sfm")
    without = solve(sample.graph.select_edges(~sample.is_outlier), profile="sfm")
    errors = [_mean_error_deg(x.body_from_world, Rotation.from_quat(sample.body_from_world)) for x in (told, without)]
    assert errors[0] < 1.2 * errors[1]


def _scan(seed: int) -> tuple[ViewGraph, torch.Tensor]:
    """A graph of the paper's recipe, and its true orientations."""
    sample = PaperRecipe(cameras=(120, 120), noise_deg=(10, 10), outlier_share=(0.2, 0.2)).sample(
        np.random.default_rng(seed)
    )
    return sample.graph, sample.body_from_world


def _root_mean_square_deg(angles: torch.Tensor) -> float:
    return float(torch.rad2deg(angles).square().mean().sqrt())


def steps(most: int) -> refinement.RefinementPriors:
    return replace(refinement.PRIORS, max_steps=most)


def _disturbed(truth: torch.Tensor, sd_deg: float, seed: int) -> torch.Tensor:
    noise = np.radians(sd_deg) * np.random.default_rng(seed).standard_normal((len(truth), 3))
    return rotations.multiply(truth, rotations.exp(torch.from_numpy(noise)))


@pytest.mark.parametrize("seed", [10, 11, 12])
def test_what_lies_ahead_of_the_last_step_is_little(seed: int) -> None:
    """Medians: a camera of few edges may hang between two places for long."""
    graph, truth = _scan(seed)
    start = _disturbed(truth, 5, seed)
    refined = refinement.refine(graph, start)
    tight = replace(refinement.PRIORS, max_steps=300, converged=1e-3, converged_angle=1e-9)
    limit = refinement.refine(graph, start, priors=tight)
    error = orientation_errors(limit, truth).median()
    assert float(orientation_errors(refined, limit).median()) < 0.1 * float(error)
    too_early = refinement.refine(graph, start, priors=steps(4))  # three shaped steps, as many as there used to be
    assert float(orientation_errors(too_early, limit).median()) > 0.2 * float(error)


def test_steps_are_bounded_and_more_than_needed_are_not_taken() -> None:
    graph, truth = _scan(13)
    start = _disturbed(truth, 5, 13)
    assert torch.equal(refinement.refine(graph, start, priors=steps(0)), start)
    answers = [refinement.refine(graph, start, priors=steps(most)) for most in (1, 2, 3, 60, 120)]
    for number in range(3):
        assert float(rotations.angle_between(answers[number], answers[number + 1]).max()) > 1e-4
    assert torch.equal(answers[3], answers[4])


def test_neither_the_worlds_nor_the_cameras_frame_matters() -> None:
    """The cameras' frames: rel → A rel A⁻¹, R → A R; the world's: R → R G. Conjugate gradients leave a difference."""
    graph, truth = _scan(14)
    start = _disturbed(truth, 5, 14)
    expected = refinement.refine(graph, start)
    axes, gauge = rotations.random(2, generator=torch.Generator().manual_seed(0))
    turned = rotations.multiply(rotations.multiply(axes, graph.target_from_source), rotations.inverse(axes))
    found = refinement.refine(
        replace(graph, target_from_source=turned), rotations.multiply(rotations.multiply(axes, start), gauge)
    )
    back = rotations.multiply(rotations.multiply(rotations.inverse(axes), found), rotations.inverse(gauge))
    assert float(torch.rad2deg(rotations.angle_between(back, expected)).max()) < 0.03


def test_the_networks_liking_for_a_frame_is_gone_in_the_end() -> None:
    """They know the axes of their generators' noise, and start far off in another frame."""
    graph, truth = _scan(15)
    quarter = rotations.exp(torch.tensor([[0.0, 0.0, np.pi / 2]], dtype=torch.float64))
    turned = rotations.multiply(rotations.multiply(quarter, graph.target_from_source), rotations.inverse(quarter))
    as_it_is = solve(graph, profile="sfm").body_from_world
    other = solve(replace(graph, target_from_source=turned), profile="sfm").body_from_world
    difference = orientation_errors(rotations.multiply(rotations.inverse(quarter), other), as_it_is)
    assert _root_mean_square_deg(difference) < 0.3 * _root_mean_square_deg(orientation_errors(as_it_is, truth))


def test_a_camera_of_few_edges_does_not_follow_the_one_that_happens_to_fit() -> None:
    """Of three edges that disagree by their noise, none is exact, so that the camera comes to lie between them."""
    graph, truth = _crowd(16, sd_deg=(4, 4, 4))
    known = as_quaternions(truth)
    rng = np.random.default_rng(16)
    lonely = 79
    touches = (graph.source == lonely) | (graph.target == lonely)
    kept = torch.ones(graph.num_edges, dtype=torch.bool)
    kept[touches.nonzero().squeeze(1)[3:]] = False
    few = graph.select_edges(kept)
    answers = [
        refinement.refine(few, rotations.multiply(known, rotations.exp(torch.from_numpy(noise))))[lonely]
        for noise in np.radians(4) * rng.standard_normal((5, 80, 3)) * (np.arange(80) == lonely)[:, None]
    ]
    spread = rotations.angle_between(torch.stack(answers[1:]), answers[0].expand(4, 4))
    assert float(torch.rad2deg(spread).max()) < 0.5
