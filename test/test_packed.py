"""Inputs that are packed are refused with the command that unpacks them."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import shlex
import subprocess
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard

from rotavg_ros.bags.reader import BagReader, BagReadError
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFileError

GRAPH = b"EDGE_SE2 0 1 1 0 0.1 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0.1 1 0 0 1 0 1\nEDGE_SE2 0 2 2 0 0.2 1 0 0 1 0 1\n"


def tar(content: bytes, mode: str) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode=mode) as archive:  # type: ignore[call-overload]
        member = tarfile.TarInfo("the graph")
        member.size = len(content)
        archive.addfile(member, io.BytesIO(content))
    return buffer.getvalue()


def zipped(content: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("the graph", content)
    return buffer.getvalue()


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    ".bz2": bz2.compress,
    ".xz": lzma.compress,
    ".zst": zstandard.ZstdCompressor().compress,
    ".tar": lambda content: tar(content, "w"),
    ".tar.gz": lambda content: tar(content, "w:gz"),
    ".tar.bz2": lambda content: tar(content, "w:bz2"),
}


@pytest.mark.parametrize("suffix", PACKERS)
def test_the_command_that_a_packed_graph_needs_is_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"the graph{suffix}"
    path.write_bytes(PACKERS[suffix](GRAPH))
    with pytest.raises(GraphFileError) as caught:
        read_graph(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: is ") and "unpack it by `" in message and "\n" not in message
    command = shlex.split(message.partition("`")[2].rstrip("`"))
    try:
        subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    except FileNotFoundError:
        pytest.skip(f"there is no {command[0]}")
    assert read_graph(tmp_path / "the graph").graph.num_edges == 3 and path.exists()


@pytest.mark.parametrize("suffix", [*PACKERS, ".gz", ".zip"])
def test_the_command_that_a_packed_bag_needs_is_named(tmp_path: Path, suffix: str) -> None:
    pack = {".gz": gzip.compress, ".zip": zipped}.get(suffix) or PACKERS[suffix]
    path = tmp_path / f"run.mcap{suffix}"
    path.write_bytes(pack(b"\x89MCAP0\r\n"))
    with pytest.raises(BagReadError, match=r"run\.mcap[.\w]*: is .*; unpack it by `\w+") as caught, BagReader(path):
        pass
    assert "\n" not in str(caught.value)


def test_what_is_read_packed_stays_so(tmp_path: Path) -> None:
    (tmp_path / "graph.g2o.gz").write_bytes(gzip.compress(GRAPH))
    assert read_graph(tmp_path / "graph.g2o.gz").graph.num_edges == 3
    np.savez(tmp_path / "graph.npz", source=[0, 1], target=[1, 2], target_from_source=[[0, 0, 0, 1.0]] * 2)
    assert read_graph(tmp_path / "graph.npz").graph.num_edges == 2
    (tmp_path / "run.mcap.gz").write_bytes(gzip.compress(b"\x89MCAP0\r\n"))
    with pytest.raises(GraphFileError, match="is packed by gzip; unpack it by `gunzip --keep"):
        read_graph(tmp_path / "run.mcap.gz")
