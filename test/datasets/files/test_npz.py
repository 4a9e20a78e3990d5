"""npz view-graphs: what is accepted, and that damage is told, never raised raw."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFileError

from .refusals import assert_refused

IDENTITY = [0.0, 0.0, 0.0, 1.0]


def arrays(**changes: Any) -> dict[str, np.ndarray]:
    plain = {"source": np.array([10, 20]), "target": np.array([20, 40]), "target_from_source": np.array([IDENTITY] * 2)}
    return {name: np.asarray(values) for name, values in {**plain, **changes}.items() if values is not None}


def saved(folder: Path, **changes: Any) -> Path:
    path = folder / "graph.npz"
    np.savez(path, **arrays(**changes))
    return path


def test_minimal(tmp_path: Path) -> None:
    graph_file = read_graph(saved(tmp_path))
    assert graph_file.node_ids.tolist() == [10, 20, 40]
    assert not graph_file.graph.is_odometry.any()
    assert bool(graph_file.graph.precision.isnan().all())
    assert graph_file.graph.label.tolist() == [0, 0]
    assert graph_file.graph.steps.tolist() == [1, 1]
    assert graph_file.body_from_world_gt is None


def test_optional_arrays(tmp_path: Path) -> None:
    truth = np.array([[0, 0, 0.6, 0.8], [np.nan] * 4, IDENTITY])
    path = saved(tmp_path, kind=np.array([0, 1], dtype=np.uint8), precision=[4.0, np.nan], body_from_world_gt=truth)
    graph_file = read_graph(path)
    assert graph_file.graph.is_odometry.tolist() == [True, False]
    assert graph_file.graph.precision[0] == 4
    np.testing.assert_allclose(graph_file.body_from_world_gt, truth)


def test_truth_of_every_id_up_to_the_last(tmp_path: Path) -> None:
    truth = np.tile(IDENTITY, (41, 1))
    truth[20] = [0.6, 0, 0, 0.8]
    graph_file = read_graph(saved(tmp_path, body_from_world_gt=truth))
    np.testing.assert_allclose(graph_file.body_from_world_gt, truth[[10, 20, 40]])


def test_rows_follow_node_ids(tmp_path: Path) -> None:
    graph_file = read_graph(saved(tmp_path, node_ids=[40, 10, 5, 20], stamps_ns=[4, 1, 0, 2]))
    assert graph_file.node_ids.tolist() == [5, 10, 20, 40]
    assert graph_file.stamps_ns is not None
    assert graph_file.stamps_ns.tolist() == [0, 1, 2, 4]


def test_self_edges_are_skipped(tmp_path: Path) -> None:
    graph_file = read_graph(saved(tmp_path, target=[20, 20], label=[2, 1], steps=[3, 4]))
    assert graph_file.graph.num_edges == 1
    assert (graph_file.graph.label.tolist(), graph_file.graph.steps.tolist()) == ([2], [3])
    assert graph_file.skipped == {"self-edge": 1}


def test_rgbd_scene(shared_data: Path) -> None:
    graph_file = read_graph(sorted((shared_data / "rgbd" / "redwood_fgr").glob("*.npz"))[0])
    assert (graph_file.graph.num_nodes, graph_file.graph.num_edges) == (50, 1225)
    assert graph_file.body_from_world_gt is not None
    assert graph_file.body_from_world_gt.shape == (50, 4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target_from_source": None}, "lacks target_from_source"),
        ({"source": [1.5, 2.0]}, "source holds float64; it must hold integers"),
        ({"source": np.array([1, 2**63], dtype=np.uint64)}, "too large"),
        ({"source": [-1, 2]}, "edge 0 (from 0) has a negative id"),
        ({"source": [1]}, "target has 2 rows, source has 1"),
        ({"target_from_source": np.ones((2, 3))}, "has shape (2, 3); it must be (rows, 4)"),
        ({"target_from_source": [IDENTITY, [0, 0, 0, 0.0]]}, "edge 1 (from 0) has a quaternion of length 0"),
        ({"target_from_source": [[np.nan] * 4, IDENTITY]}, "edge 0 (from 0) has a quaternion of length nan"),
        ({"target": [10, 20]}, "no edges between nodes"),
        ({"source": np.empty(0, int), "target": np.empty(0, int), "target_from_source": np.empty((0, 4))}, "no edges"),
        ({"kind": [0, 7]}, "unknown kind"),
        ({"label": [0, 3]}, "edge 1 (from 0) has an unknown label; 0 is automatic, 1 accepted, 2 rejected"),
        ({"label": [0.0, 1.0]}, "label holds float64; it must hold integers"),
        ({"label": [0]}, "label has 1 rows, source has 2"),
        ({"steps": [1, 1e40]}, "edge 1 (from 0) has steps that are not between 1e-09 and 1e+09"),
        ({"steps": [np.nan, 1]}, "edge 0 (from 0) has steps that are not between"),
        ({"kind": np.array(["a", "b"])}, "kind holds <U1"),
        ({"precision": np.array([1, None], dtype=object)}, "not a readable npz archive"),
        ({"body_from_world_gt": [IDENTITY]}, "1 rows for 3 nodes"),
        ({"body_from_world_gt": [[2.0, 0, 0, 0]] * 3}, "not of unit length"),
        ({"edge_translation": [[0, 0, 0], [0, -1e10, 0]]}, "edge 1 (from 0) has a translation of more than 1e+09 m"),
        (
            {"edge_information": [np.ones(21), np.full(21, np.nan)]},
            "edge 1 (from 0) has an edge_information that is not",
        ),
        ({"node_ids": [10, 20, 40, -3]}, "node_ids holds -3; ids must be integers from 0"),
        ({"node_ids": [10, 20, 20, 40], "stamps_ns": [1, 2, 3, 4]}, "node_ids holds 20 more than once"),
        ({"planar": [True, False]}, "planar holds bool of shape (2,); it must be one value, true or false"),
        ({"planar": "no"}, "planar holds <U2 of shape (); it must be one value"),
        ({"planar": True, "target_from_source": [[0.6, 0, 0, 0.8]] * 2}, "declared planar"),
    ],
)
def test_bad_arrays_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    assert_refused(saved(tmp_path, **changes), message)


def test_not_an_archive(tmp_path: Path) -> None:
    path = tmp_path / "graph.npz"
    path.write_bytes(b"not a zip file")
    with pytest.raises(GraphFileError, match="not an npz archive"):
        read_graph(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("source.npy", b"nonsense")
    with pytest.raises(GraphFileError, match=r"not a readable npz archive|lacks"):
        read_graph(path)


@given(st.data())
def test_damaged_archives_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays(kind=[0, 1], body_from_world_gt=[IDENTITY] * 3))
    content = bytearray(buffer.getvalue())
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    path = tmp_path_factory.getbasetemp() / "damaged.npz"
    path.write_bytes(content)
    try:
        read_graph(path)
    except GraphFileError as refusal:
        message = str(refusal)
    else:
        return
    assert message.startswith(str(path))
    assert "\n" not in message
