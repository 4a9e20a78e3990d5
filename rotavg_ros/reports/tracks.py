"""A robot's positions before and after, aligned so that they can be drawn on one map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.metrics import RigidFit, fits_onto
from rotavg_ros.replay.comparison import RobotComparison
from rotavg_ros.replay.record import RobotRecord
from rotavg_ros.reports.facts import RunFacts

FloatArray = NDArray[np.float64]

_UNMOVED = RigidFit(Rotation.identity(), np.zeros(3))


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

    A robot without a reference of its own lies beside the others as in the answer: its components are moved as those of
    a robot that has a reference.
    """
    robots, component = facts.record.robots, facts.record.answer.component
    own = [_onto_reference(*each, facts) for each in zip(robots, facts.comparisons, strict=True)]
    joint: dict[int, RigidFit] = {}
    for fits in reversed(own):
        joint |= fits
    return [
        _lay_together(
            robot,
            fits or {number: joint[number] for number in np.unique(component[robot.nodes]).tolist() if number in joint},
            comparison.truth.position if comparison is not None and fits else None,
            facts,
        )
        for robot, fits, comparison in zip(robots, own, facts.comparisons, strict=True)
        if best_position(robot) is not None
    ]


def _onto_reference(robot: RobotRecord, comparison: RobotComparison | None, facts: RunFacts) -> dict[int, RigidFit]:
    """Of each component that has two positions in the robot's own reference."""
    corrected = best_position(robot)
    truth = None if comparison is None else comparison.truth.position
    if corrected is None or truth is None:
        return {}
    return fits_onto(corrected, truth, facts.record.answer.component[robot.nodes])


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


def _lay_together(robot: RobotRecord, fits: dict[int, RigidFit], truth: FloatArray | None, facts: RunFacts) -> Tracks:
    """Align odometry with the reference, too, as well as possible; without one it starts where the answer does.

    Args:
        fits: of the corrected components; others are moved as the first of these is.
        truth: positions of the robot's own reference, onto which its components are laid.
    """
    corrected, odometry = best_position(robot), robot.odometry_position
    assert corrected is not None
    component = facts.record.answer.component[robot.nodes]
    before = None
    if odometry is not None:
        before = _moved(_same_start(robot, odometry, corrected)(odometry), component, fits)
        for number, fit in ({} if truth is None else fits_onto(odometry, truth, component)).items():
            before[component == number] = fit(odometry[component == number])
    after = _moved(corrected, component, fits)
    return Tracks(robot.robot, facts.time(robot.stamp_ns), before, after, truth)


def _moved(position: FloatArray, component: NDArray[np.int64], fits: dict[int, RigidFit]) -> FloatArray:
    """Each component by its own fit, others by the first one."""
    moved = next(iter(fits.values()), _UNMOVED)(position)
    for number, fit in fits.items():
        moved[component == number] = fit(position[component == number])
    return moved


def _same_start(robot: RobotRecord, odometry: FloatArray, corrected: FloatArray) -> RigidFit:
    known = np.isfinite(odometry).all(axis=1) & np.isfinite(corrected).all(axis=1)
    known &= np.isfinite(robot.odometry_world_from_body).all(axis=1)
    if not known.any():
        return _UNMOVED
    first = int(np.argmax(known))
    before, after = robot.odometry_world_from_body[first], robot.world_from_body[first]
    turn = Rotation.from_quat(after) * Rotation.from_quat(before).inv()
    return RigidFit(turn, corrected[first] - turn.apply(odometry[first]))
