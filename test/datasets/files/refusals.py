"""How files are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFileError


def assert_refused(path: Path, message: str, line: int | None = None) -> None:
    """Reading fails with words that begin with the file, and its line where one is to blame, and say what is wrong."""
    with pytest.raises(GraphFileError) as caught:
        read_graph(path)
    where = path if line is None else f"{path}:{line}"
    assert str(caught.value).startswith(f"{where}: ")
    assert message in str(caught.value)
