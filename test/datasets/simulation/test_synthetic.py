"""Synthetic view-graphs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.synthetic import PaperRecipe


def test_large_graphs_have_the_share_of_pairs_they_should() -> None:
    sample = PaperRecipe(cameras=(4500, 4500), pair_share=(0.002, 0.002)).sample(np.random.default_rng(0))
    graph = sample.graph
    expected = 0.002 * 4500 * 4499 / 2
    assert graph.num_edges == pytest.approx(expected + 4499 * 0.998, abs=5 * np.sqrt(expected))
    assert len(torch.unique(graph.components())) == 1
    drawn = graph.select_edges(torch.arange(graph.num_edges) < int(expected * 0.9))
    assert bool((drawn.source < drawn.target).all())
    key = graph.source * 4500 + graph.target
    assert len(torch.unique(key)) == len(key)
    assert bool((torch.diff(key[: int(expected * 0.9)]) > 0).all())


@pytest.mark.parametrize("planar", [True, False], ids=["planar", "in space"])
def test_planar_is_about_the_vertical_and_its_plane(planar: bool) -> None:
    sample = PaperRecipe((200, 200), outlier_share=(0.0, 0.0), planar=planar).sample(np.random.default_rng(0))
    off_axis = sample.body_from_world[:, [0, 2]].abs().max()
    assert (float(off_axis) < 1e-12) == planar
    truth = Rotation.from_quat(sample.body_from_world.numpy())
    source, target = sample.graph.source.numpy(), sample.graph.target.numpy()
    measured = Rotation.from_quat(sample.graph.target_from_source.numpy())
    noise = ((truth[target] * truth[source].inv()).inv() * measured).as_rotvec()
    assert (np.abs(noise[:, 2]).max() < 1e-9) == planar
    # The covariance that is stated is the noise's.
    assert sample.noise is not None
    stated = sample.noise.of_kind[0].numpy()
    np.testing.assert_allclose(noise.T @ noise / len(noise), stated, atol=0.15 * stated.max())
