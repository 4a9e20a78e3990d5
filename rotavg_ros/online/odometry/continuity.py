"""Whether an odometry message continues the one before: stamps far ahead, jumps, and odometry that begins anew."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online import quaternion
from rotavg_ros.online.measurements import RejectedInputError, RejectReason
from rotavg_ros.online.quaternion import UNKNOWN_VECTOR, Quaternion, Vector

# Over a shorter time than this, stamps and rotations are too noisy for a rate to mean anything.
_SHORTEST_S = 0.2
# A pose this near to zero counts as the start of odometry, and one this near to another as the same pose …
_ZERO_ANGLE = math.radians(1.0)
_ZERO_DISTANCE_M = 0.1
# … and odometry at zero counts as begun anew if its last motion, continued, would have led farther away than this.
_RETURN_ANGLE = math.radians(20.0)
_RETURN_DISTANCE_M = 1.0
# The last motion is continued at each of these shares of its speed: a robot may brake, or stop where it started.
_SHARES_OF_SPEED = (0.0, 0.5, 1.0)


@dataclass(frozen=True, slots=True)
class OdometrySample:
    """One odometry message: the body's pose in the odometry's frame at a stamp.

    Attributes:
        stamp_ns: nanoseconds.
        world_from_body: xyzw.
        position: metres; None where unknown.
        beginning: world_from_body where such odometry begins; not the identity if it begins at a sensor's zero.
    """

    stamp_ns: int
    world_from_body: Quaternion
    position: Vector | None
    beginning: Quaternion = quaternion.IDENTITY


@dataclass(frozen=True)
class ContinuityLimits:
    """The largest believable change between two odometry messages; infinite: no limit.

    Attributes:
        turn_rate: rad/s.
        speed: m/s; applies only while the odometry carries positions.
        lead_ns: a stamp farther ahead of the last than this has to be confirmed by the next.
    """

    turn_rate: float = math.inf
    speed: float = math.inf
    lead_ns: float = math.inf


ANY_MOTION = ContinuityLimits()


class ContinuityCheck:
    """Refuses a message that does not continue the last one, until the next one confirms it.

    So a single message with a stamp years ahead or a wild pose is refused, and a source that paused or began anew
    loses one message. All decisions depend on messages alone, so a bag is judged as the robot was.
    """

    def __init__(self, limits: ContinuityLimits) -> None:
        self.limits = limits
        self._refused: OdometrySample | None = None
        self._refused_jumps = False

    def admit(self, sample: OdometrySample, last: OdometrySample, before: OdometrySample | None) -> bool:
        """Judge a message that is stamped after the last one admitted.

        Args:
            sample: the message.
            last, before: the last admitted message of the same chain, and the one before it, if any.

        Returns:
            whether the odometry has begun anew, so that the rotation since ``last`` is unknown.

        Raises:
            RejectedInputError: no other message confirms this one yet.
        """
        return self._judge(sample, last, before, after_break=False)

    def admit_after_a_break(self, sample: OdometrySample, last: OdometrySample, before: OdometrySample | None) -> bool:
        """As :meth:`admit`, when the robot may have been switched off since ``last``, and nobody was watching.

        Odometry counts as begun anew unless :func:`goes_on`, and either at most ``lead_ns`` has passed or the robot
        :func:`stands_still`.
        """
        return self._judge(sample, last, before, after_break=True)

    def _judge(
        self, sample: OdometrySample, last: OdometrySample, before: OdometrySample | None, *, after_break: bool
    ) -> bool:
        refused, refused_jumps = self._refused, self._refused_jumps
        self._refused = None
        is_ahead = sample.stamp_ns - last.stamp_ns > self.limits.lead_ns
        follows = refused is not None and 0 < sample.stamp_ns - refused.stamp_ns <= self.limits.lead_ns
        if refused is not None and follows and (is_ahead or _distance(refused, sample) < _distance(last, sample)):
            return refused_jumps or (after_break and not goes_on(sample, refused, self.limits))
        jumps = has_jumped(sample, last, before, self.limits)
        if is_ahead or jumps:
            self._refused, self._refused_jumps = sample, jumps or (after_break and not stands_still(sample, last))
            raise RejectedInputError(RejectReason.FUTURE_STAMP if is_ahead else RejectReason.ODOMETRY_JUMP)
        return after_break and not goes_on(sample, last, self.limits)

    def forget(self) -> None:
        """Forget the refused message, which is unrelated to what comes next."""
        self._refused = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The message refused last, for :meth:`from_arrays`: a row of stamp, rotation and position, or none."""
        refused = [] if self._refused is None else [self._refused]
        return {
            "refused_stamp_ns": np.array([sample.stamp_ns for sample in refused], dtype=np.int64),
            "refused_world_from_body": np.array([sample.world_from_body for sample in refused]).reshape(-1, 4),
            "refused_position": np.array([sample.position or UNKNOWN_VECTOR for sample in refused]).reshape(-1, 3),
            "refused_jumps": np.array(self._refused_jumps),
        }

    @classmethod
    def from_arrays(cls, limits: ContinuityLimits, arrays: dict[str, NDArray[Any]]) -> ContinuityCheck:
        """The check that :meth:`arrays` came from."""
        check = cls(limits)
        columns = (arrays[f"refused_{name}"].tolist() for name in ("stamp_ns", "world_from_body", "position"))
        for stamp_ns, (qx, qy, qz, qw), (x, y, z) in zip(*columns, strict=True):
            check._refused = OdometrySample(stamp_ns, (qx, qy, qz, qw), (x, y, z) if math.isfinite(x) else None)
        check._refused_jumps = bool(arrays["refused_jumps"])
        return check


