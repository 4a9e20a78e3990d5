"""Graphs that are sent again and again: repetitions, contradictions, verdicts, what is remembered."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace as Fields

import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.inputs import EDGE_CONVERTERS, EdgeVerdict, Source, foreign_graph
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, OnlineEstimator, RejectReason
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

from .square import (
    BODY_FROM_SENSOR,
    converter,
    edges,
    link,
    map_graph,
    pose_graph,
    pose_graph_edge,
    quaternion,
    world_from_sensor,
)


def test_graphs_that_are_sent_again_say_nothing_new() -> None:
    convert = converter("rtabmap_msgs/msg/MapGraph")
    assert len(list(convert(map_graph()))) == 4
    pruned = map_graph()
    pruned.links = [link for link in pruned.links if 2 not in (link.from_id, link.to_id)]
    pruned.links.append(link(3, 1, 2))
    assert [(edge.source.keyframe_id, edge.target.keyframe_id) for edge in edges(convert(pruned))] == [(3, 1)]
    assert list(convert(map_graph())) == []
    convert.forget()
    assert len(list(convert(map_graph()))) == 4


def test_odometry_that_contradicts_itself_is_refused() -> None:
    """A front end that begins anew numbers other places by the same ids."""
    convert = converter("rtabmap_msgs/msg/MapGraph")
    list(convert(map_graph()))

    def again(turned_deg: float) -> list[object]:
        graph = map_graph()
        turned = world_from_sensor(0).inv() * world_from_sensor(1) * Rotation.from_euler("y", turned_deg, degrees=True)
        graph.links = [link(0, 1, 0)]
        graph.links[0].transform.rotation = quaternion(turned)
        return edges(convert(graph))

    assert len(again(2.0)) == 1 and isinstance(again(3.0)[0], EdgeMeasurement)
    assert again(30.0) == again(30.0) == [RejectReason.CONTRADICTORY_ODOMETRY]
    convert.forget()
    assert isinstance(again(30.0)[0], EdgeMeasurement)


@pytest.mark.parametrize("turned_deg", [0.0, 3.0, 30.0])
@pytest.mark.parametrize("is_loaded", [False, True])
def test_odometry_that_contradicts_the_graph_is_refused_whoever_told_of_it(
    turned_deg: float, is_loaded: bool, tmp_path: Path
) -> None:
    """A robot is switched off and on, and its front end begins anew; or another topic has been faster."""
    online = Reader().online
    for record in converter("rtabmap_msgs/msg/MapGraph")(map_graph()):
        assert online.add_edge(record.edge) is None
    if is_loaded:
        online.save(tmp_path / "state.npz")
        online = Reader().online
        online.load(tmp_path / "state.npz")
    before = online.snapshot().graph
    source = Source("b", body_from_sensor=tuple(BODY_FROM_SENSOR.as_quat()), odometry_between=online.odometry_between)
    convert, turn = EDGE_CONVERTERS["rtabmap_msgs/msg/MapGraph"](source), Rotation.from_euler("y", turned_deg, True)
    graph = map_graph()
    graph.links = [link(0, 1, 0)]
    graph.links[0].transform.rotation = quaternion(world_from_sensor(0).inv() * world_from_sensor(1) * turn)
    (record,) = convert(graph)
    if turned_deg > 10:
        assert record.edge is RejectReason.CONTRADICTORY_ODOMETRY
    else:
        assert online.add_edge(record.edge) is (RejectReason.DUPLICATE_EDGE if turned_deg == 0 else None)
    assert online.snapshot().graph.num_edges == before.num_edges + (turned_deg == 3)
    assert online.odometry_between(("b", 1), ("b", 0)) is online.odometry_between(("b", 0), ("b", 7)) is None


@pytest.mark.parametrize("later_s", [0, 1000])
def test_a_sender_that_begins_anew_is_told_by_its_keyframes_stamps(later_s: int) -> None:
    """Its robot turns as it did before, but for two degrees: a refinement, or steps of another drive."""
    online, convert = Reader().online, converter("pose_graph_tools_msgs/msg/PoseGraph")

    def said(graph: Fields) -> list[object]:
        records = [record.edge for record in convert(graph)]
        return [online.add_edge(edge) for edge in records if edge.kind == EdgeKind.ODOMETRY]

    assert said(pose_graph(1)) == [None] * 3
    again, turn = pose_graph(1), Rotation.from_euler("y", 2.0, degrees=True)
    for node in again.nodes:
        node.header.stamp.sec += later_s
    for key, edge in enumerate(again.edges[1:]):
        edge.pose.orientation = quaternion(world_from_sensor(key).inv() * world_from_sensor(key + 1) * turn)
    assert said(again) == [RejectReason.CONTRADICTORY_ODOMETRY if later_s else None] * 3


def test_a_senders_verdict_on_a_closure() -> None:
    convert = converter("pose_graph_tools_msgs/msg/PoseGraph")
    closure = edges(convert(pose_graph(1)))[-1]
    rejected = list(convert(pose_graph(3)))
    assert rejected == [EdgeVerdict("b", closure.edge_id, EdgeLabel.REJECTED)]
    assert list(convert(pose_graph(3))) == []
    assert list(convert(pose_graph(1))) == [EdgeVerdict("b", closure.edge_id, EdgeLabel.AUTOMATIC)]
    late = converter("pose_graph_tools_msgs/msg/PoseGraph")
    assert list(late(pose_graph(3)))[-1] == rejected[0]


def test_a_verdict_is_sent_again_with_a_closure_that_was_given_up() -> None:
    """Where a full graph had no room for it, nothing of it was kept, nor the verdict."""
    convert = converter("pose_graph_tools_msgs/msg/PoseGraph")
    closure, verdict = list(convert(pose_graph(3)))[-2:]
    convert.note_given_up(closure.edge.source, closure.edge.target)
    assert list(convert(pose_graph(3))) == [closure, verdict]
    assert list(convert(pose_graph(3))) == []


def closures_between(*ends: tuple[int, int]) -> Fields:
    """The graph of the square, all of whose closures are others."""
    graph = map_graph()
    graph.links = [each for each in graph.links if each.type == 0] + [link(*each, 1) for each in ends]
    return graph


def test_a_verdict_is_about_the_closure_to_one_robot() -> None:
    convert = converter("pose_graph_tools_msgs/msg/PoseGraph")
    online = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), solver=lambda *_, **__: None)

    def robots_graph(*kinds: int) -> Fields:
        """Every robot drives, and robot a closes a loop with each, at the same keyframes."""
        graph = pose_graph(1)
        graph.edges = [pose_graph_edge(key, key + 1, 0) for key in range(3) for _ in range(3)]
        graph.edges += [pose_graph_edge(3, 0, kind) for kind in kinds]
        for robot, edge in enumerate(graph.edges):
            edge.robot_to = robot % 3
            edge.robot_from = 0 if edge.key_from == 3 else edge.robot_to
        return graph

    for kinds in ((1, 1, 1), (1, 1, 3)):
        graph = robots_graph(*kinds)
        for record in convert(graph):
            if isinstance(record, EdgeVerdict):
                assert online.label_edge(record.source_robot, record.edge_id, record.label) == 1
            else:
                assert online.add_edge(record.edge) is None
    snapshot = online.snapshot()
    robot = snapshot.keyframe_robot[snapshot.graph.target[-3:].numpy()]
    assert [snapshot.robots[index] for index in robot] == ["a", "b", "c"]
    assert snapshot.graph.label[-3:].tolist() == [EdgeLabel.AUTOMATIC, EdgeLabel.AUTOMATIC, EdgeLabel.REJECTED]
    names = [convert.closure_name(edge) for edge in graph.edges[-3:]]
    assert names == [("a", number) for number in snapshot.edge_id[-3:].tolist()]


class Reader:
    """Takes whole graphs as the node does; the next odometry comes ``pending_timeout_s`` later."""

    def __init__(self, **options: object) -> None:
        known = EstimatorOptions(keyframe_source="edges", **options)
        self.online = OnlineEstimator(known, solver=lambda *_, **__: None)
        self.convert = converter("rtabmap_msgs/msg/MapGraph")
        self._seconds = 1000

    def reads(self, graph: Fields) -> int:
        """How many edges are new to the reader."""
        for ends in self.online.pop_given_up():
            self.convert.note_given_up(*ends)
        records = list(self.convert(graph))
        for record in records:
            self.online.add_edge(record.edge)
        return len(records)

    def time_passes(self) -> None:
        for _ in range(400):
            self._seconds += 1
            self.online.add_odometry("b", self._seconds * 10**9, (0.0, 0.0, 0.0, 1.0))


def test_a_closure_whose_keyframe_came_too_late_is_new_when_it_is_sent_again() -> None:
    """RTAB-Map leaves nodes out when it optimises, and takes them in again."""
    reader = Reader(pending_timeout_s=300.0)
    assert reader.reads(closures_between((0, 7))) == 4
    reader.time_passes()
    assert reader.online.counts().rejected == {"pending_timeout": 1}
    whole = closures_between((0, 7))
    whole.links += [link(3 + step, 4 + step, 0) for step in range(4)]
    assert [reader.reads(whole) for _ in range(3)] == [5, 0, 0]
    counts = reader.online.counts()
    assert counts.edges == 8 and counts.pending == 0 and counts.rejected == {"pending_timeout": 1}


def test_a_closure_that_had_to_go_for_others_is_new_when_it_is_sent_again() -> None:
    reader = Reader(pending_capacity=1)
    reader.reads(closures_between((0, 7), (1, 8)))
    assert reader.online.counts().rejected == {"pending_overflow": 1}
    whole = closures_between((0, 7), (1, 8))
    whole.links += [link(3 + step, 4 + step, 0) for step in range(5)]
    assert [reader.reads(whole) for _ in range(2)] == [6, 0]
    assert reader.online.counts().edges == 10 and reader.online.counts().pending == 0


def test_what_a_full_graph_refuses_is_new_when_it_is_sent_again() -> None:
    reader = Reader(max_edges=3)
    assert reader.reads(closures_between((0, 2))) == 4
    assert reader.online.counts().rejected == {"graph_full": 1}
    reader.online.set_options(EstimatorOptions(keyframe_source="edges"))
    assert [reader.reads(closures_between((0, 2))) for _ in range(2)] == [1, 0]
    assert reader.online.counts().edges == 4


def test_what_is_remembered_is_bounded(monkeypatch) -> None:
    monkeypatch.setattr(foreign_graph, "_MOST_REMEMBERED", 10)
    convert = converter("rtabmap_msgs/msg/MapGraph")
    for number in range(100):
        graph = map_graph()
        for each in graph.links:
            each.from_id, each.to_id = each.from_id + 4 * number, each.to_id + 4 * number
        assert len(list(convert(graph))) == 4
    assert len(list(convert(map_graph()))) == 4  # the first ones are forgotten
