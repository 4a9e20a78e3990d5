"""The contraction of odometry chains against the whole graph, and its bookkeeping against networkx."""

from __future__ import annotations

from dataclasses import replace

import networkx
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros import EdgeKind, ViewGraph, rotations
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.algebra.spanning_forest import minimum_spanning_forest
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianSystem
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph, contract
from rotavg_ros.solver.slam.graph.odometry_paths import Growth, OdometryPaths, odometry_forest
from rotavg_ros.solver.slam.posterior.system import NormalEquations
from test.solver.graphs import measured, random_truth, slam_edges, small_noise


def _contract(graph: ViewGraph) -> ClosureGraph:
    forest = minimum_spanning_forest(graph, torch.where(graph.is_odometry, 1.0, 1e6))
    return contract(graph, OdometryPaths.along(graph, forest))


def _slam_graph(num_nodes: int, num_closures: int, seed: int, noise_deg: float = 0.5) -> ViewGraph:
    source, target, kind = slam_edges(num_nodes, num_closures, seed)
    noise = small_noise(len(source), noise_deg, seed)
    return measured(random_truth(num_nodes, seed), source, target, noise, kind=kind)


@given(st.integers(6, 60), st.integers(0, 12), st.integers(0, 10**6))
def test_every_edge_lies_in_one_place(num_nodes: int, num_closures: int, seed: int) -> None:
    graph = _slam_graph(num_nodes, num_closures, seed)
    contracted = _contract(graph)
    on_segment = contracted.segment_of_edge >= 0
    assert sorted(np.flatnonzero(~on_segment)) == sorted(contracted.view_graph_edge)
    assert graph.is_odometry.numpy()[on_segment].all()
    counts = np.bincount(contracted.segment_of_edge[on_segment], minlength=contracted.num_segments)
    assert np.array_equal(counts, contracted.own_steps[: contracted.num_segments])
    ends = set(graph.source[num_nodes - 1 :].tolist()) | set(graph.target[num_nodes - 1 :].tolist())
    assert set(contracted.nodes.tolist()) == ends | {0, num_nodes - 1}


@given(st.integers(6, 60), st.integers(1, 12), st.integers(0, 10**6))
def test_path_steps_are_networkxs(num_nodes: int, num_closures: int, seed: int) -> None:
    """On a branching odometry: each node hangs on a random earlier one."""
    rng = np.random.default_rng(seed)
    parent = np.array([rng.integers(max(0, node - 4), node) for node in range(1, num_nodes)])
    backward = rng.random(num_nodes - 1) < 0.5
    source = np.where(backward, np.arange(1, num_nodes), parent)
    target = np.where(backward, parent, np.arange(1, num_nodes))
    start = rng.integers(0, num_nodes, num_closures)
    end = (start + rng.integers(1, num_nodes, num_closures)) % num_nodes
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [num_nodes - 1, num_closures])
    graph = measured(random_truth(num_nodes, seed), np.r_[source, start], np.r_[target, end], kind=kind)
    contracted = _contract(graph)
    tree = networkx.Graph(list(zip(source.tolist(), target.tolist(), strict=True)))
    for edge, steps in zip(contracted.view_graph_edge, contracted.path_steps[contracted.num_segments :], strict=True):
        expected = networkx.shortest_path_length(tree, int(graph.source[edge]), int(graph.target[edge]))
        assert steps == expected


@given(st.integers(6, 40), st.integers(0, 8), st.integers(0, 10**6))
def test_what_lies_behind_a_segment_is_what_its_removal_cuts_off(num_nodes: int, num_closures: int, seed: int) -> None:
    contracted = _contract(_slam_graph(num_nodes, num_closures, seed))
    segments = list(zip(contracted.source.tolist(), contracted.target.tolist(), strict=True))[: contracted.num_segments]
    for segment, ends in enumerate(segments):
        others = networkx.Graph(segments[:segment] + segments[segment + 1 :])
        others.add_nodes_from(ends)
        newer = max(ends, key=lambda end: contracted.position[end])
        behind = set(np.flatnonzero(contracted.behind(segment)).tolist())
        assert behind == networkx.node_connected_component(others, newer)
        assert contracted.span[:, segment].tolist() == sorted(contracted.position[list(ends)])


def test_path_steps_are_infinite_where_odometry_does_not_connect() -> None:
    """Two robots, two closures between them."""
    source, target = np.array([0, 1, 3, 4, 0, 2]), np.array([1, 2, 4, 5, 3, 5])
    kind = [0, 0, 0, 0, 1, 1]
    contracted = _contract(measured(random_truth(6, 0), source, target, kind=kind))
    assert np.isinf(contracted.path_steps[contracted.num_segments :]).all()
    assert len(contracted.roots) == 1
    # Positions along the odometry keep the robots far apart.
    position = dict(zip(contracted.nodes.tolist(), contracted.position.tolist(), strict=True))
    assert abs(position[0] - position[3]) > 6


