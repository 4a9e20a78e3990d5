"""Edges between sensors as edges between bodies, by the static transforms of their bag."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rotavg_ros.bags.messages import Edge
from rotavg_ros.inputs.sensor_frames import BODY_HAS_NO_NAME, Mounting, SensorFrames
from rotavg_ros.view_graph import UNIT_NORM_TOLERANCE

_ROBOT = ""  # a graph has only one


class EdgeFrames:
    """The mounting of a robot's sensors, known once its bag has been read."""

    def __init__(self) -> None:
        self._sensors, self._body, self._has_odometry = SensorFrames(), "", False
        self._unknown: dict[str, None] = {}

    def take(self, transforms: Any) -> None:
        """Take a message of static transforms."""
        self._sensors.take(transforms)

    def note_body(self, frame: str) -> None:
        """Remember the ``child_frame_id`` of odometry; the first non-empty one counts."""
        self._has_odometry = True
        self._body = self._body or frame
        self._sensors.note_body(_ROBOT, frame)

    def edge_of_body(self, edge: Edge) -> Edge:
        """The edge between bodies; unchanged if the sensor's mounting is not known or the edge is not a rotation."""
        off = abs(float(np.linalg.norm(edge.source_from_target)) - 1)
        if not edge.frame_id or not off <= UNIT_NORM_TOLERANCE:
            return edge
        body_from_sensor = self._sensors.body_from(_ROBOT, edge.frame_id)
        if body_from_sensor is None:
            self._unknown[edge.frame_id] = None
        if body_from_sensor is None or body_from_sensor == Mounting():
            return edge
        translation = np.zeros(3) if edge.translation is None else edge.translation
        qx, qy, qz, qw = edge.source_from_target.tolist()
        x, y, z = translation.tolist()
        of_body = body_from_sensor.of(Mounting((qx, qy, qz, qw), (x, y, z))).of(body_from_sensor.inverse())
        return replace(
            edge,
            source_from_target=np.array(of_body.orientation),
            translation=None if edge.translation is None else np.array(of_body.position),
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """A line about edges that were taken as they are, although odometry is of another frame."""
        if not self._unknown or not self._has_odometry:
            return ()
        named, why = ", ".join(list(self._unknown)[:3]), BODY_HAS_NO_NAME
        if self._body:
            why = f"odometry tells of {self._body}, and the bag has no static transform between them"
        return (f"edges are in frame {named}, but {why}: they are taken as they are",)
