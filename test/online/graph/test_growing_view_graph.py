from __future__ import annotations

import numpy as np
import torch

from rotavg_ros.online.graph.growing_view_graph import GrowingViewGraph
from rotavg_ros.online.graph.snapshot import GraphEdge
from rotavg_ros.online.growing_array import GrowingArray
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

IDENTITY = (0.0, 0.0, 0.0, 1.0)


def chain(length: int) -> GrowingViewGraph:
    graph = GrowingViewGraph()
    for index in range(length):
        graph.add_keyframe("r", index, 10 * index)
        if index:
            graph.add_edge(GraphEdge(index - 1, index, IDENTITY, EdgeKind.ODOMETRY, edge_id=index))
    return graph


def test_a_view_outlives_growth():
    array = GrowingArray(np.int64)
    array.extend(np.arange(64))
    view = array.view
    for value in range(64, 500):
        array.append(value)
    np.testing.assert_array_equal(view, np.arange(64))
    np.testing.assert_array_equal(array.view, np.arange(500))


def test_a_snapshot_does_not_change():
    graph = chain(3)
    snapshot = graph.snapshot()
    graph.label_edges("r", 1, EdgeLabel.REJECTED)
    graph.add_keyframe("r", 3, 30)
    graph.add_edge(GraphEdge(0, 3, IDENTITY, EdgeKind.LOOP_CLOSURE, edge_id=9, precision=4.0))
    assert snapshot.graph.num_nodes == 3 and snapshot.graph.num_edges == 2
    assert snapshot.graph.label.tolist() == [EdgeLabel.AUTOMATIC] * 2
    now = graph.snapshot()
    assert now.graph.label.tolist() == [EdgeLabel.REJECTED, 0, 0]
    assert now.graph.kind.tolist() == [0, 0, 1]
    assert torch.isnan(now.graph.precision).tolist() == [True, True, False]
    assert now.revision > snapshot.revision


def test_keys_of_several_robots_and_ids_up_to_64_bits():
    graph = GrowingViewGraph()
    first = graph.add_keyframe("a", 2**64 - 1)
    second = graph.add_keyframe("b", 2**64 - 1)
    assert (first, second) == (0, 1)
    assert graph.add_keyframe("a", 2**64 - 1) == 0
    assert graph.node("a", 2**64 - 1) == 0 and graph.node("c", 0) is None
    assert graph.snapshot().keyframe_id.tolist() == [2**64 - 1] * 2
    assert graph.snapshot().robots == ("a", "b")
    assert graph.robot_of(1) == "b"


def test_lookup_by_stamp_when_keyframes_came_out_of_order():
    graph = GrowingViewGraph()
    for keyframe_id, stamp in ((0, 50), (1, 10), (2, 30)):
        graph.add_keyframe("r", keyframe_id, stamp)
    assert [graph.keyframe_at_or_before("r", stamp, 0) for stamp in (9, 10, 29, 30, 49, 50, 99)] == [
        None, 1, 1, 2, 2, 0, 0,
    ]  # fmt: skip
    assert graph.first_keyframe("r", 0) == 1
    assert [list(graph.nodes_newest_first("r", 0, *reach)) for reach in ((0, 99), (10, 30), (11, 49), (51, 99))] == [
        [0, 2, 1], [2, 1], [2], [],
    ]  # fmt: skip
    assert list(graph.nodes_newest_first("r", 1, 0, 99)) == list(graph.nodes_newest_first("s", 0, 0, 99)) == []


def test_a_stamp_may_be_learnt_later_but_not_changed():
    graph = GrowingViewGraph()
    graph.add_keyframe("r", 5)
    assert graph.snapshot().stamp_ns.tolist() == [-1]
    graph.add_keyframe("r", 5, 70)
    graph.add_keyframe("r", 5, 80)
    assert graph.snapshot().stamp_ns.tolist() == [70]
    assert graph.keyframe_at_or_before("r", 75, 0) == 0


def test_labels_hit_all_edges_with_the_id_of_that_robot_only():
    graph = chain(3)
    graph.add_keyframe("s", 0)
    graph.add_edge(GraphEdge(3, 0, IDENTITY, EdgeKind.LOOP_CLOSURE, edge_id=1))
    graph.add_edge(GraphEdge(0, 2, IDENTITY, EdgeKind.LOOP_CLOSURE, edge_id=1))
    assert graph.label_edges("r", 1, EdgeLabel.ACCEPTED) == 2
    assert graph.snapshot().graph.label.tolist() == [1, 0, 0, 1]
    revision = graph.revision
    assert graph.label_edges("r", 1, EdgeLabel.ACCEPTED) == 2
    assert graph.revision == revision
    assert graph.label_edges("unknown", 1, EdgeLabel.ACCEPTED) == 0


def test_from_snapshot():
    graph = chain(70)
    copy = GrowingViewGraph.from_snapshot(graph.snapshot())
    copy.add_keyframe("r", 70, 700)
    assert (copy.num_keyframes, graph.num_keyframes) == (71, 70)
    assert copy.keyframe_at_or_before("r", 695, 0) == 69
    np.testing.assert_array_equal(copy.snapshot().edge_id, graph.snapshot().edge_id)
