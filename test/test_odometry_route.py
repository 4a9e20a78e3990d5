"""Sums of odometry's steps, joined edge by edge, are those of all steps at once."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.odometry_route import ROUTE_COLUMNS, Bend, Routes, joined


class Way:
    """Steps one after the other: where they lead is by the axes of where they begin."""

    def __init__(self, turn: Rotation, displacement: np.ndarray) -> None:
        count = len(displacement)
        world = [Rotation.identity()]
        for step in range(count):
            world.append(world[-1] * turn[step])
        self.end = world[-1]
        self.steps = np.array([float(count)])
        moved = np.array([world[step].apply(displacement[step]) for step in range(count)])
        place = np.cumsum(moved, axis=0)
        self.displacement = place[-1:]
        square = turn.magnitude() ** 2
        bends = [_bend(moved, place, weight / weight.sum()) for weight in (np.ones(count), square)]
        by_bias = [np.zeros((3, 3))]
        for step in range(count):
            by_bias.append(by_bias[-1] + world[step].as_matrix())
        shift = sum(-_cross(moved[step]) @ by_bias[step] for step in range(count))
        turned, way = square.sum(), np.linalg.norm(displacement, axis=1).sum()
        self.routes = Routes(np.array([turned]), np.array([way]), *bends, by_bias[-1][None], shift[None])


def _bend(moved: np.ndarray, place: np.ndarray, share: np.ndarray) -> Bend:
    """Of the variance of steps each has a share."""
    before = np.cumsum(share) - share
    spread = np.cov(place.T, aweights=share, bias=True) if len(place) > 1 else np.zeros((3, 3))
    return Bend((before @ moved)[None], spread[None])


def _cross(vector: np.ndarray) -> np.ndarray:
    return np.cross(vector, np.eye(3)).T


def test_the_cross_product_is_one():
    one, other = np.random.default_rng(0).normal(size=(2, 3))
    np.testing.assert_allclose(_cross(one) @ other, np.cross(one, other))


@given(st.integers(0, 2**32), st.integers(1, 6), st.integers(1, 6))
def test_joined_edges_hold_the_sums_of_all_their_steps(seed, first, second):
    rng = np.random.default_rng(seed)
    turn, displacement = Rotation.random(first + second, rng=rng), rng.normal(size=(first + second, 3))
    one, other = Way(turn[:first], displacement[:first]), Way(turn[first:], displacement[first:])
    whole = Way(turn, displacement)
    found = joined(
        (one.routes, other.routes),
        (one.steps, other.steps),
        other.displacement,
        one.end.as_matrix()[None],
    )
    np.testing.assert_allclose(found.columns, whole.routes.columns, atol=1e-9)


@given(st.integers(0, 2**32), st.integers(1, 8))
def test_steps_that_are_all_alike_are_even(seed, count):
    rng = np.random.default_rng(seed)
    step, angle = rng.normal(size=3), rng.uniform(0.0, 0.3)
    straight = Way(Rotation.from_rotvec(np.full((count, 3), 1e-12)), np.tile(step, (count, 1)))
    even = Routes.even(np.array([count * angle]), straight.displacement, straight.steps)
    np.testing.assert_allclose(even.columns[:, 1:], straight.routes.columns[:, 1:], atol=1e-9)
    np.testing.assert_allclose(even.turned, count * angle**2)


@given(st.integers(0, 2**32), st.integers(1, 8))
def test_a_small_bias_turns_and_moves_as_is_said(seed, count):
    rng = np.random.default_rng(seed)
    turn, displacement = Rotation.random(count, rng=rng), rng.normal(size=(count, 3))
    bias = 1e-5 * rng.normal(size=3)
    before, after = Way(turn, displacement), Way(Rotation.from_rotvec(bias) * turn, displacement)
    turned = (after.end * before.end.inv()).as_rotvec()
    np.testing.assert_allclose(before.routes.by_bias[0] @ bias, turned, atol=1e-7)
    moved = after.displacement[0] - before.displacement[0]
    np.testing.assert_allclose(before.routes.shift_by_bias[0] @ bias, moved, atol=1e-7)


def test_what_is_not_known_is_as_given_and_the_rest_as_stated():
    rng = np.random.default_rng(0)
    stated, other = (Way(Rotation.random(4, rng=rng), rng.normal(size=(4, 3))).routes for _ in range(2))
    columns = stated.columns
    assert columns.shape == (1, ROUTE_COLUMNS)
    np.testing.assert_allclose(Routes.known(columns, other).columns, columns)
    columns[:, 1:] = np.nan
    found = Routes.known(columns, other)
    np.testing.assert_allclose(found.turned, stated.turned)
    np.testing.assert_allclose(found.columns[:, 1:], other.columns[:, 1:])
