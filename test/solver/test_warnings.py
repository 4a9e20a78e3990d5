"""What a mistaken convention, or an answer that few closures bend, is told by; and what must not be taken for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rotavg_ros import EdgeKind, EdgeLabel, ViewGraph, rotations, solve, solve_batch
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph
from rotavg_ros.solver import warnings
from rotavg_ros.solver.algebra.spanning_forest import compose_orientations, shortest_path_forest

DIMENSIONS = pytest.mark.parametrize("dimensions", [2, 3])


@cache
def simulated(seed: int, dimensions: int = 2, **changes: object) -> ViewGraph:
    config = replace(RobotRun(laps=2).config(), num_keyframes=600, dimensions=dimensions, false_share=0.1)
    config = replace(config, closures_per_keyframe=0.6)
    run = simulate_slam_graph(replace(config, **changes), np.random.default_rng(seed))
    return run.graph


def changed(graph: ViewGraph, change: Callable[[Tensor], Tensor], edges: Tensor | None = None) -> ViewGraph:
    """With other rotations, of all edges or of those that a mask chooses."""
    rotation = rotations.canonical(change(graph.target_from_source))
    if edges is not None:
        rotation = torch.where(edges[:, None], rotation, graph.target_from_source)
    return replace(graph, target_from_source=rotation)


def written_in_another_order(target_from_source: Tensor) -> Tensor:
    """(w, x, y, z) of what a file has, the inverse, read as (x, y, z, w)."""
    return rotations.inverse(rotations.inverse(target_from_source)[:, [3, 0, 1, 2]])


def found(graph: ViewGraph) -> tuple[str, ...]:
    """By the checks that need no answer: for one along odometry, in which nothing is believed."""
    odometry = graph.select_edges(graph.is_odometry)
    answer = compose_orientations(shortest_path_forest(odometry), odometry)
    return warnings.of_whole_solve(graph, answer, torch.ones(graph.num_edges).double())


@DIMENSIONS
@pytest.mark.parametrize("seed", range(5))
def test_inverted_closures(seed: int, dimensions: int) -> None:
    graph = simulated(seed, dimensions)
    inverted = changed(graph, rotations.inverse, ~graph.is_odometry)
    assert found(graph) == ()
    (text,) = found(inverted)
    assert "would with the closures' rotations inverted" in text and "swap source and target" in text
    odometry_inverted = changed(graph, rotations.inverse, graph.is_odometry)
    (text,) = found(odometry_inverted)
    assert "rotations inverted" in text


def test_closures_of_one_pair_of_places_are_not_enough() -> None:
    """Ten that agree with each other and, inverted, with odometry."""
    chain = simulated(0)
    chain = chain.select_edges(chain.is_odometry)
    quarter = rotations.exp(torch.tensor([[0.0, 0.0, 0.5 * np.pi / 300]]).double()).expand(chain.num_edges, 4)
    chain = replace(chain, target_from_source=quarter)
    for spacing, count in ((2, 0), (25, 1)):
        source = torch.arange(0, 10 * spacing, spacing)
        back = rotations.exp(torch.tensor([[0.0, 0.0, -0.5 * np.pi]]).double()).expand(10, 4)
        assert len(found(_joined(chain, ViewGraph.create(source, source + 300, back, num_nodes=600)))) == count


@pytest.mark.parametrize("seed", range(5))
def test_in_the_plane_nothing_tells_that_all_is_inverted(seed: int) -> None:
    assert found(changed(simulated(seed), rotations.inverse)) == ()


@DIMENSIONS
@pytest.mark.parametrize("seed", range(5))
def test_another_order_of_quaternions(seed: int, dimensions: int) -> None:
    graph = simulated(seed, dimensions)
    for edges in (None, graph.is_odometry, ~graph.is_odometry):
        (text,) = found(changed(graph, written_in_another_order, edges))
        assert "in the order w, x, y, z; w, x, y, z may have been written" in text
        assert ("the closures' rotations" in text) == (edges is not None and not edges[0])
        assert text.startswith("the median odometry edge turns by 1") == (edges is None or bool(edges[0]))
    # Where what is written is what is stored.
    (text,) = found(changed(graph, lambda rotation: rotation[:, [3, 0, 1, 2]], ~graph.is_odometry))
    assert "the closures' rotations in the order w, x, y, z" in text


def test_another_order_shows_without_closures() -> None:
    graph = simulated(0)
    odometry = graph.select_edges(graph.is_odometry)
    assert found(odometry) == ()
    (text,) = found(changed(odometry, written_in_another_order))
    assert text.startswith("the median odometry edge turns by 1")


def test_more_drift_than_the_narrow_tolerance_allows() -> None:
    """Beyond 10° at nearly all closures, within 20° at most."""
    graph = simulated(1, false_share=0.0)
    bent = changed(
        graph,
        lambda rotation: rotations.multiply(rotation, rotations.exp(torch.tensor([[0.0, 0.0, 0.25]]).double())),
        ~graph.is_odometry,
    )
    assert found(bent) == ()
    (text,) = found(changed(bent, rotations.inverse, ~graph.is_odometry))
    assert "within 20°" in text and "inverted" in text


@DIMENSIONS
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("grouped_share", [0.0, 1.0])
def test_false_closures_are_no_convention(seed: int, dimensions: int, grouped_share: float) -> None:
    assert found(simulated(seed, dimensions, false_share=0.8, grouped_share=grouped_share)) == ()


def test_random_closures_and_orientations_are_no_convention() -> None:
    graphs = [simulated(seed) for seed in range(2)]
    for seed in range(20):
        generator = torch.Generator().manual_seed(seed)
        yaw = torch.zeros(400, 3).double()
        yaw[:, 2] = 2 * torch.pi * torch.rand(400, generator=generator) - torch.pi
        for random in (rotations.exp(yaw), rotations.random(400, generator=generator)):
            graph = graphs[seed % 2]
            closures = (~graph.is_odometry).nonzero()[:, 0]
            measured = graph.target_from_source.clone()
            measured[closures] = rotations.canonical(random[: len(closures)])
            assert found(replace(graph, target_from_source=measured)) == ()
            few = torch.cat((graph.is_odometry.nonzero()[:, 0], closures[:9]))
            assert found(replace(graph, target_from_source=measured).select_edges(few)) == ()
            assert found(ViewGraph.create(range(399), range(1, 400), random[:399], kind=[0] * 399)) == ()


def test_identities_speak_for_no_convention() -> None:
    graph = simulated(0)
    still = changed(graph, lambda rotation: rotations.identity(len(rotation)))
    assert found(still) == found(changed(still, rotations.inverse, ~still.is_odometry)) == ()
    turns_little = changed(graph, lambda rotation: rotations.exp(0.1 * rotations.log(rotation)))
    assert found(changed(turns_little, rotations.inverse, ~graph.is_odometry)) == ()


def test_what_a_user_has_rejected_takes_no_part() -> None:
    graph = simulated(0)
    inverted = changed(graph, rotations.inverse, ~graph.is_odometry)
    label = torch.where(graph.is_odometry, int(EdgeLabel.AUTOMATIC), int(EdgeLabel.REJECTED))
    rejected = replace(inverted, label=label)
    assert found(rejected) == ()
    assert warnings.mostly_flagged(rejected, torch.ones(graph.num_edges)) == ()


@pytest.mark.parametrize(
    ("num_nodes", "edges"),
    [(0, []), (1, []), (3, []), (2, [(0, 1, 0)]), (2, [(0, 1, 1)]), (6, [(0, 1, 0), (1, 2, 0), (4, 3, 0), (0, 2, 1)])],
)
def test_next_to_nothing(num_nodes: int, edges: list[tuple[int, int, int]]) -> None:
    source, target, kind = (np.array([edge[i] for edge in edges], dtype=np.int64) for i in range(3))
    # Two out of three turn by nearly 180° about x, as small turns do whose quaternions are in another order.
    turns = rotations.exp(torch.tensor([[3.1, 0.0, 0.0], [3.1, 0.0, 0.1], [0.1, 0.0, 0.0]], dtype=torch.float64))
    turned = turns.repeat(2, 1)[: len(edges)]
    graph = ViewGraph.create(source, target, turned, kind=kind, num_nodes=num_nodes)
    assert solve(graph, profile="slam").warnings == ()
    assert found(replace(graph, label=torch.full_like(graph.label, EdgeLabel.REJECTED))) == ()


def test_several_components() -> None:
    """Closures between two robots say nothing of odometry's convention; those of each do."""
    graph = simulated(0)
    inverted = changed(graph, rotations.inverse, ~graph.is_odometry)

    def twice(one: ViewGraph) -> ViewGraph:
        shifted = [torch.cat((end, end + one.num_nodes)) for end in (one.source, one.target)]
        return ViewGraph.create(*shifted, one.target_from_source.tile(2, 1), kind=one.kind.tile(2))

    assert found(twice(graph)) == ()
    assert len(found(twice(inverted))) == 1
    between = inverted.source.clone()
    between[~inverted.is_odometry] += inverted.num_nodes
    assert found(replace(inverted, source=between, num_nodes=2 * inverted.num_nodes)) == ()


