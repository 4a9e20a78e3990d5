"""What g2o, TORO and iSAM lines mean, and what becomes of bad ones."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros import rotations
from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError
from rotavg_ros.view_graph import EdgeKind

SE2 = "EDGE_SE2 {} {} 1 2 {} 500 0 0 500 0 {}"
SE3 = "EDGE_SE3:QUAT {} {} 1 2 3 {} 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 10 0 0 20 0 60"


def read_text(folder: Path, text: str, name: str = "graph.g2o") -> GraphFile:
    path = folder / name
    path.write_text(text)
    return read_graph(path)


def test_se2(tmp_path: Path) -> None:
    graph_file = read_text(tmp_path, SE2.format(3, 7, 0.5, 90))
    graph = graph_file.graph
    assert graph_file.node_ids.tolist() == [3, 7]
    assert graph_file.planar
    # The edge states the target in the source frame: target_from_source turns back.
    np.testing.assert_allclose(rotations.log(graph.target_from_source).numpy(), [[0, 0, -0.5]], atol=1e-12)
    np.testing.assert_allclose(graph_file.edge_translation, [[1, 2, 0]])
    assert graph.precision.tolist() == [90]
    assert graph.kind.tolist() == [EdgeKind.LOOP_CLOSURE]


def test_se3(tmp_path: Path) -> None:
    graph_file = read_text(tmp_path, SE3.format(0, 1, "0.6 0 0 0.8"))
    np.testing.assert_allclose(graph_file.graph.target_from_source.numpy(), [[-0.6, 0, 0, 0.8]], atol=1e-12)
    assert graph_file.graph.precision.tolist() == [30]
    assert not graph_file.planar


def test_toro(tmp_path: Path) -> None:
    planar = read_text(tmp_path, "VERTEX2 0 0 0 0\nEDGE2 0 1 1 2 0.5 11 12 13 44 15 16")
    np.testing.assert_allclose(rotations.log(planar.graph.target_from_source).numpy(), [[0, 0, -0.5]], atol=1e-12)
    assert planar.graph.precision.tolist() == [44]

    information = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 10 0 0 20 0 60"
    text = f"VERTEX3 0 0 0 0 0 0 0\nVERTEX3 1 0 0 0 0 0 0\nEDGE3 0 1 1 2 3 0.1 -0.2 0.3 {information}\n"
    spatial = read_text(tmp_path, text, "graph.txt")
    source_from_target = gtsam.load3D(str(tmp_path / "graph.txt"))[0].at(0).measured().rotation().matrix()
    ours = rotations.to_matrix(spatial.graph.target_from_source[0]).numpy()
    np.testing.assert_allclose(ours, source_from_target.T, atol=1e-9)
    assert spatial.graph.precision.tolist() == [30]


def test_isam_odometry_states_a_square_root(tmp_path: Path) -> None:
    root = np.array([[5.0, 1, 2], [0, 6, 3], [0, 0, 7]])
    entries = " ".join(str(value) for value in root[np.triu_indices(3)])
    graph_file = read_text(tmp_path, f"ODOMETRY 0 1 1 2 0.5 {entries}\nLANDMARK 0 1 1 2 3 4 5")
    assert graph_file.graph.precision.tolist() == [(root.T @ root)[2, 2]]
    assert graph_file.skipped == {"LANDMARK": 1}


PLANAR_SWITCHABLE = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1 0 0
VERTEX_SE2 2 2 0 0
VERTEX_SWITCH 3 1
EDGE_SWITCH_PRIOR 3 1 1.0
EDGE_SE2 0 1 1 2 0.3 10 0 0 20 0 30
{tag} 2 0 {switch} 1 2 0.5 11 12 13 14 15 44
{tag} 1 2 {switch} 1 2 0.5 11 12 13 14 15 44
"""


