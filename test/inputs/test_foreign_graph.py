"""Graphs that are sent again and again: repetitions, contradictions, verdicts, what is remembered."""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from rotavg_ros.inputs import EdgeVerdict, foreign_graph
from rotavg_ros.online import EdgeMeasurement, RejectReason
from rotavg_ros.view_graph import EdgeLabel

from .square import (
    converter,
    edges,
    link,
    map_graph,
    pose_graph,
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


def test_a_senders_verdict_on_a_closure() -> None:
    convert = converter("pose_graph_tools_msgs/msg/PoseGraph")
    closure = edges(convert(pose_graph(1)))[-1]
    rejected = list(convert(pose_graph(3)))
    assert rejected == [EdgeVerdict("b", closure.edge_id, EdgeLabel.REJECTED)]
    assert list(convert(pose_graph(3))) == []
    assert list(convert(pose_graph(1))) == [EdgeVerdict("b", closure.edge_id, EdgeLabel.AUTOMATIC)]
    late = converter("pose_graph_tools_msgs/msg/PoseGraph")
    assert list(late(pose_graph(3)))[-1] == rejected[0]


def test_what_is_remembered_is_bounded(monkeypatch) -> None:
    monkeypatch.setattr(foreign_graph, "_MOST_REMEMBERED", 10)
    convert = converter("rtabmap_msgs/msg/MapGraph")
    for number in range(100):
        graph = map_graph()
        for each in graph.links:
            each.from_id, each.to_id = each.from_id + 4 * number, each.to_id + 4 * number
        assert len(list(convert(graph))) == 4
    assert len(list(convert(map_graph()))) == 4  # the first ones are forgotten
