"""What a replay records is what the node publishes: the same answer, as both sides serialise it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rclpy.serialization import deserialize_message, serialize_message

from rotavg_ros.bags import answer_messages as recorded
from rotavg_ros.bags import bulk
from rotavg_ros.bags.message_types import typestore
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph
from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.answer.drawing import draw
from rotavg_ros.online.answer.trajectory import Trajectory
from rotavg_ros.ros.node.output import conversions, visualization

FRAME = "map"


@pytest.fixture(scope="module")
def answered() -> tuple[Answer, Trajectory]:
    """A short run with closures by stamp, and a keyframe of another robot of which nothing is known."""
    run = simulate_slam_graph(RobotRun(laps=1.5).config(), np.random.default_rng(0))
    estimator = OnlineEstimator(EstimatorOptions())
    poses = zip(
        run.stamps_ns.tolist(), run.odometry_world_from_body.tolist(), run.odometry_position.tolist(), strict=True
    )
    for stamp_ns, orientation, position in poses:
        estimator.add_odometry("röbot", stamp_ns, orientation, position)
    graph = run.graph
    for edge in np.flatnonzero(~graph.is_odometry.numpy()).tolist():
        ends = (run.stamps_ns[int(end[edge])] for end in (graph.source, graph.target))
        source, target = (KeyframeReference("röbot", stamp_ns=int(stamp_ns)) for stamp_ns in ends)
        estimator.add_edge(EdgeMeasurement(edge, source, target, graph.target_from_source[edge].tolist()))
    answer = estimator.tick(force_cold=True)
    assert answer is not None
    return answer, estimator.trajectories(answer)["röbot"]


CASES: dict[str, tuple[str, Callable[..., Any], Callable[..., Any]]] = {
    "orientations": (
        recorded.ORIENTATIONS,
        lambda answer, _: recorded.orientations_message(answer, FRAME),
        lambda answer, _: conversions.orientations_message(answer, FRAME),
    ),
    "flags": (
        recorded.FLAGS,
        lambda answer, _: recorded.flags_message(answer, FRAME),
        lambda answer, _: conversions.flags_message(answer, FRAME),
    ),
    "path": (
        recorded.PATH,
        lambda _, trajectory: recorded.path_message(trajectory, FRAME),
        lambda _, trajectory: visualization.path_message(trajectory, FRAME),
    ),
    "markers": (
        recorded.MARKERS,
        lambda answer, trajectory: recorded.markers_message(draw(answer, [trajectory]), FRAME),
        lambda answer, trajectory: visualization.markers_message(answer, [trajectory], FRAME),
    ),
}


@pytest.mark.parametrize("what", CASES)
def test_recorded_and_published_messages_agree(answered: tuple[Answer, Trajectory], what: str) -> None:
    """Read by the other side each; bytes between fields are anything in what rclpy serialises."""
    type_name, of_bag, of_node = CASES[what]
    recorded_bytes = bulk.serialize(of_bag(*answered), type_name)
    message = of_node(*answered)
    published_bytes = serialize_message(message)
    kind = type(message)
    assert deserialize_message(recorded_bytes, kind) == deserialize_message(published_bytes, kind)
    read = typestore().deserialize_cdr(published_bytes, type_name)
    assert bytes(typestore().serialize_cdr(read, type_name)) == recorded_bytes
    assert len(recorded_bytes) > 1000
