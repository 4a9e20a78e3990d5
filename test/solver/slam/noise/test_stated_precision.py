"""Stated precisions are believed where residuals bear them out, and do no harm where they do not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from rotavg_ros import ViewGraph, solve
from rotavg_ros.datasets.simulation.slam_simulation import (
    Precisions,
    SimulatedRun,
    SlamSimulationConfig,
    simulate_slam_graph,
)
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.online.answer.gauge import extend_along_edges
from rotavg_ros.solver.slam.noise.model import NoiseModel
from rotavg_ros.solver.slam.noise.stated_precision import StatedTrust, estimate_trust

NUM_CLOSURES = 400
NUM_KEYFRAMES = 300
NOISE = NoiseModel(3, np.radians(0.1) ** 2, np.radians(1.5) ** 2, 0.3)


def discrepancies(exponent: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stated variances, squared discrepancies and their predictions' variances; three closures in ten are false."""
    rng = np.random.default_rng(seed)
    stated = np.exp(1.6 * rng.standard_normal(NUM_CLOSURES))
    predicted = np.radians(0.3) ** 2 * rng.exponential(size=NUM_CLOSURES)
    variance = np.radians(1.0) ** 2 * stated**exponent + predicted
    square = variance * (rng.standard_normal((NUM_CLOSURES, 3)) ** 2).sum(axis=1)
    is_false = rng.random(NUM_CLOSURES) < 0.3
    square[is_false] = rng.uniform(np.radians(10), np.pi, int(is_false.sum())) ** 2
    return stated * 1e-6, square, predicted


def trust_in(stated: np.ndarray, square: np.ndarray, predicted: np.ndarray) -> StatedTrust:
    good = np.where(square < np.radians(10) ** 2, 0.99, 0.01)
    return estimate_trust(NOISE, stated, good, square, predicted, np.ones(NUM_CLOSURES))


@pytest.mark.parametrize("exponent", [0.0, 0.5, 1.0])
def test_the_exponent_is_found(exponent: float) -> None:
    found = [trust_in(*discrepancies(exponent, seed)).exponent for seed in range(5)]
    assert np.median(found) == pytest.approx(exponent, abs=0.12)


def test_absurd_and_missing_variances_do_not_matter() -> None:
    stated, square, predicted = discrepancies(1.0, 0)
    square[:20] = np.radians(1.0) ** 2
    stated[:20] = np.tile([1e-300, 1e300, np.nan, np.inf], 5)
    trust = trust_in(stated, square, predicted)
    assert trust.exponent > 0.8
    relative = trust.relative_variance(stated)
    assert (relative[:20] == 1).all()
    assert relative[20:].std() > 1 and relative.min() > 0.2


@cache
def run(seed: int) -> SimulatedRun:
    """Closures that err by 0.3 to 5 degrees, and say so but for a factor."""
    config = SlamSimulationConfig(
        world=World.CITY,
        num_keyframes=NUM_KEYFRAMES,
        odometry_noise_deg=0.5,
        closures_per_keyframe=0.6,
        closure_noise_deg=2.0,
        noise_spread=0.8,
        false_share=0.2,
        precisions=Precisions.SCALED,
        closure_precision_factor=20.0,
    )
    return simulate_slam_graph(config, np.random.default_rng(seed))


def with_precisions(graph: ViewGraph, stated: str, seed: int) -> ViewGraph:
    closure = (~graph.is_odometry).nonzero().squeeze(1)
    precision = graph.precision.clone()
    precision[closure] = {
        "right": precision[closure],
        "missing": torch.full((len(closure),), torch.nan, dtype=torch.float64),
        "next to nothing": torch.full((len(closure),), 5e-324, dtype=torch.float64),
        "unit": torch.ones(len(closure), dtype=torch.float64),
        "permuted": precision[closure[torch.from_numpy(np.random.default_rng(seed).permutation(len(closure)))]],
    }[stated]
    return replace(graph, precision=precision)


def mean_errors(stated: str, num_seeds: int = 4) -> np.ndarray:
    errors = []
    for seed in range(num_seeds):
        solution = solve(with_precisions(run(seed).graph, stated, seed), profile="slam")
        truth = torch.from_numpy(run(seed).world_from_body) * torch.tensor([-1.0, -1.0, -1.0, 1.0])
        errors.append(float(orientation_errors(solution.body_from_world, truth).mean()))
    return np.array(errors)


def test_right_precisions_help_and_wrong_ones_do_no_harm() -> None:
    missing = mean_errors("missing")
    for uninformative in ("unit", "next to nothing"):
        np.testing.assert_array_equal(mean_errors(uninformative, 1), missing[:1])
    assert np.exp(np.log(mean_errors("right") / missing).mean()) < 0.95
    assert np.abs(np.log(mean_errors("permuted") / missing)).max() < 0.02


def test_an_update_believes_what_the_whole_solve_did() -> None:
    graph = run(0).graph
    known = int((torch.maximum(graph.source, graph.target) < NUM_KEYFRAMES - 2).sum())
    before = solve(replace(graph.select_edges(torch.arange(known)), num_nodes=NUM_KEYFRAMES - 2), profile="slam")
    after = solve(graph, warm_start=extend_along_edges(before.body_from_world, graph), memory=before.memory)
    assert "refine" not in after.stage_seconds
    assert before.memory is not None and after.memory is not None
    closure = (~graph.is_odometry).numpy()
    relative = before.memory.trust.relative_variance(1 / graph.precision.numpy())[closure]
    assert np.log(relative).std() > 0.5
    # A closure that errs as its neighbours do weighs less than that, but none more.
    factor = after.memory.steps[closure] / relative
    assert factor.min() >= 1 - 1e-9 and np.median(factor) < 2
