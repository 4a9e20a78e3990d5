"""A robot's run against its reference: orientation, heading and position errors before and after the correction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.interpolation import poses_at
from rotavg_ros.metrics import body_from_world, gauge_alignment, known_rows, orientation_errors, position_errors
from rotavg_ros.replay.record import Reference, RobotRecord

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """The reference at a robot's n keyframes, NaN rows where it has nothing within 0.15 s.

    Attributes:
        world_from_body: ``(n, 4)`` xyzw.
        position: ``(n, 3)`` metres; None if the reference has no positions.
    """

    world_from_body: FloatArray
    position: FloatArray | None


@dataclass(frozen=True)
class OrientationErrors:
    """Angles to the reference after one robust rotation per component, n keyframes, radians, NaN where unknown.

    Attributes:
        angle: ``(n,)``.
        heading: ``(n,)``, signed, about the reference's z axis.
    """

    angle: FloatArray
    heading: FloatArray


def truth_at_keyframes(reference: Reference, stamp_ns: NDArray[np.int64]) -> Truth:
    """The reference between its two samples around each stamp, both at most 0.15 s away (at the ends: one)."""
    return Truth(*poses_at(stamp_ns, reference.stamp_ns, reference.world_from_body, reference.position))


def _truth(reference: Reference, stamp_ns: NDArray[np.int64], time_line: NDArray[np.int64]) -> Truth:
    """:func:`truth_at_keyframes` for each time line of a robot with that of the reference."""
    orientation = np.full((len(stamp_ns), 4), np.nan)
    position = None if reference.position is None else np.full((len(stamp_ns), 3), np.nan)
    for number in np.unique(time_line).tolist():
        on_line = time_line == number
        seen = reference.on_time_line(number, int(time_line.max()) + 1)
        if seen is not None:
            truth = truth_at_keyframes(seen, stamp_ns[on_line])
            orientation[on_line] = truth.world_from_body
            if position is not None and truth.position is not None:
                position[on_line] = truth.position
    return Truth(orientation, position)


def errors_of_orientations(
    world_from_body: FloatArray, truth: Truth, component: NDArray[np.int64] | None = None
) -> OrientationErrors:
    """Errors of n orientations.

    Args:
        world_from_body: ``(n, 4)`` xyzw; NaN rows are unknown.
        component: ``(n,)``; each component is rotated onto the reference separately. Default: one component.
    """
    component = np.zeros(len(world_from_body), dtype=np.int64) if component is None else component
    known = known_rows(truth.world_from_body) & known_rows(world_from_body)
    reference = np.where(known[:, None], truth.world_from_body, np.nan)
    estimate = np.where(known[:, None], world_from_body, [0.0, 0.0, 0.0, 1.0])
    angle = orientation_errors(
        body_from_world(estimate), body_from_world(reference), torch.from_numpy(component)
    ).numpy()
    heading = np.full(len(estimate), np.nan)
    for number in np.unique(component[known]):
        members = known & (component == number)
        true = Rotation.from_quat(reference[members])
        gauge = gauge_alignment(body_from_world(estimate[members]), body_from_world(reference[members])).numpy()
        off = Rotation.from_quat(gauge) * Rotation.from_quat(estimate[members]) * true.inv()
        z, w = off.as_quat().T[2:]
        # The twist about z of the rotation from the true to the estimated orientation; w is 0 at half a turn.
        heading[members] = 2 * np.arctan2(np.where(w < 0, -z, z), np.abs(w))
    return OrientationErrors(angle, heading)


@dataclass(frozen=True)
class RobotComparison:
    """How a robot's odometry and the answer differ from its reference, n keyframes; NaN where unknown.

    Attributes:
        truth: the reference at the keyframes.
        odometry, corrected: orientation errors.
        odometry_distance: ``(n,)`` position error of odometry, metres.
        dead_reckoned_distance: the same for odometry's steps along corrected orientations.
        corrected_distance: the same for the corrected positions.
    """

    truth: Truth
    odometry: OrientationErrors
    corrected: OrientationErrors
    odometry_distance: FloatArray
    dead_reckoned_distance: FloatArray
    corrected_distance: FloatArray


def compare(robot: RobotRecord, component: NDArray[np.int64]) -> RobotComparison | None:
    """Compare a robot's run with its reference; None if there is none, or if it covers no keyframe.

    Each component is laid onto the reference by itself, in the answer and in odometry alike. So where nothing was
    corrected, nothing differs.

    Args:
        component: ``(n,)`` the components of the robot's keyframes.
    """
    if robot.reference is None:
        return None
    truth = _truth(robot.reference, robot.stamp_ns, robot.time_line)
    if not known_rows(truth.world_from_body).any():
        return None

    def distance(position: FloatArray | None) -> FloatArray:
        if position is None or truth.position is None:
            return np.full(len(robot.stamp_ns), np.nan)
        return position_errors(position, truth.position, component)

    return RobotComparison(
        truth=truth,
        odometry=errors_of_orientations(robot.odometry_world_from_body, truth, component),
        corrected=errors_of_orientations(robot.world_from_body, truth, component),
        odometry_distance=distance(robot.odometry_position),
        dead_reckoned_distance=distance(robot.position_dead_reckoned),
        corrected_distance=distance(robot.position),
    )
