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


def test_matrices_and_turns_back_are_those_of_scipy() -> None:
    turn, which = _random(30, 6), np.random.default_rng(7).integers(0, 30, 80)
    np.testing.assert_allclose(quaternion_rows.matrices(turn.as_quat().T), turn.as_matrix(), atol=1e-14)
    vector = np.random.default_rng(8).normal(size=(80, 3))
    back = quaternion_rows.turned_back(turn.as_quat(), which, vector)
    np.testing.assert_allclose(back, turn[which].inv().apply(vector), atol=1e-14)


def test_corrections_are_spread_along_the_shorter_way() -> None:
    """Whatever the signs of both quaternions, and one after another within a segment."""
    rng = np.random.default_rng(9)
    orientation, correction = _random(60, 10), _random(8, 11)
    between = np.repeat(rng.integers(0, 8, (20, 2)), 3, axis=0)
    fraction = rng.random(60)
    above, below = (correction[ends] for ends in between.T)
    expected = orientation * above * Rotation.from_rotvec(fraction[:, None] * (above.inv() * below).as_rotvec())
    signs = np.where(rng.random(8) < 0.5, -1.0, 1.0)[:, None]
    spread = quaternion_rows.spread(orientation.as_quat(), signs * correction.as_quat(), between, fraction)
    np.testing.assert_allclose((Rotation.from_quat(spread).inv() * expected).magnitude(), 0.0, atol=1e-12)
