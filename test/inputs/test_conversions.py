"""Converters on bare objects with the messages' fields: directions, precisions, stamps, repetitions, verdicts."""

from __future__ import annotations

from types import SimpleNamespace as Fields

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.inputs import EDGE_CONVERTERS, ODOMETRY_CONVERTERS, EdgeRecord, EdgeVerdict, Source, foreign_graph
from rotavg_ros.inputs.fields import precision_of_covariance, precision_of_information, to_nanoseconds
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, OnlineEstimator, RejectReason
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.view_graph import EdgeLabel

SIDES = 4
BODY_FROM_SENSOR = Rotation.from_euler("zyx", [-90, 0, -90], degrees=True)  # a camera that looks ahead


def world_from_body(corner: int) -> Rotation:
    """Around a square, with a roll that makes the rotations not commute."""
    return Rotation.from_euler("zx", [90 * corner, 20 * (corner % SIDES)], degrees=True)


def world_from_sensor(corner: int) -> Rotation:
    return world_from_body(corner) * BODY_FROM_SENSOR


def position(corner: int) -> np.ndarray:
    return np.array([np.cos(np.pi / 2 * corner), np.sin(np.pi / 2 * corner), 0.1 * (corner % SIDES)])


def vector(xyz: np.ndarray) -> Fields:
    x, y, z = xyz.tolist()
    return Fields(x=x, y=y, z=z)


def quaternion(rotation: Rotation) -> Fields:
    x, y, z, w = rotation.as_quat().tolist()
    return Fields(x=x, y=y, z=z, w=w)


def between(source: int, target: int) -> Fields:
    """Orientation of the target in the source frame, as gtsam's BetweenFactor has it."""
    return quaternion(world_from_sensor(source).inv() * world_from_sensor(target))


def way(source: int, target: int) -> Fields:
    """Position of the target in the source frame."""
    return vector(world_from_sensor(source).inv().apply(position(target) - position(source)))


def transform(source: int, target: int) -> Fields:
    return Fields(rotation=between(source, target), translation=way(source, target))


def stamp(corner: int) -> Fields:
    return Fields(sec=100 + corner, nanosec=5)


def pose(rotation: Fields, xyz: Fields) -> Fields:
    return Fields(position=xyz, orientation=rotation)


def diagonal(rotation: float) -> np.ndarray:
    return np.diag([9.0, 9.0, 9.0, rotation, rotation, rotation]).ravel()


def link(source: int, target: int, kind: int) -> Fields:
    pose_between = transform(source, target)
    return Fields(from_id=source, to_id=target, type=kind, transform=pose_between, information=diagonal(25.0))


def map_graph() -> Fields:
    links = [link(3, 0, 1), link(0, 1, 0), link(1, 2, 0), link(2, 3, 0), link(1, 3, 7), link(0, 0, 9)]
    return Fields(header=Fields(stamp=stamp(3)), poses_id=np.arange(4, dtype=np.int32), links=links)


def pose_graph_edge(source: int, target: int, kind: int) -> Fields:
    return Fields(
        key_from=source,
        key_to=target,
        robot_from=1,
        robot_to=1,
        type=kind,
        pose=pose(between(source, target), way(source, target)),
        covariance=diagonal(0.04),
    )


def pose_graph(closure: int) -> Fields:
    nodes = [Fields(robot_id=1, key=key, header=Fields(stamp=stamp(key))) for key in range(SIDES)]
    edges = [pose_graph_edge(3, 0, closure), *(pose_graph_edge(key, key + 1, 0) for key in range(3))]
    return Fields(nodes=nodes, edges=edges)


def numbered_edge(source: int, target: int) -> Fields:
    """Of slam_toolbox as it is since Pose2D is deprecated."""
    relative_pose = pose(between(source, target), way(source, target))
    covariance = np.diag([9.0, 9.0, 0.04]).ravel()
    return Fields(source_id=source, target_id=target, relative_pose=relative_pose, covariance=covariance)


