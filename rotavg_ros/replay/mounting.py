"""Finds the mounting of a reference's sensor from the motion of both, since bags seldom say how an IMU is mounted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.ground_truth import MAX_TRUTH_DISTANCE_NS
from rotavg_ros.metrics import known_rows
from rotavg_ros.replay.record import Reference

# Smaller turns between keyframes are mostly noise.
_SMALLEST_TURN = np.radians(1.0)


def without_mounting(
    reference: Reference, stamp_ns: NDArray[np.int64], odometry_world_from_body: NDArray[np.float64]
) -> Reference:
    """The reference without the sensor's mounting rotation, so that it describes the body.

    A turn of the body between two keyframes is the sensor's, seen in other axes: ``v_body = R_body_sensor v_sensor``
    for rotation vectors, which is Wahba's problem (solved as by Kabsch 1976). If a body turns about only one axis, the
    mounting angle about that axis remains undetermined, but then it makes no difference.

    Args:
        reference: orientations of a sensor.
        stamp_ns: ``(n,)`` of the keyframes on the robot's last time line.
        odometry_world_from_body: ``(n, 4)`` xyzw at the keyframes; NaN rows unknown.

    Returns:
        the reference unchanged if there are no common turns.
    """
    seen = reference.on_last_time_line()
    nearest = np.searchsorted(seen.stamp_ns, stamp_ns).clip(0, len(seen.stamp_ns) - 1)
    known = known_rows(odometry_world_from_body)
    known &= np.abs(seen.stamp_ns[nearest] - stamp_ns) <= MAX_TRUTH_DISTANCE_NS
    if known.sum() < 2:
        return reference
    body = _turns(odometry_world_from_body[known])
    sensor = _turns(seen.world_from_body[nearest[known]])
    large = np.linalg.norm(body, axis=1) >= _SMALLEST_TURN
    if not large.any():
        return reference
    u, _, vt = np.linalg.svd(body[large].T @ sensor[large])
    body_from_sensor = Rotation.from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(vt)]) @ vt)
    world_from_body = Rotation.from_quat(reference.world_from_body) * body_from_sensor.inv()
    return replace(
        reference, name=f"{reference.name} (mounting fitted)", world_from_body=world_from_body.as_quat(canonical=True)
    )


def _turns(world_from_frame: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation vectors from each orientation to the next, in the frame's own axes."""
    rotation = Rotation.from_quat(world_from_frame)
    turns: NDArray[np.float64] = (rotation[:-1].inv() * rotation[1:]).as_rotvec()
    return turns
