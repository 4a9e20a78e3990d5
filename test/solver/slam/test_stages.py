"""How the SLAM profile's network takes part in the verdicts, with a network whose answer is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from rotavg_ros import solve
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.ground_truth import attach_stamps, attach_truth
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.preparation import Prepared, prepare
from rotavg_ros.solver.slam.stages import bootstrap, clean, refine_and_search
from rotavg_ros.view_graph import EdgeLabel, ViewGraph
from test.solver.graphs import measured, random_truth, slam_edges, small_noise


def verdict(log_odds: float) -> SlamCleanNet:
    """A network that says the same log-odds of being false of every closure."""
    network = SlamCleanNet()
    nn.init.zeros_(network.outlier_head.weight)
    nn.init.constant_(network.outlier_head.bias, log_odds)
    return network.requires_grad_(False)


def graph_with_a_doubtful_closure() -> tuple[ViewGraph, int]:
    """200 keyframes, 60 good closures of 1°, and one more (the last edge) that is off by 5°."""
    source, target, kind = slam_edges(200, 61, 0)
    noise = small_noise(len(source), np.where(kind == 0, 0.2, 1.0), 1).as_rotvec()
    noise[-1] = np.radians([3.0, 4.0, 0.0])
    graph = measured(random_truth(200, 2), source, target, Rotation.from_rotvec(noise), kind=kind)
    return graph, len(source) - 1


def probability_of(prepared: Prepared, graph: ViewGraph, edge: int, log_odds: float | None) -> float:
    """Of being good, after the refinement."""
    network = None if log_odds is None else verdict(log_odds)
    cleaned = clean(network, prepared, graph.label)
    estimate = refine_and_search(prepared, cleaned, bootstrap(prepared, cleaned))
    return float(prepared.closure_graph.edge_values(estimate.inlier_probability)[edge])


def test_the_network_sways_a_doubtful_verdict_and_not_a_clear_one() -> None:
    graph, doubtful = graph_with_a_doubtful_closure()
    prepared = prepare(graph)
    suspicious, silent, trusting = (probability_of(prepared, graph, doubtful, v) for v in (9.0, None, -9.0))
    assert suspicious < silent < trusting
    clear = int(np.flatnonzero(graph.kind.numpy() == 1)[0])
    assert probability_of(prepared, graph, clear, 9.0) > 0.9


@pytest.mark.parametrize("log_odds", [100.0, -100.0])
def test_no_network_overrules_a_label(log_odds: float) -> None:
    graph, _ = graph_with_a_doubtful_closure()
    closures = np.flatnonzero(graph.kind.numpy() == 1)
    label = graph.label.clone()
    label[closures[0]], label[closures[1]] = EdgeLabel.ACCEPTED, EdgeLabel.REJECTED
    graph = replace(graph, label=label)
    prepared = prepare(graph)
    for edge, expected in ((int(closures[0]), 1.0), (int(closures[1]), 0.0)):
        assert probability_of(prepared, graph, edge, log_odds) == expected


def test_the_network_counts_less_the_more_is_false() -> None:
    graph, _ = graph_with_a_doubtful_closure()
    prepared = prepare(graph)
    said = []
    for share in (0.1, 0.5, 0.9):
        noise = replace(prepared.noise, outlier_share=share)
        prior = clean(verdict(2.0), replace(prepared, noise=noise), graph.label).network_log_odds
        assert (prior[prepared.closure_graph.is_odometry] == 0).all()
        said.append(float(np.unique(prior[prepared.closure_graph.is_closure]).item()))
    assert -2 < said[0] < said[1] < said[2] < 0


@pytest.mark.parametrize("keyframes", [2480, 3120, 3360])
def test_a_robot_whose_closures_are_mostly_false_so_far_is_no_worse_off(shared_data: Path, keyframes: int) -> None:
    """The moments of B25b at which false closures passed as drift and the answer was off by up to 3.7° more."""
    folder = shared_data / "slam" / "b25b"
    stamped = attach_stamps(read_graph(folder / "B25b_0.000.g2o"), folder / "B25b_timestamps.txt")
    truth = attach_truth(stamped, folder / "ground_truth.csv").body_from_world_gt
    assert truth is not None
    known = torch.from_numpy(truth[:keyframes])
    known_rows = torch.isfinite(known).all(dim=1)

    def error_deg(edges: Tensor) -> float:
        kept = stamped.graph.select_edges(edges)
        answer = solve(replace(kept, num_nodes=keyframes)).body_from_world
        return float(torch.rad2deg(orientation_errors(answer[known_rows], known[known_rows]).mean()))

    arrived = torch.maximum(stamped.graph.source, stamped.graph.target) < keyframes
    assert error_deg(arrived) < error_deg(arrived & stamped.graph.is_odometry) + 0.5
