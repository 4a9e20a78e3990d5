"""Places edges in the graph: each is refused, tied to keyframes, or left to wait for what it refers to."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

from rotavg_ros.online.graph.attachment import attach, between_keyframes
from rotavg_ros.online.graph.growth import Growth
from rotavg_ros.online.graph.pending import Waiting
from rotavg_ros.online.graph.provisional import Provisional
from rotavg_ros.online.graph.snapshot import GraphEdge
from rotavg_ros.online.measurements import (
    OWN_EDGE_ID,
    UNKNOWN_STAMP_NS,
    EdgeMeasurement,
    KeyframeReference,
    RejectedInputError,
    RejectReason,
    checked_edge,
    contradict,
)
from rotavg_ros.view_graph import EdgeKind, EdgeLabel


class EdgePlacement:
    """Places edges in a growing graph. Not thread-safe."""

    def __init__(self, growth: Growth) -> None:
        self._growth = growth

    def add(self, edge: EdgeMeasurement) -> RejectReason | None:
        """Take an edge into the graph or into the waiting room; returns why it was refused, if it was."""
        growth = self._growth
        try:
            edge = checked_edge(edge)
            undecided = self._undecided_end(edge)
            is_known = undecided is None and self._fingerprint(edge) in growth.fingerprints
            if is_known or edge in growth.pending:
                self._complete_stamps(edge)
                raise RejectedInputError(RejectReason.DUPLICATE_EDGE)
            self._check_repeated_odometry(edge)
            if not growth.has_room_for_edge():
                return growth.give_up(edge, RejectReason.GRAPH_FULL)
            if undecided is not None:
                self._let_wait(edge, undecided, is_undecided=True)
            else:
                self._create_keyframes(edge)
                self._place(edge)
        except RejectedInputError as rejection:
            return growth.refuse(rejection.reason)
        return None

    def place_all(self, edges: Iterable[EdgeMeasurement]) -> None:
        """Take edges that have waited, and were checked before."""
        for edge in edges:
            try:
                self._place(edge)
            except RejectedInputError as rejection:
                self._growth.refuse(rejection.reason)

    def odometry_reached(self, robot: str, stamp_ns: int) -> None:
        """Take the edges that waited for a robot's odometry up to a stamp; place those exactly that were there."""
        self.place_all(self._growth.pending.pop_until(robot, stamp_ns))
        self._tie_anew(self._growth.provisional.pop_until(robot, stamp_ns))

    def decide(self, robot: str) -> None:
        """Take the edges that waited until it was known which time line a robot is on, if it is known now."""
        if not self._growth.is_undecided(robot):
            for edge in self._growth.pending.pop_undecided(robot):
                self.add(edge)

    def end_time_line(self, robot: str) -> None:
        """No more odometry comes on a robot's time line: tie edges slightly ahead of its end to it, refuse the rest."""
        growth = self._growth
        self.settle(robot)
        growth.provisional.end_time_line(robot)
        growth.refuse(RejectReason.STAMP_OUT_OF_RANGE, len(growth.pending.pop_of_time_line(robot)))

    def settle(self, robot: str) -> None:
        """No more odometry is expected for now: tie edges slightly ahead of its end to it, until it goes on.

        So does an edge that was tied to an earlier end: the graph then depends on the odometry, not on when it paused.
        """
        growth, track = self._growth, self._growth.tracks[robot]
        if track.latest is not None and not track.begins_time_line:
            horizon_ns = track.latest.stamp_ns + growth.options.odometry_bounds.tolerance_ns
            for edge in growth.pending.pop_until(robot, horizon_ns):
                self._settle(edge)
            self._tie_anew(growth.provisional.pop_until(robot, horizon_ns))

    def label(self, source_robot: str, edge_id: int, label: EdgeLabel, to_come: int = 0) -> int:
        """Label all edges with this sender's id, waiting ones and later repetitions included; returns how many.

        ``to_come`` of them are known not to have been added yet.
        """
        growth = self._growth
        waiting = sum(edge.edge_id == edge_id and edge.source.robot == source_robot for edge in growth.pending)
        labelled = growth.graph.label_edges(source_robot, edge_id, label) if edge_id != OWN_EDGE_ID else 0
        found = labelled + waiting + to_come
        if found:
            growth.labels[source_robot, edge_id] = label
        return found

    def _check_repeated_odometry(self, edge: EdgeMeasurement) -> None:
        """Refuse odometry of a front end that has begun anew and uses the same ids for other places.

        Both ends then state other stamps than the graph's keyframes have; or, where they state none, the rotation
        differs much. Where both state the stamps of the graph's keyframes, they are the same keyframes. However
        different, the rotation is then another measurement, as of a second odometry, and the solver judges both.

        Raises:
            RejectedInputError: the graph has other odometry between keyframes of these ids.
        """
        source, target = edge.source, edge.target
        chosen_by_front_end = self._growth.options.keyframe_source == "edges" and edge.kind == EdgeKind.ODOMETRY
        if not chosen_by_front_end or source.keyframe_id is None or target.keyframe_id is None:
            return
        ends = (source.robot, source.keyframe_id), (target.robot, target.keyframe_id)
        known = self._growth.graph.odometry_between(*ends)
        if known is None:
            return
        are_meant = {self._is_meant(source), self._is_meant(target)}
        is_anew = are_meant == {False} or (are_meant != {True} and contradict(known, edge.target_from_source))
        if is_anew:
            raise RejectedInputError(RejectReason.CONTRADICTORY_ODOMETRY)

    def _is_meant(self, end: KeyframeReference) -> bool | None:
        """Whether an end by id states the moment of the graph's keyframe with this id; None: nobody knows."""
        growth = self._growth
        assert end.keyframe_id is not None
        node = growth.graph.node(end.robot, end.keyframe_id)
        if node is None or end.stamp_ns is None:
            return None
        stamp_ns, time_line = growth.graph.moment_of(node)
        if stamp_ns == UNKNOWN_STAMP_NS:
            return None
        if abs(end.stamp_ns - stamp_ns) > growth.options.odometry_bounds.tolerance_ns:
            return False
        return True if growth.time_line_of(end.robot, end.stamp_ns) == time_line else None

    def _undecided_end(self, edge: EdgeMeasurement) -> KeyframeReference | None:
        """The first end whose stamp matters and may belong to either of two time lines."""
        growth = self._growth
        for end in (edge.source, edge.target):
            if end.stamp_ns is not None and growth.is_undecided(end.robot):
                is_known = end.keyframe_id is not None and growth.graph.node(end.robot, end.keyframe_id) is not None
                if not is_known:
                    return end
        return None

    def _fingerprint(self, edge: EdgeMeasurement) -> int:
        """Fingerprint of an edge and its time lines: a looped bag repeats the stamps, but means other keyframes."""
        source, target = (
            0 if end.keyframe_id is not None else self._growth.time_line_of(end.robot, end.stamp_ns)
            for end in (edge.source, edge.target)
        )
        return edge.fingerprint((source, target))

    def _complete_stamps(self, edge: EdgeMeasurement) -> None:
        """Take stamps from a repeated edge for keyframes whose stamps the first one did not give."""
        graph = self._growth.graph
        for end in (edge.source, edge.target):
            if end.keyframe_id is None or end.stamp_ns is None:
                continue
            if graph.node(end.robot, end.keyframe_id) is not None:
                time_line = self._growth.time_line_of(end.robot, end.stamp_ns)
                graph.add_keyframe(end.robot, end.keyframe_id, end.stamp_ns, time_line)
                self._place_waiting(end.robot, end.keyframe_id, end.stamp_ns)

    def _create_keyframes(self, edge: EdgeMeasurement) -> None:
        """Create the keyframes that the edge names, where edges may do so."""
        growth = self._growth
        chosen_by_front_end = growth.options.keyframe_source == "edges" and edge.kind == EdgeKind.ODOMETRY
        for end in (edge.source, edge.target):
            stamp_ns = UNKNOWN_STAMP_NS if end.stamp_ns is None else end.stamp_ns
            time_line = growth.time_line_of(end.robot, end.stamp_ns)
            if end.keyframe_id is not None and (chosen_by_front_end or growth.options.unknown_keyframes == "create"):
                keyframe_id = end.keyframe_id
                was_there = growth.graph.was_marginalized(end.robot, keyframe_id)
            elif end.keyframe_id is None and chosen_by_front_end:
                keyframe_id = growth.graph.free_id(end.robot, stamp_ns, (stamp_ns, time_line))
                was_there = growth.graph.was_moment_marginalized(end.robot, stamp_ns, time_line)
            else:
                continue
            is_new = growth.graph.node(end.robot, keyframe_id) is None
            if is_new and (was_there or not growth.has_room_for_keyframe()):
                continue
            growth.graph.add_keyframe(end.robot, keyframe_id, stamp_ns, time_line)
            self._place_waiting(end.robot, keyframe_id, stamp_ns)
        if chosen_by_front_end:
            self._advance_data_time(edge)

    def _place_waiting(self, robot: str, keyframe_id: int, stamp_ns: int) -> None:
        """Take the edges that waited for a keyframe by its id or by its moment."""
        pending = self._growth.pending
        self.place_all(pending.pop_keyframe(robot, keyframe_id))
        self.place_all(pending.pop_moment(robot, stamp_ns))

    def _advance_data_time(self, edge: EdgeMeasurement) -> None:
        """Advance the time of each robot that an edge is about, once: an edge alone does not confirm its stamps."""
        newest_ns: dict[str, int] = {}
        for end in (edge.source, edge.target):
            if end.stamp_ns is not None:
                newest_ns[end.robot] = max(end.stamp_ns, newest_ns.get(end.robot, 0))
        for robot, stamp_ns in newest_ns.items():
            self._growth.advance_data_time(robot, stamp_ns)

    def _place(self, edge: EdgeMeasurement) -> None:
        """Put an edge into the graph, or let it wait for its first end that is not there yet."""
        tied = self._tied(edge)
        if isinstance(tied, KeyframeReference):
            self._let_wait(edge, tied)
        else:
            self._enter(edge, tied)

    def _settle(self, edge: EdgeMeasurement) -> None:
        """Put an edge whose stamps odometry may not have reached into the graph; its place is then provisional."""
        growth = self._growth
        try:
            missing = self._tied(edge)
            if not isinstance(missing, KeyframeReference):
                self._enter(edge, missing)
                return
        except RejectedInputError as rejection:
            growth.refuse(rejection.reason)
            return
        try:
            tied = self._tied(edge, settle=True)
        except RejectedInputError:  # odometry may show it to be fit, as one whose ends are not the same keyframe
            tied = missing
        if isinstance(tied, KeyframeReference):
            self._let_wait(edge, tied)
            return
        growth.provisional.add(Provisional(edge, missing, growth.graph.num_edges))
        self._enter(edge, tied)

    def _tie_anew(self, edges: Iterable[Provisional]) -> None:
        """Tie edges of the graph to where they belong by now, those for good that odometry has reached."""
        growth, anew = self._growth, dict[int, GraphEdge]()
        for each in edges:
            with suppress(RejectedInputError):  # its place is the best there is
                tied = self._tied(each.edge)
                if isinstance(tied, KeyframeReference):
                    growth.provisional.add(replace(each, waits_for=tied))
                    tied = self._tied(each.edge, settle=True)
                if isinstance(tied, GraphEdge):
                    anew[each.row] = tied
        growth.graph.tie_anew(anew)

    def _tied(self, edge: EdgeMeasurement, settle: bool = False) -> GraphEdge | KeyframeReference:
        """An edge between the keyframes that its ends are tied to, or its first end that is not there yet.

        Args:
            edge: checked before.
            settle: whether odometry's last message stands for moments shortly after it.

        Raises:
            RejectedInputError: it cannot be tied to two keyframes.
        """
        growth = self._growth
        ends = []
        for reference in (edge.source, edge.target):
            attachment = attach(reference, growth.graph, growth.tracks.get(reference.robot), settle)
            if attachment is None:
                return reference
            ends.append(attachment)
        source, target = ends
        if edge.kind == EdgeKind.ODOMETRY and not (source.at_keyframe and target.at_keyframe):
            raise RejectedInputError(RejectReason.MARGINALIZED_KEYFRAME)  # the graph has this odometry already
        if source.node == target.node:
            raise RejectedInputError(RejectReason.SELF_EDGE)
        target_from_source, translation = between_keyframes(edge, source, target)
        return GraphEdge(
            source.node,
            target.node,
            target_from_source,
            edge.kind,
            edge_id=edge.edge_id,
            precision=edge.precision or math.nan,
            label=growth.labels.get((edge.source.robot, edge.edge_id), EdgeLabel.AUTOMATIC),
            translation=translation,
        )

    def _enter(self, edge: EdgeMeasurement, tied: GraphEdge) -> None:
        self._growth.graph.add_edge(tied)
        self._growth.fingerprints.add(self._fingerprint(edge))

    def _let_wait(self, edge: EdgeMeasurement, waits_for: KeyframeReference, is_undecided: bool = False) -> None:
        growth = self._growth
        timed_by = growth.timed_by(edge, waits_for)
        evicted = growth.pending.add(Waiting(edge, waits_for, timed_by, growth.now_ns(timed_by), is_undecided))
        if evicted is not None:
            growth.give_up(evicted, RejectReason.PENDING_OVERFLOW)
