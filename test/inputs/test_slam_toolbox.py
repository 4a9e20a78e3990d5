"""slam_toolbox: poses in the plane, graphs and events that tell of the same edges."""

from __future__ import annotations

from types import SimpleNamespace as Fields

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.inputs import EDGE_CONVERTERS, Source
from rotavg_ros.inputs.fields import to_nanoseconds
from rotavg_ros.online import EstimatorOptions, OnlineEstimator, RejectReason

from .square import (
    SIDES,
    converter,
    edges,
    new_node,
    numbered_graph,
    stamp,
)


def planar_edge(source: int, target: int) -> Fields:
    """Of slam_toolbox as it was: around a square of one metre, with quarter turns to the left."""
    relative_pose = Fields(x=1.0, y=0.0, theta=np.pi / 2)
    return Fields(source_id=source, target_id=target, relative_pose=relative_pose, covariance=np.zeros(9))


def test_poses_in_the_plane_lead_around_a_square() -> None:
    graph = Fields(edges=[planar_edge(3, 0), *(planar_edge(corner, corner + 1) for corner in range(3))])
    found = edges(EDGE_CONVERTERS["slam_toolbox/msg/PoseGraph"](Source("b"))(graph))
    heading = [Rotation.from_euler("z", 90 * corner, degrees=True) for corner in range(SIDES)]
    assert [(edge.source.keyframe_id, edge.target.keyframe_id, edge.kind) for edge in found] == [
        (0, 1, 0),
        (1, 2, 0),
        (2, 3, 0),
        (3, 0, 1),
    ]
    for edge in found:
        expected = heading[edge.target.keyframe_id].inv() * heading[edge.source.keyframe_id]
        assert (Rotation.from_quat(edge.target_from_source).inv() * expected).magnitude() < 1e-12
        assert edge.translation == (1.0, 0.0, 0.0) and edge.precision == 0.0


@pytest.mark.parametrize(
    ("variance", "precision"), [(0.04, 25.0), (0.0, 0.0), (-1.0, 0.0), (float("nan"), 0.0), (float("inf"), 0.0)]
)
def test_the_precision_of_a_yaw(variance: float, precision: float) -> None:
    edge = planar_edge(0, 1)
    edge.covariance[8] = variance
    (found,) = edges(EDGE_CONVERTERS["slam_toolbox/msg/PoseGraph"](Source("b"))(Fields(edges=[edge])))
    assert found.precision == pytest.approx(precision)


@pytest.mark.parametrize("graph_first", [True, False])
def test_a_graph_and_its_events_count_once_and_the_events_stamps_are_kept(graph_first: bool) -> None:
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), lambda *_, **__: None)
    graph = edges(converter("slam_toolbox/msg/PoseGraph")(numbered_graph()))
    convert = converter("slam_toolbox/msg/NewNodeEvent")
    events = [edge for corner in range(SIDES) for edge in edges(convert(new_node(corner)))]
    refused = [estimator.add_edge(edge) for edge in (graph + events if graph_first else events + graph)]
    assert refused.count(RejectReason.DUPLICATE_EDGE) == 3 and refused.count(None) == 4
    snapshot = estimator.snapshot()
    assert len(snapshot.graph.source) == 4
    assert snapshot.stamp_ns.tolist() == [to_nanoseconds(stamp(corner)) for corner in range(SIDES)]
