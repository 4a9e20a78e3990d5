"""The peers get the graph the right way round: where there is no noise, all agree with the truth."""

from __future__ import annotations

import sys

import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.evaluation.common import peers
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.view_graph import ViewGraph

NUM_NODES = 12


def pose_graph(outlier: bool = False) -> tuple[ViewGraph, torch.Tensor]:
    """A noise-free chain with closures in both directions, and with a false one on request."""
    truth = rotations.random(NUM_NODES, generator=torch.Generator().manual_seed(0))
    source = torch.tensor([*range(NUM_NODES - 1), 0, 9, 3, 11, 1])
    target = torch.tensor([*range(1, NUM_NODES), 4, 2, 8, 0, 7])
    relative = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    if outlier:
        relative[-1] = rotations.multiply(relative[-1], rotations.exp(torch.tensor([0, 0, 2.0]).double()))
    kind = [0] * (NUM_NODES - 1) + [1] * 5
    return ViewGraph.create(source, target, relative, kind=kind, precision=[1e4] * 16), truth


@pytest.mark.parametrize("peer", [peers.colmap, peers.shonan, peers.gnc, peers.isam2_huber])
def test_noise_free(peer: object) -> None:
    graph, truth = pose_graph()
    answer = peer(graph)  # type: ignore[operator]
    assert float(orientation_errors(answer.body_from_world, truth).max()) < 1e-5
    assert answer.seconds > 0


@pytest.mark.parametrize("peer", [peers.colmap, peers.shonan, peers.gnc, peers.isam2_huber])
def test_components_and_parallel_edges(peer: object) -> None:
    truth = rotations.random(7, generator=torch.Generator().manual_seed(1))
    source, target = torch.tensor([0, 1, 0, 2, 4, 6]), torch.tensor([1, 2, 2, 0, 6, 5])
    relative = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    graph = ViewGraph.create(source, target, relative)
    estimate = peer(graph).body_from_world  # type: ignore[operator]
    assert float(orientation_errors(estimate, truth, graph.components()).max()) < 1e-5


def test_gnc_finds_the_false_closure() -> None:
    graph, truth = pose_graph(outlier=True)
    answer = peers.gnc(graph)
    assert answer.outlier_score is not None
    assert (answer.outlier_score > 0.5).nonzero().flatten().tolist() == [graph.num_edges - 1]
    assert float(orientation_errors(answer.body_from_world, truth).max()) < 1e-5


def test_a_missing_peer_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    with pytest.raises(peers.PeerError, match="run: pip install gtsam"):
        peers.gnc(pose_graph()[0])
