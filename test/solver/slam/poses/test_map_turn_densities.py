"""Sums over pairs of closures that are turned alike, against the same sums with SciPy's rotations and densities."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.random import Generator
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from rotavg_ros.solver.slam.noise.repeats import Near, places_near
from rotavg_ros.solver.slam.poses.repeats.map_turn_densities import Axes, closure_rows, repeated_density

COUNT, WINDOW = 12, 5


def covariances(rng: Generator, size: int, turns: int) -> np.ndarray:
    """Of turns of a tenth of a radian and shifts of a metre, about."""
    scale = np.repeat([0.1, 1.0], [turns, size - turns])
    root = rng.normal(size=(COUNT, size, size)) * 0.3 + np.eye(size)
    return np.asarray(scale[:, None] * (root @ root.transpose(0, 2, 1)) * scale)


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("in_order", [True, False])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 5))])
def test_each_counts_all_that_are_turned_like_those_near_it(planar: bool, in_order: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    axes = Axes(*(np.eye(3)[:, 2:], np.eye(3)[:, :2]) if planar else (np.eye(3), np.eye(3)))
    k, m = axes.turns.shape[1], axes.shifts.shape[1]
    angle = rng.choice([0.5, 1.2], COUNT)[:, None] + 0.1 * rng.normal(size=(COUNT, k))
    turn = Rotation.from_rotvec(angle @ axes.turns.T)
    shift, place = (rng.normal(size=(COUNT, m)) * scale @ axes.shifts.T for scale in (1.0, 5.0))
    covariance = covariances(rng, k + m, k)
    chance, log_alone = rng.uniform(0.1, 1.0, COUNT), rng.normal(size=COUNT) - 4
    tells = np.flatnonzero(rng.random(COUNT) < 0.8)
    everybody = np.arange(COUNT)
    among = Near(tells, tells, places_near(tells, tells, np.ones(len(tells), dtype=bool), WINDOW))
    is_one = None if in_order else np.isin(everybody, tells)
    of_all = Near(everybody, tells, places_near(tells, everybody, is_one, WINDOW))
    rows = closure_rows(turn.as_quat().T, shift, place, covariance)
    surely, density = repeated_density(rows, axes, chance, log_alone, among, of_all)

    def near(one: int, before_alone: bool) -> list[int]:
        later = [] if before_alone else [other for other in tells if other > one][:WINDOW]
        return [other for other in tells if other < one][-WINDOW:] + later

    def difference(one: int, other: int) -> tuple[np.ndarray, np.ndarray, float, float] | None:
        apart = turn[one] * turn[other].inv()
        spread = np.trace(covariance[one, :k, :k]) + np.trace(covariance[other, :k, :k])
        if apart.magnitude() ** 2 >= 16 * spread:
            return None
        arm = place[one] - place[other]
        off = shift[one] - shift[other] - turn[other].apply(arm) + arm
        # Of a little turn of the other's about an axis, by what it moves what it turns.
        lever = np.stack([np.cross(turn[other].apply(arm), axis) for axis in axes.turns.T], axis=1)
        change = np.hstack((-axes.shifts.T @ lever, np.eye(m)))
        of_shift = np.trace(change @ covariance[other] @ change.T) / m
        return apart.as_rotvec() @ axes.turns, off @ axes.shifts, np.trace(covariance[other, :k, :k]) / k, of_shift

    def densities(
        one: int, turned: np.ndarray, off: np.ndarray, of_turn: float, of_shift: float
    ) -> tuple[float, np.ndarray]:
        total = covariance[one] + np.diag(np.repeat([of_turn, of_shift], [k, m]))
        inverse = np.linalg.inv(total[:k, :k])
        mean, left = total[k:, :k] @ inverse @ turned, total[k:, k:] - total[k:, :k] @ inverse @ total[:k, k:]
        widths = [multivariate_normal(mean, width * left).pdf(off) for width in (1.0, 16.0)]
        return float(turned @ inverse @ turned), np.array(widths)

    alike = np.zeros((COUNT, COUNT))
    for one in tells:
        alike[one, one] = chance[one]
        for other in near(one, before_alone=False):
            if (found := difference(one, other)) is not None:
                same = densities(one, *found)[1].mean()
                alike[one, other] = chance[other] * same / (same + np.exp(log_alone[one]))
    for one in range(COUNT):
        listed = {other: found for other in near(one, in_order) if (found := difference(one, other)) is not None}
        weights, total = [], np.zeros(2)
        for other in listed:
            weight = np.array([alike[other, third] / listed[third][3] for third in listed])
            turned, off = (sum(w * found[n] for w, found in zip(weight, listed.values(), strict=True)) for n in (0, 1))
            of_turn = (
                sum(w / found[3] * found[2] for w, found in zip(weight, listed.values(), strict=True))
                / weight.sum() ** 2
            )
            square, same = densities(one, turned / weight.sum(), off / weight.sum(), of_turn, 1 / weight.sum())
            weights.append(chance[other] * np.exp(-square / 2))
            total += weights[-1] * same
        assert surely[one] == pytest.approx(min(sum(weights), 1.0), rel=1e-4)
        np.testing.assert_allclose(density[one], total / max(sum(weights), 1.0), rtol=1e-4, atol=1e-12)
