"""When the odometry has moved far enough for another keyframe."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class KeyframePolicy:
    """When the odometry has moved far enough since the last keyframe.

    A threshold ≤ 0 switches its criterion off; with all of them off every message is a keyframe.

    Attributes:
        angle: radians.
        distance: metres; applies only while the odometry carries positions.
        interval_ns: nanoseconds.
    """

    angle: float
    distance: float
    interval_ns: int

    def reached(self, angle: float, distance: float, elapsed_ns: int) -> bool:
        if self.angle <= 0 and self.distance <= 0 and self.interval_ns <= 0:
            return True
        return (0 < self.angle <= angle) or (0 < self.distance <= distance) or (0 < self.interval_ns <= elapsed_ns)
