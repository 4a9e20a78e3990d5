"""Edges to several earlier keyframes that are made of odometry, beside loop closures that are measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.simulation.stress.kinds import KINDS, StressKind
from rotavg_ros.rotations import canonical, inverse, multiply, rotate
from rotavg_ros.solver import solve
from rotavg_ros.solver.methods import DEFAULT_METHOD, without
from rotavg_ros.solver.slam.noise.calibration import Calibration
from rotavg_ros.solver.slam.posterior.solve import Drawn
from rotavg_ros.solver.slam.preparation import made_of_odometry
from rotavg_ros.view_graph import ViewGraph

from ..linked_keyframes import SPANS, drawn, error_deg, linked
from ..update.test_memory import grown, until


def by_rotations(graph: ViewGraph) -> ViewGraph:
    return replace(graph, translation=None)


@pytest.mark.parametrize(
    ("own_deg", "translations"),
    [
        (0.0, True),
        (0.1, False),
        *(pytest.param(*each, marks=pytest.mark.large) for each in ((0.0, False), (0.1, True))),
    ],
)
def test_the_answer_is_that_of_the_graph_without_them(own_deg: float, translations: bool) -> None:
    """Errors of a step are of .3°; taken for measurements, these edges would hide them."""
    case = drawn("hills: 30 % random")
    graph = linked(case, own_deg)
    alone = replace(case.graph, translation=torch.from_numpy(case.edge_translation))
    if not translations:
        graph, alone = by_rotations(graph), by_rotations(alone)
    solution, expected = solve(graph, profile="slam"), solve(alone, profile="slam")
    torch.testing.assert_close(solution.body_from_world, expected.body_from_world, rtol=0, atol=1e-9)
    measured = alone.num_edges
    torch.testing.assert_close(solution.outlier_score[:measured], expected.outlier_score, rtol=0, atol=1e-6)
    assert float(solution.outlier_score[measured:].max()) < 0.01
    assert solution.warnings == expected.warnings
    if translations:
        assert solution.position is not None and expected.position is not None and solution.edge_precision is not None
        torch.testing.assert_close(solution.position, expected.position, rtol=0, atol=1e-6)
        assert not bool(solution.edge_precision[measured:].any())


def test_taken_for_measurements_they_make_right_closures_seem_false() -> None:
    """What the term is for: without it this is odometry's answer, more or less."""
    case = drawn("hills: 30 % random")
    graph = by_rotations(linked(case))
    found, mistaken = (solve(graph, method=method, profile="slam") for method in (DEFAULT_METHOD, without("restated")))
    assert error_deg(case, mistaken) > 2 * error_deg(case, found)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.02, 0.05]), st.booleans())
@settings(max_examples=15, deadline=None)
def test_ends_order_and_axes_do_not_matter(seed: int, own_deg: float, translations: bool) -> None:
    graph = linked(drawn("building: 30 % random", 1), own_deg, seed=seed % 7)
    graph = graph if translations else by_rotations(graph)
    restated = made_of_odometry(graph)
    first = graph.num_edges - int((graph.num_nodes - np.array(SPANS)).sum())
    assert not restated[:first].any()
    assert restated[first:].mean() > 0.98
    rng = np.random.default_rng(seed)
    order = rng.permutation(graph.num_edges)
    other = graph.reverse_edges(torch.from_numpy(rng.random(graph.num_edges) < 0.5)).select_edges(
        torch.from_numpy(order)
    )
    np.testing.assert_array_equal(made_of_odometry(other), restated[order])
    axes = torch.from_numpy(Rotation.random(random_state=seed % 1000).as_quat()).expand(graph.num_edges, 4)
    stated = canonical(multiply(multiply(axes, graph.target_from_source), inverse(axes)))
    turned = replace(graph, target_from_source=stated)
    if graph.translation is not None:
        turned = replace(turned, translation=rotate(axes, graph.translation))
    np.testing.assert_array_equal(made_of_odometry(turned), restated)


@pytest.mark.parametrize("kind", ["building: 30 % random", "hills: 30 % random", "grid: 50 % random"])
@pytest.mark.parametrize("own_deg", [0.02, 0.3, 2.0])
def test_what_is_measured_is_a_measurement(kind: str, own_deg: float) -> None:
    assert not made_of_odometry(linked(drawn(kind), own_deg, by_truth=True)).any()


