"""A graph that grows, solved by updates of the posterior's last answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver import KeptLabels, Solution, solve
from rotavg_ros.solver.methods import DEFAULT_METHOD, without
from rotavg_ros.solver.slam.noise.mounting import without_mounting
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.view_graph import EdgeLabel, ViewGraph


def drawn(kind: str, seed: int) -> DrawnGraph:
    return next(one for one in KINDS if one.name == kind).drawn(seed)


def until(graph: ViewGraph, count: int) -> ViewGraph:
    """The graph of the first nodes, edges in the order in which they came."""
    newer = torch.maximum(graph.source, graph.target)
    order = torch.argsort(newer, stable=True)
    return replace(graph.select_edges(order[newer[order] < count]), num_nodes=count)


def grown(graph: ViewGraph, solution: Solution) -> torch.Tensor:
    """Orientations of all nodes, those of new ones along the odometry."""
    orientation = torch.cat((solution.body_from_world, rotations.identity(graph.num_nodes)))[: graph.num_nodes].clone()
    for edge in torch.nonzero(graph.is_odometry & (graph.target >= len(solution.body_from_world)))[:, 0].tolist():
        source, target = int(graph.source[edge]), int(graph.target[edge])
        orientation[target] = rotations.multiply(graph.target_from_source[edge], orientation[source])
    return orientation


def error_deg(graph: ViewGraph, orientation: torch.Tensor, truth: np.ndarray) -> float:
    errors = orientation_errors(orientation, torch.from_numpy(truth[: graph.num_nodes]), graph.components())
    return float(np.degrees(errors.numpy().mean()))


@pytest.mark.parametrize(
    "kind", ["building: 30 % random", pytest.param("hills: gyroscope bias, 30 % random", marks=pytest.mark.large)]
)
def test_updates_end_where_the_whole_search_does(kind: str) -> None:
    case = drawn(kind, 1)
    count = case.graph.num_nodes - 40
    graph = until(case.graph, count)
    solution = solve(graph, profile="slam")
    updates = 0
    for number in range(count + 5, case.graph.num_nodes + 1, 5):
        graph = until(case.graph, number)
        start = grown(graph, solution)
        solution = solve(graph, profile="slam", warm_start=start, memory=solution.memory)
        updates += set(solution.stage_seconds) == {"update"}
        assert isinstance(solution.memory, SlamMemory)
    cold = solve(graph, profile="slam")
    assert updates >= 4
    errors = [error_deg(graph, one.body_from_world, case.body_from_world) for one in (solution, cold)]
    assert errors[0] < 1.2 * errors[1] + 0.1
    flagged = (solution.outlier_score > 0.5) != (cold.outlier_score > 0.5)
    assert int(flagged.sum()) <= 1


@pytest.mark.large
@pytest.mark.parametrize("degrees", [13.0, 100.0])
def test_closures_that_come_are_turned_back_as_those_before(degrees: float) -> None:
    """With translations: by updates, from labels alone, and by the tangent before an update has ended."""
    case = drawn("hills: 30 % random", 1)
    graph = replace(case.graph, translation=torch.from_numpy(case.edge_translation))
    mounting = np.radians(degrees) * np.array([0.6, -0.64, 0.48])
    graph = without_mounting(graph, -mounting)
    first = until(graph, graph.num_nodes - 30)
    solution = solve(first, profile="slam")
    assert isinstance(solution.memory, SlamMemory) and solution.memory.calibration is not None
    assert np.linalg.norm(solution.memory.calibration.mounting - mounting) < np.radians(3.0)
    whole = solve(graph, profile="slam")
    kept = solution.memory.labels
    assert kept is not None
    memories = (solution.memory, KeptLabels.of_arrays(first, kept.arrays()))
    later = until(graph, graph.num_nodes)
    flagged = solve(later, profile="slam").outlier_score > 0.5
    for memory, work in ((memories[0], None), (memories[1], None), (memories[0], 1e-9)):
        start = grown(later, solution)
        after = solve(later, profile="slam", warm_start=start, memory=memory, work=work)
        assert set(after.stage_seconds) == {"update"}
        assert ((after.outlier_score > 0.5) != flagged).sum() <= 1
        errors = [error_deg(later, one.body_from_world, case.body_from_world) for one in (after, whole)]
        assert errors[0] < 1.2 * errors[1] + 0.1


def test_what_has_not_grown_is_solved_anew() -> None:
    case = drawn("building: 15 closures", 1)
    solution = solve(case.graph, profile="slam")
    start = solution.body_from_world

    def stages(graph: ViewGraph, method: str = DEFAULT_METHOD) -> set[str]:
        return set(solve(graph, profile="slam", method=method, warm_start=start, memory=solution.memory).stage_seconds)

    assert stages(case.graph) == {"update"}
    turned = rotations.exp(torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64))
    measured = case.graph.target_from_source.clone()
    measured[0] = rotations.multiply(measured[0], turned)
    assert stages(replace(case.graph, target_from_source=measured)) != {"update"}
    label = case.graph.label.clone()
    label[-1] = int(EdgeLabel.REJECTED)
    assert stages(replace(case.graph, label=label)) != {"update"}
    assert stages(case.graph, without("slips")) != {"update"}
    assert stages(case.graph, "cleannet-spt") != {"update"}
    assert stages(case.graph.select_edges(torch.arange(case.graph.num_edges - 1))) != {"update"}


def test_odometry_alone_says_nothing_of_what_was_there() -> None:
    case = drawn("building: 30 % random", 1)
    count = case.graph.num_nodes - 40
    before = solve(until(case.graph, count), profile="slam")
    graph = until(case.graph, count + 20)
    num_known = before.outlier_score.shape[0]
    is_known = torch.arange(graph.num_edges) < num_known
    graph = graph.select_edges(is_known | graph.is_odometry)
    after = solve(graph, profile="slam", warm_start=grown(graph, before), memory=before.memory)
    assert set(after.stage_seconds) == {"update"}
    torch.testing.assert_close(after.body_from_world[:count], before.body_from_world, rtol=0, atol=1e-9)
    torch.testing.assert_close(after.outlier_score[:num_known], before.outlier_score)
    torch.testing.assert_close(after.uncertainty[:count], before.uncertainty)
    assert float(after.outlier_score[num_known:].max()) < 0.01
    variance = after.uncertainty[count - 1 :].numpy() ** 2
    np.testing.assert_allclose(np.diff(variance), np.diff(variance)[0])  # a random walk
    assert variance[1] > variance[0]


def test_odometry_is_appended_without_its_bias_whatever_the_start() -> None:
    """0.2° a step: after 40 steps the odometry as it is would be 8° off."""
    case = drawn("hills: gyroscope bias, 30 % random", 1)
    count = case.graph.num_nodes - 40
    before = solve(until(case.graph, count), profile="slam")
    graph = until(case.graph, case.graph.num_nodes)
    is_known = torch.arange(graph.num_edges) < len(before.outlier_score)
    graph = graph.select_edges(is_known | graph.is_odometry)
    anywhere = rotations.identity(graph.num_nodes)
    after = solve(graph, profile="slam", warm_start=anywhere, memory=before.memory)
    assert set(after.stage_seconds) == {"update"}
    torch.testing.assert_close(after.body_from_world[:count], before.body_from_world, rtol=0, atol=1e-9)
    whole = solve(graph, profile="slam")
    angle = rotations.angle_between(after.body_from_world, whole.body_from_world)
    assert np.degrees(float(angle.max())) < 0.5
    along = rotations.angle_between(grown(graph, before)[-1:], whole.body_from_world[-1:])
    assert np.degrees(float(along)) > 3


@pytest.mark.parametrize("has_closure", [False, True])
@pytest.mark.parametrize("with_places", [False, True])
def test_a_second_robot_begins(has_closure: bool, with_places: bool) -> None:
    case = drawn("building: 30 % random", 1)
    whole_graph = replace(case.graph, translation=torch.from_numpy(case.edge_translation) if with_places else None)
    known = until(whole_graph, 500)
    before = solve(known, profile="slam")
    first = 504 if has_closure else 500
    chain = until(whole_graph, 4)
    chain = chain.select_edges(chain.is_odometry)
    both = until(whole_graph, first)
    later = both.select_edges(torch.arange(known.num_edges, both.num_edges))
    parts = known, later, replace(chain, source=chain.source + first, target=chain.target + first)
    names = ("source", "target", "target_from_source", "kind", "precision", "label", "steps")
    names += ("translation",) if with_places else ()
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    graph = ViewGraph(first + 4, **columns)
    start = grown(graph, before)
    after = solve(graph, profile="slam", warm_start=start, memory=before.memory)
    whole = solve(graph, profile="slam")
    assert set(after.stage_seconds) == {"update"}
    angle = rotations.angle_between(after.body_from_world, whole.body_from_world)
    assert np.degrees(float(angle.mean())) < 0.3
    if with_places:
        assert after.position is not None and whole.position is not None
        assert float((after.position - whole.position).norm(dim=1).mean()) < 0.05


@pytest.mark.parametrize("was_good", [True, False])
def test_a_wrong_label_is_put_right_in_an_update(was_good: bool) -> None:
    case = drawn("building: 30 % random", 1)
    count = case.graph.num_nodes
    while bool((until(case.graph, count).is_odometry[-1:]).all()):
        count -= 1
    before = solve(until(case.graph, count - 1), profile="slam")
    memory = before.memory
    assert isinstance(memory, SlamMemory)
    score = before.outlier_score if was_good else 1 - before.outlier_score
    edge = int(torch.where(memory.graph.is_odometry, torch.inf, score).argmin())
    mistaken = memory.trusted.copy()
    mistaken[edge] = 1 - mistaken[edge]
    graph = until(case.graph, count)
    start = grown(graph, before)
    after = solve(graph, profile="slam", warm_start=start, memory=replace(memory, trusted=mistaken))
    assert set(after.stage_seconds) == {"update"}
    assert bool(after.outlier_score[edge] < 0.5) is was_good
