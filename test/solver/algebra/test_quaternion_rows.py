"""Quaternions in rows against scipy."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.solver.algebra import quaternion_rows


def _random(count: int, seed: int) -> Rotation:
    return Rotation.random(count, random_state=np.random.default_rng(seed))


def test_products_and_logarithms_are_those_of_scipy() -> None:
    a, b = _random(200, 0), _random(200, 1)
    product = quaternion_rows.multiply(a.as_quat().T, quaternion_rows.inverse(b.as_quat().T))
    np.testing.assert_allclose(quaternion_rows.log(product).T, (a * b.inv()).as_rotvec(), atol=1e-12)
    np.testing.assert_allclose(quaternion_rows.log(-product).T, (a * b.inv()).as_rotvec(), atol=1e-12)


def test_exponentials_are_those_of_scipy_down_to_nothing() -> None:
    vectors = _random(50, 2).as_rotvec()
    vectors[:3] *= 1e-9
    vectors[3] = 0
    quaternion = quaternion_rows.exp(vectors.T)
    np.testing.assert_allclose(quaternion.T, Rotation.from_rotvec(vectors).as_quat(), atol=1e-15)
    np.testing.assert_allclose(quaternion_rows.log(quaternion).T, vectors, atol=1e-14)


def test_residuals_are_what_edges_disagree_by() -> None:
    nodes, measured = _random(20, 3), _random(60, 4)
    source, target = np.random.default_rng(5).integers(0, 20, (2, 60))
    expected = (nodes[target].inv() * measured * nodes[source]).as_rotvec()
    residual = quaternion_rows.residual(nodes.as_quat().T, measured.as_quat().T, source, target)
    np.testing.assert_allclose(quaternion_rows.log(residual).T, expected, atol=1e-12)
    for sign in (1, -1):
        vectors = quaternion_rows.residual_vectors(nodes.as_quat().T, sign * measured.as_quat().T, source, target)
        np.testing.assert_allclose(vectors, expected, atol=1e-12)
