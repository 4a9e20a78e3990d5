"""The node's parameters: the estimator's options, and what only a node has."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from rotavg_ros.inputs import BRINGS_KEYFRAMES, FRAMELESS_ODOMETRY, OF_ONE_ROBOT, WITHOUT_CLOSURES, Source
from rotavg_ros.online import EstimatorOptions, quaternion
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.option import Option, OptionError, check_options, option, options_of, path_of
from rotavg_ros.view_graph import UNIT_NORM_TOLERANCE

NODE_NAME = "rotavg"


@dataclass(frozen=True)
class NodeParameters:
    """Every parameter of the node.

    Users know no ``estimator``: its options stand among the others, in its place, by their names with units.

    Raises:
        OptionError: the values do not fit, one by one or together.
    """

    odometry_topics: tuple[str, ...] = option(
        ("odom",), "topics of odometry, one per robot, 'topic' (nav_msgs/msg/Odometry) or 'topic:package/msg/Type'"
    )
    robots: tuple[str, ...] = option(
        ("robot",),
        "name of the robot behind each odometry topic; messages that number robots mean places in this list, counted "
        "from 0, or the numbers themselves where these are the names",
    )
    odometry_sensor_orientations: tuple[float, ...] = option(
        (0.0, 0.0, 0.0, 1.0),
        "orientation of each odometry topic's sensor frame in the body frame, xyzw one after the other; one for all, "
        "or one per odometry topic",
    )
    edge_topics: tuple[str, ...] = option(
        ("relative_rotations", "relative_rotation_arrays:rotavg_msgs/msg/RelativeRotationArray"),
        "topics of relative rotations, 'topic' (rotavg_msgs/msg/RelativeRotation) or 'topic:package/msg/Type'",
    )
    edge_robots: tuple[str, ...] = option(
        ("",),
        "robot that an edge topic's messages are about where they name none; one for all, or one per edge topic; "
        "empty: the first of robots",
    )
    edge_sensor_orientations: tuple[float, ...] = option(
        (0.0, 0.0, 0.0, 0.0),
        "orientation of each edge topic's sensor frame in the body frame, xyzw one after the other; one for all, "
        "or one per edge topic; zeros: not stated",
    )
    forward_topics: tuple[str, ...] = option(
        ("",),
        "'topic:output' for each of edge_topics whose believed closures are to be sent on, on a topic of the same type",
    )
    forward_delay_s: float = option(
        0.0,
        "so old a closure must be before it is sent on: others may contradict it meanwhile",
        within=(0.0, 3600.0),
        live=True,
    )
    edge_frames_from_tf: bool = option(
        True,
        "take edges whose header names a sensor's frame into the body's, by /tf_static; not where "
        "edge_sensor_orientations is stated, or tf2_msgs not installed",
    )
    edge_frame_wait_s: float = option(
        3.0,
        "how long an edge waits for the transform between its frame and the body's; it is then taken as it is",
        within=(0.0, 1e6),
    )
    world_frame: str = option("map", "frame id of what is published")
    publish_tf: bool = option(False, "publish world → odometry frame on /tf; needs tf2_msgs")
    transform_tolerance_s: float = option(
        0.1, "so far ahead that transform is dated, so that it is there when it is asked for", within=(0.0, 60.0)
    )
    correction_rate_deg_s: float = option(
        0.0,
        "corrected_odometry and tf turn a robot no faster than this to where a new answer puts it; 0: at once",
        within=(0.0, 1e6),
        live=True,
    )
    correction_rate_m_s: float = option(
        0.0, "they move it no faster than this; 0: at once", within=(0.0, 1e6), live=True
    )
    odometry_queue_depth: int = option(10_000, "messages that may wait per odometry topic", within=(1, 1_000_000))
    edge_queue_depth: int = option(10_000, "messages that may wait per edge topic", within=(1, 1_000_000))

    estimator: EstimatorOptions = field(default_factory=EstimatorOptions)

    solve_period_s: float = option(
        0.5, "how often to look for something new to solve", within=(0.01, 3600.0), live=True
    )
    tick_budget_s: float = option(
        0.2,
        "what may be spent after a tick's answer on solves that take longer than 15 % of it, which may be spent "
        "before; one factorisation may take longer",
        within=(0.0, 3600.0),
        live=True,
    )
    solver_process: bool = option(
        True,
        "solve in a process of its own, which costs memory and keeps odometry from waiting while a solve runs; false: "
        "on a thread of the node",
    )
    solver_threads: int = option(0, "threads of a solve; 0: all cores but one", within=(0, 1024))

    state_file: str = option("", "file for ~/save and ~/load, read at start if it exists; empty: none")
    autosave_period_s: float = option(0.0, "save the state this often if it changed; 0: never", within=(0.0, 1e6))
    odometry_timeout_s: float = option(
        5.0, "diagnostics warn when no odometry has come for longer", within=(0.1, 1e6), live=True
    )

    def __post_init__(self) -> None:
        check_options(self)
        self._check_topics()
        self._check_edge_robots()
        if self.autosave_period_s > 0 and not self.state_file:
            raise OptionError("autosave_period_s is set but state_file is empty; name a file")
        self._check_forwards()
        self._check_frames()

    def _check_topics(self) -> None:
        for name in ("odometry_topics", "robots", "edge_topics"):
            values = getattr(self, name)
            if len(set(values)) < len(values):
                raise OptionError(f"{name} names something twice: {', '.join(values)}")
        if not self.robots:
            raise OptionError("robots is empty; name at least one")
        if len(self.robots) != len(self.odometry_topics):
            raise OptionError(
                f"robots has {len(self.robots)} entries and odometry_topics {len(self.odometry_topics)}; "
                "give one robot per topic"
            )
        robot_of: dict[str, str] = {}
        for robot, prefix in self.prefixes().items():
            other = robot_of.setdefault(prefix, robot)
            if other != robot:
                raise OptionError(f"robots names {other!r} and {robot!r}, whose topics would both begin with {prefix}")
        _check_orientations("odometry", self.odometry_sensor_orientations, len(self.odometry_topics))
        _check_orientations("edge", self._edge_orientations, len(self.edge_topics))
        for entry in self.edge_topics:
            topic, colon, message_type = entry.partition(":")
            if entry and not (topic and (message_type or not colon)):
                raise OptionError(f"edge_topics: {entry!r} lacks a topic or a type; write topic or topic:type")
            if message_type in BRINGS_KEYFRAMES and self.estimator.keyframe_source != "edges":
                raise OptionError(f"edge topic {entry!r} brings keyframes of its own; set keyframe_source to edges")

    def _check_edge_robots(self) -> None:
        if len(self.edge_robots) not in (1, len(self.edge_topics)):
            raise OptionError(
                f"edge_robots has {len(self.edge_robots)} entries; give 1, or one per edge topic "
                f"({len(self.edge_topics)})"
            )
        sent: dict[tuple[str, str], str] = {}
        for entry, source in zip(self.edge_topics, self.edge_sources(), strict=True):
            topic, _, message_type = entry.partition(":")
            if message_type not in OF_ONE_ROBOT:
                continue
            other = sent.setdefault((source.robot, message_type), topic)
            if other != topic:
                raise OptionError(
                    f"edge topics {other} and {topic} both number keyframes of {source.robot!r}; name the robot of "
                    "each edge topic in edge_robots"
                )

    def _check_forwards(self) -> None:
        known = {topic: message_type for topic, _, message_type in (entry.partition(":") for entry in self.edge_topics)}
        outputs = self.forwarded()
        entries = [entry for entry in self.forward_topics if entry]
        for entry in entries:
            topic, _, output = entry.partition(":")
            if not (topic and output):
                raise OptionError(f"forward_topics: {entry!r} names no two topics; write topic:output")
            if topic not in known:
                raise OptionError(f"forward_topics: {topic} is none of edge_topics ({', '.join(known)})")
            if known[topic] in WITHOUT_CLOSURES:
                raise OptionError(
                    f"forward_topics: {topic} is {known[topic]}, which carries no closures: have the back end listen "
                    "to it itself"
                )
            if output in known:
                raise OptionError(f"forward_topics: {output} is listened to; choose another output for {topic}")
        if len(set(outputs.values())) < len(entries):
            raise OptionError(f"forward_topics names something twice: {', '.join(entries)}")

    def _check_frames(self) -> None:
        if not self.world_frame or self.world_frame.startswith("/"):
            raise OptionError(
                f"world_frame is {self.world_frame!r}; name the frame of what is published, without a '/' in front: map"
            )
        for entry in self.odometry_topics if self.publish_tf else ():
            if entry.endswith(f":{FRAMELESS_ODOMETRY}"):
                raise OptionError(
                    f"publish_tf places the odometry's frame, and {entry} has none; use another odometry, or no tf"
                )

    @property
    def states_edge_sensors(self) -> bool:
        """Whether the parameters state how the sensors of edges are mounted."""
        return any(self.edge_sensor_orientations)

    @property
    def places_edges_by_tf(self) -> bool:
        """Whether transforms decide how the sensors of edges are mounted; what is stated wins."""
        return self.edge_frames_from_tf and not self.states_edge_sensors

    @property
    def _edge_orientations(self) -> tuple[float, ...]:
        return self.edge_sensor_orientations if self.states_edge_sensors else quaternion.IDENTITY

    @property
    def state_path(self) -> Path | None:
        """The state file; None: none."""
        return path_of(self.state_file)

    def forwarded(self) -> dict[str, str]:
        """Outputs of the edge topics that are sent on, by topic."""
        pairs = (entry.partition(":") for entry in self.forward_topics if entry)
        return {topic: output for topic, _, output in pairs}

    def prefixes(self) -> dict[str, str]:
        """The prefix of each robot's topics: empty if there is only one robot, else its name.

        No part of a topic's name may begin with a digit, so a number gets ``robot_`` before it. Not checked otherwise.
        """
        if len(self.robots) == 1:
            return {self.robots[0]: ""}
        return {robot: f"robot_{robot}/" if robot.isdecimal() else f"{robot}/" for robot in self.robots}

    def odometry_sensors(self) -> list[Quaternion]:
        """body_from_sensor of every odometry topic."""
        return _orientations(self.odometry_sensor_orientations, len(self.odometry_topics))

    def edge_sources(self) -> list[Source]:
        """For every edge topic, what its messages do not state themselves."""
        number = len(self.edge_topics)
        robots = self.edge_robots * (number // len(self.edge_robots))
        sensors = _orientations(self._edge_orientations, number)
        pairs = zip(robots, sensors, strict=True)
        return [Source(robot or self.robots[0], self.robots, sensor) for robot, sensor in pairs]

    def values(self) -> dict[str, Any]:
        """All parameters by name, as users write them."""
        own = {each.name: each.written(self) for each in options_of(NodeParameters)}
        estimators = {each.name: each.written(self.estimator) for each in options_of(EstimatorOptions)}
        return {name: (own | estimators)[name] for name in PARAMETERS}

    def changed(self, values: Mapping[str, Any]) -> NodeParameters:
        """A copy with these values, as users write them, checked as a whole; names that are not ours are ignored.

        Raises:
            OptionError: the values do not fit, one by one or together.
        """
        own, estimators = (
            {
                each.field: each.to_field(each.checked(values[each.name]))
                for each in options_of(owner)
                if each.name in values
            }
            for owner in (NodeParameters, EstimatorOptions)
        )
        return replace(self, **own, estimator=replace(self.estimator, **estimators))


def _in_order() -> Iterator[Option]:
    own = {each.field: each for each in options_of(NodeParameters)}
    for each in fields(NodeParameters):
        yield from options_of(EstimatorOptions) if each.name == "estimator" else [own[each.name]]


PARAMETERS: dict[str, Option] = {each.name: each for each in _in_order()}


def _check_orientations(what: str, numbers: tuple[float, ...], topics: int) -> None:
    name = f"{what}_sensor_orientations"
    if len(numbers) not in (4, 4 * topics):
        raise OptionError(f"{name} has {len(numbers)} numbers; give 4, or 4 per {what} topic ({4 * topics})")
    for start in range(0, len(numbers), 4):
        if not abs(math.hypot(*numbers[start : start + 4]) - 1) <= UNIT_NORM_TOLERANCE:
            raise OptionError(f"{name}: quaternion {start // 4} is not of unit length")


def _orientations(numbers: tuple[float, ...], topics: int) -> list[Quaternion]:
    """One orientation per topic, from numbers for each topic or one set for all."""
    each = [quaternion.normalize(numbers[start : start + 4]) for start in range(0, len(numbers), 4)]
    return each * (topics // len(each))
