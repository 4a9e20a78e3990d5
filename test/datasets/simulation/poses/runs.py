"""A small drawn run for the tests of wrong places."""

from __future__ import annotations

import numpy as np

from rotavg_ros.datasets.simulation.poses.drawn import DrawnPoses, Noise, Poses, redrawn
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph

NOISE = Noise(0.5, 0.01, 1.0, 0.05)


def run(dimensions: int = 2, seed: int = 0, keyframes: int = 400) -> DrawnPoses:
    """Laps through a building or over hills, with a closure at every other keyframe."""
    config = SlamSimulationConfig(
        num_keyframes=keyframes,
        dimensions=dimensions,
        terrain_tilt_deg=10.0 * (dimensions == 3),
        closures_per_keyframe=0.5,
        false_share=0.0,
    )
    rng = np.random.default_rng(seed)
    simulated = simulate_slam_graph(config, rng)
    truth = simulated.to_graph_file().body_from_world_gt
    assert truth is not None
    return redrawn(simulated.graph, Poses(truth, simulated.position, simulated.planar), NOISE, rng)
