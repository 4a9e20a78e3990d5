"""The networks: the formula of message passing, symmetries, and weights that are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from rotavg_ros import UserError, rotations
from rotavg_ros.solver.networks import NETWORKS
from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.fine_net import EVEN_FEATURES, ODD_FEATURES, FineNet, edge_features
from rotavg_ros.solver.neurora.message_passing import DirectedEdges, MessagePassingNetwork
from rotavg_ros.solver.neurora.network_store import WEIGHTS_FOLDER, load_network, metadata


def _graph(num_nodes: int = 12, num_edges: int = 30, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(seed)
    source = rng.integers(0, num_nodes - 1, num_edges)
    target = (source + rng.integers(1, num_nodes - 1, num_edges)) % (num_nodes - 1)
    generator = torch.Generator().manual_seed(seed)
    return torch.from_numpy(source), torch.from_numpy(target), rotations.random(num_edges, generator=generator).float()


def test_message_passing_is_its_formula() -> None:
    """Edge by edge and node by node, as the module's docstring writes it; the last node is isolated."""
    source, target, quaternion = _graph()
    edges = DirectedEdges.of(source, target, 12)
    torch.manual_seed(0)
    network = MessagePassingNetwork(node_width=3, edge_width=4)
    states = torch.randn(12, 3)
    features = torch.cat((quaternion, rotations.inverse(quaternion)))
    actual, messages = network(states, features, edges)

    activation = features[:, :0]
    for layer in network.layers:
        inputs = torch.cat((features, activation), dim=1)
        projected = layer.edge_projection(inputs)
        activation = torch.stack(
            [
                torch.relu(layer.target_projection(states[v]) + layer.source_projection(states[u]) + x)
                for u, v, x in zip(edges.source.tolist(), edges.target.tolist(), projected, strict=True)
            ]
        )
        message = layer.message_output(activation)
        rows = []
        for node in range(12):
            incoming = message[edges.target == node]
            mean = incoming.mean(dim=0) if len(incoming) else torch.zeros(32)
            rows.append(torch.relu(layer.update(torch.cat((states[node], mean)))))
        states = torch.stack(rows)
    torch.testing.assert_close(actual, states, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(messages, message, atol=1e-5, rtol=1e-5)


def test_both_networks_have_the_papers_size() -> None:
    """About 49.8 K parameters in all (NeuRoRA, §5); FineNet sees more of an edge than the paper's."""
    total = sum(p.numel() for network in (CleanNet(), FineNet()) for p in network.parameters())
    assert total == pytest.approx(49_800, rel=0.07)


def test_clean_net_does_not_care_for_an_edges_direction() -> None:
    source, target, quaternion = _graph()
    network = load_network(NETWORKS["sfm-clean-net"])
    forward = network(quaternion, DirectedEdges.of(source, target, 12))
    backward = network(rotations.inverse(quaternion), DirectedEdges.of(target, source, 12))
    torch.testing.assert_close(forward.outlier_logit, backward.outlier_logit, atol=1e-4, rtol=1e-4)
    angle = rotations.angle_between(forward.target_from_source, rotations.inverse(backward.target_from_source))
    assert float(angle.max()) < 2e-3


def test_networks_do_not_care_for_the_order_of_nodes_and_edges() -> None:
    source, target, quaternion = _graph()
    node_order, edge_order = torch.randperm(12), torch.randperm(30)
    new_index = torch.argsort(node_order)
    permuted = DirectedEdges.of(new_index[source[edge_order]], new_index[target[edge_order]], 12)
    clean = load_network(NETWORKS["sfm-clean-net"])
    plain = clean(quaternion, DirectedEdges.of(source, target, 12)).outlier_logit
    shuffled = clean(quaternion[edge_order], permuted).outlier_logit
    torch.testing.assert_close(shuffled, plain[edge_order], atol=1e-4, rtol=1e-4)
    fine = load_network(NETWORKS["sfm-fine-net"])
    start, features, scale = (
        rotations.random(12).float(),
        torch.randn(30, ODD_FEATURES + EVEN_FEATURES),
        torch.ones(1, 1),
    )
    plain = fine(start, features, scale, DirectedEdges.of(source, target, 12))
    shuffled = fine(start[node_order], features[edge_order], scale, permuted)
    torch.testing.assert_close(shuffled, plain[node_order], atol=1e-4, rtol=1e-4)


def test_fine_net_knows_no_unit_of_angle() -> None:
    """Half the residuals in half the unit are the same features, and the correction is half as large."""
    source, target, quaternion = _graph()
    edges, start = DirectedEdges.of(source, target, 12), rotations.random(12).float()
    vectors, logit = quaternion.t()[:3], torch.zeros(30)
    angles = []
    for unit in (0.1, 0.05):
        scale = torch.full((1, 1), unit)
        fine = load_network(NETWORKS["sfm-fine-net"])(
            start, edge_features(vectors * unit, vectors * unit, logit, scale[0]).t(), scale, edges
        )
        angles.append(torch.tan(rotations.angle_between(fine, start) / 2))
    torch.testing.assert_close(angles[0], 2 * angles[1], atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("name", NETWORKS)
def test_shipped_weights_are_small_and_come_with_a_card(name: str) -> None:
    path = WEIGHTS_FOLDER / f"{name}.safetensors"
    assert path.stat().st_size < 500_000
    assert f'"network": "{name}"' in path.with_suffix(".json").read_text()
    assert not load_network(NETWORKS[name]).training


def _damage(kind: str, path: Path) -> None:
    tensors = load_file(path)
    if kind == "missing":
        path.unlink()
    elif kind == "truncated":
        path.write_bytes(path.read_bytes()[:-100])
    elif kind == "garbage":
        path.write_bytes(b"\x80\x04 not a safetensors file")
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "other version":
        save_file(tensors, path, metadata("sfm-clean-net") | {"architecture_version": "0"})
    elif kind == "other network":
        save_file(load_file(WEIGHTS_FOLDER / "sfm-fine-net.safetensors"), path, metadata("sfm-clean-net"))
    elif kind == "no metadata":
        save_file(tensors, path)
    else:
        tensors["outlier_head.bias"][0] = torch.nan
        save_file(tensors, path, metadata("sfm-clean-net"))


@pytest.mark.parametrize(
    "kind",
    ["missing", "truncated", "garbage", "empty", "other version", "other network", "no metadata", "not finite"],
)
def test_damaged_weights_are_refused_by_name(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "sfm-clean-net.safetensors"
    path.write_bytes((WEIGHTS_FOLDER / path.name).read_bytes())
    _damage(kind, path)
    with pytest.raises(UserError, match=r"sfm-clean-net\.safetensors: .*(reinstall)") as error:
        load_network(NETWORKS["sfm-clean-net"], folder=tmp_path)
    assert "\n" not in str(error.value)
