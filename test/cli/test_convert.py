"""`rotavg convert` between files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import read_graph

EDGES = (
    "".join(f"EDGE_SE2 {i} {i + 1} 1 0 0.1 1 0 0 1 0 100\n" for i in range(3)) + "EDGE_SE2 3 0 1 0 0.2 1 0 0 1 0 5\n"
)


@pytest.fixture
def graph_path(tmp_path: Path) -> Path:
    path = tmp_path / "graph.g2o"
    path.write_text("FIX 0\n" + EDGES)
    return path


def test_there_and_back(graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    npz, back = tmp_path / "graph.npz", tmp_path / "back.g2o"
    assert main(["convert", str(graph_path), str(npz)]) == 0
    assert "4 nodes, 4 edges; skipped 1 × FIX\n" in capsys.readouterr().out
    assert main(["convert", str(npz), str(back)]) == 0
    first, last = read_graph(graph_path), read_graph(back)
    np.testing.assert_allclose(last.graph.target_from_source, first.graph.target_from_source, atol=1e-12)
    assert last.graph.kind.tolist() == first.graph.kind.tolist()
    assert last.graph.precision.tolist() == first.graph.precision.tolist()


def test_stamps_and_truth(graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stamps, truth = tmp_path / "stamps.txt", tmp_path / "truth.csv"
    stamps.write_text("1.0\n2.0\n3.0\n4.0\n")
    truth.write_text("1.01, 0, 0, 0.5\n2.1, 1, 2, 0.6\n3.5, 0, 0, 0\n")
    npz = tmp_path / "graph.npz"
    assert main(["convert", str(graph_path), str(npz), "--stamps", str(stamps), "--truth", str(truth)]) == 0
    graph_file = read_graph(npz)
    assert graph_file.stamps_ns is not None
    assert graph_file.stamps_ns.tolist() == [10**9, 2 * 10**9, 3 * 10**9, 4 * 10**9]
    assert graph_file.body_from_world_gt is not None
    assert np.isfinite(graph_file.body_from_world_gt[:, 0]).tolist() == [True, True, False, False]
    capsys.readouterr()
    assert main(["convert", str(npz), str(tmp_path / "EGs.txt")]) == 0
    out = capsys.readouterr().out
    assert "no room for: which edges are odometry, precisions, stamps, ground-truth orientations" in out


def test_a_pipe_is_no_graph(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert main(["convert", str(tmp_path / "pipe"), str(tmp_path / "x.g2o")]) == 2
    assert "pipe: is not a regular file (a pipe or a device); save the graph to one first" in capsys.readouterr().err


@pytest.mark.parametrize("is_linked", [False, True])
def test_no_file_takes_the_place_of_a_pipe(
    graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], is_linked: bool
) -> None:
    pipe, output = tmp_path / "pipe.g2o", tmp_path / ("link.g2o" if is_linked else "pipe.g2o")
    os.mkfifo(pipe)
    if is_linked:
        output.symlink_to(pipe)
    assert main(["convert", str(graph_path), str(output), "--overwrite"]) == 2
    said = f"rotavg: error: {output}: cannot be written: not a regular file (a pipe or a device); choose another\n"
    assert capsys.readouterr().err == said
    assert pipe.is_fifo()


def test_refusals(graph_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "truth.csv").write_text("1.01, 0, 0, 0.5\n")
    (tmp_path / "folder.npz").mkdir()
    before = graph_path.read_text()
    for words, message in (
        (["missing.g2o", "x.npz"], "missing.g2o: no such file"),
        ([str(graph_path), str(tmp_path / "x.foo")], "unknown suffix '.foo'"),
        ([str(graph_path), str(tmp_path / "none" / "x.npz")], f"there is no folder {tmp_path / 'none'}; make it"),
        ([str(graph_path), str(graph_path / "x.npz")], "cannot be written: Not a directory"),
        ([str(graph_path), str(tmp_path / "folder.npz" / ".." / "graph.g2o"), "--overwrite"], "is the INPUT itself"),
        ([str(graph_path), str(tmp_path / "folder.npz"), "--overwrite"], "folder.npz: is a folder"),
        ([str(graph_path), str(tmp_path / "x.mcap")], "choose an OUTPUT without .mcap"),
        ([str(graph_path), str(tmp_path / "x.npz"), "--truth", str(tmp_path / "truth.csv")], "no stamps"),
    ):
        assert main(["convert", *words]) == 2
        error = capsys.readouterr().err
        assert error.startswith("rotavg: error: ")
        assert message in error
        assert len(error.splitlines()) == 1
    assert not (tmp_path / "x.npz").exists()
    assert graph_path.read_text() == before
