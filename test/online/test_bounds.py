"""Memory is bounded: whatever comes, and for however long, nothing grows beyond its limit."""

from __future__ import annotations

import gc
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator, RejectReason
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

SECOND = 1_000_000_000
IDENTITY = (0.0, 0.0, 0.0, 1.0)


def test_memory_stays_flat_however_long_it_drives() -> None:
    """Odometry at 2 Hz and a closure a second, half of them to robots that nobody knows: the last third is free."""
    options = EstimatorOptions(
        keyframe_distance=0,
        keyframe_interval_s=2.0,
        max_odometry_samples=1000,
        max_keyframes=100,
        max_edges=300,
        pending_capacity=50,
    )
    online = OnlineEstimator(options, lambda *_, **__: None)
    blocks = []
    for index in range(3000):
        stamp_ns = index * SECOND // 2
        angle = 0.5 * np.sin(0.001 * index)
        online.add_odometry("r", stamp_ns, (0.0, 0.0, np.sin(angle), np.cos(angle)), (0, 0, 0))
        if index % 2 == 0:
            target = KeyframeReference("r" if index % 4 else f"ghost {index}", stamp_ns=stamp_ns)
            source = KeyframeReference("r", stamp_ns=max(0, stamp_ns - 10 * SECOND))
            online.add_edge(EdgeMeasurement(index, source, target, IDENTITY))
        if index in (1999, 2999):
            gc.collect()
            blocks.append(sys.getallocatedblocks())
    counts = online.counts()
    assert 90 <= counts.keyframes <= 100 and counts.edges <= 300 + 50 and counts.pending <= 50
    assert counts.marginalized > 250 and counts.dropped_closures > 50 and not counts.is_full
    assert blocks[1] < blocks[0] + 250  # Python's objects, in 1000 messages


def test_where_nothing_can_be_spared_a_full_graph_ties_edges_to_what_there_is() -> None:
    options = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, max_keyframes=2)
    online = OnlineEstimator(options, lambda *_, **__: None)
    rotations = [Rotation.from_rotvec([0.02 * index, 0, 0.1 * index]) for index in range(20)]
    for index, rotation in enumerate(rotations):
        online.add_odometry("r", index * SECOND, rotation.as_quat().tolist())
    assert online.counts().keyframes == 2 and online.counts().is_full
    ends = [KeyframeReference("r", stamp_ns=index * SECOND) for index in (0, 18)]
    measured = (rotations[18].inv() * rotations[0]).as_quat()
    assert online.add_edge(EdgeMeasurement(1, *ends, measured)) is None
    graph = online.snapshot().graph
    assert (int(graph.source[-1]), int(graph.target[-1])) == (0, 1)
    tied = Rotation.from_quat(graph.target_from_source[-1].numpy())
    assert (tied.inv() * (rotations[1].inv() * rotations[0])).magnitude() < 1e-9


def test_a_view_graph_without_odometry_stops_growing() -> None:
    edges = EstimatorOptions(unknown_keyframes="create", max_keyframes=10)
    online = OnlineEstimator(edges, lambda *_, **__: None)
    for index in range(20):
        online.add_edge(
            EdgeMeasurement(index, KeyframeReference("r", index), KeyframeReference("r", index + 1), IDENTITY)
        )
    assert online.counts().keyframes == 10 and online.counts().pending == 11 and online.counts().is_full


def test_closures_are_bounded_with_the_keyframes() -> None:
    """A robot that goes to and fro between the same keyframes closes loops for hours; what is dropped is counted."""
    options = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, max_keyframes=100)
    online = OnlineEstimator(options, lambda *_, **__: None)
    for index in range(100):
        online.add_odometry("r", index * SECOND, (0.0, 0.0, np.sin(0.01 * index), np.cos(0.01 * index)), (0, 0, 0))
    rng = np.random.default_rng(0)
    taken = 0
    for number in range(3000):
        source, target = rng.choice(100, 2, replace=False).tolist()
        ends = KeyframeReference("r", source), KeyframeReference("r", target)
        taken += online.add_edge(EdgeMeasurement(number, *ends, IDENTITY)) is None
        assert online.counts().edges <= options.most_edges == 600
    counts = online.counts()
    assert counts.keyframes <= 100 and counts.dropped_closures > 1000
    closures = counts.edges - (counts.keyframes - 1)
    assert taken == closures + counts.dropped_closures


@pytest.mark.parametrize("label", [EdgeLabel.ACCEPTED, EdgeLabel.AUTOMATIC])
def test_it_is_told_when_a_graph_is_full_of_edges_that_cannot_be_spared(label: EdgeLabel) -> None:
    """It is not full of keyframes then; and a second odometry that is stated again and again can be spared."""
    options = EstimatorOptions(keyframe_source="edges", max_keyframes=20)
    online = OnlineEstimator(options, lambda *_, **__: None)
    kind = EdgeKind.LOOP_CLOSURE if label == EdgeLabel.ACCEPTED else EdgeKind.ODOMETRY
    refused = 0
    for number in range(200):
        target = 1 + number % 10
        turned = (0.0, 0.0, np.sin(1e-3 * number), np.cos(1e-3 * number))
        ends = KeyframeReference("r", target - 1), KeyframeReference("r", target)
        of_kind = EdgeKind.ODOMETRY if number < 10 else kind
        refused += online.add_edge(EdgeMeasurement(number, *ends, turned, of_kind)) == "graph_full"
        online.label_edge("r", number, label)
        counts = online.counts()
        assert counts.edges <= options.most_edges == 120 and counts.is_full_of_edges == (refused > 0)
    assert refused == (80 if label == EdgeLabel.ACCEPTED else 0) and not counts.is_full
    assert counts.keyframes == 11 and counts.dropped_closures == 0


@pytest.mark.parametrize("at_start", [10, 2_000_000])
def test_repetitions_are_known_within_the_bound_that_holds_now(at_start: int) -> None:
    """It can be raised while the node runs; a sender that repeated its graph was then taken twice."""
    options = EstimatorOptions(keyframe_source="edges", max_edges=at_start)
    online = OnlineEstimator(options, lambda *_, **__: None)
    online.set_options(replace(options, max_edges=1000))
    keyframes = [KeyframeReference("r", number) for number in range(101)]
    steps = [EdgeMeasurement(0, *ends, IDENTITY, EdgeKind.ODOMETRY) for ends in pairwise(keyframes)]
    assert [online.add_edge(step) for step in steps] == [None] * 100
    assert [online.add_edge(step) for step in steps] == [RejectReason.DUPLICATE_EDGE] * 100
