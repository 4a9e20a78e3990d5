"""What is written is read back, in every format."""

from __future__ import annotations

import resource
import tempfile
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.datasets.files import g2o
from rotavg_ros.datasets.files.formats import not_stored, read_graph, write_graph
from rotavg_ros.datasets.files.graph_file import MAX_NODE_ID, GraphFile, GraphFileError
from rotavg_ros.datasets.planar import quaternion_of_heading
from rotavg_ros.view_graph import ViewGraph


@st.composite
def graph_files(draw: st.DrawFn, *, planar: bool | None = None, kinds_by_id: bool = False) -> GraphFile:
    """Graphs with scattered ids, duplicate edges in both directions and nodes without an edge.

    Args:
        kinds_by_id: edges are odometry exactly if their ids are consecutive, as formats without kinds have it.
    """
    id_of_node = st.one_of(st.integers(0, 6), st.integers(0, MAX_NODE_ID))
    ids = np.array(draw(st.lists(id_of_node, min_size=2, max_size=8, unique=True)), dtype=np.int64)
    ends = st.tuples(*[st.integers(0, len(ids) - 1)] * 2).filter(lambda pair: pair[0] != pair[1])
    edges = np.array(draw(st.lists(ends, min_size=1, max_size=12)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    planar = draw(st.booleans()) if planar is None else planar
    if planar:
        quaternions = quaternion_of_heading(rng.uniform(-np.pi, np.pi, len(edges)))
    else:
        quaternions = rng.normal(size=(len(edges), 4))
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    translation = rng.normal(scale=10, size=(len(edges), 3)) * ([1, 1, 0] if planar else 1)
    source, target = ids[edges[:, 0]], ids[edges[:, 1]]
    consecutive = np.abs(source - target) == 1
    return GraphFile.from_ids(
        source,
        target,
        quaternions,
        lone_ids=ids,
        kind=np.where(consecutive, 0, 1) if kinds_by_id else rng.integers(0, 2, len(edges)),
        precision=10 ** rng.uniform(-3, 6, len(edges)),
        planar=planar,
        edge_translation=translation,
    )


def through(suffix: str, graph_file: GraphFile) -> GraphFile:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"graph{suffix}"
        write_graph(path, graph_file)
        assert [entry.name for entry in Path(folder).iterdir()] == [path.name]
        return read_graph(path)


def assert_same_edges(actual: GraphFile, expected: GraphFile) -> None:
    a, e = actual.graph, expected.graph
    np.testing.assert_array_equal(actual.node_ids[a.source], expected.node_ids[e.source])
    np.testing.assert_array_equal(actual.node_ids[a.target], expected.node_ids[e.target])
    assert rotations.angle_between(a.target_from_source, e.target_from_source).max() < 1e-9
    np.testing.assert_allclose(actual.edge_translation, expected.edge_translation, rtol=1e-12, atol=1e-9)


@given(graph_files(kinds_by_id=True))
def test_g2o(graph_file: GraphFile) -> None:
    read = through(".g2o", graph_file)
    assert_same_edges(read, graph_file)
    np.testing.assert_array_equal(read.node_ids, graph_file.node_ids)
    assert read.planar == graph_file.planar
    assert torch.equal(read.graph.kind, graph_file.graph.kind)
    torch.testing.assert_close(read.graph.precision, graph_file.graph.precision, rtol=1e-12, atol=0)
    assert read.skipped == {}


@pytest.mark.parametrize("planar", [False, True])
@given(data=st.data())
def test_toro(planar: bool, data: st.DataObject) -> None:
    graph_file = data.draw(graph_files(planar=planar, kinds_by_id=True))
    read = through(".toro", graph_file)
    assert_same_edges(read, graph_file)
    np.testing.assert_array_equal(read.node_ids, graph_file.node_ids)
    assert read.planar == planar
    torch.testing.assert_close(read.graph.precision, graph_file.graph.precision, rtol=1e-12, atol=0)


@given(graph_files(planar=True, kinds_by_id=True))
def test_isam(graph_file: GraphFile) -> None:
    read = through(".isam", graph_file)
    assert_same_edges(read, graph_file)
    torch.testing.assert_close(read.graph.precision, graph_file.graph.precision, rtol=1e-9, atol=0)
    lost = not_stored("x.isam", graph_file)
    assert ("nodes without an edge" in lost) == (len(read.node_ids) < len(graph_file.node_ids))


def test_isam_is_planar(tmp_path: Path) -> None:
    spatial = GraphFile.from_ids(np.array([0]), np.array([1]), rotations.random(1).numpy())
    with pytest.raises(GraphFileError, match=r"write .toro or .g2o"):
        write_graph(tmp_path / "x.isam", spatial)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".toro", ".isam"])
