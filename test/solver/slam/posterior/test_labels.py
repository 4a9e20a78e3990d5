"""Priors of labels, and densities of false closures that repeat each other."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.special import logsumexp

from rotavg_ros.solver.slam.noise.repeats import Repeats
from rotavg_ros.solver.slam.posterior.densities import log_false
from rotavg_ros.solver.slam.posterior.labels.false_closures import (
    Discrepancies,
    FalseDensity,
    false_density,
    log_false_set,
)
from rotavg_ros.solver.slam.posterior.labels.prior import label_log_odds, log_label_prior, log_slip_prior
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.view_graph import ViewGraph

from .planar import planar, problem_of, yaw

CLOSURE_VARIANCE = 1e-4


@pytest.mark.parametrize("seed", range(5))
def test_prior_log_odds_of_labels_are_differences_of_their_prior(seed: int) -> None:
    graph, _ = planar(seed, 10, 0.0)
    problem = problem_of(graph)
    is_false = np.random.default_rng(seed).random(len(problem.closure)) < 0.5
    log_odds = label_log_odds(problem, is_false)
    for number in range(len(is_false)):
        with_label = []
        for value in (False, True):
            changed = is_false.copy()
            changed[number] = value
            with_label.append(log_label_prior(problem, changed))
        assert log_odds[number] == pytest.approx(with_label[0] - with_label[1], abs=1e-9)


def test_priors_are_normalised() -> None:
    """Of labels over all labellings, of false closures over all turns, of slips over all sets of steps."""
    graph, _ = planar(0, 8, 0.0)
    problem = problem_of(graph)
    labels = [np.array(bits) for bits in product([False, True], repeat=len(problem.closure))]
    assert logsumexp([log_label_prior(problem, is_false) for is_false in labels]) == pytest.approx(0.0, abs=1e-9)
    angle = np.linspace(-np.pi, np.pi, 20_001)
    assert np.trapezoid(np.exp(log_false(angle**2, 1, SlamPriors())), angle) == pytest.approx(1.0, abs=1e-3)
    length = np.linspace(1e-6, np.pi, 20_001)
    shells = 4 * np.pi * length**2 * np.exp(log_false(length**2, 3, SlamPriors()))
    assert np.trapezoid(shells, length) == pytest.approx(1.0, abs=1e-3)
    # A second false closure, new or repeating the first by any turn.
    is_false = np.arange(len(problem.closure)) == problem.detection[0]
    second = problem.detection[1:2]
    densities, exact = [], np.zeros(len(problem.closure))
    turns = np.union1d(angle[::20], np.linspace(-0.02, 0.02, 401))
    for turn in turns:
        residual = np.zeros((len(problem.closure), 3))
        residual[second, 2] = turn
        densities.append(
            np.exp(
                false_density(problem, is_false, Discrepancies(residual, exact, CLOSURE_VARIANCE), second).log_sums()
            )
        )
    np.testing.assert_allclose(np.trapezoid(densities, turns, axis=0), 1.0, atol=0.02)
    # Rates, and widths of kernels, of which nothing tells yet.
    nothing = np.flatnonzero(is_false)[:0]
    nobody = false_density(problem, is_false, Discrepancies(residual, exact, CLOSURE_VARIANCE), nothing)
    assert log_false_set(problem, nobody) == pytest.approx(0.0, abs=1e-9)
    chain = problem_of(ViewGraph.create(np.arange(6), np.arange(1, 7), yaw(np.zeros(6)), kind=[0] * 6))
    # Every node an end of closures would make six segments of one step; here their prior is asked for as if.
    steps = replace(chain, graph=replace(chain.graph, own_steps=np.ones(6), is_odometry=np.ones(6, dtype=bool)))
    sets = [np.flatnonzero(bits) for bits in product([False, True], repeat=6)]
    assert logsumexp([log_slip_prior(steps, slipped) for slipped in sets]) == pytest.approx(0.0, abs=1e-9)


def _drawn_density(count: int) -> tuple[FalseDensity, np.ndarray]:
    """A density, and what it makes of each closure ``(9, P, n)``, for each c and d, at the points of other rates."""
    rng = np.random.default_rng(0)
    has_any = rng.random((3, count)) < 0.5
    alone, of_others = rng.random((3, count)), rng.random((3, 10, count)) * has_any[:, None] * 1e-3
    c, d = (np.array([0.05, 0.5, 0.95])[:, None] * has for has in has_any[:2])
    g = np.array([0.01, 0.05, 0.2, 0.5])[:, None] * has_any[2]
    run, before, far = c[:, None, None, None, None], d[:, None, None, None], g[:, None, None]
    any_one = (1 - far) * alone[:, None] + far * of_others[2]
    mixed = (1 - run) * ((1 - before) * any_one + before * of_others[1]) + run * of_others[0]
    number = rng.integers(0, count // 5, count)
    return FalseDensity(alone, Repeats(of_others, has_any), number, np.zeros(10)), mixed.reshape(9, -1, count)


def test_the_mean_over_rates_is_that_of_the_mixture() -> None:
    density, mixed = _drawn_density(40)
    rng, (ways, points, count) = np.random.default_rng(1), mixed.shape
    rates = rng.normal(size=(ways + 1) * points)
    rates -= logsumexp(rates)
    own = rng.dirichlet(np.ones(ways), count).T
    shared, of_own = np.split(np.exp(rates), [ways * points])
    expected = np.einsum("wp,wpn->n", shared.reshape(ways, points), mixed)
    expected += np.einsum("p,wn,wpn->n", of_own, own, mixed)
    np.testing.assert_allclose(density.mean(rates, own), expected, rtol=1e-12)


@pytest.mark.parametrize("count", [30, 3000])
def test_all_false_closures_together_are_the_product_of_all(count: int) -> None:
    """However many there are: the product of 3000 densities is below the least number, and that of 400 of a run is."""
    density, mixed = _drawn_density(count)
    run = np.where(np.arange(count) % 7 == 0, 0, density.run)
    of_each = np.log(mixed)
    of_run = np.stack([of_each[..., run == number].sum(axis=-1) for number in np.unique(run)])
    own = (logsumexp(of_run, axis=1) - np.log(len(mixed))).sum(axis=0)
    expected = np.concatenate((of_each.sum(axis=-1).ravel(), own))
    np.testing.assert_allclose(replace(density, run=run).log_sums(), expected, rtol=1e-9)


def test_runs_that_repeat_one_turn_are_cheap_though_others_repeat_none() -> None:
    """Twenty false closures of one run by any turn, six of another one by one turn."""
    ends = np.concatenate((np.arange(20), 60 + np.arange(6))), np.concatenate((40 + np.arange(20), 130 + np.arange(6)))
    steps = np.arange(140)
    graph = ViewGraph.create(
        np.concatenate((steps, ends[1])),
        np.concatenate((steps + 1, ends[0])),
        yaw(np.zeros(140 + 26)),
        kind=[0] * 140 + [1] * 26,
    )
    cost = {}
    for without in ((), ("own-repeats",)):
        problem = problem_of(graph, SlamPriors(), without=without)
        is_scattered = problem.ends[:, 1] < 100
        turn = np.where(is_scattered, np.random.default_rng(0).uniform(-np.pi, np.pi, 26), 3.0)
        residual = np.stack((np.zeros(26), np.zeros(26), turn), axis=1)
        for name, is_false in (("both", np.ones(26, dtype=bool)), ("scattered", is_scattered)):
            rows = np.flatnonzero(is_false)
            density = false_density(problem, is_false, Discrepancies(residual, np.zeros(26), CLOSURE_VARIANCE), rows)
            cost[name, without] = -log_false_set(problem, density)
    repeating = [cost["both", without] - cost["scattered", without] for without in ((), ("own-repeats",))]
    assert repeating[0] < repeating[1] - 2.0