def numbered_graph() -> Fields:
    """Stamped when it is published, long after its last node."""
    nodes = [Fields(node_id=corner) for corner in range(SIDES)]
    edges = [numbered_edge(3, 0), *(numbered_edge(corner, corner + 1) for corner in range(3))]
    return Fields(header=Fields(stamp=stamp(50), frame_id="map"), nodes=nodes, edges=edges)


def new_node(corner: int) -> Fields:
    """The first node's event has an edge that nobody has filled in."""
    return Fields(new_node_id=corner, stamp=stamp(corner), edge=numbered_edge(max(corner - 1, 0), corner))


def keyframe_odometry(corner: int) -> Fields:
    here = pose(quaternion(world_from_sensor(corner)), vector(position(corner)))
    odometry = Fields(header=Fields(stamp=stamp(corner)), pose=Fields(pose=here))
    return Fields(id=corner, odom=odometry)


def intra_closure(success: bool = True) -> Fields:
    return Fields(keyframe0_id=3, keyframe1_id=0, success=success, transform=transform(3, 0))


def inter_closure() -> Fields:
    ends = {"robot0_id": 1, "robot0_keyframe_id": 3, "robot1_id": 2, "robot1_keyframe_id": 0}
    return Fields(**ends, success=True, transform=transform(3, 0))


def converter(type_name: str):
    return EDGE_CONVERTERS[type_name](Source("b", ("a", "b", "c"), tuple(BODY_FROM_SENSOR.as_quat().tolist())))


def edges(records) -> list[EdgeMeasurement]:
    return [record.edge for record in records if isinstance(record, EdgeRecord)]


SQUARE = {
    "rtabmap_msgs/msg/MapGraph": ([map_graph()], 25.0),
    "pose_graph_tools_msgs/msg/PoseGraph": ([pose_graph(1)], 25.0),
    "slam_toolbox/msg/PoseGraph": ([numbered_graph()], 25.0),
    "slam_toolbox/msg/NewNodeEvent": ([new_node(corner) for corner in range(SIDES)], 25.0),
    "cslam_common_interfaces/msg/KeyframeOdom": ([keyframe_odometry(corner) for corner in range(SIDES)], 0.0),
    "cslam_common_interfaces/msg/IntraRobotLoopClosure": ([intra_closure()], 0.0),
    "cslam_common_interfaces/msg/InterRobotLoopClosure": ([inter_closure()], 0.0),
}


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


def planar_edge(source: int, target: int) -> Fields:
    """Of slam_toolbox as it was: around a square of one metre, with quarter turns to the left."""
    relative_pose = Fields(x=1.0, y=0.0, theta=np.pi / 2)
    return Fields(source_id=source, target_id=target, relative_pose=relative_pose, covariance=np.zeros(9))


def test_poses_in_the_plane_lead_around_a_square() -> None:
    graph = Fields(edges=[planar_edge(3, 0), *(planar_edge(corner, corner + 1) for corner in range(3))])
    found = edges(EDGE_CONVERTERS["slam_toolbox/msg/PoseGraph"](Source("b"))(graph))
    heading = [Rotation.from_euler("z", 90 * corner, degrees=True) for corner in range(SIDES)]
    assert [(edge.source.keyframe_id, edge.target.keyframe_id, edge.kind) for edge in found] == [
        (0, 1, 0),
        (1, 2, 0),
        (2, 3, 0),
        (3, 0, 1),
    ]
    for edge in found:
        expected = heading[edge.target.keyframe_id].inv() * heading[edge.source.keyframe_id]
        assert (Rotation.from_quat(edge.target_from_source).inv() * expected).magnitude() < 1e-12
        assert edge.translation == (1.0, 0.0, 0.0) and edge.precision == 0.0


@pytest.mark.parametrize(
    ("variance", "precision"), [(0.04, 25.0), (0.0, 0.0), (-1.0, 0.0), (float("nan"), 0.0), (float("inf"), 0.0)]
)
def test_the_precision_of_a_yaw(variance: float, precision: float) -> None:
    edge = planar_edge(0, 1)
    edge.covariance[8] = variance
    (found,) = edges(EDGE_CONVERTERS["slam_toolbox/msg/PoseGraph"](Source("b"))(Fields(edges=[edge])))
    assert found.precision == pytest.approx(precision)


