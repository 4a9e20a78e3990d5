"""Finds mistakes in how the node is connected: what it listens to, who publishes there, and in which frames.

None of them is an error to ROS; each costs an integrator an afternoon. They are looked for once a second and reported
in the diagnostics with the topic and what to do.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from enum import Enum, auto

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

from rotavg_ros.inputs import EDGE_CONVERTERS, ODOMETRY_CONVERTERS
from rotavg_ros.ros.node.intake.forwarding import Forward
from rotavg_ros.settings.parameters import PARAMETERS, NodeParameters

_CLOCK = "/clock"
# Frames come from messages and may be anything; this many different ones per topic are enough for a warning.
_MOST_FRAMES = 3
_MOST_PLACEMENTS = 1000


class Placement(Enum):
    """What is known about the mounting of a sensor on a robot's body."""

    AWAITED = auto()
    KNOWN = auto()
    UNKNOWN = auto()  # no transform came in time


@dataclass
class Input:
    """A topic that the node listens to.

    Attributes:
        name: full name of the topic.
        type_name: type of its messages, ``package/msg/Type``.
        parameter: the parameter that names it, ``odometry_topics`` or ``edge_topics``.
        robot: whose odometry it is; empty for edges.
        qos: the requested profile. A copy, since rclpy writes the user's overrides into it.
        frames: frames of the messages so far: for odometry header.frame_id and the body's, for edges the sensor's.
        forward: where its believed closures go; None if nowhere.
        placement: for edges: what is known about the mounting of their sensors, by robot and frame.
        published: when the topic last had a publisher, by the monotonic clock; initially when it was subscribed to.
    """

    name: str
    type_name: str
    parameter: str
    robot: str
    qos: QoSProfile
    frames: dict[tuple[str, ...], None] = field(default_factory=dict)
    forward: Forward | None = None
    placement: dict[tuple[str, str], Placement] = field(default_factory=dict)
    published: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.qos = copy(self.qos)

    @property
    def is_odometry(self) -> bool:
        return self.parameter == "odometry_topics"

    def is_published(self) -> None:
        """The topic has a publisher now."""
        self.published = time.monotonic()

    def note_frames(self, *frames: str) -> None:
        """Remember the frames of a message."""
        if frames not in self.frames and len(self.frames) < _MOST_FRAMES:
            self.frames[frames] = None

    def note_placement(self, robot: str, frame: str, placement: Placement) -> None:
        """Remember what is known about the mounting of a robot's sensor."""
        if (robot, frame) in self.placement or len(self.placement) < _MOST_PLACEMENTS:
            self.placement[robot, frame] = placement

    @property
    def sensors(self) -> list[str]:
        """Frames whose edges are taken as they are, although they may be sensors' frames."""
        told = {frame for _, frame in self.placement}
        unknown = [frame for (_, frame), placement in self.placement.items() if placement is Placement.UNKNOWN]
        return list(dict.fromkeys([frame for (frame,) in self.frames if frame and frame not in told] + unknown))


