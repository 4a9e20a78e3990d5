"""Poses between the samples of a trajectory, as of a ground truth that was recorded at other moments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from rotavg_ros.datasets.files.ground_truth import MAX_TRUTH_DISTANCE_NS

FloatArray = NDArray[np.float64]


def poses_at(
    asked_ns: NDArray[np.int64], stamps_ns: NDArray[np.int64], world_from_body: FloatArray, position: FloatArray | None
) -> tuple[FloatArray, FloatArray | None]:
    """The pose between the two samples around each of n stamps, both at most 0.15 s away (at the ends: one).

    Args:
        asked_ns: ``(n,)``.
        stamps_ns: ``(K,)``, in any order; of several samples of one stamp the first counts.
        world_from_body: ``(K, 4)`` xyzw.
        position: ``(K, 3)`` metres; None: unknown.

    Returns:
        ``(n, 4)`` orientations and ``(n, 3)`` positions, NaN rows where unknown; None without positions.
    """
    order = np.argsort(stamps_ns, kind="stable")
    stamps, first = np.unique(stamps_ns[order], return_index=True)
    order = order[first]
    count = len(asked_ns)
    orientation = np.full((count, 4), np.nan)
    between = None if position is None else np.full((count, 3), np.nan)
    if len(stamps) == 0:
        return orientation, between
    after = np.searchsorted(stamps, asked_ns).clip(0, len(stamps) - 1)
    before = np.where(stamps[after] > asked_ns, np.maximum(after - 1, 0), after)
    known = (np.abs(stamps[before] - asked_ns) <= MAX_TRUTH_DISTANCE_NS) & (
        np.abs(stamps[after] - asked_ns) <= MAX_TRUTH_DISTANCE_NS
    )
    # Seconds since the first sample: nanoseconds since 1970 do not fit into a float.
    seconds = (stamps - stamps[0]) / 1e9
    at = ((asked_ns[known] - stamps[0]) / 1e9).clip(0, seconds[-1])
    if known.any():
        samples = world_from_body[order]
        if len(stamps) == 1:
            orientation[known] = samples
        else:
            orientation[known] = Slerp(seconds, Rotation.from_quat(samples))(at).as_quat(canonical=True)
        if between is not None and position is not None:
            ordered = position[order]
            between[known] = np.stack([np.interp(at, seconds, ordered[:, axis]) for axis in range(3)], axis=1)
    return orientation, between