@pytest.mark.parametrize("seed", range(5))
def test_least_squares_on_the_contraction_is_least_squares_on_the_graph(seed: int) -> None:
    """One linear step on all nodes, against one on the key nodes spread over the chains."""
    graph = _slam_graph(80, 9, seed, noise_deg=1e-3)
    contracted = _contract(graph)
    variance = np.where(graph.is_odometry.numpy(), 2.0, 5.0)
    start = contracted.odometry_orientation
    residual = rotations.log(edge_residual(start, graph.target_from_source, graph.source, graph.target)).numpy()
    whole = LaplacianSystem(80, graph.source.numpy(), graph.target.numpy(), 1 / variance, np.array([0]))
    expected = rotations.multiply(start, rotations.exp(torch.from_numpy(whole.fit(residual))))

    weight = 1 / (contracted.own_steps * np.where(contracted.is_odometry, 2.0, 5.0))
    small = LaplacianSystem(contracted.num_nodes, contracted.source, contracted.target, weight, contracted.roots)
    step = small.fit(rotations.log(contracted.residual).numpy())
    actual = contracted.orientations(rotations.exp(torch.from_numpy(step)))
    assert float(rotations.angle_between(actual, expected).max()) < 1e-8


def test_corrections_invert_orientations_at_key_nodes() -> None:
    contracted = _contract(_slam_graph(50, 6, 3))
    correction = rotations.random(contracted.num_nodes, generator=torch.Generator().manual_seed(0))
    recovered = contracted.corrections(contracted.orientations(correction))
    assert float(rotations.angle_between(recovered, correction).max()) < 1e-7


def test_corrections_counted_from_roots_say_the_same() -> None:
    """Of two components: residuals are as long as before, and both roots stay where they are."""
    one, other = _slam_graph(40, 6, 1), _slam_graph(30, 5, 2)
    both = ViewGraph.create(
        torch.cat((one.source, other.source + 40)),
        torch.cat((one.target, other.target + 40)),
        torch.cat((one.target_from_source, other.target_from_source)),
        kind=torch.cat((one.kind, other.kind)),
    )
    contracted = _contract(both)
    correction = rotations.random(contracted.num_nodes, generator=torch.Generator().manual_seed(0))
    counted = contracted.from_roots(correction)
    identity = rotations.identity(len(contracted.roots))
    assert len(contracted.roots) == 2
    assert float(rotations.angle_between(counted[torch.from_numpy(contracted.roots)], identity).max()) < 1e-7
    before, after = (
        rotations.angle(edge_residual(contracted.orientations(each), both.target_from_source, both.source, both.target))
        for each in (correction, counted)
    )
    torch.testing.assert_close(after, before, atol=1e-7, rtol=0)


@pytest.mark.parametrize("seed", range(4))
def test_variances_are_relative_to_the_first_node_wherever_it_lies(seed: int) -> None:
    """Resistances between it and each node of the whole graph, by the pseudo-inverse of its Laplacian."""
    graph, number = _slam_graph(60, 4, seed), torch.from_numpy(np.random.default_rng(seed).permutation(60))
    graph = replace(graph, source=number[graph.source], target=number[graph.target])
    contracted = contract(graph, OdometryPaths.along(graph, odometry_forest(graph)))
    assert not contracted.is_held_at_first
    ends = torch.stack((graph.source, graph.target)).numpy()
    rows = np.eye(60)[ends[1]] - np.eye(60)[ends[0]]
    variance = np.where(graph.is_odometry, 2.0, 5.0)
    inverse = np.linalg.pinv(rows.T / variance @ rows)
    expected = np.diagonal(inverse) + inverse[0, 0] - 2 * inverse[0]

    run = np.full(len(contracted.source), -1)
    ends = contracted.source, contracted.target
    system = NormalEquations(contracted.num_nodes, *ends, run, np.zeros(len(run)), contracted.roots)
    solved = system.factorise(1 / (contracted.own_steps * np.where(contracted.is_odometry, 2.0, 5.0)))
    apart = solved.resistance[: contracted.num_segments]
    found = contracted.variance(solved.variance, apart, 2.0, solved.solve(contracted.first_column)[:, 0])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)


