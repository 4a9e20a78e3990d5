"""Trajectories in text files: TUM, KITTI and EuRoC's csv, as in evo and other programs."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.graph_file import GraphFileError, open_text, writing
from rotavg_ros.datasets.files.ground_truth import nanoseconds, whole_nanoseconds
from rotavg_ros.datasets.files.kitti import read_poses
from rotavg_ros.datasets.files.text_rows import (
    NUMBER_STARTS,
    Row,
    parse_rows,
    read_blocks,
    refuse,
    unit_quaternions,
    write_rows,
)
from rotavg_ros.datasets.planar import quaternion_of_heading

_EXPECTED = (
    "expected TUM (stamp x y z qx qy qz qw), KITTI (12 numbers a row), EuRoC csv (stamp in ns, x, y, z, qw, qx, qy, "
    "qz, …) or csv rows of stamp, x, y, heading"
)
# The name of a quaternion's column, as q_RS_w [] or qw, ends in its axis; others' csv files state w last.
_AXIS = re.compile(rb"([wxyz])[^A-Za-z]*$", re.IGNORECASE)


@dataclass(frozen=True)
class PoseFile:
    """The poses of a file (K rows).

    Attributes:
        stamps_ns: ``(K,)`` int64, ascending; None for KITTI's, which has one row per frame instead.
        position: ``(K, 3)`` metres.
        world_from_body: ``(K, 4)`` xyzw.
    """

    stamps_ns: np.ndarray | None
    position: np.ndarray
    world_from_body: np.ndarray


def read_pose_file(path: str | Path) -> PoseFile:
    """Read a trajectory; commas and the number of columns decide the format.

    Raises:
        GraphFileError: another format, a malformed line, or stamps that do not ascend.
    """
    path = Path(path)
    rows = [numbered for block in read_blocks(path) for numbered in block]
    is_csv = any(b"," in b"".join(row) for _, row in rows[:2])
    if is_csv:
        rows = [(line, b" ".join(row).replace(b",", b" ").split()) for line, row in rows]
        if rows and _is_heading(rows[0][1][0]):
            rows = rows[1:]
    if not rows:
        raise GraphFileError.at(path, None, f"the file has no rows; {_EXPECTED}")
    lines, cells = [line for line, _ in rows], [row for _, row in rows]
    columns = len(cells[0])
    if columns == 12 and not is_csv:
        world_from_body, position = read_poses(path)
        return PoseFile(None, position, world_from_body.as_quat(canonical=True))
    if columns == 8 and not is_csv:
        stamps_ns, numbers = _by_stamp(path, lines, cells)
        return PoseFile(stamps_ns, numbers[:, :3], unit_quaternions(path, lines, numbers[:, 3:]))
    if columns >= 8 and is_csv:
        stamps_ns, numbers = _by_stamp(path, lines, [row[:8] for row in cells], in_ns=True)
        xyzw = [3 + column for column in _places_of_xyzw(path, lines[0])]
        return PoseFile(stamps_ns, numbers[:, :3], unit_quaternions(path, lines, numbers[:, xyzw]))
    if columns == 4 and is_csv:
        stamps_ns, numbers = _by_stamp(path, lines, cells)
        position = np.pad(numbers[:, :2], ((0, 0), (0, 1)))
        return PoseFile(stamps_ns, position, quaternion_of_heading(numbers[:, 2]))
    raise GraphFileError.at(path, lines[0], f"{columns} columns; {_EXPECTED}")


def _is_heading(cell: bytes) -> bool:
    """Whether a row's first cell is that of a header; a damaged number does not count, so that its line is refused."""
    try:
        float(cell)
    except ValueError:
        return cell[:1] not in NUMBER_STARTS
    return False


def _places_of_xyzw(path: Path, first_line: int) -> list[int]:
    """Where x, y, z and w are among a csv file's columns 4 to 7: as its header says, else in EuRoC's order, w first.

    Args:
        first_line: number of the first line of numbers; the header, a comment or not, is above it.
    """
    with open_text(path) as file:
        above = [line for line in islice(file, first_line - 1) if line.strip()]
    names = above[-1].split(b",")[4:8] if above else []
    axes = "".join(found[1].decode().lower() if (found := _AXIS.search(name)) else "?" for name in names)
    return [(axes if sorted(axes) == sorted("wxyz") else "wxyz").index(axis) for axis in "xyzw"]


def _by_stamp(path: Path, lines: list[int], cells: list[Row], *, in_ns: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """``(K,)`` ascending stamps in nanoseconds and ``(K, …)`` the numbers after them."""
    _, numbers = parse_rows(path, lines, cells, 0, len(cells[0]))
    if in_ns:
        stamps = [whole_nanoseconds(path, line, row[0]) for line, row in zip(lines, cells, strict=True)]
    else:
        stamps = [nanoseconds(path, line, row[0]) for line, row in zip(lines, cells, strict=True)]
    stamps_ns = np.array(stamps, dtype=np.int64)
    step = np.diff(stamps_ns, prepend=stamps_ns[0] - 1)
    refuse(path, lines, step < 0, "a stamp earlier than the one before; sort the rows by time")
    refuse(path, lines, step == 0, "the same stamp as the one before; remove one of the two rows")
    return stamps_ns, numbers[:, 1:]


def write_tum(path: Path, stamps_ns: np.ndarray, position: np.ndarray, world_from_body: np.ndarray) -> None:
    """Rows ``stamp x y z qx qy qz qw``, the stamp in seconds.

    Raises:
        GraphFileError: the place cannot be written.
    """
    sign = np.where(stamps_ns < 0, "-", "")  # written separately, since 0 seconds have no sign
    seconds, rest = np.divmod(np.abs(stamps_ns), 10**9)
    with writing(path) as temporary, temporary.open("w", encoding="ascii") as file:
        write_rows(file, f"%s%d.%09d{' %.9f' * 7}\n", [sign, seconds, rest, position, world_from_body])


def write_kitti(path: Path, position: np.ndarray, world_from_body: np.ndarray) -> None:
    """Rows of the upper three of a 4 × 4 pose matrix.

    Raises:
        GraphFileError: the place cannot be written.
    """
    matrix = np.empty((len(position), 3, 4))
    matrix[:, :, :3] = Rotation.from_quat(world_from_body).as_matrix()
    matrix[:, :, 3] = position
    with writing(path) as temporary, temporary.open("w", encoding="ascii") as file:
        write_rows(file, f"%.12g{' %.12g' * 11}\n", [matrix.reshape(-1, 12)])
