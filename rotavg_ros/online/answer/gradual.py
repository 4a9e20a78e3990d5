"""A robot's pose whose corrections are spread over time, for controllers that must not see it jump."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from rotavg_ros.online import quaternion
from rotavg_ros.online.answer.odometry_frame import OdometryFrame
from rotavg_ros.online.quaternion import Vector


@dataclass(frozen=True)
class CorrectionRates:
    """How fast a correction may move the body, besides the motion from odometry; 0: at once.

    Attributes:
        turn: rotation, rad/s.
        way: translation, m/s.
    """

    turn: float = 0.0
    way: float = 0.0


class GradualFrame:
    """Follows a robot's odometry frame so that the body turns and moves to where it belongs no faster than allowed.

    What is limited is the body's motion, not the frame's: far from odometry's origin a slight turn of the frame moves
    the body by metres. Time is the odometry's own. When odometry begins anew, or the robot's clock goes back, the frame
    is taken at once.
    """

    def __init__(self, rates: CorrectionRates) -> None:
        self.rates = rates
        self._frame: OdometryFrame | None = None
        self._stamp_ns = 0

    def follow(self, frame: OdometryFrame, stamp_ns: int, odometry_position: Vector) -> OdometryFrame:
        """The frame to publish at an odometry message.

        Args:
            frame: where the odometry's frame belongs.
            stamp_ns: stamp of the message, nanoseconds.
            odometry_position: position of the body in the odometry's frame, metres.
        """
        before, elapsed_ns = self._frame, stamp_ns - self._stamp_ns
        if before is not None and before.chain == frame.chain and elapsed_ns > 0:
            frame = self._nearer(before, frame, 1e-9 * elapsed_ns, odometry_position)
        self._frame, self._stamp_ns = frame, stamp_ns
        return frame

    def _nearer(self, before: OdometryFrame, frame: OdometryFrame, seconds: float, at: Vector) -> OdometryFrame:
        old, new = before.place(at), frame.place(at)
        way = self._share(math.dist(old, new), self.rates.way * seconds)
        turn = self._share(quaternion.angle_between(before.orientation, frame.orientation), self.rates.turn * seconds)
        if way == turn == 1.0:
            return frame
        x, y, z = ((1 - way) * a + way * b for a, b in zip(old, new, strict=True))
        orientation = quaternion.slerp(before.orientation, frame.orientation, turn)
        turned = quaternion.rotate(orientation, at)
        return replace(frame, orientation=orientation, origin=quaternion.difference((x, y, z), turned))

    @staticmethod
    def _share(needed: float, allowed: float) -> float:
        """Share of the needed correction that is allowed; 1 where there is no limit."""
        return 1.0 if allowed == 0.0 or needed <= allowed else allowed / needed