def test_corrections_counted_from_a_first_node_inside_a_segment_say_the_same() -> None:
    graph, number = _slam_graph(60, 4, 0), torch.from_numpy(np.random.default_rng(0).permutation(60))
    graph = replace(graph, source=number[graph.source], target=number[graph.target])
    contracted = contract(graph, OdometryPaths.along(graph, odometry_forest(graph)))
    assert 0 not in contracted.nodes
    correction = rotations.random(contracted.num_nodes, generator=torch.Generator().manual_seed(0)).numpy()
    counted = np.ascontiguousarray(contracted.from_first(np.ascontiguousarray(correction.T)).T)
    before, after = (contracted.orientations(torch.from_numpy(each)) for each in (correction, counted))
    relative = [rotations.multiply(each, rotations.inverse(each[:1]).expand_as(each)) for each in (before, after)]
    assert float(rotations.angle_between(*relative).max()) < 1e-7
    assert float(rotations.angle_between(after[:1], contracted.odometry_orientation[:1]).max()) < 1e-7


def test_graphs_without_closures_or_without_odometry() -> None:
    chain = _contract(_slam_graph(30, 0, 0))
    assert chain.num_nodes == 2 and chain.num_segments == 1 and chain.own_steps.tolist() == [29]
    loops = measured(random_truth(3, 0), np.array([0, 1, 2]), np.array([1, 2, 0]))
    contracted = _contract(loops)
    assert contracted.num_segments == 0 and contracted.num_nodes == 3


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.large)])
def test_nodes_that_hang_on_a_graph_by_odometry_lie_as_in_the_grown_one(seed: int) -> None:
    """On branches, edges in either direction."""
    rng = np.random.default_rng(seed)
    parent = np.array([rng.integers(max(0, node - 4), node) for node in range(1, 60)])
    backward = rng.random(59) < 0.5
    source, target = np.where(backward, np.arange(1, 60), parent), np.where(backward, parent, np.arange(1, 60))
    kind = [EdgeKind.ODOMETRY] * 59
    graph = measured(random_truth(60, seed), source, target, small_noise(59, 5.0, seed), kind=kind)
    paths = OdometryPaths.along(graph, minimum_spanning_forest(graph, torch.ones(59)))
    growth = Growth.of(graph, 39 + rng.permutation(20), 40)
    assert growth is not None and (growth.anchor < 40).all()
    orientation = rotations.multiply(growth.turn, paths.orientation[growth.anchor])
    assert float(rotations.angle_between(orientation, paths.orientation[40:]).max()) < 1e-7
    np.testing.assert_allclose(paths.depth[growth.anchor] + growth.along(np.ones(20)), paths.depth[40:])
    kept = np.append(np.arange(0, 39, 2), np.arange(39, 59))
    np.testing.assert_array_equal(kept[growth.among(kept).edge], growth.edge)


def test_nodes_that_hang_otherwise_do_not_grow() -> None:
    graph = _slam_graph(21, 0, 2)
    assert Growth.of(graph, np.array([19]), 20) is not None
    assert Growth.of(graph, np.array([19]), 19) is None  # a node has no edge
    beside = Growth.of(graph, np.array([18, 19]), 20)  # another way along odometry attaches nothing
    assert beside is not None
    assert beside.edge.tolist() == [19]


@given(st.lists(st.integers(1, 30), min_size=1, max_size=4), st.booleans(), st.integers(0, 10**6))
def test_positions_are_those_along_each_robot_s_path(lengths: list[int], is_renumbered: bool, seed: int) -> None:
    """Wherever closures enter it, and wherever the first keyframe lies; ascending where numbers do."""
    rng = np.random.default_rng(seed)
    first = np.concatenate(([0], np.cumsum(lengths)))
    robot = np.repeat(np.arange(len(lengths)), lengths)
    follows = np.flatnonzero(np.diff(robot) == 0)
    joints = [
        (int(rng.integers(first[before], first[before + 1])), int(rng.integers(first[before + 1], first[before + 2])))
        for before in range(len(lengths) - 1)
    ]
    ends = np.array([*zip(follows, follows + 1, strict=True), *joints], dtype=np.int64).reshape(-1, 2)
    renumbered = rng.permutation(first[-1]) if is_renumbered else np.arange(first[-1])
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [len(follows), len(joints)])
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (len(ends), 1))
    graph = ViewGraph.create(*renumbered[ends].T, identity, num_nodes=int(first[-1]), kind=kind)
    paths = _contract(graph).paths
    for member in range(len(lengths)):
        position = paths.position[renumbered[robot == member]]
        ascends = position[0] == 0
        assert ascends or is_renumbered
        np.testing.assert_array_equal(position if ascends else position[::-1], np.arange(lengths[member]))