def has_jumped(
    sample: OdometrySample, last: OdometrySample, before: OdometrySample | None, limits: ContinuityLimits
) -> bool:
    """Whether no motion within the limits leads from one message to the next.

    Args:
        sample: the message.
        last: the message before it.
        before: the message before that, if any.
        limits: with an infinite turn rate, odometry that begins anew is not detected either.
    """
    seconds = max(1e-9 * (sample.stamp_ns - last.stamp_ns), _SHORTEST_S)
    angle, metres = angle_and_metres(last, sample)
    if angle > limits.turn_rate * seconds or metres > limits.speed * seconds:
        return True
    if math.isinf(limits.turn_rate) or before is None or last.stamp_ns <= before.stamp_ns or not _is_zero(sample):
        return False
    for share in _SHARES_OF_SPEED:
        angle, metres = angle_and_metres(_going_on(last, before, sample.stamp_ns, share), sample)
        if angle <= _RETURN_ANGLE and metres <= _RETURN_DISTANCE_M:
            return False
    return True


def goes_on(sample: OdometrySample, last: OdometrySample, limits: ContinuityLimits) -> bool:
    """Whether odometry, unobserved in between, is nearer to its last pose than to zero, where it would begin.

    Args:
        sample: the message.
        last: the last one before.
        limits: with an infinite turn rate it always counts as going on.
    """
    return math.isinf(limits.turn_rate) or _distance(last, sample) < _distance(_beginning(sample), sample)


def stands_still(sample: OdometrySample, last: OdometrySample) -> bool:
    """Whether a message repeats the last pose, and that pose is not one at which odometry begins."""
    angle, metres = angle_and_metres(last, sample)
    return angle < _ZERO_ANGLE and metres < _ZERO_DISTANCE_M and _distance(_beginning(sample), sample) > 1


def _beginning(sample: OdometrySample) -> OdometrySample:
    return OdometrySample(sample.stamp_ns, sample.beginning, (0.0, 0.0, 0.0))


def angle_and_metres(first: OdometrySample, second: OdometrySample) -> tuple[float, float]:
    """Angle and distance between two poses, radians and metres; the distance is 0 where a position is unknown."""
    metres = 0.0
    if first.position is not None and second.position is not None:
        metres = math.dist(first.position, second.position)
    return quaternion.angle_between(first.world_from_body, second.world_from_body), metres


def _distance(first: OdometrySample, second: OdometrySample) -> float:
    """How far apart two poses are, in units of :data:`_RETURN_ANGLE` and :data:`_RETURN_DISTANCE_M`."""
    angle, metres = angle_and_metres(first, second)
    return angle / _RETURN_ANGLE + metres / _RETURN_DISTANCE_M


def _is_zero(sample: OdometrySample) -> bool:
    near = sample.position is None or math.hypot(*sample.position) < _ZERO_DISTANCE_M
    return near and quaternion.angle_between(sample.world_from_body, sample.beginning) < _ZERO_ANGLE


def _going_on(last: OdometrySample, before: OdometrySample, stamp_ns: int, share: float) -> OdometrySample:
    """The pose at a stamp, at a share of the last two messages' speed and at most one more such step away."""
    steps = share * min(1.0, (stamp_ns - last.stamp_ns) / (last.stamp_ns - before.stamp_ns))
    turn = quaternion.multiply(quaternion.inverse(before.world_from_body), last.world_from_body)
    rotation = quaternion.multiply(last.world_from_body, quaternion.slerp(quaternion.IDENTITY, turn, steps))
    position = last.position
    if position is not None and before.position is not None:
        x, y, z = (now + steps * (now - then) for now, then in zip(position, before.position, strict=True))
        position = (x, y, z)
    return OdometrySample(stamp_ns, rotation, position)
