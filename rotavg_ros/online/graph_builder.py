"""From messages to a graph: keyframes from odometry, edges tied to keyframes, everything unusable counted."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online import quaternion
from rotavg_ros.online.attachment import attach, between_keyframes
from rotavg_ros.online.fingerprints import Fingerprints
from rotavg_ros.online.growing_view_graph import GrowingViewGraph
from rotavg_ros.online.keyframes import OdometryTrack
from rotavg_ros.online.measurements import (
    OWN_EDGE_ID,
    UNKNOWN_STAMP_NS,
    EdgeMeasurement,
    RejectedInputError,
    RejectReason,
    check_edge,
)
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.pending import PendingEdges
from rotavg_ros.online.quaternion import UNKNOWN_VECTOR, difference
from rotavg_ros.online.renumbering import Renumbering
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

# How full a full graph is after keyframes or closures have been taken out of it: the cost of doing so, which grows
# with the graph, is shared by all that come until it is full again.
_FILL = 0.9
# If less than this share of the limit could be spared, it is not tried again before a tenth of it has come.
_WORTHWHILE = 0.01
# Of how many marginalised keyframes it stays known where they were: so many limits of keyframes, or a few megabytes.
_REMEMBERED = 4
_REMEMBERED_AT_LEAST = 50_000


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
        fingerprints: of the edges in the graph and of the latest of those that were in it.
        outlier: the last answer's flags, of the first edges.
        marginalized, dropped_closures: how many keyframes and closures were taken out of a full graph.
        on_compaction: called when indices have changed.
        data_time_ns: newest stamp of odometry or of keyframes, None before the first.
    """

    def __init__(self, options: EstimatorOptions) -> None:
        self.options = options
        self.graph = GrowingViewGraph()
        self.tracks: dict[str, OdometryTrack] = {}
        self.pending = PendingEdges(options.pending_capacity, options.pending_timeout_ns)
        self.rejected: Counter[str] = Counter()
        self.labels: dict[tuple[str, int], int] = {}
        self.fingerprints = Fingerprints(options.max_edges)
        self.outlier: NDArray[np.bool_] = np.zeros(0, dtype=bool)
        self.marginalized = self.dropped_closures = 0
        self.on_compaction: Callable[[Renumbering], None] | None = None
        self._compact_from_revision = [0, 0]  # for keyframes, for edges
        self.data_time_ns: int | None = None
        self._policy = options.keyframe_policy
        self._claimed_time_ns: int | None = None

    def set_options(self, options: EstimatorOptions) -> None:
        """Change what applies to inputs from now on: keyframe thresholds, tolerances, gaps."""
        self.options = options
        self._policy = options.keyframe_policy
        for track in self.tracks.values():
            track.bounds, track.continuity.limits = options.odometry_bounds, options.continuity_limits
        self._compact_from_revision = [0, 0]

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
        chooses = self.options.keyframe_source == "odometry"
        if chooses and track.reached(self._policy) and self._has_room():
            self._add_keyframe_from_odometry(robot, track)
        self._place_all(self.pending.pop_until(robot, stamp_ns))
        self._advance_data_time(stamp_ns)
        return None

    def add_edge(self, edge: EdgeMeasurement) -> RejectReason | None:
        """Take an edge into the graph or into the waiting room; returns why it was refused, if it was."""
        try:
            edge = replace(edge, target_from_source=check_edge(edge))
            fingerprint = edge.fingerprint()
            if fingerprint in self.fingerprints or fingerprint in self.pending.fingerprints:
                raise RejectedInputError(RejectReason.DUPLICATE_EDGE)
            if not self._has_room(keyframe=False):
                raise RejectedInputError(RejectReason.GRAPH_FULL)
        except RejectedInputError as rejection:
            self.rejected[rejection.reason.value] += 1
            return rejection.reason
        self._create_keyframes(edge)
        try:
            self._place(edge)
        except RejectedInputError as rejection:
            self.rejected[rejection.reason.value] += 1
            return rejection.reason
        return None

    @property
    def is_full(self) -> bool:
        """Whether there may be no more keyframes, though whatever can be spared has been taken out."""
        at_limit = self.graph.num_keyframes >= self.options.max_keyframes
        return at_limit and self.graph.revision < self._compact_from_revision[0]

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
            step = difference(track.latest.position or UNKNOWN_VECTOR, previous.position or UNKNOWN_VECTOR)
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
            is_new = self.graph.node(end.robot, keyframe_id) is None
            if is_new and (self.graph.was_marginalized(end.robot, keyframe_id) or not self._has_room()):
                continue
            self.graph.add_keyframe(end.robot, keyframe_id, stamp_ns)
            self._place_all(self.pending.pop_keyframe(end.robot, keyframe_id))
        if chosen_by_front_end:
            self._advance_data_time(max(end.stamp_ns or 0 for end in (edge.source, edge.target)))

    def _place(self, edge: EdgeMeasurement, settle: bool = False) -> None:
        """Put an edge into the graph, or let it wait for its first end that is not there yet."""
        ends = []
        for reference in (edge.source, edge.target):
            attachment = attach(reference, self.graph, self.tracks.get(reference.robot), settle)
            if attachment is None:
                evicted = self.pending.add(edge, reference, self.data_time_ns)
                if evicted is not None:
                    self.rejected[RejectReason.PENDING_OVERFLOW.value] += 1
                return
            ends.append(attachment)
        source, target = ends
        if edge.kind == EdgeKind.ODOMETRY and not (source.at_keyframe and target.at_keyframe):
            raise RejectedInputError(RejectReason.MARGINALIZED_KEYFRAME)  # the graph has this odometry already
        if source.node == target.node:
            raise RejectedInputError(RejectReason.SELF_EDGE)
        target_from_source, translation = between_keyframes(edge, source, target)
        self.graph.add_edge(
            edge.edge_id,
            source.node,
            target.node,
            target_from_source,
            edge.kind,
            edge.precision or math.nan,
            self.labels.get((edge.source.robot, edge.edge_id), EdgeLabel.AUTOMATIC),
            translation,
        )
        self.fingerprints.add(edge.fingerprint())

    def _has_room(self, *, keyframe: bool = True) -> bool:
        """Whether a keyframe (or else an edge) may come, if need be after others have gone."""
        graph, options = self.graph, self.options

        def has_room() -> bool:
            return graph.num_keyframes < options.max_keyframes if keyframe else graph.num_edges < options.max_edges

        if not has_room():
            self._make_room()
        return has_room()

    def _make_room(self) -> None:
        """Take keyframes and closures that can be spared out of a full graph."""
        graph = self.graph
        sizes = graph.num_keyframes, graph.num_edges
        limits = self.options.max_keyframes, self.options.max_edges
        surplus_keyframes, surplus_edges = (
            size - int(_FILL * limit) if size >= limit and graph.revision >= from_revision else 0
            for size, limit, from_revision in zip(sizes, limits, self._compact_from_revision, strict=True)
        )
        if not surplus_keyframes and not surplus_edges:
            return
        remembered = max(_REMEMBERED * self.options.max_keyframes, _REMEMBERED_AT_LEAST)
        renumbering = graph.compact(surplus_keyframes, surplus_edges, self.outlier, remembered)
        gained = sizes[0] - graph.num_keyframes, sizes[1] - graph.num_edges
        for index, limit in enumerate(limits):
            if (surplus_keyframes, surplus_edges)[index] and gained[index] < max(1, _WORTHWHILE * limit):
                self._compact_from_revision[index] = graph.revision + max(1, round((1 - _FILL) * limit))
        if renumbering is None:
            return
        self.outlier = renumbering.flags(self.outlier)
        self.marginalized += gained[0]
        self.dropped_closures += renumbering.num_dropped
        for robot, track in self.tracks.items():
            track.release_keyframes(graph.stamps(robot))
        if self.on_compaction is not None:
            self.on_compaction(renumbering)

    def _place_all(self, edges: Iterable[EdgeMeasurement], settle: bool = False) -> None:
        for edge in edges:
            try:
                self._place(edge, settle)
            except RejectedInputError as rejection:
                self.rejected[rejection.reason.value] += 1

    def _advance_data_time(self, stamp_ns: int) -> None:
        """Let what has waited for too long go; a stamp far ahead counts only when a second one says so."""
        lead_ns = self.options.continuity_limits.lead_ns
        if self.data_time_ns is not None and stamp_ns - self.data_time_ns > lead_ns:
            claimed_ns, self._claimed_time_ns = self._claimed_time_ns, stamp_ns
            if claimed_ns is None or not 0 <= stamp_ns - claimed_ns <= lead_ns:
                return
        self.data_time_ns = max(stamp_ns, self.data_time_ns or 0)
        expired = self.pending.pop_expired(self.data_time_ns)
        if expired:
            self.rejected[RejectReason.PENDING_TIMEOUT.value] += len(expired)