def test_most_closures_flagged() -> None:
    kind = [EdgeKind.ODOMETRY] * 5 + [EdgeKind.LOOP_CLOSURE] * 4
    graph = ViewGraph.create([0, 1, 2, 3, 4, 0, 1, 2, 3], [1, 2, 3, 4, 5, 2, 3, 4, 5], rotations.identity(9), kind=kind)
    score = torch.tensor([1.0] * 5 + [0.9, 0.9, 0.9, 0.1])
    (text,) = warnings.mostly_flagged(graph, score)
    assert text.startswith("3 of 4 loop closures are flagged")
    assert warnings.mostly_flagged(graph, torch.where(torch.arange(9) == 5, 0.1, score)) == ()  # just half
    assert warnings.mostly_flagged(graph.select_edges(torch.arange(8)), score[:8]) == ()  # 3 of 3
    label = torch.where(torch.arange(9) == 5, int(EdgeLabel.REJECTED), 0)
    assert warnings.mostly_flagged(replace(graph, label=label), score) == ()  # 2 of 3 that nobody has judged
    (text,) = warnings.mostly_flagged(graph.select_edges(torch.arange(5, 9)), score[5:])
    assert text.startswith("3 of 4 edges are flagged")


def test_places_in_millimetres_and_places_that_are_missing() -> None:
    """Three laps of 40 steps of 1 m, every closure of a right rotation: in millimetres all places are off by metres."""
    rng, lap = np.random.default_rng(0), 40
    heading = 2 * np.pi / lap * np.arange(3 * lap)
    position = lap / (2 * np.pi) * np.stack((np.cos(heading), np.sin(heading), 0 * heading), axis=1)
    orientation = Rotation.from_rotvec(np.outer(heading, [0, 0, 1]))
    closures = np.arange(0, 2 * lap, 4)
    source = np.concatenate((np.arange(3 * lap - 1), closures))
    target = np.concatenate((np.arange(1, 3 * lap), closures + lap))
    turn = Rotation.from_rotvec(np.outer(rng.normal(0, 0.005, len(source)), [0, 0, 1]))
    relative = (orientation[source].inv() * orientation[target] * turn).as_quat()
    shift = orientation[source].inv().apply(position[target] - position[source])
    shift[:, :2] += rng.normal(0, 0.03, (len(source), 2))
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [3 * lap - 1, len(closures)])

    def warned(unit: float) -> tuple[str, ...]:
        graph = ViewGraph.create(source, target, source_from_target=relative, kind=kind, translation=unit * shift)
        return solve(graph).warnings

    assert warned(1.0) == ()
    (text,) = warned(1000.0)
    assert "join wrong places; if translations are not in metres" in text and "translation_scale" in text
    shift[7] = np.nan
    (text,) = warned(1.0)
    assert text.startswith("1 of 119 odometry edges have no translation, so closures are judged by their rotations")
    shift[kind == EdgeKind.LOOP_CLOSURE] = np.nan
    assert warned(1.0) == ()
    shift[:] = np.nan
    assert warned(1.0) == ()


