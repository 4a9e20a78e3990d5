"""g2o pose graphs and their TORO, iSAM and Vertigo dialects.

An edge line stores the pose of the target in the source frame, so its rotation is the inverse of
``target_from_source``. Edges between consecutive ids, in either direction, are odometry; if keyframes are numbered with
gaps, those between neighbours. Edges that an optimiser may switch off (Sünderhauf & Protzel, IROS 2012; RTAB-Map writes
them, too) are closures whatever their ids, since odometry is never switched off.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError, joins_consecutive, writing
from rotavg_ros.datasets.files.pose_graph_rows import ANGULAR_DIAGONAL, lay_out, rotation_of, without_position
from rotavg_ros.datasets.files.text_rows import (
    Row,
    parse_rows,
    read_blocks,
    refuse,
    shown,
    unit_quaternions,
    write_rows,
    wrong_width,
)
from rotavg_ros.datasets.planar import quaternion_of_heading
from rotavg_ros.rotations import inverse
from rotavg_ros.view_graph import MAX_TRANSLATION, EdgeKind

# Where the entries of a planar information matrix, in the order xx xy xθ yy yθ θθ, are in the 21 of a spatial one.
_PLANAR_ENTRIES = (0, 1, 5, 6, 10, 20)


@dataclass(frozen=True)
class EdgeTag:
    """How the numbers after an edge's two ids, and those of its switch, are laid out."""

    translation: int  # how many numbers: x y, or x y z
    rotation: int  # θ, roll pitch yaw, or qx qy qz qw
    information: tuple[int, ...]  # which of the 21 entries of the upper triangle, row by row, each number is
    is_square_root: bool = False
    switch: int = 0  # how many numbers of an optimiser's own come before: a switch's id, or a weight

    @property
    def planar(self) -> bool:
        return self.rotation == 1


EDGE_TAGS = {
    b"EDGE_SE2": EdgeTag(2, 1, _PLANAR_ENTRIES),
    b"EDGE2": EdgeTag(2, 1, (0, 1, 6, 20, 5, 10)),  # TORO: xx xy yy θθ xθ yθ
    b"ODOMETRY": EdgeTag(2, 1, _PLANAR_ENTRIES, is_square_root=True),  # iSAM
    b"EDGE_SE3:QUAT": EdgeTag(3, 4, tuple(range(21))),
    b"EDGE3": EdgeTag(3, 3, tuple(range(21))),  # TORO
    b"EDGE_SE2_SWITCHABLE": EdgeTag(2, 1, _PLANAR_ENTRIES, switch=1),  # Vertigo and RTAB-Map
    b"EDGE_SE2_MAXMIX": EdgeTag(2, 1, _PLANAR_ENTRIES, switch=1),  # Vertigo
    b"EDGE_SE3_SWITCHABLE": EdgeTag(3, 4, tuple(range(21)), switch=1),  # RTAB-Map and Vertigo's later versions
    b"EDGE_SE3:QUAT_SWITCHABLE": EdgeTag(3, 4, tuple(range(21)), switch=1),  # Vertigo's first
}
# Numbers after the id. Only the id is used: poses in a file are an estimate, not a measurement.
VERTEX_TAGS = {b"VERTEX_SE2": 3, b"VERTEX2": 3, b"VERTEX_SE3:QUAT": 7, b"VERTEX3": 6}
# Lines without information on relative rotations between poses: landmarks, priors, an optimiser's switches, planes.
SKIPPED_TAGS = frozenset(
    b"FIX LANDMARK VERTEX_XY VERTEX_XYZ VERTEX_TRACKXYZ VERTEX_POINT_XYZ VERTEX_TAG VERTEX_PLANE VERTEX_SWITCH "
    b"EDGE_XY EDGE_SE2_XY EDGE_SE2_XY_CALIB EDGE_BEARING_SE2_XY EDGE_SE3_XYZ EDGE_SE3_TRACKXYZ EDGE_POINT_XYZ "
    b"EDGE_PRIOR_SE2 EDGE_PRIOR_SE2_XY EDGE_SE2_PRIOR EDGE_PRIOR_SE3 EDGE_SE3_PRIOR EDGE_SWITCH_PRIOR "
    b"EDGE_POINTXY_PRIOR EDGE_POINTXYZ_PRIOR EDGE_XY_PRIOR EDGE_XYZ_PRIOR "
    b"EDGE_SE3_PRIORXY EDGE_SE3_PRIORXYZ EDGE_SE3_PRIORVEC EDGE_SE3_PRIORQUAT EDGE_SE3_PLANE "
    b"EDGE_PLANE_PRIOR_NORMAL EDGE_PLANE_PRIOR_DISTANCE EDGE_PLANE_IDENTITY EDGE_PLANE_PARALLEL "
    b"EDGE_PLANE_PERPENDICULAR ROBOTLASER1 RAWLASER1".split()
)
# Beyond this, rad, a double resolves angles to 1e-7 at best: such a number is not an angle.
_MAX_ANGLE = 1e9
# TORO's tag for two vertices that are the same.
_SAME_PLACE = b"EQUIV"


