"""Names of robots in front of their topics', and quality of service of one topic at a time."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from rclpy.validate_topic_name import validate_topic_name

from rotavg_ros.errors import UserError
from rotavg_ros.online import OnlineEstimator
from rotavg_ros.ros.node.health import Health
from rotavg_ros.ros.node.intake.subscriptions import Subscriptions
from rotavg_ros.ros.node.output.outputs import Outputs
from rotavg_ros.ros.node.topics import checked_prefixes
from rotavg_ros.settings.parameters import NodeParameters


def robot_prefixes(*robots: str) -> dict[str, str]:
    topics = tuple(f"odom_{index}" for index in range(len(robots)))
    return dict(checked_prefixes(NodeParameters(robots=robots, odometry_topics=topics).prefixes()))


def test_a_robot_alone_has_no_prefix() -> None:
    assert [robot_prefixes(name) for name in ("robot", "", "1", "a b")] == [
        {"robot": ""},
        {"": ""},
        {"1": ""},
        {"a b": ""},
    ]


def test_several_have_their_names_and_numbers_a_word_before_them() -> None:
    prefixes = robot_prefixes("alice", "0", "12", "fleet/bob", "_c3")
    assert list(prefixes.values()) == ["alice/", "robot_0/", "robot_12/", "fleet/bob/", "_c3/"]
    for prefix in prefixes.values():
        validate_topic_name(f"{prefix}orientation")


@pytest.mark.parametrize(
    "name", ["", "my robot", "my-robot", "2nd", "fleet/1", "alice/", "a//b", "~", "{ns}", "é", "١", "a\n"]
)
def test_names_that_no_topic_can_have(name: str) -> None:
    with pytest.raises(
        UserError, match=rf"robots names {re.escape(repr(name))}, .*use letters, digits and _"
    ) as caught:
        robot_prefixes("alice", name)
    assert "\n" not in str(caught.value)


def test_two_robots_with_the_same_topics() -> None:
    with pytest.raises(UserError, match=r"robots names '1' and 'robot_1', .* both begin with robot_1/"):
        robot_prefixes("1", "robot_1")


FIRST_OF_EACH = {
    "/a/odom.subscription.reliability": "reliable",
    "/one.subscription.reliability": "best_effort",
    "/one_believed.publisher.reliability": "best_effort",
    "/abs_orientations.publisher.depth": 7,
}


@pytest.fixture
def node() -> Iterator[Node]:
    """With an override for the first topic of each kind."""
    context = rclpy.Context()
    rclpy.init(context=context)
    overrides = [Parameter(f"qos_overrides.{name}", value=value) for name, value in FIRST_OF_EACH.items()]
    node = rclpy.create_node("topics", context=context, parameter_overrides=overrides)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_an_override_is_of_its_own_topic_alone(node: Node) -> None:
    parameters = NodeParameters(
        robots=("a", "b"),
        odometry_topics=("/a/odom", "/b/odom"),
        edge_topics=("/one", "/two"),
        forward_topics=("/one:/one_believed", "/two:/two_believed"),
    )
    estimator, health = OnlineEstimator(solver=lambda *_, **__: None), Health()
    outputs = Outputs(node, parameters, estimator)
    listening = Subscriptions(node, parameters, estimator, health, outputs, lambda: None)
    reliable, best_effort = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT
    asked = {"/a/odom": reliable, "/b/odom": best_effort, "/one": best_effort, "/two": reliable}
    subscribed = {each.topic_name: each.qos_profile.reliability for each in node.subscriptions}
    assert {topic: subscribed[topic] for topic in asked} == asked
    assert {each.name: each.qos.reliability for each in listening.inputs} == asked
    published = {each.topic_name: each.qos_profile for each in node.publishers}
    assert published["/one_believed"].reliability == best_effort
    assert published["/two_believed"].reliability == published["/topics/revoked"].reliability == reliable
    assert [published[topic].depth for topic in ("/abs_orientations", "/outlier_flags")] == [7, 1]
