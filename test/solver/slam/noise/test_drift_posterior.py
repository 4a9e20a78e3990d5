"""How uncertain odometry's drift is where few closures tell of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from rotavg_ros import EdgeKind
from rotavg_ros.solver.slam import preparation as slam_preparation
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.drift_posterior import MAX_CLOSURES, expected_step_variance
from test.solver.graphs import measured, random_truth

NUM_NODES = 300
LOW = np.array([5, 9, 40, 42, 100, 130, 135, 210])
HIGH = np.array([180, 170, 260, 120, 190, 290, 280, 295])


def drifting(step_deg: float, closure_deg: float, seed: int, backward: bool = False) -> ClosureGraph:
    """A planar chain with eight closures that overlap."""
    rng = np.random.default_rng(seed)
    ends = (HIGH, LOW) if backward else (LOW, HIGH)
    source = np.concatenate((np.arange(NUM_NODES - 1), ends[0]))
    target = np.concatenate((np.arange(1, NUM_NODES), ends[1]))
    sigma = np.repeat(np.radians([step_deg, closure_deg]), [NUM_NODES - 1, len(LOW)])
    vector = np.array([0, 0, 1.0]) * (sigma * rng.normal(size=len(sigma)))[:, None]
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [NUM_NODES - 1, len(LOW)])
    truth = random_truth(NUM_NODES, seed, planar=True)
    return slam_preparation.prepare(
        measured(truth, source, target, Rotation.from_rotvec(vector), kind=kind)
    ).closure_graph


def test_the_likelihood_is_that_of_errors_with_steps_in_common() -> None:
    graph = drifting(0.2, 0.5, 3, backward=True)
    relative = np.linspace(0.3, 3.0, len(LOW))
    own_steps = graph.own_steps.copy()
    own_steps[graph.is_closure] = relative
    graph = replace(graph, own_steps=own_steps)
    discrepancy = graph.residual[graph.is_closure][:, 2].numpy() * 2
    passed = np.array([[len(set(range(*a)) & set(range(*b))) for b in zip(LOW, HIGH, strict=True)]
                       for a in zip(LOW, HIGH, strict=True)], dtype=float)  # fmt: skip
    order = np.argsort([LOW.tolist().index(min(s, t)) for s, t in _ends(graph)])
    step, own = np.geomspace(0.003, 10, 36), 0.5 * np.geomspace(0.3, 3, 13)
    posterior = np.zeros(len(step))
    for i, sigma in enumerate(step):
        for closure in own:
            covariance = np.radians(sigma) ** 2 * passed + np.radians(closure) ** 2 * np.diag(relative[order])
            posterior[i] += multivariate_normal.pdf(discrepancy[order], cov=covariance)
        posterior[i] *= np.exp(-(np.log10(sigma / 0.3) ** 2) / 2)
    expected = (posterior * np.radians(step) ** 2).sum() / posterior.sum()
    found = expected_step_variance(graph, np.ones(len(graph.source)), np.radians(0.5) ** 2, 1)
    assert found == pytest.approx(expected, rel=0.01)


def _ends(graph: ClosureGraph) -> list[tuple[int, int]]:
    closure = np.flatnonzero(graph.is_closure)
    return [(int(graph.nodes[graph.source[e]]), int(graph.nodes[graph.target[e]])) for e in closure]


def test_the_mean_is_right_on_average() -> None:
    """Eight closures tell the drift to a factor; what counts is the mean, over many drifts of one size."""
    found = [
        expected_step_variance(graph, np.ones(len(graph.source)), np.radians(0.5) ** 2, 1)
        for graph in (drifting(0.3, 0.5, seed) for seed in range(25))
    ]
    assert 0.8 < np.median(np.degrees(np.sqrt(found))) / 0.3 < 1.4


def test_no_closures_and_too_many_say_nothing() -> None:
    graph = drifting(0.2, 0.5, 0)
    assert np.isnan(expected_step_variance(graph, np.zeros(len(graph.source)), 1e-4, 1))
    assert len(LOW) <= MAX_CLOSURES
