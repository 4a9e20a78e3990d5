"""Whatever a message says: drawn fields through every converter, into an estimator."""

from __future__ import annotations

from types import SimpleNamespace as Fields

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rotavg_ros.inputs import EDGE_CONVERTERS, EdgeVerdict
from rotavg_ros.online import EstimatorOptions, OnlineEstimator, RejectReason

from .square import (
    between,
    converter,
)

NUMBERS = st.one_of(
    st.sampled_from([float("nan"), float("inf"), -float("inf"), 0.0, 1.0, -1.0, 1e300, 1e-300]), st.floats(-2, 2)
)
INT32 = st.one_of(st.integers(-3, 12), st.sampled_from([-(2**31), 2**31 - 1]))
UINT32 = st.one_of(st.integers(0, 12), st.just(2**32 - 1))
UINT64 = st.one_of(st.integers(0, 12), st.just(2**64 - 1))
QUATERNIONS = st.one_of(
    st.builds(Fields, x=NUMBERS, y=NUMBERS, z=NUMBERS, w=NUMBERS), st.integers(0, 3).map(lambda k: between(k, k + 1))
)
POSITIONS = st.builds(Fields, x=NUMBERS, y=NUMBERS, z=NUMBERS)
STAMPS = st.builds(Fields, sec=INT32, nanosec=UINT32)
HEADERS = st.builds(Fields, stamp=STAMPS, frame_id=st.sampled_from(["", "camera"]))
POSES = st.builds(Fields, position=POSITIONS, orientation=QUATERNIONS)
TRANSFORMS = st.builds(Fields, translation=POSITIONS, rotation=QUATERNIONS)
MATRICES = st.builds(lambda a, b: np.array([a] * 20 + [b] * 16), NUMBERS, NUMBERS)
LINKS = st.builds(Fields, from_id=INT32, to_id=INT32, type=INT32, transform=TRANSFORMS, information=MATRICES)
POSE_GRAPH_EDGES = st.builds(
    Fields,
    **dict.fromkeys(("key_from", "key_to"), UINT64),
    **dict.fromkeys(("robot_from", "robot_to", "type"), INT32),
    pose=POSES,
    covariance=MATRICES,
)
NUMBERED_EDGES = st.builds(
    Fields,
    source_id=INT32,
    target_id=INT32,
    relative_pose=st.one_of(POSES, st.builds(Fields, x=NUMBERS, y=NUMBERS, theta=NUMBERS)),
    covariance=NUMBERS.map(lambda variance: np.full(9, variance)),
)
ODOMETRIES = st.builds(Fields, header=HEADERS, pose=st.builds(Fields, pose=POSES))
REFERENCES = st.builds(Fields, by=st.integers(0, 3), robot=st.sampled_from(["", "b"]), id=UINT64, stamp=STAMPS)
RELATIVE_ROTATIONS = st.builds(
    Fields,
    header=HEADERS,
    id=UINT64,
    sequence=UINT32,
    source=REFERENCES,
    target=REFERENCES,
    rotation=QUATERNIONS,
    precision=NUMBERS,
    translation=st.lists(NUMBERS, max_size=3),
    translation_precision=NUMBERS,
    kind=st.integers(0, 4),
)
MESSAGES = {
    "rotavg_msgs/msg/RelativeRotation": RELATIVE_ROTATIONS,
    "rotavg_msgs/msg/RelativeRotationArray": st.builds(
        Fields, header=HEADERS, edges=st.lists(RELATIVE_ROTATIONS, max_size=5)
    ),
    "rtabmap_msgs/msg/MapGraph": st.builds(
        Fields, header=HEADERS, poses_id=st.lists(INT32, max_size=5), links=st.lists(LINKS, max_size=8)
    ),
    "pose_graph_tools_msgs/msg/PoseGraph": st.builds(
        Fields,
        nodes=st.lists(st.builds(Fields, header=HEADERS, robot_id=INT32, key=UINT64), max_size=5),
        edges=st.lists(POSE_GRAPH_EDGES, max_size=8),
    ),
    "slam_toolbox/msg/PoseGraph": st.builds(Fields, header=HEADERS, edges=st.lists(NUMBERED_EDGES, max_size=8)),
    "slam_toolbox/msg/NewNodeEvent": st.builds(Fields, new_node_id=INT32, stamp=STAMPS, edge=NUMBERED_EDGES),
    "cslam_common_interfaces/msg/KeyframeOdom": st.builds(Fields, id=UINT32, odom=ODOMETRIES),
    "cslam_common_interfaces/msg/IntraRobotLoopClosure": st.builds(
        Fields, keyframe0_id=UINT32, keyframe1_id=UINT32, success=st.booleans(), transform=TRANSFORMS
    ),
    "cslam_common_interfaces/msg/InterRobotLoopClosure": st.builds(
        Fields,
        **dict.fromkeys(("robot0_id", "robot0_keyframe_id", "robot1_id", "robot1_keyframe_id"), UINT32),
        success=st.booleans(),
        transform=TRANSFORMS,
    ),
}


@pytest.mark.parametrize("type_name", EDGE_CONVERTERS)
@given(data=st.data())
@settings(max_examples=15, suppress_health_check=[HealthCheck.too_slow])
def test_whatever_a_message_says_what_comes_out_is_sound(type_name: str, data) -> None:
    """Nothing raises, and only unit quaternions, sound precisions and proper edges get into the graph."""
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), lambda *_, **__: None)
    convert = converter(type_name)
    for message in data.draw(st.lists(MESSAGES[type_name], max_size=6)):
        for record in convert(message):
            if isinstance(record, EdgeVerdict):
                estimator.label_edge(record.source_robot, record.edge_id, record.label)
            elif isinstance(record.edge, RejectReason):
                estimator.reject(record.edge)
            else:
                estimator.add_edge(record.edge)
    graph = estimator.snapshot().graph
    np.testing.assert_allclose(np.linalg.norm(graph.target_from_source.numpy(), axis=1), 1, atol=1e-9)
    assert not (graph.source == graph.target).any()
    precision = graph.precision.numpy()
    assert (np.isnan(precision) | ((precision > 0) & np.isfinite(precision))).all()
    known = np.isfinite(graph.translation.numpy())
    assert (known.all(axis=1) == known.any(axis=1)).all()
