"""A robot's odometry: which messages continue the last one, and which become keyframes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online import quaternion
from rotavg_ros.online.measurements import (
    RejectedInputError,
    RejectReason,
    check_length,
    checked_rotation,
    checked_stamp,
)
from rotavg_ros.online.odometry.continuity import ANY_MOTION, ContinuityCheck, ContinuityLimits, OdometrySample
from rotavg_ros.online.odometry.keyframe_choice import KeyframePolicy
from rotavg_ros.online.odometry.samples import OdometryBounds, OdometrySamples
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.stamps import NANOSECONDS

# The clock cannot overtake odometry by more than this: edges by stamp wait for the first message from after it.
_LONGEST_UNDER_WAY_NS = 60 * NANOSECONDS


class OdometryTrack:
    """The odometry of one robot, in chains between which the body's rotation is unknown.

    A new chain begins where the odometry began anew, where the robot's clock went back, and where, after a restore
    from a file, it is not certain that the odometry has continued.

    Attributes:
        samples: the messages.
        latest: the last message.
        last_keyframe: the last keyframe of the latest message's chain.
        chain: number of the latest message's chain, from 0.
        time_line: number of the latest message's time line, from 0.
        anchors: world_from_odometry, one for every chain but the first, set by whoever knows the world.
        num_keyframes: id of the next keyframe; equals the number of keyframes unless a front end has taken ids between.
    """

    def __init__(self, bounds: OdometryBounds, limits: ContinuityLimits = ANY_MOTION) -> None:
        self.samples = OdometrySamples(bounds)
        self.chain = self.time_line = 0
        self.anchors: list[Quaternion] = []
        self.latest: OdometrySample | None = None
        self.last_keyframe: OdometrySample | None = None
        self.num_keyframes = 0
        self._continuity = ContinuityCheck(limits)
        self._before_latest: OdometrySample | None = None
        self._begins_time_line = False
        self._clock_went_back_at: int | None = None
        self._is_restored = False
        self._without_position_since: int | None = None

    def set_limits(self, bounds: OdometryBounds, limits: ContinuityLimits) -> None:
        """Change what applies from now on."""
        self.samples.bounds, self._continuity.limits = bounds, limits

    def await_time_line(self) -> None:
        """The clock that stamps the odometry went back. Messages from before may still be on their way."""
        assert self.latest is not None
        self._clock_went_back_at = self.latest.stamp_ns

    @property
    def awaits_time_line(self) -> bool:
        """Whether the clock went back, and no message from after it has come yet.

        Odometry that goes on for ``lead_ns``, or for a minute, as if nothing had happened is stamped by another clock.
        """
        at, latest, lead_ns = self._clock_went_back_at, self.latest, self._continuity.limits.lead_ns
        lead_ns = min(lead_ns, _LONGEST_UNDER_WAY_NS)
        return at is not None and latest is not None and latest.stamp_ns - at <= lead_ns

    def comes_after_the_clock(self, stamp_ns: int, time_jump_ns: int) -> bool:
        """Whether a message with this stamp is the first from after the clock went back."""
        is_back = self.latest is not None and self.latest.stamp_ns - stamp_ns > time_jump_ns
        return self.awaits_time_line and is_back

    def begin_time_line(self) -> None:
        """The robot's clock went back: the next message begins a new time line, whatever its stamp."""
        self._begins_time_line, self._clock_went_back_at = True, None

    @property
    def begins_time_line(self) -> bool:
        """Whether the next message begins a new time line."""
        return self._begins_time_line

    def add(
        self,
        stamp_ns: int,
        world_from_body: Sequence[float],
        position: Sequence[float] | None,
        body_from_sensor: Sequence[float] = quaternion.IDENTITY,
    ) -> OdometrySample:
        """Append a message.

        Args:
            stamp_ns: its stamp.
            world_from_body: xyzw.
            position: metres, or None; one that is not finite counts as None.
            body_from_sensor: xyzw, of the sensor at whose zero pose the odometry begins.

        Raises:
            RejectedInputError: the stamp is not after the last one, the rotation or position is invalid, or the message
                does not continue the last one and no other confirms it yet.
        """
        stamp_ns = checked_stamp(stamp_ns)
        rotation, beginning = checked_rotation(world_from_body), quaternion.inverse(checked_rotation(body_from_sensor))
        check_length(position, 3)
        if self.latest is not None and stamp_ns <= self.latest.stamp_ns and not self._begins_time_line:
            repeated = stamp_ns == self.latest.stamp_ns
            raise RejectedInputError(RejectReason.REPEATED_STAMP if repeated else RejectReason.OUT_OF_ORDER_ODOMETRY)
        has_lost_position = False
        if position is not None:
            x, y, z = position
            has_lost_position = not math.isfinite(x + y + z)
            position = None if has_lost_position else (x, y, z)
        sample = OdometrySample(stamp_ns, rotation, position, beginning)
        if self._begins_time_line:
            self._continuity.forget()
            self.time_line += 1
            self._begin_chain()
        elif self.latest is not None and self._begins_anew(sample, self.latest):
            self._begin_chain()
        self._begins_time_line = self._is_restored = False
        self._before_latest, self.latest = self.latest, sample
        self._note_position(has_lost_position)
        self.samples.append(sample, self.chain, self.time_line)
        return sample

    def _note_position(self, has_lost_position: bool) -> None:
        """Note since when positions are missing, if the last keyframe has one or there is no keyframe yet."""
        assert self.latest is not None
        if not has_lost_position or (self.last_keyframe is not None and self.last_keyframe.position is None):
            self._without_position_since = None
        elif self._without_position_since is None:
            self._without_position_since = self.latest.stamp_ns

    def _begins_anew(self, sample: OdometrySample, latest: OdometrySample) -> bool:
        if self._is_restored:
            return self._continuity.admit_after_a_break(sample, latest, self._before_latest)
        return self._continuity.admit(sample, latest, self._before_latest)

    def _begin_chain(self) -> None:
        self.chain += 1
        self.latest = self.last_keyframe = None
        self._without_position_since = None

    def reached(self, policy: KeyframePolicy) -> bool:
        """Whether the latest message is far enough from the last keyframe to become one.

        A message without a position (NaN) does not become a keyframe until positions have been missing for longer than
        odometry may pause. An edge at a keyframe without a position has no translation, and unless all odometry has
        translations the solver does not judge places.
        """
        sample, keyframe = self.latest, self.last_keyframe
        if sample is None:
            return False
        since = self._without_position_since
        if since is not None and sample.stamp_ns - since <= self.samples.bounds.max_gap_ns:
            return False
        if keyframe is None:
            return True
        distance = 0.0
        if sample.position is not None and keyframe.position is not None:
            distance = math.dist(sample.position, keyframe.position)
        angle = quaternion.angle_between(keyframe.world_from_body, sample.world_from_body)
        return policy.reached(angle, distance, sample.stamp_ns - keyframe.stamp_ns)

    def mark_keyframe(self) -> None:
        """Make the latest message the last keyframe."""
        self.samples.mark_keyframe()
        self.last_keyframe = self.latest
        self.num_keyframes += 1

    def reaches(self, stamp_ns: int) -> bool:
        """Whether the odometry has reached the stamp."""
        return self.latest is not None and self.latest.stamp_ns >= stamp_ns

    def within_tolerance(self, stamp_ns: int) -> bool:
        """Whether the stamp is at most the tolerance ahead of the odometry."""
        return self.reaches(stamp_ns - self.samples.bounds.tolerance_ns)

    def time_line_of(self, stamp_ns: int) -> int:
        """Number of the time line that a stamp from outside means, see :meth:`OdometrySamples.time_line_of`."""
        return self.samples.time_line_of(stamp_ns, self._continuity.limits.lead_ns)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Everything as arrays, for :meth:`from_arrays`."""
        anchors = np.array(self.anchors, dtype=np.float64).reshape(-1, 4)
        return (
            self.samples.arrays()
            | self._continuity.arrays()
            | {
                "num_keyframes": np.array(self.num_keyframes),
                "anchors": anchors,
                "begins_time_line": np.array(self._begins_time_line),
                "clock_went_back_at": _stamp_or_none(self._clock_went_back_at),
                "without_position_since": _stamp_or_none(self._without_position_since),
            }
        )

    @classmethod
    def from_arrays(
        cls, bounds: OdometryBounds, arrays: dict[str, NDArray[Any]], limits: ContinuityLimits = ANY_MOTION
    ) -> OdometryTrack:
        """The track that :meth:`arrays` came from; its next message decides whether odometry has continued."""
        track = cls(bounds, limits)
        track.samples = samples = OdometrySamples.from_arrays(bounds, arrays)
        track._continuity = ContinuityCheck.from_arrays(limits, arrays)
        track.num_keyframes = int(arrays["num_keyframes"])
        track.anchors = [(x, y, z, w) for x, y, z, w in arrays["anchors"].tolist()]
        track._begins_time_line = bool(arrays["begins_time_line"])
        # Files of earlier versions do not have these two.
        track._clock_went_back_at, track._without_position_since = (
            next(iter(arrays.get(name, np.empty(0)).tolist()), None)
            for name in ("clock_went_back_at", "without_position_since")
        )
        track._before_latest, track.latest, track.last_keyframe = samples.latest_of_chain()
        track.chain, track.time_line = samples.last_chain, samples.last_time_line
        track._is_restored = track.latest is not None
        return track


def _stamp_or_none(stamp_ns: int | None) -> NDArray[np.int64]:
    """A stamp as an array of one, None as one of none."""
    return np.array([] if stamp_ns is None else [stamp_ns], dtype=np.int64)
