"""What solves do to torch's number of threads: nothing that anybody finds afterwards."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import pytest
import torch

from rotavg_ros.solver.running.threads import for_each, num_workers, workers

FOUND = 3
WAIT_S = 60.0  # for what happens at once; only a deadlock takes longer


@pytest.fixture(autouse=True)
def found() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(FOUND)
    yield
    torch.set_num_threads(before)


def in_a_new_thread(work: Callable[[], int]) -> int:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


def assert_as_found() -> None:
    assert torch.get_num_threads() == FOUND
    assert in_a_new_thread(torch.get_num_threads) == FOUND


def test_one_thread_for_an_operation_and_several_for_a_loop() -> None:
    with workers():
        assert (num_workers(), torch.get_num_threads()) == (FOUND, 1)
        seen: list[int] = []
        for_each(lambda _: seen.append(torch.get_num_threads()), range(8))
        assert seen == [1] * 8
        with workers():
            pass
        assert (num_workers(), torch.get_num_threads()) == (FOUND, 1)
    assert num_workers() == 1
    assert_as_found()


def test_after_a_solve_that_raises() -> None:
    def fail(item: int) -> None:
        raise ValueError(f"item {item}")

    with pytest.raises(ValueError, match="item 0"), workers():
        for_each(fail, range(8))
    assert_as_found()


def test_solves_at_once_share_the_workers() -> None:
    def one_more(number: int) -> bool:
        done: list[int] = []
        with workers():
            for_each(done.append, range(number))
        return sorted(done) == list(range(number))

    with ThreadPoolExecutor(2) as pool:
        assert all(pool.map(one_more, range(20)))
    assert num_workers() == 1
    assert_as_found()


@pytest.mark.parametrize("first_leaves_first", [True, False])
@pytest.mark.parametrize("raises", [True, False])
def test_after_solves_that_overlap(first_leaves_first: bool, raises: bool) -> None:
    """Each in a thread of its own; the pool is first needed once one of them has left."""
    inside, may_leave = [threading.Event(), threading.Event()], [threading.Event(), threading.Event()]
    operations: list[int] = []

    def overlapping(number: int) -> int:
        with workers():
            inside[number].set()
            assert may_leave[number].wait(WAIT_S)
            for_each(lambda _: operations.append(torch.get_num_threads()), range(4))
            if raises:
                raise ZeroDivisionError
        return torch.get_num_threads()

    with ThreadPoolExecutor(2) as pool:
        futures: list[Future[int]] = []
        for number in (0, 1):
            futures.append(pool.submit(overlapping, number))
            assert inside[number].wait(WAIT_S)
        for number in (0, 1) if first_leaves_first else (1, 0):
            may_leave[number].set()
            assert (futures[number].exception(WAIT_S) is not None) == raises
        # Either thread has its own number back.
        again = [pool.submit(torch.get_num_threads) for _ in range(2)]
        assert [future.result() for future in again] == [FOUND, FOUND]
    assert operations == [1] * 8
    assert_as_found()


def test_a_thread_keeps_its_own_number() -> None:
    """One that was set in that thread alone, which solves last."""
    first_inside, first_may_leave = threading.Event(), threading.Event()

    def first() -> None:
        with workers():
            first_inside.set()
            assert first_may_leave.wait(WAIT_S)

    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(first)
        assert first_inside.wait(WAIT_S)
        torch.set_num_threads(5)
        with workers():
            first_may_leave.set()
            future.result()
        assert torch.get_num_threads() == 5
    assert in_a_new_thread(torch.get_num_threads) == FOUND
