"""Synthetic view-graphs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

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
