"""Names of robots in front of their topics'."""

from __future__ import annotations

import re

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rclpy.validate_topic_name import validate_topic_name

from rotavg_ros.errors import UserError
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
