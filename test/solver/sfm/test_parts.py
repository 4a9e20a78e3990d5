"""Parts that few edges join to the rest: which way they turn, and where it cannot be told."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.algebra.residuals import EdgeResiduals
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.solver.sfm.refinement import EdgeWeights
from rotavg_ros.solver.sfm.starts import parts
from rotavg_ros.solver.sfm.starts.choice import Start, begin, settle_best
from rotavg_ros.solver.sfm.starts.parts import Parts
from rotavg_ros.solver.sfm.step.structure import Structure
from test.solver.graphs import as_quaternions, measured, random_truth

PRIORS = RefinementPriors()
# The second half as seen by the false edges between the halves.
TURN = Rotation.from_rotvec(np.radians(60.0) * np.array([0.0, 0.6, 0.8]))


def halves(seed: int, good: int, false: int, cameras: int = 40, noise_deg: float = 1.0) -> tuple[ViewGraph, Rotation]:
    """Two well-knit halves, joined by ``good`` edges and by ``false`` ones, which agree that one half is turned."""
    rng = np.random.default_rng(seed)
    pairs = []
    for first in (0, cameras):
        drawn = np.sort(rng.integers(0, cameras, (6 * cameras, 2)), axis=1)
        path = np.stack((np.arange(cameras - 1), np.arange(1, cameras)), axis=1)
        pairs += [first + drawn[drawn[:, 0] < drawn[:, 1]], first + path]
    inner = np.unique(np.concatenate(pairs), axis=0)
    bridges = np.stack((rng.permutation(cameras), cameras + rng.permutation(cameras)), axis=1)[: good + false]
    source, target = np.concatenate((inner, bridges)).T
    is_false = np.arange(len(source)) >= len(inner) + good
    truth = random_truth(2 * cameras, seed)
    turned = truth[target] * TURN * truth[source].inv()
    exact = truth[target] * truth[source].inv()
    noise = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(len(source), 3)))
    measured = noise * Rotation.from_quat(np.where(is_false[:, None], turned.as_quat(), exact.as_quat()))
    return ViewGraph.create(source, target, measured.as_quat(), num_nodes=2 * cameras), truth


def wrong(truth: Rotation) -> Rotation:
    """The orientations that the false edges fit."""
    half = np.arange(len(truth)) >= len(truth) // 2
    return Rotation.from_quat(np.where(half[:, None], (truth * TURN).as_quat(), truth.as_quat()))


def parts_at(graph: ViewGraph, at: Rotation) -> tuple[Parts, np.ndarray]:
    angle = EdgeResiduals(graph, as_quaternions(at)).angles()
    weight = torch.ones(graph.num_edges, dtype=torch.float64)
    return Parts.of(graph, angle, weight, PRIORS), np.ascontiguousarray(at.as_quat().T)


def cost(graph: ViewGraph, at: Rotation) -> float:
    source, target = graph.source.numpy(), graph.target.numpy()
    residual = Rotation.from_quat(graph.target_from_source.numpy()).inv() * at[target] * at[source].inv()
    return float(np.sqrt(residual.magnitude()).sum())


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_part_that_false_edges_hold_is_turned_back(seed: int) -> None:
    graph, truth = halves(seed, good=5, false=3)
    start = wrong(truth)
    parts, rows = parts_at(graph, start)
    found = parts.improved(rows, PRIORS)
    assert found is not None
    errors = orientation_errors(torch.from_numpy(found.T.copy()), as_quaternions(truth))
    assert float(torch.rad2deg(errors).mean()) < 3.0  # one edge tells, with its own noise
    assert cost(graph, Rotation.from_quat(found.T)) < cost(graph, start)
    assert parts_at(graph, truth)[0].improved(parts_at(graph, truth)[1], PRIORS) is None


def test_the_change_of_each_turn_is_that_of_the_whole_cost() -> None:
    graph, truth = halves(3, good=3, false=3, cameras=15)
    parts, rows = parts_at(graph, wrong(truth))
    turns = parts.turns(rows)
    known = np.isfinite(turns.change)
    assert known.sum() >= 1
    before = cost(graph, wrong(truth))
    for index in np.flatnonzero(known):
        chosen = np.arange(len(turns.node)) == index
        after = Rotation.from_quat(parts.turned(rows, turns, chosen).T)
        np.testing.assert_allclose(cost(graph, after) - before, turns.change[index], atol=1e-6)


@pytest.mark.parametrize("is_wrong", [False, True])
def test_both_ways_are_refined_where_as_many_edges_say_either(is_wrong: bool) -> None:
    graph, truth = halves(0, good=3, false=3)
    ones = torch.ones(graph.num_edges, dtype=torch.float64)
    structure, start = Structure.of(graph), Start(as_quaternions(wrong(truth) if is_wrong else truth), ones)
    begun = begin(graph, [start, start], ones, structure)
    assert begun.rival is not None
    found = [begun.body_from_world, begun.rival.body_from_world]
    errors = [
        [float(orientation_errors(one, as_quaternions(way)).mean()) for way in (truth, wrong(truth))] for one in found
    ]
    np.testing.assert_array_less(np.radians([[0, 25], [25, 0]]), np.array(sorted(errors)) + np.radians(0.01))
    np.testing.assert_array_less(np.array(sorted(errors)), np.radians([[1.5, 35], [35, 1.5]]))
    best = settle_best(graph, begun, EdgeWeights(ones, ones), structure)
    assert best.is_doubtful is not None
    assert bool(best.is_doubtful.all())


def test_graphs_with_too_many_edges_are_not_searched() -> None:
    graph, truth = halves(0, good=3, false=3)
    ones = torch.ones(graph.num_edges, dtype=torch.float64)
    structure, start = Structure.of(graph), Start(as_quaternions(truth), ones)
    few = replace(PRIORS, starts=replace(PRIORS.starts, most_searched=graph.num_edges - 1))
    assert begin(graph, [start, start], ones, structure, few).rival is None


@pytest.mark.parametrize("seed", [0, 1])
def test_where_as_many_edges_say_either_the_answer_says_so(seed: int) -> None:
    """Which of the two is right nobody can tell."""
    graph, truth = halves(seed, good=3, false=3)
    solution = solve(graph)
    ways = [orientation_errors(solution.body_from_world, as_quaternions(one)).mean() for one in (truth, wrong(truth))]
    assert float(torch.rad2deg(min(ways))) < 1.5
    assert any("80 of 80 orientations differ between them" in warning for warning in solution.warnings)


@pytest.mark.parametrize("seed", [0, 1])
def test_where_edges_agree_there_is_no_doubt(seed: int) -> None:
    graph, truth = halves(seed, good=8, false=0)
    solution = solve(graph)
    assert solution.warnings == ()
    assert float(torch.rad2deg(orientation_errors(solution.body_from_world, as_quaternions(truth))).mean()) < 1.5


def test_there_is_nothing_to_turn_in_a_graph_that_is_joined_well_or_hardly_at_all() -> None:
    """Complete; a path; exact; of no edges."""
    for source, target in (
        np.triu_indices(50, 1),
        (np.arange(9), np.arange(1, 10)),
        (np.zeros(0, dtype=int), np.zeros(0, dtype=int)),
    ):
        truth = random_truth(50, 0)
        measured = truth[target] * truth[source].inv() if len(source) else Rotation.identity(0)
        graph = ViewGraph.create(source, target, measured.as_quat().reshape(-1, 4), num_nodes=50)
        parts, rows = parts_at(graph, truth)
        assert parts.improved(rows, PRIORS) is None
        assert parts.rival(rows, PRIORS) is None


def wheel(rim: int) -> tuple[ViewGraph, Rotation]:
    """A ring, and a camera that has seen everything."""
    truth, around = random_truth(rim + 1, 0), np.arange(rim)
    return measured(truth, np.tile(around, 2), np.concatenate(((around + 1) % rim, np.full(rim, rim)))), truth


def test_a_camera_that_has_seen_everything_takes_memory_for_its_edges_alone() -> None:
    """Not for their square: 3000² numbers of 4 bytes are 36 MB."""
    graph, truth = wheel(3000)
    parts_at(*wheel(30))
    tracemalloc.start()
    parts_at(graph, truth)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 18e6


@pytest.mark.parametrize("seed", [0, 1])
def test_common_neighbours_are_paths_of_two_edges(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Entries of the squared adjacency, beside hubs and parallel edges as well."""
    monkeypatch.setattr(parts, "_AT_A_TIME", 50)
    rng = np.random.default_rng(seed)
    source, target = np.sort(
        np.concatenate((rng.integers(0, 60, (200, 2)), rng.integers(0, [3, 60], (150, 2)))), axis=1
    ).T
    source, target = source[source < target], target[source < target]
    adjacency = np.zeros((60, 60))
    np.add.at(adjacency, (source, target), 1)
    adjacency += adjacency.T
    expected = (adjacency @ adjacency)[source, target]
    np.testing.assert_array_equal(parts._common_neighbours(60, source, target), expected)
