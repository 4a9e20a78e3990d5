"""What edges measure is the truth and noise of the size that was asked for."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from rotavg_ros.datasets.simulation.poses.drawn import Claims, Noise, redrawn, with_closures

from .runs import NOISE, run


@pytest.mark.parametrize("dimensions", [2, 3])
def test_measured_less_true_is_the_noise(dimensions: int) -> None:
    drawn = run(dimensions, keyframes=1000)
    turn, shift = drawn.errors()
    axes = [2] if dimensions == 2 else [0, 1, 2]
    for kind, degrees, metres in (
        (~drawn.is_closure, NOISE.step_deg, NOISE.step_m),
        (drawn.is_closure, NOISE.closure_deg, NOISE.closure_m),
    ):
        assert kstest((turn[kind][:, axes] / np.radians(degrees)).ravel(), "norm").pvalue > 1e-3
        assert kstest((shift[kind][:, :dimensions] / metres).ravel(), "norm").pvalue > 1e-3
        np.testing.assert_allclose(np.unique(drawn.sigma[kind], axis=0), [[np.radians(degrees), metres]])
    if dimensions == 2:
        assert not shift[:, 2].any()
        np.testing.assert_allclose(turn[:, :2], 0, atol=1e-9)


@pytest.mark.parametrize("dimensions", [2, 3])
def test_without_noise_edges_are_exact(dimensions: int) -> None:
    drawn = run(dimensions)
    stated = np.full((drawn.graph.num_edges, 2), 0.1)
    exact = redrawn(drawn.graph, drawn.poses, Noise(0, 0, 0, 0), np.random.default_rng(0), stated)
    for error in exact.errors():
        np.testing.assert_allclose(error, 0, atol=1e-9)
    np.testing.assert_allclose(exact.graph.precision, 100.0)


def test_edges_come_as_a_robot_reports_them() -> None:
    drawn = run()
    claims = Claims(np.array([300, 3]), np.array([2, 40]), Rotation.identity(2), np.ones((2, 3)))
    graph = with_closures(drawn, claims).graph
    later = np.maximum(graph.source.numpy(), graph.target.numpy())
    assert (np.diff(later) >= 0).all()
    same = np.diff(later) == 0
    assert (np.diff(graph.kind.numpy())[same] >= 0).all()


def test_a_claim_from_the_other_side_is_the_same() -> None:
    rng = np.random.default_rng(1)
    claims = Claims(np.arange(5), np.arange(5) + 9, Rotation.random(5, random_state=1), rng.normal(size=(5, 3)))
    which = np.array([True, False, True, True, False])
    back = claims.reversed(which)
    assert back.source[which].tolist() == claims.target[which].tolist()
    again = back.reversed(which)
    np.testing.assert_allclose(again.translation, claims.translation, atol=1e-12)
    np.testing.assert_allclose((again.target_from_source * claims.target_from_source.inv()).magnitude(), 0, atol=1e-9)
