"""KITTI's pose files."""

from __future__ import annotations

from pathlib import Path

import pytest

from rotavg_ros.datasets.files import kitti
from rotavg_ros.datasets.files.graph_file import GraphFileError


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("1 0 0 0 0 1 0 0 0 0 1\n", "11 numbers where 12 belong"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 1 0 0 0 0 1 0\n", ":2: a matrix that is not a rotation"),
    ],
)
def test_bad_poses(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(GraphFileError, match=message):
        kitti.read_poses(path)
