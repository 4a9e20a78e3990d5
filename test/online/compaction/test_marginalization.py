"""Keyframes that are marginalised leave what the graph says of the others as it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.evaluation.common.cases import drawings
from rotavg_ros.evaluation.slam import stress
from rotavg_ros.odometry_route import ROUTE_COLUMNS
from rotavg_ros.online.compaction.chain import Columns, are_between, is_plain_odometry
from rotavg_ros.online.compaction.marginalization import marginalize
from rotavg_ros.online.compaction.marginalized_keyframes import Forgotten, MarginalizedIndex, MarginalizedKeyframes
from rotavg_ros.solver import solve
from rotavg_ros.view_graph import ViewGraph

NO_ROUTES = np.empty((0, ROUTE_COLUMNS))
COLUMNS = ("source", "target", "target_from_source", "kind", "precision", "label", "steps")


def columns_of(graph: ViewGraph) -> Columns:
    edges = {name: getattr(graph, name).numpy() for name in COLUMNS}
    return edges | {
        "edge_id": np.arange(graph.num_edges, dtype=np.uint64),
        "translation": np.zeros((graph.num_edges, 3)) if graph.translation is None else graph.translation.numpy(),
        "route": np.full(graph.num_edges, -1),
    }


def keyframes_of(count: int) -> Columns:
    numbers = np.arange(count)
    return {
        "robot": np.zeros(count, np.int32),
        "keyframe_id": numbers.astype(np.uint64),
        "stamp_ns": 10 * numbers,
        "time_line": np.zeros(count, np.int64),
    }


def can_be_marginalized(num_nodes: int, edges: Columns) -> np.ndarray:
    """Between two steps of odometry, and in no other edge."""
    free, other = are_between(num_nodes, edges), ~is_plain_odometry(edges)
    free[edges["source"][other]] = free[edges["target"][other]] = False
    return free


def laplacian(num_nodes: int, edges: Columns) -> np.ndarray:
    """Of the variances: closures as good as a step."""
    matrix = np.zeros((num_nodes, num_nodes))
    for source, target, steps in zip(edges["source"], edges["target"], edges["steps"], strict=True):
        matrix[[source, target], [source, target]] += 1 / steps
        matrix[[source, target], [target, source]] -= 1 / steps
    return matrix


@st.composite
def drives(draw) -> tuple[Rotation, np.ndarray, Columns]:
    """True poses, and edges without noise: chains with edges either way, a few more of either kind, and labels."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    count, more, chains = draw(st.integers(3, 25)), draw(st.integers(0, 6)), draw(st.integers(1, 3))
    chain = [(i, i + 1) for i in range(count - 1)] * chains
    ends = np.array(chain + [rng.choice(count, 2, replace=False) for _ in range(more)])
    turned = rng.random(len(ends)) < 0.3
    ends[turned] = ends[turned, ::-1]
    source, target = ends[rng.permutation(len(ends))].T
    world_from_body, position = Rotation.random(count, rng=rng), rng.normal(size=(count, 3))
    graph = ViewGraph.create(
        source,
        target,
        (world_from_body[target].inv() * world_from_body[source]).as_quat(canonical=True),
        num_nodes=count,
        kind=(np.abs(target - source) > 1) & (rng.random(len(ends)) < 0.7),
        label=np.where(rng.random(len(ends)) < 0.1, 2, 0),
        precision=np.where(rng.random(len(ends)) < 0.1, np.nan, 4.0),
    )
    edges = columns_of(graph) | {
        "translation": world_from_body[source].inv().apply(position[target] - position[source])
    }
    return world_from_body, position, edges


