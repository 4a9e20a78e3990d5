"""Runs of which little is known: what is left of them, and that nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.scarce_evidence import several_robots, slip_with_few_witnesses
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.view_graph import EdgeKind

RUN = simulate_slam_graph(SlamSimulationConfig(num_keyframes=300, closures_per_keyframe=0.5), np.random.default_rng(0))


@pytest.mark.parametrize("seed", range(5))
def test_one_step_slips_and_few_good_closures_lie_across(seed: int) -> None:
    slipped = slip_with_few_witnesses(RUN, np.random.default_rng(seed))
    ends = np.sort((slipped.graph.source.numpy(), slipped.graph.target.numpy()), axis=0)
    is_odometry = slipped.graph.kind.numpy() == EdgeKind.ODOMETRY
    assert is_odometry.sum() == 299
    world_from_body = Rotation.from_quat(slipped.world_from_body)
    source, target = slipped.graph.source.numpy(), slipped.graph.target.numpy()
    true = world_from_body[target].inv() * world_from_body[source]
    noise = (Rotation.from_quat(slipped.graph.target_from_source.numpy()) * true.inv()).magnitude()
    np.testing.assert_allclose(noise, slipped.edge_noise, atol=1e-6)
    (slip,) = np.flatnonzero(is_odometry & (noise > np.radians(4.0)))
    across = ~is_odometry & (ends[0] <= ends[0, slip]) & (ends[1] > ends[0, slip])
    assert 1 <= (across & ~slipped.closure_is_false).sum() <= 30
    # Closures elsewhere are all there.
    before = np.sort((RUN.graph.source.numpy(), RUN.graph.target.numpy()), axis=0)
    elsewhere = (RUN.graph.kind.numpy() != EdgeKind.ODOMETRY) & (
        (before[0] > ends[0, slip]) | (before[1] <= ends[0, slip])
    )
    assert (~is_odometry & ~across).sum() == elsewhere.sum()


@pytest.mark.parametrize("seed", range(5))
def test_robots_are_joined_by_closures_alone(seed: int) -> None:
    several = several_robots(RUN, np.random.default_rng(seed))
    is_odometry = several.graph.kind.numpy() == EdgeKind.ODOMETRY
    assert 299 - 5 <= is_odometry.sum() <= 299 - 1
    assert (
        (~is_odometry).sum()
        == (RUN.graph.kind.numpy() != EdgeKind.ODOMETRY).sum()
        == len(several.closure_is_false) - (is_odometry.sum())
    )
