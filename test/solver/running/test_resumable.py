"""Solves that are left where they have done enough, and gone on with."""

from __future__ import annotations

import gc
import threading
import time
import weakref

import pytest
import torch

from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.resumable import Resumable
from rotavg_ros.solver.running.threads import num_workers, workers
from rotavg_ros.solver.running.work import Abandoned, abandonable, metered, rest, spend, stop_if_abandoned


def counting(number: int, seen: list[int]) -> int:
    for each in range(number):
        spend(1)
        seen.append(each)
    return number


def threads() -> int:
    return sum(thread.name == "rotavg-resumable" for thread in threading.enumerate())


def until(condition: object) -> None:
    for _ in range(500):
        if condition():  # type: ignore[operator]
            return
        time.sleep(0.01)
    raise AssertionError("it never came true")


def test_it_does_so_much_at_a_time_and_ends_where_it_would_at_once() -> None:
    seen: list[int] = []
    solve = Resumable(lambda: counting(10, seen))
    assert not seen  # nothing begins by itself
    with metered() as meter:
        assert not solve.go_on(3.0)
        assert seen == [0, 1, 2]
        assert meter.spent == 3.0
        assert not solve.go_on(0.0)
        assert len(seen) == 4  # one more, however little
        assert not solve.go_on(0.5)
        assert len(seen) == 5
        assert solve.go_on(1e9)
    assert (solve.result, solve.spent, meter.spent) == (10, 10.0, 10.0)
    assert solve.has_ended and not solve.has_failed
    assert solve.go_on(1.0)  # and stays so


def test_a_piece_that_does_not_fit_waits_unless_nothing_else_was_done() -> None:
    seen: list[float] = []

    def pieces() -> None:
        for units in (3.0, 6.0, 20.0, 1.0):
            spend(units)
            seen.append(units)

    solve, spent = Resumable(pieces), []
    while not solve.go_on(10.0):
        spent.append(solve.spent)
    assert spent == [9.0, 29.0]
    assert seen == [3.0, 6.0, 20.0, 1.0]


def test_between_turns_nothing_of_it_runs() -> None:
    seen: list[int] = []
    solve = Resumable(lambda: counting(1000, seen))
    for turn in range(1, 6):
        solve.go_on(10.0)
        before = len(seen)
        time.sleep(0.02)
        assert len(seen) == before == 10 * turn


def test_where_it_only_rests_it_is_left_too() -> None:
    seen: list[int] = []

    def solve() -> None:
        spend(10)
        for each in range(3):
            rest()
            seen.append(each)

    resumable = Resumable(solve)
    lengths = []
    while not resumable.go_on(0.0):
        lengths.append(len(seen))
    assert lengths == [0, 0, 1, 2]


def test_its_error_is_raised_where_it_is_waited_for() -> None:
    def fails() -> None:
        spend(1)
        raise ValueError("no such graph")

    solve = Resumable(fails)
    with pytest.raises(ValueError, match="no such graph"):
        solve.go_on(1e9)
    assert solve.has_failed and not solve.has_ended
    until(lambda: threads() == 0)


def test_it_is_abandoned_with_the_solve_around_it() -> None:
    def runs_for_ever() -> None:
        while True:
            spend(1)
            stop_if_abandoned()

    solve, asked = Resumable(runs_for_ever), 0

    def after_a_while() -> bool:
        nonlocal asked
        asked += 1
        return asked > 50

    assert not solve.go_on(20.0)
    with abandonable(after_a_while), pytest.raises(Abandoned):
        solve.go_on(1e9)
    assert solve.has_failed
    until(lambda: threads() == 0)


def test_its_thread_ends_when_nobody_holds_it_any_more() -> None:
    solve = Resumable(lambda: counting(1000, []))
    solve.go_on(2.0)
    assert threads() == 1
    del solve
    gc.collect()
    until(lambda: threads() == 0)


def test_torch_has_its_threads_between_turns_and_no_gradients_inside() -> None:
    before = torch.get_num_threads()
    inside: list[tuple[int, bool]] = []

    def solve() -> None:
        for _ in range(3):
            spend(1)
            inside.append((torch.get_num_threads(), torch.is_grad_enabled()))

    resumable = Resumable(solve)
    while not resumable.go_on(1.0):
        assert torch.get_num_threads() == before
        assert num_workers() == 1
    assert inside == [(1, False)] * 3
    with workers():
        assert num_workers() == before
    assert torch.get_num_threads() == before


class Slow:
    @cached_property
    def value(self) -> int:
        spend(1)
        spend(1)
        return 1


def test_one_that_rests_keeps_no_other_one_waiting() -> None:
    """What functools has for it locked all objects of a class until Python 3.12."""
    first, second = (Resumable(lambda: Slow().value) for _ in range(2))
    assert not first.go_on(1.0)
    assert second.go_on(1e9)
    assert first.go_on(1e9)
    slow = Slow()
    assert slow.value == slow.value == 1


class _Large:
    """What a solve has in its hands."""


def _holding(held: list[weakref.ref[_Large]]) -> None:
    large = _Large()
    held.append(weakref.ref(large))
    while True:
        spend(1)
        stop_if_abandoned()


@pytest.mark.parametrize("is_abandoned", [False, True])
def test_one_that_is_given_up_leaves_nothing_behind(is_abandoned: bool) -> None:
    """Without a collection of garbage: there is none."""
    held: list[weakref.ref[_Large]] = []
    solve = Resumable(lambda: _holding(held))
    gc.collect()
    gc.disable()
    try:
        solve.go_on(3.0)
        if is_abandoned:
            with abandonable(lambda: True), pytest.raises(Abandoned):
                solve.go_on(3.0)
            assert solve.has_failed
        else:
            del solve
        until(lambda: held[0]() is None)
    finally:
        gc.enable()
