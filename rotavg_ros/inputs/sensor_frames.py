"""The mounting of sensors on a robot's body from static transforms (``tf2_msgs/TFMessage``), and edges between bodies.

A tf transform is the pose of the child frame in the parent frame. An edge between two poses of a sensor, T, is the
edge X T X⁻¹ between those of the body, where X is the pose of the sensor in the body's frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

from rotavg_ros.inputs.fields import to_tuple, to_vector
from rotavg_ros.online import EdgeMeasurement, quaternion
from rotavg_ros.online.measurements import RejectedInputError, checked_rotation
from rotavg_ros.online.quaternion import IDENTITY, Quaternion, Vector

# Most frames remembered; beyond, new ones are assumed to be nonsense.
_MOST_FRAMES = 10_000
# Why the mounting of a sensor cannot be known, whatever transforms there are.
BODY_HAS_NO_NAME = "no odometry names the frame of the body (child_frame_id)"
# Mountings on two robots that differ by less are alike, radians and metres: closures err by as much.
_ALIKE_RAD, _ALIKE_M = math.radians(1.0), 0.1


@dataclass(frozen=True, slots=True)
class Mounting:
    """The pose of a frame in another one: orientation xyzw, and position in metres."""

    orientation: Quaternion = IDENTITY
    position: Vector = (0.0, 0.0, 0.0)

    def of(self, inner: Mounting) -> Mounting:
        """The pose, in the outer frame, of a frame with the pose ``inner`` in this one."""
        turned = quaternion.rotate(self.orientation, inner.position)
        x, y, z = (a + b for a, b in zip(self.position, turned, strict=True))
        return Mounting(quaternion.normalize(quaternion.multiply(self.orientation, inner.orientation)), (x, y, z))

    def inverse(self) -> Mounting:
        """The pose of the outer frame in this one."""
        back = quaternion.inverse(self.orientation)
        x, y, z = quaternion.rotate(back, self.position)
        return Mounting(back, (-x, -y, -z))

    def edge_of_body(self, edge: EdgeMeasurement) -> EdgeMeasurement:
        """The edge between bodies, from one measured between sensors with this pose in the body's frame."""
        if self == _AT_THE_BODY:
            return edge
        x, y, z, w = edge.target_from_source
        source_from_target = Mounting(quaternion.inverse((x, y, z, w)), self._position_of(edge))
        of_body = self.of(source_from_target).of(self.inverse())
        return replace(
            edge,
            target_from_source=quaternion.inverse(of_body.orientation),
            translation=None if edge.translation is None else of_body.position,
        )

    def is_like(self, other: Mounting, *, with_position: bool) -> bool:
        """Whether another mounting may take the place of this one."""
        turned = quaternion.angle_between(self.orientation, other.orientation)
        moved = math.dist(self.position, other.position) if with_position else 0.0
        return turned <= _ALIKE_RAD and moved <= _ALIKE_M

    @staticmethod
    def _position_of(edge: EdgeMeasurement) -> Vector:
        x, y, z = edge.translation or (0.0, 0.0, 0.0)
        return (x, y, z)


_AT_THE_BODY = Mounting()


class SensorFrames:
    """The tree of static transforms, and the frames of the robots' bodies in it."""

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, Mounting]] = {}
        self._bodies: dict[str, tuple[str, Mounting]] = {}
        self._found: dict[tuple[str, str], Mounting | None] = {}

    def take(self, message: Any) -> None:
        """Take the transforms of a ``tf2_msgs/TFMessage``; invalid poses are ignored, newer ones replace older ones."""
        for each in message.transforms:
            parent, child = _name(each.header.frame_id), _name(each.child_frame_id)
            mounting = _mounting(each.transform)
            if mounting is not None and child != parent and (child in self._parent or len(self._parent) < _MOST_FRAMES):
                self._parent[child] = parent, mounting
        self._found.clear()

    def note_body(self, robot: str, frame: str, body_from_frame: Quaternion = IDENTITY) -> None:
        """Remember the frame whose motion a robot's odometry describes.

        Args:
            robot: name of the robot.
            frame: the odometry's ``child_frame_id``; empty if it does not say.
            body_from_frame: orientation of that frame in the body's.
        """
        if frame and robot not in self._bodies:
            self._bodies[robot] = _name(frame), Mounting(body_from_frame)
            self._found.clear()

    def knows_body(self, robot: str) -> bool:
        """Whether the frame of a robot's body is known; without it no sensor's mounting is."""
        return robot in self._bodies

    def body_from(self, robot: str, sensor: str) -> Mounting | None:
        """The pose of a sensor's frame in the frame of a robot's body; None as long as it is not known."""
        if (robot, sensor) not in self._found:
            if len(self._found) >= _MOST_FRAMES:
                self._found.clear()
            self._found[robot, sensor] = self._search(robot, _name(sensor))
        return self._found[robot, sensor]

    def unlike(self, edge: EdgeMeasurement, sensor: str) -> str | None:
        """The warning about an edge between two robots on which a sensor is known to be mounted differently.

        An edge names one frame, and is converted by its mounting on the source's robot at both ends.

        Args:
            edge: as it was measured.
            sensor: the frame that it names.

        Returns:
            None if there is nothing to warn of, or one of the mountings is not known.
        """
        source, target = edge.source.robot, edge.target.robot
        if source == target or source not in self._bodies or target not in self._bodies:
            return None
        here = self.body_from(source, sensor)
        there = self.body_from(target, sensor) or self.body_from(target, self._namesake(source, target, sensor))
        if here is None or there is None or here.is_like(there, with_position=edge.translation is not None):
            return None
        return (
            f"{_name(sensor)} is mounted differently on {source} and on {target}; closures between them are taken as "
            f"if it were mounted as on {source} at both ends: send them between the bodies, without frame_id"
        )

    def _namesake(self, source: str, target: str, sensor: str) -> str:
        """The target's frame of that name, where names begin with the robot's and a '/': b/camera for a/camera."""
        (own, _), (other, _) = self._bodies[source], self._bodies[target]
        beginning = own[: own.rfind("/") + 1]
        return other[: other.rfind("/") + 1] + _name(sensor).removeprefix(beginning)

    def _search(self, robot: str, sensor: str) -> Mounting | None:
        if robot not in self._bodies:
            return None
        frame, body_from_frame = self._bodies[robot]
        to_ancestors = dict(self._ancestors(frame))
        for ancestor, ancestor_from_sensor in self._ancestors(sensor):
            if ancestor in to_ancestors:
                frame_from_sensor = to_ancestors[ancestor].inverse().of(ancestor_from_sensor)
                return body_from_frame.of(frame_from_sensor)
        return None

    def _ancestors(self, frame: str) -> Iterator[tuple[str, Mounting]]:
        """A frame, its parent and so on, with the pose of the frame in each; stops after one turn of a cycle."""
        seen: set[str] = set()
        pose = Mounting()
        while frame not in seen:
            yield frame, pose
            seen.add(frame)
            if frame not in self._parent:
                return
            frame, parent_from_frame = self._parent[frame]
            pose = parent_from_frame.of(pose)


def _name(frame: str) -> str:
    """The frame's name as in tf2; tf1 put a '/' before it."""
    return frame.removeprefix("/")


def _mounting(transform: Any) -> Mounting | None:
    """From a ``geometry_msgs/Transform``; None if it is not a valid pose."""
    position = to_vector(transform.translation)
    try:
        orientation = checked_rotation(to_tuple(transform.rotation))
    except RejectedInputError:
        return None
    return Mounting(orientation, position) if all(map(math.isfinite, position)) else None
