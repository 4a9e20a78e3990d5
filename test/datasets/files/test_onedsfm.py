"""1DSfM lines; their direction is checked with the round trips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFileError

from .refusals import assert_refused


def test_stored_rotation_is_the_transpose_of_target_from_source(tmp_path: Path) -> None:
    body_from_world = Rotation.random(2, random_state=0)
    target_from_source = body_from_world[1] * body_from_world[0].inv()
    stored = " ".join(f"{value:.17g}" for value in target_from_source.as_matrix().T.ravel())
    path = tmp_path / "EGs.txt"
    path.write_text(f"17 4 {stored} 0.1 0.2 0.3\n17 17 {stored} 0 0 1\n")
    graph_file = read_graph(path)
    assert graph_file.node_ids.tolist() == [4, 17]
    assert graph_file.graph.source.tolist() == [1]
    assert graph_file.graph.target.tolist() == [0]
    measured = Rotation.from_quat(graph_file.graph.target_from_source[0].numpy())
    assert (measured.inv() * target_from_source).magnitude() < 1e-12
    np.testing.assert_allclose(graph_file.edge_translation, [[0.1, 0.2, 0.3]])
    assert graph_file.skipped == {"self-edge": 1}


def test_a_long_comment_does_not_hide_the_format(tmp_path: Path) -> None:
    path = tmp_path / "EGs.txt"
    path.write_text("# where it is from\n" * 10_000 + "0 1 1 0 0 0 1 0 0 0 1 0 0 0\n")
    assert read_graph(path).node_ids.tolist() == [0, 1]


def test_consecutive_cameras_are_not_odometry(tmp_path: Path) -> None:
    path = tmp_path / "EGs.txt"
    path.write_text("0 1 1 0 0 0 1 0 0 0 1 0 0 0\n")
    assert read_graph(path).graph.is_odometry.tolist() == [False]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 2 1 0 0 0 1 0 0 0 1 0 0", "13 numbers where 14 belong"),
        ("1 2 1 0 0 0 1 0 0 0 -1 0 0 0", "not a rotation matrix"),
        ("1 2 2 0 0 0 2 0 0 0 2 0 0 0", "not a rotation matrix"),
        ("1 2 1e200 0 0 0 1e200 0 0 0 1e200 0 0 0", "not a rotation matrix"),
        ("1 2 0 0 0 0 0 0 0 0 0 0 0 0", "not a rotation matrix"),
        ("1 2 nan 0 0 0 1 0 0 0 1 0 0 0", "not finite"),
        ("1.5 2 1 0 0 0 1 0 0 0 1 0 0 0", "not an integer id"),
        ("1_0 2 1 0 0 0 1 0 0 0 1 0 0 0", "'1_0' is not an integer id"),
        ("1 2 1 0 0 0 1 0 0 0 1 0 0 1_0", "'1_0' is not a number"),
        ("9" * 5000 + " 2 1 0 0 0 1 0 0 0 1 0 0 0", "too large"),
        ("x", "1 number where 14 belong"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "EGs.txt"
    path.write_text(f"0 1 1 0 0 0 1 0 0 0 1 0 0 0\n{line}\n")
    assert_refused(path, message, line=2)


def test_no_edges(tmp_path: Path) -> None:
    path = tmp_path / "EGs.txt"
    path.write_text("1 1 1 0 0 0 1 0 0 0 1 0 0 0\n")
    with pytest.raises(GraphFileError, match="no edges"):
        read_graph(path)
