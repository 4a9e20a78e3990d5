"""The online estimator: odometry and edges in, ticks, answers out. The node and the offline replay share all of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.answer.answer import Answer
from rotavg_ros.online.answer.closure_filter import closure_keys
from rotavg_ros.online.answer.odometry_frame import OdometryFrame, placed_frames
from rotavg_ros.online.answer.trajectory import Trajectory, corrected_trajectories
from rotavg_ros.online.content import Content, Counts
from rotavg_ros.online.current_content import CurrentContent
from rotavg_ros.online.graph.snapshot import GraphSnapshot
from rotavg_ros.online.measurements import (
    MAX_ID,
    EdgeMeasurement,
    KeyframeReference,
    OdometryMessage,
    RejectReason,
    plain_numbers,
    whole_nanoseconds,
    whole_number,
)
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.online.quaternion import IDENTITY, Quaternion
from rotavg_ros.online.state import content as state_content
from rotavg_ros.online.state import file as state_file
from rotavg_ros.online.state.discarded import Discarded
from rotavg_ros.online.ticks import TICK_WORK, WORK_AFTER, Advance, Solver, Ticks
from rotavg_ros.view_graph import EdgeLabel, ViewGraphError


class OnlineEstimator:
    """Thread-safe: inputs may come while another thread solves; they wait for microseconds.

    Only when a full graph is compacted do they wait some tenths of a second, at 200 000 keyframes once in 20 000.
    :mod:`~rotavg_ros.online.current_content` says which lock guards what.

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
        self._current = CurrentContent(options or EstimatorOptions(), on_discard)
        self._lock = self._current.lock
        self._ticks = Ticks(self._current, solver, advance)

    @property
    def _content(self) -> Content:
        return self._current.content

    @property
    def options(self) -> EstimatorOptions:
        return self._current.options

    def add_odometry(
        self,
        robot: str,
        stamp_ns: int,
        world_from_body: Sequence[float],
        position: Sequence[float] | None = None,
        body_from_sensor: Sequence[float] = IDENTITY,
    ) -> RejectReason | None:
        """Take an odometry message.

        Args:
            robot: name of the robot.
            stamp_ns: nanoseconds, ascending per robot. A stamp far ahead is believed only if the next one agrees.
            world_from_body: xyzw, the body in the odometry's frame.
            position: metres, for the keyframes' distance criterion.
            body_from_sensor: xyzw, orientation in the body's frame of the sensor at whose zero pose this odometry
                begins, so that a return to it is recognised; default: the body itself.

        Odometry that begins anew begins a new component, placed at first where the robot was last. When its stamps have
        gone back for several messages in a row, the options decide what happens.

        Returns:
            why it was refused and counted; None if it was taken.

        Raises:
            UserError: ``stamp_ns`` is no whole number.
        """
        turn, place, sensor = map(plain_numbers, (world_from_body, position, body_from_sensor))
        message = OdometryMessage(robot, whole_nanoseconds(stamp_ns), turn or (), place, sensor or ())
        with self._lock:
            return self._current.add_odometry(message)

    def clock_went_back(self, now_ns: int, from_ns: int | None = None) -> None:
        """The clock that stamps the data (``/clock``) went back; treated as if odometry had shown it.

        Going back by less than the options' ``time_jump_s`` is no jump.

        Args:
            now_ns: what it shows now.
            from_ns: what it showed before. Odometry up to then may still be under way; it belongs to the time before.
                None: all of it has come.
        """
        with self._lock:
            self._current.clock_went_back(now_ns, from_ns)

    def add_edge(self, edge: EdgeMeasurement, generation: int | None = None) -> RejectReason | None:
        """Take a measured edge.

        Args:
            edge: the edge.
            generation: of the graph that it is meant for, see :attr:`generation`; any other graph is left unchanged.

        Returns:
            why it was refused and counted; None if it was taken, may wait, or is meant for another graph.

        Raises:
            UserError: an id or a stamp is no whole number.
        """
        with self._lock:
            if generation not in (None, self._current.generation):
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

    def odometry_between(self, source: tuple[str, int], target: tuple[str, int]) -> Quaternion | None:
        """Measured target_from_source of the first odometry edge from one keyframe, (robot, id), to another, if any."""
        with self._lock:
            return self._content.builder.graph.odometry_between(source, target)

    def reject(self, reason: RejectReason) -> None:
        """Count an input that could not even be read as a measurement."""
        with self._lock:
            self._content.state.growth.refuse(reason)

    def label_edge(self, source_robot: str, edge_id: int, label: EdgeLabel, to_come: int = 0) -> int:
        """Accept or reject for good every edge with a sender's id, or hand it back; returns how many there are.

        Args:
            source_robot: of the edge's source.
            edge_id: the sender's.
            label: what holds from now on.
            to_come: how many such edges the caller has, but has not added yet.

        Raises:
            ViewGraphError: not an :class:`EdgeLabel`; a file with such a label could never be loaded.
            UserError: ``edge_id`` is no whole number.
        """
        edge_id = whole_number("edge_id", edge_id)
        try:
            label = EdgeLabel(label)
        except ValueError:
            raise ViewGraphError(f"label {label!r}; 0 is automatic, 1 accepted, 2 rejected") from None
        if not 0 <= edge_id <= MAX_ID:
            return 0
        with self._lock:
            return self._content.builder.label_edge(source_robot, edge_id, label, to_come)

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
            return self._content.counts(self._current.time_jumps)

    def set_options(self, options: EstimatorOptions) -> None:
        """Change the options; what was built so far stays.

        The next tick solves anew if an answer depends on what has changed (:attr:`EstimatorOptions.for_answer`).
        """
        with self._lock:
            self._current.set_options(options)

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
        """The graph now. Until keyframes are marginalised a later one begins with the same keyframes and edges.

        Only edges that are tied to odometry's end, since it pauses, are tied anew once it goes on.
        """
        with self._lock:
            return self._content.builder.graph.snapshot()

    def closure_keys(self) -> NDArray[np.uint64]:
        """Names of the closures in the graph, and of edges that wait to enter it, see :func:`closure_keys`."""
        with self._lock:
            snapshot, pending = self._content.builder.graph.snapshot(), list(self._content.state.growth.pending)
        return closure_keys(snapshot, pending)

    @property
    def revision(self) -> int:
        """Counts the graph's changes."""
        with self._lock:
            return self._content.builder.graph.revision

    @property
    def generation(self) -> int:
        """Counts how often everything was forgotten or replaced; what was sent before may then be new again."""
        return self._current.generation

    @property
    def time_jumps(self) -> int:
        """Counts how often the data's time went back."""
        return self._current.time_jumps

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
        return self._current.paused

    def pause(self, paused: bool) -> None:
        """While paused, inputs are taken as usual but ticks do nothing and a running one is given up, unless forced."""
        with self._lock:
            self._current.pause(paused)

    def reset(self) -> None:
        """Forget everything, counters included. Answers go on counting up; a running tick is thrown away."""
        with self._lock:
            self._current.forget()

    def save(self, path: str | Path) -> None:
        """Write everything into one file, whole or not at all.

        Raises:
            StateFileError: the file cannot be written.
        """
        with self._lock:
            state = state_content.collect(self._content.state)
        state_file.write(Path(path), state.encoded())

    def load(self, path: str | Path) -> None:
        """Replace everything by a file's content.

        Raises:
            StateFileError: not a state file, or not a whole one. The old state is kept.
        """
        state = state_content.restore(state_file.read(Path(path)), self.options)
        with self._lock:
            state.version = max(state.version, self._content.version)
            self._current.replace(state)

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
        return self._ticks.tick(force_cold, work)

    def go_on(self, work: float = WORK_AFTER) -> float:
        """After a tick, continue with the work that it has left; the next tick uses the result.

        Args:
            work: units of work that the solver may spend, see :data:`WORK_AFTER`; up to one factorisation more.

        Returns:
            the units of work that it has spent.

        Raises:
            UserError, TickAbandonedError: as :meth:`tick`.
        """
        return self._ticks.go_on(work)