@pytest.mark.parametrize(("tag", "switch"), [("EDGE_SE2_SWITCHABLE", "3"), ("EDGE_SE2_MAXMIX", "0.01")])
def test_planar_edges_that_may_be_switched_off_are_closures(tmp_path: Path, tag: str, switch: str) -> None:
    graph_file = read_text(tmp_path, PLANAR_SWITCHABLE.format(tag=tag, switch=switch))
    graph = graph_file.graph
    turns = rotations.log(graph.target_from_source).numpy()
    np.testing.assert_allclose(turns, [[0, 0, -0.3], [0, 0, -0.5], [0, 0, -0.5]], atol=1e-12)
    assert graph.precision.tolist() == [30, 44, 44]
    assert graph.is_odometry.tolist() == [True, False, False], "consecutive ids, but who would switch odometry off?"
    assert graph_file.skipped == {"VERTEX_SWITCH": 1, "EDGE_SWITCH_PRIOR": 1}
    assert graph_file.node_ids.tolist() == [0, 1, 2], "a switch is no pose"


@pytest.mark.parametrize("tag", ["EDGE_SE3_SWITCHABLE", "EDGE_SE3:QUAT_SWITCHABLE"])
def test_spatial_edges_that_may_be_switched_off_are_closures(tmp_path: Path, tag: str) -> None:
    plain = SE3.format(0, 1, "0.6 0 0 0.8")
    switchable = plain.replace("EDGE_SE3:QUAT 0 1", f"{tag} 0 1 7")
    graph = read_text(tmp_path, f"{plain}\n{switchable}").graph
    assert torch.equal(graph.target_from_source[0], graph.target_from_source[1])
    assert torch.equal(graph.translation[0], graph.translation[1])
    assert graph.precision.tolist() == [30, 30]
    assert graph.is_odometry.tolist() == [True, False]


def test_what_rtab_map_and_hdl_graph_slam_write_beside_edges_is_skipped(tmp_path: Path) -> None:
    beside = """PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
EDGE_POINTXYZ_PRIOR 1 4 5 6 1 0 0 1 0 1
EDGE_SE3_PRIOR 1 0 0 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1
VERTEX_PLANE 9 0 0 1 0
EDGE_SE3_PLANE 1 9 0 0 1 0 1 0 0 1 0 1
EDGE_SE3_PRIORXYZ 1 4 5 6 1 0 0 1 0 1
EDGE_SE3_PRIORQUAT 1 0 0 0 1 1 0 0 1 0 1
"""
    graph_file = read_text(tmp_path, beside + SE3.format(0, 1, "0 0 0 1"))
    assert graph_file.graph.num_edges == 1
    assert graph_file.node_ids.tolist() == [0, 1]
    assert sum(graph_file.skipped.values()) == len(beside.splitlines())


def test_consecutive_ids_are_odometry_in_either_direction(tmp_path: Path) -> None:
    pairs = [(0, 1), (2, 1), (0, 2), (5, 2), (2**62, 2**62 + 1)]
    graph_file = read_text(tmp_path, "\n".join(SE2.format(*pair, 0, 1) for pair in pairs))
    assert graph_file.graph.is_odometry.tolist() == [True, True, False, False, True]
    graph = graph_file.graph
    assert list(zip(graph_file.node_ids[graph.source], graph_file.node_ids[graph.target], strict=True)) == pairs


def _chain_and_loop(ids: list[int]) -> str:
    pairs = [*pairwise(ids), (ids[-1], ids[0]), (ids[7], ids[2])]
    return "\n".join(SE2.format(*pair, 0, 1) for pair in pairs)


@pytest.mark.parametrize(
    "ids",
    [
        list(range(0, 60, 5)),
        [0, 3, 4, 9, 12, 15, 21, 22, 30, 34, 39, 41],
        [0, 1, 2, 3, 4, 6, 7, 8, 12, 13, 14, 45],  # some keyframes were dropped
        [(97 << 56) + 10 * k for k in range(12)],
    ],
)
def test_keyframes_with_gaps_between_their_ids_have_odometry(tmp_path: Path, ids: list[int]) -> None:
    graph_file = read_text(tmp_path, _chain_and_loop(ids))
    assert graph_file.graph.is_odometry.tolist() == [True] * 11 + [False] * 2
    assert graph_file.consecutive.tolist() == graph_file.graph.is_odometry.tolist()


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (range(10), range(100, 110)),
        ([(97 << 56) + 10 * k for k in range(10)], [(98 << 56) + 10 * k for k in range(10)]),
    ],
)
def test_a_closure_between_two_blocks_of_ids_is_no_odometry(tmp_path: Path, first: Any, second: Any) -> None:
    ids = [*first, *second]
    graph_file = read_text(tmp_path, _chain_and_loop(ids))
    assert graph_file.graph.is_odometry.tolist() == [True] * 9 + [False] + [True] * 9 + [False] * 2


