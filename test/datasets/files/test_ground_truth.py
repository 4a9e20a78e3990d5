"""Companion files: stamps, ground truth by id and by stamp."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError
from rotavg_ros.datasets.files.ground_truth import attach_stamps, attach_truth


@pytest.fixture
def graph_file() -> GraphFile:
    return GraphFile.from_ids(np.array([1, 2]), np.array([2, 5]), np.tile([0.0, 0, 0, 1], (2, 1)))


def written(folder: Path, text: str) -> Path:
    path = folder / "companion.txt"
    path.write_text(text)
    return path


def test_stamps_are_exact(tmp_path: Path, graph_file: GraphFile) -> None:
    path = written(tmp_path, "1235603336.0099111\n1235603336.208386912\n1.2356033364e9\n")
    stamps = attach_stamps(graph_file, path).stamps_ns
    assert stamps is not None
    assert stamps.tolist() == [1235603336009911100, 1235603336208386912, 1235603336400000000]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1\n2\n", "2 stamps for 3 nodes"),
        ("3\n2\n1\n", "every stamp is earlier than the one before"),
        ("1\nx\n3\n", ":2: 'x' is not a number"),
        ("1e30\n2\n3\n", ":1: .*too large"),
        ("1\n-1e300\n3\n", ":2: stamp '-1e300' is too large; stamps are in seconds"),
    ],
)
def test_bad_stamps(tmp_path: Path, graph_file: GraphFile, text: str, message: str) -> None:
    with pytest.raises(GraphFileError, match=message):
        attach_stamps(graph_file, written(tmp_path, text))


def test_truth_by_id(tmp_path: Path, graph_file: GraphFile) -> None:
    path = written(tmp_path, "id,qx,qy,qz,qw,component\n5,0.6,0,0,0.8,0\n7,0,0,0,1,0\n1,0,0,0,-1,0\n")
    truth = attach_truth(graph_file, path).body_from_world_gt
    np.testing.assert_allclose(truth, [[0, 0, 0, 1], [np.nan] * 4, [-0.6, 0, 0, 0.8]], atol=1e-12)


def test_truth_by_stamp_within_150_ms(tmp_path: Path, graph_file: GraphFile) -> None:
    stamped = attach_stamps(graph_file, written(tmp_path, "10.0\n11.0\n12.0\n"))
    path = written(tmp_path, "9.851, 1, 2, 0.5\n10.848, 3, 4, 0.6\n12.149, 5, 6, 0.7\n")
    with_truth = attach_truth(stamped, path)
    world_from_body = rotations.inverse(torch.from_numpy(with_truth.body_from_world_gt))
    np.testing.assert_allclose(rotations.log(world_from_body)[[0, 2], 2].numpy(), [0.5, 0.7], atol=1e-12)
    np.testing.assert_allclose(with_truth.position_gt, [[1, 2, 0], [np.nan] * 3, [5, 6, 0]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("id,qw,qx,qy,qz\n1,1,0,0,0\n", "the header is 'id,qw,qx,qy,qz'; expected 'id,qx,qy,qz,qw'"),
        ("", "empty"),
        ("id,qx,qy,qz,qw\n1,0,0,0\n", ":2: 4 numbers where 5 belong"),
        ("id,qx,qy,qz,qw\n1,0,0,0,0\n", ":2: a quaternion of length 0"),
        ("id,qx,qy,qz,qw\n99,0,0,0,1\n", "no row belongs to a node"),
        ("id,qx,qy,qz,qw\n", "no row belongs to a node"),
        ("10.0, 1, 2, 0.5\n", "no stamps; give them too"),
        ("10.0, 1, 2, 0.5\n9.0, 1, 2, 0.5\n", ":2: a stamp earlier"),
        ("timestamp,x\n", ":1: the header is 'timestamp,x'"),
    ],
)
def test_bad_truth(tmp_path: Path, graph_file: GraphFile, text: str, message: str) -> None:
    with pytest.raises(GraphFileError, match=message):
        attach_truth(graph_file, written(tmp_path, text))


def test_b25b(shared_data: Path) -> None:
    folder = shared_data / "slam" / "b25b"
    graph_file = attach_stamps(read_graph(folder / "B25b_0.000.g2o"), folder / "B25b_timestamps.txt")
    truth = attach_truth(graph_file, folder / "ground_truth.csv").body_from_world_gt
    assert truth is not None
    assert np.isfinite(truth[:, 0]).sum() == 7352


@pytest.mark.parametrize(("name", "median_deg"), [("sphere2500", 2.5), ("manhattan", 1.5)])
def test_truth_fits_the_edges(shared_data: Path, name: str, median_deg: float) -> None:
    """Truth and edges have the same direction: their difference is the simulated noise."""
    graph_file = read_graph(shared_data / "slam" / f"{name}.g2o")
    truth = attach_truth(graph_file, shared_data / "slam" / f"{name}_ground_truth.csv").body_from_world_gt
    body_from_world = torch.from_numpy(truth)
    graph = graph_file.graph
    expected = rotations.multiply(body_from_world[graph.target], rotations.inverse(body_from_world[graph.source]))
    assert rotations.angle_between(expected, graph.target_from_source).rad2deg().median() < median_deg
