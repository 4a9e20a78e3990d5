"""Memory is bounded: whatever comes, and for however long, nothing grows beyond its limit."""

from __future__ import annotations

import tracemalloc

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator, RejectReason

SECOND = 1_000_000_000
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def test_memory_stays_flat_however_long_it_drives() -> None:
    """Odometry at 5 Hz and a closure a second, half of them to robots that nobody knows: the second half is free."""
    options = EstimatorOptions(
        keyframe_distance=0,
        keyframe_interval_s=2.0,
        max_odometry_samples=1000,
        max_keyframes=200,
        max_edges=300,
        pending_capacity=50,
    )
    online = OnlineEstimator(options, lambda *_, **__: None)
    sizes = []
    tracemalloc.start()
    for index in range(2 * 5 * 1200):
        stamp_ns = index * SECOND // 5
        angle = 0.5 * np.sin(0.001 * index)
        online.add_odometry("r", stamp_ns, (0.0, 0.0, np.sin(angle), np.cos(angle)), (0, 0, 0))
        if index % 5 == 0:
            target = KeyframeReference("r" if index % 10 else f"ghost {index}", stamp_ns=stamp_ns)
            source = KeyframeReference("r", stamp_ns=max(0, stamp_ns - 10 * SECOND))
            online.add_edge(EdgeMeasurement(index, source, target, IDENTITY))
        if index in (5 * 1200 - 1, 2 * 5 * 1200 - 1):
            sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    counts = online.counts()
    assert counts.keyframes == 200 and counts.pending <= 50
    assert counts.edges <= 300 + 50  # those that waited are let in
    assert counts.rejected[RejectReason.GRAPH_FULL.value] > 1000
    assert sizes[1] < sizes[0] + 50_000


def test_a_full_graph_still_ties_edges_to_what_there_is() -> None:
    options = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, max_keyframes=10)
    online = OnlineEstimator(options, lambda *_, **__: None)
    rotations = [Rotation.from_rotvec([0.02 * index, 0, 0.1 * index]) for index in range(20)]
    for index, rotation in enumerate(rotations):
        online.add_odometry("r", index * SECOND, rotation.as_quat().tolist())
    assert online.counts().keyframes == 10 and online.current_orientation("r") is not None
    ends = [KeyframeReference("r", stamp_ns=index * SECOND) for index in (2, 18)]
    measured = (rotations[18].inv() * rotations[2]).as_quat()
    assert online.add_edge(EdgeMeasurement(1, *ends, measured)) is None
    graph = online.snapshot().graph
    assert (int(graph.source[-1]), int(graph.target[-1])) == (2, 9)
    tied = Rotation.from_quat(graph.target_from_source[-1].numpy())
    assert (tied.inv() * (rotations[9].inv() * rotations[2])).magnitude() < 1e-9
    edges = EstimatorOptions(keyframe_source="edges", unknown_keyframes="create", max_keyframes=10)
    online = OnlineEstimator(edges, lambda *_, **__: None)
    for index in range(20):
        online.add_edge(
            EdgeMeasurement(index, KeyframeReference("r", index), KeyframeReference("r", index + 1), IDENTITY, kind=0)
        )
    assert online.counts().keyframes == 10 and online.counts().pending == 11
