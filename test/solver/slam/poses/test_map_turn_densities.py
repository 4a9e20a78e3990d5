"""Sums over pairs of closures that are turned alike, against the same sums with SciPy's rotations and densities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
from numpy.random import Generator
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from rotavg_ros.solver.slam.noise.repeats import Near, places_near
from rotavg_ros.solver.slam.poses.repeats.map_turn_densities import (
    Axes,
    closure_rows,
    repeated_after,
    repeated_density,
)

COUNT, WINDOW = 12, 5


def covariances(rng: Generator, size: int, turns: int) -> np.ndarray:
    """Of turns of a tenth of a radian and shifts of a metre, about."""
    scale = np.repeat([0.1, 1.0], [turns, size - turns])
    root = rng.normal(size=(COUNT, size, size)) * 0.3 + np.eye(size)
    return np.asarray(scale[:, None] * (root @ root.transpose(0, 2, 1)) * scale)


class Difference(NamedTuple):
    """Of a closure's turn and shift from those that another's turn of the map predicts.

    And the prediction's variance of turns per component, and covariance ``(m, m)`` of shifts.
    """

    turned: np.ndarray
    off: np.ndarray
    of_turn: float
    of_shift: np.ndarray

    @property
    def mean_shift(self) -> float:
        """Variance per component."""
        return float(np.trace(self.of_shift)) / len(self.of_shift)

    @property
    def alike(self) -> Difference:
        """Along all axes."""
        return self._replace(of_shift=self.mean_shift * np.eye(len(self.of_shift)))


@dataclass(frozen=True)
class Turned:
    """Closures that are false by one of two turns of the map."""

    axes: Axes
    turn: Rotation
    shift: np.ndarray
    place: np.ndarray
    covariance: np.ndarray

    @classmethod
    def draw(cls, rng: Generator, *, planar: bool) -> Turned:
        turns, shifts = (np.eye(3)[:, 2:], np.eye(3)[:, :2]) if planar else (np.eye(3), np.eye(3))
        # Contiguous as a map's are: other layouts would be compiled anew.
        axes = Axes(np.ascontiguousarray(turns), np.ascontiguousarray(shifts))
        k, m = axes.turns.shape[1], axes.shifts.shape[1]
        angle = rng.choice([0.5, 1.2], COUNT)[:, None] + 0.1 * rng.normal(size=(COUNT, k))
        turn = Rotation.from_rotvec(angle @ axes.turns.T)
        shift, place = (rng.normal(size=(COUNT, m)) * scale @ axes.shifts.T for scale in (1.0, 5.0))
        return cls(axes, turn, shift, place, covariances(rng, k + m, k))

    @property
    def rows(self) -> np.ndarray:
        return closure_rows(self.turn.as_quat().T, self.shift, self.place, self.covariance)

    def difference(self, one: int, other: int) -> Difference | None:
        """None where they are not turned alike."""
        covariance, (turns, shifts) = self.covariance, self.axes
        k, m = turns.shape[1], shifts.shape[1]
        apart = self.turn[one] * self.turn[other].inv()
        spread = np.trace(covariance[one, :k, :k]) + np.trace(covariance[other, :k, :k])
        if apart.magnitude() ** 2 >= 16 * spread:
            return None
        arm = self.place[one] - self.place[other]
        turned = self.turn[other].apply(arm)
        off = self.shift[one] - self.shift[other] - turned + arm
        # Of a little turn of the other's about an axis, by what it moves what it turns.
        lever = np.stack([np.cross(turned, axis) for axis in turns.T], axis=1)
        change = np.hstack((-shifts.T @ lever, np.eye(m)))
        of_shift = change @ covariance[other] @ change.T
        return Difference(apart.as_rotvec() @ turns, off @ shifts, np.trace(covariance[other, :k, :k]) / k, of_shift)

    def densities(self, one: int, found: Difference, widths: tuple[float, ...]) -> tuple[float, np.ndarray]:
        """The squared turn, in standard deviations; densities of the shift given it, with these variances."""
        square, mean, left = self._given_turn(one, found)
        return square, np.array([multivariate_normal(mean, width * left).pdf(found.off) for width in widths])

    def heights(self, one: int, found: Difference, widths: tuple[float, ...]) -> np.ndarray:
        """The largest values of these densities."""
        _, mean, left = self._given_turn(one, found)
        return np.array([multivariate_normal(mean, width * left).pdf(mean) for width in widths])

    def _given_turn(self, one: int, found: Difference) -> tuple[float, np.ndarray, np.ndarray]:
        k = self.axes.turns.shape[1]
        total = self.covariance[one] + block_diag(found.of_turn * np.eye(k), found.of_shift)
        inverse = np.linalg.inv(total[:k, :k])
        mean = total[k:, :k] @ inverse @ found.turned
        left = total[k:, k:] - total[k:, :k] @ inverse @ total[:k, k:]
        return float(found.turned @ inverse @ found.turned), mean, left


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("in_order", [True, False])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 5))])
def test_each_counts_all_that_are_turned_like_those_near_it(planar: bool, in_order: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    false = Turned.draw(rng, planar=planar)
    # From a map that is hardly broader than the kernels to one by far broader.
    chance, log_alone = rng.uniform(0.1, 1.0, COUNT), rng.uniform(-16, -4, COUNT)
    broad = 0
    tells = np.flatnonzero(rng.random(COUNT) < 0.8)
    everybody = np.arange(COUNT)
    among = Near(tells, tells, places_near(tells, tells, np.ones(len(tells), dtype=bool), WINDOW))
    is_one = None if in_order else np.isin(everybody, tells)
    of_all = Near(everybody, tells, places_near(tells, everybody, is_one, WINDOW))
    surely, density = repeated_density(false.rows, false.axes, chance, log_alone, among, of_all)

    def near(one: int, before_alone: bool) -> list[int]:
        later = [] if before_alone else [other for other in tells if other > one][:WINDOW]
        return [other for other in tells if other < one][-WINDOW:] + later

    alike = np.zeros((COUNT, COUNT))
    for one in tells:
        alike[one, one] = chance[one]
        for other in near(one, before_alone=False):
            if (found := false.difference(one, other)) is not None:
                same = false.densities(one, found.alike, (1.0, 16.0))[1].mean()
                alike[one, other] = chance[other] * same / (same + np.exp(log_alone[one]))
    for one in range(COUNT):
        listed = {other: each for other in near(one, in_order) if (each := false.difference(one, other)) is not None}
        weights, total = [], np.zeros(2)
        for other in listed:
            weight = np.array([alike[other, third] / listed[third].mean_shift for third in listed])
            turned, off = (
                sum(w * each[n] for w, each in zip(weight, listed.values(), strict=True)) / weight.sum() for n in (0, 1)
            )
            of_turn = (
                sum(w / each.mean_shift * each.of_turn for w, each in zip(weight, listed.values(), strict=True))
                / weight.sum() ** 2
            )
            mean = Difference(turned, off, of_turn, np.eye(len(off)) / weight.sum())
            square, same = false.densities(one, mean, (1.0, 16.0))
            height = false.heights(one, mean, (1.0, 16.0))
            # A tenth of anywhere: of what has that mean density over its own values.
            tells_nothing = height < 10 * np.exp(log_alone[one] + len(off) / 2)
            broad += int(tells_nothing.sum())
            same = np.where(tells_nothing, np.exp(log_alone[one]), same)
            weights.append(chance[other] * np.exp(-square / 2))
            total += weights[-1] * same
        assert surely[one] == pytest.approx(min(sum(weights), 1.0), rel=1e-4)
        np.testing.assert_allclose(density[one], total / max(sum(weights), 1.0), rtol=1e-4, atol=1e-12)
    assert broad > 0


@pytest.mark.parametrize("planar", [True, False])
def test_one_that_follows_another_repeats_it_more_or_less_exactly_than_noise_tells(planar: bool) -> None:
    """With the noise of both along each axis, and up to sixteen times its standard deviations; either by the other."""
    false = Turned.draw(np.random.default_rng(0), planar=planar)
    earlier, later = (each.ravel() for each in np.meshgrid(np.arange(COUNT), np.arange(COUNT)))
    by_other = repeated_after(false.rows, false.axes, later, earlier)
    told = 0
    for end, (ones, others) in enumerate(((later, earlier), (earlier, later))):
        for pair, (one, other) in enumerate(zip(ones, others, strict=True)):
            found = false.difference(int(one), int(other))
            expected = np.zeros(3)
            if found is not None:
                told += 1
                expected = false.densities(int(one), found, (1.0, 16.0, 256.0))[1]
            np.testing.assert_allclose(by_other[end, pair], expected, rtol=1e-6, atol=1e-300)
    assert told > COUNT
