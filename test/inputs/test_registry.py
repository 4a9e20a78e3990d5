"""What every converter of edges does: directions, precisions, names, stamps, reasons."""

from __future__ import annotations

from types import SimpleNamespace as Fields

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.inputs.fields import to_nanoseconds
from rotavg_ros.online import RejectReason

from .square import (
    SIDES,
    SQUARE,
    converter,
    edges,
    intra_closure,
    map_graph,
    pose_graph,
    position,
    stamp,
    world_from_body,
)


@pytest.mark.parametrize("type_name", SQUARE)
def test_edges_lead_around_a_square(type_name: str) -> None:
    """R_target = R_target_source R_source of the true body-from-world orientations, for every edge."""
    messages, precision = SQUARE[type_name]
    convert = converter(type_name)
    found = edges(record for message in messages for record in convert(message))
    assert len(found) == (1 if "Closure" in type_name else 3 if type_name.endswith(("Odom", "Event")) else 4)
    for edge in found:
        source, target = edge.source.keyframe_id, edge.target.keyframe_id
        expected = world_from_body(target).inv() * world_from_body(source)
        assert (Rotation.from_quat(edge.target_from_source).inv() * expected).magnitude() < 1e-12
        way_of_body = world_from_body(source).inv().apply(position(target) - position(source))
        np.testing.assert_allclose(edge.translation, way_of_body, atol=1e-12)
        assert edge.kind == (target == 0)  # the closure is the edge back to the first corner
        assert edge.precision == pytest.approx(precision)
        assert edge.source.robot == "b"
        assert edge.target.robot == ("c" if "Inter" in type_name else "b")
    assert [edge.kind for edge in found] == sorted(edge.kind for edge in found)  # odometry makes the keyframes
    assert len({edge.edge_id for edge in found}) == len(found)


@pytest.mark.parametrize("type_name", [name for name in SQUARE if name.endswith("Graph")])
def test_the_closures_of_a_whole_graph_have_the_names_of_their_records(type_name: str) -> None:
    convert, ((message,), _) = converter(type_name), SQUARE[type_name]
    closures = [(edge.source.robot, edge.edge_id) for edge in edges(convert(message)) if edge.kind]
    names = [convert.closure_name(edge) for edge in getattr(message, convert.edges_field)]
    assert len(closures) == 1 and [name for name in names if name is not None] == closures
    assert convert.sends_parts == ("pose_graph_tools" in type_name)


def test_stamps_of_keyframes() -> None:
    """RTAB-Map's message is of its newest node's time, slam_toolbox's is not; Swarm-SLAM's closures have none."""
    times = {corner: to_nanoseconds(stamp(corner)) for corner in range(SIDES)}
    for type_name, (messages, _) in SQUARE.items():
        convert = converter(type_name)
        for edge in edges(record for message in messages for record in convert(message)):
            for end in (edge.source, edge.target):
                known = type_name.endswith(("tools_msgs/msg/PoseGraph", "Odom", "Event"))
                known |= "MapGraph" in type_name and end.keyframe_id == 3
                assert end.stamp_ns == (times[end.keyframe_id] if known else None)


def test_what_cannot_be_read_is_a_reason() -> None:
    def reasons(type_name: str, message: Fields) -> list[object]:
        return [record.edge for record in converter(type_name)(message) if isinstance(record.edge, RejectReason)]

    graph = map_graph()
    graph.links[1].transform.rotation.x = float("nan")
    graph.links[2].type = 42
    assert reasons("rtabmap_msgs/msg/MapGraph", graph) == ["nan_rotation", "bad_kind"]
    graph.header.stamp.sec = -1
    assert reasons("rtabmap_msgs/msg/MapGraph", graph) == ["bad_stamp"]
    graph = pose_graph(1)
    graph.nodes[0].header.stamp.nanosec = 2**31
    graph.edges[0].robot_from = -1
    graph.edges[1].pose.orientation.w = 0.0
    assert reasons("pose_graph_tools_msgs/msg/PoseGraph", graph)[0] == "bad_stamp"
    assert sorted(reasons("pose_graph_tools_msgs/msg/PoseGraph", graph)[1:]) == [
        "bad_reference",
        "unnormalized_quaternion",
    ]
    assert list(converter("cslam_common_interfaces/msg/IntraRobotLoopClosure")(intra_closure(success=False))) == []