def test_few_closures_that_turn_the_answer() -> None:
    graph = ViewGraph.create(range(9), range(1, 10), rotations.identity(9), kind=[EdgeKind.ODOMETRY] * 9)
    closures = ViewGraph.create([0] * 10, [9] * 10, rotations.identity(10))
    one, nine, ten = (_joined(graph, closures.select_edges(torch.arange(count))) for count in (1, 9, 10))
    yaw = torch.zeros(10, 3).double()
    yaw[:, 2] = torch.linspace(0.0, np.radians(150.0), 10)  # 38° in the mean from odometry turned by 75°
    gauge = rotations.random(1, generator=torch.Generator().manual_seed(0))
    turned = rotations.multiply(rotations.exp(yaw), gauge)
    for bent, start in ((one, "1 believed loop closure turns"), (nine, "9 believed loop closures turn")):
        (text,) = warnings.of_whole_solve(bent, turned, torch.zeros(bent.num_edges))
        assert text.startswith(start) and "by 42° on average" in text
        assert warnings.of_whole_solve(bent, gauge.expand(10, 4), torch.zeros(bent.num_edges)) == ()
        assert warnings.of_whole_solve(bent, turned, torch.ones(bent.num_edges)) == ()
    assert warnings.of_whole_solve(ten, turned, torch.zeros(ten.num_edges)) == ()
    # Odometry that does not connect all says nothing of what closures join.
    apart = nine.select_edges(torch.arange(nine.num_edges) != 4)
    (text,) = warnings.of_whole_solve(apart, turned, torch.zeros(apart.num_edges))
    assert text.startswith(
        "5 of 10 keyframes are joined to the rest by 9 loop closures alone, of a single pair of places"
    )


