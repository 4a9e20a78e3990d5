"""Graphs most of whose closures are measured between keyframes that follow each other closely."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.rotations import multiply
from rotavg_ros.solver import solve
from rotavg_ros.solver.estimate import Run, Stopwatch
from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.slam.links import links_of, solved_in_two_parts
from rotavg_ros.solver.slam.options import SlamStages
from rotavg_ros.solver.slam.solve import whole
from rotavg_ros.view_graph import ViewGraph

from .linked_keyframes import SPANS, drawn, error_deg, linked


def num_links(graph: ViewGraph) -> int:
    return int((graph.num_nodes - np.array(SPANS)).sum())


def in_two_parts(graph: ViewGraph) -> bool:
    """Whether the search was made without links, and they do not contradict it."""
    links, run = links_of(graph), Run(Networks("cpu"), Stopwatch())
    assert links is not None
    with torch.no_grad():
        return solved_in_two_parts(graph, links, lambda reduced: whole(reduced, SlamStages(), run), run) is not None


@pytest.mark.parametrize("translations", [False, pytest.param(True, marks=pytest.mark.large)])
def test_they_help_and_take_little(translations: bool) -> None:
    case = drawn("hills: 30 % random")
    graph = linked(case, 0.3, by_truth=True)
    alone = replace(case.graph, translation=torch.from_numpy(case.edge_translation))
    if not translations:
        graph, alone = (replace(each, translation=None) for each in (graph, alone))
    solution, without = solve(graph, profile="slam"), solve(alone, profile="slam")
    assert error_deg(case, solution) < error_deg(case, without)
    flagged = solution.outlier_score.numpy() > 0.5
    np.testing.assert_array_equal(flagged[: alone.num_edges], without.outlier_score.numpy() > 0.5)
    assert not flagged[alone.num_edges :].any()
    # Beside the first search, one solve of all of them.
    assert solution.work < 4 * without.work
    assert solution.is_anew


def test_false_ones_among_them_are_flagged() -> None:
    graph = linked(drawn("building: 30 % random", 1), 0.3, by_truth=True)
    stated, rng = graph.target_from_source.clone(), np.random.default_rng(0)
    false = graph.num_edges - 1 - rng.choice(num_links(graph), 8, replace=False)
    for edge in false:
        off = Rotation.from_rotvec([0, 0, rng.uniform(0.5, 2.5)]) * Rotation.from_quat(stated[edge].numpy())
        stated[edge] = torch.from_numpy(off.as_quat(canonical=True))
    graph = replace(graph, target_from_source=stated, translation=None)
    assert in_two_parts(graph)
    flagged = np.flatnonzero(solve(graph, profile="slam").outlier_score.numpy() > 0.5)
    links = flagged[flagged >= graph.num_edges - num_links(graph)]
    np.testing.assert_array_equal(links, np.sort(false))


def test_a_slip_is_found_at_its_step() -> None:
    """Loop closures alone would leave open where, so that the search is made with all closures."""
    graph = linked(drawn("hills: 30 % random"), 0.3, by_truth=True)
    stated, step = graph.target_from_source.clone(), int(graph.is_odometry.nonzero()[250])
    slip = torch.from_numpy(Rotation.from_rotvec([0.0, 0.0, np.radians(25)]).as_quat())
    stated[step] = multiply(slip, stated[step])
    graph = replace(graph, target_from_source=stated, translation=None)
    solution = solve(graph, profile="slam")
    odometry = graph.is_odometry.numpy()
    assert np.flatnonzero((solution.outlier_score.numpy() > 0.5) & odometry).tolist() == [step]
    assert not (solution.outlier_score.numpy()[-num_links(graph) :] > 0.5).any()


def test_few_of_them_are_closures_like_any_other() -> None:
    for kind in ("building: 30 % random", "grid: 30 % random", "2 robots: half random"):
        assert links_of(drawn(kind).graph) is None
    case = drawn("hills: 30 % random")
    assert links_of(linked(case)) is None, "these are made of odometry"
