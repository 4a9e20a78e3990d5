"""Keyframes that are no longer nodes: each lies on an odometry edge, at a known pose along it."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rotavg_ros import rotations
from rotavg_ros.online.measurements import UNKNOWN_STAMP_NS


@dataclass(frozen=True)
class MarginalizedKeyframes:
    """K keyframes in the order in which they were marginalised.

    Attributes:
        robot: ``(K,)`` int32 index.
        keyframe_id: ``(K,)`` uint64.
        stamp_ns: ``(K,)`` int64, -1 where unknown.
        time_line: ``(K,)`` int64, which of its robot's time lines the stamp belongs to.
        edge: ``(K,)`` int64, the odometry edge.
        keyframe_from_source: ``(K, 4)`` xyzw, rotation from the frame of the edge's source.
        position: ``(K, 3)`` in the frame of the edge's source, metres; NaN unknown.
        steps: ``(K,)`` odometry steps from the edge's source.
    """

    robot: NDArray[np.int32]
    keyframe_id: NDArray[np.uint64]
    stamp_ns: NDArray[np.int64]
    time_line: NDArray[np.int64]
    edge: NDArray[np.int64]
    keyframe_from_source: NDArray[np.float64]
    position: NDArray[np.float64]
    steps: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.edge)

    @classmethod
    def none(cls) -> MarginalizedKeyframes:
        return cls(
            np.empty(0, dtype=np.int32),
            np.empty(0, dtype=np.uint64),
            np.empty(0, dtype=np.int64),
            np.empty(0, dtype=np.int64),
            np.empty(0, dtype=np.int64),
            np.empty((0, 4)),
            np.empty((0, 3)),
            np.empty(0),
        )

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The columns by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def select(self, chosen: NDArray[Any]) -> MarginalizedKeyframes:
        """The keyframes of a mask, or of indices in their order."""
        return MarginalizedKeyframes(**{name: values[chosen] for name, values in self.arrays().items()})

    def followed_by(self, others: MarginalizedKeyframes) -> MarginalizedKeyframes:
        """These, then the others."""
        theirs = others.arrays()
        return MarginalizedKeyframes(
            **{name: np.concatenate((values, theirs[name])) for name, values in self.arrays().items()}
        )


@dataclass(frozen=True)
class Forgotten:
    """Which keyframes may have been marginalised without anything of them being known any more.

    Attributes:
        ids: by robot index: keyframes up to this id.
        stamps_ns: by robot index and time line: keyframes up to this stamp. Ids that are made of stamps do not ascend
            where a clock goes back, so keyframes that are named by their stamps are judged by these.
    """

    ids: Mapping[int, int] = field(default_factory=dict)
    stamps_ns: Mapping[tuple[int, int], int] = field(default_factory=dict)

    def together_with(self, keyframes: MarginalizedKeyframes) -> Forgotten:
        """With these keyframes, too."""
        ids, stamps_ns = dict(self.ids), dict(self.stamps_ns)
        for robot in np.unique(keyframes.robot).tolist():
            of_robot = keyframes.robot == robot
            ids[robot] = max(int(keyframes.keyframe_id[of_robot].max()), ids.get(robot, 0))
            for line in np.unique(keyframes.time_line[of_robot]).tolist():
                newest_ns = int(keyframes.stamp_ns[of_robot & (keyframes.time_line == line)].max())
                stamps_ns[robot, line] = max(newest_ns, stamps_ns.get((robot, line), UNKNOWN_STAMP_NS))
        return Forgotten(ids, stamps_ns)


@dataclass(frozen=True)
class MarginalizedIndex:
    """Finds marginalised keyframes by key and by moment.

    Attributes:
        keyframes: those that can be found.
        forgotten: those that cannot be found any more.
    """

    keyframes: MarginalizedKeyframes
    forgotten: Forgotten
    _by_id: NDArray[np.int64]
    _by_moment: NDArray[np.int64]

    @classmethod
    def of(cls, keyframes: MarginalizedKeyframes, forgotten: Forgotten) -> MarginalizedIndex:
        by_id = np.lexsort((keyframes.keyframe_id, keyframes.robot))
        by_moment = np.lexsort((keyframes.stamp_ns, keyframes.time_line, keyframes.robot))
        return cls(keyframes, forgotten, by_id, by_moment)

    def limited_to(self, capacity: int) -> MarginalizedIndex:
        """The index with at most ``capacity`` keyframes; the first ones are forgotten."""
        surplus = len(self.keyframes) - capacity
        if surplus <= 0:
            return self
        forgotten = self.forgotten.together_with(self.keyframes.select(np.arange(surplus)))
        return MarginalizedIndex.of(self.keyframes.select(np.arange(surplus, len(self.keyframes))), forgotten)

    def by_id(self, robot: int, keyframe_id: int) -> int | None:
        """Row of a keyframe."""
        keyframes = self.keyframes
        return _find(self._by_id, (keyframes.robot, keyframes.keyframe_id), (robot, keyframe_id))

    def by_moment(self, robot: int, time_line: int, stamp_ns: int) -> int | None:
        """Row of the robot's keyframe with exactly this stamp on this time line."""
        keyframes = self.keyframes
        columns = (keyframes.robot, keyframes.time_line, keyframes.stamp_ns)
        return _find(self._by_moment, columns, (robot, time_line, stamp_ns))

    def is_forgotten(self, robot: int, keyframe_id: int) -> bool:
        """Whether a keyframe of this id may have been forgotten."""
        return keyframe_id <= self.forgotten.ids.get(robot, -1)

    def is_moment_forgotten(self, robot: int, time_line: int, stamp_ns: int) -> bool:
        """Whether a keyframe of this stamp on this time line may have been forgotten."""
        return stamp_ns <= self.forgotten.stamps_ns.get((robot, time_line), UNKNOWN_STAMP_NS)

    def nearest_end(
        self, row: int, target_from_source: NDArray[np.float64], translation: NDArray[np.float64], steps: float
    ) -> tuple[bool, NDArray[np.float64], NDArray[np.float64]]:
        """A keyframe seen from the nearer end of its edge.

        Args:
            row: the keyframe.
            target_from_source: ``(4,)`` of its edge.
            translation: ``(3,)`` of the edge: position of the target in the source's frame, metres.
            steps: of the edge, in odometry steps.

        Returns:
            whether the nearer end is the edge's source; the keyframe's orientation ``(4,)`` and position ``(3,)`` in
            that end's frame.
        """
        keyframes = self.keyframes
        source_from_keyframe = rotations.inverse(torch.from_numpy(keyframes.keyframe_from_source[row]))
        if keyframes.steps[row] <= steps - keyframes.steps[row]:
            return True, source_from_keyframe.numpy(), keyframes.position[row]
        turn = torch.from_numpy(target_from_source)
        position = rotations.rotate(turn, torch.from_numpy(keyframes.position[row] - translation))
        return False, rotations.multiply(turn, source_from_keyframe).numpy(), position.numpy()


def _find(order: NDArray[np.int64], columns: Sequence[NDArray[Any]], key: tuple[int, ...]) -> int | None:
    """The row with a key; ``order`` lists the rows in ascending order of their keys."""

    def key_of(row: int) -> tuple[int, ...]:
        return tuple(int(column[row]) for column in columns)

    place = bisect_left(order, key, key=key_of)
    return int(order[place]) if place < len(order) and key_of(order[place]) == key else None
