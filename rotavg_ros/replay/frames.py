"""Converts a bag's edges between sensors to the bodies' frames by the static transforms recorded with them."""

from __future__ import annotations

from rotavg_ros.bags.reader import BagReader
from rotavg_ros.bags.topics import static_transforms
from rotavg_ros.inputs import NAMES_ITS_BODY, ODOMETRY_CONVERTERS
from rotavg_ros.inputs.sensor_frames import BODY_HAS_NO_NAME, SensorFrames
from rotavg_ros.online import EdgeMeasurement
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.replay.plan import Input, Plan


class BagFrames:
    """The mounting of a bag's sensors, known for the whole bag from the beginning on.

    The node waits a while for a transform; here nothing has to wait.
    """

    def __init__(self, bag: BagReader, plan: Plan) -> None:
        """Read the bag's static transforms, and the frames whose motion odometry describes."""
        self._is_on = plan.edge_frames_from_tf
        self._sensors, self._bodies, self._has_odometry = SensorFrames(), set[str](), bool(plan.odometry)
        self._unknown: dict[str, dict[str, None]] = {}
        self._unlike: str | None = None
        for _, _, message in bag.decoded(static_transforms(bag.topics) if self._is_on else []):
            self._sensors.take(message)
        for robot, source, sensor in plan.odometry_of_robots():
            frame = _frame_of_body(bag, source, sensor) if self._is_on else ""
            self._sensors.note_body(robot, frame, sensor)
            self._bodies |= {frame} if frame else set()

    def edge_of_body(self, edge: EdgeMeasurement, frame: str, topic: str) -> EdgeMeasurement:
        """The edge between bodies; unchanged if the mounting of the sensor is not known."""
        if not self._is_on or not frame:
            return edge
        body_from_sensor = self._sensors.body_from(edge.source.robot, frame)
        if body_from_sensor is not None:
            self._compare_ends(edge, frame, topic)
            return body_from_sensor.edge_of_body(edge)
        self._unknown.setdefault(topic, {})[frame] = None
        return edge

    def _compare_ends(self, edge: EdgeMeasurement, frame: str, topic: str) -> None:
        unlike = self._sensors.unlike(edge, frame) if self._unlike is None else None
        if unlike is not None:
            self._unlike = f"{topic}: {unlike}"

    @property
    def warnings(self) -> list[str]:
        """One line for each topic with edges that were taken as they are, although odometry is of another frame.

        And one about the first edge between robots whose sensors are mounted differently.
        """
        lines, why = [] if self._unlike is None else [self._unlike], BODY_HAS_NO_NAME
        if self._bodies:
            bodies = ", ".join(sorted(self._bodies))
            why = f"odometry tells of {bodies}, and the bag has no static transform between them"
        for topic, frames in self._unknown.items() if self._has_odometry else ():
            named = ", ".join(list(frames)[:3])
            lines.append(
                f"{topic} is in frame {named}, but {why}: its edges are taken as they are; set edge_sensor_orientations"
            )
        return lines


def _frame_of_body(bag: BagReader, source: Input, sensor: Quaternion) -> str:
    """The frame whose motion odometry describes, by the first message that names one, as in the node; empty: none."""
    for _, _, message in bag.decoded([source.topic] if source.type_name in NAMES_ITS_BODY else []):
        try:
            frame = ODOMETRY_CONVERTERS[source.type_name](message, sensor).child_frame_id
        except RejectedInputError:
            continue
        if frame:
            return frame
    return ""
