"""The project's own messages: ``rotavg_msgs/RelativeRotation`` and ``RelativeRotationArray``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from rotavg_ros.inputs.fields import target_from_source, to_nanoseconds, to_tuple
from rotavg_ros.inputs.records import EdgeRecord, Source
from rotavg_ros.online import EdgeMeasurement, KeyframeReference, RejectReason, quaternion
from rotavg_ros.online.measurements import RejectedInputError, check_length
from rotavg_ros.online.quaternion import Vector

_AXES = 3
# KeyframeReference.by
_BY_ID, _BY_STAMP = 0, 1


class RelativeRotationConverter:
    """Single edges; every message is passed on, since the estimator recognises repetitions."""

    def __init__(self, source: Source) -> None:
        self._source = source

    def __call__(self, message: Any) -> Iterator[EdgeRecord]:
        try:
            edge: EdgeMeasurement | RejectReason = edge_from_message(message, self._source)
        except RejectedInputError as rejection:
            edge = rejection.reason
        yield EdgeRecord(edge, message.source.robot, int(message.sequence), message.header.frame_id)

    def forget(self) -> None:
        """Nothing is remembered."""

    def note_given_up(self, source: KeyframeReference, target: KeyframeReference) -> None:
        """Nothing is remembered."""


class RelativeRotationArrayConverter(RelativeRotationConverter):
    """Many edges in a message, which may turn out to be malformed only while they are read."""

    def __call__(self, message: Any) -> Iterator[EdgeRecord]:
        frame_id = message.header.frame_id
        try:
            for edge in message.edges:
                for record in super().__call__(edge):
                    yield replace(record, frame_id=record.frame_id or frame_id, element=edge)
        except RejectedInputError as rejection:
            yield EdgeRecord(rejection.reason)


def edge_from_message(message: Any, source: Source) -> EdgeMeasurement:
    """The edge between bodies from a message's edge between sensors.

    Raises:
        RejectedInputError: a field that cannot be read at all.
    """
    return EdgeMeasurement(
        edge_id=int(message.id),
        source=_reference(message.source, source.robot),
        target=_reference(message.target, source.robot),
        target_from_source=target_from_source(to_tuple(message.rotation), source.body_from_sensor),
        kind=int(message.kind),
        precision=float(message.precision),
        translation=_translation(message, source),
    )


def _translation(message: Any, source: Source) -> Vector | None:
    """Translation between bodies, as far as the sensor's orientation determines it; None if the message has none.

    Raises:
        RejectedInputError: one or two numbers, as of a sender that means the plane.
    """
    if not len(message.translation):
        return None
    check_length(message.translation, _AXES)
    x, y, z = (float(part) for part in message.translation)
    return quaternion.rotate(source.body_from_sensor, (x, y, z))


def _reference(message: Any, default_robot: str) -> KeyframeReference:
    robot = message.robot or default_robot
    stamp_ns = to_nanoseconds(message.stamp)
    if message.by == _BY_ID:
        return KeyframeReference(robot, int(message.id), stamp_ns or None)
    if message.by == _BY_STAMP:
        return KeyframeReference(robot, None, stamp_ns)
    raise RejectedInputError(RejectReason.BAD_REFERENCE)
