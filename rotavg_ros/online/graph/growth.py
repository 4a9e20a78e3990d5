"""A growing graph and everything that decides how it goes on growing."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

from rotavg_ros.online.graph.fingerprints import Fingerprints
from rotavg_ros.online.graph.growing_view_graph import GrowingViewGraph
from rotavg_ros.online.graph.pending import PendingEdges
from rotavg_ros.online.graph.provisional import ProvisionalEdges
from rotavg_ros.online.graph.room import GraphsAnswer, Room
from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference, RejectReason
from rotavg_ros.online.odometry.data_time import DataTime
from rotavg_ros.online.odometry.time_jumps import BackwardJumps
from rotavg_ros.online.odometry.track import OdometryTrack
from rotavg_ros.online.options import EstimatorOptions

# Edges remembered as given up, some tens of megabytes; beyond, the oldest are forgotten.
_MOST_GIVEN_UP = 100_000


@dataclass
class Growth:
    """The growing graph and its surroundings; a state file holds all of it but the options and what was given up.

    Attributes:
        options: those that apply from now on.
        answer: what the last answer says about the graph.
        pending: edges that wait for a keyframe or for odometry.
        fingerprints: of the edges in the graph and of the latest of those that were in it.
        graph: the graph.
        tracks: odometry per robot.
        backward_jumps: late odometry messages, as long as they may show that time went back.
        rejected: how many inputs were refused, by :class:`RejectReason`.
        labels: the users' verdicts, by source robot and edge id.
        room: what was taken out of a full graph.
        data_times: by robot, the newest stamp of its odometry or keyframes; the robots' clocks need not agree.
        provisional: edges of the graph that are tied to the end of odometry until it goes on.
        given_up: ends of edges between keyframes by id that were refused for lack of room or time since the last
            request for them.
    """

    options: EstimatorOptions
    answer: GraphsAnswer
    pending: PendingEdges
    fingerprints: Fingerprints
    graph: GrowingViewGraph = field(default_factory=GrowingViewGraph)
    tracks: dict[str, OdometryTrack] = field(default_factory=dict)
    backward_jumps: BackwardJumps = field(default_factory=BackwardJumps)
    rejected: Counter[str] = field(default_factory=Counter)
    labels: dict[tuple[str, int], int] = field(default_factory=dict)
    room: Room = field(default_factory=Room)
    data_times: dict[str, DataTime] = field(default_factory=dict)
    provisional: ProvisionalEdges = field(default_factory=ProvisionalEdges)
    given_up: deque[tuple[KeyframeReference, KeyframeReference]] = field(
        default_factory=lambda: deque(maxlen=_MOST_GIVEN_UP)
    )

    @classmethod
    def begin(cls, options: EstimatorOptions, answer: GraphsAnswer) -> Growth:
        """An empty graph."""
        pending = PendingEdges(options.pending_capacity, options.pending_timeout_ns)
        return cls(options, answer, pending, Fingerprints(options.max_edges))

    def refuse(self, reason: RejectReason, count: int = 1) -> RejectReason:
        """Count refusals, or take them back; returns the reason."""
        self.rejected[reason.value] += count
        if self.rejected[reason.value] <= 0:
            del self.rejected[reason.value]
        return reason

    def give_up(self, edge: EdgeMeasurement, reason: RejectReason) -> RejectReason:
        """Refuse an edge that may be taken when it comes again; returns the reason."""
        if edge.source.keyframe_id is not None and edge.target.keyframe_id is not None:
            self.given_up.append((edge.source, edge.target))
        return self.refuse(reason)

    def has_room_for_keyframe(self) -> bool:
        """Whether one more may be added; if the graph is full, room is made first."""
        if self.graph.num_keyframes >= self.options.max_keyframes:
            self._make_room()
        return self.graph.num_keyframes < self.options.max_keyframes

    def has_room_for_edge(self) -> bool:
        """Whether one more may be added; if the graph is full, room is made first."""
        if self.graph.num_edges >= self.options.most_edges:
            self._make_room()
        return self.graph.num_edges < self.options.most_edges

    def _make_room(self) -> None:
        limits = self.options.max_keyframes, self.options.most_edges
        renumbering = self.room.make(self.graph, *limits, self.answer, self._gone_on_from())
        if renumbering is not None:
            self.provisional.renumber(renumbering)
            for robot, track in self.tracks.items():
                track.samples.release_keyframes(*self.graph.moments(robot))

    def _gone_on_from(self) -> list[int]:
        """Nodes that odometry's next keyframes will be tied to; edges may have named them long before odometry came."""
        last = ((robot, track.num_keyframes - 1) for robot, track in self.tracks.items() if track.last_keyframe)
        return [node for key in last if (node := self.graph.node(*key)) is not None]

    def time_line_of(self, robot: str, stamp_ns: int | None) -> int:
        """Number of the robot's time line that a stamp means, see :meth:`OdometrySamples.time_line_of`."""
        track = self.tracks.get(robot)
        return 0 if track is None or stamp_ns is None else track.time_line_of(stamp_ns)

    def is_undecided(self, robot: str) -> bool:
        """Whether it is unclear to which time line of a robot a stamp that comes now belongs."""
        track = self.tracks.get(robot)
        begins = track is not None and (track.begins_time_line or track.awaits_time_line)
        return begins or self.backward_jumps.is_undecided(robot)

    def now_ns(self, robot: str) -> int | None:
        """The data's time of a robot; None while it is not known."""
        return None if (time := self.data_times.get(robot)) is None else time.now_ns

    @property
    def newest_ns(self) -> int | None:
        """The data's time of the robot that is ahead; None while none is known."""
        known = (time.now_ns for time in self.data_times.values())
        return max((now_ns for now_ns in known if now_ns is not None), default=None)

    def advance_data_time(self, robot: str, stamp_ns: int) -> None:
        """Advance a robot's time and give up edges that have waited too long in it."""
        time = self.data_times.setdefault(robot, DataTime())
        now_ns = time.advance(stamp_ns, self.options.continuity_limits.lead_ns)
        if now_ns is not None:
            for edge in self.pending.pop_expired(robot, now_ns):
                self.give_up(edge, RejectReason.PENDING_TIMEOUT)

    def data_time_went_back(self, robot: str) -> None:
        """A robot's time begins again with its next stamp, and so do the timeouts that count in it."""
        self.data_times.setdefault(robot, DataTime()).go_back(None)
        self.pending.restart_timeouts(robot)

    def timed_by(self, edge: EdgeMeasurement, waits_for: KeyframeReference) -> str:
        """The robot in whose time an edge waits: that of the awaited end, or of the other while only that is known."""
        robots = waits_for.robot, edge.source.robot, edge.target.robot
        return next((robot for robot in robots if self.now_ns(robot) is not None), waits_for.robot)
