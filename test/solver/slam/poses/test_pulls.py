"""How much closures pull by their classes: runs that repeat one wrong place say once where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from rotavg_ros.solver.slam.poses.closures import ANYWHERE, GOOD, Predictions, Scale, Told
from rotavg_ros.solver.slam.poses.even.shifts import EvenShifts
from rotavg_ros.solver.slam.poses.places.classes import CLASSES, Said
from rotavg_ros.solver.slam.poses.places.pulls import pulled
from rotavg_ros.solver.slam.poses.priors import PlacePriors
from rotavg_ros.solver.slam.posterior.densities import anyhow


def told(count: int) -> Told:
    """Closures of one run, each of .01 rad, one after the other."""
    each = np.arange(count)
    return Told(
        rotation_variance=np.full(count, 1e-4),
        uneven=np.ones((count, 1, 1)),
        false_odds=np.zeros(count),
        is_known=np.ones(count, dtype=bool),
        label=np.zeros(count),
        chains=np.zeros((count, 2), dtype=np.int64),
        run=np.zeros(count, dtype=np.int64),
        follows=each - 1,
        sign=np.ones(count),
        detection=each,
        detected=each,
    )


def alike(count: int, *, variance: float, extent: float) -> Scale:
    """Of closures that all err by as many m² along any axis, on a map of ``extent`` m²."""
    one, nothing, shape = np.ones(count), np.zeros(count), EvenShifts.alike(count, 2)
    return Scale(variance * one, variance * one, one, extent, extent * one, nothing, nothing, shape)


def said_of(count: int, off: float) -> Said:
    """That all are off by some metres along x, which is known to a metre, in a plane of 50 m."""
    mean = np.tile([0.0, off, 0.0], (count, 1))
    covariance = np.tile(np.diag([1e-4, 1.0, 1.0]), (count, 1, 1))
    scale = alike(count, variance=0.01, extent=2500.0)
    return Said.of(Predictions(mean, covariance), told(count), np.ones(count, dtype=bool), 1, scale, PlacePriors())


def of_class(number: int, count: int) -> np.ndarray:
    """``(J + 1, C)`` nats: all of one class, those of wrong places otherwise as likely as each other."""
    log_class = np.full((CLASSES, count), -40.0)
    log_class[number] = 0.0
    return log_class


@pytest.mark.parametrize("count", [1, 2, 50])
def test_a_run_of_repeats_pulls_like_one_of_them(count: int) -> None:
    said, repeats = said_of(count, 30.0), of_class(CLASSES - 2, count)
    # Each would be of the broadest class by itself.
    repeats[CLASSES - 3] = -20.0
    weight = pulled(said, told(count), repeats, np.ones(count)).weight
    one = pulled(said_of(1, 30.0), told(1), of_class(CLASSES - 3, 1), np.ones(1)).weight
    np.testing.assert_allclose(weight.sum(), one[0], rtol=1e-4)


def test_repeats_of_other_runs_that_are_off_alike_count_as_well() -> None:
    repeats = of_class(CLASSES - 2, 2)
    repeats[CLASSES - 3] = -20.0
    alone, among_ten = (
        pulled(said_of(2, 30.0), told(2), repeats.copy(), np.full(2, number)).weight for number in (1.0, 10.0)
    )
    np.testing.assert_allclose(alone / among_ten, 5.0, rtol=1e-4)


def test_good_ones_pull_by_their_own_variance_each() -> None:
    weight = pulled(said_of(20, 0.1), told(20), of_class(0, 20), np.ones(20)).weight
    np.testing.assert_allclose(weight, 1 / 0.01, rtol=1e-6)


def test_false_rotations_pull_next_to_nothing() -> None:
    places = pulled(said_of(3, 30.0), told(3), of_class(CLASSES - 1, 3), np.ones(3))
    assert (places.weight < 1e-8).all() and (places.rotation_weight < 1e-3).all()


def test_densities_given_the_turn_are_those_of_both_together() -> None:
    """With a turn that is known to have to do with the shift."""
    said = said_of(1, 0.2)
    covariance = said.predictions.covariance.copy()
    covariance[:, 0, 1] = covariance[:, 1, 0] = 0.006
    mean = np.array([[0.01, 0.2, -0.1]])
    said = Said.of(Predictions(mean, covariance), told(1), np.ones(1, dtype=bool), 1, said.scale, PlacePriors())
    good = covariance[0] + np.diag([1e-4, 0.01, 0.01])
    both = multivariate_normal(np.zeros(3), good).logpdf(mean[0])
    np.testing.assert_allclose((said.log_turn + said.log_shift)[0, 0], both)
    tail = covariance[0] + np.diag([1e-4, 0.16, 0.16])
    both = multivariate_normal(np.zeros(3), tail).logpdf(mean[0])
    np.testing.assert_allclose((said.log_turn + said.log_shift)[GOOD - 1, 0], both)


def test_places_anywhere_are_as_likely_wherever_the_map_has_them() -> None:
    """As by a normal density in the mean (SciPy: its entropy)."""
    near, far = (said_of(3, off).log_anywhere for off in (0.5, 40.0))
    np.testing.assert_array_equal(near, far)
    np.testing.assert_allclose(near, -multivariate_normal(np.zeros(2), 2500.0 * np.eye(2)).entropy())


def test_one_false_rotation_may_be_in_place_where_no_place_is_known() -> None:
    """A hundred closures of a robot that nothing else joins cannot all be in place: there is but one for the robot."""
    known, scale = said_of(1, 0.0), alike(1, variance=0.01, extent=2500.0)
    assert known.log_in_place[0] > known.log_anywhere[0] + 5
    loose, told_of = Predictions(np.zeros((1, 3)), np.diag([6.0, 6000.0, 6000.0])[None]), np.ones(1, dtype=bool)
    said = Said.of(loose, told(1), told_of, 1, scale, PlacePriors())
    np.testing.assert_allclose(said.log_in_place, said.log_anywhere)
    # Nor is a place known of which only wrong ones would tell.
    np.testing.assert_allclose(
        Said.of(known.predictions, told(1), ~told_of, 1, scale, PlacePriors()).log_in_place, said.log_anywhere
    )
    many = Predictions(np.repeat(loose.mean, 100, axis=0), np.repeat(loose.covariance, 100, axis=0))
    scale, told_of = alike(100, variance=0.01, extent=2500.0), np.ones(100, dtype=bool)
    said = Said.of(many, told(100), told_of, 1, scale, PlacePriors())
    np.testing.assert_allclose(said.log_in_place, said.log_anywhere - np.log(100))


def test_what_nothing_predicts_is_as_likely_right_as_anywhere() -> None:
    unknown = np.diag([1e9, 1e9, 1e9])[None]
    extent, one = 2500.0, np.zeros(1, dtype=bool)
    loose = Predictions(np.zeros((1, 3)), unknown).bounded(1, anyhow(1), np.array([ANYWHERE * extent]), one)
    said = Said.of(loose, told(1), one, 1, alike(1, variance=1e-4, extent=extent), PlacePriors())
    np.testing.assert_allclose(said.log_turn[0], -np.log(2 * np.pi), atol=1e-4)
    np.testing.assert_allclose(said.log_shift[0], said.log_anywhere, atol=1e-4)


def test_wrong_closures_are_judged_without_what_two_chains_share() -> None:
    """Two within chains, known to .1 m; one between two, by what is known to 5 m; and one that nothing else joins."""
    deviation = np.array([[0.01, 0.1, 0.1], [0.01, 0.1, 0.1], [0.2, 5.0, 5.0], [100.0, 1e4, 1e4]])
    mean = np.array([[0.0, 0.1, 0.1], [0.0, 0.1, 0.1], [0.5, 8.0, 1.0], [1.0, 300.0, 1.0]])
    within = np.array([True, True, False, False])
    all_else = Predictions(mean, deviation[:, :, None] ** 2 * np.eye(3))
    bounded = all_else.bounded(1, 10.0, np.full(4, 2500.0), within)
    spread = np.sqrt(np.diagonal(bounded.wrong.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(spread[2], [0.01, 0.1, 0.1])
    np.testing.assert_allclose(bounded.wrong.mean[2], mean[2])  # not drawn towards what it says itself
    np.testing.assert_allclose(spread[3], [np.sqrt(10.0), 50.0, 50.0], rtol=1e-3)
    # Right ones pay for what is unknown of the place.
    assert np.sqrt(bounded.covariance[2, 1, 1]) > 4.9
    alone = all_else.bounded(1, 10.0, np.full(4, 2500.0), np.ones(4, dtype=bool))
    np.testing.assert_array_equal(alone.wrong.covariance, alone.covariance)


def test_what_states_no_translation_does_not_pull() -> None:
    unknown = replace(told(2), is_known=np.array([True, False]))
    weight = pulled(said_of(2, 0.1), unknown, of_class(0, 2), np.ones(2)).weight
    assert weight[0] > 1e6 * weight[1]
