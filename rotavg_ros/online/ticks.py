"""Ticks: solve what is new, and continue after the answer with the work that is left."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from rotavg_ros.online import free_memory
from rotavg_ros.online.answer.anchoring import root_orientations
from rotavg_ros.online.answer.answer import Answer
from rotavg_ros.online.answer.gauge import fix_gauge
from rotavg_ros.online.content import AcceptedAnswer
from rotavg_ros.online.current_content import CurrentContent, RunningTick
from rotavg_ros.online.options import EstimatorOptions
from rotavg_ros.solver import Abandoned, abandonable
from rotavg_ros.view_graph import ViewGraph

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


class Ticks:
    """What runs while inputs come: ticks, and the work after them, one at a time.

    Their lock is taken before that of the content; :mod:`~rotavg_ros.online.current_content` says what each guards.
    """

    def __init__(self, current: CurrentContent, solver: Solver | None = None, advance: Advance | None = None) -> None:
        """Begin.

        Args:
            current: the content that is solved.
            solver: default: :func:`rotavg_ros.solve`.
            advance: default: :func:`rotavg_ros.solver.advance` with the default solver, nothing with another.
        """
        self._current = current
        self._solver, self._advance = (solver, advance) if solver else _default_solver()
        self._lock = threading.Lock()
        self._after_work = free_memory.AfterWork()

    def tick(self, force_cold: bool, work: float) -> Answer | None:
        """Solve, if there is anything new; see :meth:`~rotavg_ros.online.estimator.OnlineEstimator.tick`."""
        with self._lock:
            started = time.perf_counter()
            answer = self._tick(force_cold, work)
            if answer is None:
                return None
            free_memory.give_back_after(len(answer.source), answer.stage_seconds)
            return replace(answer, seconds=time.perf_counter() - started)

    def go_on(self, work: float) -> float:
        """Continue with the work that the last tick has left.

        See :meth:`~rotavg_ros.online.estimator.OnlineEstimator.go_on`.
        """
        if self._advance is None:
            return 0.0
        current = self._current
        with self._lock:
            with current.lock:
                if current.paused:
                    return 0.0
                memory, running = current.content.memory, current.begin_tick(is_forced=False)
            with _abandonable(running):
                spent = self._advance(memory, work)
            self._after_work.spent(spent)
            return spent

    def _tick(self, force_cold: bool, work: float) -> Answer | None:
        current = self._current
        with current.lock:
            content, options = current.content, current.options
            problem = None if current.paused and not force_cold else content.next_problem(force_cold)
            running = current.begin_tick(force_cold)
        if problem is None:
            return None
        snapshot, warm_start = problem.snapshot, problem.warm_start()
        with _abandonable(running):
            solution = self._solver(
                _solved_graph(problem.graph, options),
                **options.for_solver,
                warm_start=warm_start,
                memory=None if warm_start is None else problem.goes_on_from,
                work=work,
                anew=problem.anew,
            )
        if problem.anew and not solution.is_anew:
            with current.lock:  # nothing but the solver's memory has changed
                if options.for_answer == current.options.for_answer:
                    content.remember(solution.memory, snapshot.revision)
            return None
        component = solution.component.cpu()
        known = problem.known(solution, options.outlier_threshold)
        with current.lock:
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
        with current.lock:
            if content is not current.content:  # the solve ended before it noticed that it was abandoned
                raise _abandoned(running)
            revision, memory = snapshot.revision, solution.memory
            content.accept(
                AcceptedAnswer(body_from_world, component, answer.outlier, revision, was_cold, memory, known)
            )
            if options.for_answer != current.options.for_answer:
                content.solve_anew()
        return answer


@contextmanager
def _abandonable(running: RunningTick) -> Iterator[None]:
    """Inside, the solver stops soon after the tick is abandoned.

    Raises:
        TickAbandonedError: it has.
    """
    try:
        with abandonable(running.is_abandoned):
            yield
    except Abandoned:
        raise _abandoned(running) from None


def _abandoned(running: RunningTick) -> TickAbandonedError:
    return TickAbandonedError(f"abandoned: {running.abandoned_by}")


def _default_solver() -> tuple[Solver, Advance]:
    from rotavg_ros.solver import advance, solve  # loads the networks: not before somebody solves

    return solve, advance


def _solved_graph(graph: ViewGraph, options: EstimatorOptions) -> ViewGraph:
    """The graph without translations unless they are in metres."""
    return replace(graph, translation=None) if options.translation_scale == "none" else graph
