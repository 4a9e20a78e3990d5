"""The sparse system of the posterior."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.solver.slam.posterior import system
from rotavg_ros.solver.slam.posterior.system import Factorised, NormalEquations

LENGTH, CLOSURES = 400, 600


def equations() -> NormalEquations:
    """A chain, and closures from its first half to its second, two of which share an error."""
    rng = np.random.default_rng(0)
    source = np.concatenate((np.arange(LENGTH - 1), rng.integers(0, LENGTH // 2, CLOSURES)))
    target = np.concatenate((np.arange(1, LENGTH), rng.integers(LENGTH // 2, LENGTH, CLOSURES)))
    run = np.full(len(source), -1)
    run[LENGTH - 1 : LENGTH + 1] = 0
    return NormalEquations(LENGTH, source, target, run, np.where(run >= 0, 1.0, 0.0), roots=np.zeros(1, dtype=int))


def weights() -> np.ndarray:
    """Five in six closures weigh nothing."""
    weight = np.random.default_rng(1).uniform(1e2, 1e4, LENGTH + CLOSURES)
    weight[LENGTH + 50 : LENGTH + 550] *= 1e-14
    return weight


def test_rows_that_weigh_nothing_are_left_out_of_the_pattern_and_change_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Many false closures fill the factor; without them steps, determinants and leverages are the same."""
    weight, difference = weights(), np.random.default_rng(2).normal(size=(LENGTH + CLOSURES, 3))
    sizes: list[int] = []
    monkeypatch.setattr(system, "spend", sizes.append)
    found = equations().factorise(weight)
    monkeypatch.setattr(system, "_WORTH_LEAVING_OUT", len(weight))
    whole: Factorised = equations().factorise(weight)
    assert sizes[0] < 0.6 * sizes[1]
    np.testing.assert_allclose(found.fit(difference), whole.fit(difference), atol=1e-8)
    assert found.log_det == pytest.approx(whole.log_det, abs=1e-6)
    np.testing.assert_allclose(found.resistance, whole.resistance, rtol=1e-3)
    rows = np.array([3, LENGTH, LENGTH + 100])
    np.testing.assert_allclose(found.covariance(rows), whole.covariance(rows), rtol=1e-6, atol=1e-12)


def test_what_alone_holds_the_graph_together_stays_in_however_little_it_weighs() -> None:
    weight = weights()
    weight[100] *= 1e-14
    weight[LENGTH - 1 : LENGTH - 1 + CLOSURES] = 1e-10
    fit = equations().factorise(weight).fit(np.ones((len(weight), 3)))
    assert np.isfinite(fit).all()
    # Of the broken step: all that is left of it is in the closures across.
    assert np.abs(fit[:100]).max() < 200
