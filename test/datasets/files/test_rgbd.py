"""RGB-D scenes: ground truth and the registrations' residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros.datasets.files.graph_file import GraphFileError
from rotavg_ros.datasets.files.rgbd import read_scene
from rotavg_ros.metrics import true_edge_noise

IDENTITY = [0.0, 0.0, 0.0, 1.0]


def test_residuals_follow_the_edges(tmp_path: Path) -> None:
    path = tmp_path / "scene.npz"
    plain = {"source": [0, 1, 1], "target": [1, 1, 2], "target_from_source": [IDENTITY] * 3}
    np.savez(path, **plain, body_from_world_gt=[IDENTITY] * 3, registration_rms=[0.01, 0.5, 1e6])
    assert read_scene(path).registration_rms.tolist() == [0.01, np.inf]
    np.savez(path, **plain, body_from_world_gt=[IDENTITY] * 3)
    with pytest.raises(GraphFileError, match="lacks registration_rms"):
        read_scene(path)
    np.savez(path, **plain)
    with pytest.raises(GraphFileError, match="lacks body_from_world_gt"):
        read_scene(path)


@pytest.mark.parametrize(
    ("folder", "num_nodes"), [("scannet_fgr", 100), ("scannet_super4pcs", 100), ("redwood_fgr", 50)]
)
def test_real_scenes(shared_data: Path, folder: str, num_nodes: int) -> None:
    scene = read_scene(sorted((shared_data / "rgbd" / folder).glob("*.npz"))[0])
    graph = scene.graph_file.graph
    assert (graph.num_nodes, graph.num_edges) == (num_nodes, num_nodes * (num_nodes - 1) // 2)
    assert scene.registration_rms.shape == (graph.num_edges,)
    truth = torch.from_numpy(scene.graph_file.body_from_world_gt)
    error = true_edge_noise(graph, truth)
    good_share = float((torch.rad2deg(error) < 15).double().mean())
    assert 0.1 < good_share < 0.9  # a wrong direction would leave about 1 %
