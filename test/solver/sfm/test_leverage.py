"""How uncertain cameras are whose answer follows the few edges that they have."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.baselines.least_squares import least_squares
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.sfm.refinement import PRIORS
from rotavg_ros.solver.sfm.step.measure import Measure
from rotavg_ros.solver.sfm.step.problem import Dispersion, Problem
from rotavg_ros.solver.sfm.step.structure import Structure
from test.solver.graphs import as_quaternions, measured, random_truth, small_noise


def circle(cameras: int, reach: int, deg: float, seed: int = 0) -> tuple[ViewGraph, Rotation]:
    """Cameras on a circle, each joined to those up to ``reach`` places on; normal noise."""
    truth, source = random_truth(cameras, seed), np.tile(np.arange(cameras), reach)
    target = (source + np.repeat(np.arange(1, reach + 1), cameras)) % cameras
    return measured(truth, source, target, small_noise(len(source), deg, seed)), truth


def grid(side: int, deg: float, seed: int) -> tuple[ViewGraph, Rotation]:
    """Cameras in a square, each joined to those beside it, one row on and across; Laplacian noise."""
    node = np.arange(side * side).reshape(side, side)
    ends = ((node[:-1], node[1:]), (node[:, :-1], node[:, 1:]), (node[:-1, :-1], node[1:, 1:]))
    source, target = (np.concatenate([pair[end].ravel() for pair in ends]) for end in (0, 1))
    rng, truth = np.random.default_rng(seed), random_truth(side * side, seed)
    vector = np.radians(deg) * rng.normal(size=(len(source), 3)) * rng.exponential(size=(len(source), 1)) ** 0.5
    return measured(truth, source, target, Rotation.from_rotvec(vector)), truth


def dispersion(graph: ViewGraph, orientations: torch.Tensor, total: torch.Tensor | None) -> Dispersion:
    """Of least squares: all edges weigh 1."""
    problem = Problem(graph, Structure.of(graph), PRIORS)
    measure = Measure(
        problem.round, problem.variance_of_means(), lambda square, _: torch.ones_like(square), problem.everywhere(False)
    )
    sample = problem.sample(orientations)
    return problem.dispersion(sample, measure, torch.ones(graph.num_edges, dtype=torch.float64), total)


@pytest.mark.parametrize(("cameras", "reach"), [(30, 1), (30, 2), (30, 5), (7, 3)])
def test_where_cameras_are_alike_it_is_that_of_least_squares(cameras: int, reach: int) -> None:
    """Squared residuals over the number of edges beyond a tree, whether weights are known or not."""
    graph, _ = circle(cameras, reach, 2.0)
    answer = least_squares(graph, np.ones(graph.num_edges, dtype=bool))
    redundancy = graph.num_edges - cameras + 1
    for total in (None, torch.full((cameras,), 2.0 * reach, dtype=torch.float64)):
        found = dispersion(graph, answer, total)
        assert float(found.of_errors) == pytest.approx(float(found.of_residuals) * graph.num_edges / redundancy)


def test_on_a_tree_it_is_finite() -> None:
    truth, source = random_truth(6, 0), np.arange(5)
    graph = measured(truth, source, source + 1, small_noise(5, 2.0, 0))
    found = dispersion(graph, as_quaternions(truth), None)
    assert torch.isfinite(found.of_errors).all()


def test_cameras_of_few_edges_do_not_follow_them() -> None:
    """Errors beside those of least squares, which knows that no edge is false: .98 times; 1.09 without leverages."""
    ratios = []
    for seed in range(6):
        graph, truth = grid(8, 2.0, seed)
        answers = solve(graph).body_from_world, least_squares(graph, np.ones(graph.num_edges, dtype=bool))
        errors = [float(orientation_errors(one, as_quaternions(truth)).mean()) for one in answers]
        ratios.append(errors[0] / errors[1])
    assert np.exp(np.mean(np.log(ratios))) < 1.04