@pytest.mark.parametrize("graph_first", [True, False])
def test_a_graph_and_its_events_count_once_and_the_events_stamps_are_kept(graph_first: bool) -> None:
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), lambda *_, **__: None)
    graph = edges(converter("slam_toolbox/msg/PoseGraph")(numbered_graph()))
    convert = converter("slam_toolbox/msg/NewNodeEvent")
    events = [edge for corner in range(SIDES) for edge in edges(convert(new_node(corner)))]
    refused = [estimator.add_edge(edge) for edge in (graph + events if graph_first else events + graph)]
    assert refused.count(RejectReason.DUPLICATE_EDGE) == 3 and refused.count(None) == 4
    snapshot = estimator.snapshot()
    assert len(snapshot.graph.source) == 4
    assert snapshot.stamp_ns.tolist() == [to_nanoseconds(stamp(corner)) for corner in range(SIDES)]


def test_a_senders_verdict_on_a_closure() -> None:
    convert = converter("pose_graph_tools_msgs/msg/PoseGraph")
    closure = edges(convert(pose_graph(1)))[-1]
    rejected = list(convert(pose_graph(3)))
    assert rejected == [EdgeVerdict("b", closure.edge_id, EdgeLabel.REJECTED)]
    assert list(convert(pose_graph(3))) == []
    assert list(convert(pose_graph(1))) == [EdgeVerdict("b", closure.edge_id, EdgeLabel.AUTOMATIC)]
    late = converter("pose_graph_tools_msgs/msg/PoseGraph")
    assert list(late(pose_graph(3)))[-1] == rejected[0]


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


def test_keyframes_whose_numbers_start_again_begin_a_new_chain() -> None:
    convert = converter("cslam_common_interfaces/msg/KeyframeOdom")
    pairs = []
    for number in (0, 1, 3, 0, 4, 5):
        pairs.extend(
            edge if isinstance(edge, RejectReason) else (edge.source.keyframe_id, edge.target.keyframe_id)
            for edge in edges(convert(Fields(id=number, odom=keyframe_odometry(number).odom)))
        )
    assert pairs == [(0, 1), (1, 3), RejectReason.OUT_OF_ORDER_ODOMETRY, (4, 5)]


def test_keyframes_of_odometry_that_begins_anew_begin_a_new_chain() -> None:
    limits = EstimatorOptions().continuity_limits
    convert = EDGE_CONVERTERS["cslam_common_interfaces/msg/KeyframeOdom"](Source("b", limits=limits))
    pairs = []
    for number in range(8):
        pose = Fields(position=Fields(x=20.0 + number if number < 4 else 0.0, y=0.0, z=0.0))
        pose.orientation = quaternion(Rotation.from_euler("z", 90 + number if number < 4 else number - 4, degrees=True))
        odom = Fields(header=Fields(stamp=stamp(number)), pose=Fields(pose=pose))
        pairs += [
            (edge.source.keyframe_id, edge.target.keyframe_id) for edge in edges(convert(Fields(id=number, odom=odom)))
        ]
    assert pairs == [(0, 1), (1, 2), (2, 3), (4, 5), (5, 6), (6, 7)]


@pytest.mark.parametrize("type_name", ODOMETRY_CONVERTERS)
def test_odometry_of_a_sensor_that_is_turned_in_the_body(type_name: str) -> None:
    orientation = quaternion(world_from_sensor(2))
    here = pose(orientation, vector(position(2)))
    posed = {
        "nav_msgs/msg/Odometry": Fields(pose=here),
        "geometry_msgs/msg/PoseWithCovarianceStamped": Fields(pose=here),
        "geometry_msgs/msg/PoseStamped": here,
    }
    message = Fields(header=Fields(stamp=stamp(2), frame_id="odom"), child_frame_id="base")
    if type_name in posed:
        message.pose = posed[type_name]
    else:
        message.orientation, message.orientation_covariance = orientation, np.zeros(9)
    record = ODOMETRY_CONVERTERS[type_name](message, tuple(BODY_FROM_SENSOR.as_quat().tolist()))
    assert record.stamp_ns == to_nanoseconds(stamp(2))
    assert (Rotation.from_quat(record.world_from_body).inv() * world_from_body(2)).magnitude() < 1e-12
    assert record.position == (tuple(position(2).tolist()) if type_name in posed else None)


