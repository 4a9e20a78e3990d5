"""Mistakes of wiring, made over DDS one after the other: the diagnostics warn with the topic and what to do."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, Quaternion
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rotavg_msgs.msg import AbsoluteOrientations, KeyframeReference, RelativeRotation, RelativeRotationArray
from std_msgs.msg import Header

from rotavg_ros.ros.node.intake.wiring import Input, Placement, Wiring
from rotavg_ros.settings.parameters import NodeParameters

pytestmark = pytest.mark.ros

NODE = Path(sys.executable).with_name("rotavg_node")
# A period that no solve exceeds on a busy machine, which would be warned of for a minute.
EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=2.0")
PATIENT, IMPATIENT = "odometry_timeout_s:=1000.0", "odometry_timeout_s:=0.5"
OK, WARN = 0, 1


def says(live_node, *words: str) -> None:
    """Wait for a warning with all these words."""
    live_node.said.clear()
    live_node.spin_until(lambda: any(level == WARN and all(w in said for w in words) for level, said in live_node.said))


def says_nothing(live_node) -> None:
    live_node.said.clear()
    live_node.spin_until(lambda: any(said == (OK, "ok") for said in live_node.said))


def start_alone(live_node, start_process, *parameters: str) -> None:
    """Start the node where nobody may ever publish what it listens to."""
    words = [word for parameter in parameters for word in ("-p", parameter)]
    live_node.process = start_process(NODE, "--ros-args", *words)
    live_node.spin_until(lambda: bool(live_node.status))


@contextmanager
def publishing(live_node, message_type: type, topic: str, qos: QoSProfile | int = 10) -> Iterator[object]:
    publisher = live_node.probe.create_publisher(message_type, topic, qos)
    yield publisher
    live_node.probe.destroy_publisher(publisher)


def odometry(second: int, frame: str, child: str = "") -> Odometry:
    message = Odometry(header=Header(stamp=Time(sec=1000 + second), frame_id=frame), child_frame_id=child)
    message.pose.pose.orientation = Quaternion(w=1.0)
    return message


def edge(edge_id: int, robot: str = "", frame: str = "", **ends: int) -> RelativeRotation:
    source, target = (KeyframeReference(robot=robot, id=ends.get(end, n)) for n, end in enumerate(("source", "target")))
    rotation = Quaternion(w=1.0)
    return RelativeRotation(
        header=Header(frame_id=frame), id=edge_id, source=source, target=target, rotation=rotation, kind=1
    )


def test_who_publishes_what_the_node_listens_to(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, PATIENT)
    says_nothing(live_node)
    with publishing(live_node, Odometry, "/odom"):
        says(live_node, "/odom has 2 publishers (/test_probe, /test_probe)", "odometry_topics")
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    with publishing(live_node, RelativeRotation, "/relative_rotations", best_effort):
        says(live_node, "/relative_rotations: nothing arrives from /test_probe", "best_effort")
        assert "qos_overrides./relative_rotations.subscription.reliability:=best_effort" in live_node.status["message"]
    with publishing(live_node, AbsoluteOrientations, "/abs_orientations"):
        says(live_node, "another node publishes /abs_orientations")
    says_nothing(live_node)


def test_frames_and_robots_of_edges(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, PATIENT)
    for second in range(3):
        live_node.odometry.publish(odometry(second, "odom", "base_link"))
    live_node.edges.publish(edge(1, frame="base_link"))
    live_node.spin_until(lambda: live_node.status.get("edges") == "3")
    says_nothing(live_node)
    live_node.arrays.publish(RelativeRotationArray(header=Header(frame_id="camera_optical"), edges=[edge(2)]))
    says(live_node, "/relative_rotation_arrays is in frame camera_optical", "base_link", "edge_sensor_orientations")
    live_node.edges.publish(edge(3, robot="roboter"))
    says(live_node, "1 edges are about robots that are not known ('roboter'); known are robot")
    live_node.odometry.publish(odometry(3, "map", "base_link"))
    says(live_node, "/odom comes in frames odom → base_link and map → base_link")


def test_the_bodys_frame_is_the_bodys_with_a_slash_in_front_as_well() -> None:
    """As tf1 wrote names; such edges were said to be in another frame."""
    node = SimpleNamespace(
        get_publishers_info_by_topic=lambda _: [],
        count_publishers=lambda _: 0,
        get_parameter=lambda _: SimpleNamespace(value=False),
    )
    kinds = (("odometry_topics", "robot", ("odom", "base_link")), ("edge_topics", "", ("/base_link",)))
    inputs = [Input(f"/{kind}", "", kind, robot, QoSProfile(depth=1), {frames: None}) for kind, robot, frames in kinds]
    wiring = Wiring(node, inputs, [])
    assert wiring.warnings(NodeParameters()) == []
    inputs[1].note_frames("/camera")
    (line,) = wiring.warnings(NodeParameters())
    assert "is in frame /camera, but odometry tells of base_link: publish the transform" in line
    inputs[0].note_frames("map", "base_link")
    assert "but odometry tells of base_link: publish" in wiring.warnings(NodeParameters())[-1]  # once, as any name


@pytest.mark.parametrize("bodys_frame", [(("odom", ""),), ()], ids=["nameless", "no odometry"])
def test_odometry_that_does_not_name_the_bodys_frame(bodys_frame: tuple) -> None:
    """As PoseStamped: no transform can place a sensor on the body. Nothing had been said."""
    node = SimpleNamespace(
        get_publishers_info_by_topic=lambda _: [],
        count_publishers=lambda _: 0,
        get_parameter=lambda _: SimpleNamespace(value=False),
    )
    kinds = (("odometry_topics", "robot", bodys_frame), ("edge_topics", "", (("camera",),)))
    inputs = [
        Input(f"/{kind}", "", kind, robot, QoSProfile(depth=1), dict.fromkeys(frames)) for kind, robot, frames in kinds
    ]
    lines = Wiring(node, inputs, []).warnings(NodeParameters())
    told = (
        "/edge_topics is in frame camera, but no odometry names the frame of the body (child_frame_id): have it do so"
    )
    assert [line.startswith(told) for line in lines] == [True] * len(bodys_frame)


def test_a_sender_that_was_built_with_another_definition_is_named() -> None:
    """As on a machine where rotavg_msgs is older; its messages were lost or misread, and nothing was said."""

    def endpoint(node_name: str, told: str) -> SimpleNamespace:
        type_name = "rotavg_msgs/msg/RelativeRotation"
        return SimpleNamespace(
            topic_type=type_name, qos_profile=qos, node_namespace="/", node_name=node_name, topic_type_hash=told
        )

    qos = QoSProfile(depth=1)
    senders = [endpoint("same", "RIHS01_a"), endpoint("older", "RIHS01_b"), endpoint("tells_nothing", "INVALID")]
    node = SimpleNamespace(
        get_publishers_info_by_topic=lambda _: senders,
        get_subscriptions_info_by_topic=lambda _: [endpoint("rotavg", "RIHS01_a"), endpoint("other", "RIHS01_b")],
        get_fully_qualified_name=lambda: "/rotavg",
        count_publishers=lambda _: 0,
        get_parameter=lambda _: SimpleNamespace(value=False),
    )
    edges = Input("/edges", "rotavg_msgs/msg/RelativeRotation", "edge_topics", "", qos)
    (line,) = Wiring(node, [edges], []).warnings(NodeParameters())
    assert line.startswith("/edges: /older was built with another definition of rotavg_msgs/msg/RelativeRotation")


@pytest.mark.parametrize("topics", [NodeParameters().edge_topics, ("one", "two")])
def test_who_states_the_default_topics_needs_no_more_than_one_of_them(topics: tuple[str, ...]) -> None:
    """As a file of all defaults does; those that are chosen are all needed."""
    names, qos = [topic.partition(":")[0] for topic in topics], QoSProfile(depth=1)
    sender = SimpleNamespace(topic_type="t", qos_profile=qos, node_namespace="/", node_name="sender")
    node = SimpleNamespace(
        get_publishers_info_by_topic=lambda name: [sender] * (name == names[0]),
        get_topic_names_and_types=list,
        get_fully_qualified_name=lambda: "/rotavg",
        count_publishers=lambda _: 0,
        get_parameter=lambda _: SimpleNamespace(value=False),
    )
    inputs = [Input(name, "t", "edge_topics", "", qos, published=-1e9) for name in names]
    lines = Wiring(node, inputs, []).warnings(NodeParameters().changed({"edge_topics": topics}))
    assert lines == ["nobody publishes two (edge_topics): is it started?"] * (names[1] == "two")


def test_a_sensor_that_nobody_places_is_named_however_many_frames_came_before() -> None:
    """Robots with four cameras and more: only the first three frames of a topic had been looked at."""
    edges = Input("/edges", "rotavg_msgs/msg/RelativeRotation", "edge_topics", "", QoSProfile(depth=1))
    for number in range(5):
        edges.note_frames(f"camera_{number}")
        edges.note_placement("robot", f"camera_{number}", Placement.UNKNOWN if number == 4 else Placement.KNOWN)
    assert edges.sensors == ["camera_4"]


@pytest.mark.large
def test_an_orientation_that_was_given_settles_what_frame_edges_are_in(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, PATIENT, "edge_sensor_orientations:=[0, 0, 0, 1]")
    for second in range(3):
        live_node.odometry.publish(odometry(second, "odom", "base_link"))
    live_node.edges.publish(edge(1, frame="camera_optical"))
    live_node.spin_until(lambda: live_node.status.get("edges") == "3")
    says_nothing(live_node)


@pytest.mark.large
def test_edges_that_wait_for_keyframes_of_another_numbering(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, "odometry_timeout_s:=3.0")
    live_node.odometry.publish(odometry(0, "odom"))
    live_node.edges.publish(edge(1, source=900, target=901))
    live_node.spin_until(lambda: live_node.status.get("pending") == "1")
    for second in range(1, 10):
        live_node.odometry.publish(odometry(second, "odom"))
    says(live_node, "1 edges wait for keyframes, such as 900 of robot", "keyframe_source")


@pytest.mark.large
def test_nobody_where_somebody_should_be(live_node, start_process) -> None:
    start_alone(
        live_node,
        start_process,
        IMPATIENT,
        "odometry_topics:=['wheels', 'pose']",
        "robots:=['a', 'b']",
        "edge_topics:=['closures']",
        "use_sim_time:=true",
        "qos_overrides./wheel.subscription.depth:=5",
    )
    says(live_node, "nobody publishes /wheels (odometry_topics): nav_msgs/msg/Odometry is published on /odom")
    says(live_node, "nobody publishes /closures (edge_topics): rotavg_msgs/msg/RelativeRotation is published on")
    says(live_node, "use_sim_time is set, but nobody publishes /clock")
    says(live_node, "unknown parameter qos_overrides./wheel.subscription.depth is ignored; did you mean")
    with publishing(live_node, PoseStamped, "/pose"):
        says(live_node, "/pose carries geometry_msgs/msg/PoseStamped", "write /pose:geometry_msgs/msg/PoseStamped")
    with publishing(live_node, PoseStamped, "/closures"):
        says(live_node, "/closures carries geometry_msgs/msg/PoseStamped", "there is no adapter for that")


def test_one_topic_under_two_names() -> None:
    words = ["-p", "odometry_topics:=['odom', '/odom']", "-p", "robots:=['a', 'b']"]
    ended = subprocess.run([NODE, "--ros-args", *words], capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2
    assert ended.stderr == "rotavg_node: error: topic /odom is /odom, which is listened to already; name it once\n"


@pytest.mark.large
def test_tf_places_only_frames_that_can_be(foreign_packages, live_node, start_process) -> None:
    live_node.start(*EVERY_MESSAGE, PATIENT, "publish_tf:=true")
    places = start_process(sys.executable, "-c", LISTENING)
    live_node.spin_until(lambda: bool(live_node.probe.get_subscriptions_info_by_topic("/tf")))
    live_node.odometry.publish(odometry(0, ""))
    says(live_node, "publish_tf says nothing about /odom: its header.frame_id is empty")
    live_node.odometry.publish(odometry(1, "map"))
    says(live_node, "publish_tf says nothing about /odom: it is in the world frame map already; set world_frame")
    for second in range(2, 302):  # until the node has found who listens
        live_node.odometry.publish(odometry(second, "odom"))
        live_node.spin_for(0.2)
        if "placed" in places.output:
            break
    assert set(places.output.splitlines()) == {"placed map odom"}
    live_node.said.clear()
    live_node.spin_until(lambda: any("says nothing" not in said for _, said in live_node.said))


def test_tf_places_a_frame_that_another_robot_has_given_up(foreign_packages, live_node, start_process) -> None:
    """Its driver was started anew with a frame of its own; the warning had stayed."""
    topics = ("odometry_topics:=['odom', 'other/odom']", "robots:=['a', 'b']")
    start_alone(live_node, start_process, *EVERY_MESSAGE, PATIENT, "publish_tf:=true", *topics)
    with publishing(live_node, Odometry, "/other/odom") as other:
        live_node.spin_until(lambda: all(each.get_subscription_count() for each in (live_node.odometry, other)))
        told = "publish_tf says nothing about /other/odom: a has the odometry frame odom, too"

        def until_told(frame: str, is_told: bool) -> None:
            live_node.said.clear()

            def went_on() -> bool:
                until_told.second = second = until_told.second + 1
                live_node.odometry.publish(odometry(second, frame))
                live_node.spin_for(0.2)
                other.publish(odometry(second, "odom"))
                return any((told in said) == is_told for _, said in live_node.said[-1:])

            live_node.spin_until(went_on)

        until_told.second = 0
        until_told("odom", True)
        until_told("a/odom", False)


LISTENING = """
import rclpy
from tf2_msgs.msg import TFMessage
rclpy.init()
node = rclpy.create_node("tf_listener")
def on_tf(message):
    for transform in message.transforms:
        print("placed", transform.header.frame_id, transform.child_frame_id, flush=True)
node.create_subscription(TFMessage, "/tf", on_tf, 100)
rclpy.spin(node)
"""


@pytest.mark.parametrize("robot", ["", "a"])
def test_odometry_is_odometry_whatever_the_robot_is_called(robot: str) -> None:
    """With ``robots:=['']`` it was taken for edges, and waited for them."""
    odom = Input("/odom", "nav_msgs/msg/Odometry", "odometry_topics", robot, QoSProfile(depth=1))
    edges = Input("/edges", "rotavg_msgs/msg/RelativeRotation", "edge_topics", "", QoSProfile(depth=1))
    assert odom.is_odometry and not edges.is_odometry