class Wiring:
    """Checks the ROS graph around a node, and the messages that came over it."""

    def __init__(self, node: Node, inputs: Sequence[Input], outputs: Sequence[str]) -> None:
        """Watch a node.

        Args:
            node: the node.
            inputs: what it listens to.
            outputs: full names of topics that only this node should publish.
        """
        self._node, self._inputs, self._outputs = node, inputs, outputs

    def warnings(self, parameters: NodeParameters) -> list[str]:
        """One line for each present mistake."""
        found: list[str] = []
        now = time.monotonic()
        missing = []
        for each in self._inputs:
            publishers = self._node.get_publishers_info_by_topic(each.name)
            found += _of_publishers(each, publishers) + self._of_definitions(each, publishers)
            if publishers:
                each.is_published()
            elif now - each.published > parameters.odometry_timeout_s:
                missing.append(each)
        found += self._of_missing(missing, parameters)
        found += self._of_odometry() + ([] if parameters.states_edge_sensors else self._of_sensors())
        for topic in self._outputs:
            if self._node.count_publishers(topic) > 1:
                found.append(f"another node publishes {topic}, too: stop it, or give one of them a namespace")
        if self._node.get_parameter("use_sim_time").value and self._node.count_publishers(_CLOCK) == 0:
            found.append(f"use_sim_time is set, but nobody publishes {_CLOCK}: play the bag with --clock or unset it")
        return found

    def _of_definitions(self, topic: Input, publishers: Sequence[TopicEndpointInfo]) -> list[str]:
        """Warnings about publishers whose messages have other fields, though their type has the same name."""
        told = [(_name(each), _definition(each)) for each in publishers if each.topic_type == topic.type_name]
        if not any(definition for _, definition in told):
            return []
        own = self._node.get_fully_qualified_name()
        subscriptions = self._node.get_subscriptions_info_by_topic(topic.name)
        ours = {_definition(each) for each in subscriptions if (_name(each), each.topic_type) == (own, topic.type_name)}
        package = topic.type_name.partition("/")[0]
        return [
            f"{topic.name}: {name} was built with another definition of {topic.type_name}, so its messages are "
            f"lost or misread: build both with the same {package}"
            for name, definition in told
            if definition and ours and definition not in ours
        ]

    def _of_missing(self, missing: Sequence[Input], parameters: NodeParameters) -> list[str]:
        """Warnings about needed topics that nobody publishes."""
        edges = [each for each in self._inputs if not each.is_odometry]
        # The default topics are two forms of the same input; a user of one does not need the other.
        are_chosen = parameters.edge_topics != PARAMETERS["edge_topics"].default
        all_needed = are_chosen or all(each in missing for each in edges)
        needs_odometry = parameters.estimator.needs_odometry
        lines = []
        for each in missing:
            if needs_odometry if each.is_odometry else all_needed:
                others = self._topics_of(each.type_name)
                hint = f"{each.type_name} is published on {', '.join(others)}" if others else "is it started?"
                lines.append(f"nobody publishes {each.name} ({each.parameter}): {hint}")
        return lines

    def _topics_of(self, type_name: str) -> list[str]:
        """A few topics of a type that others publish and that this node does not listen to."""
        own = self._node.get_fully_qualified_name()
        known = {each.name for each in self._inputs}
        by_others = (
            topic
            for topic, types in self._node.get_topic_names_and_types()
            if type_name in types
            and topic not in known
            and any(_name(each) != own for each in self._node.get_publishers_info_by_topic(topic))
        )
        return sorted(by_others)[:_MOST_FRAMES]

    def _of_odometry(self) -> list[str]:
        """Warnings about odometry in several frames."""
        lines = []
        for each in self._inputs:
            if each.is_odometry and len(each.frames) > 1:
                named = " and ".join(" → ".join(frames) for frames in each.frames)
                lines.append(f"{each.name} comes in frames {named}: a robot's odometry has one source")
        return lines

    def _of_sensors(self) -> list[str]:
        """Warnings about edges in frames of which nobody knows how they sit on the body."""
        frames = [frames for each in self._inputs if each.is_odometry for frames in each.frames]
        if not frames:
            return []
        bodies = list(dict.fromkeys(body for _, body in frames if body))
        why = ", but no odometry names the frame of the body (child_frame_id): have it do so"
        if bodies:
            why = (
                f", but odometry tells of {', '.join(bodies)}: publish the transform between them on /tf_static (it is "
                "read where tf2_msgs is installed)"
            )
        known = {body.removeprefix("/") for body in bodies}  # tf1 put a '/' before names
        lines = []
        for each in self._inputs:
            sensors = [] if each.is_odometry else [name for name in each.sensors if name.removeprefix("/") not in known]
            if sensors:
                named = ", ".join(sensors[:_MOST_FRAMES])
                lines.append(
                    f"{each.name} is in frame {named}{why}, or set edge_sensor_orientations to the "
                    "orientation of the one in the other (0, 0, 0, 1 if they are equal)"
                )
        return lines


def _of_publishers(topic: Input, publishers: Sequence[TopicEndpointInfo]) -> list[str]:
    """Warnings about the publishers of a topic."""
    lines = []
    fitting = [each for each in publishers if each.topic_type == topic.type_name]
    for other in sorted({each.topic_type for each in publishers} - {topic.type_name}):
        known = other in (ODOMETRY_CONVERTERS if topic.is_odometry else EDGE_CONVERTERS)
        remedy = f"write {topic.name}:{other}" if known else "there is no adapter for that"
        lines.append(f"{topic.name} carries {other}, but {topic.parameter} says {topic.type_name}: {remedy}")
    if topic.is_odometry and len(fitting) > 1:
        names = ", ".join(sorted(_name(each) for each in fitting))
        lines.append(
            f"{topic.name} has {len(fitting)} publishers ({names}): stop all but one, or give each robot a topic of "
            "its own (odometry_topics)"
        )
    for each in fitting:
        if qos_check_compatible(each.qos_profile, topic.qos)[0] == QoSCompatibility.ERROR:
            remedy = "set its reliability to reliable"
            if each.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT:
                remedy = f"-p qos_overrides.{topic.name}.subscription.reliability:=best_effort"
            lines.append(f"{topic.name}: nothing arrives from {_name(each)}, whose QoS is incompatible: {remedy}")
    return lines


def _definition(endpoint: TopicEndpointInfo) -> str:
    """The hash of the definition of an endpoint's messages; empty if it does not tell, as in Humble."""
    told = str(getattr(endpoint, "topic_type_hash", ""))
    return told if told.startswith("RIHS") else ""


def _name(endpoint: TopicEndpointInfo) -> str:
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
