"""Writes a view-graph as a bag, from which :mod:`rotavg_ros.bags.graph_from_bag` reads it back without loss.

Topics: ``/relative_rotations`` carries every edge, odometry included, by the id and the stamp of both ends;
``/odom`` is odometry chained (where there is odometry); ``/ground_truth`` is there if the file has it.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.bags.message_types import ODOMETRY, RELATIVE_ROTATION
from rotavg_ros.bags.messages import (
    Edge,
    Keyframe,
    edge_message,
    odometry_message,
)
from rotavg_ros.bags.topics import EDGE_TOPIC, GRAPH_NOTE, ODOM_TOPIC, TRUTH_TOPIC
from rotavg_ros.bags.writer import BagWriteError, BagWriter
from rotavg_ros.datasets.dead_reckoning import chain_poses
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.stamps import NANOSECONDS

# First stamp for a graph without stamps, which get one keyframe every 0.1 s.
START_STAMP_NS = 1_700_000_000_000_000_000
DEFAULT_PERIOD_NS = 100_000_000
# Seconds of a message's stamp are signed 32-bit, and a recording's times are unsigned.
_END_OF_TIME_NS = 2**31 * NANOSECONDS


def write_graph_bag(path: str | Path, graph_file: GraphFile, *, overwrite: bool = False) -> None:
    """Write a graph as a rosbag2 MCAP folder; each edge is published when the later of its ends exists.

    Raises:
        BagWriteError: the folder exists (without ``overwrite``), its place cannot be written, or a message cannot hold
            a stamp.
    """
    graph = graph_file.graph
    stamps_ns = graph_file.stamps_ns
    if stamps_ns is None:
        stamps_ns = START_STAMP_NS + DEFAULT_PERIOD_NS * np.arange(graph.num_nodes)
    _check_stamps(Path(path), graph_file.node_ids, stamps_ns)
    source, target = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    published_ns = np.maximum(stamps_ns[source], stamps_ns[target])
    # Order at one instant: odometry, ground truth, then measurements.
    events: list[tuple[int, int, int]] = []
    has_odometry = bool(graph.is_odometry.any())
    if has_odometry:
        events += [(int(stamp), 0, node) for node, stamp in enumerate(stamps_ns)]
    truth_position, truth_orientation = _truth(graph_file)
    truth_known = np.isfinite(truth_orientation).all(axis=1)
    if graph_file.position_gt is not None:
        truth_known |= np.isfinite(truth_position).all(axis=1)
    truth_known = np.isin(stamps_ns, stamps_ns[truth_known])  # nodes of one stamp are told apart by their order
    events += [(int(stamps_ns[node]), 1, int(node)) for node in np.flatnonzero(truth_known)]
    events += [(int(stamp), 2, edge) for edge, stamp in enumerate(published_ns)]

    with BagWriter(path, overwrite=overwrite) as bag:
        bag.set_note(GRAPH_NOTE, json.dumps(_note(graph_file, stamps_ns)))
        bag.add_topic(EDGE_TOPIC, RELATIVE_ROTATION)
        if has_odometry:
            bag.add_topic(ODOM_TOPIC, ODOMETRY)
        if truth_known.any():
            bag.add_topic(TRUTH_TOPIC, ODOMETRY)
        odom_position, odom_orientation = _dead_reckoning(graph_file) if has_odometry else (None, None)
        edges = _edges(graph_file, stamps_ns, published_ns)
        sequence = 0
        for stamp, what, index in sorted(events):
            if what == 0:
                assert odom_position is not None and odom_orientation is not None
                message = odometry_message(stamp, odom_position[index], odom_orientation[index], "odom")
                bag.write(ODOM_TOPIC, stamp, message)
            elif what == 1:
                message = odometry_message(stamp, truth_position[index], truth_orientation[index], "map")
                bag.write(TRUTH_TOPIC, stamp, message)
            else:
                sequence += 1
                bag.write(EDGE_TOPIC, stamp, edge_message(replace(edges[index], sequence=sequence)))


def _check_stamps(path: Path, node_ids: NDArray[np.int64], stamps_ns: NDArray[np.int64]) -> None:
    bad = np.flatnonzero((stamps_ns < 0) | (stamps_ns >= _END_OF_TIME_NS))
    if len(bad):
        stamp = f"node {node_ids[bad[0]]} has the stamp {stamps_ns[bad[0]] / 1e9:.15g} s"
        raise BagWriteError(f"{path}: {stamp}; a bag's stamps lie between 1970 and 2038: give others with --stamps")


def _note(graph_file: GraphFile, stamps_ns: NDArray[np.int64]) -> dict[str, object]:
    graph = graph_file.graph
    lone = np.ones(graph.num_nodes, dtype=bool)
    lone[graph.source.numpy()] = lone[graph.target.numpy()] = False
    return {
        "planar": graph_file.planar,
        "stamps": graph_file.stamps_ns is not None,
        "position_gt": graph_file.position_gt is not None,
        "lone_ids": graph_file.node_ids[lone].tolist(),
        "lone_stamps_ns": stamps_ns[lone].tolist(),
    }


def _dead_reckoning(graph_file: GraphFile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    translation = graph_file.edge_translation
    if translation is None:
        translation = np.zeros((graph_file.graph.num_edges, 3))
    return chain_poses(graph_file.graph, translation)


def _truth(graph_file: GraphFile) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions, the origin for a file without any, and world-from-body orientations; NaN rows where unknown."""
    position = np.zeros((graph_file.graph.num_nodes, 3)) if graph_file.position_gt is None else graph_file.position_gt
    orientation = np.full((len(position), 4), np.nan)
    if graph_file.body_from_world_gt is not None:
        known = np.isfinite(graph_file.body_from_world_gt).all(axis=1)
        orientation[known] = Rotation.from_quat(graph_file.body_from_world_gt[known]).inv().as_quat(canonical=True)
    return position, orientation


def _edges(graph_file: GraphFile, stamps_ns: NDArray[np.int64], published_ns: NDArray[np.int64]) -> list[Edge]:
    graph = graph_file.graph
    keyframes = list(map(Keyframe, graph_file.node_ids.tolist(), stamps_ns.tolist()))
    source_from_target = graph.target_from_source.cpu().numpy() * [-1, -1, -1, 1]
    columns = (graph.source, graph.target, graph.precision, graph.kind)
    translation = graph_file.edge_translation
    return [
        Edge(
            stamp,
            index,
            0,
            keyframes[source],
            keyframes[target],
            rotation,
            precision,
            kind,
            None if translation is None else translation[index],
        )
        for index, (stamp, rotation, source, target, precision, kind) in enumerate(
            zip(published_ns.tolist(), source_from_target, *(column.tolist() for column in columns), strict=True)
        )
    ]
