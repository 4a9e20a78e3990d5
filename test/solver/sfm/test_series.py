"""Edges that only check each other: their classes, their blame, and what is said of a cycle."""

from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import Solution, ViewGraph, rotations, solve
from rotavg_ros.metrics.orientations import gauge_alignment
from rotavg_ros.solver.algebra.relaxed_forest import relaxed_forest
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.sfm.series import EdgesInSeries
from rotavg_ros.solver.solution import residual_deg
from test.solver.graphs import as_quaternions, measured, random_truth, small_noise

_LENGTHS = (4, 10, 30)


def _series(graph: ViewGraph) -> EdgesInSeries:
    edges = SortedEdges.of(graph)
    roots = torch.from_numpy(np.unique(graph.components().numpy(), return_index=True)[1])
    forest = relaxed_forest(edges, torch.ones(graph.num_edges), roots)
    return EdgesInSeries.of(graph, forest.parent, forest.parent_edge)


def _cut_pairs(graph: ViewGraph) -> set[frozenset[int]]:
    """Pairs of edges that are no bridges and take the graph apart together, by trying all of them."""
    ends = list(zip(graph.source.tolist(), graph.target.tolist(), strict=True))
    whole = nx.MultiGraph(ends)

    def parts_without(*edges: int) -> int:
        left = nx.MultiGraph(whole.edges())
        left.add_nodes_from(whole)
        left.remove_edges_from([ends[edge] for edge in edges])
        return nx.number_connected_components(left)

    sound = [edge for edge in range(len(ends)) if parts_without(edge) == parts_without()]
    return {
        frozenset((a, b))
        for place, a in enumerate(sound)
        for b in sound[:place]
        if parts_without(a, b) > parts_without()
    }


@pytest.mark.parametrize("seed", range(6))
def test_classes_are_the_pairs_that_take_the_graph_apart(seed: int) -> None:
    """Trees with a few more edges, some parallel, in two components."""
    rng = np.random.default_rng(seed)
    trees = [(int(rng.integers(0, node)) + 12 * part, node + 12 * part) for part in (0, 1) for node in range(1, 12)]
    more = [(a + 12 * part, b + 12 * part) for part in (0, 1) for a, b in rng.integers(0, 12, (5, 2)) if a != b]
    source, target = np.array(trees + more).T
    graph = measured(random_truth(24, seed), source, target)
    series = _series(graph)
    found = {
        frozenset((int(series.edge[a]), int(series.edge[b])))
        for a in range(len(series.edge))
        for b in range(a)
        if series.group[a] == series.group[b]
    }
    assert found == _cut_pairs(graph)
    torch.testing.assert_close(series.sums(series.blame), torch.ones(series.num_groups, dtype=torch.float64))


def test_in_a_well_knit_graph_every_edge_is_by_itself() -> None:
    source, target = np.triu_indices(12, k=1)
    assert len(_series(measured(random_truth(12, 0), source, target)).edge) == 0


def _cycle(length: int, seed: int = 0) -> tuple[ViewGraph, Rotation]:
    """A cycle whose fourth edge is off by a radian; the others by a degree."""
    source = np.arange(length)
    noise = small_noise(length, 1.0, seed).as_rotvec()
    noise[3] = [1.0, 0.0, 0.0]
    truth = random_truth(length, seed)
    return measured(truth, source, (source + 1) % length, Rotation.from_rotvec(noise)), truth


def _solved(graph: ViewGraph) -> Solution:
    return solve(graph, profile="sfm")


@pytest.mark.parametrize("length", _LENGTHS)
def test_all_edges_of_a_cycle_share_the_blame(length: int) -> None:
    solution = _solved(_cycle(length)[0])
    assert not bool((solution.outlier_score > 0.5).any())
    np.testing.assert_allclose(solution.outlier_score, 1 / length, rtol=0.25)


@pytest.mark.parametrize("length", _LENGTHS)
def test_a_cycles_misfit_is_spread_over_all_its_edges(length: int) -> None:
    graph, _ = _cycle(length)
    residual = residual_deg(graph, _solved(graph))
    assert residual.sum() == pytest.approx(57.3, rel=0.15)
    np.testing.assert_allclose(residual, residual.mean(), rtol=0.25)


@pytest.mark.parametrize("length", _LENGTHS)
def test_a_cycle_that_fits_has_no_outlier(length: int) -> None:
    source = np.arange(length)
    graph = measured(random_truth(length, 1), source, (source + 1) % length, small_noise(length, 1.0, 1))
    assert float(_solved(graph).outlier_score.max()) < 0.05


def test_a_cycles_uncertainty_is_that_of_a_wrong_edge_anywhere() -> None:
    """Root mean square error over where the wrong edge is, against what is stated; up to a factor of two."""
    length, squares, stated = 10, [], []
    source, truth = np.arange(10), random_truth(10, 2)
    root = as_quaternions(truth * truth[0].inv())
    for wrong in range(length):
        noise = np.zeros((length, 3))
        noise[wrong] = [1.0, 0.0, 0.0]
        solution = _solved(measured(truth, source, (source + 1) % length, Rotation.from_rotvec(noise)))
        error = rotations.log(rotations.multiply(rotations.inverse(root), solution.body_from_world))
        squares.append((error**2).mean(dim=1))
        stated.append(solution.uncertainty**2)
    ratio = (torch.stack(squares).mean(0)[1:] / torch.stack(stated).mean(0)[1:]).sqrt()
    assert float(ratio.min()) > 0.5 and float(ratio.max()) < 2


def test_where_a_graph_checks_itself_cleannet_tells_which_of_two_edges_is_wrong() -> None:
    """A camera on two edges, one of them wrong by a wide angle, beside a hundred that see each other."""
    rng = np.random.default_rng(7)
    truth = Rotation.from_rotvec(0.4 * rng.standard_normal((61, 3)))
    source, target = np.triu_indices(60, k=1)
    seen = rng.random(len(source)) < 0.5
    source, target = np.append(source[seen], [3, 40]), np.append(target[seen], [60, 60])
    noise = small_noise(len(source), 4.0, 7).as_rotvec()
    noise[-1] = [2.0, 0.0, 0.0]
    graph = measured(truth, source, target, Rotation.from_rotvec(noise))
    solution = _solved(graph)
    assert solution.outlier_score[-1] > 0.5 > solution.outlier_score[-2]
    gauge = gauge_alignment(solution.body_from_world[:60], as_quaternions(truth)[:60])
    at_camera = rotations.multiply(as_quaternions(truth)[60], gauge)
    assert float(torch.rad2deg(rotations.angle_between(solution.body_from_world[60], at_camera))) < 30
