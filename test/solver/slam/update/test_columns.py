"""Columns of new closures, whole and half worked out, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.solver.slam.poses.state import PoseNoise
from rotavg_ros.solver.slam.update.columns import Columns
from rotavg_ros.solver.slam.update.linear import Linear

_BLOCKS, _SIZE = 12, 3


def _linear(information: np.ndarray, is_half: bool) -> Linear:
    root = np.linalg.cholesky(information)
    flat = _BLOCKS * _SIZE

    def left(columns: np.ndarray) -> np.ndarray:
        right = columns.reshape(flat, -1)
        if not is_half:
            return right
        begun = np.linalg.solve(root, right)
        begun[np.abs(begun) < 1e-12] = 0.0
        return begun

    def half(begun: np.ndarray) -> np.ndarray:
        return begun if is_half else np.linalg.solve(information, begun)

    def ended(half: np.ndarray) -> np.ndarray:
        return (np.linalg.solve(root.T, half) if is_half else half).reshape(_BLOCKS, _SIZE, -1)

    nothing, nowhere = np.zeros((2, _BLOCKS)), np.arange(_BLOCKS)
    noise, axes = PoseNoise(*np.ones(8)), np.eye(3)
    return Linear(
        0,
        nowhere,
        nowhere,
        nothing,
        nothing,
        _BLOCKS,
        1,
        axes[:, 2:],
        axes[:, :2],
        noise,
        0,
        0,
        1.0,
        left,
        half,
        ended,
        1.0,
    )


def _information(rng: np.random.Generator) -> np.ndarray:
    """Of two parts that have nothing in common, so that halves have rows of nothing."""
    information = np.zeros((_BLOCKS * _SIZE,) * 2)
    half = len(information) // 2
    for part in (slice(half), slice(half, None)):
        rows = rng.normal(size=(half, half))
        information[part, part] = rows.T @ rows + np.eye(half)
    return information


@pytest.mark.parametrize("is_half", [False, True])
def test_they_tell_what_the_inverse_does(is_half: bool) -> None:
    rng = np.random.default_rng(0)
    information = _information(rng)
    linear, inverse = _linear(information, is_half), np.linalg.inv(information)
    right = np.zeros((_BLOCKS, _SIZE, 5 * _SIZE))
    for closure in range(5):
        ends = rng.choice(_BLOCKS // 2, 2, replace=False) + closure % 2 * (_BLOCKS // 2)
        right[ends, :, closure * _SIZE : (closure + 1) * _SIZE] = rng.normal(size=(2, _SIZE, _SIZE))
    columns = Columns.none()
    for first, last in ((0, 2), (2, 5)):
        columns = columns.and_of(linear, np.arange(first, last), right[:, :, first * _SIZE : last * _SIZE])
    np.testing.assert_array_equal(columns.edge, np.arange(5))
    flat = right.reshape(len(information), -1)
    np.testing.assert_allclose(columns.covariance, flat.T @ inverse @ flat, atol=1e-12)
    pull = rng.normal(size=(5 * _SIZE, 2))
    np.testing.assert_allclose(
        columns.moves(linear, pull).reshape(len(information), 2), inverse @ flat @ pull, atol=1e-12
    )
    blocks = np.array([[3, 7, 3], [0, 7, 11]])
    expected = (inverse @ flat).reshape(_BLOCKS, _SIZE, -1)[blocks]
    known = columns.with_anchors(linear, blocks)
    np.testing.assert_allclose(known.at(blocks), expected, atol=1e-12)
    assert known.with_anchors(linear, blocks[:, 1:]) is known
    np.testing.assert_allclose(known.at(blocks[:, 1:]), expected[:, 1:], atol=1e-12)
    some = Columns.none().with_anchors(linear, blocks).and_of(linear, np.arange(5), right)
    np.testing.assert_allclose(some.at(blocks), expected, atol=1e-12)


@pytest.mark.parametrize("is_half", [False, True])
def test_of_no_closures_nothing_moves(is_half: bool) -> None:
    linear = _linear(_information(np.random.default_rng(1)), is_half)
    assert not Columns.none().moves(linear, np.empty((0, 1))).any()
    assert Columns.none().with_anchors(linear, np.array([2, 5])).at(np.array([2, 5])).shape == (2, _SIZE, 0)
