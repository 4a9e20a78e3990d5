"""What a converter knows about its source, and the records that it makes from a message."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

from rotavg_ros.inputs.fields import Key
from rotavg_ros.online import EdgeMeasurement, KeyframeReference, OnlineEstimator, RejectReason
from rotavg_ros.online.odometry.continuity import ANY_MOTION, ContinuityLimits
from rotavg_ros.online.quaternion import IDENTITY, Quaternion, Vector, multiply
from rotavg_ros.view_graph import EdgeLabel


@dataclass(frozen=True)
class Source:
    """The source of messages: what they do not state themselves.

    Attributes:
        robot: the robot that they belong to if they name none.
        robots: names of all robots, for messages that number them.
        body_from_sensor: orientation, in the body frame, of the sensor frame in which the messages state rotations.
        limits: gives the largest believable change of odometry from one keyframe to the next, as it is now.
        odometry_between: target_from_source of the odometry edge that the graph has from one keyframe to another, None
            if there is none: a graph may have been loaded, or built from other topics.
    """

    robot: str
    robots: tuple[str, ...] = ()
    body_from_sensor: Quaternion = IDENTITY
    limits: Callable[[], ContinuityLimits] = lambda: ANY_MOTION
    odometry_between: Callable[[Key, Key], Quaternion | None] = lambda source, target: None

    def into(self, estimator: OnlineEstimator) -> Source:
        """The same, by an estimator's present graph and options."""
        limits, odometry_between = (lambda: estimator.options.continuity_limits), estimator.odometry_between
        return replace(self, limits=limits, odometry_between=odometry_between)

    def robot_of(self, number: int) -> str:
        """Name of the robot with a number, which is its place in ``robots`` unless robots there are named by numbers.

        A number that fits none of them becomes a name itself.
        """
        return self._name_of_number.get(number, str(number))

    @cached_property
    def _name_of_number(self) -> dict[int, str]:
        numbered = {int(name): name for name in self.robots if name.isdecimal()}
        return numbered or dict(enumerate(self.robots))


@dataclass(frozen=True, slots=True)
class EdgeRecord:
    """One edge of a message.

    Attributes:
        edge: the measurement, or why it cannot be read.
        sender, sequence: the robot that the message is about, and the sender's count; 0 if the sender does not count.
        frame_id: the sensor frame in which the sender measured; empty if it does not say.
        element: the edge's element in a message of many edges.
    """

    edge: EdgeMeasurement | RejectReason
    sender: str = ""
    sequence: int = 0
    frame_id: str = ""
    element: Any = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class EdgeVerdict:
    """A sender's changed mind about edges that it has sent, for :meth:`OnlineEstimator.label_edge`."""

    source_robot: str
    edge_id: int
    label: EdgeLabel


@dataclass(frozen=True, slots=True)
class OdometryRecord:
    """The body's pose in its odometry's frame.

    Attributes:
        stamp_ns: nanoseconds.
        world_from_body: xyzw, not checked.
        position: of the sensor, metres, not checked; None if the message carries none.
        frame_id, child_frame_id: of the odometry and of the moving frame; empty if the message does not say.
        body_from_sensor: xyzw, of the frame whose pose the message states.
    """

    stamp_ns: int
    world_from_body: Quaternion
    position: Vector | None
    frame_id: str = ""
    child_frame_id: str = ""
    body_from_sensor: Quaternion = IDENTITY

    @property
    def world_from_sensor(self) -> Quaternion:
        """xyzw, as stated in the message."""
        return multiply(self.world_from_body, self.body_from_sensor)

    @property
    def known_position(self) -> Vector | None:
        """The position; None also if the source has lost it (NaN, infinite)."""
        return self.position if self.position is not None and all(map(math.isfinite, self.position)) else None


class EdgeConverter(Protocol):
    """Turns the messages of one topic into edges. It may remember what it has seen."""

    def __call__(self, message: Any) -> Iterator[EdgeRecord | EdgeVerdict]:
        """What is new in a message."""

    def forget(self) -> None:
        """Begin anew with the graph: everything that is sent again is new."""

    def note_given_up(self, source: KeyframeReference, target: KeyframeReference) -> None:
        """An edge between these, by id, was lost for lack of room or time: when it is sent again, it is new."""


class WholeGraphConverter(EdgeConverter, Protocol):
    """Converter of messages that hold a graph, which can be sent on without some of its edges.

    Attributes:
        edges_field: the message's field with the edges.
        sends_parts: whether a message may hold a part of the graph; otherwise each replaces all before it.
    """

    edges_field: str
    sends_parts: bool

    def closure_name(self, edge: Any) -> tuple[str, int] | None:
        """Source robot and id of an element of that field, as in its record; None if it is not a closure."""


# Message, body_from_sensor → record. Raises RejectedInputError if the message cannot be read at all.
OdometryConverter = Callable[[Any, Quaternion], OdometryRecord]