LAPS = {"a": range(100), "b": range(100, 160), "c": range(160, 200)}


def of_fleet(*joins: tuple[int, int], label: EdgeLabel = EdgeLabel.AUTOMATIC) -> ViewGraph:
    """Three robots of 100, 60 and 40 keyframes, with closures between some keyframes; the first has ``label``."""
    steps = [(node, node + 1) for lap in LAPS.values() for node in lap[:-1]]
    source, target = np.array([*steps, *joins]).T
    kind = [EdgeKind.ODOMETRY] * len(steps) + [EdgeKind.LOOP_CLOSURE] * len(joins)
    labels = [EdgeLabel.AUTOMATIC] * len(steps) + [label] + [EdgeLabel.AUTOMATIC] * (len(joins) - 1)
    return ViewGraph.create(source, target, rotations.identity(len(source)), kind=kind, label=labels, num_nodes=200)


def of_answer(graph: ViewGraph, score: Tensor | None = None) -> tuple[str, ...]:
    score = torch.zeros(graph.num_edges) if score is None else score
    return warnings.of_whole_solve(graph, rotations.identity(graph.num_nodes), score)


RUN = tuple((10 + number, 105 + number) for number in range(5))


def test_robots_that_one_pair_of_places_joins() -> None:
    lone = of_fleet(*RUN)
    (text,) = of_answer(lone)
    assert text.startswith(
        "60 of 200 keyframes are joined to the rest by 5 loop closures alone, of a single pair of places, "
    )
    # A third robot that nothing joins is no part of it; one that hangs on the second moves with it.
    (text,) = of_answer(of_fleet(*RUN, (150, 170), (105, 165)))
    assert text.startswith("100 of 200 keyframes are joined to the rest by 5 loop closures alone")
    (text,) = of_answer(of_fleet(*RUN, (150, 170)))
    assert text.startswith(
        "100 of 200 keyframes are joined to the rest by 6 loop closures alone, of a single pair of places "
    )
    assert "places for each part, and" in text
    # Joins elsewhere, at either end, would contradict them.
    for elsewhere in ((80, 107), (12, 155)):
        assert of_answer(of_fleet(*RUN, elsewhere)) == ()
    assert of_answer(of_fleet(*RUN, *((number, 160 + number) for number in range(0, 30, 5)))) == of_answer(lone)
    assert of_answer(of_fleet(*RUN, (150, 170), (70, 165))) == ()
    # What is flagged or rejected joins nothing, and who has accepted one need not look.
    score = torch.zeros(lone.num_edges)
    score[-5:] = 0.9
    assert of_answer(lone, score) == ()
    assert of_answer(of_fleet(*RUN[:1], label=EdgeLabel.REJECTED)) == ()
    assert of_answer(of_fleet(*RUN, label=EdgeLabel.ACCEPTED)) == ()


