"""From messages to a graph: keyframes from odometry, edges tied to keyframes, everything unusable counted."""

from __future__ import annotations

from rotavg_ros.online import quaternion
from rotavg_ros.online.graph.edge_placement import EdgePlacement
from rotavg_ros.online.graph.growing_view_graph import GrowingViewGraph
from rotavg_ros.online.graph.growth import Growth
from rotavg_ros.online.graph.snapshot import GraphEdge
from rotavg_ros.online.measurements import (
    EdgeMeasurement,
    OdometryMessage,
    RejectedInputError,
    RejectReason,
)
from rotavg_ros.online.odometry.time_jumps import KEEPS_TIME_LINE
from rotavg_ros.online.odometry.track import OdometryTrack
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.quaternion import UNKNOWN_VECTOR, difference
from rotavg_ros.view_graph import EdgeKind, EdgeLabel


class GraphBuilder:
    """Grows a graph from odometry and edges. Not thread-safe.

    The graph depends on the messages of each robot's odometry in their order and on the set of edges, not on how
    they were interleaved. An edge by stamp waits until the odometry has reached the stamp, and is then tied to the
    keyframe at or before it, with the odometry's motion in between taken out. In silence one that is slightly ahead is
    tied to the odometry's end, but where it belongs as soon as odometry goes on. Only where a robot's clock goes back
    does the order matter, since from then on a stamp means the time line that has just begun.

    Attributes:
        growth: the graph so far, and what is needed to grow it.
    """

    def __init__(self, growth: Growth) -> None:
        self.growth = growth
        self._edges = EdgePlacement(growth)
        self._policy = growth.options.keyframe_policy

    @property
    def options(self) -> EstimatorOptions:
        return self.growth.options

    @property
    def graph(self) -> GrowingViewGraph:
        return self.growth.graph

    @property
    def tracks(self) -> dict[str, OdometryTrack]:
        return self.growth.tracks

    def set_options(self, options: EstimatorOptions) -> None:
        """Change what applies to inputs from now on: keyframe thresholds, tolerances, gaps."""
        self.growth.options = options
        self._policy = options.keyframe_policy
        self.growth.fingerprints.capacity = options.max_edges
        for track in self.tracks.values():
            track.set_limits(options.odometry_bounds, options.continuity_limits)
        self.growth.room.try_again()

    def add_odometry(self, message: OdometryMessage) -> tuple[RejectReason | None, list[OdometryMessage]]:
        """Take an odometry message.

        Returns:
            why it was refused and counted, None if it was taken; and, if this message shows that the robot's clock has
            gone back, its messages since then.
        """
        robot, growth = message.robot, self.growth
        track = self.tracks.get(robot)
        if track is None:
            track = OdometryTrack(self.options.odometry_bounds, self.options.continuity_limits)
        elif track.comes_after_the_clock(message.stamp_ns, self.options.time_jump_ns):
            self.begin_time_line(robot)
        try:
            track.add(message.stamp_ns, message.world_from_body, message.position, message.body_from_sensor)
        except RejectedInputError as rejection:
            is_late = rejection.reason is RejectReason.OUT_OF_ORDER_ODOMETRY
            return growth.refuse(rejection.reason), self._late(message, track) if is_late else []
        self.tracks[robot] = track
        growth.backward_jumps.on_time(robot)
        chooses = self.options.keyframe_source == "odometry"
        if chooses and track.reached(self._policy) and growth.has_room_for_keyframe():
            self._add_keyframe(robot, track)
        self._edges.odometry_reached(robot, message.stamp_ns)
        growth.advance_data_time(robot, message.stamp_ns)
        self._edges.decide(robot)
        return None, []

    def _late(self, message: OdometryMessage, track: OdometryTrack) -> list[OdometryMessage]:
        """Note an out-of-order message; returns the messages since the robot's clock went back, once that is clear."""
        options, jumps = self.options, self.growth.backward_jumps
        since_jump = jumps.late(message, track.samples.stamps_ns, options.time_jump_ns, options.on_time_jump)
        if not since_jump or options.on_time_jump in KEEPS_TIME_LINE:
            self._edges.decide(message.robot)
        return since_jump

    def begin_time_line(self, robot: str, num_late: int = 0) -> None:
        """The robot's clock went back: stamps now belong to a new time line, and its odometry to a new chain.

        Args:
            robot: with odometry.
            num_late: messages that were refused as out of order and will be taken again now.
        """
        growth = self.growth
        self._edges.end_time_line(robot)
        self.tracks[robot].begin_time_line()
        growth.refuse(RejectReason.OUT_OF_ORDER_ODOMETRY, -num_late)
        growth.data_time_went_back(robot)

    def clock_went_back(self, now_ns: int) -> bool:
        """The clock that stamps the data went back: a new time line for every robot whose odometry is ahead of it.

        It begins with the first message that is back as well: the clock comes on a topic of its own, and may overtake
        odometry, of which all that is not back belongs to the time line before.

        Returns:
            whether there was one.
        """
        ahead = [
            robot
            for robot, track in self.tracks.items()
            if track.latest is not None
            and track.latest.stamp_ns - now_ns > self.options.time_jump_ns
            and not (track.begins_time_line or track.awaits_time_line)
        ]
        for robot in ahead:
            self.tracks[robot].await_time_line()
        return bool(ahead)

    def add_edge(self, edge: EdgeMeasurement) -> RejectReason | None:
        """Take an edge into the graph or into the waiting room; returns why it was refused, if it was."""
        return self._edges.add(edge)

    def label_edge(self, source_robot: str, edge_id: int, label: EdgeLabel, to_come: int = 0) -> int:
        """Label all edges with this sender's id, see :meth:`EdgePlacement.label`."""
        return self._edges.label(source_robot, edge_id, label, to_come)

    def settle(self) -> None:
        """No more input is expected for now: tie edges slightly ahead of the odometry to its end, until it goes on."""
        for robot in self.tracks:
            self._edges.settle(robot)

    def _add_keyframe(self, robot: str, track: OdometryTrack) -> None:
        """Make the latest odometry message a keyframe, with an edge from the one before on the same chain."""
        assert track.latest is not None
        previous, latest = track.last_keyframe, track.latest
        source = self.graph.node(robot, track.num_keyframes - 1)
        moment = latest.stamp_ns, track.time_line
        keyframe_id = track.num_keyframes = self.graph.free_id(robot, track.num_keyframes, moment)
        node = self.graph.add_keyframe(robot, keyframe_id, *moment)
        if previous is not None:
            assert source is not None
            turn = quaternion.multiply(quaternion.inverse(latest.world_from_body), previous.world_from_body)
            step = difference(latest.position or UNKNOWN_VECTOR, previous.position or UNKNOWN_VECTOR)
            translation = quaternion.rotate(quaternion.inverse(previous.world_from_body), step)
            self.graph.add_edge(
                GraphEdge(source, node, quaternion.normalize(turn), EdgeKind.ODOMETRY, translation=translation)
            )
        track.mark_keyframe()
        self._edges.place_all(self.growth.pending.pop_keyframe(robot, keyframe_id))
