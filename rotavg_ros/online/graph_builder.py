"""From messages to a graph: keyframes from odometry, edges tied to keyframes, everything unusable counted."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from rotavg_ros.online import quaternion
from rotavg_ros.online.growing_view_graph import GrowingViewGraph
from rotavg_ros.online.keyframes import OdometryTrack
from rotavg_ros.online.measurements import (
    OWN_EDGE_ID,
    UNKNOWN_STAMP_NS,
    EdgeMeasurement,
    KeyframeReference,
    RejectedInputError,
    RejectReason,
    check_edge,
)
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.pending import PendingEdges
from rotavg_ros.online.quaternion import UNKNOWN_VECTOR, Quaternion, Vector
from rotavg_ros.view_graph import EdgeKind, EdgeLabel


@dataclass(frozen=True, slots=True)
class _Attachment:
    """Where an edge's end is tied to the graph: a keyframe, and how the body has moved since.

    Attributes:
        node: the keyframe's.
        keyframe_from_body: the body's orientation in the keyframe's frame.
        position: of the body in the keyframe's frame, metres; NaN where the odometry carries none.
    """

    node: int
    keyframe_from_body: Quaternion = quaternion.IDENTITY
    position: Vector = (0.0, 0.0, 0.0)


class GraphBuilder:
    """The growing graph and what is needed to grow it. Not thread-safe.

    The graph depends on the messages of each robot's odometry in their order and on the set of edges, not on how
    they were interleaved: an edge by stamp waits until the odometry has come as far, and is then tied to the
    keyframe at or before the stamp, with the odometry's rotation in between taken out.

    Attributes:
        graph: the growing graph.
        tracks: odometry per robot.
        pending: edges that wait for a keyframe or for odometry.
        rejected: how many inputs were refused, by :class:`RejectReason`.
        labels: the users' verdicts, by source robot and edge id.
        data_time_ns: newest stamp of odometry or of keyframes, None before the first.
    """

    def __init__(self, options: EstimatorOptions) -> None:
        self.options = options
        self.graph = GrowingViewGraph()
        self.tracks: dict[str, OdometryTrack] = {}
        self.pending = PendingEdges(options.pending_capacity, options.pending_timeout_ns)
        self.rejected: Counter[str] = Counter()
        self.labels: dict[tuple[str, int], int] = {}
        self.fingerprints: set[int] = set()
        self.data_time_ns: int | None = None
        self._policy = options.keyframe_policy
        self._claimed_time_ns: int | None = None

    def set_options(self, options: EstimatorOptions) -> None:
        """Change what applies to inputs from now on: keyframe thresholds, tolerances, gaps."""
        self.options = options
        self._policy = options.keyframe_policy
        for track in self.tracks.values():
            track.bounds, track.continuity.limits = options.odometry_bounds, options.continuity_limits

    def add_odometry(
        self, robot: str, stamp_ns: int, world_from_body: Sequence[float], position: Sequence[float] | None
    ) -> RejectReason | None:
        """Take an odometry message; returns why it was refused, if it was."""
        track = self.tracks.get(robot)
        if track is None:
            track = OdometryTrack(self.options.odometry_bounds, self.options.continuity_limits)
        try:
            track.add(stamp_ns, world_from_body, position)
        except RejectedInputError as rejection:
            self.rejected[rejection.reason.value] += 1
            return rejection.reason
        self.tracks[robot] = track
        chooses = self.options.keyframe_source == "odometry" and not self.is_full
        if chooses and track.reached(self._policy):
            self._add_keyframe_from_odometry(robot, track)
        self._place_all(self.pending.pop_until(robot, stamp_ns))
        self._advance_data_time(stamp_ns)
        return None

    def add_edge(self, edge: EdgeMeasurement) -> RejectReason | None:
        """Take an edge into the graph or into the waiting room; returns why it was refused, if it was."""
        try:
            edge = replace(edge, target_from_source=check_edge(edge))
            fingerprint = edge.fingerprint()
            if fingerprint in self.fingerprints:
                raise RejectedInputError(RejectReason.DUPLICATE_EDGE)
            if self.graph.num_edges >= self.options.max_edges:
                raise RejectedInputError(RejectReason.GRAPH_FULL)
        except RejectedInputError as rejection:
            self.rejected[rejection.reason.value] += 1
            return rejection.reason
        self.fingerprints.add(fingerprint)
        self._create_keyframes(edge)
        try:
            self._place(edge)
        except RejectedInputError as rejection:
            self._drop(edge, rejection.reason)
            return rejection.reason
        return None

    @property
    def is_full(self) -> bool:
        """Whether there may be no more keyframes: edges are tied to those there are, or wait in vain."""
        return self.graph.num_keyframes >= self.options.max_keyframes

    def label_edge(self, source_robot: str, edge_id: int, label: EdgeLabel) -> int:
        """Label all edges a sender gave this id, waiting ones and later repetitions included; returns how many."""
        waiting = sum(edge.edge_id == edge_id and edge.source.robot == source_robot for edge in self.pending)
        labelled = self.graph.label_edges(source_robot, edge_id, label) if edge_id != OWN_EDGE_ID else 0
        if labelled + waiting:
            self.labels[source_robot, edge_id] = label
        return labelled + waiting

    def settle(self) -> None:
        """No more input is expected for now: tie edges just ahead of the odometry to its end."""
        for robot, track in self.tracks.items():
            if track.latest is not None:
                horizon = track.latest.stamp_ns + self.options.odometry_bounds.tolerance_ns
                self._place_all(self.pending.pop_until(robot, horizon), settle=True)

    def _add_keyframe_from_odometry(self, robot: str, track: OdometryTrack) -> None:
        assert track.latest is not None
        keyframe_id, previous = track.num_keyframes, track.last_keyframe
        node = self.graph.add_keyframe(robot, keyframe_id, track.latest.stamp_ns)
        if previous is not None:
            source = self.graph.node(robot, keyframe_id - 1)
            assert source is not None
            target_from_source = quaternion.normalize(
                quaternion.multiply(
                    quaternion.inverse(track.latest.world_from_body),
                    previous.world_from_body,
                )
            )
            step = _difference(track.latest.position or UNKNOWN_VECTOR, previous.position or UNKNOWN_VECTOR)
            self.graph.add_edge(
                OWN_EDGE_ID,
                source,
                node,
                target_from_source,
                EdgeKind.ODOMETRY,
                math.nan,
                translation=quaternion.rotate(quaternion.inverse(previous.world_from_body), step),
            )
        track.mark_keyframe()
        self._place_all(self.pending.pop_keyframe(robot, keyframe_id))

    def _create_keyframes(self, edge: EdgeMeasurement) -> None:
        """Make the keyframes that the edge names, where edges may do so."""
        chosen_by_front_end = self.options.keyframe_source == "edges" and edge.kind == EdgeKind.ODOMETRY
        for end in (edge.source, edge.target):
            stamp_ns = UNKNOWN_STAMP_NS if end.stamp_ns is None else end.stamp_ns
            if end.keyframe_id is not None and (chosen_by_front_end or self.options.unknown_keyframes == "create"):
                keyframe_id = end.keyframe_id
            elif end.keyframe_id is None and chosen_by_front_end:
                keyframe_id = stamp_ns
            else:
                continue
            if self.is_full and self.graph.node(end.robot, keyframe_id) is None:
                continue
            self.graph.add_keyframe(end.robot, keyframe_id, stamp_ns)
            self._place_all(self.pending.pop_keyframe(end.robot, keyframe_id))
        if chosen_by_front_end:
            self._advance_data_time(max(end.stamp_ns or 0 for end in (edge.source, edge.target)))

    def _place(self, edge: EdgeMeasurement, settle: bool = False) -> None:
        """Put an edge into the graph, or let it wait for its first end that is not there yet."""
        ends = []
        for reference in (edge.source, edge.target):
            attachment = self._attach(reference, settle)
            if attachment is None:
                evicted = self.pending.add(edge, reference, self.data_time_ns)
                if evicted is not None:
                    self._drop(evicted, RejectReason.PENDING_OVERFLOW)
                return
            ends.append(attachment)
        source, target = ends
        if source.node == target.node:
            raise RejectedInputError(RejectReason.SELF_EDGE)
        # R_kt R_ks⁻¹ = (R_kt R_t⁻¹) (R_t R_s⁻¹) (R_s R_ks⁻¹): keyframes ks and kt, moments s and t.
        measured = quaternion.normalize(edge.target_from_source)
        target_from_source = quaternion.multiply(
            quaternion.multiply(target.keyframe_from_body, measured), quaternion.inverse(source.keyframe_from_body)
        )
        self.graph.add_edge(
            edge.edge_id,
            source.node,
            target.node,
            quaternion.normalize(target_from_source),
            edge.kind,
            edge.precision or math.nan,
            self.labels.get((edge.source.robot, edge.edge_id), EdgeLabel.AUTOMATIC),
            _between_keyframes(edge, measured, source, target),
        )

    def _attach(self, reference: KeyframeReference, settle: bool) -> _Attachment | None:
        """Tie one end to a keyframe; None if what it needs is not there yet.

        Raises:
            RejectedInputError: a stamp before the odometry's first or inside a gap of it, or a robot without keyframes.
        """
        robot, stamp_ns = reference.robot, reference.stamp_ns
        if reference.keyframe_id is not None:
            node = self.graph.node(robot, reference.keyframe_id)
            return None if node is None else _Attachment(node)
        assert stamp_ns is not None
        node = self.graph.keyframe_at_or_before(robot, stamp_ns)
        if node is not None and self.graph.stamp_of(node) == stamp_ns:
            return _Attachment(node)
        track = self.tracks.get(robot)
        if track is None or not (track.reaches(stamp_ns) or (settle and track.within_tolerance(stamp_ns))):
            return None
        now = track.world_from_body_at(stamp_ns)
        if node is None:
            node = self.graph.first_keyframe(robot)
        if node is None:
            raise RejectedInputError(RejectReason.UNKNOWN_KEYFRAME)
        keyframe_ns = self.graph.stamp_of(node)
        if track.chain_at(keyframe_ns) != track.chain_at(stamp_ns):
            raise RejectedInputError(RejectReason.ODOMETRY_GAP)
        keyframe_from_odometry = quaternion.inverse(track.world_from_body_at(keyframe_ns))
        return _Attachment(
            node,
            quaternion.multiply(keyframe_from_odometry, now),
            quaternion.rotate(
                keyframe_from_odometry, _difference(track.position_at(stamp_ns), track.position_at(keyframe_ns))
            ),
        )

    def _place_all(self, edges: Iterable[EdgeMeasurement], settle: bool = False) -> None:
        for edge in edges:
            try:
                self._place(edge, settle)
            except RejectedInputError as rejection:
                self._drop(edge, rejection.reason)

    def _advance_data_time(self, stamp_ns: int) -> None:
        """Let what has waited for too long go; a stamp far ahead counts only when a second one says so."""
        lead_ns = self.options.continuity_limits.lead_ns
        if self.data_time_ns is not None and stamp_ns - self.data_time_ns > lead_ns:
            claimed_ns, self._claimed_time_ns = self._claimed_time_ns, stamp_ns
            if claimed_ns is None or not 0 <= stamp_ns - claimed_ns <= lead_ns:
                return
        self.data_time_ns = max(stamp_ns, self.data_time_ns or 0)
        for edge in self.pending.pop_expired(self.data_time_ns):
            self._drop(edge, RejectReason.PENDING_TIMEOUT)

    def _drop(self, edge: EdgeMeasurement, reason: RejectReason) -> None:
        self.rejected[reason.value] += 1
        self.fingerprints.discard(edge.fingerprint())  # a retransmission gets another chance


def _between_keyframes(
    edge: EdgeMeasurement, target_from_source: Quaternion, source: _Attachment, target: _Attachment
) -> Vector:
    """Position of the target's keyframe in the frame of the source's, metres; NaN unknown.

    ``p_ks_kt = p_ks_s + R_ks_s (p_s_t + R_s_t R_t_kt (-p_kt_t))``, pose by pose along ks → s → t → kt.
    """
    if edge.translation is None or not all(map(math.isfinite, edge.translation)):
        return UNKNOWN_VECTOR
    to_keyframe = quaternion.rotate(quaternion.inverse(target.keyframe_from_body), target.position)
    step = _difference(edge.translation, quaternion.rotate(quaternion.inverse(target_from_source), to_keyframe))
    x, y, z = quaternion.rotate(source.keyframe_from_body, step)
    return (x + source.position[0], y + source.position[1], z + source.position[2])


def _difference(a: Sequence[float], b: Sequence[float]) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])
