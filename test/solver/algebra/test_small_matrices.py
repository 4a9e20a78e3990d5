"""Cholesky and inverses of many small matrices against NumPy's own."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.solver.algebra.small_matrices import _eigh, eigh, inverse, inverse_root


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_as_numpy_has_it(size: int) -> None:
    """Of matrices whose numbers differ by twelve orders of magnitude, too."""
    rng = np.random.default_rng(size)
    part = rng.standard_normal((40, size, size + 2)) * 10.0 ** rng.uniform(-6, 6, (40, size, 1))
    matrices = part @ part.transpose(0, 2, 1)
    before = matrices.copy()
    root = inverse_root(matrices)
    np.testing.assert_array_equal(matrices, before)
    np.testing.assert_array_equal(root, np.tril(root))
    scale = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    expected = np.linalg.inv(np.linalg.cholesky(matrices))
    np.testing.assert_allclose(root * scale[:, None, :], expected * scale[:, None, :], rtol=1e-9, atol=1e-9)
    unit = np.broadcast_to(np.eye(size), matrices.shape)
    relative = inverse(matrices) @ matrices * (scale[:, :, None] / scale[:, None, :])
    np.testing.assert_allclose(relative, unit, atol=1e-8)


def test_none_at_all() -> None:
    assert inverse_root(np.zeros((0, 3, 3))).shape == (0, 3, 3)


def test_one_that_is_not_positive_definite() -> None:
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        inverse_root(np.stack((np.eye(2), np.ones((2, 2)))))


@pytest.mark.parametrize("size", [1, 2, 3])
def test_eigenvectors_are_numpys(size: int) -> None:
    """Of any symmetric ones: definite or not, with equal eigenvalues, next to diagonal, of no size at all."""
    rng = np.random.default_rng(size)
    part = rng.standard_normal((200, size, size)) * 10.0 ** rng.uniform(-6, 6, (200, size, 1))
    matrices = part + part.transpose(0, 2, 1)
    matrices[0], matrices[1], matrices[2] = 0.0, np.eye(size), 1e-300 * np.ones((size, size))
    matrices[3] = np.eye(size) + 1e-17 * np.ones((size, size))
    before = matrices.copy()
    value, vector = eigh(matrices)
    np.testing.assert_array_equal(matrices, before)
    largest = np.abs(before).max(axis=(1, 2)).clip(1e-300)
    np.testing.assert_allclose(
        np.sort(value, axis=1) / largest[:, None], np.linalg.eigvalsh(before) / largest[:, None], atol=1e-13
    )
    np.testing.assert_allclose(
        vector.transpose(0, 2, 1) @ vector, np.broadcast_to(np.eye(size), before.shape), atol=1e-13
    )
    made = vector @ (value[:, :, None] * vector.transpose(0, 2, 1))
    np.testing.assert_allclose(made / largest[:, None, None], before / largest[:, None, None], atol=1e-13)


def test_parts_of_matrices_need_no_code_of_their_own() -> None:
    """One compilation is for all layouts in memory."""
    matrices = np.random.default_rng(4).standard_normal((5, 6, 6))
    matrices += matrices.transpose(0, 2, 1)
    for part, same in zip(eigh(matrices[:, 3:, 3:]), eigh(matrices[:, 3:, 3:].copy()), strict=True):
        np.testing.assert_array_equal(part, same)
    assert len(_eigh.dispatcher.signatures) == 1  # type: ignore[attr-defined]
