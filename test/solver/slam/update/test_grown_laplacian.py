"""A closure graph that grows: solved from an older factorisation, and what the rest predicts of the new closures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import ViewGraph
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.solver.algebra.laplacian import LaplacianSystem
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.preparation import draw_together
from rotavg_ros.solver.slam.update.grown_laplacian import GrownLaplacian, OlderFactor

NUM_KEYFRAMES = 400


@pytest.fixture(scope="module")
def drive() -> ViewGraph:
    """Four laps of a city, sparsely closed, so that new closures cut segments in two."""
    config = SlamSimulationConfig(
        world=World.CITY, num_keyframes=NUM_KEYFRAMES, laps=4, closures_per_keyframe=0.3, false_share=0.1
    )
    return simulate_slam_graph(config, np.random.default_rng(1001)).graph


def until(drive: ViewGraph, num_keyframes: int) -> tuple[ClosureGraph, np.ndarray]:
    """The closure graph after so many keyframes, and the weights of its edges."""
    reported = torch.maximum(drive.source, drive.target) < num_keyframes
    graph, _ = draw_together(replace(drive.select_edges(reported.nonzero().squeeze(1)), num_nodes=num_keyframes))
    weight = np.where(graph.is_odometry, 1.0, 0.2) / graph.steps
    return graph, weight


def system(graph: ClosureGraph, weight: np.ndarray) -> LaplacianSystem:
    return LaplacianSystem(graph.num_nodes, graph.source, graph.target, weight, graph.roots)


def grown(drive: ViewGraph, ticks: list[int]) -> tuple[ClosureGraph, np.ndarray, GrownLaplacian]:
    """What the last of several ticks has, each of which goes on from the one before; the first factorises."""
    graph, weight = until(drive, ticks[0])
    older = OlderFactor.of(graph, system(graph, weight))
    for num_keyframes in ticks[1:]:
        graph, weight = until(drive, num_keyframes)
        assert older.fits(graph)
        laplacian = GrownLaplacian(older, graph, weight)
        older = laplacian.factor
    return graph, weight, laplacian


def test_a_grown_graph_is_solved_as_one_that_is_factorised(drive: ViewGraph) -> None:
    graph, weight, laplacian = grown(drive, [350, 360, 380, NUM_KEYFRAMES])
    assert len(laplacian.closures) > 5
    rng = np.random.default_rng(0)
    difference = np.radians(5) * rng.standard_normal((len(weight), 3))
    # With no other weights than those of then, the first approximation is the solution.
    for spread, tolerance in ((0.0, 1e-5), (0.5, 3e-3)):
        changed = weight * np.exp(spread * graph.is_closure * rng.standard_normal(len(weight)))
        laplacian.reweight(changed)
        fitted, exact = laplacian.fit(difference), system(graph, changed).fit(difference)
        assert fitted is not None
        assert np.abs(fitted - exact).max() < tolerance * np.abs(exact).max()
    turned_off = np.where(graph.is_closure, weight * 1e-6, weight)
    laplacian.reweight(turned_off)
    assert laplacian.fit(difference) is None


def test_predictions_of_new_closures_are_exact(drive: ViewGraph) -> None:
    graph, weight, laplacian = grown(drive, [350, 370, NUM_KEYFRAMES])
    predicted = laplacian.prediction_variance()
    for edge, variance in zip(laplacian.closures, predicted, strict=True):
        without = np.where(np.arange(len(weight)) == edge, weight * 1e-12, weight)
        force = np.zeros((graph.num_nodes, 1))
        force[graph.target[edge]], force[graph.source[edge]] = 1.0, -1.0
        potential = system(graph, without).solve(force)[:, 0]
        np.testing.assert_allclose(variance, potential[graph.target[edge]] - potential[graph.source[edge]], rtol=1e-3)
