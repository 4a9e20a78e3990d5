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


ISAM2 = [peers.isam2_huber, peers.isam2_cauchy, peers.isam2_geman_mcclure]
ALL = [peers.colmap, peers.shonan, peers.gnc, *ISAM2, peers.line_process]
JUDGES = [peers.gnc, peers.line_process]


def skip_if_optional_and_missing(peer: object) -> None:
    """Open3D is not among what `make setup` installs."""
    if peer is peers.line_process:
        pytest.importorskip("open3d", exc_type=ImportError)


@pytest.mark.parametrize("peer", ALL)
def test_noise_free(peer: object) -> None:
    skip_if_optional_and_missing(peer)
    graph, truth = pose_graph()
    answer = peer(graph)  # type: ignore[operator]
    assert float(orientation_errors(answer.body_from_world, truth).max()) < 1e-5
    assert answer.seconds > 0


@pytest.mark.parametrize("peer", ALL)
def test_components_and_parallel_edges(peer: object) -> None:
    skip_if_optional_and_missing(peer)
    truth = rotations.random(7, generator=torch.Generator().manual_seed(1))
    source, target = torch.tensor([0, 1, 0, 2, 4, 6]), torch.tensor([1, 2, 2, 0, 6, 5])
    relative = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    graph = ViewGraph.create(source, target, relative)
    estimate = peer(graph).body_from_world  # type: ignore[operator]
    assert float(orientation_errors(estimate, truth, graph.components()).max()) < 1e-5


@pytest.mark.parametrize("peer", JUDGES)
def test_the_false_closure_is_found(peer: object) -> None:
    skip_if_optional_and_missing(peer)
    graph, truth = pose_graph(outlier=True)
    answer = peer(graph)  # type: ignore[operator]
    assert answer.outlier_score is not None
    assert (answer.outlier_score > 0.5).nonzero().flatten().tolist() == [graph.num_edges - 1]
    assert float(orientation_errors(answer.body_from_world, truth).max()) < 1e-5


def test_robust_losses_resist_the_false_closure() -> None:
    """In the order of their tails: a loss that is bounded leaves the least of it."""
    graph, truth = pose_graph(outlier=True)
    huber, cauchy, bounded = (float(orientation_errors(peer(graph).body_from_world, truth).mean()) for peer in ISAM2)
    assert bounded < cauchy < huber


@pytest.mark.parametrize(("peer", "package"), [(peers.gnc, "gtsam"), (peers.line_process, "open3d")])
def test_a_missing_peer_is_told(monkeypatch: pytest.MonkeyPatch, peer: object, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(peers.MissingPeerError, match=f"run: pip install {package}"):
        peer(pose_graph()[0])  # type: ignore[operator]
