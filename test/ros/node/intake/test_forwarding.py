"""Closures on their way to a back end, over DDS: believed ones go on as they came, others are held back or revoked."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from rclpy.qos import QoSProfile
from rotavg_msgs.msg import KeyframeReference, OutlierFlags, RelativeRotation, RelativeRotationArray
from rotavg_msgs.srv import LabelEdge
from std_msgs.msg import Header

pytestmark = pytest.mark.ros

NODE = Path(sys.executable).with_name("rotavg_node")
SPEAKER = Path(__file__).with_name("graph_publisher.py")
EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=0.1")
LENGTH = 60
ACCEPT, REJECT = 1, 2
FALSE = {1, 4, 7}


def closure(edge_id: int, false: bool) -> RelativeRotation:
    """Between two seconds of :meth:`LiveNode.turn`; a false one is off by 1.5 rad, each in its own way."""
    source, target = 2 + 3 * edge_id, 30 + 3 * edge_id
    edge = RelativeRotation(id=edge_id, kind=RelativeRotation.LOOP_CLOSURE, sequence=edge_id + 1)
    edge.header = Header(stamp=Time(sec=1000 + target), frame_id="base_link")
    edge.source, edge.target = (
        KeyframeReference(by=KeyframeReference.BY_STAMP, stamp=Time(sec=1000 + each)) for each in (source, target)
    )
    first, last = (Rotation.from_rotvec([0.1, 0, 0.2 * each]) for each in (source, target))
    off = Rotation.from_rotvec([0, 1.5, 0.5 * edge_id]) if false else Rotation.identity()
    x, y, z, w = (first.inv() * last * off).as_quat().tolist()
    edge.rotation = Quaternion(x=x, y=y, z=z, w=w)
    return edge


def listen(live_node, message_type: type, topic: str) -> list:
    heard: list = []
    live_node.probe.create_subscription(message_type, topic, heard.append, QoSProfile(depth=1000))
    return heard


def start(live_node, *parameters: str) -> None:
    live_node.start(*EVERY_MESSAGE, *parameters)
    outputs = [word.split(":")[-1].strip("']") for word in parameters if word.startswith("forward_topics")]
    topics = [f"/{outputs[0]}", "/rotavg/revoked", "/rotavg/reinstated"]
    live_node.spin_until(lambda: all(live_node.probe.count_publishers(topic) for topic in topics))
    live_node.spin_for(2.0)  # the node has found who listens as well
    live_node.turn(0, LENGTH)


def until_heard(live_node, passed: list, publish) -> None:
    """Send odometry, which goes on at once, until the node has found who listens to what it sends on."""
    step = closure(0, False)
    step.id, step.kind = 1000, RelativeRotation.ODOMETRY

    def is_heard() -> bool:
        step.id += 1
        publish(step)
        live_node.spin_for(0.2)
        return bool(passed)

    live_node.spin_until(is_heard)
    # Several are under way where the node is slow.
    live_node.spin_until(lambda: any(edge.id == step.id for each in passed for edge in getattr(each, "edges", [each])))
    passed.clear()


def test_believed_closures_go_on_as_they_came_and_are_revoked_and_reinstated(live_node) -> None:
    passed = listen(live_node, RelativeRotation, "/trusted")
    revoked = listen(live_node, OutlierFlags, "/rotavg/revoked")
    reinstated = listen(live_node, OutlierFlags, "/rotavg/reinstated")
    start(live_node, "forward_topics:=['relative_rotations:trusted']", f"pending_timeout_s:={LENGTH}.0")
    until_heard(live_node, passed, live_node.edges.publish)
    sent = [closure(edge_id, edge_id in FALSE) for edge_id in range(10)]
    for edge in [*sent, *sent]:  # a sender may repeat itself
        live_node.edges.publish(edge)
    step = closure(99, False)
    step.kind = RelativeRotation.ODOMETRY
    live_node.edges.publish(step)
    live_node.wait_for_silence()
    live_node.spin_until(lambda: len(passed) >= 8 and live_node.status["held back"] == str(len(FALSE)))
    assert {edge.id for edge in passed} == {99, *range(10)} - FALSE and len(passed) == 8
    by_id = {edge.id: edge for edge in [*sent, step]}
    assert all(edge == by_id[edge.id] for edge in passed)
    # One that waits for a keyframe in vain is no longer held back.
    lost = closure(50, False)
    lost.target = KeyframeReference(by=KeyframeReference.BY_ID, id=9999)
    live_node.edges.publish(lost)
    live_node.spin_until(lambda: live_node.status["held back"] == str(len(FALSE) + 1))
    live_node.turn(LENGTH, 2 * LENGTH + 2)
    live_node.spin_until(lambda: live_node.status["held back"] == str(len(FALSE)))
    in_order = [edge.id for edge in passed if edge.id != 99]
    assert in_order == sorted(in_order)
    assert not revoked and not reinstated
    assert live_node.call("label_edge", LabelEdge, source_robot="robot", edge_id=3, label=REJECT).success
    live_node.spin_until(lambda: bool(revoked))
    assert list(revoked[0].edge_ids) == [3] and list(revoked[0].outliers) == [True]
    assert live_node.call("label_edge", LabelEdge, source_robot="robot", edge_id=3, label=ACCEPT).success
    live_node.spin_until(lambda: bool(reinstated))
    assert list(reinstated[0].edge_ids) == [3] and list(reinstated[0].outliers) == [False]
    assert live_node.call("label_edge", LabelEdge, source_robot="robot", edge_id=4, label=ACCEPT).success
    live_node.spin_until(lambda: len(passed) == 9)
    assert passed[-1] == by_id[4]
    # After a reset everything is new.
    assert live_node.call("reset").success
    live_node.turn(0, LENGTH)
    for edge in sent:
        live_node.edges.publish(edge)
    live_node.spin_until(lambda: len(passed) == 9 + 10 - len(FALSE))
    assert {edge.id for edge in passed[9:]} == set(range(10)) - FALSE


@pytest.mark.large
def test_arrays_and_a_delay(live_node) -> None:
    passed = listen(live_node, RelativeRotationArray, "/trusted")
    start(
        live_node,
        "edge_topics:=['relative_rotation_arrays:rotavg_msgs/msg/RelativeRotationArray', 'relative_rotations']",
        "forward_delay_s:=8.0",
        "forward_topics:=['relative_rotation_arrays:trusted']",
    )
    until_heard(live_node, passed, lambda edge: live_node.arrays.publish(RelativeRotationArray(edges=[edge])))
    header = Header(stamp=Time(sec=77), frame_id="base_link")
    sent = [closure(edge_id, edge_id in FALSE) for edge_id in range(10)]
    live_node.arrays.publish(RelativeRotationArray(header=header, edges=sent))
    live_node.spin_until(lambda: bool(live_node.flags) and {*range(10)} <= {*live_node.flags[-1].edge_ids})
    assert not passed and live_node.status["held back"] in ("0", "10")
    # What passes together: on a busy machine an answer comes between two parts of an array.
    live_node.spin_until(lambda: sum(len(each.edges) for each in passed) >= len(sent) - len(FALSE))
    assert all(each.header == header for each in passed)
    assert [edge for each in passed for edge in each.edges] == [edge for edge in sent if edge.id not in FALSE]


@pytest.mark.large
@pytest.mark.parametrize("topics", [1, 2])
def test_closures_that_share_an_id_are_told_of(live_node, topics: int) -> None:
    """On one topic, or on one that is sent on and another that is not: both count from 0."""
    listen(live_node, RelativeRotation, "/trusted")
    start(live_node, "forward_topics:=['relative_rotations:trusted']")
    first, second = closure(0, False), closure(3, False)
    second.id = first.id
    live_node.edges.publish(first)
    if topics == 1:
        live_node.edges.publish(second)
    else:
        live_node.arrays.publish(RelativeRotationArray(edges=[second]))
    said = "relative_rotations: different closures have the same id"
    live_node.spin_until(lambda: said in live_node.status["message"])


@pytest.mark.large
def test_a_whole_graph_goes_out_without_its_false_edges(foreign_packages, live_node, start_process) -> None:
    words = [
        "edge_topics:=['graph:rtabmap_msgs/msg/MapGraph', 'kimera:pose_graph_tools_msgs/msg/PoseGraph']",
        "odometry_topics:=['a/odom', 'b/odom']",
        "robots:=['a', 'b']",
        "edge_robots:=['a', '']",
        "keyframe_source:=edges",
        "forward_topics:=['graph:trusted_graph', 'kimera:trusted_kimera']",
        "solve_period_s:=0.1",
    ]
    live_node.process = start_process(NODE, "--ros-args", *(part for word in words for part in ("-p", word)))
    speaker = start_process(sys.executable, SPEAKER)

    def latest() -> dict[str, list[list[int]]]:
        said = [json.loads(line) for line in speaker.output.splitlines() if line.startswith("{")]
        return {key: value for each in said for key, value in each.items()}

    # Ten steps, ten true closures, and three false ones that are missing; the node's poses are there whole.
    live_node.spin_until(lambda: all(len(latest().get(name, [])) == 51 for name in ("graph", "kimera")))
    for name in ("graph", "kimera"):
        kept = {tuple(edge) for edge in latest()[name]}
        assert not kept & {(3, 20), (9, 33), (14, 38)}
    assert {name: edges for name, edges in latest().items() if name.startswith("nodes")} == {"nodes": [[41, 41]]}


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("nothing", "'nothing' names no two topics; write topic:output"),
        pytest.param("other:trusted", "other is none of edge_topics", marks=pytest.mark.large),
        ("relative_rotations:relative_rotation_arrays", "relative_rotation_arrays is listened to; choose another"),
        pytest.param(
            "relative_rotations:/relative_rotations",
            "is /relative_rotations, which is listened to",
            marks=pytest.mark.large,
        ),
        ("relative_rotations:odom", "is /odom, which is listened to"),
    ],
)
def test_what_cannot_be_sent_on(entry, said) -> None:
    command = [NODE, "--ros-args", "-p", f"forward_topics:=['{entry}']"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("rotavg_node: error: forward_topics: ") and said in ended.stderr