@given(data=st.data())
def test_gtsam_reads_our_dialects_of_the_plane(suffix: str, data: st.DataObject) -> None:
    graph_file = data.draw(graph_files(planar=True))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"graph{suffix}"
        write_graph(path, graph_file)
        factors, _ = gtsam.load2D(str(path))
    relative = [factors.at(index).measured() for index in range(factors.size())]
    headings = [measured.theta() for measured in relative]
    turned = rotations.angle_between(
        torch.from_numpy(quaternion_of_heading(-np.array(headings))), graph_file.graph.target_from_source
    )
    assert turned.max() < 1e-9
    steps = [measured.translation() for measured in relative]
    np.testing.assert_allclose(steps, graph_file.edge_translation[:, :2], rtol=1e-9, atol=1e-9)


@given(graph_files())
def test_onedsfm(graph_file: GraphFile) -> None:
    read = through(".txt", graph_file)
    assert_same_edges(read, graph_file)
    assert not read.graph.is_odometry.any()


@given(graph_files(), st.integers(0, 2**32))
def test_npz_keeps_everything(graph_file: GraphFile, seed: int) -> None:
    rng = np.random.default_rng(seed)
    num_nodes = len(graph_file.node_ids)
    truth = rotations.random(num_nodes).numpy()
    truth[rng.random(num_nodes) < 0.3] = np.nan
    num_edges = graph_file.graph.num_edges
    label, steps = torch.from_numpy(rng.integers(0, 3, num_edges)), torch.from_numpy(rng.uniform(0.5, 9, num_edges))
    full = replace(
        graph_file,
        graph=replace(graph_file.graph, label=label, steps=steps),
        body_from_world_gt=truth,
        stamps_ns=rng.integers(0, 2**62, num_nodes),
        position_gt=rng.normal(size=(num_nodes, 3)),
        edge_information=rng.normal(size=(num_edges, 21)),
    )
    read = through(".npz", full)
    assert_same_edges(read, full)
    assert read.planar == full.planar
    assert torch.equal(read.graph.kind, full.graph.kind)
    for name in ("precision", "label", "steps"):
        assert torch.equal(getattr(read.graph, name), getattr(full.graph, name))
    for name in ("node_ids", "stamps_ns", "position_gt", "edge_translation", "edge_information"):
        np.testing.assert_array_equal(getattr(read, name), getattr(full, name))
    np.testing.assert_allclose(read.body_from_world_gt, full.body_from_world_gt, atol=1e-12)
    assert not_stored("x.npz", full) == []


@pytest.mark.parametrize("planar", [False, True])
@given(data=st.data())
def test_gtsam_reads_our_g2o(planar: bool, data: st.DataObject) -> None:
    graph_file = data.draw(graph_files(planar=planar))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "graph.g2o"
        write_graph(path, graph_file)
        factors, values = gtsam.readG2o(str(path), not planar)
    assert values.size() == graph_file.graph.num_nodes
    assert_gtsam_agrees(factors, graph_file, planar)