def test_lone_places_do_not_depend_on_order() -> None:
    rng = np.random.default_rng(0)
    for joins in (RUN, (*RUN, (150, 170)), (*RUN, (80, 107)), (*RUN, (150, 170), (70, 165))):
        graph = of_fleet(*joins)
        name, order = torch.from_numpy(rng.permutation(200)), torch.from_numpy(rng.permutation(graph.num_edges))
        turned = torch.from_numpy(rng.random(graph.num_edges) < 0.5)
        ends = torch.stack((graph.source, graph.target))
        source, target = name[torch.where(turned, ends.flip(0), ends)][:, order]
        rotation, kind = graph.target_from_source[order], graph.kind[order]
        assert of_answer(ViewGraph.create(source, target, rotation, kind=kind, num_nodes=200)) == of_answer(graph)


def _joined(a: ViewGraph, b: ViewGraph) -> ViewGraph:
    both = [torch.cat((getattr(a, name), getattr(b, name))) for name in ("source", "target", "target_from_source")]
    return ViewGraph.create(*both, kind=torch.cat((a.kind, b.kind)))


@pytest.mark.large
def test_a_solve_states_them_and_the_next_ones_keep_them() -> None:
    graph = simulated(0)
    inverted = changed(graph, rotations.inverse, ~graph.is_odometry)
    assert solve(graph).warnings == ()
    cold = solve(inverted)
    assert any("rotations inverted" in text for text in cold.warnings)
    warm = solve(inverted, warm_start=cold.body_from_world, memory=cold.memory)
    assert set(warm.stage_seconds) == {"update"}
    assert warm.warnings[0] == cold.warnings[0]
    again = solve(inverted, warm_start=warm.body_from_world, memory=warm.memory)
    assert again.warnings[0] == cold.warnings[0]
    assert any("rotations inverted" in text for text in solve(inverted, method="spt").warnings)


@pytest.mark.large
def test_warnings_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = simulated(1)
    inverted = changed(graph, rotations.inverse, ~graph.is_odometry)
    warned = solve(inverted)
    monkeypatch.setattr(warnings, "of_whole_solve", lambda *_: ())
    monkeypatch.setattr(warnings, "mostly_flagged", lambda *_: ())
    silent = solve(inverted)
    assert set(warned.warnings) > set(silent.warnings)
    assert torch.equal(warned.body_from_world, silent.body_from_world)
    assert torch.equal(warned.outlier_score, silent.outlier_score)


def test_graphs_that_are_solved_together_are_warned_of_one_by_one() -> None:
    graph = simulated(0)
    closures = graph.select_edges(~graph.is_odometry)
    clean = ViewGraph.create([0, 1, 2, 0, 1], [1, 2, 3, 2, 3], rotations.identity(5))
    pairs = np.stack(np.triu_indices(12, 1))
    wild = ViewGraph.create(*pairs, rotations.random(66, generator=torch.Generator().manual_seed(0)))
    together = solve_batch([clean, wild, closures])
    assert together[0].warnings == ()
    assert together[1].warnings[0].endswith("by hand") and "of 66 edges are flagged" in together[1].warnings[0]


def test_edges_that_state_exactly_nothing() -> None:
    """As a registration does that found nothing, between any two scans; not as a rig of parallel cameras does."""
    source, target = torch.triu_indices(12, 12, offset=1)
    generator = torch.Generator().manual_seed(0)
    relative = rotations.random(len(source), generator=generator)
    found_nothing = torch.rand(len(source), generator=generator) < 0.4
    nothing = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    graph = ViewGraph.create(source, target, torch.where(found_nothing[:, None], nothing, relative))
    (text,) = warnings.stating_nothing(graph)
    assert text.startswith(f"{int(found_nothing.sum())} of 66 edges state exactly no rotation")
    assert text in solve(graph).warnings
    is_rig = (source // 3) == (target // 3)
    rigs = ViewGraph.create(source, target, torch.where(is_rig[:, None], nothing, relative))
    assert warnings.stating_nothing(rigs) == ()
    assert warnings.stating_nothing(ViewGraph.create(source, target, relative)) == ()
    assert warnings.stating_nothing(ViewGraph.create(source, target, nothing.expand(66, 4))) == ()
