"""The tuple algebra against scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from rotavg_ros.online import quaternion


@pytest.fixture
def pairs() -> list[tuple[quaternion.Quaternion, quaternion.Quaternion]]:
    drawn = Rotation.random(40, random_state=1).as_quat(canonical=True).tolist()
    return [(tuple(a), tuple(b)) for a, b in zip(drawn[::2], drawn[1::2], strict=True)]


def test_product_inverse_and_angle(pairs):
    for a, b in pairs:
        expected = Rotation.from_quat(a) * Rotation.from_quat(b)
        np.testing.assert_allclose(
            quaternion.normalize(quaternion.multiply(a, b)), expected.as_quat(canonical=True), atol=1e-14
        )
        np.testing.assert_allclose(quaternion.inverse(a), Rotation.from_quat(a).inv().as_quat(canonical=True))
        between = (Rotation.from_quat(a).inv() * Rotation.from_quat(b)).magnitude()
        assert quaternion.angle_between(a, b) == pytest.approx(between, abs=1e-12)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 1.0])
def test_slerp(pairs, fraction):
    for a, b in pairs:
        expected = Slerp([0, 1], Rotation.from_quat([a, b]))(fraction)
        np.testing.assert_allclose(quaternion.slerp(a, b, fraction), expected.as_quat(canonical=True), atol=1e-12)


def test_slerp_between_equal_rotations():
    assert quaternion.slerp(quaternion.IDENTITY, quaternion.IDENTITY, 0.5) == quaternion.IDENTITY


def test_normalize_makes_w_positive_and_length_one():
    np.testing.assert_allclose(quaternion.normalize((0, 0, 0, -2)), (0, 0, 0, 1))
    assert math.isclose(quaternion.norm(quaternion.normalize((1, 2, 3, -4))), 1)
