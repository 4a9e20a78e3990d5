"""An estimator's content: a growing graph, the last answer to it, and what ties the two to odometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rotavg_ros.online import quaternion
from rotavg_ros.online.answer.anchoring import anchor, corrections, first_correction
from rotavg_ros.online.answer.last_answer import LastAnswer
from rotavg_ros.online.answer.odometry_frame import OdometryFrame, first_frame, next_frame
from rotavg_ros.online.answer.problem import Problem
from rotavg_ros.online.answer.screening import Known
from rotavg_ros.online.graph.builder import GraphBuilder
from rotavg_ros.online.graph.growth import Growth
from rotavg_ros.online.measurements import KeyframeReference, OdometryMessage, RejectReason
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.stamps import NANOSECONDS


@dataclass(frozen=True)
class Counts:
    """How large the estimator's state is, and what was refused so far.

    Attributes:
        keyframes, edges, pending: present sizes.
        queued: closures in the graph that wait to be solved, see :mod:`~rotavg_ros.online.answer.closure_queue`.
        by_chance: how many of these the last answer explains, though it would explain as many random ones.
        rejected: number of refused inputs by :class:`RejectReason` value.
        time_jumps: how often the data's time went back.
        time_is_back: whether odometry has been refused since such a jump, and somebody has to decide.
        odometry_restarts: how often a robot's odometry began anew, or had to be treated as new.
        marginalized, dropped_closures: numbers of keyframes and closures removed from a full graph so far.
        is_full: whether nothing more can be spared, so that no new keyframes are added.
        is_full_of_edges: likewise, so that no new edges are added.
        robots: names of the robots that have keyframes.
        odometry_robots: names of the robots whose odometry has come.
        pending_by_robot: number of edges that wait for each robot.
        longest_pending: the end that the longest-waiting edge waits for; None if none waits.
        longest_pending_s: how long it has waited, seconds of its robot's data time.
    """

    keyframes: int
    edges: int
    pending: int
    rejected: dict[str, int]
    time_jumps: int = 0
    time_is_back: bool = False
    odometry_restarts: int = 0
    marginalized: int = 0
    dropped_closures: int = 0
    is_full: bool = False
    is_full_of_edges: bool = False
    robots: tuple[str, ...] = ()
    odometry_robots: tuple[str, ...] = ()
    pending_by_robot: Mapping[str, int] = field(default_factory=dict)
    longest_pending: KeyframeReference | None = None
    longest_pending_s: float = 0.0
    queued: int = 0
    by_chance: int = 0


@dataclass
class ContentState:
    """What a content consists of.

    Attributes:
        growth: the graph, and what is needed to grow it.
        last: the last answer; ``growth`` holds the same object.
        version: of the last answer.
        ticked_revision: the graph's revision when it was last solved.
        world_from_odometry: by robot: world_from_body = world_from_odometry ∘ odometry, as of its last corrected
            keyframe.
        memory: what the solver remembers of the last answer; a file keeps only the labels of it.
    """

    growth: Growth
    last: LastAnswer
    version: int = 0
    ticked_revision: int = 0
    world_from_odometry: dict[str, Quaternion] = field(default_factory=dict)
    memory: object | None = None

    @classmethod
    def begin(cls, options: EstimatorOptions, version: int = 0) -> ContentState:
        """An empty state, whose answers are numbered from the next version on."""
        last = LastAnswer()
        return cls(Growth.begin(options, last), last, version)


@dataclass(frozen=True)
class AcceptedAnswer:
    """The answer to a problem of N keyframes and M edges.

    Attributes:
        body_from_world, component, outlier: orientations ``(N, 4)``, components ``(N,)`` and flags ``(M,)``.
        revision: of the graph that they are about.
        was_cold: whether it was solved from scratch.
        memory: what the solver remembers of it.
        known: what is needed to judge closures that are not part of it.
    """

    body_from_world: Tensor
    component: Tensor
    outlier: NDArray[np.bool_]
    revision: int
    was_cold: bool
    memory: object | None
    known: Known


class Content:
    """Everything that is forgotten together, when a new content takes its place. Not thread-safe.

    The placement of the robots' odometry frames is not part of the state; it is known again after the next answer.

    Attributes:
        builder: the graph, and what is needed to grow it.
        state: everything that a file keeps.
        first_version: the version before this content's first answer.
    """

    def __init__(self, state: ContentState) -> None:
        self.state = state
        self.builder = GraphBuilder(state.growth)
        self.first_version = state.version
        self._frames: dict[str, OdometryFrame] = {}
        self._answered_revision = 0
        self._answer_was_cold = True
        self._remembered_revision = self.builder.graph.revision

    @property
    def version(self) -> int:
        """Version of the last answer."""
        return self.state.version

    @property
    def answered(self) -> Tensor | None:
        """body_from_world ``(n, 4)`` of the last answer, None before the first."""
        return self.state.last.body_from_world

    def add_odometry(self, message: OdometryMessage) -> tuple[RejectReason | None, list[OdometryMessage]]:
        """Take an odometry message; returns what :meth:`GraphBuilder.add_odometry` does."""
        robot = message.robot
        taken = self.builder.add_odometry(message)
        track = self.builder.tracks.get(robot)
        if track is not None and track.chain > len(track.anchors):
            before = self._frames.pop(robot, None)
            anchor(track, self.correction(robot))
            self.state.world_from_odometry.pop(robot, None)
            if before is not None and (frame := next_frame(before, track, self.correction(robot))) is not None:
                self._frames[robot] = frame
        elif taken[0] is None and (placed := self._frames.get(robot)) is not None:
            if placed.steps is not None and track is not None and track.latest is not None:
                placed.steps.go_on(track.latest)
        elif track is not None and robot not in self._frames and self.answered is None:
            frame = first_frame(track, self.correction(robot))
            self._frames |= {} if frame is None else {robot: frame}
        return taken

    def odometry_frame(self, robot: str) -> tuple[OdometryFrame, int] | None:
        """Where the robot's present odometry frame lies in the world, and for how many steps of odometry it has held.

        None while it is unknown.
        """
        frame = self._frames.get(robot)
        if frame is None:
            return None
        counted = self.builder.tracks[robot].num_keyframes - frame.keyframes_before
        return frame, (counted if frame.steps is None else frame.steps.count) + 1

    def take_frames(self, frames: Mapping[str, OdometryFrame]) -> None:
        """Take the odometry frames of robots that an answer has placed."""
        for robot, frame in frames.items():
            before = self._frames.get(robot)
            counted = None if before is None or before.chain != frame.chain else before.steps
            if counted is not None and frame.steps is not None and counted.moment == frame.steps.moment:
                # A later answer with the same newest keyframe does not make the way since then any shorter.
                frame = replace(frame, steps=counted)
            self._frames[robot] = frame

    def correction(self, robot: str) -> Quaternion:
        """world_from_odometry; before the robot's first answer, the one that makes its first odometry fit the gauge."""
        if robot in self.state.world_from_odometry:
            return self.state.world_from_odometry[robot]
        return first_correction(self.builder, robot)

    def current_orientation(self, robot: str) -> Quaternion | None:
        """world_from_body now: the robot's last corrected keyframe, then odometry. None before its first odometry."""
        track = self.builder.tracks.get(robot)
        if track is None or track.latest is None:
            return None
        return quaternion.normalize(quaternion.multiply(self.correction(robot), track.latest.world_from_body))

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to solve: no keyframe yet."""
        return self.builder.graph.num_keyframes == 0

    @property
    def is_behind(self) -> bool:
        """Whether the last answer does not cover the whole graph; False for an empty one."""
        has_changed = self.builder.graph.revision != self._answered_revision
        return not self.is_empty and (has_changed or len(self.state.last.queue) > 0)

    def solve_anew(self) -> None:
        """Let the next tick solve though the graph is the same."""
        self._answered_revision = -1
        self.state.memory = None

    def next_problem(self, force_cold: bool) -> Problem | None:
        """What is to be solved now; None if the last answer still stands."""
        state = self.state
        idle = self.builder.graph.revision == state.ticked_revision
        if idle or force_cold:
            self.builder.settle()
        if self.is_empty or (not self.is_behind and self._answer_was_cold):
            return None
        snapshot, last = self.builder.graph.snapshot(), state.last
        state.ticked_revision = snapshot.revision
        last.begin_problem()
        waited = len(last.queue)
        # In silence the answer becomes that of a solve from scratch; if the solver can, it works on it between ticks.
        is_last = idle and not waited
        may_go_on = self.builder.options.warm_start and self.state.memory is not None
        anew = is_last and not force_cold and may_go_on
        if anew and self.is_behind:  # the last tick failed: new data come first
            is_last = anew = False
        if force_cold or (is_last and not anew):
            last.queue.let_in_all(snapshot.graph)
        else:
            last.queue.let_in(snapshot.graph, last.known, last.outlier, idle=idle)
        cold = force_cold or (is_last and not anew) or not self.builder.options.warm_start
        answered = last.body_from_world, last.component, last.outlier
        remembered = self.state.memory, last.queue.order, last.queue.prior_log_odds
        return Problem(snapshot, cold, *answered, *remembered, anew, self._are_tied_anew)

    def accept(self, answer: AcceptedAnswer) -> None:
        """Make the answer to the last problem the last answer."""
        state = self.state
        state.last.replace(answer.body_from_world, answer.component, answer.outlier, answer.known)
        # After a compaction only the labels in the memory fit the graph; the solver notices.
        self._answered_revision, self._answer_was_cold = answer.revision, answer.was_cold
        self.remember(answer.memory, answer.revision)
        state.version += 1
        assert self.answered is not None
        state.world_from_odometry = corrections(self.builder, self.answered)

    @property
    def memory(self) -> object | None:
        """What the solver remembers of the last answer."""
        return self.state.memory

    def remember(self, memory: object | None, revision: int) -> None:
        """Keep the solver's memory of the graph at a revision."""
        self.state.memory, self._remembered_revision = memory, revision

    @property
    def _are_tied_anew(self) -> bool:
        """Whether edges that the solver remembers have been tied anew since, and their indices still hold."""
        graph = self.builder.graph
        return graph.tied_anew_at > self._remembered_revision >= graph.compacted_at

    def counts(self, time_jumps: int) -> Counts:
        """Present sizes and refusals."""
        growth = self.state.growth
        longest = growth.pending.longest(growth.now_ns)
        return Counts(
            keyframes=growth.graph.num_keyframes,
            edges=growth.graph.num_edges,
            pending=len(growth.pending),
            queued=len(self.state.last.queue),
            by_chance=self.state.last.queue.num_by_chance,
            rejected=dict(growth.rejected),
            time_jumps=time_jumps,
            time_is_back=growth.backward_jumps.is_back and growth.options.on_time_jump == "error",
            odometry_restarts=sum(track.chain for track in growth.tracks.values()),
            marginalized=growth.room.marginalized,
            dropped_closures=growth.room.dropped_closures,
            is_full=growth.room.is_full(growth.graph, growth.options.max_keyframes),
            is_full_of_edges=growth.room.is_full_of_edges(growth.graph, growth.options.most_edges),
            robots=tuple(growth.graph.robots),
            odometry_robots=tuple(growth.tracks),
            pending_by_robot=dict(growth.pending.by_robot),
            longest_pending=None if longest is None else longest[0],
            longest_pending_s=0.0 if longest is None else longest[1] / NANOSECONDS,
        )
