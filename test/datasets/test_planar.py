"""Rotations about z."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.datasets.planar import are_about_z, heading_of_quaternion, quaternion_of_heading


@pytest.mark.parametrize("axis", [0, 1])
def test_what_32_bits_leave_of_a_turn_about_z_is_one(axis: int) -> None:
    turns = quaternion_of_heading(np.linspace(-3, 3, 50))
    np.testing.assert_allclose(heading_of_quaternion(turns), np.linspace(-3, 3, 50))
    assert are_about_z(turns)
    turns[7, axis] = np.finfo(np.float32).eps / 2
    assert are_about_z(turns)
    turns[7, axis] = -1e-5
    assert not are_about_z(turns)
