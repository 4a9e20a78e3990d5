"""Converts answers to messages, with orientations as world_from_body; the inverse is in :mod:`rotavg_ros.inputs`."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion as QuaternionMessage
from numpy.typing import DTypeLike, NDArray
from rotavg_msgs.msg import AbsoluteOrientations, OutlierFlags
from std_msgs.msg import Header

from rotavg_ros.online import Answer
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.stamps import NANOSECONDS


def to_time(stamp_ns: int) -> Time:
    """A message's stamp; a time that Time cannot hold (unknown, or beyond 2038) becomes zero."""
    seconds, nanosec = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=seconds, nanosec=nanosec) if 0 <= seconds < 2**31 else Time()


def to_quaternion_message(rotation: Quaternion) -> QuaternionMessage:
    """A message from xyzw."""
    x, y, z, w = rotation
    return QuaternionMessage(x=x, y=y, z=z, w=w)


def orientations_message(answer: Answer, frame_id: str) -> AbsoluteOrientations:
    """The answer's keyframes."""
    return AbsoluteOrientations(
        header=_header(answer, frame_id),
        robots=list(answer.robots),
        keyframe_robots=_array("I", answer.keyframe_robot, np.uint32),
        keyframe_ids=_array("Q", answer.keyframe_id, np.uint64),
        stamps_ns=_array("q", answer.stamp_ns, np.int64),
        orientations=_array("d", answer.world_from_body, np.float64),
        components=_array("I", answer.component, np.uint32),
        uncertainties_deg=_array("f", np.degrees(answer.uncertainty), np.float32),
    )


def flags_message(answer: Answer, frame_id: str, rows: NDArray[np.int64] | slice = slice(None)) -> OutlierFlags:
    """The answer's edges, or those of some rows."""
    source, target = answer.source[rows], answer.target[rows]
    return OutlierFlags(
        header=_header(answer, frame_id),
        edge_ids=_array("Q", answer.edge_id[rows], np.uint64),
        robots=list(answer.robots),
        source_robots=_array("I", answer.keyframe_robot[source], np.uint32),
        source_ids=_array("Q", answer.keyframe_id[source], np.uint64),
        target_robots=_array("I", answer.keyframe_robot[target], np.uint32),
        target_ids=_array("Q", answer.keyframe_id[target], np.uint64),
        kinds=_array("B", answer.kind[rows], np.uint8),
        scores=_array("f", answer.outlier_score[rows], np.float32),
        outliers=answer.outlier[rows].tolist(),
        rotation_scores=_array("f", _known(answer.rotation_score, rows), np.float32),
        residuals_deg=_array("f", answer.residual_deg[rows], np.float32),
        residuals_m=_array("f", _known(answer.residual_m, rows), np.float32),
    )


def _known(values: NDArray[np.float64] | None, rows: NDArray[np.int64] | slice) -> NDArray[np.float64]:
    return np.empty(0) if values is None else values[rows]


def _header(answer: Answer, frame_id: str) -> Header:
    return Header(stamp=to_time(answer.newest_stamp_ns), frame_id=frame_id)


def _array(typecode: str, values: NDArray[Any], dtype: DTypeLike) -> array[Any]:
    """A flat array in the form that a message accepts without checking every element."""
    flat = array(typecode)
    flat.frombytes(np.ascontiguousarray(values, dtype=dtype).tobytes())
    return flat