def test_an_imu_without_orientation() -> None:
    message = Fields(header=Fields(stamp=stamp(0), frame_id="imu"), orientation=quaternion(Rotation.identity()))
    message.orientation_covariance = np.array([-1.0] + [0.0] * 8)
    with pytest.raises(RejectedInputError, match="no_orientation"):
        ODOMETRY_CONVERTERS["sensor_msgs/msg/Imu"](message, (0.0, 0.0, 0.0, 1.0))


def test_precision_agrees_with_the_spread_of_rotation_vectors() -> None:
    rng = np.random.default_rng(0)
    deviation = 0.05
    vectors = rng.normal(scale=deviation, size=(20_000, 3))
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.cov(vectors.T)
    information = np.zeros((6, 6))
    information[3:, 3:] = np.linalg.inv(covariance[3:, 3:])
    assert precision_of_covariance(covariance.ravel()) == pytest.approx(deviation**-2, rel=0.03)
    assert precision_of_information(information.ravel()) == pytest.approx(deviation**-2, rel=0.03)
    assert precision_of_covariance(np.zeros(36)) == precision_of_information(np.zeros(36)) == 0.0
    assert precision_of_covariance(np.full(36, np.nan)) == 0.0  # from a sender who knows none
    assert precision_of_covariance(-covariance.ravel()) < 0  # refused later, as bad_precision


def test_numbers_of_robots() -> None:
    assert [Source("", ("red", "blue")).robot_of(number) for number in (0, 1, 2)] == ["red", "blue", "2"]
    assert [Source("", ("7", "0")).robot_of(number) for number in (0, 1, 7)] == ["0", "1", "7"]


