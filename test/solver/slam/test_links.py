"""Graphs most of whose closures are measured between keyframes that follow each other closely."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.baselines.least_squares import least_squares
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver import KeptLabels, Solution, solve
from rotavg_ros.solver.slam.links import as_closures, with_links
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

from .linked_keyframes import SPANS, drawn, error_deg, linked
from .update.test_memory import grown, until


def num_links(graph: ViewGraph) -> int:
    return int((graph.num_nodes - np.array(SPANS)).sum())


def by_rotations(graph: ViewGraph) -> ViewGraph:
    return replace(graph, translation=None)


def flagged_links(graph: ViewGraph, solution: Solution) -> np.ndarray:
    flagged = np.flatnonzero(solution.outlier_score.numpy() > 0.5)
    return flagged[flagged >= graph.num_edges - num_links(graph)]


def told_all(case: DrawnGraph, graph: ViewGraph, own_deg: float) -> float:
    """Degrees, error of least squares that is told which closures are false, and all precisions."""
    precision = np.append(case.true_precision, np.full(num_links(graph), np.radians(own_deg) ** -2))
    is_used = np.append(~case.is_wrong, np.ones(num_links(graph), dtype=bool))
    answer = least_squares(replace(graph, precision=torch.from_numpy(precision)), is_used)
    return float(torch.rad2deg(orientation_errors(answer, torch.from_numpy(case.body_from_world))).mean())


@pytest.mark.parametrize("own_deg", [0.1, 3.0])
def test_as_good_as_if_all_precisions_were_known(own_deg: float) -> None:
    """Whether they are better than odometry, or no better than loop closures."""
    case = drawn("building: 30 % random", 1)
    graph = linked(case, own_deg, by_truth=True)
    solution, alone = solve(by_rotations(graph), profile="slam"), solve(case.graph, profile="slam")
    assert error_deg(case, solution) < 1.1 * told_all(case, graph, own_deg) + 0.05
    assert error_deg(case, solution) < error_deg(case, alone) + 0.02
    flagged = solution.outlier_score.numpy()[: case.graph.num_edges] > 0.5
    np.testing.assert_array_equal(flagged[case.is_closure], case.is_false[case.is_closure])
    assert not flagged[~case.is_closure].any()
    assert not solution.warnings, "closures over few keyframes that are false are no slips"


@pytest.mark.large
@pytest.mark.parametrize("kind", ["hills: 30 % random", "grid: 30 % random"])
@pytest.mark.parametrize("own_deg", [0.1, 0.3, 1.0, 3.0])
def test_also_in_other_worlds(kind: str, own_deg: float) -> None:
    case = drawn(kind, 1)
    graph = linked(case, own_deg, by_truth=True)
    solution = solve(by_rotations(graph), profile="slam")
    assert error_deg(case, solution) < 1.1 * told_all(case, graph, own_deg) + 0.05
    flagged = flagged_links(graph, solution) - case.graph.num_edges
    truth = Rotation.from_quat(case.body_from_world)
    links = graph.select_edges(torch.arange(case.graph.num_edges, graph.num_edges))
    right = truth[links.target.numpy()] * truth[links.source.numpy()].inv()
    off = (Rotation.from_quat(links.target_from_source.numpy()) * right.inv()).magnitude()
    assert (np.degrees(off[flagged]) > 8).all()
    assert not np.setdiff1d(np.flatnonzero(np.degrees(off) > 14), flagged).any()


@pytest.mark.large
def test_positions_are_better_by_them() -> None:
    case = drawn("building: 30 % random", 1)
    graph = linked(case, 0.3, by_truth=True)
    off = []
    for each in (graph, graph.select_edges(torch.arange(case.graph.num_edges))):
        solution = solve(each, profile="slam")
        assert solution.position is not None
        turn, _ = Rotation.align_vectors(
            case.position - case.position.mean(axis=0), solution.position - solution.position.mean(axis=0)
        )
        left = (
            case.position - case.position.mean(axis=0) - turn.apply(solution.position - solution.position.mean(axis=0))
        )
        off.append(float(np.sqrt((left**2).sum(axis=1).mean())))
    assert off[0] < off[1]


@pytest.mark.parametrize("wrong", ["rotations", "translations"])
def test_false_ones_among_them_are_flagged(wrong: str) -> None:
    case = drawn("building: 30 % random", 1)
    graph = linked(case, 0.3, by_truth=True)
    right = solve(graph if wrong == "translations" else by_rotations(graph), profile="slam")
    stated, shift, rng = graph.target_from_source.clone(), graph.translation.clone(), np.random.default_rng(0)
    false = graph.num_edges - 1 - rng.choice(num_links(graph), 80, replace=False)
    for edge in false:
        off = Rotation.from_rotvec([0, 0, rng.uniform(0.5, 2.5)]) * Rotation.from_quat(stated[edge].numpy())
        stated[edge] = torch.from_numpy(off.as_quat(canonical=True))
        shift[edge, :2] += torch.from_numpy(rng.choice([-1, 1], 2) * rng.uniform(3, 6, 2))
    if wrong == "translations":
        graph = replace(graph, translation=shift)
    else:
        graph = replace(graph, target_from_source=stated, translation=None)
    solution = solve(graph, profile="slam")
    np.testing.assert_array_equal(flagged_links(graph, solution), np.sort(false))
    assert error_deg(case, solution) < 1.05 * error_deg(case, right) + 0.02


@pytest.mark.parametrize("kind", ["building: 30 % random", pytest.param("hills: 30 % random", marks=pytest.mark.large)])
def test_a_slip_is_found_at_its_step(kind: str) -> None:
    """Loop closures alone would leave open where."""
    graph = linked(drawn(kind), 0.3, by_truth=True)
    stated, step = graph.target_from_source.clone(), int(graph.is_odometry.nonzero()[250])
    slip = torch.from_numpy(Rotation.from_rotvec([0.0, 0.0, np.radians(25)]).as_quat())
    stated[step] = rotations.multiply(slip, stated[step])
    graph = replace(graph, target_from_source=stated, translation=None)
    assert len(with_links(graph)[1]) > 0.9 * num_links(graph)
    solution = solve(graph, profile="slam")
    odometry = graph.is_odometry.numpy()
    assert np.flatnonzero((solution.outlier_score.numpy() > 0.5) & odometry).tolist() == [step]
    assert len(flagged_links(graph, solution)) == 0


def test_few_of_them_are_closures_like_any_other() -> None:
    for kind in ("building: 30 % random", "grid: 30 % random", "2 robots: half random"):
        assert len(with_links(drawn(kind).graph)[1]) == 0
    assert len(with_links(linked(drawn("hills: 30 % random")))[1]) == 0, "these are made of odometry"


@pytest.mark.parametrize("share", [0.4, 0.8])
def test_where_many_are_false_all_are_closures(share: float) -> None:
    """False ones would decide what is usual."""
    case = drawn("building: 30 % random", 1)
    graph = by_rotations(linked(case, 0.3, by_truth=True))
    stated, rng = graph.target_from_source.clone(), np.random.default_rng(0)
    false = graph.num_edges - 1 - rng.choice(num_links(graph), int(share * num_links(graph)), replace=False)
    stated[false] = torch.from_numpy(Rotation.random(len(false), random_state=0).as_quat(canonical=True))
    assert len(with_links(replace(graph, target_from_source=stated))[1]) == 0


def test_an_absurd_translation_is_no_links() -> None:
    graph = linked(drawn("building: 30 % random", 1), 0.3, by_truth=True)
    links, shift = with_links(graph)[1], graph.translation.clone()
    shift[links[5]] = 1e200
    np.testing.assert_array_equal(with_links(replace(graph, translation=shift))[1], np.delete(links, 5))
    solution = solve(replace(graph, translation=shift), profile="slam")
    assert solution.outlier_score[links[5]] > 0.9
    assert solution.position is not None and bool(torch.isfinite(torch.as_tensor(solution.position)).all())


def test_rejected_ones_stay_closures() -> None:
    graph = linked(drawn("building: 30 % random", 1), 0.3, by_truth=True)
    links, label = with_links(graph)[1], graph.label.clone()
    label[links[:900]], label[links[900:1200]] = EdgeLabel.REJECTED, EdgeLabel.ACCEPTED
    changed, others = with_links(replace(graph, label=label))
    assert np.isin(links[900:], others).all()
    assert changed.is_odometry[others].all() and not changed.is_odometry[links[:900]].any()
    solution = solve(by_rotations(replace(graph, label=label)), profile="slam")
    score = solution.outlier_score.numpy()
    assert (score[links[:900]] == 1).all() and (score[links[900:1200]] == 0).all()


@pytest.mark.parametrize("without", ["their translations", "loop closures"])
def test_positions_need_neither_their_translations_nor_loop_closures(without: str) -> None:
    case = drawn("building: 30 % random", 1)
    graph = linked(case, 0.1, by_truth=True)
    assert graph.translation is not None
    shift = graph.translation.clone()
    shift[-num_links(graph) :] = torch.nan
    no_loops = graph.is_odometry | (torch.arange(graph.num_edges) >= case.graph.num_edges)
    solution = solve(
        replace(graph, translation=shift) if without == "their translations" else graph.select_edges(no_loops),
        profile="slam",
    )
    chain = graph.select_edges(graph.is_odometry)
    assert solution.position is not None and solution.edge_precision is not None
    assert error_deg(case, solution) < 0.6 * error_deg(case, solve(chain, profile="slam"))
    stated = solution.edge_precision[-num_links(graph) :, 1]
    assert (stated == 0).all() if without == "their translations" else (stated > 0).all()


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=10, deadline=None)
def test_ends_order_and_axes_do_not_matter(seed: int, translations: bool) -> None:
    graph = linked(drawn("building: 30 % random", 1), 0.3, by_truth=True)
    graph = graph if translations else by_rotations(graph)
    rng = np.random.default_rng(seed)
    order = rng.permutation(graph.num_edges)
    other = graph.reverse_edges(torch.from_numpy(rng.random(graph.num_edges) < 0.5)).select_edges(
        torch.from_numpy(order)
    )
    axes = torch.from_numpy(Rotation.random(random_state=seed % 1000).as_quat()).expand(graph.num_edges, 4)
    turned = rotations.multiply(rotations.multiply(axes, other.target_from_source), rotations.inverse(axes))
    other = replace(other, target_from_source=rotations.canonical(turned))
    if other.translation is not None:
        other = replace(other, translation=rotations.rotate(axes, other.translation))
    taken, links = with_links(graph)
    others, same = with_links(other)
    np.testing.assert_array_equal(np.sort(order[same]), links)
    np.testing.assert_allclose(taken.steps[order], others.steps)
    again = as_closures(others, same)
    assert torch.equal(again.kind, other.kind) and torch.equal(again.steps, other.steps)


@pytest.mark.parametrize("bias_deg", [0.05, pytest.param(0.3, marks=pytest.mark.large)])
def test_they_tell_a_bias_from_noise(bias_deg: float) -> None:
    """By loop closures alone it seems as if odometry erred far more than these say, as if made of odometry."""
    case = drawn("hills: 30 % random")
    graph = by_rotations(linked(case, 0.3, by_truth=True))
    right = solve(graph, profile="slam")
    biased = without_bias(graph, np.radians([0.0, 0.0, -bias_deg]))
    assert len(with_links(biased)[1]) == num_links(graph)
    solution = solve(biased, profile="slam")
    assert error_deg(case, solution) < 1.05 * error_deg(case, right) + 0.02
    np.testing.assert_array_equal(solution.outlier_score > 0.5, right.outlier_score > 0.5)


def test_a_gyroscopes_bias_is_the_chains_alone() -> None:
    graph, links = with_links(linked(drawn("building: 30 % random", 1), 0.3, by_truth=True))
    unbiased = without_bias(graph, np.array([0.0, 0.0, 0.01]))
    is_same = rotations.angle_between(unbiased.target_from_source, graph.target_from_source) < 1e-6
    assert is_same[links].all()
    chain = graph.is_odometry.clone()
    chain[links] = False
    assert not is_same[chain].any()


def test_a_graph_that_grows_ends_where_a_whole_solve_does() -> None:
    case = drawn("building: 30 % random", 1)
    graph = linked(case, 0.3, by_truth=True)
    now = until(graph, graph.num_nodes - 30)
    solution = solve(now, profile="slam")
    for count in range(graph.num_nodes - 20, graph.num_nodes + 1, 10):
        before, now = now, until(graph, count)
        solution = solve(now, profile="slam", warm_start=grown(now, solution), memory=solution.memory)
        assert isinstance(solution.memory, SlamMemory)
        assert solution.memory.links.max() >= before.num_edges, "new ones are links, too"
    cold = solve(now, profile="slam")
    assert error_deg(case, solution) < 1.05 * error_deg(case, cold) + 0.02
    np.testing.assert_array_equal(solution.outlier_score > 0.5, cold.outlier_score > 0.5)
    kept = solution.memory.labels
    assert isinstance(kept, KeptLabels)
    resumed = solve(now, profile="slam", warm_start=solution.body_from_world, memory=kept)
    assert not resumed.is_anew
    assert isinstance(resumed.memory, SlamMemory)
    np.testing.assert_array_equal(resumed.memory.links, with_links(now)[1])
    np.testing.assert_array_equal(resumed.outlier_score > 0.5, cold.outlier_score > 0.5)
    assert error_deg(case, resumed) < 1.05 * error_deg(case, cold) + 0.02
