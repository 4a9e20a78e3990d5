"""The facts that a report states about a run, computed once from its record."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.online.measurements import OWN_EDGE_ID
from rotavg_ros.replay.comparison import RobotComparison, compare
from rotavg_ros.replay.record import RobotRecord, RunRecord
from rotavg_ros.reports.panels import Clock
from rotavg_ros.view_graph import FALSE_CLOSURE_DEG, FALSE_CLOSURE_M, EdgeKind

FloatArray = NDArray[np.float64]

_SURE = 0.4  # a score below 0.1 or above 0.9 is
_EVEN = 0.5
_DECIMALS = 3  # of scores, as tables show them


@dataclass(frozen=True)
class Closure:
    """A loop closure as the report's table names it.

    Attributes:
        edge_id: the sender's id; None if it gave none.
        source, target: robot, keyframe id and stamp of its ends.
        score: probability that it is false.
        outlier: the verdict.
        fails: the part that is judged false, "rotation" or "place"; empty if it is believed.
        off_deg, off_m: residuals of its rotation and translation in the answer; NaN where unknown.
    """

    edge_id: int | None
    source: tuple[str, int, int]
    target: tuple[str, int, int]
    score: float
    outlier: bool
    fails: str
    off_deg: float
    off_m: float


@dataclass(frozen=True)
class RunFacts:
    """A record and what follows from it (N keyframes and M edges in the answer, C of them loop closures)."""

    record: RunRecord

    @cached_property
    def comparisons(self) -> tuple[RobotComparison | None, ...]:
        """Per robot; None without a reference at any of its keyframes."""
        component = self.record.answer.component
        return tuple(compare(robot, component[robot.nodes]) for robot in self.record.robots)

    @property
    def compared(self) -> Iterator[tuple[RobotRecord, RobotComparison]]:
        """The robots that have a reference."""
        for robot, comparison in zip(self.record.robots, self.comparisons, strict=True):
            if comparison is not None:
                yield robot, comparison

    @cached_property
    def start_ns(self) -> int:
        """The earliest stamp of a keyframe, or of a tick where keyframes have none."""
        stamps = self.record.answer.stamp_ns
        known = stamps[stamps >= 0]
        if len(known):
            return int(known.min())
        return min((tick.stamp_ns for tick in self.record.ticks), default=0)

    @cached_property
    def clock(self) -> Clock:
        stamps = self.record.answer.stamp_ns
        last_s = self.seconds(stamps.max()) if len(stamps) else 0.0
        return Clock.for_duration(max(float(last_s), self.record.duration_s))

    def seconds(self, stamp_ns: NDArray[np.int64] | np.int64) -> FloatArray:
        """Seconds since the start; exact to a nanosecond before the division."""
        return np.asarray((stamp_ns - self.start_ns) / 1e9)

    def time(self, stamp_ns: NDArray[np.int64]) -> FloatArray:
        """Time since the start in the clock's unit."""
        return np.asarray(self.clock(self.seconds(stamp_ns)), dtype=np.float64)

    @cached_property
    def tick_time(self) -> FloatArray:
        """Time of each tick, since the start in the clock's unit.

        Where the keyframes' stamps are of another clock than the recorder's, as a simulation's are, the first tick is
        the start. Clocks that differ by more than the run lasts are not the same.
        """
        ticks = np.array([tick.stamp_ns for tick in self.record.ticks], dtype=np.int64)
        stamps = self.record.answer.stamp_ns
        known = stamps[stamps >= 0]
        if len(ticks) and len(known):
            apart_ns = max(int(ticks.min()) - int(known.max()), int(known.min()) - int(ticks.max()))
            if apart_ns > 1e9 * max(self.record.duration_s, 1.0):
                ticks = ticks - ticks.min() + self.start_ns
        return self.time(ticks)

    @cached_property
    def closures(self) -> NDArray[np.intp]:
        """``(C,)`` indices of the answer's loop closures."""
        return np.flatnonzero(self.record.answer.kind == EdgeKind.LOOP_CLOSURE)

    @cached_property
    def num_flagged(self) -> int:
        return int(self.record.answer.outlier[self.closures].sum())

    @cached_property
    def num_flagged_odometry(self) -> int:
        return int(self.record.answer.outlier.sum()) - self.num_flagged

    @property
    def knows_places(self) -> bool:
        """Whether closures were judged by their translations, too."""
        return self.record.answer.position is not None

    @cached_property
    def off_m(self) -> FloatArray:
        """``(M,)`` metres, residuals of the edges' translations in the answer; NaN where unknown."""
        off = self.record.answer.residual_m
        return np.full(len(self.record.answer.source), np.nan) if off is None else off

    def most_suspicious(self) -> list[Closure]:
        """Loop closures by descending score; equal ones by residual, then by arrival."""
        answer = self.record.answer
        score = np.round(answer.outlier_score[self.closures], _DECIMALS)
        off_deg, off_m = answer.residual_deg[self.closures], np.nan_to_num(self.off_m[self.closures])
        off = np.maximum(off_deg / FALSE_CLOSURE_DEG, off_m / FALSE_CLOSURE_M)
        return self._described(self.closures[np.lexsort((-off, -score))])

    def believed_but_long(self) -> list[Closure]:
        """Believed closures whose residual exceeds the limit for a false translation, the largest first."""
        off = self.off_m[self.closures]
        long = np.flatnonzero(~self.record.answer.outlier[self.closures] & (np.nan_to_num(off) > FALSE_CLOSURE_M))
        return self._described(self.closures[long[np.argsort(-off[long], kind="stable")]])

    def closest_calls(self, limit: int) -> list[Closure]:
        """The loop closures with the least certain scores, those nearest to 0.5 first."""
        doubt = np.abs(self.record.answer.outlier_score[self.closures] - 0.5)
        order = np.argsort(doubt, kind="stable")
        return self._described(self.closures[order[doubt[order] < _SURE]][:limit])

    def _described(self, edges: NDArray[np.intp]) -> list[Closure]:
        answer = self.record.answer
        return [
            Closure(
                edge_id=None if int(answer.edge_id[edge]) == OWN_EDGE_ID else int(answer.edge_id[edge]),
                source=self._end(answer.source[edge]),
                target=self._end(answer.target[edge]),
                score=float(answer.outlier_score[edge]),
                outlier=bool(answer.outlier[edge]),
                fails=self._fails(edge),
                off_deg=float(answer.residual_deg[edge]),
                off_m=float(self.off_m[edge]),
            )
            for edge in edges
        ]

    def _fails(self, edge: np.intp) -> str:
        answer = self.record.answer
        if not answer.outlier[edge]:
            return ""
        is_turned = answer.rotation_score is None or answer.rotation_score[edge] > _EVEN
        return "rotation" if is_turned else "place"

    def _end(self, node: np.int64) -> tuple[str, int, int]:
        answer = self.record.answer
        robot = answer.robots[int(answer.keyframe_robot[node])]
        return robot, int(answer.keyframe_id[node]), int(answer.stamp_ns[node])

    @cached_property
    def correction(self) -> tuple[FloatArray, ...]:
        """Per robot ``(n,)`` radians: angle from odometry to the answer, both aligned at the first keyframe."""
        return tuple(_turned(robot.odometry_world_from_body, robot.world_from_body) for robot in self.record.robots)


def _turned(before: FloatArray, after: FloatArray) -> FloatArray:
    """Angle between two trajectories' orientations after alignment at the first known one."""
    angle = np.full(len(after), np.nan)
    known = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    if known.any():
        turn = Rotation.from_quat(after[known]) * Rotation.from_quat(before[known]).inv()
        angle[known] = (turn[0].inv() * turn).magnitude()
    return angle
