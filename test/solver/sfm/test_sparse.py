"""Few edges that check each other, between cameras that look every way: CleanNet alone may lead into a wrong valley."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.utils._python_dispatch import TorchDispatchMode

from rotavg_ros import ViewGraph, solve
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.neurora.stages import trust_all
from rotavg_ros.solver.neurora.tree import bootstrap
from rotavg_ros.solver.sfm.refinement import EdgeWeights, refine
from rotavg_ros.solver.sfm.starts.choice import Start, begin, settle_best
from rotavg_ros.solver.sfm.starts.spectral import spectral
from rotavg_ros.solver.sfm.step.structure import Structure
from test.solver.graphs import as_quaternions, measured, random_truth


def ring(seed: int, cameras: int, reach: int, false_share: float) -> tuple[ViewGraph, Rotation]:
    """Each camera joined to the next ones around and, now and then, across; noise of 2°."""
    rng = np.random.default_rng(seed)
    near = [(i, (i + k) % cameras) for i in range(cameras) for k in range(1, reach + 1)]
    across = [tuple(rng.choice(cameras, 2, replace=False)) for _ in range(cameras // 4)]
    source, target = np.unique(np.sort(np.array(near + across), axis=1), axis=0).T
    noise = Rotation.from_rotvec(np.radians(2.0) * rng.normal(size=(len(source), 3)))
    is_false = rng.random(len(source)) < false_share
    anyhow = Rotation.random(len(source), rng).as_quat()
    noise = Rotation.from_quat(np.where(is_false[:, None], anyhow, noise.as_quat()))
    truth = random_truth(cameras, seed)
    return measured(truth, source, target, noise), truth


def error_deg(graph: ViewGraph, truth: Rotation, method: str) -> float:
    errors = orientation_errors(solve(graph, method=method).body_from_world, as_quaternions(truth))
    return float(torch.rad2deg(errors).mean())


@pytest.mark.parametrize(
    ("cameras", "reach", "false_share"), [(40, 4, 0.2), pytest.param(100, 3, 0.05, marks=pytest.mark.large)]
)
def test_it_is_no_worse_than_without_cleannet(cameras: int, reach: int, false_share: float) -> None:
    graphs = [ring(seed, cameras, reach, false_share) for seed in range(8)]
    ours, without = (
        np.array([error_deg(graph, truth, method) for graph, truth in graphs])
        for method in ("neurora", "neurora-without-cleannet")
    )
    assert ours.mean() < 1.1 * without.mean()
    assert ours.max() < 2 * without.max()


def anyhow(seed: int, cameras: int, degree: int, false_share: float) -> tuple[ViewGraph, Rotation]:
    """Pairs of cameras drawn by chance, noise of 2°."""
    rng = np.random.default_rng(seed)
    pairs = np.array([(i, j) for i in range(cameras) for j in range(i + 1, cameras)])
    path = np.stack((np.arange(cameras - 1), np.arange(1, cameras)), axis=1)
    drawn = pairs[rng.choice(len(pairs), cameras * degree // 2, replace=False)]
    source, target = np.unique(np.concatenate((path, drawn)), axis=0).T
    noise = Rotation.from_rotvec(np.radians(2.0) * rng.normal(size=(len(source), 3))).as_quat()
    is_false = rng.random(len(source)) < false_share
    noise = Rotation.from_quat(np.where(is_false[:, None], Rotation.random(len(source), rng).as_quat(), noise))
    truth = random_truth(cameras, seed)
    return measured(truth, source, target, noise), truth


def twice(graph: ViewGraph) -> ViewGraph:
    """Two components, each the whole graph."""
    ends = (torch.cat((end, end + graph.num_nodes)) for end in (graph.source, graph.target))
    return ViewGraph.create(*ends, graph.target_from_source.repeat(2, 1))


def test_each_component_goes_on_from_the_better_start() -> None:
    graph, truth = anyhow(0, 100, 11, 0.5)
    both = twice(graph)
    exact, wrong = as_quaternions(truth), as_quaternions(random_truth(100, 5))
    ones = torch.ones(both.num_edges, dtype=torch.float64)
    one, other = torch.cat((exact, wrong)), torch.cat((wrong, exact))

    def errors_deg(orientations: torch.Tensor) -> list[float]:
        return [float(torch.rad2deg(orientation_errors(part, exact)).mean()) for part in orientations.split(100)]

    best = max(errors_deg(refine(both, torch.cat((exact, exact)))))
    assert max(errors_deg(refine(both, one))) > 10 * best
    structure, weights = Structure.of(both), EdgeWeights(ones, ones)
    for first, second in ((one, other), (other, one)):
        begun = begin(both, [Start(first, ones), Start(second, ones)], ones, structure)
        assert max(errors_deg(settle_best(both, begun, weights, structure).body_from_world)) < 1.1 * best


def test_eigenvectors_know_exact_orientations_whatever_they_begin_with() -> None:
    """Of two components; beginning nearly anywhere, each in a gauge of its own."""
    graph, truth = anyhow(1, 60, 14, 0.0)
    both = twice(graph)
    start = as_quaternions(random_truth(120, 9))
    found = spectral(both, start, both.components(), torch.ones(both.num_edges, dtype=torch.float64))
    for part in found.split(60):
        assert float(torch.rad2deg(orientation_errors(part, as_quaternions(truth))).mean()) < 2.0


def test_eigenvectors_are_nearer_than_a_tree_where_cameras_are_few_edges_apart() -> None:
    """Half of the edges are false: a tree has some of them, eigenvectors their mean."""
    by_tree, by_eigenvectors = [], []
    for seed in range(6):
        graph, truth = anyhow(seed, 200, 14, 0.5)
        component, exact = graph.components(), as_quaternions(truth)
        tree = bootstrap(trust_all(graph), component).body_from_world
        found = spectral(graph, tree, component, torch.ones(graph.num_edges, dtype=torch.float64))
        for errors, start in ((by_tree, tree), (by_eigenvectors, found)):
            errors.append(float(torch.rad2deg(orientation_errors(start, exact)).mean()))
    assert np.mean(by_eigenvectors) < np.mean(by_tree) / 2


@pytest.mark.large
def test_a_bridge_is_as_certain_as_the_edges_that_others_check() -> None:
    """It leaves no residual, whatever it states; what is behind it is as uncertain as that may be wrong."""
    scores, is_wrong, deviations = [], [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        ends = np.array([(i, (i + k) % 13) for i in range(13) for k in (1, 2, 3)] + [(0, 13)])
        false = rng.random(len(ends)) < 0.2
        noise = Rotation.from_rotvec(np.radians(1.0) * rng.normal(size=(len(ends), 3))).as_quat()
        noise = Rotation.from_quat(np.where(false[:, None], Rotation.random(len(ends), rng).as_quat(), noise))
        truth = Rotation.from_rotvec(rng.normal(0, 0.4, (14, 3)))
        solution = solve(measured(truth, *np.sort(ends, axis=1).T, noise))
        scores.append(float(solution.outlier_score[-1]))
        deviations.append(float(solution.uncertainty[13]) / float(solution.uncertainty[1:13].max()))
        is_wrong.append(bool(false[-1]))
    assert np.mean(scores) == pytest.approx(np.mean(is_wrong), abs=0.1)
    assert min(scores) > 0.05 and max(scores) < 0.5
    assert min(deviations) > 3


def test_bridges_are_found_and_a_tree_has_nothing_to_tell_by() -> None:
    truth = random_truth(9, 1)
    source, target = np.array([0, 1, 2, 2, 3, 4, 5, 7]), np.array([1, 2, 0, 3, 4, 5, 3, 8])
    solution = solve(measured(truth, source, target))
    assert (solution.outlier_score < 1e-3).all()
    tree = solve(measured(truth, np.arange(8), np.arange(1, 9)))
    assert (tree.outlier_score == 0).all()


class _Operations(TorchDispatchMode):
    """Counts operations on tensors."""

    count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        self.count += 1
        return func(*args, **(kwargs or {}))


def test_a_long_graph_takes_no_more_passes_than_a_short_one() -> None:
    """Edges in series are told by a tree, which is as deep as half the ring: a pass for each level is quadratic."""
    counts = []
    for cameras in (100, 1000):
        graph, _ = ring(0, cameras, 2, 0.0)
        is_near = (graph.target - graph.source).abs() < 3
        with _Operations() as operations:
            Structure.of(graph.select_edges(is_near))
        counts.append(operations.count)
    assert counts[1] < 1.5 * counts[0]
