"""F against integrals computed independently and densely."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from scipy.special import expit, logsumexp
from scipy.stats import multivariate_normal

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.objective import evaluate
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import with_noise
from rotavg_ros.solver.slam.posterior.state import STEP_TAIL_RATIOS, Noise
from rotavg_ros.view_graph import ViewGraph

from .planar import NOISE, log_evidence, planar, problem_of, state_of, yaw


@pytest.mark.parametrize("seed", range(4))
def test_marginals_are_those_of_dense_integrals(seed: int) -> None:
    graph, _ = planar(seed, 7, 0.4)
    problem = problem_of(graph)
    labels = [np.array(bits) for bits in product([False, True], repeat=len(problem.closure))]
    by_f, densely = [], []
    for is_false in labels:
        _, evaluation = polish(problem, state_of(problem, is_false), hold_noise=True)
        by_f.append(-evaluation.total)
        # What false closures contribute is a density by itself; the integral over orientations is what is checked.
        densely.append(
            log_evidence(problem, is_false) - evaluation.terms["false closures"] - evaluation.terms["labels"]
        )
    is_false = np.stack(labels)
    marginals = [(np.exp(np.array(log) - logsumexp(log))[:, None] * is_false).sum(axis=0) for log in (by_f, densely)]
    np.testing.assert_allclose(marginals[0], marginals[1], atol=0.01)
    assert marginals[0].max() > 0.02 and marginals[0].min() < 0.98


def _log_evidence_of_tails(problem: Problem, noise: Noise) -> float:
    """The same of good closures by themselves, summed over which segments and which closures are in the tails."""
    graph, closure = problem.graph, problem.closure
    discrepancy = (2 * np.arctan2(problem.measured[2], problem.measured[3]))[closure] * problem.sign
    segment = np.flatnonzero(graph.is_odometry)
    ends = np.sort(np.stack((graph.position[graph.source[segment]], graph.position[graph.target[segment]])), axis=0)
    older, newer = problem.ends.T
    across = ((ends[0] >= older[:, None] - 1e-9) & (ends[1] <= newer[:, None] + 1e-9)).astype(np.float64)
    segment, across = segment[across.any(axis=0)], across[:, across.any(axis=0)]
    variance = np.append(graph.own_steps[segment] * noise.step_variance, np.full(len(closure), noise.closure_variance))
    share = np.append(np.full(len(segment), noise.step_tails), np.full(len(closure), noise.closure_tails))
    ratio = np.append(np.full(len(segment), noise.step_tail_ratio), np.full(len(closure), problem.priors.tail_ratio))
    design = np.hstack((across, np.eye(len(closure))))
    logs = []
    for tail in map(np.array, product([False, True], repeat=len(variance))):
        inflated = variance * np.where(tail, ratio, 1.0)
        normal = multivariate_normal(np.zeros(len(closure)), (design * inflated) @ design.T)
        with np.errstate(divide="ignore"):
            logs.append(normal.logpdf(discrepancy) + np.log(np.where(tail, share, 1 - share)).sum())
    return float(logsumexp(logs))


@pytest.mark.parametrize("ratio", STEP_TAIL_RATIOS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 6))])
def test_tails_have_the_evidence_of_the_sum_over_what_is_in_them(seed: int, ratio: float) -> None:
    graph, _ = planar(seed, 4, 0.0, length=40)
    problem = problem_of(graph)
    state = state_of(problem, np.zeros(4, dtype=bool))
    by_f, exactly = [], []
    for share in (0.0, 0.1):
        noise = replace(NOISE, run_steps=0.0, step_tails=share, closure_tails=share, step_tail_ratio=ratio)
        _, evaluation = polish(problem, with_noise(problem, state, noise), hold_noise=True)
        terms = evaluation.terms
        by_f.append(terms["odometry"] + terms["good closures"] + terms["orientations"])
        exactly.append(-_log_evidence_of_tails(problem, noise))
    assert by_f[1] - by_f[0] == pytest.approx(exactly[1] - exactly[0], abs=0.1)
    # Laplace's method is off by 0.3 to 1.2 nats here.
    assert abs(exactly[1] - exactly[0]) > 0.15


@pytest.mark.parametrize("seed", range(3))
def test_f_does_not_depend_on_order_and_direction_of_edges(seed: int) -> None:
    graph, _ = planar(seed, 9, 0.3)
    rng = np.random.default_rng(seed)
    order = torch.from_numpy(rng.permutation(graph.num_edges))
    shuffled = graph.select_edges(order)
    turned = torch.from_numpy(rng.random(graph.num_edges) < 0.5)
    inverse = shuffled.target_from_source * torch.tensor([-1.0, -1.0, -1.0, 1.0])
    changed = replace(
        shuffled,
        source=torch.where(turned, shuffled.target, shuffled.source),
        target=torch.where(turned, shuffled.source, shuffled.target),
        target_from_source=torch.where(turned[:, None], inverse, shuffled.target_from_source),
    )
    totals = []
    for drawn in (graph, changed):
        problem = problem_of(drawn)
        is_false = expit(np.abs(2 * np.arctan2(problem.measured[2], problem.measured[3]))[problem.closure]) > 0.55
        totals.append(polish(problem, state_of(problem, is_false), hold_noise=True)[1].total)
    assert totals[0] == pytest.approx(totals[1], abs=1e-6)


def test_a_part_that_nothing_holds_weighs_as_one_that_may_be_turned_by_anything() -> None:
    """Two chains joined by one closure: whether it is good or false, F stays finite and comparable."""
    graph = ViewGraph.create(
        [0, 1, 3, 4, 1], [1, 2, 4, 5, 4], yaw(np.array([0.0, 0.0, 0.0, 0.0, 0.5])), num_nodes=6, kind=[0, 0, 0, 0, 1]
    )
    problem = problem_of(graph)
    good, false = (
        evaluate(problem, polish(problem, state_of(problem, np.array([label])), hold_noise=True)[0]).terms
        for label in (False, True)
    )
    # Nothing contradicts the closure, so its residual tells nothing: only the labels' prior does.
    evidence = [sum(terms.values()) - terms["labels"] for terms in (good, false)]
    assert evidence[0] == pytest.approx(evidence[1], abs=0.05)
