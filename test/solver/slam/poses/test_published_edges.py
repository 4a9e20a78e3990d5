"""What is published of single edges: scores as labelled, and the precisions with which the solve counted them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations, solve
from rotavg_ros.datasets.files.corrected_graph import is_told
from rotavg_ros.solver import Solution
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

from .test_poses import graph_of, simulated


def in_file(graph: ViewGraph, solution: Solution) -> np.ndarray:
    """``(M,)`` bool, edges of ``graph.g2o``."""
    assert solution.rotation_score is not None and solution.edge_precision is not None
    judged = solution.rotation_score.numpy(), solution.edge_precision.numpy()
    return is_told(solution.outlier_score.numpy() > 0.5, graph.is_odometry.numpy(), judged)


def test_labels_decide_both_scores_and_which_closures_a_back_end_gets() -> None:
    graph = graph_of(simulated(1, num_keyframes=200))
    closures = np.flatnonzero(~graph.is_odometry.numpy())
    good, turned = closures[:3], closures[7]
    label, measured = graph.label.clone(), graph.target_from_source.clone()
    label[good], label[turned] = EdgeLabel.REJECTED, EdgeLabel.ACCEPTED
    sixty = torch.tensor([0.0, 0.0, 0.5, 0.75**0.5]).double()
    measured[turned] = rotations.canonical(rotations.multiply(sixty, measured[turned]))
    labelled = replace(graph, label=label, target_from_source=measured)
    solution = solve(labelled)
    assert solution.rotation_score is not None
    for score in (solution.outlier_score, solution.rotation_score):
        assert (score[good] == 1.0).all() and score[turned] == 0.0
    told = in_file(labelled, solution)
    assert not told[good].any() and told[turned]


def beside(graph: ViewGraph, world_from_body: Rotation, position: np.ndarray) -> ViewGraph:
    """The graph with a second odometry over five keyframes each, the fourth of which a user has rejected."""
    rng, begin = np.random.default_rng(0), 6 * np.arange(25)
    end, count = begin + 5, len(begin)
    noise = Rotation.from_rotvec(0.01 * rng.normal(size=(count, 1)) * [0.0, 0.0, 1.0])
    turn = (world_from_body[end].inv() * world_from_body[begin] * noise).as_quat()
    shift = world_from_body[begin].inv().apply(position[end] - position[begin])
    shift[:, :2] += 0.02 * rng.normal(size=(count, 2))
    label = np.where(np.arange(count) == 3, int(EdgeLabel.REJECTED), int(EdgeLabel.AUTOMATIC))
    assert graph.translation is not None
    return ViewGraph.create(
        torch.cat((graph.source, torch.from_numpy(begin))),
        torch.cat((graph.target, torch.from_numpy(end))),
        torch.cat((graph.target_from_source, torch.from_numpy(turn))),
        kind=torch.cat((graph.kind, torch.zeros(count, dtype=graph.kind.dtype))),
        label=torch.cat((graph.label, torch.from_numpy(label))),
        translation=torch.cat((graph.translation, torch.from_numpy(shift))),
    )


def test_rejected_odometry_beside_the_chain_is_published_with_next_to_no_weight() -> None:
    run = simulated(1, num_keyframes=200)
    graph = graph_of(run)
    solution = solve(beside(graph, Rotation.from_quat(run.world_from_body), run.position))
    assert solution.edge_precision is not None
    shift = solution.edge_precision[graph.num_edges :, 1]
    assert shift[3] < 1e-6 * shift.median()
    others = torch.cat((shift[:3], shift[4:]))
    assert others.min() > 0.1 * others.median()


@pytest.mark.parametrize("copies", [2, 3])
def test_copies_of_a_measurement_share_its_precision(copies: int) -> None:
    """So that least squares on the file counts it once, as the solve does."""
    graph = graph_of(simulated(8, num_keyframes=200, false_share=0.2))
    some = torch.arange(0, graph.num_edges, 3)
    repeated = graph.select_edges(torch.cat((torch.arange(graph.num_edges), *[some] * (copies - 1))))
    once, several = solve(graph).edge_precision, solve(repeated).edge_precision
    assert once is not None and several is not None
    total = several[: graph.num_edges].clone()
    total[some] += several[graph.num_edges :].reshape(copies - 1, len(some), 2).sum(dim=0)
    torch.testing.assert_close(total, once)
