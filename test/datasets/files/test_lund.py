"""Lund's MATLAB view-graphs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.formats import read_graph, write_graph
from rotavg_ros.datasets.files.graph_file import GraphFileError
from rotavg_ros.metrics import true_edge_noise

from .refusals import assert_refused

TRUTH = Rotation.random(4, random_state=0)
EDGES = ((0, 1), (1, 2), (0, 2))


def arrays(**changes: Any) -> dict[str, Any]:
    relative, hessian = np.zeros((12, 12)), np.zeros((12, 12))
    for source, target in EDGES:
        block = np.s_[3 * source : 3 * source + 3, 3 * target : 3 * target + 3]
        relative[block] = (TRUTH[target] * TRUTH[source].inv()).as_matrix()
        hessian[block] = np.diag([1.0, 2.0, 3.0])
    plain = {"Rgt": TRUTH.as_matrix().reshape(12, 3), "Rrel": relative, "H": hessian}
    return {name: values for name, values in {**plain, **changes}.items() if values is not None}


def saved(folder: Path, **changes: Any) -> Path:
    path = folder / "scene.mat"
    savemat(path, arrays(**changes))
    return path


def test_edges_agree_with_the_truth(tmp_path: Path) -> None:
    graph_file = read_graph(saved(tmp_path))
    graph = graph_file.graph
    assert graph_file.node_ids.tolist() == [0, 1, 2, 3]  # camera 3 has no edge
    assert sorted(zip(graph.source.tolist(), graph.target.tolist(), strict=True)) == sorted(EDGES)
    truth = torch.from_numpy(graph_file.body_from_world_gt)
    assert float(true_edge_noise(graph, truth).max()) < 1e-7
    assert graph_file.edge_information is not None
    np.testing.assert_array_equal(graph_file.edge_information[:, 15:], [[1, 0, 0, 2, 0, 3]] * 3)
    assert graph.information is not None
    np.testing.assert_array_equal(graph.information.numpy(), [np.diag([1.0, 2.0, 3.0])] * 3)
    np.testing.assert_allclose(graph.precision.numpy(), 3 / (1 + 1 / 2 + 1 / 3))


def test_a_hessian_that_is_not_finite_is_unknown(tmp_path: Path) -> None:
    hessian = arrays()["H"]
    hessian[0, 3] = np.nan
    graph_file = read_graph(saved(tmp_path, H=hessian))
    write_graph(tmp_path / "scene.npz", graph_file)
    back = read_graph(tmp_path / "scene.npz")
    np.testing.assert_array_equal(back.edge_information, graph_file.edge_information)
    assert (back.edge_information == 0).all(axis=1).sum() == 1
    write_graph(tmp_path / "scene.g2o", graph_file)
    assert read_graph(tmp_path / "scene.g2o").graph.num_edges == len(EDGES)


def test_hessians_are_optional(tmp_path: Path) -> None:
    assert read_graph(saved(tmp_path, H=None)).edge_information is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Rgt": None}, "lacks Rgt"),
        ({"Rgt": np.eye(4)}, "Rgt has shape (4, 4)"),
        ({"Rrel": np.eye(9)}, "Rrel has shape (9, 9); it must be (12, 12)"),
        ({"Rrel": np.zeros((12, 12))}, "no edges"),
        ({"Rrel": 2 * arrays()["Rrel"]}, "Rrel has a block that is not a rotation"),
        ({"Rgt": np.full((12, 3), np.nan)}, "Rgt has a block that is not a rotation"),
        ({"Rgt": {"a": 1}}, "must be plain arrays of numbers"),
    ],
)
def test_bad_arrays_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    assert_refused(saved(tmp_path, **changes), message)


def test_truncated(tmp_path: Path) -> None:
    path = saved(tmp_path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(GraphFileError, match="not a readable MATLAB file"):
        read_graph(path)


def test_sphinx(shared_data: Path) -> None:
    graph_file = read_graph(shared_data / "sfm" / "lund_sphinx.mat")
    graph = graph_file.graph
    assert (graph.num_nodes, graph.num_edges) == (70, 1207)
    truth = torch.from_numpy(graph_file.body_from_world_gt)
    error = torch.rad2deg(true_edge_noise(graph, truth))
    assert float(error.mean()) == pytest.approx(0.57, abs=0.01)
    assert float(error.median()) == pytest.approx(0.30, abs=0.01)