def test_cameras_with_gaps_between_their_ids_have_none(tmp_path: Path) -> None:
    pairs = [(5 * i, 5 * j) for i in range(12) for j in range(i) if (i + j) % 3]
    graph_file = read_text(tmp_path, "\n".join(SE2.format(*pair, 0, 1) for pair in pairs))
    assert not graph_file.graph.is_odometry.any()


@pytest.mark.parametrize(("angle", "is_doubted"), [("30", True), ("-6.29", True), ("6.28", False)])
def test_angles_that_may_be_degrees_are_warned_of(tmp_path: Path, angle: str, is_doubted: bool) -> None:
    text = f"# degrees?\nEDGE_SE2 0 1 1 0 0.1 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 {angle} 1 0 0 1 0 1\n"
    said = ["1 of 2 edges (the first in line 3) with an angle of more than a whole turn"] if is_doubted else []
    assert [warning.partition(";")[0] for warning in read_text(tmp_path, text).warnings] == said


def test_skipped_and_kept(tmp_path: Path) -> None:
    text = f"""# a comment

PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1
VERTEX_SE2 0 nan 0 0
VERTEX_SE2 9 0 0 0
VERTEX_XY 100 1 2
FIX 0
{SE2.format(0, 1, 0.1, 1)}
{SE2.format(0, 1, 0.1, 1)}
{SE2.format(5, 5, 0.1, 1)}
EDGE_SE2_XY 0 100 1 2 1 0 1
EDGE_SE2_XY 1 100 1 2 1 0 1
"""
    graph_file = read_text(tmp_path, text.replace("\n", "\r\n"))
    assert graph_file.graph.num_edges == 2
    assert graph_file.node_ids.tolist() == [0, 1, 5, 9]
    assert graph_file.skipped == {"PARAMS_SE3OFFSET": 1, "VERTEX_XY": 1, "FIX": 1, "EDGE_SE2_XY": 2, "self-edge": 1}


def test_mixed_dimensions_stay_in_order(tmp_path: Path) -> None:
    lines = [SE3.format(0, 1, "0 0 0 1"), SE2.format(1, 2, 0.1, 1), SE3.format(2, 3, "0 0 0 1")]
    graph_file = read_text(tmp_path, "\n".join(lines))
    assert graph_file.graph.source.tolist() == [0, 1, 2]
    assert not graph_file.planar


def test_nearly_unit_quaternions_are_normalised(tmp_path: Path) -> None:
    graph = read_text(tmp_path, SE3.format(0, 1, "0 0 0 1.0009")).graph
    assert graph.target_from_source.norm().item() == pytest.approx(1, abs=1e-15)


