"""Least squares with covariances against SciPy's minimiser and against the covariances themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, rotations
from rotavg_ros.baselines.most_likely import most_likely
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.metrics import orientation_errors


def _drawn(num_nodes: int, size: float, rng: np.random.Generator) -> tuple[ViewGraph, np.ndarray, Rotation]:
    """All pairs, each with a covariance of its own, whose standard deviations are at most ``size`` rad."""
    truth = Rotation.random(num_nodes, random_state=rng)
    source, target = np.triu_indices(num_nodes, k=1)
    axes = Rotation.random(len(source), random_state=rng).as_matrix()
    deviation = size * rng.uniform(0.1, 1.0, (len(source), 3))
    covariance = (axes * deviation[:, None, :] ** 2) @ axes.transpose(0, 2, 1)
    noise = (axes @ (deviation * rng.standard_normal(deviation.shape))[:, :, None])[:, :, 0]
    relative = truth[target] * truth[source].inv() * Rotation.from_rotvec(noise)
    return ViewGraph.create(source, target, relative.as_quat()), covariance, truth


@settings(max_examples=8)
@given(st.integers(0, 2**16), st.sampled_from([0.02, 0.3]))
def test_it_is_the_minimum_that_scipy_finds(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    graph, covariance, truth = _drawn(6, size, rng)
    source, target = graph.source.numpy(), graph.target.numpy()
    measured = Rotation.from_quat(graph.target_from_source.numpy())
    whitener = np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)

    def residuals(turns: np.ndarray) -> np.ndarray:
        nodes = truth * Rotation.from_rotvec(np.concatenate((np.zeros(3), turns)).reshape(-1, 3))
        noise = (nodes[source] * nodes[target].inv() * measured).as_rotvec()
        return (whitener @ noise[:, :, None]).ravel()

    expected = least_squares(residuals, np.zeros(15), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    nodes = truth * Rotation.from_rotvec(np.concatenate((np.zeros(3), expected.x)).reshape(-1, 3))
    found = most_likely(graph, torch.from_numpy(covariance), torch.from_numpy(truth.as_quat()))
    assert float(orientation_errors(found, torch.from_numpy(nodes.as_quat())).max()) < 2e-5


@pytest.mark.parametrize("recipe", [ReleasedRecipe((60, 60)), PaperRecipe((60, 60))], ids=["released", "paper"])
def test_generators_state_the_covariance_of_their_noise(recipe: ReleasedRecipe | PaperRecipe) -> None:
    undisturbed = replace(recipe, outlier_share=(0.0, 0.0), noise_deg=(5.0, 5.0))
    noise = undisturbed.noise(100_000, np.random.default_rng(0))
    vectors = noise.rotation.as_rotvec()
    usual = noise.covariance.of_kind[0].numpy()
    np.testing.assert_allclose(vectors.T @ vectors / len(vectors), usual, atol=0.02 * usual.max())
    assert not noise.covariance.kind.any()
    sample = replace(recipe, outlier_share=(0.1, 0.1)).sample(np.random.default_rng(1))
    assert sample.noise is not None
    is_disturbed = sample.noise.kind.bool()
    assert float(is_disturbed.double().mean()) == pytest.approx(0.1, abs=1 / len(is_disturbed))
    assert float(sample.noise_angle[is_disturbed].median()) > 2 * float(sample.noise_angle[~is_disturbed].median())
    assert sample.noise.of_edges().shape == (sample.graph.num_edges, 3, 3)


def test_components_and_lone_nodes_are_left_where_nothing_says_otherwise() -> None:
    truth = rotations.random(5, generator=torch.Generator().manual_seed(0))
    source, target = torch.tensor([0, 2]), torch.tensor([1, 3])
    relative = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    graph = ViewGraph.create(source, target, relative, num_nodes=5)
    found = most_likely(graph, torch.eye(3, dtype=torch.float64).expand(2, 3, 3), truth)
    assert float(rotations.angle_between(found, truth).max()) < 1e-9
