"""A robot's positions before and after, aligned so that they can be drawn on one map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.metrics import RigidFit, fit_onto
from rotavg_ros.replay.comparison import RobotComparison
from rotavg_ros.replay.record import RobotRecord
from rotavg_ros.reports.facts import RunFacts

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Tracks:
    """Positions of a robot's n keyframes in one frame, ``(n, 3)`` metres each.

    Attributes:
        robot: its name.
        time: ``(n,)`` in the unit of the report's clock.
        odometry: None if it has no positions.
        corrected: by the sparse solve where there is one, else by dead reckoning.
        reference: None without reference positions.
    """

    robot: str
    time: FloatArray
    odometry: FloatArray | None
    corrected: FloatArray
    reference: FloatArray | None

    @property
    def all(self) -> list[FloatArray]:
        return [track for track in (self.odometry, self.corrected, self.reference) if track is not None]


def tracks_of(facts: RunFacts) -> list[Tracks]:
    """The tracks of all robots that have positions."""
    return [
        _lay_together(robot, comparison, corrected, facts.time(robot.stamp_ns))
        for robot, comparison in zip(facts.record.robots, facts.comparisons, strict=True)
        if (corrected := best_position(robot)) is not None
    ]


def node_positions(facts: RunFacts) -> FloatArray:
    """Corrected position of each of the answer's N keyframes, ``(N, 3)`` metres, NaN where unknown.

    A single robot is aligned with its reference; several stay as in the answer, since each has its own reference.
    """
    position = np.full((len(facts.record.answer.stamp_ns), 3), np.nan)
    robots = facts.record.robots
    if len(robots) == 1:
        for tracks in tracks_of(facts):
            position[robots[0].nodes] = tracks.corrected
        return position
    for robot in robots:
        best = best_position(robot)
        if best is not None:
            position[robot.nodes] = best
    return position


def best_position(robot: RobotRecord) -> FloatArray | None:
    """The corrected positions: from the sparse solve where there is one, else dead reckoned."""
    return robot.position if robot.position is not None else robot.position_dead_reckoned


def _lay_together(
    robot: RobotRecord, comparison: RobotComparison | None, corrected: FloatArray, time: FloatArray
) -> Tracks:
    """Align everything with the reference as well as possible; without one, odometry starts where the answer does."""
    truth = None if comparison is None else comparison.truth.position
    fit = None if truth is None else fit_onto(corrected, truth)
    odometry = robot.odometry_position
    if odometry is not None:
        odometry_fit = None if truth is None or fit is None else fit_onto(odometry, truth)
        odometry = (odometry_fit or _same_start(robot, odometry, corrected))(odometry)
    return Tracks(
        robot=robot.robot,
        time=time,
        odometry=odometry,
        corrected=corrected if fit is None else fit(corrected),
        reference=None if fit is None else truth,
    )


def _same_start(robot: RobotRecord, odometry: FloatArray, corrected: FloatArray) -> RigidFit:
    known = np.isfinite(odometry).all(axis=1) & np.isfinite(corrected).all(axis=1)
    known &= np.isfinite(robot.odometry_world_from_body).all(axis=1)
    if not known.any():
        return RigidFit(Rotation.identity(), np.zeros(3))
    first = int(np.argmax(known))
    before, after = robot.odometry_world_from_body[first], robot.world_from_body[first]
    turn = Rotation.from_quat(after) * Rotation.from_quat(before).inv()
    return RigidFit(turn, corrected[first] - turn.apply(odometry[first]))
