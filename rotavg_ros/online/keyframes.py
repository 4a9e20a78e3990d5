"""A robot's odometry: which messages become keyframes, and its rotation at any moment in between."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online import quaternion
from rotavg_ros.online.growing_array import GrowingArray
from rotavg_ros.online.measurements import RejectedInputError, RejectReason, checked_rotation, checked_stamp
from rotavg_ros.online.odometry_continuity import ANY_MOTION, ContinuityCheck, ContinuityLimits, OdometrySample
from rotavg_ros.online.quaternion import UNKNOWN_VECTOR, Quaternion

Position = quaternion.Vector

_COLUMNS = ("stamp_ns", "world_from_body", "position", "is_keyframe", "chain")


@dataclass(frozen=True)
class KeyframePolicy:
    """When the odometry has moved far enough since the last keyframe.

    A threshold ≤ 0 switches its criterion off; with all of them off every message is a keyframe.

    Attributes:
        angle: radians.
        distance: metres; counts only while the odometry carries positions.
        interval_ns: nanoseconds.
    """

    angle: float
    distance: float
    interval_ns: int

    def reached(self, angle: float, distance: float, elapsed_ns: int) -> bool:
        if self.angle <= 0 and self.distance <= 0 and self.interval_ns <= 0:
            return True
        return (0 < self.angle <= angle) or (0 < self.distance <= distance) or (0 < self.interval_ns <= elapsed_ns)


@dataclass(frozen=True)
class OdometryBounds:
    """How far the odometry may be stretched when a moment between its messages is asked for.

    Attributes:
        tolerance_ns: a stamp this far before the first or after the last message takes that message's rotation.
        max_gap_ns: between two messages farther apart than this nothing is interpolated.
        max_samples: beyond it, the older half gives up every second message that is not a keyframe.
    """

    tolerance_ns: int
    max_gap_ns: int
    max_samples: int


class OdometryTrack:
    """The odometry messages of one robot in ascending order of their stamps.

    Where the odometry began anew a new chain begins: between chains nothing is known of the body's rotation.

    Attributes:
        latest: the last message.
        last_keyframe: of the latest message's chain.
        chain: number of the latest message's chain, from 0.
        anchors: world_from_odometry, one for every chain but the first, where whoever knows the world has set it.
    """

    def __init__(self, bounds: OdometryBounds, limits: ContinuityLimits = ANY_MOTION) -> None:
        self.bounds = bounds
        self.continuity = ContinuityCheck(limits)
        self._limit = bounds.max_samples
        self._stamp_ns = GrowingArray(np.int64)
        self._world_from_body = GrowingArray(np.float64, width=4)
        self._position = GrowingArray(np.float64, width=3)
        self._is_keyframe = GrowingArray(np.bool_)
        self._chain = GrowingArray(np.int32)
        self._before_latest: OdometrySample | None = None
        self.chain = 0
        self.anchors: list[Quaternion] = []
        self.latest: OdometrySample | None = None
        self.last_keyframe: OdometrySample | None = None
        self.num_keyframes = 0

    def add(self, stamp_ns: int, world_from_body: Sequence[float], position: Sequence[float] | None) -> OdometrySample:
        """Append a message.

        Args:
            stamp_ns: its stamp.
            world_from_body: xyzw.
            position: metres, or None; one that is not finite counts as None.

        Raises:
            RejectedInputError: a stamp not after the last one, a rotation that is none, or a message that does not
                go on from the last one and that no other sides with yet.
        """
        stamp_ns = checked_stamp(stamp_ns)
        rotation = checked_rotation(world_from_body)
        if self.latest is not None and stamp_ns <= self.latest.stamp_ns:
            repeated = stamp_ns == self.latest.stamp_ns
            raise RejectedInputError(RejectReason.REPEATED_STAMP if repeated else RejectReason.OUT_OF_ORDER_ODOMETRY)
        if position is not None:
            x, y, z = position
            position = (x, y, z) if math.isfinite(x + y + z) else None
        sample = OdometrySample(stamp_ns, rotation, position)
        if self.latest is not None and self.continuity.admit(sample, self.latest, self._before_latest):
            self.chain += 1
            self.latest = self.last_keyframe = None
        if len(self._stamp_ns) >= self._limit:
            self._thin_out()
        self._before_latest, self.latest = self.latest, sample
        self._stamp_ns.append(stamp_ns)
        self._world_from_body.append(rotation)
        self._position.append(UNKNOWN_VECTOR if position is None else position)
        self._is_keyframe.append(False)
        self._chain.append(self.chain)
        return self.latest

    def reached(self, policy: KeyframePolicy) -> bool:
        """Whether the latest message is far enough from the last keyframe to become one."""
        sample, keyframe = self.latest, self.last_keyframe
        if sample is None or keyframe is None:
            return sample is not None
        distance = 0.0
        if sample.position is not None and keyframe.position is not None:
            distance = math.dist(sample.position, keyframe.position)
        angle = quaternion.angle_between(keyframe.world_from_body, sample.world_from_body)
        return policy.reached(angle, distance, sample.stamp_ns - keyframe.stamp_ns)

    def mark_keyframe(self) -> None:
        """Make the latest message the last keyframe."""
        self._is_keyframe.view[-1] = True
        self.last_keyframe = self.latest
        self.num_keyframes += 1

    def reaches(self, stamp_ns: int) -> bool:
        """Whether the odometry has come as far as the stamp."""
        return self.latest is not None and self.latest.stamp_ns >= stamp_ns

    def within_tolerance(self, stamp_ns: int) -> bool:
        """Whether the stamp is at most the tolerance ahead of the odometry."""
        return self.reaches(stamp_ns - self.bounds.tolerance_ns)

    def world_from_body_at(self, stamp_ns: int) -> Quaternion:
        """The odometry's rotation at a moment: interpolated between two messages, clamped just outside of them.

        Raises:
            RejectedInputError: the stamp is outside the odometry by more than the tolerance, or inside a gap, which
                is also where one chain ends and another begins.
        """
        stamps = self._stamp_ns.view
        after = int(np.searchsorted(stamps, stamp_ns))
        tolerance = self.bounds.tolerance_ns
        if after < len(stamps) and stamps[after] == stamp_ns:
            return self._rotation(after)
        until_next = int(stamps[after]) - stamp_ns if after < len(stamps) else None
        since_last = stamp_ns - int(stamps[after - 1]) if after > 0 else None
        if until_next is None or since_last is None:
            if until_next is not None and until_next <= tolerance:
                return self._rotation(0)
            if since_last is not None and since_last <= tolerance:
                return self._rotation(after - 1)
            raise RejectedInputError(RejectReason.STAMP_OUT_OF_RANGE)
        if self._chain.view[after - 1] != self._chain.view[after]:
            if since_last > tolerance:
                raise RejectedInputError(RejectReason.ODOMETRY_GAP)
            return self._rotation(after - 1)
        gap = since_last + until_next
        if gap > self.bounds.max_gap_ns:
            if min(since_last, until_next) > tolerance:
                raise RejectedInputError(RejectReason.ODOMETRY_GAP)
            return self._rotation(after if until_next < since_last else after - 1)
        return quaternion.slerp(self._rotation(after - 1), self._rotation(after), since_last / gap)

    def position_at(self, stamp_ns: int) -> Position:
        """The odometry's position at a moment: interpolated, clamped at the ends, NaN without positions."""
        stamps, positions = self._stamp_ns.view, self._position.view
        after = min(int(np.searchsorted(stamps, stamp_ns)), len(stamps) - 1)
        before = max(after - 1, 0)
        gap = int(stamps[after] - stamps[before])
        share = min(max((stamp_ns - int(stamps[before])) / gap, 0.0), 1.0) if gap else 1.0
        if share < 1 and self._chain.view[before] != self._chain.view[after]:
            share = 0.0
        x, y, z = (
            positions[after] if share == 1 else (1 - share) * positions[before] + share * positions[after]
        ).tolist()
        return (x, y, z)

    def chain_at(self, stamp_ns: int) -> int:
        """Number of the chain that a moment belongs to. There must be a message."""
        return int(self._chain.view[max(int(np.searchsorted(self._stamp_ns.view, stamp_ns, "right")) - 1, 0)])

    def first_body_from_world(self) -> Quaternion:
        """Inverse of the first message's rotation."""
        return quaternion.inverse(self._rotation(0))

    def _rotation(self, index: int) -> Quaternion:
        x, y, z, w = self._world_from_body.view[index].tolist()
        return (x, y, z, w)

    def _thin_out(self) -> None:
        size = len(self._stamp_ns)
        keep = self._is_keyframe.view | (np.arange(size) % 2 == 0) | (np.arange(size) >= size // 2)
        for name in _COLUMNS:
            column = getattr(self, f"_{name}")
            thinned = GrowingArray(column.view.dtype, *column.view.shape[1:])
            thinned.extend(column.view[keep])
            setattr(self, f"_{name}", thinned)
        # Where keyframes fill the room the limit yields; a quarter of it at least lies between two thinnings.
        self._limit = max(self.bounds.max_samples, int(keep.sum()) + self.bounds.max_samples // 4 + 1)

    def release_keyframes(self, kept_stamps_ns: NDArray[np.int64]) -> None:
        """Where keyframes take up most of the room, let those be thinned out that are no longer in the graph."""
        if np.count_nonzero(self._is_keyframe.view) > self.bounds.max_samples // 2:
            self._is_keyframe.view[:] &= np.isin(self._stamp_ns.view, kept_stamps_ns)

    def poses_at(
        self, stamp_ns: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
        """The messages at or next after the stamps ``(K,)``.

        Returns:
            world_from_body ``(K, 4)``, position ``(K, 3)`` and number of the chain ``(K,)``.

        Positions are NaN where the odometry carries none. There must be a message.
        """
        index = np.minimum(np.searchsorted(self._stamp_ns.view, stamp_ns), len(self._stamp_ns) - 1)
        return self._world_from_body.view[index], self._position.view[index], self._chain.view[index]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The messages as arrays, for :meth:`from_arrays`."""
        columns = {name: getattr(self, f"_{name}").view for name in _COLUMNS}
        columns["is_keyframe"] = columns["is_keyframe"].copy()
        anchors = np.array(self.anchors, dtype=np.float64).reshape(-1, 4)
        return columns | {"num_keyframes": np.array(self.num_keyframes), "anchors": anchors}

    @classmethod
    def from_arrays(
        cls, bounds: OdometryBounds, arrays: dict[str, NDArray[Any]], limits: ContinuityLimits = ANY_MOTION
    ) -> OdometryTrack:
        """The track that :meth:`arrays` came from."""
        track = cls(bounds, limits)
        for name in _COLUMNS:
            getattr(track, f"_{name}").extend(arrays[name])
        track.num_keyframes = int(arrays["num_keyframes"])
        track.anchors = [(x, y, z, w) for x, y, z, w in arrays["anchors"].tolist()]
        if len(track._stamp_ns):
            track.latest, track.chain = track._sample(-1), int(track._chain.view[-1])
        keyframes = np.flatnonzero(arrays["is_keyframe"] & (arrays["chain"] == track.chain))
        if len(keyframes):
            track.last_keyframe = track._sample(int(keyframes[-1]))
        return track

    def _sample(self, index: int) -> OdometrySample:
        x, y, z = self._position.view[index].tolist()
        position = (x, y, z) if math.isfinite(x) else None
        return OdometrySample(int(self._stamp_ns.view[index]), self._rotation(index), position)
