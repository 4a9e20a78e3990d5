"""A replay in numbers: ``summary.json``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.replay.comparison import compare
from rotavg_ros.replay.record import RobotRecord, RunRecord
from rotavg_ros.replay.run import Outcome
from rotavg_ros.version import __version__
from rotavg_ros.view_graph import EdgeKind


def summarize(record: RunRecord, bag: Path, outcome: Outcome) -> dict[str, Any]:
    """The content of ``summary.json``, except the names of the files.

    Args:
        record: the run.
        bag: the bag that it came from.
        outcome: the outcome that the record was made from.
    """
    answer = record.answer
    closures = answer.kind == EdgeKind.LOOP_CLOSURE
    seconds = np.array([tick.seconds for tick in record.ticks])
    return {
        "bag": str(bag),
        "duration_s": record.duration_s,
        "interrupted": record.interrupted,
        "damage": outcome.damage,
        "keyframes": len(answer.keyframe_id),
        "edges": len(answer.outlier),
        "loop_closures": int(closures.sum()),
        "flagged_closures": int((answer.outlier & closures).sum()),
        "outliers": int(answer.outlier.sum()),
        "components": answer.num_components,
        "warnings": [*record.warnings, *answer.warnings],
        "robots": {robot.robot: _robot(robot, answer.component[robot.nodes]) for robot in record.robots},
        "waiting": outcome.estimator.counts().pending,
        "rejected": {reason: count for reason, count in record.rejected.items() if count},
        "topics": {use.topic: use.used_as for use in record.topics if use.used_as},
        "ticks": len(record.ticks),
        "tick_seconds": {f"p{percent}": float(np.percentile(seconds, percent)) for percent in (50, 95, 100)},
        "failed_ticks": outcome.failures,
        "time_jumps": outcome.estimator.time_jumps,
        "wall_seconds": record.wall_seconds,
        "device": answer.device,
        "method": answer.method,
        "profile": answer.profile,
        "options": record.options,
        "version": __version__,
    }


def _robot(robot: RobotRecord, component: NDArray[np.int64]) -> dict[str, Any]:
    said: dict[str, Any] = {"keyframes": len(robot.nodes)}
    if robot.reference is None:
        return said
    comparison = compare(robot, component)
    said["reference"] = robot.reference.name
    said["compared_keyframes"] = 0 if comparison is None else int(np.isfinite(comparison.corrected.angle).sum())
    if comparison is None:
        return said
    said["orientation_error_mean_deg"] = {
        "odometry": _mean_deg(comparison.odometry.angle),
        "corrected": _mean_deg(comparison.corrected.angle),
    }
    distances = {
        "odometry": comparison.odometry_distance,
        "dead_reckoned": comparison.dead_reckoned_distance,
        "corrected": comparison.corrected_distance,
    }
    rms = {name: _rms(distance) for name, distance in distances.items()}
    if any(value is not None for value in rms.values()):
        said["position_error_rms_m"] = rms
    return said


def _mean_deg(angle: NDArray[np.float64]) -> float | None:
    known = angle[np.isfinite(angle)]
    return math.degrees(float(known.mean())) if len(known) else None


def _rms(distance: NDArray[np.float64]) -> float | None:
    known = distance[np.isfinite(distance)]
    return float(np.sqrt((known**2).mean())) if len(known) else None
