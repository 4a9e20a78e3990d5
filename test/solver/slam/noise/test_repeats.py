"""Densities of turns like those of other false closures, against sums that are written out."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation

from rotavg_ros.solver.slam.noise.repeats import KERNELS, REPEAT_DEG, Closures, Near, log_widths, places_near, repeats

GAP, WINDOW = 30.0, 6


@given(st.integers(0, 10_000), st.integers(1, 25), st.booleans(), st.sampled_from([1, 3]))
def test_densities_are_means_over_a_run_those_before_and_all(
    seed: int, count: int, both_sides: bool, components: int
) -> None:
    rng = np.random.default_rng(seed)
    # Few places, so that many are near each other, or the other way round.
    ends = np.stack((rng.integers(0, 4, count) * 20.0, 500 + rng.integers(0, 4, count) * 20.0), axis=1)
    swapped = rng.random(count) < 0.3
    ends[swapped] = ends[swapped, ::-1]
    older, newer = ends.T  # in memory as a problem has them: other layouts would be compiled anew
    turn = Rotation.from_rotvec(0.1 * rng.normal(size=(count, 3)) * ([0, 0, 1] if components == 1 else 1))
    is_told, false = rng.random(count) < 0.9, np.flatnonzero(rng.random(count) < 0.7)
    rows = np.arange(count)
    between = places_near(false, rows, np.isin(rows, false) if both_sides else None, WINDOW)
    closures, near, drawn = Closures(older, newer, turn.as_quat(), is_told), Near(rows, false, between), rng.random(9)
    found = repeats(closures, near, GAP, components, np.log(drawn / drawn.sum()))

    width = np.radians(REPEAT_DEG)
    for row in rows:
        before = [other for other in false if other < row][-WINDOW:]
        after = [other for other in false if other > row][:WINDOW] if both_sides else []
        others = [other for other in before + after if is_told[other]] if is_told[row] else []
        follows = any(abs(newer[other] - newer[row]) <= GAP for other in others)
        kernels, weights = np.zeros((len(others), KERNELS - 1)), np.zeros((3, len(others)))
        for number, other in enumerate(others):
            apart = np.abs([older[other] - older[row], newer[other] - newer[row]])
            crossed = min(abs(newer[other] - older[row]), abs(older[other] - newer[row]))
            back = crossed <= GAP and bool((apart > GAP).all())
            angle = (turn[row] * turn[other] if back else turn[row] * turn[other].inv()).magnitude()
            kernels[number] = np.exp(-(angle**2) / (2 * width**2)) / (2 * np.pi * width**2) ** (components / 2)
            of_run = apart.sum() <= GAP
            of_places = follows and (back or apart[0] <= GAP)
            weights[:, number] = of_run, not of_run and (apart[1] <= GAP or of_places), 1.0
        np.testing.assert_array_equal(found.has_any[:, row], weights.sum(axis=1) > 0)
        for density, weight in zip(found.density, weights, strict=True):
            expected = weight @ kernels / max(weight.sum(), 1.0)
            # Kernels end at five widths of the broadest.
            np.testing.assert_allclose(density[:-1, row], expected, rtol=1e-6, atol=1e-5 * width[-1] ** -components)
            assert density[-1, row] == pytest.approx(np.average(density[:-1, row], weights=drawn))


def test_nobody_is_near_itself() -> None:
    when, rows = np.array([2, 5, 9]), np.array([2, 4, 5, 10])
    near = places_near(when, rows, np.isin(rows, when), 2)
    assert near.tolist() == [[0, 0, 1, 3], [0, 1, 1, 3], [0, 1, 2, 3], [1, 3, 3, 3]]
    assert places_near(when, rows, None, 2)[:, 2:].tolist() == [[3, 3]] * 4


@pytest.mark.parametrize("usual_deg", [0.05, 0.4, 3.0])
def test_kernels_are_about_as_wide_as_good_closures_differ(usual_deg: float) -> None:
    """Log-normal below, relative to the widest; all that are wider are equally likely."""
    log, spread = log_widths(np.radians(usual_deg), 0.7), 0.7
    assert np.exp(log).sum() == pytest.approx(1.0)
    below = stats.norm.logpdf(np.log(np.minimum(REPEAT_DEG, usual_deg)), np.log(usual_deg), spread)
    np.testing.assert_allclose(log - log[-1], below - below[-1], atol=1e-9)
