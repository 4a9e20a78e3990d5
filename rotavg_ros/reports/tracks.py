"""A robot's positions before and after, aligned so that they can be drawn on one map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

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
    """The tracks of all robots that have positions.

    A robot without a reference of its own lies beside the others as in the answer: it is moved as one of those is that
    has a reference, and that edges join with it.
    """
    robots = facts.record.robots
    laid = [_onto_reference(*each) for each in zip(robots, facts.comparisons, strict=True)]
    fits = [None if on is None else on.fit for on in laid]
    return [
        _lay_together(robot, on or _Laid(_of_a_joined_robot(facts, robot, fits)), facts.time(robot.stamp_ns))
        for robot, on in zip(robots, laid, strict=True)
        if best_position(robot) is not None
    ]


class _Laid(NamedTuple):
    """How a robot's corrected positions are moved, None: not at all, and onto which positions of its own reference."""

    fit: RigidFit | None
    truth: FloatArray | None = None


def _onto_reference(robot: RobotRecord, comparison: RobotComparison | None) -> _Laid | None:
    """None without a reference that has at least two of the robot's positions."""
    corrected = best_position(robot)
    truth = None if comparison is None else comparison.truth.position
    fit = None if truth is None or corrected is None else fit_onto(corrected, truth)
    return None if fit is None else _Laid(fit, truth)


def _of_a_joined_robot(facts: RunFacts, robot: RobotRecord, fits: Sequence[RigidFit | None]) -> RigidFit | None:
    component = facts.record.answer.component
    for other, fit in zip(facts.record.robots, fits, strict=True):
        if fit is not None and np.isin(component[robot.nodes], component[other.nodes]).any():
            return fit
    return None


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


def _lay_together(robot: RobotRecord, laid: _Laid, time: FloatArray) -> Tracks:
    """Align odometry with the reference, too, as well as possible; without one it starts where the answer does."""
    corrected, odometry = best_position(robot), robot.odometry_position
    assert corrected is not None
    fit = laid.fit or RigidFit(Rotation.identity(), np.zeros(3))
    if odometry is not None:
        onto_truth = None if laid.truth is None else fit_onto(odometry, laid.truth)
        odometry = (
            fit(_same_start(robot, odometry, corrected)(odometry)) if onto_truth is None else onto_truth(odometry)
        )
    return Tracks(robot=robot.robot, time=time, odometry=odometry, corrected=fit(corrected), reference=laid.truth)


def _same_start(robot: RobotRecord, odometry: FloatArray, corrected: FloatArray) -> RigidFit:
    known = np.isfinite(odometry).all(axis=1) & np.isfinite(corrected).all(axis=1)
    known &= np.isfinite(robot.odometry_world_from_body).all(axis=1)
    if not known.any():
        return RigidFit(Rotation.identity(), np.zeros(3))
    first = int(np.argmax(known))
    before, after = robot.odometry_world_from_body[first], robot.world_from_body[first]
    turn = Rotation.from_quat(after) * Rotation.from_quat(before).inv()
    return RigidFit(turn, corrected[first] - turn.apply(odometry[first]))
