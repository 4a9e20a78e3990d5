"""Expectation–maximisation of the SLAM noise, against the likelihood written out and scipy's optimiser."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import norm

from rotavg_ros.solver.slam.noise.mixture import Discrepancies, MixtureFit, Mixtures, log_uniform_density

COMPONENTS = 3


def drawn_kinds() -> list[Discrepancies]:
    """Discrepancies with an odometry of 0.2° a step, closures of 1°, and a third and a half of either kind false."""
    rng = np.random.default_rng(0)
    kinds = []
    for count, closures, false_share in ((300, 1, 1 / 3), (500, 2, 1 / 2)):
        steps = rng.uniform(1, 200, count)
        sigma = np.sqrt(steps * np.radians(0.2) ** 2 + closures * np.radians(1.0) ** 2)
        vector = sigma[:, None] * rng.standard_normal((count, COMPONENTS))
        angle = np.where(
            rng.random(count) < false_share, rng.uniform(0.5, np.pi, count), np.linalg.norm(vector, axis=1)
        )
        kinds.append(Discrepancies(angle**2, steps, closures, 1 / closures))
    return kinds


def log_likelihood(kinds: list[Discrepancies], models: Mixtures) -> float:
    """Of the first model, as it is defined."""
    total = 0.0
    for kind, share in zip(kinds, models.false_share[0], strict=True):
        sigma = np.sqrt(kind.steps * models.step_variance[0] + kind.closures * models.closure_variance[0])
        # A rotation vector along one axis has the density of all of its length.
        good = norm.logpdf(np.sqrt(kind.squared_angle), scale=sigma) + (COMPONENTS - 1) * norm.logpdf(0, scale=sigma)
        uniform = log_uniform_density(np.sqrt(kind.squared_angle), COMPONENTS)
        total += kind.weight * np.logaddexp(np.log(1 - share) + good, np.log(share) + uniform).sum()
    return float(total)


def models_of(*rows: tuple[float, float, float, float]) -> Mixtures:
    """From standard deviations in degrees and false shares."""
    step, closure, *share = np.array(rows).T
    return Mixtures(np.radians(step) ** 2, np.radians(closure) ** 2, np.stack(share, axis=1))


def test_models_side_by_side_have_the_likelihoods_of_each() -> None:
    kinds = drawn_kinds()
    rows = (0.05, 3.0, 0.2, 0.6), (0.3, 0.5, 0.5, 0.4)
    _, together = MixtureFit(kinds, COMPONENTS).step(models_of(*rows))
    assert together == pytest.approx([log_likelihood(kinds, models_of(row)) for row in rows], rel=1e-5)


def test_every_step_gains_and_the_end_is_the_optimum() -> None:
    kinds = drawn_kinds()
    fit = MixtureFit(kinds, COMPONENTS)
    model = start = models_of((1.0, 0.3, 0.5, 0.7))
    gains = []
    for _ in range(20):
        following, before = fit.step(model)
        gains.append(log_likelihood(kinds, following) - before[0])
        model = following
    assert min(gains) > -0.01
    found = fit.converge(start, 60)

    def loss(x: np.ndarray) -> float:
        return -log_likelihood(kinds, models_of((*np.exp(x[:2]), *(1 / (1 + np.exp(-x[2:]))))))

    optimum = minimize(loss, np.array([np.log(0.2), 0.0, 0.0, 0.0]), method="Nelder-Mead", options={"maxiter": 2000})
    # A prior of some pseudo-observations moves the end a little.
    assert log_likelihood(kinds, found) == pytest.approx(-optimum.fun, abs=0.1)
    assert np.degrees(np.sqrt(found.step_variance[0])) == pytest.approx(0.2, rel=0.1)
    assert found.false_share[0] == pytest.approx([1 / 3, 1 / 2], abs=0.06)
