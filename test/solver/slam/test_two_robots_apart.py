"""Two robots that nothing joins: one's noise leaves the other's answer and certainty alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, rotations, solve
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph
from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.posterior.moves.starts import _turned_parts
from rotavg_ros.solver.slam.posterior.solve import Drawn


def _hills(seed: int, step_deg: float, closure_deg: float) -> ViewGraph:
    config = SlamSimulationConfig(
        num_keyframes=80,
        laps=3.0,
        dimensions=3,
        terrain_tilt_deg=10.0,
        sway_deg=3.0,
        closures_per_keyframe=0.4,
        false_share=0.3,
        odometry_noise_deg=step_deg,
        closure_noise_deg=closure_deg,
    )
    return simulate_slam_graph(config, np.random.default_rng(seed)).graph


def _beside(one: ViewGraph, other: ViewGraph) -> ViewGraph:
    return ViewGraph.create(
        torch.cat((one.source, other.source + one.num_nodes)),
        torch.cat((one.target, other.target + one.num_nodes)),
        torch.cat((one.target_from_source, other.target_from_source)),
        kind=torch.cat((one.kind, other.kind)),
    )


@pytest.mark.large
def test_a_part_that_is_turned_with_its_root_is_no_other_answer() -> None:
    """The first keyframe is certain, and what hangs on it as certain as alone."""
    for seed in range(3):
        exact, poor = _hills(seed, 0.1, 0.3), _hills(seed + 50, 3.0, 4.0)
        both = _beside(exact, poor)
        alone, beside = solve(exact, profile="slam"), solve(both, profile="slam")
        stated = beside.uncertainty[: exact.num_nodes]
        assert float(stated[0]) < 1e-5
        assert float(stated.mean()) < 1.5 * float(alone.uncertainty.mean())
        assert not any("they judge 0 closures" in text for text in beside.warnings)


def test_moves_that_turn_a_whole_component_are_counted_from_its_root() -> None:
    """The start by minimum cuts, of two components of which one was turned as a whole."""
    one, other = _hills(1, 0.3, 1.0), _hills(2, 0.3, 1.0)
    both = _beside(one, other)
    drawn = Drawn.of(both, Networks("cpu").load(SlamCleanNet))
    graph = drawn.prepared.closure_graph
    turned = rotations.identity(graph.num_nodes).clone()
    of_other = torch.from_numpy(graph.nodes >= one.num_nodes)
    turned[of_other] = torch.from_numpy(Rotation.from_rotvec([0.0, 2.0, 0.0]).as_quat())
    found = _turned_parts(drawn.problem, drawn.prepared, turned, drawn.prepared.noise)
    roots = found[torch.from_numpy(graph.roots)]
    assert float(rotations.angle(roots).max()) < 1e-7
