"""How many steps odometry has made since a keyframe that a front end chose, which counts no steps of odometry."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rotavg_ros.online.odometry.continuity import OdometrySample, angle_and_metres
from rotavg_ros.online.quaternion import Vector


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
        first, last = (np.array(sample.position or (0.0, 0.0, 0.0)) for sample in (keyframe, latest))
        made_at = first + (np.arange(self.count)[:, None] + 0.5) / max(self.count, 1) * (last - first)
        self._places, self._squares = made_at.sum(axis=0), float((made_at**2).sum())

    def go_on(self, sample: OdometrySample) -> None:
        """Take the next message."""
        if self._size.number(self._from, sample) >= 1:
            self.count += 1
            self._from = sample
            place = np.array(sample.position or (0.0, 0.0, 0.0))
            self._places += place
            self._squares += float(place @ place)

    def square_lever(self, position: Vector) -> float:
        """Mean square distance of a position from where the steps were made, m²: over it their turns move it."""
        if not self.count:
            return 0.0
        place = np.array(position)
        return max(0.0, float(place @ place + (self._squares - 2 * place @ self._places) / self.count))
