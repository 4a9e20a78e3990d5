"""Converts state files of earlier versions to today's form."""

from __future__ import annotations

from typing import Any

import numpy as np

from rotavg_ros.online.compaction.marginalized_keyframes import MarginalizedKeyframes
from rotavg_ros.online.state.file import Arrays

# Before it, odometry edges stood for one step each, and no keyframe was marginalised.
_FIRST_WITH_STEPS = 3
# Before it, every robot had one time line, and waiting edges did not say what they wait for.
_FIRST_WITH_TIME_LINES = 4
# Before it, every closure was part of the next solve.
_FIRST_WITH_QUEUE = 5
# Before it, the first answer after a load was a cold one.
_FIRST_WITH_LABELS = 6
# Before it, the only systematic error that was known was a gyroscope's bias.
_FIRST_WITH_CALIBRATION = 7
# Before it, the data's time was the newest stamp of all robots, and an edge tied to odometry's end stayed there.
_FIRST_WITH_DATA_TIMES = 8


def upgraded(arrays: Arrays, header: dict[str, Any]) -> tuple[Arrays, dict[str, Any]]:
    """Arrays and header as today's version writes them.

    Two entries of the header remain to be filled in, since they need the graph: ``unplaced`` edges that waited, and
    ``world_from_odometry``, which is None.
    """
    if header["format_version"] < _FIRST_WITH_STEPS:
        nothing = MarginalizedKeyframes.none().arrays()
        arrays = arrays | {"steps": np.ones(len(arrays["edge_id"]))}
        arrays |= {f"marginalized_{name}": values for name, values in nothing.items()}
    if header["format_version"] < _FIRST_WITH_TIME_LINES:
        arrays, header = _with_time_lines(arrays), _with_surroundings(header, arrays)
    if header["format_version"] < _FIRST_WITH_QUEUE:
        arrays = arrays | {"queued": np.zeros(0, dtype=np.int64)}
    if header["format_version"] < _FIRST_WITH_LABELS:
        arrays = arrays | {"component": np.zeros(0, dtype=np.int64)}
    if header["format_version"] < _FIRST_WITH_CALIBRATION and "labels_bias" in arrays:
        bias = arrays["labels_bias"]
        arrays = arrays | {"labels_calibration": np.append(bias, np.zeros(len(bias)))}
    if header["format_version"] < _FIRST_WITH_DATA_TIMES:
        header = _with_data_times(header, arrays)
    return arrays, header


def _with_time_lines(arrays: Arrays) -> Arrays:
    nothing = np.empty(0, dtype=np.uint64)
    added: Arrays = {
        "time_line": np.zeros(len(arrays["keyframe_id"]), dtype=np.int64),
        "marginalized_time_line": np.zeros(len(arrays["marginalized_edge"]), dtype=np.int64),
        "outlier": np.zeros(0, dtype=bool),
        "fingerprints_older": nothing,
        "fingerprints_younger": np.sort(arrays["fingerprints"]),
        "fingerprints_newest": nothing,
    }
    for name, values in arrays.items():
        if name.startswith("odometry") and name.endswith("_stamp_ns"):
            prefix = name.removesuffix("stamp_ns")
            added |= {
                f"{prefix}time_line": np.zeros(len(values), dtype=np.int64),
                f"{prefix}limit": np.array(0),
                f"{prefix}refused_stamp_ns": np.empty(0, dtype=np.int64),
                f"{prefix}refused_world_from_body": np.empty((0, 4)),
                f"{prefix}refused_position": np.empty((0, 3)),
                f"{prefix}refused_jumps": np.array(False),
                f"{prefix}begins_time_line": np.array(False),
            }
    return arrays | added


def _with_surroundings(header: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    return header | {
        "ticked_revision": 0,
        "world_from_odometry": None,
        "revision": len(arrays["keyframe_id"]) + len(arrays["edge_id"]),
        "backward_jumps": {"runs": {}, "told": []},
        "room": {
            "marginalized": header.get("marginalized", 0),
            "dropped_closures": header.get("dropped_closures", 0),
            "compact_from_revision": [0, 0],
        },
        "forgotten_up_to": header.get("forgotten_up_to", []),
        "pending": [],
        "unplaced": header["pending"],
    }


def _with_data_times(header: dict[str, Any], arrays: Arrays) -> dict[str, Any]:
    """Each robot's time is that of its last odometry; edges begin to wait anew, in the time of what they wait for."""
    times = {
        robot: {"now_ns": int(arrays[f"odometry{index}_stamp_ns"][-1]), "claimed_ns": None}
        for index, robot in enumerate(header["odometry_robots"])
        if not arrays[f"odometry{index}_begins_time_line"]
    }
    anew = [row | {"timed_by": row["waits_for"]["robot"], "since_ns": None} for row in header["pending"]]
    return header | {"data_times": times, "pending": anew, "provisional": []}
