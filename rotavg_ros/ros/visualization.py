"""Answers as pictures for RViz and Foxglove: a path per robot, the graph coloured by outlier score."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseStamped, Vector3
from nav_msgs.msg import Path
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from rotavg_ros.online import Answer
from rotavg_ros.online.trajectory import Trajectory
from rotavg_ros.ros.conversions import to_quaternion_message, to_time

_EDGE_WIDTH_M = 0.03
_KEYFRAME_SIZE_M = 0.12
_KEYFRAME_COLOR = ColorRGBA(r=0.15, g=0.35, b=0.75, a=1.0)
_NUM_COLORS = 32


def path_message(trajectory: Trajectory, frame_id: str) -> Path:
    """Corrected keyframe poses; the origin where the odometry carries no positions."""
    positions = np.nan_to_num(trajectory.position).tolist()
    poses = [
        PoseStamped(header=Header(stamp=to_time(stamp_ns), frame_id=frame_id), pose=_pose(position, orientation))
        for stamp_ns, position, orientation in zip(
            trajectory.stamp_ns.tolist(), positions, trajectory.world_from_body.tolist(), strict=True
        )
    ]
    newest = int(trajectory.stamp_ns[-1]) if len(trajectory.stamp_ns) else 0
    return Path(header=Header(stamp=to_time(newest), frame_id=frame_id), poses=poses)


def markers_message(answer: Answer, trajectories: list[Trajectory], frame_id: str) -> MarkerArray:
    """One sphere list of the keyframes and one line list of the edges, green (inlier) to red (outlier).

    Keyframes without a known position are left out, and their edges with them.
    """
    position = np.full((len(answer.keyframe_id), 3), np.nan)
    for trajectory in trajectories:
        position[trajectory.node] = trajectory.position
    placed = np.isfinite(position).all(axis=1)
    points = [
        Point(x=x, y=y, z=z) if known else None for (x, y, z), known in zip(position.tolist(), placed, strict=True)
    ]
    header = Header(frame_id=frame_id)
    spheres = Marker(header=header, ns="keyframes", id=0, type=Marker.SPHERE_LIST, color=_KEYFRAME_COLOR)
    spheres.scale = Vector3(x=_KEYFRAME_SIZE_M, y=_KEYFRAME_SIZE_M, z=_KEYFRAME_SIZE_M)
    spheres.points = [points[node] for node in np.flatnonzero(placed).tolist()]
    lines = Marker(header=header, ns="edges", id=0, type=Marker.LINE_LIST)
    lines.scale = Vector3(x=_EDGE_WIDTH_M)
    shown = np.flatnonzero(placed[answer.source] & placed[answer.target])
    colors = _colors(answer.outlier_score[shown])
    ends = zip(answer.source[shown].tolist(), answer.target[shown].tolist(), strict=True)
    lines.points = [points[node] for pair in ends for node in pair]
    lines.colors = [color for color in colors for _ in range(2)]
    for marker in (spheres, lines):
        marker.pose.orientation.w = 1.0
    return MarkerArray(markers=[spheres, lines])


def _colors(score: NDArray[np.float64]) -> list[ColorRGBA]:
    palette = [
        ColorRGBA(r=share, g=0.75 * (1 - share), b=0.1, a=0.5 + 0.5 * share)
        for share in np.linspace(0, 1, _NUM_COLORS).tolist()
    ]
    return [palette[index] for index in np.rint(np.nan_to_num(score) * (_NUM_COLORS - 1)).astype(int).tolist()]


def _pose(position: list[float], orientation: list[float]) -> Pose:
    x, y, z = position
    qx, qy, qz, qw = orientation
    return Pose(position=Point(x=x, y=y, z=z), orientation=to_quaternion_message((qx, qy, qz, qw)))
