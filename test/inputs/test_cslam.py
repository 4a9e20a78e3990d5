"""Swarm-SLAM: where a chain of keyframes ends."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace as Fields

import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.inputs import EDGE_CONVERTERS, Source
from rotavg_ros.online import EstimatorOptions, OnlineEstimator, RejectReason

from .square import (
    converter,
    edges,
    keyframe_odometry,
    quaternion,
    stamp,
)

UPRIGHT = Fields(x=0.0, y=0.0, z=0.0, w=1.0)


def test_keyframes_whose_numbers_start_again_begin_a_new_chain() -> None:
    convert = converter("cslam_common_interfaces/msg/KeyframeOdom")
    pairs = []
    for number in (0, 1, 3, 0, 4, 5):
        pairs.extend(
            edge if isinstance(edge, RejectReason) else (edge.source.keyframe_id, edge.target.keyframe_id)
            for edge in edges(convert(Fields(id=number, odom=keyframe_odometry(number).odom)))
        )
    assert pairs == [(0, 1), (1, 3), RejectReason.OUT_OF_ORDER_ODOMETRY, (4, 5)]


@pytest.mark.parametrize("turned_deg", [1.0, 30.0])
def test_steps_that_contradict_a_graph_that_was_loaded_are_refused(turned_deg: float) -> None:
    """A robot that was switched off and on counts its keyframes anew."""

    def odometry_between(*ends: tuple[str, int]) -> tuple[float, ...] | None:
        return (0.0, 0.0, 0.0, 1.0) if ends == (("b", 0), ("b", 1)) else None

    convert = EDGE_CONVERTERS["cslam_common_interfaces/msg/KeyframeOdom"](
        Source("b", odometry_between=odometry_between)
    )
    said = []
    for number in range(3):
        turned = quaternion(Rotation.from_euler("z", turned_deg * number, degrees=True))
        pose = Fields(position=Fields(x=0.0, y=0.0, z=0.0), orientation=turned)
        odom = Fields(header=Fields(stamp=stamp(number)), pose=Fields(pose=pose))
        said += [edge is RejectReason.CONTRADICTORY_ODOMETRY for edge in edges(convert(Fields(id=number, odom=odom)))]
    assert said == [turned_deg > 10, False]


def test_keyframes_of_odometry_that_begins_anew_begin_a_new_chain() -> None:
    limits = EstimatorOptions().continuity_limits
    convert = EDGE_CONVERTERS["cslam_common_interfaces/msg/KeyframeOdom"](Source("b", limits=lambda: limits))
    pairs = []
    for number in range(8):
        pose = Fields(position=Fields(x=20.0 + number if number < 4 else 0.0, y=0.0, z=0.0))
        pose.orientation = quaternion(Rotation.from_euler("z", 90 + number if number < 4 else number - 4, degrees=True))
        odom = Fields(header=Fields(stamp=stamp(number)), pose=Fields(pose=pose))
        pairs += [
            (edge.source.keyframe_id, edge.target.keyframe_id) for edge in edges(convert(Fields(id=number, odom=odom)))
        ]
    assert pairs == [(0, 1), (1, 2), (2, 3), (4, 5), (5, 6), (6, 7)]


def test_limits_that_are_changed_apply_from_then_on() -> None:
    """Parameters of the node are live: it had gone by those that it was started with."""
    slow = EstimatorOptions(max_speed=1.0)
    estimator = OnlineEstimator(slow, lambda *_, **__: None)
    convert = EDGE_CONVERTERS["cslam_common_interfaces/msg/KeyframeOdom"](Source("b").into(estimator))

    def made(numbers: range) -> int:
        poses = [Fields(position=Fields(x=5.0 * number, y=0.0, z=0.0), orientation=UPRIGHT) for number in numbers]
        odom = [
            Fields(header=Fields(stamp=stamp(number)), pose=Fields(pose=pose))
            for number, pose in zip(numbers, poses, strict=True)
        ]
        return sum(len(edges(convert(Fields(id=number, odom=odom[at])))) for at, number in enumerate(numbers))

    assert made(range(5)) == 0
    estimator.set_options(replace(slow, max_speed=50.0))
    assert made(range(5, 10)) == 5
