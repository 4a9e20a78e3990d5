"""What SfM answers state of their errors, against errors over draws of the noise and against the exact inverse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeLabel, ViewGraph, rotations, solve
from rotavg_ros.solver.sfm.certainty import uncertainty
from test.solver.graphs import as_quaternions, measured, random_truth, small_noise


def _street(num_nodes: int, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Each camera sees the next two."""
    node = np.repeat(np.arange(num_nodes - 2), 2)
    return first + node, first + node + np.tile([1, 2], num_nodes - 2)


def _dense(num_nodes: int, degree: int) -> tuple[np.ndarray, np.ndarray]:
    """A ring, and pairs at random; about ``degree`` edges a node."""
    rng = np.random.default_rng(3)
    source, target = np.triu_indices(num_nodes, k=1)
    kept = (rng.random(len(source)) < degree / num_nodes) | (target == source + 1)
    return source[kept], target[kept]


_NOISE = torch.tensor([0.03**2], dtype=torch.float64)
_GRAPHS = {"street": _street(60), "well knit": _dense(60, 20)}


def _exact(graph: ViewGraph, weight: np.ndarray) -> np.ndarray:
    """Diagonal of the inverse Laplacian without the first node, ``(N - 1,)``."""
    laplacian = np.zeros((graph.num_nodes, graph.num_nodes))
    for source, target, value in zip(graph.source.tolist(), graph.target.tolist(), weight, strict=True):
        laplacian[[source, target], [source, target]] += value
        laplacian[[source, target], [target, source]] -= value
    return np.diag(np.linalg.inv(laplacian[1:, 1:]))


@pytest.mark.parametrize("name", _GRAPHS)
def test_it_is_the_diagonal_of_the_least_squares_covariance(name: str) -> None:
    rng = np.random.default_rng(1)
    source, target = _GRAPHS[name]
    graph = measured(random_truth(60, 1), source, target)
    score = torch.from_numpy(rng.uniform(0, 0.9, len(source)))
    to = uncertainty.References(torch.zeros(60, dtype=torch.int64), torch.tensor([0]))
    found = uncertainty.variances(graph, _NOISE, score, torch.zeros(0, dtype=torch.int64), to)
    assert found is not None and float(found[0]) == 0
    ratio = (found.numpy()[1:] / (float(_NOISE) * _exact(graph, 1 - score.numpy()))) ** 0.5
    assert np.allclose(ratio, 1, atol=0.3 if name == "street" else 0.03)


@pytest.mark.parametrize("score", [0.0, 0.9, 1.0])
def test_what_hardly_joins_two_well_knit_parts_counts(score: float) -> None:
    """Iterations that end early do not see how far parts may be apart, and state a hundredth of it."""
    source, target = np.triu_indices(60, k=1)
    ends = (np.concatenate((one, one + 60, joining)) for one, joining in ((source, [3, 5]), (target, [63, 65])))
    graph = measured(random_truth(120, 2), *ends)
    scores = torch.zeros(graph.num_edges, dtype=torch.float64)
    scores[-2:] = score
    to = uncertainty.References(torch.zeros(120, dtype=torch.int64), torch.tensor([0]))
    found = uncertainty.variances(graph, _NOISE, scores, torch.zeros(0, dtype=torch.int64), to)
    assert found is not None
    ratio = (found.numpy()[1:] / (float(_NOISE) * _exact(graph, (1 - scores.numpy()).clip(1e-3)))) ** 0.5
    assert np.allclose(ratio[:59], 1, atol=0.03)
    assert np.allclose(ratio[59:], 1, atol=0.3)


@pytest.mark.parametrize("name", [pytest.param("street", marks=pytest.mark.large), "well knit"])
def test_errors_over_draws_of_the_noise_are_as_stated(name: str) -> None:
    source, target = _GRAPHS[name]
    truth = random_truth(60, 5)
    root = as_quaternions(truth * truth[0].inv())
    squares, stated = [], []
    for seed in range(12):
        graph = measured(truth, source, target, small_noise(len(source), 3.0, seed))
        solution = solve(graph, profile="sfm")
        error = rotations.log(rotations.multiply(rotations.inverse(root), solution.body_from_world))
        squares.append((error**2).mean(dim=1))
        stated.append(solution.uncertainty**2)
    assert float(stated[0][0]) == 0
    ratio = (torch.stack(squares).mean(0)[1:] / torch.stack(stated).mean(0)[1:]).sqrt()
    assert 0.7 < float(ratio.median()) < 1.4


@pytest.mark.parametrize("noise_deg", [0.3, 1.0])
def test_false_edges_do_not_count_as_noise(noise_deg: float) -> None:
    """Sixty of a hundred edges have any rotation."""
    source, target = np.triu_indices(40, k=1)
    truth = random_truth(40, 5)
    root = as_quaternions(truth * truth[0].inv())
    ratios = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        noise, anyhow = small_noise(len(source), noise_deg, seed), Rotation.random(len(source), random_state=seed)
        false = rng.random(len(source)) < 0.6
        noise = Rotation.from_quat(np.where(false[:, None], anyhow.as_quat(), noise.as_quat()))
        solution = solve(measured(truth, source, target, noise), profile="sfm")
        error = rotations.log(rotations.multiply(rotations.inverse(root), solution.body_from_world))[1:]
        ratios.append(float(((error**2).mean(dim=1) / solution.uncertainty[1:] ** 2).mean().sqrt()))
    # Edges whose residuals are hardly above 20° are still believed to some extent.
    assert 0.25 < np.mean(ratios) < 1.3


