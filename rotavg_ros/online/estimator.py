"""The online estimator: odometry and edges in, ticks, answers out. The node and the offline replay share all of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rotavg_ros.online import free_memory
from rotavg_ros.online.answer.anchoring import root_orientations
from rotavg_ros.online.answer.answer import Answer
from rotavg_ros.online.answer.gauge import fix_gauge
from rotavg_ros.online.answer.odometry_frame import OdometryFrame, placed_frames
from rotavg_ros.online.answer.trajectory import Trajectory, corrected_trajectories
from rotavg_ros.online.content import AcceptedAnswer, Content, ContentState, Counts
from rotavg_ros.online.graph.snapshot import GraphSnapshot
from rotavg_ros.online.measurements import (
    MAX_ID,
    EdgeMeasurement,
    KeyframeReference,
    OdometryMessage,
    RejectReason,
    plain_number,
    plain_numbers,
)
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.online.state import content as state_content
from rotavg_ros.online.state import file as state_file
from rotavg_ros.online.state.discarded import Discarded
from rotavg_ros.solver import Abandoned, abandonable
from rotavg_ros.view_graph import EdgeLabel, ViewGraph, ViewGraphError

if TYPE_CHECKING:
    from rotavg_ros.solver import Solution

# The signature of :func:`rotavg_ros.solve`.
Solver = Callable[..., "Solution"]

# The signature of :func:`rotavg_ros.solver.advance`.
Advance = Callable[[object | None, float], float]

# Units of work that a tick has before its answer, 15 ms, and after it, .1 s (see the solver's SECONDS_PER_UNIT). From
# docs/diary/ticks.md, "Answers first": with 10 to 100 units before it, answers err alike; 95 % take at most .11 s with
# 100, .02 s with fewer. The work after it decides how soon a whole search ends, and does not affect the last answer.
TICK_WORK, WORK_AFTER = 30.0, 200.0


class TickAbandonedError(Exception):
    """A tick was abandoned, since its answer is no longer wanted; the message says why."""


class _Tick:
    """A tick that is running.

    Attributes:
        is_forced: somebody has asked for its answer.
        abandoned_by: what made its answer worthless; None as long as it is wanted.
    """

    def __init__(self, is_forced: bool) -> None:
        self.is_forced = is_forced
        self.abandoned_by: str | None = None

    def is_abandoned(self) -> bool:
        return self.abandoned_by is not None


class OnlineEstimator:
    """Thread-safe: inputs may come while another thread solves; they wait for microseconds.

    Only when a full graph is compacted do they wait some tenths of a second, at 200 000 keyframes once in 20 000.

    A tick solves from the previous answer while data flows (warm), and once more from scratch (cold) when the graph
    has not changed since the tick before. So the last answer before silence is what ``rotavg solve`` says of the
    same graph, and nothing is computed after it until something changes.
    """

    def __init__(
        self,
        options: EstimatorOptions | None = None,
        solver: Solver | None = None,
        on_discard: Callable[[Discarded], None] | None = None,
        advance: Advance | None = None,
    ) -> None:
        """Start empty.

        Args:
            options: default: the defaults.
            solver: default: :func:`rotavg_ros.solve`.
            on_discard: called with every graph that is forgotten (:meth:`reset`, time that goes back) or replaced
                (:meth:`load`), unless it is empty. It runs within these methods, so it must be quick.
            advance: default: :func:`rotavg_ros.solver.advance` with the default solver, nothing with another.
        """
        self.options = options or EstimatorOptions()
        self._solver, self._advance = (solver, advance) if solver else _default_solver()
        self._lock = threading.Lock()
        self._tick_lock = threading.Lock()  # one tick at a time; taken before ``_lock``
        self._paused = False
        self._running: _Tick | None = None
        self._after_work = free_memory.AfterWork()
        self._generation = 0
        self._time_jumps = 0
        self._on_discard = on_discard
        self._content = Content(ContentState.begin(self.options))

    def _start_over(self, state: ContentState) -> None:
        """Begin with this content; the one before is handed to ``on_discard`` unless it is empty."""
        discarded = Discarded(self._content.state)
        self._generation += 1
        self._content = Content(state)
        self._content.builder.set_options(self.options)  # they may have changed while a file was read
        self._abandon_tick("everything was forgotten or replaced meanwhile")
        if self._on_discard is not None and discarded.num_keyframes:
            self._on_discard(discarded)

    def _abandon_tick(self, why: str) -> None:
        """Make the running tick, if there is one, end soon and change nothing."""
        if self._running is not None:
            self._running.abandoned_by = why

    def add_odometry(
        self,
        robot: str,
        stamp_ns: int,
        world_from_body: Sequence[float],
        position: Sequence[float] | None = None,
    ) -> RejectReason | None:
        """Take an odometry message.

        Args:
            robot: name of the robot.
            stamp_ns: nanoseconds, ascending per robot. A stamp far ahead is believed only if the next one agrees.
            world_from_body: xyzw, the body in the odometry's frame.
            position: metres, for the keyframes' distance criterion.

        Odometry that begins anew begins a new component, placed at first where the robot was last. When its stamps have
        gone back for several messages in a row, the options decide what happens.

        Returns:
            why it was refused and counted; None if it was taken.
        """
        turn, place = plain_numbers(world_from_body), plain_numbers(position)
        message = OdometryMessage(robot, plain_number(stamp_ns), turn or (), place)
        with self._lock:
            reason, since_jump = self._content.add_odometry(message)
            if not since_jump:
                return reason
            self._time_jumps += 1
            if self.options.on_time_jump == "new_component":
                self._content.builder.begin_time_line(robot, len(since_jump))
            elif self.options.on_time_jump == "reset":
                self._forget()
            else:
                return reason
            return [self._content.add_odometry(message)[0] for message in since_jump][-1]

    def clock_went_back(self, now_ns: int) -> None:
        """The clock that stamps the data (``/clock``) went back to ``now_ns``; treated as if odometry had shown it."""
        with self._lock:
            data_time_ns = self._content.state.growth.data_time.now_ns
            if data_time_ns is None or data_time_ns - now_ns <= self.options.time_jump_ns:
                return  # no data from after it are known, or odometry has shown the jump already
            if self.options.on_time_jump == "reset":
                self._time_jumps += 1
                self._forget()
            elif self.options.on_time_jump == "new_component":
                self._time_jumps += self._content.builder.clock_went_back(now_ns)

    def add_edge(self, edge: EdgeMeasurement, generation: int | None = None) -> RejectReason | None:
        """Take a measured edge.

        Args:
            edge: the edge.
            generation: of the graph that it is meant for, see :attr:`generation`; any other graph is left unchanged.

        Returns:
            why it was refused and counted; None if it was taken, may wait, or is meant for another graph.
        """
        with self._lock:
            if generation not in (None, self._generation):
                return None
            return self._content.builder.add_edge(edge)

    def pop_given_up(self) -> list[tuple[KeyframeReference, KeyframeReference]]:
        """Source and target of edges by id that were refused for lack of room or time since the last call.

        They are counted as ``graph_full``, ``pending_overflow`` or ``pending_timeout``, and may be taken when their
        sender repeats them. If there are very many, only the latest are returned.
        """
        with self._lock:
            given_up = list(self._content.state.growth.given_up)
            self._content.state.growth.given_up.clear()
            return given_up

    def reject(self, reason: RejectReason) -> None:
        """Count an input that could not even be read as a measurement."""
        with self._lock:
            self._content.state.growth.refuse(reason)

    def label_edge(self, source_robot: str, edge_id: int, label: EdgeLabel) -> int:
        """Accept or reject for good every edge with a sender's id, or hand it back; returns how many there are.

        Raises:
            ViewGraphError: not an :class:`EdgeLabel`; a file with such a label could never be loaded.
        """
        edge_id = plain_number(edge_id)
        try:
            label = EdgeLabel(label)
        except ValueError:
            raise ViewGraphError(f"label {label!r}; 0 is automatic, 1 accepted, 2 rejected") from None
        if not 0 <= edge_id <= MAX_ID:
            return 0
        with self._lock:
            return self._content.builder.label_edge(source_robot, edge_id, label)

    def current_orientation(self, robot: str) -> Quaternion | None:
        """world_from_body now: the robot's last corrected keyframe, then odometry. None before its first odometry."""
        with self._lock:
            return self._content.current_orientation(robot)

    def world_from_odometry(self, robot: str) -> Quaternion | None:
        """The correction of a robot's odometry frame (map from odom); None before its first odometry."""
        with self._lock:
            return self._content.correction(robot) if robot in self._content.builder.tracks else None

    def counts(self) -> Counts:
        """Present sizes and refusals."""
        with self._lock:
            return self._content.counts(self._time_jumps)

    def set_options(self, options: EstimatorOptions) -> None:
        """Change the options; what was built so far stays, and the next tick solves anew."""
        with self._lock:
            self.options = options
            self._content.builder.set_options(options)
            self._content.solve_anew()

    def trajectories(self, answer: Answer) -> dict[str, Trajectory]:
        """Poses of every robot's keyframes in the answer that have a stamp, see :func:`corrected_trajectories`."""
        with self._lock:
            samples = {robot: track.samples.frozen() for robot, track in self._content.builder.tracks.items()}
        return corrected_trajectories(answer, samples)

    def place(self, answer: Answer) -> dict[str, Trajectory]:
        """The same; from now on :meth:`odometry_frame` uses them, unless the answer is about a forgotten graph."""
        trajectories = self.trajectories(answer)
        with self._lock:
            if answer.version > self._content.first_version:
                self._content.take_frames(placed_frames(answer, trajectories, self._content.builder))
        return trajectories

    def odometry_frame(self, robot: str) -> tuple[OdometryFrame, int] | None:
        """Where a robot's odometry frame lies in the world, by the last answer that was placed.

        The number counts odometry's steps since the frame's keyframe, including the unfinished one.

        Before the first answer odometry's own poses are used, and odometry that begins anew continues where the robot
        was. None before odometry with positions, and after a load until an answer has been placed.
        """
        with self._lock:
            return self._content.odometry_frame(robot)

    def snapshot(self) -> GraphSnapshot:
        """The graph now. Until keyframes are marginalised a later one begins with the same keyframes and edges."""
        with self._lock:
            return self._content.builder.graph.snapshot()

    @property
    def revision(self) -> int:
        """Counts the graph's changes."""
        with self._lock:
            return self._content.builder.graph.revision

    @property
    def generation(self) -> int:
        """Counts how often everything was forgotten or replaced; what was sent before may then be new again."""
        return self._generation

    @property
    def time_jumps(self) -> int:
        """Counts how often the data's time went back."""
        return self._time_jumps

    @property
    def first_version(self) -> int:
        """Answers up to this version are about a graph that has been forgotten or replaced since."""
        return self._content.first_version

    @property
    def is_behind(self) -> bool:
        """Whether the graph has changed since the last answer, or closures of it wait to be solved."""
        with self._lock:
            return self._content.is_behind

    @property
    def paused(self) -> bool:
        return self._paused

    def pause(self, paused: bool) -> None:
        """While paused, inputs are taken as usual but ticks do nothing and a running one is given up, unless forced."""
        with self._lock:
            self._paused = paused
            if paused and self._running is not None and not self._running.is_forced:
                self._abandon_tick("paused meanwhile")

    def reset(self) -> None:
        """Forget everything, counters included. Answers go on counting up; a running tick is thrown away."""
        with self._lock:
            self._forget()

    def _forget(self) -> None:
        self._start_over(ContentState.begin(self.options, self._content.version))

    def save(self, path: Path) -> None:
        """Write everything into one file, whole or not at all.

        Raises:
            StateFileError: the file cannot be written.
        """
        with self._lock:
            state = state_content.collect(self._content.state)
        state_file.write(path, state.encoded())

    def load(self, path: Path) -> None:
        """Replace everything by a file's content.

        Raises:
            StateFileError: not a state file, or not a whole one. The old state is kept.
        """
        state = state_content.restore(state_file.read(path), self.options)
        with self._lock:
            state.version = max(state.version, self._content.version)
            self._start_over(state)

    def tick(self, force_cold: bool = False, work: float = TICK_WORK) -> Answer | None:
        """Solve, if there is anything new.

        Args:
            force_cold: solve from scratch, even while paused.
            work: units of work that the solver may spend, see :data:`TICK_WORK`. If it needs more, new data are fitted
                to the known solution, and :meth:`go_on` does the rest. The limit does not apply to a forced solve from
                scratch, nor to the first solve.

        Returns:
            the new answer; None if the last one still stands.

        Raises:
            UserError: from the solver; the next tick tries again.
            TickAbandonedError: everything was forgotten or replaced meanwhile, or ticks were paused.
        """
        with self._tick_lock:
            started = time.perf_counter()
            answer = self._tick(force_cold, work)
            if answer is None:
                return None
            free_memory.give_back_after(len(answer.source), answer.stage_seconds)
            return replace(answer, seconds=time.perf_counter() - started)

    def go_on(self, work: float = WORK_AFTER) -> float:
        """After a tick, continue with the work that it has left; the next tick uses the result.

        Args:
            work: units of work that the solver may spend, see :data:`WORK_AFTER`; up to one factorisation more.

        Returns:
            the units of work that it has spent.

        Raises:
            UserError, TickAbandonedError: as :meth:`tick`.
        """
        if self._advance is None:
            return 0.0
        with self._tick_lock:
            with self._lock:
                if self._paused:
                    return 0.0
                memory, running = self._content.memory, _Tick(False)
                self._running = running
            try:
                with abandonable(running.is_abandoned):
                    spent = self._advance(memory, work)
            except Abandoned:
                raise TickAbandonedError(f"abandoned: {running.abandoned_by}") from None
            self._after_work.spent(spent)
            return spent

    def _tick(self, force_cold: bool, work: float) -> Answer | None:
        with self._lock:
            content, options = self._content, self.options
            problem = None if self._paused and not force_cold else content.next_problem(force_cold)
            running = self._running = _Tick(force_cold)
        if problem is None:
            return None
        snapshot, warm_start = problem.snapshot, problem.warm_start()
        try:
            with abandonable(running.is_abandoned):
                solution = self._solver(
                    _solved_graph(problem.graph, options),
                    **options.for_solver,
                    warm_start=warm_start,
                    memory=None if warm_start is None else problem.goes_on_from,
                    work=work,
                    anew=problem.anew,
                )
        except Abandoned:
            raise TickAbandonedError(f"abandoned: {running.abandoned_by}") from None
        if problem.anew and not solution.is_anew:
            with self._lock:  # nothing but the solver's memory has changed
                if options is self.options:
                    content.remember(solution.memory)
            return None
        component = solution.component.cpu()
        known = problem.known(solution, options.outlier_threshold)
        with self._lock:
            roots = root_orientations(content.builder, snapshot, component, problem.answered)
        body_from_world = fix_gauge(solution.body_from_world.cpu(), component, roots)
        was_cold = warm_start is None or (problem.anew and solution.is_anew)
        answer = Answer.of_solution(
            snapshot,
            problem.of_all_edges(solution, known),
            body_from_world,
            problem.thresholds(options.outlier_threshold, was_cold),
            content.version + 1,
            was_cold,
        )
        answer = replace(answer, waits=problem.waits)
        with self._lock:
            if content is not self._content:  # the solve ended before it noticed that it was abandoned
                raise TickAbandonedError(f"abandoned: {running.abandoned_by}")
            revision, memory = snapshot.revision, solution.memory
            content.accept(
                AcceptedAnswer(body_from_world, component, answer.outlier, revision, was_cold, memory, known)
            )
            if options is not self.options:
                content.solve_anew()
        return answer


def _default_solver() -> tuple[Solver, Advance]:
    from rotavg_ros.solver import advance, solve  # loads the networks: not before somebody solves

    return solve, advance


def _solved_graph(graph: ViewGraph, options: EstimatorOptions) -> ViewGraph:
    """The graph without translations unless they are in metres."""
    return replace(graph, translation=None) if options.translation_scale == "none" else graph