NUMBERS = st.one_of(
    st.sampled_from([float("nan"), float("inf"), -float("inf"), 0.0, 1.0, -1.0, 1e300, 1e-300]), st.floats(-2, 2)
)
INT32 = st.one_of(st.integers(-3, 12), st.sampled_from([-(2**31), 2**31 - 1]))
UINT32 = st.one_of(st.integers(0, 12), st.just(2**32 - 1))
UINT64 = st.one_of(st.integers(0, 12), st.just(2**64 - 1))
QUATERNIONS = st.one_of(
    st.builds(Fields, x=NUMBERS, y=NUMBERS, z=NUMBERS, w=NUMBERS), st.integers(0, 3).map(lambda k: between(k, k + 1))
)
POSITIONS = st.builds(Fields, x=NUMBERS, y=NUMBERS, z=NUMBERS)
STAMPS = st.builds(Fields, sec=INT32, nanosec=UINT32)
HEADERS = st.builds(Fields, stamp=STAMPS, frame_id=st.sampled_from(["", "camera"]))
POSES = st.builds(Fields, position=POSITIONS, orientation=QUATERNIONS)
TRANSFORMS = st.builds(Fields, translation=POSITIONS, rotation=QUATERNIONS)
MATRICES = st.builds(lambda a, b: np.array([a] * 20 + [b] * 16), NUMBERS, NUMBERS)
LINKS = st.builds(Fields, from_id=INT32, to_id=INT32, type=INT32, transform=TRANSFORMS, information=MATRICES)
POSE_GRAPH_EDGES = st.builds(
    Fields,
    **dict.fromkeys(("key_from", "key_to"), UINT64),
    **dict.fromkeys(("robot_from", "robot_to", "type"), INT32),
    pose=POSES,
    covariance=MATRICES,
)
NUMBERED_EDGES = st.builds(
    Fields,
    source_id=INT32,
    target_id=INT32,
    relative_pose=st.one_of(POSES, st.builds(Fields, x=NUMBERS, y=NUMBERS, theta=NUMBERS)),
    covariance=NUMBERS.map(lambda variance: np.full(9, variance)),
)
ODOMETRIES = st.builds(Fields, header=HEADERS, pose=st.builds(Fields, pose=POSES))
REFERENCES = st.builds(Fields, by=st.integers(0, 3), robot=st.sampled_from(["", "b"]), id=UINT64, stamp=STAMPS)
RELATIVE_ROTATIONS = st.builds(
    Fields,
    header=HEADERS,
    id=UINT64,
    sequence=UINT32,
    source=REFERENCES,
    target=REFERENCES,
    rotation=QUATERNIONS,
    precision=NUMBERS,
    translation=st.lists(NUMBERS, max_size=3),
    translation_precision=NUMBERS,
    kind=st.integers(0, 4),
)
MESSAGES = {
    "rotavg_msgs/msg/RelativeRotation": RELATIVE_ROTATIONS,
    "rotavg_msgs/msg/RelativeRotationArray": st.builds(
        Fields, header=HEADERS, edges=st.lists(RELATIVE_ROTATIONS, max_size=5)
    ),
    "rtabmap_msgs/msg/MapGraph": st.builds(
        Fields, header=HEADERS, poses_id=st.lists(INT32, max_size=5), links=st.lists(LINKS, max_size=8)
    ),
    "pose_graph_tools_msgs/msg/PoseGraph": st.builds(
        Fields,
        nodes=st.lists(st.builds(Fields, header=HEADERS, robot_id=INT32, key=UINT64), max_size=5),
        edges=st.lists(POSE_GRAPH_EDGES, max_size=8),
    ),
    "slam_toolbox/msg/PoseGraph": st.builds(Fields, header=HEADERS, edges=st.lists(NUMBERED_EDGES, max_size=8)),
    "slam_toolbox/msg/NewNodeEvent": st.builds(Fields, new_node_id=INT32, stamp=STAMPS, edge=NUMBERED_EDGES),
    "cslam_common_interfaces/msg/KeyframeOdom": st.builds(Fields, id=UINT32, odom=ODOMETRIES),
    "cslam_common_interfaces/msg/IntraRobotLoopClosure": st.builds(
        Fields, keyframe0_id=UINT32, keyframe1_id=UINT32, success=st.booleans(), transform=TRANSFORMS
    ),
    "cslam_common_interfaces/msg/InterRobotLoopClosure": st.builds(
        Fields,
        **dict.fromkeys(("robot0_id", "robot0_keyframe_id", "robot1_id", "robot1_keyframe_id"), UINT32),
        success=st.booleans(),
        transform=TRANSFORMS,
    ),
}


@pytest.mark.parametrize("type_name", EDGE_CONVERTERS)
@given(data=st.data())
@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
def test_whatever_a_message_says_what_comes_out_is_sound(type_name: str, data) -> None:
    """Nothing raises, and only unit quaternions, sound precisions and proper edges get into the graph."""
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), lambda *_, **__: None)
    convert = converter(type_name)
    for message in data.draw(st.lists(MESSAGES[type_name], max_size=6)):
        for record in convert(message):
            if isinstance(record, EdgeVerdict):
                estimator.label_edge(record.source_robot, record.edge_id, record.label)
            elif isinstance(record.edge, RejectReason):
                estimator.reject(record.edge)
            else:
                estimator.add_edge(record.edge)
    graph = estimator.snapshot().graph
    np.testing.assert_allclose(np.linalg.norm(graph.target_from_source.numpy(), axis=1), 1, atol=1e-9)
    assert not (graph.source == graph.target).any()
    precision = graph.precision.numpy()
    assert (np.isnan(precision) | ((precision > 0) & np.isfinite(precision))).all()
    known = np.isfinite(graph.translation.numpy())
    assert (known.all(axis=1) == known.any(axis=1)).all()


def test_what_is_remembered_is_bounded(monkeypatch) -> None:
    monkeypatch.setattr(foreign_graph, "_MOST_REMEMBERED", 10)
    convert = converter("rtabmap_msgs/msg/MapGraph")
    for number in range(100):
        graph = map_graph()
        for each in graph.links:
            each.from_id, each.to_id = each.from_id + 4 * number, each.to_id + 4 * number
        assert len(list(convert(graph))) == 4
    assert len(convert._seen) <= 10