@settings(max_examples=60, deadline=None)
@given(drives(), st.integers(0, 2**32))
def test_what_is_left_is_the_schur_complement_and_true_to_the_poses(drive, seed):
    world_from_body, position, edges = drive
    rng = np.random.default_rng(seed)
    count = len(position)
    full, nodes = laplacian(count, edges), np.arange(count)
    ids, routes, riders = keyframes_of(count), NO_ROUTES, MarginalizedKeyframes.none()
    for _ in range(2):  # the second time there are marginalised keyframes already
        free = can_be_marginalized(len(nodes), edges)
        done = marginalize(ids, edges, routes, free & (rng.random(len(nodes)) < 0.7), riders)
        nodes, edges, routes, riders = nodes[done.kept], done.edges, done.routes, done.marginalized
        ids = {name: values[done.kept] for name, values in ids.items()}
    gone = np.setdiff1d(np.arange(count), nodes)
    schur = full[np.ix_(nodes, nodes)]
    if len(gone):
        schur = schur - full[np.ix_(nodes, gone)] @ np.linalg.solve(full[np.ix_(gone, gone)], full[np.ix_(gone, nodes)])
    np.testing.assert_allclose(laplacian(len(nodes), edges), schur, atol=1e-9)
    assert ids["keyframe_id"].tolist() == nodes.tolist()

    body, place = world_from_body[nodes], position[nodes]
    source, target = edges["source"], edges["target"]
    measured = Rotation.from_quat(edges["target_from_source"])
    assert (measured * (body[target].inv() * body[source]).inv()).magnitude().max() < 1e-7
    steps = body[source].inv().apply(place[target] - place[source])
    np.testing.assert_allclose(edges["translation"], steps, atol=1e-7)

    assert sorted(riders.keyframe_id.tolist()) == gone.tolist()
    index = MarginalizedIndex.of(riders, Forgotten())
    for keyframe in gone.tolist():
        row = index.by_id(0, keyframe)
        assert row == index.by_moment(0, 0, 10 * keyframe) and index.by_id(1, keyframe) is None
        edge = riders.edge[row]
        on_edge = (edges[name][edge] for name in ("target_from_source", "translation", "steps"))
        at_source, turn, offset = index.nearest_end(row, *on_edge)
        end = source[edge] if at_source else target[edge]
        assert (body[end] * Rotation.from_quat(turn) * world_from_body[keyframe].inv()).magnitude() < 1e-7
        np.testing.assert_allclose(place[end] + body[end].apply(offset), position[keyframe], atol=1e-7)


@pytest.mark.parametrize(("method", "relative", "score"), [("neurora~turns", 1e-6, 1e-6), ("neurora", 0.01, 1e-3)])
def test_the_solver_says_the_same_of_those_that_are_left(method, relative, score):
    """Whether a step turns as its neighbours do is not told any more once it is gone, how far all turned is."""
    config = SlamSimulationConfig(
        World.CITY, num_keyframes=600, laps=3, keyframe_distance_m=2.0, closures_per_keyframe=0.1, false_share=0.2
    )
    graph = simulate_slam_graph(config, np.random.default_rng(1004)).graph
    edges = columns_of(graph)
    remove = can_be_marginalized(600, edges)
    assert remove.sum() > 300
    done = marginalize(keyframes_of(600), edges, NO_ROUTES, remove, MarginalizedKeyframes.none())
    left = ViewGraph.create(**{name: done.edges[name] for name in COLUMNS}, num_nodes=len(done.kept))
    left = replace(left, route=torch.from_numpy(done.edges["route"]), routes=torch.from_numpy(done.routes))
    full, small = solve(graph, method=method), solve(left, method=method)
    turned = Rotation.from_quat(small.body_from_world) * Rotation.from_quat(full.body_from_world[done.kept]).inv()
    assert np.degrees(turned.magnitude().max()) < 1e-5
    np.testing.assert_allclose(small.uncertainty, full.uncertainty[done.kept], rtol=relative, atol=1e-6)
    # What an edge of several steps is suspected of is what all of them are.
    together = np.bincount(done.edge_of, full.outlier_score, len(done.last))
    np.testing.assert_allclose(small.outlier_score, together, atol=score)


