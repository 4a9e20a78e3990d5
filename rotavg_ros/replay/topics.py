"""What each topic of a bag can be used for, judged by its type, its name and its first messages."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice

from rotavg_ros.bags.reader import BagReader
from rotavg_ros.inputs import BRINGS_KEYFRAMES, EDGE_CONVERTERS, ODOMETRY_CONVERTERS, EdgeRecord, Source
from rotavg_ros.online import EdgeMeasurement
from rotavg_ros.online.measurements import RejectedInputError, checked_rotation
from rotavg_ros.online.quaternion import IDENTITY
from rotavg_ros.view_graph import EdgeKind

_ODOMETRY, _IMU = "nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu"
_TRUTH_NAME = re.compile(r"ground.?truth|(^|[/_])(gt|truth|mocap|vicon|optitrack)([/_]|$)", re.IGNORECASE)
# Number of edge messages that are examined for the kind of graph they make.
_FIRST_EDGES = 100
# Number of odometry messages that are searched for an orientation: a filter that has not converged sends zeros or NaN.
_FIRST_POSES = 100
_NO_ORIENTATION = f"none of its first {_FIRST_POSES} messages states an orientation"


@dataclass(frozen=True)
class Candidate:
    """A topic that could be used, and its number of messages."""

    topic: str
    type_name: str
    messages: int

    @property
    def is_truth(self) -> bool:
        """Whether its name says that it is ground truth."""
        return bool(_TRUTH_NAME.search(self.topic))


@dataclass(frozen=True)
class Candidates:
    """The usable topics of a bag, the best of each kind first.

    Attributes:
        odometry: topics that could serve as odometry.
        references: topics to compare with: ground truth, then poses, then IMUs.
        edges: topics with relative rotations.
        brings_keyframes: topics of edges whose sender chooses the keyframes.
        why_not: by topic, why one that looks useful is not.
    """

    odometry: tuple[Candidate, ...]
    references: tuple[Candidate, ...]
    edges: tuple[Candidate, ...]
    brings_keyframes: frozenset[str]
    why_not: dict[str, str] = field(default_factory=dict)


def find_candidates(bag: BagReader) -> Candidates:
    """Examine every topic of the bag, and the first messages of some.

    Raises:
        BagReadError: a damaged bag.
    """
    why_not: dict[str, str] = {}
    poses, edges = [], []
    for topic, type_name in bag.topics.items():
        messages = bag.num_messages([topic])
        candidate = Candidate(topic, type_name, messages)
        if type_name in ODOMETRY_CONVERTERS:
            if messages and not _states_orientation(bag, candidate):
                why_not[topic] = _NO_ORIENTATION
            elif messages:
                poses.append(candidate)
        elif type_name in EDGE_CONVERTERS and messages:
            edges.append(candidate)
        if not messages:
            why_not[topic] = "no messages"
    return Candidates(
        odometry=tuple(sorted((pose for pose in poses if not pose.is_truth), key=_as_odometry)),
        references=tuple(
            sorted((pose for pose in poses if pose.is_truth or pose.type_name != _ODOMETRY), key=_as_reference)
        ),
        edges=tuple(edges),
        brings_keyframes=frozenset(
            edge.topic for edge in edges if edge.type_name in BRINGS_KEYFRAMES or _has_odometry_edges(bag, edge)
        ),
        why_not=why_not,
    )


def _as_odometry(candidate: Candidate) -> tuple[int, int, int, str]:
    """Sort key: odometry, then IMUs, then poses (a localisation's may jump); a good name; many messages."""
    by_type = {_ODOMETRY: 0, _IMU: 1}.get(candidate.type_name, 2)
    name = candidate.topic.rsplit("/", 1)[-1]
    by_name = 0 if candidate.topic == "/odom" else 1 if name == "odom" else 2 if "odom" in name else 3
    return by_type, by_name, -candidate.messages, candidate.topic


def _as_reference(candidate: Candidate) -> tuple[bool, bool, int, str]:
    return not candidate.is_truth, candidate.type_name == _IMU, -candidate.messages, candidate.topic


def _states_orientation(bag: BagReader, candidate: Candidate) -> bool:
    for _, _, message in islice(bag.decoded([candidate.topic]), _FIRST_POSES):
        with suppress(RejectedInputError):
            checked_rotation(ODOMETRY_CONVERTERS[candidate.type_name](message, IDENTITY).world_from_body)
            return True
    return False


def of_others(edges: Sequence[str], odometry: Sequence[str], other_odometry: Sequence[str]) -> frozenset[str]:
    """The topics of edges that are of robots other than those whose odometry is used.

    They are in the namespace of another odometry. None is, where none of the topics is in a namespace that is used: a
    sensor that has odometry of its own may be all that sees loops.
    """
    own = _named(odometry)
    if not any(_namespace(topic) in own for topic in edges):
        return frozenset()
    others = _named(other_odometry) - own
    return frozenset(topic for topic in edges if _namespace(topic) in others)


def robots_of(edges: Sequence[str], odometry: Sequence[str], robots: Sequence[str]) -> tuple[str, ...]:
    """For each topic of edges the robot, of one odometry topic each, that alone has its namespace; else empty."""
    namespaces = [_namespace(topic) for topic in odometry]
    count = Counter(namespaces)
    robot_of = {name: robot for name, robot in zip(namespaces, robots, strict=False) if name and count[name] == 1}
    return tuple(robot_of.get(_namespace(topic), "") for topic in edges)


def can_be_read_as(bag: BagReader, topic: str, type_name: str) -> bool:
    """Whether a topic's messages have the fields of a type, as those of a renamed package do, judged by the first."""
    for _, _, message in islice(bag.decoded([topic]), _FIRST_EDGES):
        try:
            if type_name in ODOMETRY_CONVERTERS:
                with suppress(RejectedInputError):
                    ODOMETRY_CONVERTERS[type_name](message, IDENTITY)
                return True
            if next(EDGE_CONVERTERS[type_name](Source("robot"))(message), None) is not None:
                return True
        except (AttributeError, TypeError):
            return False
    return True


def _has_odometry_edges(bag: BagReader, candidate: Candidate) -> bool:
    convert = EDGE_CONVERTERS[candidate.type_name](Source("robot"))
    for _, _, message in islice(bag.decoded([candidate.topic]), _FIRST_EDGES):
        for record in convert(message):
            if not isinstance(record, EdgeRecord) or not isinstance(record.edge, EdgeMeasurement):
                continue
            if record.edge.kind == EdgeKind.ODOMETRY:
                return True
    return False


def _named(topics: Sequence[str]) -> frozenset[str]:
    return frozenset(map(_namespace, topics)) - {""}


def _namespace(topic: str) -> str:
    """The first part of a topic's name; empty if it has no other."""
    first, _, rest = topic.strip("/").partition("/")
    return first if rest else ""