def read(path: Path) -> GraphFile:
    """Read a pose graph of EDGE_SE2, EDGE_SE3:QUAT, TORO's, iSAM's and Vertigo's edges.

    Landmarks, priors, parameters and self-edges are skipped and counted. Precision is Iθθ, or the mean of the
    three angular diagonal entries; information is the 3 × 3 block, for spatial edges that are not equally exact about
    all axes. Translations are None if none is known.

    Raises:
        GraphFileError: the message names the faulty line.
    """
    skipped: Counter[str] = Counter()
    lone_ids: list[np.ndarray] = []
    edges: list[_Edges] = []
    edge_tags: set[bytes] = set()
    for block in read_blocks(path):
        by_tag: dict[bytes, tuple[list[int], list[Row]]] = {}
        for line, (tag, *row) in block:
            lines, rows = by_tag.setdefault(tag, ([], []))
            lines.append(line)
            rows.append(row)
        for tag, (lines, rows) in by_tag.items():
            if tag in EDGE_TAGS:
                edge_tags.add(tag)
                edges.append(_parse_edges(path, EDGE_TAGS[tag], lines, rows))
            elif tag in VERTEX_TAGS:
                lone_ids.append(_parse_vertices(path, VERTEX_TAGS[tag], lines, rows))
            elif tag in SKIPPED_TAGS or tag.startswith(b"PARAMS"):
                skipped[tag.decode("ascii", "backslashreplace")] += len(lines)
            else:
                raise GraphFileError.at(path, lines[0], _unknown(tag))
    if not edges:
        raise GraphFileError.at(path, None, "no edges between poses; there is nothing to solve")
    every = _Edges.concatenate(edges)
    self_edge = every.ids[:, 0] == every.ids[:, 1]
    if self_edge.any():
        skipped["self-edge"] = int(self_edge.sum())
        lone_ids.append(every.ids[self_edge, 0])
        every = every.select(~self_edge)
        if not len(every.line):
            raise GraphFileError.at(path, None, "every edge joins a pose with itself; there is nothing to solve")
    consecutive = joins_consecutive(every.ids[:, 0], every.ids[:, 1])
    planar = all(EDGE_TAGS[tag].planar for tag in edge_tags)
    graph_file = GraphFile.from_ids(
        every.ids[:, 0],
        every.ids[:, 1],
        inverse(torch.from_numpy(every.source_from_target)).numpy(),
        lone_ids=np.concatenate(lone_ids) if lone_ids else None,
        kind=np.where(consecutive & ~every.has_switch, EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE),
        precision=every.precision,
        planar=planar,
        edge_translation=None if np.isnan(every.translation).all() else every.translation,
        edge_information=every.information,
        information=None if planar else rotation_of(every.information),
        skipped=dict(skipped),
    )
    return replace(graph_file, warnings=_doubts(every))


@dataclass(frozen=True)
class _Edges:
    """Parsed edge lines, K rows each."""

    line: np.ndarray
    ids: np.ndarray
    source_from_target: np.ndarray
    translation: np.ndarray
    information: np.ndarray
    precision: np.ndarray
    has_switch: np.ndarray
    beyond_turn: np.ndarray

    @classmethod
    def concatenate(cls, parts: list[_Edges]) -> _Edges:
        """All edges in the order of their lines."""
        together = cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))
        return together.select(np.argsort(together.line))

    def select(self, rows: np.ndarray) -> _Edges:
        return _Edges(*(getattr(self, f.name)[rows] for f in fields(self)))


def _doubts(edges: _Edges) -> tuple[str, ...]:
    """Why the edges may not be what was meant: nobody measures more than a whole turn, but 30° read as rad are."""
    lines = edges.line[edges.beyond_turn]
    if not len(lines):
        return ()
    return (
        f"{len(lines)} of {len(edges.line)} edges (the first in line {lines[0]}) with an angle of more than "
        "a whole turn; angles are in radians: if these are degrees, convert them",
    )


def _unknown(tag: bytes) -> str:
    """What is wrong with a line with that tag, and what to do."""
    if tag == _SAME_PLACE:
        return "EQUIV, two vertices that are one, is not read; remove it or state an edge of no turn between them"
    known = ", ".join(sorted(known.decode() for known in EDGE_TAGS))
    return f"unknown tag {shown(tag)}; is this a g2o file? Edges may be {known}"


