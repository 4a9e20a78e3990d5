"""View-graphs as npz archives of plain arrays.

Required: ``source``, ``target`` ``(M,)`` integer ids and ``target_from_source`` ``(M, 4)`` xyzw.
Optional: ``kind`` ``(M,)`` (0 odometry, 1 loop closure), ``precision`` ``(M,)`` rad⁻², ``label`` ``(M,)`` (0 automatic,
1 accepted, 2 rejected), ``steps`` ``(M,)`` of odometry that an edge stands for, ``information`` ``(M, 3, 3)`` rad⁻² of
the rotation's error in the target's frame, ``edge_translation`` ``(M, 3)``, ``edge_information`` ``(M, 21)``,
``node_ids`` ``(N,)`` (names nodes without an edge too), ``planar``; and per node, ascending by id:
``body_from_world_gt`` ``(N, 4)`` with NaN where unknown, ``stamps_ns`` ``(N,)``, ``position_gt`` ``(N, 3)``. Other
arrays are ignored.
"""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError, reading, writing
from rotavg_ros.datasets.files.text_rows import refuse, unit_quaternions
from rotavg_ros.datasets.planar import are_about_z, are_level
from rotavg_ros.view_graph import MAX_TRANSLATION, STEPS, EdgeKind, EdgeLabel, are_steps

_SHAPES: dict[str, tuple[int, ...]] = {  # of one row
    "source": (),
    "target": (),
    "target_from_source": (4,),
    "kind": (),
    "precision": (),
    "label": (),
    "steps": (),
    "information": (3, 3),
    "edge_translation": (3,),
    "edge_information": (21,),
    "node_ids": (),
    "body_from_world_gt": (4,),
    "stamps_ns": (),
    "position_gt": (3,),
}
_REQUIRED = ("source", "target", "target_from_source")
_INTEGER = ("source", "target", "kind", "label", "node_ids", "stamps_ns")
_OF_EDGES = ("precision", "label", "steps", "information")  # as the graph has them
_EDGE_EXTRAS = ("edge_translation", "edge_information")
_PER_NODE = ("body_from_world_gt", "stamps_ns", "position_gt")


def read(path: Path) -> GraphFile:
    """Read an npz view-graph. Self-edges are skipped and counted. Nothing is ever unpickled.

    Raises:
        GraphFileError: the message names the faulty array.
    """
    arrays, planar = _load(path)
    source, target = arrays["source"], arrays["target"]
    num_edges = len(source)
    for name in ("target", "target_from_source", "kind", *_OF_EDGES, *_EDGE_EXTRAS):
        if name in arrays and len(arrays[name]) != num_edges:
            what = f"{name} has {len(arrays[name])} rows, source has {num_edges}; they must agree"
            raise GraphFileError.at(path, None, what)
    refuse(path, None, (source < 0) | (target < 0), "a negative id; ids must be integers from 0")
    _check_node_ids(path, arrays.get("node_ids", source[:0]))
    quaternions = unit_quaternions(path, None, arrays["target_from_source"])
    if "edge_information" in arrays:
        not_finite = ~np.isfinite(arrays["edge_information"]).all(axis=1)
        refuse(path, None, not_finite, "an edge_information that is not finite; write zeros where it is unknown")
    if "edge_translation" in arrays:
        too_long = (np.abs(arrays["edge_translation"]) > MAX_TRANSLATION).any(axis=1)
        refuse(path, None, too_long, f"a translation of more than {MAX_TRANSLATION:g} m; write NaN where it is unknown")
    kind = arrays.get("kind", np.full(num_edges, EdgeKind.LOOP_CLOSURE, dtype=np.int64))
    refuse(path, None, ~np.isin(kind, list(EdgeKind)), "an unknown kind; 0 is odometry, 1 a loop closure")
    if "label" in arrays:
        is_unknown = ~np.isin(arrays["label"], list(EdgeLabel))
        refuse(path, None, is_unknown, "an unknown label; 0 is automatic, 1 accepted, 2 rejected")
    if "steps" in arrays:
        refuse(path, None, ~are_steps(arrays["steps"]), f"steps that are not between {STEPS[0]:g} and {STEPS[1]:g}")
    proper = source != target
    if not proper.any():
        raise GraphFileError.at(path, None, "no edges between nodes; there is nothing to solve")
    turns_about_z = are_about_z(quaternions)
    if planar and not turns_about_z:
        raise GraphFileError.at(path, None, "is declared planar, but has rotations that are not about z")
    graph_file = GraphFile.from_ids(
        source[proper],
        target[proper],
        quaternions[proper],
        lone_ids=np.concatenate((source[~proper], arrays.get("node_ids", source[:0]))),
        kind=kind[proper],
        planar=turns_about_z and are_level(arrays.get("edge_translation")) if planar is None else planar,
        **{name: arrays[name][proper] for name in (*_OF_EDGES, *_EDGE_EXTRAS) if name in arrays},
        skipped={} if proper.all() else {"self-edge": int((~proper).sum())},
    )
    rows: dict[str, Any] = {
        name: _rows_of_nodes(path, name, arrays, graph_file.node_ids) for name in _PER_NODE if name in arrays
    }
    if "body_from_world_gt" in rows:
        rows["body_from_world_gt"] = _ground_truth(path, rows["body_from_world_gt"])
    return replace(graph_file, **rows)


