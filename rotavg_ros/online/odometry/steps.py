"""How many steps odometry has made since a keyframe that a front end chose, which counts no steps of odometry."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rotavg_ros.online.odometry.continuity import OdometrySample, angle_and_metres


@dataclass(frozen=True)
class StepSize:
    """The step from one keyframe of a robot to the next.

    Attributes:
        angle: root mean square of their angles, radians; 0 unknown.
        distance: root mean square of their lengths, metres; 0 unknown.
    """

    angle: float
    distance: float

    def number(self, first: OdometrySample, second: OdometrySample) -> float:
        """How many such steps in one direction lead from one pose to another."""
        moved = zip(angle_and_metres(first, second), (self.angle, self.distance), strict=True)
        squares = [(way / step) ** 2 for way, step in moved if step > 0]
        return math.sqrt(sum(squares) / len(squares)) if squares else 0.0


class OdometrySteps:
    """Counts steps of a size while the robot moves; one that stands still makes none.

    Attributes:
        moment: stamp and time line of the keyframe.
        count: number of whole steps since.
    """

    def __init__(self, size: StepSize, time_line: int, keyframe: OdometrySample, latest: OdometrySample) -> None:
        """Begin at the latest message, with the steps that lead there straight from the keyframe."""
        self.moment = keyframe.stamp_ns, time_line
        self.count = int(size.number(keyframe, latest))
        self._size, self._from = size, latest

    def go_on(self, sample: OdometrySample) -> None:
        """Take the next message."""
        if self._size.number(self._from, sample) >= 1:
            self.count += 1
            self._from = sample