def _parse_edges(path: Path, tag: EdgeTag, lines: list[int], rows: list[Row]) -> _Edges:
    num_pose = tag.translation + tag.rotation
    ids, numbers = parse_rows(path, lines, rows, 2, tag.switch + num_pose + len(tag.information))
    translation, rotation, stated = np.split(numbers[:, tag.switch :], [tag.translation, num_pose], axis=1)
    if tag.rotation != 4:
        too_large = (np.abs(rotation) > _MAX_ANGLE).any(axis=1)
        refuse(path, lines, too_large, f"an angle of more than {_MAX_ANGLE:g} rad; remove the line")
    if tag.planar:
        source_from_target = quaternion_of_heading(rotation[:, 0])
        translation = np.pad(translation, ((0, 0), (0, 1)))
    elif tag.rotation == 4:
        source_from_target = unit_quaternions(path, lines, rotation)
    else:
        source_from_target = Rotation.from_euler("xyz", rotation).as_quat()
    too_long = (np.abs(translation) > MAX_TRANSLATION).any(axis=1)
    refuse(path, lines, too_long, f"a translation of more than {MAX_TRANSLATION:g} m; remove the line")
    with np.errstate(over="ignore"):  # absurdly large entries become inf, which counts as unknown
        information = np.zeros((len(rows), 21))
        information[:, tag.information] = _squared(stated) if tag.is_square_root else stated
        precision = information[:, 20] if tag.planar else information[:, ANGULAR_DIAGONAL].mean(axis=1)
    translation[without_position(translation, information)] = np.nan
    has_switch = np.full(len(rows), tag.switch > 0)
    beyond_turn = (np.abs(rotation) > 2 * np.pi).any(axis=1)  # a quaternion's numbers never are
    return _Edges(
        np.array(lines), ids, source_from_target, translation, information, precision, has_switch, beyond_turn
    )


def _squared(root: np.ndarray) -> np.ndarray:
    """``RᵀR`` of upper triangular 3 × 3 matrices, both as ``(K, 6)`` upper triangles, row by row.

    Zero where Rθθ is zero: the entries are then in another program's order, which is unknown.
    """
    xx, xy, xt, yy, yt, tt = root.T
    information = (xx * xx, xx * xy, xx * xt, xy * xy + yy * yy, xy * xt + yy * yt, xt * xt + yt * yt + tt * tt)
    return np.asarray(np.where(tt > 0, information, 0).T)


def _parse_vertices(path: Path, num_values: int, lines: list[int], rows: list[Row]) -> np.ndarray:
    """Ids of the vertices. Their poses may be anything: a diverged estimate does not affect the measurements."""
    for line, row in zip(lines, rows, strict=True):
        if len(row) != 1 + num_values:
            raise GraphFileError.at(path, line, wrong_width(len(row), 1 + num_values))
    return parse_rows(path, lines, [row[:1] for row in rows], 1, 0)[0][:, 0]


def write(
    path: Path,
    graph_file: GraphFile,
    body_from_world: np.ndarray | None = None,
    position: np.ndarray | None = None,
) -> None:
    """Write EDGE_SE2 or EDGE_SE3:QUAT lines, after VERTEX lines that chain the edges' translations.

    The format has no unknown precision (written as 1) and no edge kind (consecutive ids are odometry). Unknown
    translations are zeros with practically no information.

    Args:
        body_from_world: ``(N, 4)`` xyzw orientations of the vertices; default: those a breadth-first tree of
            the edges, odometry first, gives.
        position: ``(N, 3)`` metres, of the vertices; default: chained likewise.
    """
    poses = lay_out(graph_file, body_from_world, position)
    with writing(path) as temporary, temporary.open("w", encoding="ascii") as file:
        if graph_file.planar:
            write_rows(file, f"VERTEX_SE2 %d{' %.15g' * 3}\n", [poses.ids, *poses.planar_vertices])
            columns = [*poses.ends, *poses.planar_edges, poses.information[:, _PLANAR_ENTRIES]]
            write_rows(file, f"EDGE_SE2 %d %d{' %.15g' * 9}\n", columns)
        else:
            columns = [poses.ids, poses.position, poses.world_from_body]
            write_rows(file, f"VERTEX_SE3:QUAT %d{' %.15g' * 7}\n", columns)
            columns = [*poses.ends, poses.translation, poses.source_from_target, poses.information]
            write_rows(file, f"EDGE_SE3:QUAT %d %d{' %.15g' * 28}\n", columns)


def not_stored(graph_file: GraphFile) -> list[str]:
    """The parts of this graph that the format cannot store, in words."""
    graph = graph_file.graph
    lost = {
        "which edges are odometry (consecutive ids will be)": bool(
            (graph.is_odometry.cpu().numpy() != graph_file.consecutive).any()
        ),
        "that precisions are unknown (written as 1)": bool(graph.precision.isnan().any()),
    }
    return [name for name, is_lost in lost.items() if is_lost] + graph_file.extras
