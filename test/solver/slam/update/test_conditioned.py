"""Closures reckoned in by the tangent of the last solve, against the solves that follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph
from rotavg_ros.datasets.worlds import World
from rotavg_ros.solver import Solution, solve
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.view_graph import ViewGraph

from .test_memory import grown

KNOWN, NEW = 600, 20


def drawn(*, translations: bool, planar: bool, seed: int = 0) -> tuple[ViewGraph, np.ndarray]:
    """A graph in the order in which it came, and which of its edges are false."""
    world = World.BUILDING if planar else World.GARAGE
    config = SlamSimulationConfig(
        world=world,
        dimensions=2 if planar else 3,
        num_keyframes=KNOWN + NEW,
        closures_per_keyframe=0.8,
        false_share=0.2,
    )
    run = simulate_slam_graph(config, np.random.default_rng(seed))
    graph = run.graph
    if translations:
        graph = replace(graph, translation=torch.from_numpy(run.edge_translation))
    order = np.argsort(torch.maximum(graph.source, graph.target).numpy(), kind="stable")
    return graph.select_edges(torch.from_numpy(order)), np.asarray(run.closure_is_false)[order]


def first(graph: ViewGraph, count: int) -> ViewGraph:
    kept = torch.maximum(graph.source, graph.target) < count
    return replace(graph.select_edges(kept), num_nodes=count)


def turned_deg(one: Solution, other: Solution) -> np.ndarray:
    return np.degrees(rotations.angle_between(one.body_from_world, other.body_from_world).numpy())


@pytest.mark.parametrize(
    ("translations", "planar"),
    [
        (False, True),
        (True, False),
        *(pytest.param(*same, marks=pytest.mark.large) for same in ((False, False), (True, True))),
    ],
)
def test_it_is_near_the_solve_that_follows(translations: bool, planar: bool) -> None:
    graph, is_false = drawn(translations=translations, planar=planar)
    before = solve(first(graph, KNOWN), profile="slam")
    start = grown(graph, before)
    given = {"profile": "slam", "warm_start": start, "memory": before.memory}
    quick = solve(graph, **given, work=1e4)
    assert isinstance(quick.memory, SlamMemory)
    memory = before.memory
    assert isinstance(memory, SlamMemory)
    given["memory"] = replace(memory, update_work=1e9)  # which no tick waits for
    quick, after = solve(graph, **given, work=1e4), solve(graph, **given)
    count = int((~graph.is_odometry[memory.graph.num_edges :]).sum())
    assert isinstance(quick.memory, SlamMemory) and quick.memory.update is not None
    assert quick.memory.columns is not None and len(quick.memory.columns.edge) == count > 10
    new = np.flatnonzero((np.arange(graph.num_edges) >= memory.graph.num_edges) & ~graph.is_odometry.numpy())
    assert is_false[new].sum() >= 2
    flags = [(one.outlier_score > 0.5).numpy()[new] for one in (quick, after)]
    wrong = [int((flagged != is_false[new]).sum()) for flagged in flags]
    assert wrong[0] <= wrong[1] + 1
    assert (flags[0] == flags[1]).mean() > 0.9
    kept = (torch.arange(graph.num_edges) < memory.graph.num_edges) | graph.is_odometry
    odometry = solve(graph.select_edges(kept), **{**given, "memory": memory})
    off, without = turned_deg(quick, after), turned_deg(odometry, after)
    assert off[KNOWN:].mean() < 0.4 * without[KNOWN:].mean()
    assert off.mean() < 0.3 * np.degrees(float(after.uncertainty.mean()))
    # New keyframes are surer by it, about as sure as they turn out to be.
    surer = [float(one.uncertainty[KNOWN:].mean()) for one in (odometry, quick, after)]
    assert surer[1] < 0.9 * surer[0]
    assert 0.7 < surer[1] / surer[2] < 1.4
    torch.testing.assert_close(quick.uncertainty[:KNOWN], odometry.uncertainty[:KNOWN])
    if translations:
        assert quick.position is not None and after.position is not None and odometry.position is not None
        moved, missed = ((one.position - after.position).norm(dim=1)[KNOWN:].mean() for one in (quick, odometry))
        assert moved < 0.75 * missed  # .1 to .7 of other seeds, 1.2 of one whose odometry errs by 2 cm
        assert quick.rotation_score is not None and len(quick.rotation_score) == graph.num_edges
        assert quick.edge_precision is not None and bool((quick.edge_precision[new[flags[0]]] == 0).all())


@pytest.mark.parametrize("translations", [False, pytest.param(True, marks=pytest.mark.large)])
def test_the_gauge_and_the_order_of_ends_change_nothing(translations: bool) -> None:
    graph, _ = drawn(translations=translations, planar=False)
    is_new = torch.arange(graph.num_edges) >= first(graph, KNOWN).num_edges
    swapped = graph.reverse_edges(is_new & ~graph.is_odometry & (torch.arange(graph.num_edges) % 2 == 0))
    assert int((swapped.source != graph.source).sum()) > 5
    before = solve(first(graph, KNOWN), profile="slam")
    memory = before.memory
    assert isinstance(memory, SlamMemory)
    given = {"profile": "slam", "memory": replace(memory, update_work=1e9), "work": 1e4}
    start = grown(graph, before)
    gauge = rotations.exp(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    plain = solve(graph, warm_start=start, **given)
    turned = solve(swapped, warm_start=rotations.multiply(start, gauge.expand_as(start)), **given)
    assert turned_deg(plain, turned).max() < 1e-6
    torch.testing.assert_close(plain.outlier_score, turned.outlier_score, atol=1e-9, rtol=0)


def test_what_is_not_reckoned_in_yet_has_a_score_by_its_residual() -> None:
    graph, is_false = drawn(translations=True, planar=True)
    before = solve(first(graph, KNOWN), profile="slam")
    memory = before.memory
    assert isinstance(memory, SlamMemory)
    memory = replace(memory, update_work=1e9)
    quick = solve(graph, profile="slam", warm_start=grown(graph, before), memory=memory, work=0.0)
    assert isinstance(quick.memory, SlamMemory) and quick.memory.columns is not None
    assert len(quick.memory.columns.edge) == 1
    new = np.flatnonzero((np.arange(graph.num_edges) >= memory.graph.num_edges) & ~graph.is_odometry.numpy())
    flagged = (quick.outlier_score > 0.5).numpy()[new]
    assert (flagged == is_false[new]).mean() > 0.8


@pytest.mark.large
def test_a_long_closure_counts_for_less_than_a_short_one() -> None:
    """As in a whole solve, whose closures' translations err by a share of their length, too."""
    graph, _ = drawn(translations=True, planar=True)
    before = solve(first(graph, KNOWN), profile="slam")
    memory = before.memory
    assert isinstance(memory, SlamMemory) and memory.poses is not None
    pose = memory.poses.pose
    noise = replace(pose.state.noise, relative=0.1)
    solved = replace(pose.solved, state=replace(pose.state, noise=noise))
    poses = replace(memory.poses, pose=replace(pose, solved=solved))
    memory = replace(memory, poses=poses, update_work=1e9)
    found = solve(graph, profile="slam", warm_start=grown(graph, before), memory=memory, work=1e4)
    is_new = (torch.arange(graph.num_edges) >= memory.graph.num_edges) & ~graph.is_odometry
    good = is_new & (found.outlier_score < 0.5)
    assert found.edge_precision is not None and graph.translation is not None
    square = graph.translation[good].square().sum(dim=1).numpy()
    assert square.max() > 4 * square.min() and len(square) > 5
    # Planar: the mean of the variances along both axes.
    alike = noise.of_constant_times(float(np.trace(pose.state.shape[:2, :2])) / 2)
    np.testing.assert_allclose(1 / found.edge_precision[good, 1].numpy(), alike.of_closures(square))


