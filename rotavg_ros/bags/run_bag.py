"""A simulated run as the bag that a robot would have recorded."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rotavg_ros.bags.message_types import ODOMETRY, RELATIVE_ROTATION
from rotavg_ros.bags.messages import Edge, Keyframe, edge_message, odometry_message
from rotavg_ros.bags.topics import EDGE_TOPIC, ODOM_TOPIC, TRUTH_TOPIC
from rotavg_ros.bags.writer import BagWriter
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun


def write_run_bag(path: str | Path, run: SimulatedRun, *, overwrite: bool = False) -> None:
    """Write ``/odom`` and ``/ground_truth`` at every pose, and loop closures by stamp on ``/relative_rotations``.

    Odometry edges are not published: subscribers make keyframes from ``/odom``.

    Raises:
        BagWriteError: the folder exists (without ``overwrite``), or its place cannot be written.
    """
    graph, stamps_ns = run.graph, run.stamps_ns.tolist()
    closures = np.flatnonzero(~graph.is_odometry.numpy())
    source, target = graph.source.numpy()[closures], graph.target.numpy()[closures]
    source_from_target = graph.target_from_source.numpy()[closures] * [-1, -1, -1, 1]
    precision = graph.precision.numpy()[closures]
    known_at = np.maximum(source, target)
    # Closures are ordered by their later end, so those of pose k are a slice.
    first = np.searchsorted(known_at, np.arange(len(stamps_ns) + 1))

    with BagWriter(path, overwrite=overwrite) as bag:
        bag.add_topic(ODOM_TOPIC, ODOMETRY)
        bag.add_topic(EDGE_TOPIC, RELATIVE_ROTATION)
        bag.add_topic(TRUTH_TOPIC, ODOMETRY)
        for pose, stamp in enumerate(stamps_ns):
            odometry = run.odometry_position[pose], run.odometry_world_from_body[pose]
            bag.write(ODOM_TOPIC, stamp, odometry_message(stamp, *odometry, "odom"))
            bag.write(TRUTH_TOPIC, stamp, odometry_message(stamp, run.position[pose], run.world_from_body[pose], "map"))
            for index in range(first[pose], first[pose + 1]):
                edge = Edge(
                    stamp_ns=stamp,
                    id=index,
                    sequence=index + 1,
                    source=Keyframe(None, stamps_ns[source[index]]),
                    target=Keyframe(None, stamps_ns[target[index]]),
                    source_from_target=source_from_target[index],
                    precision=float(precision[index]),
                    kind=int(graph.kind[closures[index]]),
                    translation=run.edge_translation[closures[index]],
                )
                bag.write(EDGE_TOPIC, stamp, edge_message(edge))