@pytest.mark.parametrize("kind", KINDS[::4], ids=lambda kind: kind.name)
def test_no_kind_of_noise_passes_for_it(kind: StressKind) -> None:
    """None of these graphs has an edge that is made of odometry, though some have closures over few keyframes."""
    assert not made_of_odometry(kind.drawn(3).graph).any()


def test_without_noise_all_closures_are_measurements() -> None:
    """Good ones agree exactly with odometry then, over long ways as well."""
    case = drawn("building: 30 % random")
    truth = Rotation.from_quat(case.body_from_world)
    graph = case.graph
    exact = truth[graph.target.numpy()] * truth[graph.source.numpy()].inv()
    wrong = case.is_wrong & ~graph.is_odometry.numpy()
    stated = np.where(wrong[:, None], graph.target_from_source.numpy(), exact.as_quat())
    graph = ViewGraph.create(graph.source, graph.target, stated, kind=graph.kind, num_nodes=graph.num_nodes)
    assert not made_of_odometry(graph).any()
    solution = solve(graph, profile="slam")
    assert error_deg(case, solution) < 1e-3
    np.testing.assert_array_equal(solution.outlier_score.numpy() > 0.5, wrong)


def test_one_of_them_that_contradicts_odometry_is_no_copy() -> None:
    graph = linked(drawn("hills: 30 % random"), 0.05)
    stated, edge = graph.target_from_source.clone(), graph.num_edges - 100
    off = Rotation.from_rotvec([0.0, 0.0, 0.5]) * Rotation.from_quat(stated[edge].numpy())
    stated[edge] = torch.from_numpy(off.as_quat() * np.sign(off.as_quat()[3]))
    restated = made_of_odometry(replace(graph, target_from_source=stated))
    assert not restated[edge]
    assert restated[edge + 1 : edge + 50].all()


def test_six_digits_of_a_file_are_enough(tmp_path: Path) -> None:
    graph = linked(drawn("hills: 30 % random"))
    assert graph.translation is not None
    ids = np.arange(graph.num_nodes)
    lines = [f"VERTEX_SE3:QUAT {node} 0 0 0 0 0 0 1" for node in ids]
    rows = torch.cat((graph.translation, inverse(graph.target_from_source)), dim=1).numpy()
    upper = " ".join("1" if row == column else "0" for row in range(6) for column in range(row, 6))
    for source, target, row in zip(graph.source.tolist(), graph.target.tolist(), rows, strict=True):
        lines.append(f"EDGE_SE3:QUAT {source} {target} " + " ".join(f"{value:.6g}" for value in row) + f" {upper}")
    file = tmp_path / "vins.g2o"
    file.write_text("\n".join(lines) + "\n")
    restated = made_of_odometry(read_graph(file).graph)
    assert restated.sum() == (graph.num_nodes - np.array(SPANS)).sum()


def test_a_bias_that_was_taken_out_of_odometry_changes_nothing() -> None:
    """The edges that are made of odometry have its bias, too."""
    case = drawn("hills: gyroscope bias, 30 % random")
    graph = by_rotations(linked(case))
    found = Drawn.of(graph, None)
    corrected = Drawn.of(graph, None, calibration=replace(Calibration.none(), bias=np.array([0.0, 0.0, 1e-3])))
    restated = [each.problem.graph.restated.edge for each in (found, corrected)]
    assert len(restated[0]) > 100
    np.testing.assert_array_equal(*map(np.sort, restated))


def test_a_graph_that_grows_ends_where_a_whole_solve_does() -> None:
    case = drawn("building: 30 % random", 1)
    graph = linked(case)
    solution = solve(until(graph, graph.num_nodes - 30), profile="slam")
    for count in range(graph.num_nodes - 20, graph.num_nodes + 1, 10):
        now = until(graph, count)
        solution = solve(now, profile="slam", warm_start=grown(now, solution), memory=solution.memory)
        assert set(solution.stage_seconds) == {"update"}
    cold = solve(now, profile="slam")
    assert error_deg(case, solution) < 1.2 * error_deg(case, cold) + 0.1
    assert int(((solution.outlier_score > 0.5) != (cold.outlier_score > 0.5)).sum()) <= 1
