"""Quaternion algebra against scipy's Rotation, which we did not write."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations


def _random(count: int, seed: int) -> tuple[torch.Tensor, Rotation]:
    reference = Rotation.random(count, random_state=seed)
    return torch.from_numpy(reference.as_quat(canonical=True)), reference


def _assert_same(quaternions: torch.Tensor, reference: Rotation, tolerance: float = 1e-12) -> None:
    assert (Rotation.from_quat(quaternions.numpy()) * reference.inv()).magnitude().max() < tolerance


def test_multiply_is_scipys_composition() -> None:
    a, ra = _random(50, 0)
    b, rb = _random(50, 1)
    _assert_same(rotations.multiply(a, b), ra * rb)


def test_inverse_and_matrix_and_rotate() -> None:
    a, ra = _random(50, 2)
    _assert_same(rotations.inverse(a), ra.inv())
    np.testing.assert_allclose(rotations.to_matrix(a).numpy(), ra.as_matrix(), atol=1e-12)
    vectors = np.random.default_rng(0).standard_normal((50, 3))
    np.testing.assert_allclose(rotations.rotate(a, torch.from_numpy(vectors)).numpy(), ra.apply(vectors), atol=1e-12)


def test_from_matrix_includes_half_turns() -> None:
    axes = np.vstack((np.eye(3), np.ones(3) / np.sqrt(3), [0.6, -0.8, 0]))
    references = Rotation.concatenate([Rotation.random(50, random_state=3), Rotation.from_rotvec(np.pi * axes)])
    _assert_same(rotations.from_matrix(torch.from_numpy(references.as_matrix())), references, 1e-9)


@given(hnp.arrays(np.float64, (7, 3), elements=st.floats(-1.8, 1.8)))
def test_exp_is_scipys_and_log_its_inverse(vectors: np.ndarray) -> None:
    quaternions = rotations.exp(torch.from_numpy(vectors))
    _assert_same(quaternions, Rotation.from_rotvec(vectors), 1e-9)
    np.testing.assert_allclose(rotations.log(quaternions).numpy(), Rotation.from_rotvec(vectors).as_rotvec(), atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-6, 1e-4, 1e-3, 1.0, np.pi - 1e-9, np.pi])
def test_exp_log_near_their_special_angles(angle: float) -> None:
    vector = torch.tensor([[0.0, angle, 0.0]], dtype=torch.float64)
    assert abs(float(rotations.log(rotations.exp(vector)).norm()) - angle) < 1e-9
    assert abs(float(rotations.angle(rotations.exp(vector))) - angle) < 1e-9


def test_gradients_are_finite_at_the_identity() -> None:
    vector = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    rotations.log(rotations.exp(vector)).sum().backward()
    assert vector.grad is not None and torch.allclose(vector.grad, torch.ones(1, 3, dtype=torch.float64))


def test_angle_between_is_scipys_magnitude() -> None:
    a, ra = _random(50, 4)
    b, rb = _random(50, 5)
    np.testing.assert_allclose(rotations.angle_between(a, b).numpy(), (ra.inv() * rb).magnitude(), atol=1e-12)
    np.testing.assert_allclose(rotations.angle_between(a, -b).numpy(), (ra.inv() * rb).magnitude(), atol=1e-12)


def test_canonical_and_normalize() -> None:
    a, _ = _random(50, 6)
    assert torch.equal(rotations.canonical(-a), a)
    assert torch.allclose(rotations.normalize(-3 * a), a)


@given(st.floats(0, 1))
def test_slerp_moves_at_constant_speed(fraction: float) -> None:
    a, ra = _random(5, 7)
    b, rb = _random(5, 8)
    along = rotations.slerp(a, b, torch.full((5,), fraction, dtype=torch.float64))
    np.testing.assert_allclose(
        rotations.angle_between(a, along).numpy(), fraction * (ra.inv() * rb).magnitude(), atol=1e-9
    )


def test_random_is_uniform() -> None:
    generator = torch.Generator().manual_seed(0)
    angle = rotations.angle(rotations.random(20000, generator=generator))
    # Mean angle of the Haar measure: π/2 + 2/π.
    assert abs(float(angle.mean()) - (np.pi / 2 + 2 / np.pi)) < 0.02