def assert_gtsam_agrees(factors: gtsam.NonlinearFactorGraph, graph_file: GraphFile, planar: bool) -> None:
    """gtsam's relative rotations, of the target in the source frame, are the inverses of ours."""
    graph, ids = graph_file.graph, graph_file.node_ids
    assert factors.size() == graph.num_edges
    ours = rotations.to_matrix(graph.target_from_source).numpy()
    for edge in range(graph.num_edges):
        factor = factors.at(edge)
        assert list(factor.keys()) == [ids[graph.source[edge]], ids[graph.target[edge]]]
        source_from_target = np.eye(3)
        size = 2 if planar else 3
        source_from_target[:size, :size] = factor.measured().rotation().matrix()
        np.testing.assert_allclose(ours[edge], source_from_target.T, atol=1e-9)
        translation = graph_file.edge_translation[edge]
        np.testing.assert_allclose(factor.measured().translation(), translation[:size], atol=1e-9)


@pytest.mark.parametrize(
    "name", ["sphere2500", *(pytest.param(name, marks=pytest.mark.large) for name in ("manhattan", "b25b/B25b_0.000"))]
)
def test_directions_against_gtsam(shared_data: Path, tmp_path: Path, name: str) -> None:
    path = shared_data / "slam" / f"{name}.g2o"
    graph_file = read_graph(path)
    planar = name != "sphere2500"
    assert graph_file.planar == planar
    assert_gtsam_agrees(gtsam.readG2o(str(path), not planar)[0], graph_file, planar)
    copy = tmp_path / "copy.g2o"
    write_graph(copy, graph_file)
    rewritten = gtsam.readG2o(str(copy), not planar)[0]
    assert_gtsam_agrees(rewritten, graph_file, planar)
    original = gtsam.readG2o(str(path), not planar)[0]
    for edge in range(0, graph_file.graph.num_edges, 7):
        information, expected = (factors.at(edge).noiseModel().information() for factors in (rewritten, original))
        np.testing.assert_allclose(information, expected, rtol=1e-9, atol=1e-6)


