"""The online estimator: odometry and edges in, ticks, answers out. The node and the offline replay share it whole."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from rotavg_ros.online import quaternion, state_file
from rotavg_ros.online.anchoring import anchor, corrections, first_correction, root_orientations
from rotavg_ros.online.answer import Answer
from rotavg_ros.online.gauge import extend_along_edges, fix_gauge, joins_components
from rotavg_ros.online.graph_builder import GraphBuilder
from rotavg_ros.online.growing_view_graph import GraphSnapshot
from rotavg_ros.online.measurements import EdgeMeasurement, RejectReason
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.online.time_jumps import BackwardJumps, LateMessage
from rotavg_ros.online.trajectory import Trajectory, corrected_trajectories
from rotavg_ros.view_graph import EdgeLabel

if TYPE_CHECKING:
    from rotavg_ros.solver import Solution


# The signature of :func:`rotavg_ros.solve`.
Solver = Callable[..., "Solution"]


@dataclass(frozen=True)
class Counts:
    """How large the estimator's state is, and what was refused so far.

    Attributes:
        keyframes, edges, pending: sizes now.
        rejected: inputs refused, by :class:`RejectReason` value.
        time_jumps: how often the data's time went back.
        time_is_back: whether odometry is refused since such a jump, and somebody has to decide.
        odometry_restarts: how often the odometry of one of the robots began anew.
    """

    keyframes: int
    edges: int
    pending: int
    rejected: dict[str, int]
    time_jumps: int = 0
    time_is_back: bool = False
    odometry_restarts: int = 0


class OnlineEstimator:
    """Thread-safe: inputs may come while another thread solves; they wait for microseconds only.

    A tick solves from the previous answer while data flows (warm), and once more from scratch (cold) when the graph
    has not changed since the tick before. So the last answer before silence is what ``rotavg solve`` says of the
    same graph, and nothing is computed after it until something changes.
    """

    def __init__(self, options: EstimatorOptions | None = None, solver: Solver | None = None) -> None:
        """Start empty.

        Args:
            options: default: the defaults.
            solver: default: :func:`rotavg_ros.solve`.
        """
        self.options = options or EstimatorOptions()
        self._solver = solver or _default_solver()
        self._lock = threading.Lock()
        self._tick_lock = threading.Lock()  # one tick at a time; taken before ``_lock``
        self._paused = False
        self._generation = 0
        self._time_jumps = 0
        self._start_over(GraphBuilder(self.options), None, 0)

    def _start_over(self, builder: GraphBuilder, answered: Tensor | None, version: int) -> None:
        """Begin with this content; ``answered`` is the last answer's body_from_world ``(n, 4)``."""
        self._generation += 1
        self._first_version = version
        self._builder = builder
        self._backward_jumps = BackwardJumps()
        self._answered = answered
        self._answered_component: Tensor | None = None
        self._answered_revision = 0
        self._answer_was_cold = True
        self._ticked_revision = 0
        self._version = version
        # Per robot: world_from_body = world_from_odometry ∘ odometry, as of its last corrected keyframe.
        self._world_from_odometry: dict[str, Quaternion] = {}

    def add_odometry(
        self,
        robot: str,
        stamp_ns: int,
        world_from_body: Sequence[float],
        position: Sequence[float] | None = None,
    ) -> RejectReason | None:
        """Take an odometry message.

        Args:
            robot: whose.
            stamp_ns: nanoseconds, ascending per robot. One far ahead is believed only when the next agrees.
            world_from_body: xyzw, the body in the odometry's frame.
            position: metres, for the keyframes' distance criterion.

        Odometry that begins anew begins a new component, first where the robot was last. When its stamps have gone
        back for several messages in a row, the options say what becomes of it.

        Returns:
            why it was refused and counted; None if it was taken.
        """
        with self._lock:
            track = self._builder.tracks.get(robot)
            last = None if track is None else track.latest
            reason = self._builder.add_odometry(robot, stamp_ns, world_from_body, position)
            if track is not None and last is not None and track.chain > len(track.anchors):
                anchor(track, last, self._correction(robot))
                self._world_from_odometry.pop(robot, None)
            if reason is None:
                self._backward_jumps.on_time(robot)
            elif reason is RejectReason.OUT_OF_ORDER_ODOMETRY and last is not None:
                message = LateMessage(robot, stamp_ns, world_from_body, position)
                return self._consider_jump(message, last.stamp_ns, reason)
            return reason

    def _consider_jump(self, message: LateMessage, latest_ns: int, reason: RejectReason) -> RejectReason | None:
        """What becomes of an odometry message that came out of order."""
        longest_step_ns = self.options.odometry_bounds.max_gap_ns
        since_jump = self._backward_jumps.late(message, latest_ns, self.options.time_jump_ns, longest_step_ns)
        if not since_jump:
            return reason
        self._time_jumps += 1
        if self.options.on_time_jump != "reset":
            return reason
        self._start_over(GraphBuilder(self.options), None, self._version)
        for late in since_jump:
            self._builder.add_odometry(late.robot, late.stamp_ns, late.world_from_body, late.position)
        return None

    def clock_went_back(self, now_ns: int) -> None:
        """The clock that stamps the data (``/clock``) went back to ``now_ns``; taken as if odometry had told it."""
        with self._lock:
            data_time_ns = self._builder.data_time_ns
            if data_time_ns is None or data_time_ns - now_ns <= self.options.time_jump_ns:
                return  # nothing of the future is known, or odometry has told it already
            if self.options.on_time_jump == "reset":
                self._time_jumps += 1
                self._start_over(GraphBuilder(self.options), None, self._version)

    def add_edge(self, edge: EdgeMeasurement) -> RejectReason | None:
        """Take a measured edge; returns why it was refused and counted, None if it was taken or may wait."""
        with self._lock:
            return self._builder.add_edge(edge)

    def reject(self, reason: RejectReason) -> None:
        """Count an input that could not even be read as a measurement."""
        with self._lock:
            self._builder.rejected[reason.value] += 1

    def label_edge(self, source_robot: str, edge_id: int, label: EdgeLabel) -> int:
        """Accept or reject for good every edge with a sender's id, or hand it back; returns how many there are."""
        with self._lock:
            return self._builder.label_edge(source_robot, edge_id, label)

    def current_orientation(self, robot: str) -> Quaternion | None:
        """world_from_body now: the robot's last corrected keyframe, then odometry. None before its first odometry."""
        with self._lock:
            track = self._builder.tracks.get(robot)
            if track is None or track.latest is None:
                return None
            return quaternion.normalize(quaternion.multiply(self._correction(robot), track.latest.world_from_body))

    def world_from_odometry(self, robot: str) -> Quaternion | None:
        """The correction of a robot's odometry frame (map from odom); None before its first odometry."""
        with self._lock:
            return self._correction(robot) if robot in self._builder.tracks else None

    def counts(self) -> Counts:
        """Sizes and refusals now."""
        with self._lock:
            builder = self._builder
            return Counts(
                keyframes=builder.graph.num_keyframes,
                edges=builder.graph.num_edges,
                pending=len(builder.pending),
                rejected=dict(builder.rejected),
                time_jumps=self._time_jumps,
                time_is_back=self._backward_jumps.is_back and self.options.on_time_jump == "error",
                odometry_restarts=sum(track.chain for track in builder.tracks.values()),
            )

    def set_options(self, options: EstimatorOptions) -> None:
        """Change the options; what was built so far stays, and the next tick solves anew."""
        with self._lock:
            self.options = options
            self._builder.set_options(options)
            self._answered_revision = -1

    def trajectories(self, answer: Answer) -> dict[str, Trajectory]:
        """Poses of every robot's keyframes in the answer that have a stamp, see :func:`corrected_trajectories`."""
        with self._lock:
            translation = self._builder.graph.snapshot().translation[: len(answer.source)]
            tracks = dict(self._builder.tracks)
        if len(translation) < len(answer.source):
            return {}  # the answer is about a graph that was reset since
        return corrected_trajectories(answer, translation, tracks)

    def snapshot(self) -> GraphSnapshot:
        """The graph now; a later one begins with the same keyframes and edges."""
        with self._lock:
            return self._builder.graph.snapshot()

    @property
    def revision(self) -> int:
        """Counts the graph's changes."""
        with self._lock:
            return self._builder.graph.revision

    @property
    def generation(self) -> int:
        """Counts how often everything was forgotten or replaced: what was sent before may be news again."""
        return self._generation

    @property
    def time_jumps(self) -> int:
        """Counts how often the data's time went back."""
        return self._time_jumps

    @property
    def first_version(self) -> int:
        """Answers up to this version are of what was forgotten or replaced since."""
        return self._first_version

    @property
    def is_behind(self) -> bool:
        """Whether the graph has changed since the last answer."""
        with self._lock:
            return self._builder.graph.revision != self._answered_revision

    @property
    def paused(self) -> bool:
        return self._paused

    def pause(self, paused: bool) -> None:
        """While paused, inputs are taken as ever but ticks do nothing (a forced one does)."""
        self._paused = paused

    def reset(self) -> None:
        """Forget everything, counters included. Answers go on counting up; a running tick is thrown away."""
        with self._lock:
            self._start_over(GraphBuilder(self.options), None, self._version)

    def save(self, path: Path) -> None:
        """Write everything into one file, whole or not at all.

        Raises:
            StateFileError: the file cannot be written.
        """
        with self._lock:
            state = state_file.collect(self._builder, self._answered, self._version)
        state_file.write(path, state.encoded())

    def load(self, path: Path) -> None:
        """Replace everything by a file's content.

        Raises:
            StateFileError: not a state file, or not a whole one. The old state is kept.
        """
        builder, answered, version = state_file.restore(state_file.read(path), self.options)
        with self._lock:
            self._start_over(builder, answered, max(version, self._version))
            if answered is not None:
                self._world_from_odometry = corrections(builder, answered)

    def tick(self, force_cold: bool = False) -> Answer | None:
        """Solve, if there is anything new.

        Args:
            force_cold: from scratch, and even while paused.

        Returns:
            the new answer; None if the last one still stands.

        Raises:
            UserError: from the solver; the next tick tries again.
        """
        with self._tick_lock:
            started = time.perf_counter()
            with self._lock:
                if self._paused and not force_cold:
                    return None
                builder, answered, answered_component = self._builder, self._answered, self._answered_component
                idle = builder.graph.revision == self._ticked_revision
                if idle or force_cold:
                    builder.settle()
                unchanged = builder.graph.revision == self._answered_revision
                if unchanged and self._answer_was_cold:
                    return None
                snapshot = builder.graph.snapshot()
                self._ticked_revision = snapshot.revision
            cold = force_cold or idle or answered is None or not self.options.warm_start
            warm_start = None
            if not cold and answered is not None:
                joined = answered_component is None or joins_components(answered_component, snapshot.graph.components())
                warm_start = None if joined else extend_along_edges(answered, snapshot.graph)
                cold = joined
            solution = self._solver(
                snapshot.graph,
                method=self.options.method,
                profile=self.options.profile,
                device=self.options.device,
                refinement_steps=self.options.refinement_steps,
                warm_start=warm_start,
            )
            component = solution.component.cpu()
            with self._lock:
                roots = root_orientations(builder, component, answered)
            body_from_world = fix_gauge(solution.body_from_world.cpu(), component, roots)
            with self._lock:
                if builder is not self._builder:
                    return None  # reset or loaded meanwhile
                self._answered, self._answered_component = body_from_world, component
                self._answered_revision, self._answer_was_cold = snapshot.revision, cold
                self._version += 1
                version = self._version
                self._world_from_odometry = corrections(self._builder, body_from_world)
            seconds = time.perf_counter() - started
            return Answer.of_solution(
                snapshot, solution, body_from_world, component, self.options.outlier_threshold, version, cold, seconds
            )

    def _correction(self, robot: str) -> Quaternion:
        """world_from_odometry; before the robot's first answer, what makes its first odometry fit the gauge."""
        if robot in self._world_from_odometry:
            return self._world_from_odometry[robot]
        return first_correction(self._builder, robot)


def _default_solver() -> Solver:
    from rotavg_ros.solver import solve  # loads the networks: not before somebody solves

    return solve
