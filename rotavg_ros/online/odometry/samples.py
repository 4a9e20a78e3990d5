"""A robot's odometry messages as they were taken, and the body's pose at any moment between them."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rotavg_ros import rotations
from rotavg_ros.online import quaternion
from rotavg_ros.online.growing_array import GrowingArray
from rotavg_ros.online.measurements import RejectedInputError, RejectReason
from rotavg_ros.online.odometry.continuity import OdometrySample
from rotavg_ros.online.quaternion import UNKNOWN_VECTOR, Quaternion, Vector

_COLUMNS = ("stamp_ns", "world_from_body", "position", "is_keyframe", "chain", "time_line", "stood_still")
# Between two messages whose poses differ by less, a robot stands still, as where odometry goes on after a restart.
_STILL_ANGLE = math.radians(1.0)
_STILL_DISTANCE_M = 0.1
# Share of max_samples that stays though it is its turn to go, since without it some closures could not be placed. With
# it, and without keyframes, at most 1.25 max_samples are kept.
_SPARED = 1 / 16


@dataclass(frozen=True)
class OdometryBounds:
    """How far odometry may be extended or interpolated for a moment between its messages, and how much is kept.

    Attributes:
        tolerance_ns: a stamp this far before the first or after the last message takes that message's rotation.
        max_gap_ns: there is no interpolation between two messages farther apart than this, unless messages between
            them were removed in which the robot stood still.
        max_samples: beyond it, every second message of the older half that is not a keyframe is removed, apart from a
            few without which such a gap would arise while the robot moved.
    """

    tolerance_ns: int
    max_gap_ns: int
    max_samples: int


class OdometrySamples:
    """Messages in the order in which they were taken, in chains and time lines.

    Between two chains the body's rotation is unknown. Stamps ascend within a time line; where the robot's clock went
    back, a new time line begins and a new chain with it. So a stamp defines a moment only together with the number of
    its time line; if that is left out, the present one is meant.

    Attributes:
        bounds: see :class:`OdometryBounds`.
    """

    def __init__(self, bounds: OdometryBounds) -> None:
        self.bounds = bounds
        self._limit = bounds.max_samples
        self._stamp_ns = GrowingArray(np.int64)
        self._world_from_body = GrowingArray(np.float64, 4)
        self._position = GrowingArray(np.float64, 3)
        self._is_keyframe = GrowingArray(np.bool_)
        # As wide as the values looked up in them: a search would copy narrower columns whole.
        self._chain = GrowingArray(np.int64)
        self._time_line = GrowingArray(np.int64)
        self._stood_still = GrowingArray(np.bool_)  # in the messages that were removed between it and the one before

    def __len__(self) -> int:
        return len(self._stamp_ns)

    def append(self, sample: OdometrySample, chain: int, time_line: int) -> None:
        """Add a message at the end; the older half is thinned out where there are too many."""
        if len(self) >= self._limit:
            self._thin_out()
        self._stamp_ns.append(sample.stamp_ns)
        self._world_from_body.append(sample.world_from_body)
        self._position.append(UNKNOWN_VECTOR if sample.position is None else sample.position)
        self._is_keyframe.append(False)
        self._chain.append(chain)
        self._time_line.append(time_line)
        self._stood_still.append(False)

    def frozen(self) -> OdometrySamples:
        """A read-only copy of the messages so far, safe to read while others come and old ones are thinned out."""
        frozen = copy.copy(self)
        for name in _COLUMNS:
            setattr(frozen, f"_{name}", copy.copy(getattr(self, f"_{name}")))
        return frozen

    def mark_keyframe(self) -> None:
        """Mark the last message, so that it is never thinned out."""
        self._is_keyframe.view[-1] = True

    def release_keyframes(self, kept_stamps_ns: NDArray[np.int64], kept_time_lines: NDArray[np.int64]) -> None:
        """If keyframes take up most of the room, allow thinning of all but these ``(K,)``."""
        if np.count_nonzero(self._is_keyframe.view) > self.bounds.max_samples // 2:
            rows = self._rows_from(kept_stamps_ns, kept_time_lines)
            kept = np.zeros(len(self), dtype=bool)
            kept[rows[self._stamp_ns.view[rows] == kept_stamps_ns]] = True
            self._is_keyframe.view[:] &= kept

    def latest_of_chain(self) -> tuple[OdometrySample | None, OdometrySample | None, OdometrySample | None]:
        """Of the last message's chain: the message before the last, the last message, the last keyframe."""
        if not len(self):
            return None, None, None
        chain = self._chain.view
        keyframes = np.flatnonzero(self._is_keyframe.view & (chain == chain[-1]))
        return (
            self._sample(-2) if len(self) > 1 and chain[-2] == chain[-1] else None,
            self._sample(-1),
            self._sample(int(keyframes[-1])) if len(keyframes) else None,
        )

    def reach(self) -> tuple[int, int]:
        """First and last stamp that the last message's chain covers, apart from gaps. There must be a message.

        The tolerance is included, but not towards another chain of the same time line.
        """
        stamps, time_line, tolerance_ns = self._stamp_ns.view, self._time_line.view, self.bounds.tolerance_ns
        first = int(np.searchsorted(self._chain.view, self.last_chain))
        begins_time_line = first == 0 or time_line[first - 1] != time_line[first]
        return int(stamps[first]) - (tolerance_ns if begins_time_line else 0), int(stamps[-1]) + tolerance_ns

    def seam(self, chain: int) -> tuple[OdometrySample, OdometrySample]:
        """The last message before a chain, and its first."""
        first = int(np.searchsorted(self._chain.view, chain))
        return self._sample(first - 1), self._sample(first)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the messages ``(n,)`` in the order in which they were taken, not copied."""
        return self._stamp_ns.view

    @property
    def last_chain(self) -> int:
        return int(self._chain.view[-1]) if len(self) else 0

    @property
    def last_time_line(self) -> int:
        return int(self._time_line.view[-1]) if len(self) else 0

    def time_line_of(self, stamp_ns: int, lead_ns: float) -> int:
        """Number of the time line that a stamp from outside means. There must be a message.

        It is the present one from its first message until ``lead_ns`` after its last. For any other stamp it is the
        latest time line with messages on both sides of it, or the present one if there is none.
        """
        present, tolerance_ns = self.last_time_line, self.bounds.tolerance_ns
        if present == 0:
            return 0
        stamps = self._stamp_ns.view[self._rows_of(present)]
        if stamps[0] - tolerance_ns <= stamp_ns <= int(stamps[-1]) + lead_ns:
            return present
        starts = np.searchsorted(self._time_line.view, np.arange(present + 1))
        first, last = self._stamp_ns.view[starts[:-1]], self._stamp_ns.view[starts[1:] - 1]
        covering = np.flatnonzero((first - tolerance_ns <= stamp_ns) & (stamp_ns <= last + tolerance_ns))
        return int(covering[-1]) if len(covering) else present

    def world_from_body_at(self, stamp_ns: int, time_line: int | None = None) -> Quaternion:
        """The odometry's rotation at a moment: interpolated between two messages, clamped just outside them.

        Raises:
            RejectedInputError: the stamp is outside the odometry by more than the tolerance, or inside a gap, which
                is also where one chain ends and another begins.
        """
        line = self._rows_of(time_line)
        stamps = self._stamp_ns.view
        after = line.start + int(np.searchsorted(stamps[line], stamp_ns))
        tolerance = self.bounds.tolerance_ns
        if after < line.stop and stamps[after] == stamp_ns:
            return self._rotation(after)
        until_next = int(stamps[after]) - stamp_ns if after < line.stop else None
        since_last = stamp_ns - int(stamps[after - 1]) if after > line.start else None
        if until_next is None or since_last is None:
            if until_next is not None and until_next <= tolerance:
                return self._rotation(line.start)
            if since_last is not None and since_last <= tolerance:
                return self._rotation(after - 1)
            raise RejectedInputError(RejectReason.STAMP_OUT_OF_RANGE)
        if self._chain.view[after - 1] != self._chain.view[after]:
            if since_last > tolerance:
                raise RejectedInputError(RejectReason.ODOMETRY_GAP)
            return self._rotation(after - 1)
        gap = since_last + until_next
        if gap > self.bounds.max_gap_ns and not self._stood_still.view[after]:
            if min(since_last, until_next) > tolerance:
                raise RejectedInputError(RejectReason.ODOMETRY_GAP)
            return self._rotation(after if until_next < since_last else after - 1)
        return quaternion.slerp(self._rotation(after - 1), self._rotation(after), since_last / gap)

    def position_at(self, stamp_ns: int, time_line: int | None = None) -> Vector:
        """The odometry's position at a moment: interpolated, clamped at the ends, NaN without positions."""
        line = self._rows_of(time_line)
        stamps, positions = self._stamp_ns.view, self._position.view
        after = min(line.start + int(np.searchsorted(stamps[line], stamp_ns)), line.stop - 1)
        before = max(after - 1, line.start)
        gap = int(stamps[after] - stamps[before])
        share = min(max((stamp_ns - int(stamps[before])) / gap, 0.0), 1.0) if gap else 1.0
        if share < 1 and self._chain.view[before] != self._chain.view[after]:
            after, share = before, 1.0
        x, y, z = (
            positions[after] if share == 1 else (1 - share) * positions[before] + share * positions[after]
        ).tolist()
        return (x, y, z)

    def chain_at(self, stamp_ns: int, time_line: int | None = None) -> int:
        """Number of the chain that a moment belongs to. There must be a message."""
        line = self._rows_of(time_line)
        place = int(np.searchsorted(self._stamp_ns.view[line], stamp_ns, "right")) - 1
        return int(self._chain.view[line.start + max(place, 0)])

    def poses_at(
        self, stamp_ns: NDArray[np.int64], time_line: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """What :meth:`world_from_body_at` and :meth:`position_at` say of the moments ``(K,)``.

        Returns:
            world_from_body ``(K, 4)``, position ``(K, 3)`` and number of the chain ``(K,)``; NaN and -1 where
            :meth:`world_from_body_at` refuses.

        Positions are NaN where the odometry carries none. There must be a message.
        """
        stamps, chains, tolerance_ns = self._stamp_ns.view, self._chain.view, self.bounds.tolerance_ns
        after = self._rows_from(stamp_ns, time_line)
        before = np.maximum(after - 1, 0)
        before = np.where(self._time_line.view[before] == self._time_line.view[after], before, after)
        since, until = stamp_ns - stamps[before], stamps[after] - stamp_ns
        is_between = (since > 0) & (until > 0)
        is_seam = is_between & (chains[before] != chains[after])
        is_gap = is_between & ~is_seam & (since + until > self.bounds.max_gap_ns) & ~self._stood_still.view[after]
        # How far the moment is from the message whose rotation it would take; 0 where it is interpolated.
        off = np.select([is_seam, is_gap, is_between], [since, np.minimum(since, until), 0], np.abs(until))
        is_known = off <= tolerance_ns
        nearest = np.where(is_seam | (is_gap & (since <= until)), before, after)
        turns, places = self._world_from_body.view[nearest], self._position.view[nearest]
        is_inner = is_between & ~is_seam
        first, second = before[is_inner], after[is_inner]
        share = since[is_inner] / (since + until)[is_inner]
        one, other = (torch.from_numpy(self._world_from_body.view[rows]) for rows in (first, second))
        inner = rotations.normalize(rotations.slerp(one, other, torch.from_numpy(share))).numpy()
        turns[is_inner] = np.where(is_gap[is_inner, None], turns[is_inner], inner)
        one, other = self._position.view[first], self._position.view[second]
        places[is_inner] = one + share[:, None] * (other - one)
        turns[~is_known] = places[~is_known] = np.nan
        return turns, places, np.where(is_known, chains[np.where(is_between, before, after)], -1)

    def first_body_from_world(self) -> Quaternion:
        """Inverse of the first message's rotation."""
        return quaternion.inverse(self._rotation(0))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The messages as arrays, for :meth:`from_arrays`; columns that may change later are copied."""
        columns = {name: getattr(self, f"_{name}").view for name in _COLUMNS}
        columns["is_keyframe"] = columns["is_keyframe"].copy()
        return columns | {"limit": np.array(self._limit)}

    @classmethod
    def from_arrays(cls, bounds: OdometryBounds, arrays: dict[str, NDArray[Any]]) -> OdometrySamples:
        """The messages that :meth:`arrays` came from."""
        samples = cls(bounds)
        # Files of earlier versions do not have it.
        arrays = {"stood_still": np.zeros(len(arrays["stamp_ns"]), dtype=bool)} | arrays
        for name in _COLUMNS:
            getattr(samples, f"_{name}").extend(arrays[name])
        samples._limit = max(bounds.max_samples, int(arrays["limit"]))
        return samples

    def _rows_of(self, time_line: int | None) -> slice:
        """Rows of a time line's messages; there must be one."""
        column = self._time_line.view
        if column[-1] == 0:
            return slice(0, len(column))
        number = column[-1] if time_line is None else time_line
        return slice(int(np.searchsorted(column, number)), int(np.searchsorted(column, number, "right")))

    def _rows_from(self, stamp_ns: NDArray[np.int64], time_line: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows ``(K,)`` of the messages at or next after moments, the last of the time line where none is."""
        rows = np.empty(len(stamp_ns), dtype=np.int64)
        for number in np.unique(time_line).tolist():
            line, chosen = self._rows_of(number), time_line == number
            place = np.searchsorted(self._stamp_ns.view[line], stamp_ns[chosen])
            rows[chosen] = np.minimum(line.start + place, line.stop - 1)
        return rows

    def _rotation(self, row: int) -> Quaternion:
        x, y, z, w = self._world_from_body.view[row].tolist()
        return (x, y, z, w)

    def _sample(self, row: int) -> OdometrySample:
        x, y, z = self._position.view[row].tolist()
        position = (x, y, z) if math.isfinite(x) else None
        return OdometrySample(int(self._stamp_ns.view[row]), self._rotation(row), position)

    def _thin_out(self) -> None:
        size = len(self)
        keep = self._is_keyframe.view | (np.arange(size) % 2 == 0) | (np.arange(size) >= size // 2)
        keep |= np.diff(self._time_line.view, prepend=-1) != 0  # a time line never vanishes
        goes, stood_still = self._spared(np.flatnonzero(~keep))
        keep[:] = True
        keep[goes] = False
        flags = self._stood_still.view.copy()  # frozen copies share it
        flags[goes + 1] = stood_still
        self._stood_still.replace(flags)
        for name in _COLUMNS:
            column = getattr(self, f"_{name}")
            column.replace(column.view[keep])
        # If keyframes fill the room, the limit is raised; at least a quarter of it comes between two thinnings.
        self._limit = max(self.bounds.max_samples, int(keep.sum()) + self.bounds.max_samples // 4 + 1)

    def _spared(self, goes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Rows ``(K,)`` that may go, each between two that stay → those that go, and whether the robot stood still.

        A message without which a gap would arise while the robot moved is spared, the newest first.
        """
        is_still = self._stand_still()
        stood_still = is_still[goes] & is_still[goes + 1]
        gap_ns = self._stamp_ns.view[goes + 1] - self._stamp_ns.view[goes - 1]
        needed = np.flatnonzero((gap_ns > self.bounds.max_gap_ns) & ~stood_still)
        spared = needed[max(0, len(needed) - int(_SPARED * self.bounds.max_samples)) :]
        return np.delete(goes, spared), np.delete(stood_still, spared)

    def _stand_still(self) -> NDArray[np.bool_]:
        """Whether the robot stood still, without a gap in odometry, from the message before to each one ``(n,)``."""
        stamps, turns, positions = self._stamp_ns.view, self._world_from_body.view, self._position.view
        is_same = np.abs(np.sum(turns[1:] * turns[:-1], axis=1)) > math.cos(_STILL_ANGLE / 2)
        is_same &= ~(np.linalg.norm(np.diff(positions, axis=0), axis=1) > _STILL_DISTANCE_M)  # NaN: by rotation alone
        is_same &= (np.diff(stamps) <= self.bounds.max_gap_ns) | self._stood_still.view[1:]
        return np.append(False, is_same & (np.diff(self._chain.view) == 0))
