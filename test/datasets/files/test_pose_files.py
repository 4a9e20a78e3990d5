"""Trajectory files, written by us and read by evo, and the other way round."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.core.trajectory import PosePath3D, PoseTrajectory3D
from evo.tools import file_interface

from rotavg_ros import rotations
from rotavg_ros.datasets.files.graph_file import GraphFileError
from rotavg_ros.datasets.files.pose_files import read_pose_file, write_kitti, write_tum

COUNT = 20


@pytest.fixture
def poses() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps of today to the nanosecond, positions, orientations xyzw."""
    rng = np.random.default_rng(0)
    stamps_ns = 1_700_000_000_123_456_789 + np.cumsum(rng.integers(1, 10**9, COUNT))
    return stamps_ns, rng.normal(scale=100, size=(COUNT, 3)), rotations.random(COUNT).numpy()


def test_tum(tmp_path: Path, poses) -> None:
    stamps_ns, position, orientation = poses
    write_tum(tmp_path / "ours.tum", *poses)
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "ours.tum"))
    np.testing.assert_allclose(read.timestamps, stamps_ns / 1e9, atol=1e-6)
    np.testing.assert_allclose(read.positions_xyz, position, atol=1e-8)
    same = np.abs((np.roll(read.orientations_quat_wxyz, -1, axis=1) * orientation).sum(axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-8)
    back = read_pose_file(tmp_path / "ours.tum")
    np.testing.assert_array_equal(back.stamps_ns, stamps_ns)  # which seconds in a float could not hold


def test_stamps_before_zero(tmp_path: Path) -> None:
    stamps_ns = np.array([-1_500_000_000, -500_000_000, -1, 0, 1_500_000_000])
    write_tum(tmp_path / "ours.tum", stamps_ns, np.zeros((5, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (5, 1)))
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "ours.tum"))
    np.testing.assert_allclose(read.timestamps, stamps_ns / 1e9, atol=1e-12)
    np.testing.assert_array_equal(read_pose_file(tmp_path / "ours.tum").stamps_ns, stamps_ns)


def test_a_first_row_before_zero_is_no_header(tmp_path: Path) -> None:
    for header in ("", "stamp,x,y,heading\n"):
        (tmp_path / "truth.csv").write_text(f"{header}-1.5,2,3,0\n2.5,2,4,0\n")
        np.testing.assert_array_equal(read_pose_file(tmp_path / "truth.csv").stamps_ns, [-1_500_000_000, 2_500_000_000])


def test_tum_of_evo(tmp_path: Path, poses) -> None:
    stamps_ns, position, orientation = poses
    theirs = PoseTrajectory3D(position, np.roll(orientation, 1, axis=1), stamps_ns / 1e9)
    file_interface.write_tum_trajectory_file(str(tmp_path / "theirs.tum"), theirs)
    read = read_pose_file(tmp_path / "theirs.tum")
    assert read.stamps_ns is not None
    np.testing.assert_allclose(read.stamps_ns, stamps_ns, atol=1000)
    np.testing.assert_allclose(read.position, position, atol=1e-8)


def test_kitti(tmp_path: Path, poses) -> None:
    _, position, orientation = poses
    write_kitti(tmp_path / "ours.txt", position, orientation)
    path: PosePath3D = file_interface.read_kitti_poses_file(str(tmp_path / "ours.txt"))
    np.testing.assert_allclose(path.positions_xyz, position, rtol=1e-9)
    back = read_pose_file(tmp_path / "ours.txt")
    assert back.stamps_ns is None
    np.testing.assert_allclose(np.abs((back.world_from_body * orientation).sum(axis=1)), 1, atol=1e-9)


