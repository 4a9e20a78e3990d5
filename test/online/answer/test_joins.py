"""Several robots in one estimator: gauges of their own until a closure joins them, one frame right after."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.answer.joins import Join, joins

SECOND = 1_000_000_000
ROBOTS = ("ann", "bob", "cid")
STARTS = Rotation.random(3, random_state=0)  # world_from_odometry, which nobody knows
OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0)


def odometry(robot: int, index: int) -> Rotation:
    """world_from_body in the robot's own frame."""
    return Rotation.from_euler("zyx", [7 * index, 3 * robot, index], degrees=True)


def truth(robot: int, index: int) -> Rotation:
    return STARTS[robot] * odometry(robot, index)


def feed(estimator: OnlineEstimator, start: int, stop: int) -> None:
    for index in range(start, stop):
        for robot, name in enumerate(ROBOTS):
            assert estimator.add_odometry(name, index * SECOND, odometry(robot, index).as_quat().tolist()) is None


def closure(edge_id: int, source: tuple[int, int], target: tuple[int, int]) -> EdgeMeasurement:
    ends = (KeyframeReference(ROBOTS[robot], index) for robot, index in (source, target))
    return EdgeMeasurement(edge_id, *ends, (truth(*target).inv() * truth(*source)).as_quat().tolist())


def current(estimator: OnlineEstimator, robot: int) -> Rotation:
    return Rotation.from_quat(estimator.current_orientation(ROBOTS[robot]))


def orientation(answer: Answer, robot: int, index: int) -> Rotation:
    of_robot = answer.keyframe_robot == answer.robots.index(ROBOTS[robot])
    return Rotation.from_quat(answer.world_from_body[of_robot & (answer.keyframe_id == index)][0])


def degrees(a: Rotation, b: Rotation) -> float:
    return math.degrees((a.inv() * b).magnitude())


def test_each_component_keeps_its_gauge_until_it_is_joined(solver):
    estimator = OnlineEstimator(OPTIONS, solver)
    feed(estimator, 0, 5)
    apart = estimator.tick()
    assert apart.num_components == 3 and joins(apart, apart) == []
    for robot in range(3):
        assert degrees(current(estimator, robot), odometry(robot, 4)) < 1e-9

    assert estimator.add_edge(closure(1, (1, 2), (2, 4))) is None
    feed(estimator, 5, 8)
    two = estimator.tick()
    assert joins(apart, two) == [Join(("bob", "cid"), 2)]
    assert str(joins(apart, two)[0]) == "bob and cid are joined"
    # The older one's gauge stands, the younger one follows; who is not concerned does not move.
    for robot in (0, 1):
        assert degrees(current(estimator, robot), odometry(robot, 7)) < 1e-9
        assert degrees(orientation(two, robot, 0), orientation(apart, robot, 0)) < 1e-9
    between = current(estimator, 1).inv() * current(estimator, 2)
    assert degrees(between, truth(1, 7).inv() * truth(2, 7)) < 1e-6

    estimator.add_edge(closure(2, (2, 6), (0, 1)))
    one = estimator.tick()
    assert joins(two, one) == [Join(("ann", "bob", "cid"), 2)]
    assert joins(apart, one) == [Join(("ann", "bob", "cid"), 3)]
    for robot in range(3):  # all of them in ann's frame at once, before any further odometry
        expected = STARTS[0].inv() * truth(robot, 7)
        assert degrees(current(estimator, robot), expected) < 1e-6
        np.testing.assert_allclose(
            (Rotation.from_quat(estimator.world_from_odometry(ROBOTS[robot])) * odometry(robot, 7)).as_matrix(),
            expected.as_matrix(),
            atol=1e-9,
        )


def test_pieces_of_one_track():
    assert str(Join(("ann",), 2)) == "2 pieces of ann's track are joined"
    assert str(Join(("ann", "bob", "cid"), 3)) == "ann, bob and cid are joined"
