"""What a converter knows about its source, and what it makes of a message."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

from rotavg_ros.online import EdgeMeasurement, KeyframeReference, RejectReason
from rotavg_ros.online.odometry.continuity import ANY_MOTION, ContinuityLimits
from rotavg_ros.online.quaternion import IDENTITY, Quaternion, Vector, multiply
from rotavg_ros.view_graph import EdgeLabel


@dataclass(frozen=True)
class Source:
    """Where messages come from: what they do not say themselves.

    Attributes:
        robot: whose they are, where they name no robot.
        robots: names of all robots, for messages that number them.
        body_from_sensor: orientation in the body frame of the sensor frame that the messages' rotations are given in.
        limits: what odometry is believed to do from one keyframe to the next.
    """

    robot: str
    robots: tuple[str, ...] = ()
    body_from_sensor: Quaternion = IDENTITY
    limits: ContinuityLimits = ANY_MOTION

    def robot_of(self, number: int) -> str:
        """Name of the robot with a number: its place in ``robots``, unless robots there have numbers for names.

        A number that means none of them becomes a name itself.
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
        sender, sequence: whom the message is about, and its sender's count; 0 for senders that do not.
        frame_id: the sensor frame that the sender says it measured in; empty where it says nothing.
        element: of a message of many edges, the one that this is.
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
        position: metres, of the sensor, not checked; None where the message carries none.
        frame_id, child_frame_id: of the odometry and of what moves in it; empty where the message does not say.
        body_from_sensor: xyzw, of what the message says the pose of.
    """

    stamp_ns: int
    world_from_body: Quaternion
    position: Vector | None
    frame_id: str = ""
    child_frame_id: str = ""
    body_from_sensor: Quaternion = IDENTITY

    @property
    def world_from_sensor(self) -> Quaternion:
        """xyzw, as the message says."""
        return multiply(self.world_from_body, self.body_from_sensor)

    @property
    def known_position(self) -> Vector | None:
        """The position; None, too, where the source has lost it (NaN, infinite)."""
        return self.position if self.position is not None and all(map(math.isfinite, self.position)) else None


class EdgeConverter(Protocol):
    """Turns the messages of one topic into edges. It may remember what it has seen."""

    def __call__(self, message: Any) -> Iterator[EdgeRecord | EdgeVerdict]:
        """What is new in a message."""

    def forget(self) -> None:
        """Begin anew, as the graph does: everything that is sent again is new."""

    def note_given_up(self, source: KeyframeReference, target: KeyframeReference) -> None:
        """An edge between these, by id, was lost for want of room or of time: when it is sent again, it is new."""


class WholeGraphConverter(EdgeConverter, Protocol):
    """Of messages that hold a graph, which can be sent on without some of its edges.

    Attributes:
        edges_field: the message's field with the edges.
        sends_parts: whether a message may hold a part of the graph; else each stands for all before it.
    """

    edges_field: str
    sends_parts: bool

    def closure_name(self, edge: Any) -> tuple[str, int] | None:
        """Source's robot and id of an element of that field, as in its record; None of what is no closure."""


# Message, body_from_sensor → record. Raises RejectedInputError for what cannot be read at all.
OdometryConverter = Callable[[Any, Quaternion], OdometryRecord]
