"""Weighted least squares on graphs, against numpy's least squares."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csc_array

from rotavg_ros.solver.algebra.sparse import laplacian
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianPattern, LaplacianSystem
from rotavg_ros.solver.algebra.sparse.sparse_factor import SparseFactor


def random_graph(num_nodes: int, num_edges: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A chain through all nodes and random edges besides."""
    chain, random = np.arange(num_nodes - 1), rng.integers(0, num_nodes, num_edges)
    source = np.concatenate((chain, random))
    target = np.concatenate((chain + 1, (random + rng.integers(1, num_nodes, num_edges)) % num_nodes))
    return source, target


@pytest.mark.parametrize(("num_edges", "is_dense"), [(200, True), (60, False)], ids=["dense", "sparse"])
def test_fit_is_the_least_squares_solution(num_edges: int, is_dense: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    sparse = []

    def counted(matrix: csc_array, *, is_ordered: bool) -> SparseFactor:
        sparse.append(matrix)
        return SparseFactor(matrix, is_ordered=is_ordered)

    monkeypatch.setattr(laplacian, "SparseFactor", counted)
    rng = np.random.default_rng(0)
    source, target = random_graph(20, num_edges, rng)
    weight, difference = rng.uniform(0.1, 10, len(source)), rng.standard_normal((len(source), 3))
    pattern = LaplacianPattern(20, source, target, np.array([3]))
    pattern.factorize(rng.uniform(0.1, 10, len(source)))  # from then on the order of elimination is known
    assert (not sparse) is is_dense
    fitted = [system.fit(difference) for system in (pattern.factorize(weight), pattern.factorize(weight))]
    fitted.append(LaplacianSystem(20, source, target, weight, np.array([3])).fit(difference))
    incidence = np.zeros((len(source), 20))
    incidence[np.arange(len(source)), target] = 1
    incidence[np.arange(len(source)), source] = -1
    root_weight = np.sqrt(weight)[:, None]
    expected, *_ = np.linalg.lstsq(root_weight * incidence, root_weight * difference)
    for found in fitted:
        np.testing.assert_allclose(found, expected - expected[3], atol=1e-8)


def test_weights_over_the_whole_range_of_doubles_stay_finite() -> None:
    source, target = np.arange(9), np.arange(1, 10)
    weight = 10.0 ** np.array([-200, 200, -30, 30, -300, 0, 300, 5, -5])
    fitted = LaplacianSystem(10, source, target, weight, np.array([0])).fit(np.ones((9, 1)))
    assert np.isfinite(fitted).all()


def test_a_node_without_edges_stays_where_it_is() -> None:
    nothing = np.empty(0, dtype=np.int64)
    pattern = LaplacianPattern(1, nothing, nothing, np.array([0]))
    np.testing.assert_array_equal(pattern.factorize(np.empty(0)).fit(np.empty((0, 3))), np.zeros((1, 3)))