def write(path: Path, graph_file: GraphFile) -> None:
    """Write everything a :class:`GraphFile` holds, except what reading found and :attr:`GraphFile.in_no_file`."""
    graph, ids = graph_file.graph, graph_file.node_ids
    arrays: dict[str, Any] = {
        "source": ids[graph.source.cpu().numpy()],
        "target": ids[graph.target.cpu().numpy()],
        "target_from_source": graph.target_from_source.cpu().numpy(),
        "kind": graph.kind.cpu().numpy(),
        "node_ids": ids,
        "planar": np.array(graph_file.planar),
    }
    for name in _OF_EDGES:
        column = getattr(graph, name)
        if column is not None:
            arrays[name] = column.cpu().numpy()
    for name in (*_EDGE_EXTRAS, *_PER_NODE):
        values = getattr(graph_file, name)
        if values is not None:
            arrays[name] = values
    # np.savez would append .npz to the temporary name, but not to an open file.
    with writing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def not_stored(graph_file: GraphFile) -> list[str]:
    """The parts of this graph that the format cannot store, in words."""
    return graph_file.in_no_file


def _load(path: Path) -> tuple[dict[str, np.ndarray], bool | None]:
    """The known arrays, as int64 or float64 in the right shapes, and the stated planarity."""
    with reading(path):
        file = path.open("rb")
    with file:
        if not zipfile.is_zipfile(file):
            raise GraphFileError.at(path, None, "not an npz archive, or a truncated one; write it with numpy.savez")
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as archive:
                names = sorted(archive.files)
                arrays = {name: archive[name] for name in _SHAPES if name in names}
                stated_planar = archive["planar"] if "planar" in names else None
        except Exception as error:  # a damaged archive can fail anywhere in zipfile, zlib or the array headers
            reason = " ".join(str(error).split())[:120] or type(error).__name__
            raise GraphFileError.at(path, None, f"not a readable npz archive of plain arrays: {reason}") from None
    missing = [name for name in _REQUIRED if name not in arrays]
    if missing:
        has = ", ".join(names) or "nothing"
        raise GraphFileError.at(path, None, f"lacks {', '.join(missing)}; an npz view-graph needs them, this has {has}")
    return {name: _checked(path, name, array) for name, array in arrays.items()}, _truth_value(path, stated_planar)


def _truth_value(path: Path, planar: np.ndarray | None) -> bool | None:
    if planar is None:
        return None
    if planar.size != 1 or planar.dtype.kind not in "biu":
        what = f"planar holds {planar.dtype} of shape {planar.shape}; it must be one value, true or false"
        raise GraphFileError.at(path, None, what)
    return bool(planar.item())


def _checked(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    if array.ndim != 1 + len(_SHAPES[name]) or array.shape[1:] != _SHAPES[name]:
        shape = "(" + ", ".join(["rows", *map(str, _SHAPES[name])]) + ")"
        raise GraphFileError.at(path, None, f"{name} has shape {array.shape}; it must be {shape}")
    integer = name in _INTEGER
    if not (np.issubdtype(array.dtype, np.integer) or (not integer and np.issubdtype(array.dtype, np.floating))):
        needed = "integers" if integer else "numbers"
        raise GraphFileError.at(path, None, f"{name} holds {array.dtype}; it must hold {needed}")
    if integer and array.dtype == np.uint64 and (array > np.iinfo(np.int64).max).any():
        raise GraphFileError.at(path, None, f"{name} holds a value above {np.iinfo(np.int64).max}, which is too large")
    return np.asarray(array, dtype=np.int64 if integer else np.float64)


def _check_node_ids(path: Path, node_ids: np.ndarray) -> None:
    """Check that ids are non-negative and unique, since they identify the rows of nodes."""
    if (node_ids < 0).any():
        what = f"node_ids holds {node_ids.min()}; ids must be integers from 0"
        raise GraphFileError.at(path, None, what)
    ids, counts = np.unique(node_ids, return_counts=True)
    if (counts > 1).any():
        what = f"node_ids holds {ids[counts > 1][0]} more than once; name every node once"
        raise GraphFileError.at(path, None, what)


def _rows_of_nodes(path: Path, name: str, arrays: dict[str, np.ndarray], node_ids: np.ndarray) -> np.ndarray:
    """Rows ascending by id, for ``node_ids`` or the ids that occur; if there are more rows, the row is the id."""
    rows: np.ndarray = arrays[name]
    if "node_ids" in arrays and len(rows) == len(arrays["node_ids"]):
        rows = rows[np.argsort(arrays["node_ids"], kind="stable")]
    if len(rows) == len(node_ids):
        return rows
    if len(rows) > node_ids[-1]:
        return np.asarray(rows[node_ids])
    what = f"{name} has {len(rows)} rows for {len(node_ids)} nodes; give one row per node, ascending by id"
    raise GraphFileError.at(path, None, what)


def _ground_truth(path: Path, body_from_world: np.ndarray) -> np.ndarray:
    """Known rows normalised; a row with any NaN is unknown."""
    known = ~np.isnan(body_from_world).any(axis=1)
    result = np.full_like(body_from_world, np.nan)
    try:
        result[known] = unit_quaternions(path, np.flatnonzero(known), body_from_world[known])
    except GraphFileError:
        what = "body_from_world_gt has a quaternion that is not of unit length; write NaN where it is unknown"
        raise GraphFileError.at(path, None, what) from None
    return result