@given(st.integers(2, 30), st.integers(0, 2**32))
def test_vertices_of_a_chain_explain_its_edges(num_nodes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = np.stack((np.arange(num_nodes - 1), np.arange(1, num_nodes)))
    flipped = rng.random(num_nodes - 1) < 0.5
    source, target = np.where(flipped, ends[::-1], ends)
    chain = GraphFile.from_ids(
        source,
        target,
        rotations.random(num_nodes - 1).numpy(),
        edge_translation=rng.normal(size=(num_nodes - 1, 3)),
    )
    orientations = rotations.random(num_nodes)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.g2o"
        write_graph(path, chain)
        factors, values = gtsam.readG2o(str(path), True)
        assert factors.error(values) < 1e-15
        g2o.write(path, chain, orientations.numpy())
        _, values = gtsam.readG2o(str(path), True)
    for node in range(num_nodes):
        world_from_body = values.atPose3(node).rotation().matrix()
        np.testing.assert_allclose(world_from_body, rotations.to_matrix(orientations[node]).numpy().T, atol=1e-9)
    for edge in range(num_nodes - 1):
        start, end = (values.atPose3(int(ids[edge])) for ids in (source, target))
        np.testing.assert_allclose(start.transformTo(end.translation()), chain.edge_translation[edge], atol=1e-9)


def test_madrid_metropolis(shared_data: Path, tmp_path: Path) -> None:
    """The stored R is the transpose of R_j R_iᵀ."""
    path = shared_data / "sfm" / "madrid_metropolis" / "EGs.txt"
    graph_file = read_graph(path)
    assert (graph_file.graph.num_nodes, graph_file.graph.num_edges) == (394, 23784)
    first = np.array(path.read_text().split(maxsplit=14)[2:11], dtype=float).reshape(3, 3)
    np.testing.assert_allclose(rotations.to_matrix(graph_file.graph.target_from_source[0]).numpy(), first.T, atol=1e-5)
    write_graph(tmp_path / "EGs.txt", graph_file)
    assert_same_edges(read_graph(tmp_path / "EGs.txt"), graph_file)


def test_toro_information_is_reordered(shared_data: Path, tmp_path: Path) -> None:
    graph_file = read_graph(shared_data / "slam" / "FR079.g2o")
    write_graph(tmp_path / "copy.g2o", graph_file)
    assert (
        "EDGE_SE2 0 1 0.52736 -0.06069 -0.06826 62.41751 156.175245 0 1401.514426 0 8762.863892\n"
        in (tmp_path / "copy.g2o").read_text()
    )


@given(graph_files())
def test_what_a_format_cannot_store_is_named(graph_file: GraphFile) -> None:
    full = replace(graph_file, stamps_ns=np.arange(len(graph_file.node_ids)))
    assert "stamps" in not_stored("x.g2o", full)
    assert "stamps" in not_stored("x.txt", full)
    assert "precisions" in not_stored("x.txt", full)
    kinds_survive = torch.equal(through(".g2o", full).graph.kind, full.graph.kind)
    assert kinds_survive != any("which edges are odometry" in what for what in not_stored("x.g2o", full))


@pytest.mark.parametrize("suffix", [".g2o", ".toro", ".isam", ".txt"])
def test_labels_and_steps_are_lost_but_in_npz(suffix: str) -> None:
    label, steps = "labels", "how many steps odometry edges stand for"
    graph_file = GraphFile.from_ids(
        np.array([0, 1]), np.array([1, 2]), np.array([[0.0, 0, 0, 1]] * 2), kind=np.array([0, 1]), planar=True
    )
    plain = graph_file.graph
    assert not {label, steps} & set(not_stored(f"x{suffix}", graph_file))
    for changes, lost in (
        ({"label": torch.tensor([0, 2])}, {label}),
        ({"steps": torch.tensor([2.0, 1.0]).double()}, {steps}),
        ({"steps": torch.tensor([1.0, 2.0]).double()}, set()),  # of a closure, without meaning
    ):
        changed = replace(graph_file, graph=replace(plain, **changes))
        assert {label, steps} & set(not_stored(f"x{suffix}", changed)) == lost
        assert not_stored("x.npz", changed) == []
    along = replace(graph_file, graph=replace(plain, route=torch.tensor([0, -1]), routes=torch.zeros(1, 38).double()))
    for path in (f"x{suffix}", "x.npz"):
        assert "which ways odometry went along edges drawn together" in not_stored(path, along)


def test_unknown_suffix(tmp_path: Path) -> None:
    graph_file = GraphFile.from_ids(np.array([0]), np.array([1]), np.array([[0.0, 0, 0, 1]]))
    with pytest.raises(GraphFileError, match=r"unknown suffix '.foo'; use .g2o, .toro, .graph"):
        write_graph(tmp_path / "graph.foo", graph_file)


def test_a_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    graph_file = GraphFile.from_ids(np.array([0]), np.array([1]), np.array([[0.0, 0, 0, 1]]))
    path = tmp_path / "graph.g2o"
    path.write_text("old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, hard))  # bytes: as on a disk that is full from there on
    try:
        with pytest.raises(GraphFileError, match="cannot be written: File too large"):
            write_graph(path, graph_file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".g2o", ".toro", ".isam", ".npz", ".txt"])
def test_translations_that_are_not_known(tmp_path: Path, suffix: str) -> None:
    """They are read back as what they are; 1DSfM, which has no word for them, says that it has none."""
    angle = np.array([0.1, 0.2, 0.3, 0.6])
    quaternions = np.stack((0 * angle, 0 * angle, -np.sin(angle / 2), np.cos(angle / 2)), axis=1)
    translation = np.array([[1.0, 0.0, 0.0], [np.nan] * 3, [0.0, 0.0, 0.0], [np.nan] * 3])
    graph_file = GraphFile.from_ids(
        np.array([0, 1, 2, 0]), np.array([1, 2, 3, 3]), quaternions, planar=True, edge_translation=translation
    )
    path = tmp_path / f"graph{suffix}"
    write_graph(path, graph_file)
    again = read_graph(path)
    assert again.edge_translation is not None
    if suffix == ".txt":
        np.testing.assert_array_equal(again.edge_translation, np.nan_to_num(translation))
        assert "which translations are unknown (written as 0)" in not_stored(path, graph_file)
    else:
        np.testing.assert_allclose(again.edge_translation, translation, atol=1e-12)
        assert not any("translations" in what for what in not_stored(path, graph_file))


@pytest.mark.parametrize("suffix", [".g2o", ".toro", ".isam", ".npz", ".txt"])
def test_translations_that_only_the_graph_has(suffix: str) -> None:
    translation = [[1.0, 2.0, 0.0], [-3.0, 0.5, 0.0]]
    graph = ViewGraph.create([0, 1], [1, 2], [[0, 0, 0.6, 0.8]] * 2, kind=[0, 0], translation=translation)
    read = through(suffix, GraphFile(graph, np.array([4, 5, 6]), planar=True))
    assert read.graph.translation is not None
    np.testing.assert_allclose(read.graph.translation, translation, atol=1e-12)


@pytest.mark.parametrize("suffix", [".g2o", ".toro", ".isam", ".npz", ".txt"])
@pytest.mark.parametrize("planar", [True, False])
def test_no_translations_at_all(suffix: str, planar: bool) -> None:
    """None comes back, and again none of that; 1DSfM says that it has no word for it."""
    if suffix == ".isam" and not planar:
        pytest.skip("a format of the plane")
    graph_file = GraphFile.from_ids(
        np.array([0, 1]), np.array([1, 2]), np.array([[0.0, 0, 0.6, 0.8]] * 2), planar=planar, precision=np.ones(2)
    )
    if suffix == ".txt":
        assert "which translations are unknown (written as 0)" in not_stored(f"x{suffix}", graph_file)
        return
    assert not any("translations" in what for what in not_stored(f"x{suffix}", graph_file))
    once = through(suffix, graph_file)
    for read in (once, through(suffix, once)):
        assert read.graph.translation is None
        assert read.edge_translation is None
        torch.testing.assert_close(read.graph.precision, graph_file.graph.precision)


def _with_information(rng: np.random.Generator) -> GraphFile:
    """Of a chain: one edge states it, one does not."""
    factors = rng.standard_normal((2, 3, 3))
    information = factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(3)
    information[1] = np.nan
    return GraphFile.from_ids(
        np.array([3, 4]),
        np.array([4, 5]),
        Rotation.random(2, rng).as_quat(),
        precision=np.array([np.nan, 2.0]),
        information=information,
        edge_translation=rng.standard_normal((2, 3)),
    )


@pytest.mark.parametrize("suffix", [".npz", ".g2o", ".toro"])
def test_information_is_kept(suffix: str) -> None:
    graph_file = _with_information(np.random.default_rng(0))
    read, expected = through(suffix, graph_file).graph.information, graph_file.graph.information
    assert read is not None and expected is not None
    torch.testing.assert_close(read[0], expected[0], rtol=1e-12, atol=1e-12)
    # Pose-graph files have no word for an unknown one.
    unknown = torch.full((3, 3), torch.nan) if suffix == ".npz" else 2 * torch.eye(3)
    torch.testing.assert_close(read[1], unknown.double(), equal_nan=True)
    assert (
        through(suffix, replace(graph_file, graph=replace(graph_file.graph, information=None))).graph.information
        is None
    )


def test_gtsam_has_information_in_the_same_frame() -> None:
    """Its error of a g2o edge, in units of the information that it reads, is ours."""
    rng = np.random.default_rng(1)
    graph_file = _with_information(rng)
    graph = graph_file.graph
    assert graph.information is not None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "graph.g2o"
        write_graph(path, graph_file)
        factors, _ = gtsam.readG2o(str(path), True)
    true = Rotation.random(2, rng)  # world_from_body of both ends of the first edge
    pose = gtsam.Values()
    place = graph_file.edge_translation
    assert place is not None
    for key, orientation, position in ((3, true[0], np.zeros(3)), (4, true[1], true[0].apply(place[0]))):
        pose.insert(key, gtsam.Pose3(gtsam.Rot3(orientation.as_matrix()), position))
    error = Rotation.from_quat(graph.target_from_source[0].numpy()) * (true[1].inv() * true[0]).inv()
    vector = error.as_rotvec()
    expected = vector @ graph.information[0].numpy() @ vector / 2
    assert factors.at(0).error(pose) == pytest.approx(expected, rel=1e-6)
