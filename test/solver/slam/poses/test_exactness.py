"""How exactly wrong places are repeated: ways that all share, against sums and densities by SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from rotavg_ros.solver.slam.noise.repeats import Near, places_near
from rotavg_ros.solver.slam.poses.repeats.exactness import (
    WAYS,
    WIDTHS,
    Chains,
    Errors,
    InTurn,
    kernels_along,
    repeated_anywhere,
    shared_ways,
)

SQUARED_WIDTHS = np.array([256.0, 16.0, 1.0])


def log_normals(off: np.ndarray, variance: float) -> np.ndarray:
    """``(W,)`` of each width, from the broadest on."""
    return np.array([multivariate_normal(np.zeros(len(off)), width * variance).logpdf(off) for width in SQUARED_WIDTHS])


def one_run(count: int, linked: float = 1.0) -> Chains:
    return Chains(np.arange(count), np.arange(count) - 1, np.full(count, linked))


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), in_order=st.booleans())
def test_ways_are_an_urn_of_what_the_others_chose(seed: int, in_order: bool) -> None:
    """Of all, and of a run: what all tell counts for one closure within it. Nobody tells itself anything."""
    rng = np.random.default_rng(seed)
    count, ways = 12, 3
    kernels, tells = rng.exponential(size=(count, ways)), rng.random(count)
    order, run = rng.permutation(count), rng.integers(0, 3, count)
    beforehand = rng.random(ways) + 0.1
    likely = shared_ways(kernels, beforehand, tells, InTurn(order, run, in_order))
    chose = np.zeros((count, ways))

    def by(others: list[int], one: int) -> np.ndarray:
        of_all = beforehand + chose[others].sum(axis=0)
        of_run = chose[[other for other in others if run[other] == run[one]]].sum(axis=0)
        return np.asarray((of_all / of_all.sum() + of_run) / (1 + of_run.sum()))

    for place, one in enumerate(order):
        weight = by(list(order[:place]), one) * kernels[one]
        chose[one] = tells[one] * weight / weight.sum()
    for place, one in enumerate(order):
        others = list(order[:place]) if in_order else [other for other in order if other != one]
        np.testing.assert_allclose(likely[one], by(others, one))


def test_densities_that_nothing_can_be_told_by_are_no_chances() -> None:
    """Exact closures have densities near the ends of the range of numbers, those far from all none at all."""
    kernels = np.array([[0.0, 0.0], [5e-324, 0.0], [1e300, 1e-300], [0.0, 0.0]])
    likely = shared_ways(kernels, np.ones(2), np.ones(4), InTurn(np.arange(4), np.zeros(4, dtype=np.int64), True))
    np.testing.assert_allclose(likely.sum(axis=1), 1.0)
    assert np.isfinite(likely).all()


@pytest.mark.parametrize("size", [1, 2, 3])
def test_kernels_are_about_the_last_one_and_about_the_mean_of_all_before(size: int) -> None:
    rng = np.random.default_rng(size)
    off, variance = rng.normal(size=(5, size)), rng.uniform(0.5, 2.0, 5)
    later, earlier = kernels_along(off, variance, one_run(5))
    for one in range(1, 5):
        by_last = log_normals(off[one] - off[one - 1], variance[one] + variance[one - 1])
        by_mean = log_normals(off[one] - off[:one].mean(axis=0), variance[one] + variance[one - 1] / one)
        np.testing.assert_allclose(np.log(later[one]), np.concatenate((by_last, by_mean)))
    # The other way round the last one is the first.
    flipped, _ = kernels_along(off[::-1].copy(), variance[::-1].copy(), one_run(5))
    np.testing.assert_allclose(earlier[1:], flipped[:0:-1])
    assert not later[0].any() and later.shape == (5, WAYS)


def test_whoever_repeats_nobody_begins_anew() -> None:
    rng = np.random.default_rng(0)
    off, variance = rng.normal(size=(5, 2)), np.ones(5)
    later, _ = kernels_along(off, variance, one_run(5, linked=0.0))
    np.testing.assert_allclose(later[:, :WIDTHS], later[:, WIDTHS:])


@pytest.mark.parametrize("width", [1.0, 16.0])
def test_a_long_run_pays_once_for_how_exact_it_is(width: float) -> None:
    """Next to one whose width is known, it loses what a Pólya urn does: some nats, not some for each closure."""
    count, variance = 200, 0.01
    rng = np.random.default_rng(3)
    off = np.sqrt(width * variance) * rng.normal(size=(count, 2)) + [30.0, -7.0]
    kernels, _ = kernels_along(off, np.full(count, variance), one_run(count))
    told = InTurn(np.arange(count), np.zeros(count, dtype=np.int64), True)
    likely = shared_ways(kernels, np.ones(WAYS), np.ones(count), told)
    known = kernels[1:, WIDTHS + list(SQUARED_WIDTHS).index(width)]
    lost = np.log(known).sum() - np.log((likely * kernels)[1:].sum(axis=1)).sum()
    assert lost < WAYS * np.log(count)
    # With widths of their own they had lost this.
    assert np.log(known).sum() - np.log(kernels[1:].mean(axis=1)).sum() > 3 * WAYS * np.log(count)


@pytest.mark.parametrize("in_order", [True, False])
def test_repeats_anywhere_are_there_or_back_by_turn_and_shift(in_order: bool) -> None:
    rng = np.random.default_rng(5)
    count = 8
    turn, shift = 0.05 * rng.normal(size=(count, 1)), rng.normal(size=(count, 2))
    # There, back by the inverse, and as far off, but turned otherwise.
    turn[1:4], shift[1:4] = np.outer([1, -1, -1], turn[0]), np.outer([1, -1, 1], shift[0])
    of_turn, of_shift = np.full(count, 0.01**2), np.full(count, 0.02**2)
    errors = Errors(turn, shift, of_turn, of_shift, of_shift / 2, np.ones(count, dtype=bool))
    wrong, everybody = rng.random(count), np.arange(count)
    is_one = None if in_order else np.ones(count, dtype=bool)
    near = Near(everybody, everybody, places_near(everybody, everybody, is_one, count))
    alone = rng.exponential(size=count)
    density, total, alike = repeated_anywhere(errors, alone, wrong, near)
    for one in range(count):
        expected, number = np.zeros((WIDTHS, WIDTHS)), 0.0
        for other in set(range(one if in_order else count)) - {one}:
            for sign in (1, -1):
                turned = np.exp(log_normals(turn[one] - sign * turn[other], 2 * of_turn[0]))
                shifted = np.exp(log_normals(shift[one] - sign * shift[other], 2 * of_shift[0]))
                expected += wrong[other] * np.outer(turned, shifted) / 2
                same = turned.mean() * shifted.mean()
                number += wrong[other] * same / (same + alone[one])
        np.testing.assert_allclose(density[one], expected.ravel(), rtol=1e-4, atol=1e-6 * expected.max(initial=0.0))
        np.testing.assert_allclose(alike[one], number, rtol=1e-4, atol=1e-9)
        np.testing.assert_allclose(total[one], wrong[: one if in_order else count].sum() - (not in_order) * wrong[one])
    # There and back are as dense; turned otherwise only the broadest is.
    by_the_first = Near(np.array([1]), np.array([0]), np.array([[0, 1, 1, 1]]))
    there, back, otherwise = (
        repeated_anywhere(
            errors._replace(turn=turn[[0, n]], shift=shift[[0, n]]), np.ones(2), np.ones(2), by_the_first
        )[0][1]
        for n in (1, 2, 3)
    )
    np.testing.assert_allclose(there, back)
    assert otherwise[-1] < 1e-5 * there[-1]
