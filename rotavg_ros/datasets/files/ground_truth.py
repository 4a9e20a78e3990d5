"""Companion files of a view-graph: a stamp per node, and ground truth by id or by stamp."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError
from rotavg_ros.datasets.files.text_rows import parse_rows, read_blocks, refuse, shown, unit_quaternions
from rotavg_ros.datasets.planar import quaternion_of_heading
from rotavg_ros.rotations import canonical, inverse

# Ground truth by stamp belongs to a node only if it is this close in time.
MAX_TRUTH_DISTANCE_NS = 150_000_000

_TOO_LARGE = 1e18  # seconds; 64 bits of nanoseconds end at 9.2e9

_BY_ID_HEADER = b"id,qx,qy,qz,qw"


def attach_stamps(graph_file: GraphFile, path: str | Path) -> GraphFile:
    """The graph with the stamps of a text file: one per line in seconds, for the nodes in ascending order of id.

    Raises:
        GraphFileError: a malformed line, or not as many stamps as nodes.
    """
    path = Path(path)
    stamps: list[int] = []
    for block in read_blocks(path):
        parse_rows(path, [line for line, _ in block], [row for _, row in block], 0, 1)
        stamps.extend(nanoseconds(path, line, row[0]) for line, row in block)
    if len(stamps) != len(graph_file.node_ids):
        what = f"{len(stamps)} stamps for {len(graph_file.node_ids)} nodes; give one per node, ascending by id"
        raise GraphFileError.at(path, None, what)
    if len(stamps) > 2 and all(later < earlier for earlier, later in pairwise(stamps)):
        what = "every stamp is earlier than the one before; give them in the ascending order of the nodes' ids"
        raise GraphFileError.at(path, None, what)
    return replace(graph_file, stamps_ns=np.array(stamps, dtype=np.int64))


def _is_number(cell: bytes) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def attach_truth(graph_file: GraphFile, path: str | Path) -> GraphFile:
    """The graph with ground truth from a csv file; nodes that it does not mention are NaN.

    Two kinds are supported: with the header ``id,qx,qy,qz,qw``, world-from-body orientations by id (further columns,
    as in our own ``orientations.csv``, are ignored); without a header, rows ``stamp, x, y, heading`` in seconds, metres
    and radians, matched to the nodes' stamps within 0.15 s.

    Raises:
        GraphFileError: a malformed line, ground truth by stamp for a graph without stamps, or no node matched.
    """
    path = Path(path)
    rows = [
        (line, [cell.strip() for cell in b" ".join(row).split(b",")])
        for block in read_blocks(path)
        for line, row in block
    ]
    if not rows:
        raise GraphFileError.at(path, None, f"the file is empty; expected the header {_BY_ID_HEADER.decode()}")
    lines, cells = [line for line, _ in rows], [row for _, row in rows]
    body_from_world = np.full((len(graph_file.node_ids), 4), np.nan)
    position = np.full((len(graph_file.node_ids), 3), np.nan)
    if b",".join(cells[0]).startswith(_BY_ID_HEADER):
        ids, quaternions = parse_rows(path, lines[1:], [row[:5] for row in cells[1:]], 1, 4)
        matched = np.isin(graph_file.node_ids, ids[:, 0])
        order = np.argsort(ids[:, 0], kind="stable")
        rows_of_nodes = order[np.searchsorted(ids[order, 0], graph_file.node_ids[matched])]
        world_from_body = unit_quaternions(path, lines[1:], quaternions)[rows_of_nodes]
        body_from_world[matched] = _body_from_world(world_from_body)
        position_gt = graph_file.position_gt
    elif not _is_number(cells[0][0]):
        header = b",".join(cells[0]).decode(errors="replace")
        what = f"the header is {header!r}; expected {_BY_ID_HEADER.decode()!r}, or none and rows stamp, x, y, heading"
        raise GraphFileError.at(path, lines[0], what)
    else:
        stamps, numbers = _rows_by_stamp(path, lines, cells)
        if graph_file.stamps_ns is None:
            what = "is ground truth by stamp, but the graph has no stamps; give them too (--stamps)"
            raise GraphFileError.at(path, None, what)
        nearest = _nearest(stamps, graph_file.stamps_ns)
        matched = np.abs(stamps[nearest] - graph_file.stamps_ns) <= MAX_TRUTH_DISTANCE_NS
        x_y_heading = numbers[nearest[matched]]
        body_from_world[matched] = _body_from_world(quaternion_of_heading(x_y_heading[:, 2]))
        position[matched] = np.pad(x_y_heading[:, :2], ((0, 0), (0, 1)))
        position_gt = position
    if not matched.any():
        raise GraphFileError.at(path, None, "no row belongs to a node of the graph; check that the two files fit")
    return replace(graph_file, body_from_world_gt=body_from_world, position_gt=position_gt)


def _body_from_world(world_from_body: np.ndarray) -> np.ndarray:
    return canonical(inverse(torch.from_numpy(world_from_body))).numpy()


def _rows_by_stamp(path: Path, lines: list[int], cells: list[list[bytes]]) -> tuple[np.ndarray, np.ndarray]:
    """``(K,)`` ascending stamps in nanoseconds and ``(K, 3)`` x, y, heading."""
    _, numbers = parse_rows(path, lines, cells, 0, 4)
    stamps = np.array([nanoseconds(path, line, row[0]) for line, row in zip(lines, cells, strict=True)], dtype=np.int64)
    backward = np.concatenate(([False], np.diff(stamps) < 0))
    refuse(path, lines, backward, "a stamp earlier than the one before; sort the rows by time")
    return stamps, numbers[:, 1:]


def _nearest(ascending: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Index into ``ascending`` of the entry nearest to each value."""
    right = np.searchsorted(ascending, values).clip(0, len(ascending) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(ascending[left] - values) <= np.abs(ascending[right] - values), left, right)


def nanoseconds(path: Path, line: int, seconds: bytes) -> int:
    """Exact nanoseconds; a float of seconds since 1970 would be off by a hundred nanoseconds."""
    unsigned = seconds.removeprefix(b"-")
    whole, _, fraction = unsigned.partition(b".")
    if whole.isdigit() and (fraction.isdigit() or not fraction):
        value = int(whole) * 10**9 + int(fraction[:9].ljust(9, b"0"))
        value = value if unsigned == seconds else -value
    else:
        # Some valid numbers of seconds are too large for nanoseconds.
        value = round(min(max(float(seconds), -_TOO_LARGE), _TOO_LARGE) * 1e9)
    return _in_range(path, line, value, f"stamp {shown(seconds)} is too large; stamps are in seconds")


def whole_nanoseconds(path: Path, line: int, stamp: bytes) -> int:
    """A stamp given in nanoseconds, as in EuRoC's files."""
    is_whole = stamp.removeprefix(b"-").isdigit()
    if not is_whole and not float(stamp).is_integer():
        what = f"stamp {shown(stamp)} is not a whole number; EuRoC's stamps are in nanoseconds, TUM's in seconds"
        raise GraphFileError.at(path, line, what)
    value = int(stamp) if is_whole else int(float(stamp))
    return _in_range(path, line, value, f"stamp {shown(stamp)} is too large; EuRoC's stamps are in nanoseconds")


def _in_range(path: Path, line: int, value: int, what: str) -> int:
    if abs(value) > np.iinfo(np.int64).max:
        raise GraphFileError.at(path, line, what)
    return value
