"""What ties answers to odometry: where a component's gauge begins, and the correction of a robot's odometry frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rotavg_ros.online import quaternion
from rotavg_ros.online.gauge import component_roots
from rotavg_ros.online.graph_builder import GraphBuilder
from rotavg_ros.online.measurements import UNKNOWN_STAMP_NS, RejectedInputError
from rotavg_ros.online.quaternion import Quaternion


def root_orientations(builder: GraphBuilder, component: Tensor, answered: Tensor | None) -> Tensor:
    """body_from_world that the first keyframe of every component keeps.

    A keyframe that an earlier answer placed stays where it was: so a component keeps its gauge, the older of two
    that join imposes its own, and what splits off (a rejected edge) stays put as well.

    Args:
        builder: its graph may have grown since.
        component: ``(N,)`` numbered by first node.
        answered: body_from_world ``(n, 4)`` of the last answer.

    Returns:
        ``(C, 4)``.
    """
    known = 0 if answered is None else len(answered)
    orientations: list[Sequence[float]] = []
    for root in component_roots(component).tolist():
        if answered is not None and root < known:
            orientations.append(answered[root].tolist())
        else:
            orientations.append(quaternion.inverse(_initial_world_from_body(builder, root)))
    return torch.tensor(orientations, dtype=torch.float64)


def first_correction(builder: GraphBuilder, robot: str) -> Quaternion:
    """world_from_odometry before the robot's first answer: what makes its first odometry fit the gauge."""
    return quaternion.IDENTITY if builder.options.gauge == "odometry" else builder.tracks[robot].first_body_from_world()


def corrections(builder: GraphBuilder, body_from_world: Tensor) -> dict[str, Quaternion]:
    """world_from_odometry of every robot, from its newest keyframe that is in the answer and has odometry.

    Args:
        builder: its graph may have grown since the answer.
        body_from_world: the answer's, ``(n, 4)``.
    """
    found = {}
    for robot, track in builder.tracks.items():
        for node in builder.graph.nodes_newest_first(robot):
            if node >= len(body_from_world):
                continue
            try:
                odometry = track.world_from_body_at(builder.graph.stamp_of(node))
            except RejectedInputError:
                continue
            x, y, z, w = body_from_world[node].tolist()
            found[robot] = quaternion.inverse(quaternion.multiply(odometry, (x, y, z, w)))
            break
    return found


def _initial_world_from_body(builder: GraphBuilder, node: int) -> Quaternion:
    """Where a component's first keyframe begins."""
    stamp_ns = builder.graph.stamp_of(node)
    track = builder.tracks.get(builder.graph.robot_of(node))
    if builder.options.gauge == "odometry" and track is not None and stamp_ns != UNKNOWN_STAMP_NS:
        try:
            return track.world_from_body_at(stamp_ns)
        except RejectedInputError:
            pass  # the odometry does not cover the keyframe: identity is as good as anything
    return quaternion.IDENTITY