def test_euroc(tmp_path: Path, poses) -> None:
    """evo reads the same file the same way; its columns beyond the pose are velocities and biases."""
    stamps_ns, position, orientation = poses
    rows = np.hstack((position, np.roll(orientation, 1, axis=1), np.ones((COUNT, 9))))
    text = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], ..."]
    text += [
        f"{stamp}," + ",".join(map(repr, row)) for stamp, row in zip(stamps_ns.tolist(), rows.tolist(), strict=True)
    ]
    path = tmp_path / "data.csv"
    path.write_text("\n".join(text))
    read, by_evo = read_pose_file(path), file_interface.read_euroc_csv_trajectory(str(path))
    np.testing.assert_array_equal(read.stamps_ns, stamps_ns)
    np.testing.assert_allclose(read.position, by_evo.positions_xyz)
    np.testing.assert_allclose(read.world_from_body, np.roll(by_evo.orientations_quat_wxyz, -1, axis=1), atol=1e-12)


@pytest.mark.parametrize(
    ("header", "order"),
    [
        ("timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_WS_W_x\n", "xyzw"),  # OKVIS
        ("#timestamp [ns],tx,ty,tz,qx,qy,qz,qw\n", "xyzw"),
        ("# by hand\n\n#timestamp, p_x [m], p_y [m], p_z [m], q_W [], q_X [], q_Y [], q_Z []\n", "wxyz"),
        ("timestamp,x,y,z,a,b,c,d\n", "wxyz"),
        ("# of 4 axes, x, y, z\n", "wxyz"),
        ("", "wxyz"),
    ],
)
def test_the_header_of_a_csv_file_states_the_order_of_its_quaternions(
    tmp_path: Path, poses, header: str, order: str
) -> None:
    stamps_ns, position, orientation = poses
    stated = orientation[:, ["xyzw".index(axis) for axis in order]]
    numbers = np.hstack((position, stated, np.ones((COUNT, 3)))).tolist()
    rows = [",".join(map(repr, [stamp, *row])) for stamp, row in zip(stamps_ns.tolist(), numbers, strict=True)]
    (tmp_path / "data.csv").write_text(header + "\n".join(rows))
    read = read_pose_file(tmp_path / "data.csv")
    np.testing.assert_array_equal(read.stamps_ns, stamps_ns)
    np.testing.assert_allclose(read.world_from_body, orientation, atol=1e-12)


def test_headings_in_the_plane(tmp_path: Path) -> None:
    (tmp_path / "truth.csv").write_text("1.5, 2, 3, 1.5707963267948966\n2.5, 2, 4, 0\n")
    read = read_pose_file(tmp_path / "truth.csv")
    np.testing.assert_array_equal(read.stamps_ns, [1_500_000_000, 2_500_000_000])
    np.testing.assert_allclose(read.position, [[2, 3, 0], [2, 4, 0]])
    np.testing.assert_allclose(read.world_from_body[0], [0, 0, np.sqrt(0.5), np.sqrt(0.5)])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("# nothing\n", "no rows; expected TUM"),
        ("1 2 3 4 5\n", ":1: 5 columns; expected TUM"),
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 1\n", ":2: "),
        ("1 0 0 0 0 0 0 1\n2 0 0 nan 0 0 0 1\n", ":2: a number that is not finite"),
        ("1,a,0,0\n", ":1: 'a' is not a number"),
        ("-1x,0,0,0\n2,0,0,0\n", ":1: '-1x' is not a number"),
        ("1,0,0,0,1,0,0,0\n" + "9" * 20 + ",0,0,0,1,0,0,0\n", ":2: stamp '99999999999999999999' is too large"),
        ("1,0,0,0,1,0,0,0\n1e30,0,0,0,1,0,0,0\n", ":2: stamp '1e30' is too large; EuRoC's stamps are in nanoseconds"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", ":2: a stamp earlier than the one before; sort"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", ":2: the same stamp as the one before; remove one"),
        ("1,0,0,0,0,0,0,1\n2.5,0,0,0,0,0,0,1\n", ":2: stamp '2.5' is not a whole number; EuRoC's stamps are in nano"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n", ":1: a matrix that is not a rotation"),
    ],
)
def test_what_is_no_trajectory(tmp_path: Path, content: str, says: str) -> None:
    (tmp_path / "bad.txt").write_text(content)
    with pytest.raises(GraphFileError) as caught:
        read_pose_file(tmp_path / "bad.txt")
    assert says in str(caught.value)
