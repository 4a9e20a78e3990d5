"""What keyframes are called is nobody's business: the answer is the same to .05 degrees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations, solve
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.evaluation.common.cases import drawings
from rotavg_ros.evaluation.slam import stress
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.view_graph import ViewGraph


def renumbered(graph: ViewGraph, rng: np.random.Generator) -> tuple[ViewGraph, torch.Tensor]:
    """Other numbers for all keyframes, half of the edges stated from their other end; and which is which.

    But the beginning of the path has a lower number than its end: nothing else tells which way time goes.
    """
    number = torch.from_numpy(rng.permutation(graph.num_nodes))
    number[[0, -1]] = number[[0, -1]].sort().values
    changed = replace(graph, source=number[graph.source], target=number[graph.target])
    return changed.reverse_edges(torch.from_numpy(rng.random(graph.num_edges) < 0.5)), number


@pytest.mark.parametrize(
    "kind",
    [
        "building: 30 % random",
        "hills: gyroscope bias, 30 % random",
        *(
            pytest.param(kind, marks=pytest.mark.large)
            for kind in ("sphere: 50 % random", "grid: 30 % near misses in groups")
        ),
    ],
)
def test_other_numbers_of_keyframes_change_nothing(kind: str) -> None:
    graph = drawn(kind, 3).graph
    changed, number = renumbered(graph, np.random.default_rng(0))
    expected, found = solve(graph, profile="slam"), solve(changed, profile="slam")
    assert largest_turn_deg(expected.body_from_world, found.body_from_world[number]) < 0.05
    torch.testing.assert_close(found.outlier_score, expected.outlier_score, atol=0.01, rtol=0)


@pytest.mark.large
@pytest.mark.parametrize(
    "kind", ["building: closures of 6°", pytest.param("hills: gyroscope bias, 30 % random", marks=pytest.mark.large)]
)
def test_nor_do_they_with_translations(kind: str) -> None:
    graph = next(drawings(stress.kinds((kind,), translations=True), [3])).graph
    changed, number = renumbered(graph, np.random.default_rng(0))
    expected, found = solve(graph), solve(changed)
    assert expected.position is not None and found.position is not None
    assert largest_turn_deg(expected.body_from_world, found.body_from_world[number]) < 0.05
    torch.testing.assert_close(found.outlier_score, expected.outlier_score, atol=0.01, rtol=0)


@pytest.mark.parametrize("kind", ["building: 30 % random", "hills: gyroscope bias, 30 % random"])
def test_uncertainty_is_that_of_turns_since_the_first_keyframe(kind: str) -> None:
    """Which is none of itself; between two keyframes it is the same, whichever of both is the first."""
    graph = drawn(kind, 3).graph
    middle, number = graph.num_nodes // 2, torch.arange(graph.num_nodes)
    number[[0, middle]] = number[[middle, 0]]
    changed = replace(graph, source=number[graph.source], target=number[graph.target])
    # The one answer, since rivals' shares and the variances of each differ a little.
    expected, found = (solve(each, profile="slam", method="neurora~rivals").uncertainty for each in (graph, changed))
    assert found[0] < 1e-5 and expected[0] < 1e-4
    torch.testing.assert_close(found[middle], expected[middle], rtol=0.02, atol=0)
    assert found.median() < 0.9 * expected.median()


def largest_turn_deg(one: torch.Tensor, other: torch.Tensor) -> float:
    """Between orientations ``(N, 4)`` of one component whose gauges may differ, those of its first keyframe held."""
    turns = [rotations.multiply(each, rotations.inverse(each[:1]).expand_as(each)) for each in (one, other)]
    return float(torch.rad2deg(rotations.angle_between(*turns)).max())


def drawn(kind: str, seed: int) -> DrawnGraph:
    return next(each for each in KINDS if each.name == kind).drawn(seed)


@pytest.mark.parametrize("seed", [2, pytest.param(3, marks=pytest.mark.large)])
def test_a_slip_is_found_wherever_the_keyframe_of_the_first_number_lies(seed: int) -> None:
    """The tree has its root there; what comes before it is as far from it as what comes after."""
    graph = drawn("lone slip: 10 witnesses, three pairs of places", seed).graph
    number = torch.arange(graph.num_nodes)
    middle = graph.num_nodes // 2
    number[[0, middle]] = number[[middle, 0]]
    changed = replace(graph, source=number[graph.source], target=number[graph.target])
    expected, found = solve(graph, profile="slam"), solve(changed, profile="slam")
    assert largest_turn_deg(expected.body_from_world, found.body_from_world[number]) < 1e-3
    torch.testing.assert_close(found.outlier_score, expected.outlier_score, atol=1e-3, rtol=0)
    assert found.warnings == expected.warnings or len(found.warnings) == len(expected.warnings) == 1


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in (2, 3))])
def test_a_second_robot_that_slipped_is_joined_in_the_middle_of_its_path(seed: int) -> None:
    """Closures enter its chain there. The witnesses of its slip lie on both sides."""
    one, other = drawn("building: 30 % random", seed), drawn("lone slip: 10 witnesses, three pairs of places", seed)
    rng = np.random.default_rng(seed)
    count, middle = one.graph.num_nodes, other.graph.num_nodes // 2
    here, there = rng.integers(0, count, 12), rng.integers(middle - 30, middle + 30, 12)
    truth = torch.from_numpy(np.concatenate((one.body_from_world, other.body_from_world)))
    noise = rotations.exp(torch.from_numpy(rng.normal(size=(12, 1)) * np.radians([[0.0, 0.0, 1.0]])))
    turn = rotations.multiply(truth[count + there], rotations.inverse(truth[here]))
    graph = ViewGraph.create(
        torch.cat((one.graph.source, other.graph.source + count, torch.from_numpy(here))),
        torch.cat((one.graph.target, other.graph.target + count, torch.from_numpy(count + there))),
        torch.cat((one.graph.target_from_source, other.graph.target_from_source, rotations.multiply(noise, turn))),
        kind=torch.cat((one.graph.kind, other.graph.kind, torch.ones(12, dtype=torch.int64))),
    )
    solution = solve(graph, profile="slam")
    error = orientation_errors(solution.body_from_world, truth, graph.components())
    assert float(torch.rad2deg(error).mean()) < 1.0
    is_wrong = torch.from_numpy(np.concatenate((one.is_wrong, other.is_wrong, np.zeros(12, dtype=bool))))
    good = ~is_wrong & ~graph.is_odometry
    assert not bool((solution.outlier_score[good] > 0.5).any())