GOOD = SE2.format(0, 1, 0.1, 1)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (SE2.format(1, 2, "nan", 1), "not finite"),
        (SE2.format(1, 2, "inf", 1), "not finite"),
        (SE2.format(1, 2, "0.1x", 1), "'0.1x' is not a number"),
        (SE2.format(1, 2.5, 0, 1), "'2.5' is not an integer id"),
        (SE2.format(1, "x7", 0, 1), "'x7' is not an integer id"),
        (SE2.format(1, 2**63, 0, 1), "too large"),
        (SE2.format(1, -2, 0, 1), "negative id"),
        (SE3.format(1, 2, "0 0 0 0"), "quaternion of length 0"),
        (SE3.format(1, 2, "0 0 0 1.01"), "quaternion of length 1.01"),
        (SE3.format(1, 2, "0 0 0 1e200"), "quaternion of length"),
        ("EDGE_SE2 1 2 1e300 0 0.1 1 0 0 1 0 1", "a translation of more than 1e+09 m"),
        ("EDGE_SE2 1 2 0.1 0.2", "4 numbers where 11 belong"),
        ("VERTEX_SE2 1 2", "2 numbers where 4 belong"),
        ("VERTEX_SE2 one 0 0 0", "'one' is not an integer id"),
        ("EDGE_SE9 1 2 0.1", "unknown tag 'EDGE_SE9'"),
        ("EQUIV 1 2", "two vertices that are one, is not read; remove it or state an edge of no turn"),
        (SE2.format(0, 1, 1e300, 1), "an angle of more than 1e+09 rad"),
        (PLANAR_SWITCHABLE.format(tag="EDGE_SE2_SWITCHABLE", switch="").splitlines()[-1], "11 numbers where 12 belong"),
        ("\x00\x01\x02\x03", "unknown tag"),
    ],
)
def test_bad_lines_are_named(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(GraphFileError) as caught:
        read_text(tmp_path, f"# comment\n{GOOD}\n\n{line}\n{GOOD}\n")
    assert str(caught.value).startswith(f"{tmp_path}/graph.g2o:4: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_line_numbers_beyond_the_first_block(tmp_path: Path) -> None:
    lines = [SE2.format(i, i + 1, 0.1, 1) for i in range(150_000)]
    lines[149_000] = SE2.format(0, 1, "nan", 1)
    with pytest.raises(GraphFileError, match=r"graph\.g2o:149001: "):
        read_text(tmp_path, "\n".join(lines))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        ("# nothing\n", "no edges"),
        ("VERTEX_SE2 0 0 0 0\n", "no edges"),
        (SE2.format(4, 4, 0, 1), "joins a pose with itself"),
    ],
)
def test_nothing_to_solve(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(GraphFileError, match=message):
        read_text(tmp_path, text)


def test_a_tag_of_parameters_may_be_garbled(tmp_path: Path) -> None:
    (tmp_path / "graph.g2o").write_bytes(b"PARAMS\xff 0 1\n" + GOOD.encode())
    assert "PARAMS\\xff" in read_graph(tmp_path / "graph.g2o").skipped


def test_what_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(GraphFileError, match="no such file"):
        read_graph(tmp_path / "missing.g2o")
    with pytest.raises(GraphFileError, match="is a directory"):
        read_graph(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(GraphFileError, match="not a regular file"):
        read_graph(tmp_path / "pipe")
    secret = tmp_path / "secret.g2o"
    secret.write_text(GOOD)
    secret.chmod(0)
    if os.access(secret, os.R_OK):
        pytest.skip("this user may read everything, so permission cannot be denied")
    with pytest.raises(GraphFileError, match="permission denied"):
        read_graph(secret)


@given(st.data())
def test_damaged_text_is_read_or_refused_by_name(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    lines = [SE2.format(0, 1, 0.1, 1), SE3.format(1, 2, "0.6 0 0 0.8"), "VERTEX_SE2 3 0 0 0", "FIX 0"]
    rotation = "1 2 1 0 0 0 1 0 0 0 1 0 0 0"
    text = "\n".join(data.draw(st.permutations(lines)) if data.draw(st.booleans()) else [rotation] * 3).encode()
    if data.draw(st.booleans()):
        text = text[: data.draw(st.integers(0, len(text)))]
    for _ in range(data.draw(st.integers(0, 3))):
        where = data.draw(st.integers(0, len(text)))
        length = data.draw(st.integers(0, 3))
        junk = data.draw(
            st.one_of(st.binary(max_size=6), st.sampled_from([b"nan", b"-", b"1e999", b"\n", b" 9", b"_"]))
        )
        text = text[:where] + junk + text[where + length :]
    path = tmp_path_factory.getbasetemp() / "damaged.g2o"
    path.write_bytes(text)
    try:
        graph_file = read_graph(path)
    except GraphFileError as refusal:
        message = str(refusal)
    else:
        assert graph_file.graph.num_edges > 0
        assert bool(graph_file.graph.target_from_source.isfinite().all())
        return
    assert message.startswith(str(path))
    assert "\n" not in message
