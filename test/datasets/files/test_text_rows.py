"""Texts as Windows programs and archives leave them: byte order marks, gzip, UTF-16, and what is cut off."""

from __future__ import annotations

import gzip
import os
import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFileError
from rotavg_ros.datasets.files.ground_truth import attach_stamps, attach_truth
from rotavg_ros.datasets.files.pose_files import read_pose_file

packed = partial(gzip.compress, mtime=0)  # the same bytes, and names of tests, at any time
BOM = b"\xef\xbb\xbf"
G2O = b"".join(b"EDGE_SE2 %d %d 1 2 0.5 500 0 0 500 0 90\n" % (i, i + 1) for i in range(2000))
IDENTITY = b"1 0 0 0 1 0 0 0 1"
TEXTS = {
    "graph.g2o": G2O,
    "graph.toro": b"VERTEX2 0 0 0 0\nEDGE2 0 1 1 2 0.5 11 12 13 44 15 16\n",
    "graph.isam": b"ODOMETRY 0 1 1 2 0.5 5 1 2 6 3 7\n",
    "EGs.txt": b"0 1 " + IDENTITY + b" 0 0 1\n",
}
FORMS: dict[str, Callable[[bytes], bytes]] = {
    "mark": lambda text: BOM + text,
    "gzip": packed,
    "gzipped mark": lambda text: packed(BOM + text),
    "two parts": lambda text: packed(text[: len(text) // 2]) + packed(text[len(text) // 2 :]),
}


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", TEXTS)
def test_graphs_read_as_the_plain_text(tmp_path: Path, name: str, form: str) -> None:
    plain = read_graph(written(tmp_path / name, TEXTS[name]))
    # The content decides, so the name may be the old one.
    for other in (f"{name}.gz", f"other-{name}"):
        read = read_graph(written(tmp_path / other, FORMS[form](TEXTS[name])))
        np.testing.assert_array_equal(read.node_ids, plain.node_ids)
        for column in ("source", "target", "target_from_source", "kind", "precision"):
            np.testing.assert_array_equal(getattr(read.graph, column), getattr(plain.graph, column))


@pytest.mark.parametrize("form", FORMS)
def test_companions_and_trajectories(tmp_path: Path, form: str) -> None:
    graph = read_graph(written(tmp_path / "graph.g2o", G2O[: G2O.index(b"\n") + 1]))
    stamps = written(tmp_path / "stamps.txt", FORMS[form](b"10.5\n11.5\n"))
    truth = written(tmp_path / "truth.csv", FORMS[form](b"id,qx,qy,qz,qw\n0,0,0,0,1\n1,0,0,1,0\n"))
    with_all = attach_truth(attach_stamps(graph, stamps), truth)
    assert with_all.stamps_ns is not None and with_all.stamps_ns.tolist() == [10_500_000_000, 11_500_000_000]
    assert with_all.body_from_world_gt is not None and np.isfinite(with_all.body_from_world_gt).all()
    tum = written(tmp_path / "trajectory.tum", FORMS[form](b"1.5 0 0 0 0 0 0 1\n2.5 1 0 0 0 0 0 1\n"))
    assert read_pose_file(tum).position.tolist() == [[0, 0, 0], [1, 0, 0]]


def test_lines_are_counted_as_in_the_text(tmp_path: Path) -> None:
    path = written(tmp_path / "graph.g2o.gz", packed(BOM + G2O + b"EDGE_SE2 1 2 nan\n"))
    with pytest.raises(GraphFileError, match=r"graph\.g2o\.gz:2001: "):
        read_graph(path)


def test_a_pipe_may_be_gzipped(tmp_path: Path) -> None:
    """As `--stamps <(…)` is, which nobody can read twice."""
    graph = read_graph(written(tmp_path / "graph.g2o", G2O[: G2O.index(b"\n") + 1]))
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_bytes, args=(packed(BOM + b"1\n2\n"),))
    writer.start()
    assert attach_stamps(graph, pipe).stamps_ns is not None
    writer.join()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (G2O.decode().encode("utf-16"), "is UTF-16 text; save it as UTF-8"),
        (b"\xfe\xff" + G2O.decode().encode("utf-16-be"), "is UTF-16 text; save it as UTF-8"),
        (packed(G2O.decode().encode("utf-16")), "is UTF-16 text; save it as UTF-8"),
        (packed(G2O)[:-20], "is a damaged gzip file: "),
        (packed(G2O)[:5], "is a damaged gzip file: "),
        (packed(G2O)[:-8] + bytes(8), "is a damaged gzip file: "),
        (packed(G2O)[:60] + bytes(40) + packed(G2O)[100:], "is a damaged gzip file: "),
        (BOM, "the file is empty"),
        (packed(b""), "the file is empty"),
    ],
)
def test_what_cannot_be_read_is_named_in_one_line(tmp_path: Path, content: bytes, message: str) -> None:
    path = written(tmp_path / "graph.g2o", content)
    with pytest.raises(GraphFileError) as caught:
        read_graph(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_the_answer_to_a_gzipped_graph_has_its_name(tmp_path: Path) -> None:
    graphs = [written(tmp_path / f"{name}.g2o.gz", packed(TEXTS["graph.toro"])) for name in "ab"]
    assert main(["solve", *map(str, graphs), "--output", str(tmp_path / "out")]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a", "b"]


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (
            b"\x89MCAP0\r\n\x01",
            "is a bag; `rotavg replay` takes it, and `rotavg convert` makes a view-graph of a .mcap",
        ),
        (b"SQLite format 3\x00\x10", "of a .db3 file"),
        (b"#ROSBAG V2.0\nE\x00\x00", "of a .bag file"),
        (b"# stamp x y z qx qy qz qw\n1.5 0 0 0 0 0 0 1\n", r"8 numbers a row, as in a trajectory \(TUM\)"),
        (b"1 0 0 0 0 1 0 0 0 0 1 0\n", r"12 numbers a row, as in a trajectory \(KITTI\), which has no edges"),
    ],
)
def test_recordings_and_trajectories_are_no_graphs(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "run"
    path.write_bytes(content)
    with pytest.raises(GraphFileError, match=complaint):
        read_graph(path)


@pytest.mark.parametrize(
    ("tables", "complaint"),
    [
        (("Node", "Link"), "is RTAB-Map's database; export its graph as g2o"),
        (("cameras", "two_view_geometries"), "is COLMAP's database; write its relative rotations as an npz"),
        (("topics", "messages"), "makes a view-graph of a .db3 file"),
    ],
)
def test_databases_of_others_are_told_from_recordings(tmp_path: Path, tables: tuple[str, ...], complaint: str) -> None:
    path = tmp_path / "a % map?.db"
    with closing(sqlite3.connect(path)) as database:
        for table in tables:
            database.execute(f"CREATE TABLE {table} (id INTEGER)")
        database.commit()
    with pytest.raises(GraphFileError, match=complaint):
        read_graph(path)
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_only_texts_are_read_as_they_are_packed(tmp_path: Path, shared_data: Path) -> None:
    np.savez(tmp_path / "graph.npz", source=[0], target=[1], target_from_source=[[0.0, 0.0, 0.0, 1.0]])
    for path in (tmp_path / "graph.npz", shared_data / "sfm" / "lund_sphinx.mat"):
        gzipped = tmp_path / f"{path.name}.gz"
        gzipped.write_bytes(packed(path.read_bytes()))
        with pytest.raises(GraphFileError, match=rf"{path.name}.gz: is packed by gzip; unpack it by `gunzip --keep "):
            read_graph(gzipped)
