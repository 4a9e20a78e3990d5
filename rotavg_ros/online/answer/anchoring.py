"""What ties answers to odometry: where a component's gauge begins, and the correction of a robot's odometry frame."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rotavg_ros.online import quaternion
from rotavg_ros.online.answer.gauge import component_roots
from rotavg_ros.online.graph.builder import GraphBuilder
from rotavg_ros.online.graph.snapshot import GraphSnapshot
from rotavg_ros.online.measurements import UNKNOWN_STAMP_NS, RejectedInputError
from rotavg_ros.online.odometry.track import OdometryTrack
from rotavg_ros.online.quaternion import Quaternion


def root_orientations(
    builder: GraphBuilder, snapshot: GraphSnapshot, component: Tensor, answered: Tensor | None
) -> Tensor:
    """body_from_world that the first keyframe of every component keeps.

    A keyframe that an earlier answer placed stays where it was. So a component keeps its gauge, the older of two
    that join imposes its own, and a part that splits off (after an edge is rejected) stays put as well.

    Args:
        builder: its graph may have changed since.
        snapshot: the graph.
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
            robot = snapshot.robots[snapshot.keyframe_robot[root]]
            moment = int(snapshot.stamp_ns[root]), int(snapshot.time_line[root])
            orientations.append(quaternion.inverse(_initial_world_from_body(builder, robot, *moment)))
    return torch.tensor(orientations, dtype=torch.float64)


def first_correction(builder: GraphBuilder, robot: str) -> Quaternion:
    """world_from_odometry before the first answer about the robot's odometry chain.

    For the first chain it makes the first message fit the gauge; a later chain has an anchor.
    """
    if anchors := builder.tracks[robot].anchors:
        return anchors[-1]
    samples = builder.tracks[robot].samples
    return quaternion.IDENTITY if builder.options.gauge == "odometry" else samples.first_body_from_world()


def anchor(track: OdometryTrack, world_from_odometry: Quaternion) -> None:
    """Let the chain that has just begun start where the robot was last, as a best guess: the true pose is unknown.

    Args:
        track: has one more chain than anchors.
        world_from_odometry: of the chain before.
    """
    last, first = track.samples.seam(track.chain)
    world_from_body = quaternion.multiply(world_from_odometry, last.world_from_body)
    track.anchors.append(quaternion.multiply(world_from_body, quaternion.inverse(first.world_from_body)))


def corrections(builder: GraphBuilder, body_from_world: Tensor) -> dict[str, Quaternion]:
    """world_from_odometry of every robot, from the newest answered keyframe that its present odometry covers.

    Args:
        builder: its graph may have grown since the answer.
        body_from_world: the answer's, ``(n, 4)``.
    """
    found = {}
    for robot, track in builder.tracks.items():
        # Look only where the odometry reaches: a front end with another clock may have any number of keyframes outside.
        reach_ns = track.samples.reach()
        for node in builder.graph.nodes_newest_first(robot, track.samples.last_time_line, *reach_ns):
            if node >= len(body_from_world):
                continue
            try:
                odometry = track.samples.world_from_body_at(*builder.graph.moment_of(node))
            except RejectedInputError:  # in a gap
                continue
            x, y, z, w = body_from_world[node].tolist()
            found[robot] = quaternion.inverse(quaternion.multiply(odometry, (x, y, z, w)))
            break
    return found


def _initial_world_from_body(builder: GraphBuilder, robot: str, stamp_ns: int, time_line: int) -> Quaternion:
    """Initial orientation of a component's first keyframe."""
    track = builder.tracks.get(robot)
    if track is None or stamp_ns == UNKNOWN_STAMP_NS:
        return quaternion.IDENTITY
    chain = track.samples.chain_at(stamp_ns, time_line)
    if chain == 0 and builder.options.gauge == "identity":
        return quaternion.IDENTITY
    try:
        odometry = track.samples.world_from_body_at(stamp_ns, time_line)
    except RejectedInputError:
        return quaternion.IDENTITY  # the odometry does not cover the keyframe, so any choice will do
    return odometry if chain == 0 else quaternion.multiply(track.anchors[chain - 1], odometry)
