"""What an estimator knows at a time: a growing graph, the last answer to it, and what ties the two to odometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rotavg_ros.online import quaternion
from rotavg_ros.online.anchoring import anchor, corrections, first_correction
from rotavg_ros.online.graph_builder import GraphBuilder
from rotavg_ros.online.measurements import KeyframeReference, RejectReason
from rotavg_ros.online.options import NANOSECONDS
from rotavg_ros.online.problem import Problem
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.online.renumbering import Renumbering
from rotavg_ros.online.time_jumps import BackwardJumps, LateMessage


@dataclass(frozen=True)
class Counts:
    """How large the estimator's state is, and what was refused so far.

    Attributes:
        keyframes, edges, pending: sizes now.
        rejected: inputs refused, by :class:`RejectReason` value.
        time_jumps: how often the data's time went back.
        time_is_back: whether odometry is refused since such a jump, and somebody has to decide.
        odometry_restarts: how often the odometry of one of the robots began anew.
        marginalized, dropped_closures: how many keyframes and closures a full graph has done without so far.
        is_full: whether nothing more can be spared, and there are no new keyframes.
        robots: that have keyframes.
        pending_by_robot: how many edges wait for each robot.
        longest_pending: the end that the edge waits for that has waited the longest; None if none waits.
        longest_pending_s: how long it has, seconds of the data's time.
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
    robots: tuple[str, ...] = ()
    pending_by_robot: Mapping[str, int] = field(default_factory=dict)
    longest_pending: KeyframeReference | None = None
    longest_pending_s: float = 0.0


class Content:
    """All of it is forgotten together, by a new one in its place. Not thread-safe.

    Attributes:
        builder: the graph, and what is needed to grow it.
        answered: body_from_world ``(n, 4)`` of the last answer, None before the first.
        first_version, version: of the answers, before the first and of the last.
    """

    def __init__(self, builder: GraphBuilder, answered: Tensor | None, version: int) -> None:
        self.builder = builder
        self.answered = answered
        self.first_version = self.version = version
        self._answered_component: Tensor | None = None
        self._memory: object | None = None
        self._answered_revision = 0
        self._answer_was_cold = True
        self._ticked_revision = 0
        self._backward_jumps = BackwardJumps()
        self._renumbering: Renumbering | None = None  # since the last problem
        builder.on_compaction = self._renumber
        # Per robot: world_from_body = world_from_odometry ∘ odometry, as of its last corrected keyframe.
        self._world_from_odometry: dict[str, Quaternion] = {}
        if answered is not None:
            self._world_from_odometry = corrections(builder, answered)

    def add_odometry(self, message: LateMessage) -> tuple[RejectReason | None, list[LateMessage]]:
        """Take an odometry message.

        Returns:
            why it was refused and counted, None if it was taken; and the messages since time went back, if this one
            shows that it has.
        """
        builder, robot = self.builder, message.robot
        track = builder.tracks.get(robot)
        last = None if track is None else track.latest
        reason = builder.add_odometry(robot, message.stamp_ns, message.world_from_body, message.position)
        if track is not None and last is not None and track.chain > len(track.anchors):
            anchor(track, last, self.correction(robot))
            self._world_from_odometry.pop(robot, None)
        if reason is None:
            self._backward_jumps.on_time(robot)
        elif reason is RejectReason.OUT_OF_ORDER_ODOMETRY and last is not None:
            options = builder.options
            longest_step_ns = options.odometry_bounds.max_gap_ns
            return reason, self._backward_jumps.late(message, last.stamp_ns, options.time_jump_ns, longest_step_ns)
        return reason, []

    def correction(self, robot: str) -> Quaternion:
        """world_from_odometry; before the robot's first answer, what makes its first odometry fit the gauge."""
        if robot in self._world_from_odometry:
            return self._world_from_odometry[robot]
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
        """Whether the graph has changed since the last answer; an empty one has no answer to wait for."""
        return not self.is_empty and self.builder.graph.revision != self._answered_revision

    def solve_anew(self) -> None:
        """Let the next tick solve though the graph is the same."""
        self._answered_revision = -1
        self._memory = None

    def next_problem(self, force_cold: bool) -> Problem | None:
        """What is to be solved now; None if the last answer still stands."""
        idle = self.builder.graph.revision == self._ticked_revision
        if idle or force_cold:
            self.builder.settle()
        if self.is_empty or (not self.is_behind and self._answer_was_cold):
            return None
        snapshot = self.builder.graph.snapshot()
        self._ticked_revision = snapshot.revision
        self._renumbering = None
        cold = force_cold or idle or not self.builder.options.warm_start
        return Problem(snapshot, cold, self.answered, self._answered_component, self.builder.outlier, self._memory)

    def accept(
        self,
        body_from_world: Tensor,
        component: Tensor,
        outlier: NDArray[np.bool_],
        revision: int,
        was_cold: bool,
        memory: object | None,
    ) -> None:
        """Make the answer to the last problem the last answer.

        Args:
            body_from_world, component, outlier: orientations ``(N, 4)``, components ``(N,)`` and flags ``(M,)``.
            revision: of the graph that they are about.
            was_cold: solved from scratch.
            memory: what the solver remembers of it; after a renumbering it fits no graph, and the solver sees that.
        """
        self.answered, self._answered_component, self.builder.outlier = body_from_world, component, outlier
        if self._renumbering is not None:
            self._renumber_answer(self._renumbering)
        self._answered_revision, self._answer_was_cold, self._memory = revision, was_cold, memory
        self.version += 1
        self._world_from_odometry = corrections(self.builder, self.answered)

    def _renumber(self, renumbering: Renumbering) -> None:
        """Follow the builder, which has renumbered its own flags."""
        earlier = self._renumbering
        self._renumbering = renumbering if earlier is None else earlier.then(renumbering)
        if self.answered is not None:
            self.answered = renumbering.nodes(self.answered)
        if self._answered_component is not None:
            self._answered_component = renumbering.nodes(self._answered_component)

    def _renumber_answer(self, renumbering: Renumbering) -> None:
        """Bring an answer about the graph of the last problem into the present numbers."""
        assert self.answered is not None and self._answered_component is not None
        self.answered = renumbering.nodes(self.answered)
        self._answered_component = renumbering.nodes(self._answered_component)
        self.builder.outlier = renumbering.flags(self.builder.outlier)

    def counts(self, time_jumps: int) -> Counts:
        """Sizes and refusals now."""
        builder = self.builder
        longest = builder.pending.longest(builder.data_time_ns)
        return Counts(
            keyframes=builder.graph.num_keyframes,
            edges=builder.graph.num_edges,
            pending=len(builder.pending),
            rejected=dict(builder.rejected),
            time_jumps=time_jumps,
            time_is_back=self._backward_jumps.is_back and builder.options.on_time_jump == "error",
            odometry_restarts=sum(track.chain for track in builder.tracks.values()),
            marginalized=builder.marginalized,
            dropped_closures=builder.dropped_closures,
            is_full=builder.is_full,
            robots=tuple(builder.graph.robots),
            pending_by_robot=dict(builder.pending.by_robot),
            longest_pending=None if longest is None else longest[0],
            longest_pending_s=0.0 if longest is None else longest[1] / NANOSECONDS,
        )
