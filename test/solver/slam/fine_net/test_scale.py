"""The noise's scale after single edges' variances changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rotavg_ros.solver.slam.fine_net.scale import Told
from rotavg_ros.solver.slam.posterior.priors import SlamPriors

SPREAD = SlamPriors().noise_spread


def told(seed: int, count: int = 4000) -> tuple[Told, torch.Tensor]:
    """Edges of either kind with drawn discrepancies, and their true variances."""
    rng = np.random.default_rng(seed)
    variance = torch.from_numpy(rng.uniform(1e-4, 1e-2, count))
    predicted = torch.from_numpy(rng.uniform(1e-4, 1e-2, count))
    square = (variance + predicted) * torch.from_numpy(rng.chisquare(3, count))
    is_odometry = torch.from_numpy(rng.random(count) < 0.6)
    return Told(is_odometry, torch.ones(count, dtype=torch.float64), square, predicted, 3, SPREAD), variance


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_nothing_changes_where_no_variance_does(seed: int) -> None:
    edges, variance = told(seed, 50)
    assert torch.equal(edges.log_scale(variance, variance), torch.zeros(2, dtype=torch.float64))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_a_common_factor_is_taken_back(seed: int, of_closures: float, of_odometry: float) -> None:
    edges, variance = told(seed)
    factor = torch.tensor([of_closures, of_odometry], dtype=torch.float64)
    scale = edges.log_scale(variance, variance * factor.exp()[edges.is_odometry.long()])
    torch.testing.assert_close(scale, -factor, rtol=0.0, atol=0.05)


def test_false_edges_have_no_say() -> None:
    edges, variance = told(1)
    good = torch.ones_like(variance)
    good[::2] = 0
    odd = torch.arange(len(variance)) % 2 == 1
    some = Told(edges.is_odometry, good, edges.square, edges.predicted, 3, SPREAD)
    only = Told(edges.is_odometry[odd], good[odd], edges.square[odd], edges.predicted[odd], 3, SPREAD)
    after = variance * torch.linspace(0.2, 5, len(variance), dtype=torch.float64)
    torch.testing.assert_close(some.log_scale(variance, after), only.log_scale(variance[odd], after[odd]))


def test_few_edges_leave_the_noise_near_what_is_believed_beforehand() -> None:
    edges, variance = told(2, 6)
    free, held = (replace(edges, noise_spread=spread).log_scale(variance, 4 * variance).abs() for spread in (10.0, 0.2))
    assert (held < free / 2).all()
