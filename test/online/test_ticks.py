"""When the estimator solves, warm or cold, and what becomes of a solve that something comes between."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from rotavg_ros.online import OnlineEstimator
from rotavg_ros.online.ticks import TickAbandonedError
from rotavg_ros.solver.running.work import stop_if_abandoned

from .drives import OPTIONS, closure, drive, feed, final, make


def test_options_that_change_during_a_solve_are_in_the_next_answer(solver):
    """Once there is nothing else to solve for."""
    changes = [replace(OPTIONS, outlier_threshold=0.9)]

    def changing(*arguments: Any, **options: Any) -> Any:
        if changes:
            estimator.set_options(changes.pop())
        return solver(*arguments, **options)

    run, estimator = drive(), make(changing)
    feed(estimator, run)
    assert estimator.tick(force_cold=True) is not None
    assert estimator.tick() is not None and estimator.tick() is None


@pytest.mark.parametrize(
    ("change", "is_answer_other"),
    [
        ({"stamp_tolerance_s": 0.2, "keyframe_interval_s": 0.2, "max_keyframes": 50, "warm_start": False}, False),
        *(({name: value}, True) for name, value in (("outlier_threshold", 0.9), ("translation_scale", "none"))),
        ({"method": "l1"}, True),
    ],
)
def test_only_options_that_an_answer_depends_on_make_it_anew(solver, change: dict, is_answer_other: bool) -> None:
    """Others leave the last answer, and what the solver remembers of it, whether they change before a tick or in it."""
    remembered: list[object] = []

    def remembering(*arguments: Any, memory: object = None, **options: Any) -> Any:
        remembered.append(memory)
        return replace(solver(*arguments, memory=memory, **options), memory=len(remembered))

    run, estimator = drive(), make(remembering)
    feed(estimator, run, stop=20)
    final(estimator)
    estimator.set_options(replace(OPTIONS, **change))
    assert (estimator.tick() is not None) == is_answer_other
    solver.on_call = lambda: estimator.set_options(OPTIONS)
    feed(estimator, run, start=20, stop=30)
    assert estimator.tick() is not None
    solver.on_call = None
    feed(estimator, run, start=30)
    assert estimator.tick() is not None
    assert (remembered[-1] is None) == is_answer_other


def test_what_an_unfinished_solve_remembers_of_old_options_is_forgotten(solver):
    """It goes on from tick to tick until it is what a solve from scratch says; not where options changed within it."""
    remembered: list[object] = []

    def changing(*arguments: Any, memory: object = None, anew: bool = False, **options: Any) -> Any:
        remembered.append(memory)
        solution = solver(*arguments, memory=memory, **options)
        if not anew:
            return replace(solution, memory="of an answer", is_anew=False)
        if len(remembered) == 3:
            estimator.set_options(replace(OPTIONS, outlier_threshold=0.9))
        return replace(solution, memory="under way", is_anew=False)

    run, estimator = drive(), make(changing)
    feed(estimator, run, stop=10)
    assert estimator.tick() is not None
    feed(estimator, run, start=10, stop=20)
    assert estimator.tick() is not None
    assert estimator.tick() is None  # options change during this one
    estimator.tick()
    assert remembered[2] == "of an answer" and remembered[3] is None


def test_warm_while_data_flows_then_cold_once_then_nothing(solver):
    run, estimator = drive(), make(solver)
    assert estimator.tick() is None
    feed(estimator, run, stop=10)
    assert estimator.tick().was_cold  # nothing to start from
    assert estimator.tick() is None
    feed(estimator, run, start=10, stop=20)
    assert not estimator.tick().was_cold
    assert estimator.tick().was_cold
    assert estimator.tick() is None and estimator.tick(force_cold=True) is None
    assert (solver.calls, solver.warm) == (3, 1)
    feed(estimator, run, start=20, stop=21)  # no new keyframe: nothing to solve
    assert estimator.tick() is None
    feed(estimator, run, start=21)
    assert estimator.tick(force_cold=True).was_cold
    assert estimator.tick() is None


def test_a_failing_solver_is_tried_again(solver):
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    solver.on_call = lambda: (_ for _ in ()).throw(RuntimeError("no"))
    with pytest.raises(RuntimeError):
        estimator.tick()
    solver.on_call = None
    assert final(estimator).version == 1


def test_input_during_a_solve_belongs_to_the_next(solver):
    run, estimator = drive(), make(solver)
    feed(estimator, run, stop=20)
    solver.on_call = lambda: feed(estimator, run, start=20) if solver.calls == 1 else None
    assert len(estimator.tick().keyframe_id) == 7
    assert len(final(estimator).keyframe_id) == 14


def test_reset_during_a_solve_throws_its_answer_away(solver):
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    solver.on_call = estimator.reset
    with pytest.raises(TickAbandonedError, match="forgotten or replaced"):
        estimator.tick()
    assert estimator.counts().keyframes == 0 and estimator.counts().rejected == {}
    assert estimator.tick() is None


@pytest.mark.parametrize("act", ["reset", "load", "pause"])
def test_a_solve_is_given_up_where_nobody_waits_for_its_answer(solver, tmp_path, act: str) -> None:
    run, estimator = drive(), make(solver)
    feed(estimator, run)
    before = estimator.tick()
    estimator.save(tmp_path / "state.npz")
    feed(estimator, drive(seed=2), robot="s")
    acts = {
        "reset": estimator.reset,
        "load": lambda: estimator.load(tmp_path / "state.npz"),
        "pause": lambda: estimator.pause(True),
    }
    asked = []

    def solve_until_told() -> None:
        stop_if_abandoned()
        acts[act]()
        asked.append(act)
        stop_if_abandoned()
        pytest.fail("the solve went on")

    solver.on_call = solve_until_told
    with pytest.raises(TickAbandonedError, match="paused" if act == "pause" else "forgotten or replaced"):
        estimator.tick()
    solver.on_call = None
    assert asked == [act]
    if act == "pause":
        assert estimator.tick() is None
        estimator.pause(False)
    answer = estimator.tick()
    assert len(before.keyframe_id) == 14
    assert (0 if answer is None else len(answer.keyframe_id)) == {"reset": 0, "load": 14, "pause": 28}[act]


def test_a_pause_leaves_an_answer_alone_that_somebody_has_asked_for(solver) -> None:
    estimator = make(solver)
    feed(estimator, drive())

    def pause() -> None:
        estimator.pause(True)
        stop_if_abandoned()

    solver.on_call = pause
    assert estimator.tick(force_cold=True) is not None


def test_an_empty_graph_is_nothing_to_solve() -> None:
    estimator = OnlineEstimator(OPTIONS)

    def nothing() -> None:
        assert estimator.tick() is None and estimator.tick(force_cold=True) is None and not estimator.is_behind

    nothing()
    estimator.set_options(replace(OPTIONS, outlier_threshold=0.4))
    nothing()
    feed(estimator, drive())
    assert estimator.tick() is not None
    estimator.reset()
    estimator.set_options(OPTIONS)
    nothing()


def test_pause_keeps_inputs_and_stops_ticks(solver):
    run, estimator = drive(), make(solver)
    estimator.pause(True)
    feed(estimator, run)
    assert estimator.tick() is None and solver.calls == 0
    assert estimator.tick(force_cold=True) is not None
    estimator.pause(False)
    estimator.add_edge(closure(run, 1, 0, 30))
    assert len(final(estimator).edge_id) == 14
