"""Where there is a GPU: both networks, whole solves, and what a node solves with say on it what they say on the CPU."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
import torch

from rotavg_ros import (
    EdgeMeasurement,
    EstimatorOptions,
    KeyframeReference,
    OnlineEstimator,
    ViewGraph,
    rotations,
    solve,
)
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, SyntheticGraph
from rotavg_ros.online import Answer
from rotavg_ros.online.solver_process.client import SolverProcess
from rotavg_ros.solver import devices
from rotavg_ros.solver.networks import NETWORKS
from rotavg_ros.solver.neurora.network_store import load_network
from rotavg_ros.solver.neurora.stages import clean, fine_tune

TOLERANCE_DEG = 1e-3


def usable(device: str) -> bool:
    return device == "cpu" or devices.gpu_problem() is None


@pytest.fixture(params=["cuda"])
def device(request: pytest.FixtureRequest) -> str:
    if not usable(request.param):
        pytest.skip(f"no usable GPU on this machine: {devices.gpu_problem()}")
    return str(request.param)


@pytest.fixture(scope="module")
def photographs() -> SyntheticGraph:
    return PaperRecipe(cameras=(150, 150)).sample(np.random.default_rng(0))


def degrees(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float(torch.rad2deg(rotations.angle_between(found, expected)).max())


@torch.no_grad()
def test_networks(device: str, photographs: SyntheticGraph) -> None:
    clean_net, fine_net = (load_network(NETWORKS[name]) for name in ("sfm-clean-net", "sfm-fine-net"))
    here = clean(clean_net, photographs.graph)
    there = clean(deepcopy(clean_net).to(device), photographs.graph)
    assert degrees(there.graph.target_from_source, here.graph.target_from_source) < TOLERANCE_DEG
    torch.testing.assert_close(there.outlier_probability, here.outlier_probability, atol=1e-4, rtol=0)
    assert torch.equal(there.is_inlier, here.is_inlier)
    tuned = fine_tune(fine_net, here, photographs.body_from_world)
    tuned_there = fine_tune(deepcopy(fine_net).to(device), here, photographs.body_from_world)
    assert degrees(tuned, photographs.body_from_world) > 100 * TOLERANCE_DEG  # it does something
    assert degrees(tuned_there, tuned) < TOLERANCE_DEG


def test_a_solve(device: str, photographs: SyntheticGraph) -> None:
    here, there = (solve(photographs.graph, device=where) for where in ("cpu", device))
    assert there.device == device
    assert torch.equal(there.outlier_score > 0.5, here.outlier_score > 0.5)
    assert degrees(there.body_from_world, here.body_from_world) < TOLERANCE_DEG


def test_the_process_that_a_node_solves_in(device: str, photographs: SyntheticGraph) -> None:
    here, process = solve(photographs.graph, device="cpu"), SolverProcess(threads=1)
    try:
        there = process(photographs.graph, device=device)
    finally:
        process.close()
    assert there.device == device
    assert torch.equal(there.outlier_score > 0.5, here.outlier_score > 0.5)
    assert degrees(there.body_from_world, here.body_from_world) < TOLERANCE_DEG


@pytest.mark.parametrize("is_robots", [False, True])
def test_what_a_node_answers(device: str, photographs: SyntheticGraph, is_robots: bool) -> None:
    """Over ticks that go on from each other to the cold one at the end; a robot's graph stays on the CPU."""
    graph = photographs.graph
    if is_robots:
        graph = simulate_slam_graph(SlamSimulationConfig(num_keyframes=200), np.random.default_rng(0)).graph
    here, there = (answered(graph, where) for where in ("cpu", device))
    assert there[-1].device == ("cpu" if is_robots else device)
    for a, b in zip(here, there, strict=True):
        assert a.outlier.tolist() == b.outlier.tolist()
        assert degrees(torch.from_numpy(a.world_from_body), torch.from_numpy(b.world_from_body)) < TOLERANCE_DEG


def answered(graph: ViewGraph, device: str) -> list[Answer]:
    """What the estimator says of a graph that comes in three parts."""
    online = OnlineEstimator(
        EstimatorOptions(device=device, gauge="identity", keyframe_source="edges", unknown_keyframes="create")
    )
    columns = (graph.source, graph.target, graph.target_from_source, graph.kind)
    answers = []
    for part in np.array_split(np.arange(graph.num_edges), 3):
        for edge in part.tolist():
            source, target, rotation, kind = (column[edge].tolist() for column in columns)
            ends = KeyframeReference("r", source), KeyframeReference("r", target)
            online.add_edge(EdgeMeasurement(edge, *ends, rotation, kind))
        answers.append(online.tick())
    while (answer := online.tick()) is not None:
        answers.append(answer)
    return answers
