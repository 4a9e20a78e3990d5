"""Planar chains with closures, whose evidence is a dense normal density."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
from scipy.stats import multivariate_normal

from rotavg_ros.solver.slam.noise.calibration import Calibration
from rotavg_ros.solver.slam.posterior.calibration import Calibrated
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.state import RUN_STEPS, Noise, Others, State
from rotavg_ros.solver.slam.preparation import prepare_as_it_is
from rotavg_ros.view_graph import ViewGraph

# Gaussian where a mixture would be integrated approximately only.
GAUSSIAN_PRIORS = replace(SlamPriors(), near_miss_share=1e-12)
NOISE = Noise(np.radians(1.0) ** 2, np.radians(1.5) ** 2, 0.0, 0.4, RUN_STEPS[-1], step_tails=0.0, closure_tails=0.0)


def yaw(angle: np.ndarray) -> np.ndarray:
    return np.stack((np.zeros_like(angle), np.zeros_like(angle), np.sin(angle / 2), np.cos(angle / 2)), axis=1)


def planar(seed: int, num_closures: int, false_share: float, length: int = 60) -> tuple[ViewGraph, np.ndarray]:
    """A planar chain with closures, some of them wrong by up to 40°; returns the graph and what closures are off by."""
    rng = np.random.default_rng(seed)
    older = rng.integers(0, length // 2, num_closures)
    newer = older + rng.integers(length // 4, length // 2, num_closures)
    # Two closures of a run, so that common errors count.
    older[1], newer[1] = older[0] + 1, newer[0] + 2
    off = np.where(rng.random(num_closures) < false_share, rng.uniform(-0.7, 0.7, num_closures), 0.0)
    noise = off + rng.normal(size=num_closures) * np.radians(1.5)
    odometry = rng.normal(size=length - 1) * np.radians(1.0)
    graph = ViewGraph.create(
        np.concatenate((np.arange(length - 1), older)),
        np.concatenate((np.arange(1, length), newer)),
        yaw(np.concatenate((odometry, noise))),
        num_nodes=length,
        kind=[0] * (length - 1) + [1] * num_closures,
    )
    return graph, off


def problem_of(
    graph: ViewGraph, priors: SlamPriors = GAUSSIAN_PRIORS, without: Collection[str] = (), rate: float | None = None
) -> Problem:
    """A problem whose network has no opinion, after a bias of ``rate`` about z, rad per step, was taken out."""
    calibration = Calibration(np.array([0.0, 0.0, rate or 0.0]), np.zeros(3))
    corrected = calibration.taken_out_of(graph)
    prepared = prepare_as_it_is(corrected)
    taken_out = None if rate is None else Calibrated.of(corrected, prepared, calibration, {"bias"})
    turned = np.arange(graph.num_nodes) ** 2.0
    no_opinion = np.zeros(len(prepared.closure_graph.source))
    return Problem.of(prepared, no_opinion, priors=priors, without=without, calibrated=taken_out, turned=turned)


def state_of(problem: Problem, is_false: np.ndarray) -> State:
    trusted = np.ones(len(problem.graph.source))
    trusted[problem.closure[is_false]] = 0.0
    correction = np.zeros((4, problem.graph.num_nodes))
    correction[3] = 1.0
    return State(
        correction, np.zeros((problem.system(NOISE).num_runs, 3)), trusted, NOISE, Others.before_any(len(trusted))
    )


def log_evidence(problem: Problem, is_false: np.ndarray, bias_deg: float = 0.0) -> float:
    """Of the data given labels: the good closures' residuals are jointly normal, by what they pass and share."""
    measured = problem.measured[:, problem.closure]
    discrepancy = 2 * np.arctan2(measured[2], measured[3]) * problem.sign
    older, newer = problem.ends.T
    passed = np.maximum(np.minimum(newer[:, None], newer) - np.maximum(older[:, None], older), 0.0)
    shared = problem.system(NOISE).shared[problem.closure]
    common = (problem.run[:, None] == problem.run) & shared[:, None] & shared
    own = np.where(shared, 1 - NOISE.common_share, 1.0) * NOISE.closure_variance
    covariance = passed * NOISE.step_variance + common * NOISE.common_share * NOISE.closure_variance + np.diag(own)
    covariance += np.radians(bias_deg) ** 2 * (newer - older)[:, None] * (newer - older)
    good = ~is_false
    if not good.any():
        return 0.0
    normal = multivariate_normal(np.zeros(int(good.sum())), covariance[np.ix_(good, good)], allow_singular=True)
    return float(normal.logpdf(discrepancy[good]))