def test_noise_is_told_by_the_part_that_believed_edges_join() -> None:
    """25 cameras see some others each; to each hangs one more by a false edge, which says nothing of the noise."""
    source, target = _dense(25, 4)
    residual = small_noise(len(source), 1.0, 0).as_rotvec()
    incidence = np.zeros((len(source), 25))
    incidence[np.arange(len(source)), source], incidence[np.arange(len(source)), target] = -1, 1
    residual -= incidence @ np.linalg.lstsq(incidence, residual, rcond=None)[0]
    graph = measured(random_truth(50, 3), np.append(source, np.arange(25)), np.append(target, np.arange(25, 50)))
    angle = torch.from_numpy(np.append(np.linalg.norm(residual, axis=1), np.ones(25)))
    score = torch.from_numpy(np.repeat([0.0, 0.9], [len(source), 25]))
    (deviation,) = uncertainty.noise_variance(graph, angle, score, torch.zeros(50, dtype=torch.int64)).sqrt()
    assert float(deviation) == pytest.approx(np.radians(1.0), rel=0.2)


def test_each_component_states_its_own() -> None:
    """A well-knit one, a street and a tree state what they state alone."""
    dense, tree = _dense(40, 20), (100 + np.arange(8), 101 + np.arange(8))
    source, target = np.concatenate((dense, _street(60, 40), tree), axis=1)
    together = measured(random_truth(109, 6), source, target, small_noise(len(source), 1.0, 6))
    stated = solve(together, profile="sfm").uncertainty
    assert bool(stated[100:].isnan().all())
    for nodes in (slice(0, 40), slice(40, 100)):
        chosen = (together.source >= nodes.start) & (together.source < nodes.stop)
        part = together.select_edges(chosen.nonzero()[:, 0])
        ends = part.source - nodes.start, part.target - nodes.start
        alone = ViewGraph.create(*ends, part.target_from_source, num_nodes=nodes.stop - nodes.start)
        assert torch.allclose(stated[nodes], solve(alone, profile="sfm").uncertainty, rtol=0.02)


def test_a_few_samples_are_taken_where_they_suffice() -> None:
    """As exact where cameras have 150 edges as where they have 16, and neither depends on the other."""
    sizes, degrees = (200, 60), (150, 16)
    graphs = [
        measured(random_truth(size, 3), *_dense(size, degree)) for size, degree in zip(sizes, degrees, strict=True)
    ]
    ends = (torch.cat((getattr(graphs[0], end), getattr(graphs[1], end) + sizes[0])) for end in ("source", "target"))
    relative = torch.cat([graph.target_from_source for graph in graphs])
    together = ViewGraph.create(*ends, relative, num_nodes=sum(sizes))

    def stated(graph: ViewGraph, nodes: list[int]) -> np.ndarray:
        component, first = torch.arange(len(nodes)).repeat_interleave(torch.tensor(nodes)), np.cumsum([0, *nodes[:-1]])
        to = uncertainty.References(component, torch.from_numpy(first))
        noise, score = _NOISE.repeat(len(nodes)), torch.zeros(graph.num_edges, dtype=torch.float64)
        found = uncertainty.variances(graph, noise, score, torch.zeros(0, dtype=torch.int64), to)
        assert found is not None
        return found.numpy()

    parts = np.split(stated(together, list(sizes)), sizes[:1])
    for graph, part, tolerance in zip(graphs, parts, (0.01, 0.05), strict=True):
        exact = float(_NOISE) * _exact(graph, np.ones(graph.num_edges))
        assert np.allclose((part[1:] / exact) ** 0.5, 1, atol=tolerance)
        assert np.allclose(part, stated(graph, [graph.num_nodes]), rtol=1e-6)


def test_well_knit_graphs_with_too_many_edges_state_none(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = measured(random_truth(60, 7), *_GRAPHS["well knit"])
    assert bool(solve(graph, profile="sfm").uncertainty.isfinite().all())
    monkeypatch.setattr(uncertainty, "PRIORS", replace(uncertainty.PRIORS, most_edges=100))
    assert bool(solve(graph, profile="sfm").uncertainty.isnan().all())


def test_a_tree_states_none() -> None:
    tree = measured(random_truth(9, 8), np.arange(8), np.arange(8) + 1)
    assert bool(solve(tree, profile="sfm").uncertainty.isnan().all())


@pytest.mark.parametrize("closing", [[], [(9, 3)], [(9, 3), (7, 1), (5, 2)]])
def test_rejected_edges_check_nothing(closing: list[tuple[int, int]]) -> None:
    """Ten cameras in a row, with edges that close cycles, state the same with and without others that are rejected."""
    ends = np.array([*zip(range(9), range(1, 10), strict=True), *closing, (9, 0), (8, 2), (4, 0)]).T
    relative = measured(random_truth(10, 1), *ends, small_noise(len(ends[0]), 1.0, 3)).target_from_source.numpy()
    relative[-3:-1] = as_quaternions(random_truth(2, 9))
    label = np.repeat([EdgeLabel.AUTOMATIC, EdgeLabel.REJECTED], [len(relative) - 3, 3])
    rejected = ViewGraph.create(*ends, relative, num_nodes=10, label=label)
    removed = rejected.select_edges(torch.arange(len(relative) - 3))
    one, other = (solve(graph, profile="sfm") for graph in (rejected, removed))
    assert torch.allclose(one.outlier_score[:-3], other.outlier_score, atol=0.02)
    assert torch.allclose(one.uncertainty, other.uncertainty, rtol=0.2, equal_nan=True)