def contracted(graph: ViewGraph, but_every: int = 0) -> tuple[ViewGraph, np.ndarray]:
    """Without the keyframes that no closure touches, but every so-and-so-many-th; and which are left."""
    edges = columns_of(graph)
    remove = can_be_marginalized(graph.num_nodes, edges)
    if but_every:
        remove[::but_every] = False
    done = marginalize(keyframes_of(graph.num_nodes), edges, NO_ROUTES, remove, MarginalizedKeyframes.none())
    left = ViewGraph.create(
        **{name: done.edges[name] for name in COLUMNS}, translation=done.edges["translation"], num_nodes=len(done.kept)
    )
    return replace(left, route=torch.from_numpy(done.edges["route"]), routes=torch.from_numpy(done.routes)), done.kept


@pytest.mark.parametrize(
    ("kind", "seed", "translations", "sigmas"),
    [
        ("grid: odometry worse in turns", 2, False, 0.15),
        ("drive: 26 closures, 16 agree with noise", 3, True, 0.03),
        pytest.param("hills: gyroscope bias, 30 % random", 3, True, 0.05, marks=pytest.mark.large),
        pytest.param("building: odometry worse in turns", 3, True, 0.3, marks=pytest.mark.large),
    ],
)
def test_nor_does_it_of_odometry_that_errs_in_turns_or_whose_translations_count(kind, seed, translations, sigmas):
    """By how many standard deviations an orientation moves: by up to 5 where only the sum of the steps is kept.

    Of drawings with one likeliest answer. Where two are within a nat (the first kind's seeds 3 and 4), either may be
    the median that is published, and an orientation moves by one.
    """
    graph = next(drawings(stress.kinds((kind,), translations=translations), [seed])).graph
    left, kept = contracted(graph)
    assert graph.num_nodes - len(kept) > 150
    full, small = solve(graph), solve(left)
    turned = Rotation.from_quat(small.body_from_world) * Rotation.from_quat(full.body_from_world[kept]).inv()
    assert (turned.magnitude()[1:] / full.uncertainty[kept].numpy()[1:]).max() < sigmas
    np.testing.assert_allclose(small.uncertainty[1:], full.uncertainty[kept][1:], rtol=0.05)


def test_keyframes_between_contracted_steps_are_as_uncertain():
    """In orientation and place: of a contracted step the lag and the spread tell how it bends what follows."""
    graph = next(drawings(stress.kinds(("building: closures of 6°",), translations=True), [3])).graph
    closures = np.flatnonzero(~graph.is_odometry.numpy())
    graph = graph.select_edges(torch.from_numpy(np.setdiff1d(np.arange(graph.num_edges), closures[5:])))
    left, kept = contracted(graph, but_every=20)
    assert graph.num_nodes - len(kept) > 150
    method = "neurora~fine-net,turns,tails,bias"
    full, small = solve(graph, method=method), solve(left, method=method)
    np.testing.assert_allclose(small.uncertainty[1:], full.uncertainty[kept][1:], rtol=0.01)
    np.testing.assert_allclose(small.position_uncertainty[1:], full.position_uncertainty[kept][1:], rtol=0.02)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_steps_without_place_and_absurd_ones_break_nothing():
    graph = next(drawings(stress.kinds(("hills: gyroscope bias, 30 % random",)), [3])).graph
    assert graph.translation is None
    unknown = contracted(replace(graph, translation=torch.full((graph.num_edges, 3), torch.nan, dtype=torch.float64)))
    absurd = contracted(replace(graph, translation=torch.full((graph.num_edges, 3), 1e300, dtype=torch.float64)))
    full = solve(graph)
    for left, kept in (unknown, absurd):
        assert left.routes is not None and not torch.isinf(left.routes).any()
        small = solve(replace(left, translation=None))
        turned = Rotation.from_quat(small.body_from_world) * Rotation.from_quat(full.body_from_world[kept]).inv()
        assert (turned.magnitude()[1:] / full.uncertainty[kept].numpy()[1:]).max() < 0.02
