"""Ties ends of edges to keyframes: poses of moments between keyframes, and what an edge says about the keyframes."""

from __future__ import annotations

from dataclasses import dataclass

from rotavg_ros.online import quaternion
from rotavg_ros.online.graph.growing_view_graph import GrowingViewGraph
from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference, RejectedInputError, RejectReason
from rotavg_ros.online.odometry.track import OdometryTrack
from rotavg_ros.online.quaternion import UNKNOWN_VECTOR, Quaternion, Vector, difference
from rotavg_ros.view_graph import MAX_TRANSLATION


@dataclass(frozen=True, slots=True)
class Attachment:
    """Where an edge's end is tied to the graph: a keyframe, and how the body has moved since.

    Attributes:
        node: the keyframe's node.
        keyframe_from_body: the body's orientation in the keyframe's frame.
        position: of the body in the keyframe's frame, metres; NaN where the odometry carries none.
        at_keyframe: whether the end is one of the graph's keyframes, or at least between two of them.
    """

    node: int
    keyframe_from_body: Quaternion = quaternion.IDENTITY
    position: Vector = (0.0, 0.0, 0.0)
    at_keyframe: bool = True


def attach(
    reference: KeyframeReference, graph: GrowingViewGraph, track: OdometryTrack | None, settle: bool
) -> Attachment | None:
    """Tie one end to a keyframe; None if what it needs is not there yet.

    Args:
        reference: the end.
        graph: with the keyframes so far.
        track: the odometry of the end's robot, if there is any.
        settle: no more odometry is expected for now, so its last message stands for moments shortly after it.

    Raises:
        RejectedInputError: a stamp before the odometry's first or inside a gap of it, a robot without keyframes, or a
            keyframe that was marginalised too long ago.
    """
    robot, stamp_ns = reference.robot, reference.stamp_ns
    if reference.keyframe_id is not None:
        node = graph.node(robot, reference.keyframe_id)
        return _marginalized(reference, graph, 0) if node is None else Attachment(node)
    assert stamp_ns is not None
    line = 0 if track is None else track.time_line_of(stamp_ns)
    node = graph.keyframe_at_or_before(robot, stamp_ns, line)
    if node is not None and graph.moment_of(node)[0] == stamp_ns:
        return Attachment(node)
    if (marginalized := _marginalized(reference, graph, line)) is not None:
        return marginalized
    if track is None:
        return None
    is_covered = line < track.time_line or track.reaches(stamp_ns)
    if not (is_covered or (settle and track.within_tolerance(stamp_ns))):
        return None
    samples = track.samples
    now = samples.world_from_body_at(stamp_ns, line)
    if node is None:
        node = graph.first_keyframe(robot, line)
    if node is None:
        raise RejectedInputError(RejectReason.UNKNOWN_KEYFRAME)
    keyframe_ns, _ = graph.moment_of(node)
    if samples.chain_at(keyframe_ns, line) != samples.chain_at(stamp_ns, line):
        raise RejectedInputError(RejectReason.ODOMETRY_GAP)
    keyframe_from_odometry = quaternion.inverse(samples.world_from_body_at(keyframe_ns, line))
    step = difference(samples.position_at(stamp_ns, line), samples.position_at(keyframe_ns, line))
    return Attachment(
        node, quaternion.multiply(keyframe_from_odometry, now), quaternion.rotate(keyframe_from_odometry, step)
    )


def _marginalized(reference: KeyframeReference, graph: GrowingViewGraph, time_line: int) -> Attachment | None:
    """A keyframe that is no longer a node, tied to the nearest one along the odometry that still is.

    Args:
        reference: to the keyframe.
        graph: that it was a node of.
        time_line: number of the time line that the reference's stamp belongs to, where it has no id.
    """
    robot, keyframe_id = reference.robot, reference.keyframe_id
    found = graph.marginalized_keyframe(robot, keyframe_id, reference.stamp_ns, time_line)
    if found is not None:
        return Attachment(*found, at_keyframe=False)
    if keyframe_id is not None and graph.was_marginalized(robot, keyframe_id):
        raise RejectedInputError(RejectReason.MARGINALIZED_KEYFRAME)
    return None


def between_keyframes(edge: EdgeMeasurement, source: Attachment, target: Attachment) -> tuple[Quaternion, Vector]:
    """What an edge between two moments says about the keyframes that they are tied to.

    Returns:
        target_from_source: ``R_kt R_ks⁻¹ = (R_kt R_t⁻¹) (R_t R_s⁻¹) (R_s R_ks⁻¹)`` for keyframes ks, kt, moments s, t.
        translation: position of the target's keyframe in the frame of the source's, metres; NaN unknown.
    """
    measured = quaternion.normalize(edge.target_from_source)
    target_from_source = quaternion.multiply(
        quaternion.multiply(target.keyframe_from_body, measured), quaternion.inverse(source.keyframe_from_body)
    )
    return quaternion.normalize(target_from_source), _translation(edge, measured, source, target)


def _translation(
    edge: EdgeMeasurement, target_from_source: Quaternion, source: Attachment, target: Attachment
) -> Vector:
    """``p_ks_kt = p_ks_s + R_ks_s (p_s_t + R_s_t R_t_kt (-p_kt_t))``, pose by pose along ks → s → t → kt."""
    if edge.translation is None or not all(abs(component) <= MAX_TRANSLATION for component in edge.translation):
        return UNKNOWN_VECTOR
    to_keyframe = quaternion.rotate(quaternion.inverse(target.keyframe_from_body), target.position)
    step = difference(edge.translation, quaternion.rotate(quaternion.inverse(target_from_source), to_keyframe))
    x, y, z = quaternion.rotate(source.keyframe_from_body, step)
    return (x + source.position[0], y + source.position[1], z + source.position[2])
