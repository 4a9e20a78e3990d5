"""Answers as pictures for RViz and Foxglove: a path per robot, the graph coloured by outlier score."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseStamped, Vector3
from nav_msgs.msg import Path
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from rotavg_ros.online import Answer
from rotavg_ros.online.answer.drawing import EDGE_WIDTH_M, KEYFRAME_COLOR, KEYFRAME_SIZE_M, PALETTE, draw
from rotavg_ros.online.answer.trajectory import Trajectory
from rotavg_ros.ros.node.output.conversions import to_quaternion_message, to_time


def path_message(trajectory: Trajectory, frame_id: str) -> Path:
    """Corrected keyframe poses; the origin where the odometry carries no positions."""
    rows = trajectory.on_path
    columns = trajectory.stamp_ns, np.nan_to_num(trajectory.position), trajectory.world_from_body
    poses = [
        PoseStamped(header=Header(stamp=to_time(stamp_ns), frame_id=frame_id), pose=_pose(position, orientation))
        for stamp_ns, position, orientation in zip(*(column[rows].tolist() for column in columns), strict=True)
    ]
    newest = int(trajectory.stamp_ns[-1]) if len(trajectory.stamp_ns) else 0
    return Path(header=Header(stamp=to_time(newest), frame_id=frame_id), poses=poses)


def no_path(frame_id: str) -> Path:
    """An empty path, for a robot without keyframes."""
    return Path(header=Header(frame_id=frame_id))


def no_markers(frame_id: str) -> MarkerArray:
    """A message that deletes all markers."""
    return MarkerArray(markers=[Marker(header=Header(frame_id=frame_id), action=Marker.DELETEALL)])


def markers_message(answer: Answer, trajectories: list[Trajectory], frame_id: str) -> MarkerArray:
    """One sphere list of the keyframes and one line list of the edges, green (inlier) to red (outlier)."""
    drawing = draw(answer, trajectories)
    header = Header(frame_id=frame_id)
    spheres = Marker(header=header, ns="keyframes", id=0, type=Marker.SPHERE_LIST, color=_color(KEYFRAME_COLOR))
    spheres.scale = Vector3(x=KEYFRAME_SIZE_M, y=KEYFRAME_SIZE_M, z=KEYFRAME_SIZE_M)
    spheres.points = _points(drawing.keyframes)
    lines = Marker(header=header, ns="edges", id=0, type=Marker.LINE_LIST)
    lines.scale = Vector3(x=EDGE_WIDTH_M)
    lines.points = _points(drawing.edge_ends)
    palette = [_color(rgba) for rgba in PALETTE]
    lines.colors = [palette[shade] for shade in drawing.edge_shades.tolist() for _ in range(2)]
    for marker in (spheres, lines):
        marker.pose.orientation.w = 1.0
    return MarkerArray(markers=[spheres, lines])


def _points(xyz: NDArray[np.float64]) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in xyz.tolist()]


def _color(rgba: tuple[float, float, float, float]) -> ColorRGBA:
    red, green, blue, opacity = rgba
    return ColorRGBA(r=red, g=green, b=blue, a=opacity)


def _pose(position: list[float], orientation: list[float]) -> Pose:
    x, y, z = position
    qx, qy, qz, qw = orientation
    return Pose(position=Point(x=x, y=y, z=z), orientation=to_quaternion_message((qx, qy, qz, qw)))