@pytest.mark.parametrize(
    ("number", "translations"), [(1, False), (5, True), pytest.param(1, True, marks=pytest.mark.large), (5, False)]
)
def test_closures_between_keyframes_that_are_known(translations: bool, number: int) -> None:
    """Nothing is new but closures: one, and some of them false."""
    graph, _ = drawn(translations=translations, planar=False)
    known = first(graph, KNOWN)
    closure = torch.nonzero(~known.is_odometry)[:, 0]
    late = closure[:: len(closure) // number][:number]
    kept = torch.ones(known.num_edges, dtype=torch.bool)
    kept[late] = False
    order = torch.cat((torch.nonzero(kept)[:, 0], late))
    grown_graph = known.select_edges(order)
    before = solve(known.select_edges(order[: -len(late)]), profile="slam")
    memory = before.memory
    assert isinstance(memory, SlamMemory)
    given = {"profile": "slam", "warm_start": before.body_from_world, "work": 1e4}
    quick = solve(grown_graph, **given, memory=replace(memory, update_work=1e9))
    assert isinstance(quick.memory, SlamMemory) and quick.memory.update is not None
    after = solve(grown_graph, **{**given, "work": None}, memory=memory)
    assert turned_deg(quick, after).mean() < 0.1
    flags = [(one.outlier_score > 0.5).numpy()[-len(late) :] for one in (quick, after)]
    np.testing.assert_array_equal(*flags)


@pytest.mark.parametrize("translations", [False, True])
def test_tick_by_tick_it_is_the_same_as_at_once(translations: bool) -> None:
    """What a tick takes over from the one before, inverses and variances, is what it would work out from nothing."""
    graph, _ = drawn(translations=translations, planar=True)
    before = solve(first(graph, KNOWN), profile="slam")
    memory = before.memory
    assert isinstance(memory, SlamMemory)
    memory = replace(memory, update_work=1e9)  # which no tick waits for

    def tick(count: int, memory: SlamMemory) -> Solution:
        known = first(graph, count)
        return solve(known, profile="slam", warm_start=grown(known, before), memory=memory, work=1e4)

    at_once = tick(KNOWN + NEW, memory)
    for count in range(KNOWN + 2, KNOWN + NEW + 1, 2):
        ticked = tick(count, memory)
        assert isinstance(ticked.memory, SlamMemory) and ticked.memory.update is not None
        memory = ticked.memory
    assert memory.columns is not None and len(memory.columns.edge) > 10
    assert turned_deg(ticked, at_once).max() < 1e-9
    np.testing.assert_allclose(ticked.outlier_score, at_once.outlier_score, atol=1e-9)
    np.testing.assert_allclose(ticked.uncertainty, at_once.uncertainty, rtol=1e-9)
