"""The worker's queue: in order, once where that is asked for, and an end that is awaited or not."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rclpy.executors import SingleThreadedExecutor

from rotavg_ros.ros.node.worker import Worker

PATIENCE_S = 30.0


@pytest.fixture
def worker() -> Iterator[Worker]:
    context = rclpy.Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)
    yield Worker(executor, "test")
    executor.shutdown()
    rclpy.shutdown(context=context)


class Job:
    """Begins, and ends when it is let go."""

    def __init__(self) -> None:
        self.begun, self.go = threading.Event(), threading.Event()
        self.runs = 0

    def __call__(self) -> None:
        self.runs += 1
        self.begun.set()
        assert self.go.wait(PATIENCE_S)


def test_a_job_waits_once_however_often_it_is_asked_for(worker: Worker) -> None:
    job = Job()
    worker.submit_once(job)
    assert job.begun.wait(PATIENCE_S)
    for _ in range(100):
        worker.submit_once(job)  # while it runs: once more afterwards
    job.go.set()
    assert worker.stop(PATIENCE_S, finish=True)
    assert job.runs == 2


def test_a_failed_job_tells_its_future_and_the_next_one_runs(worker: Worker) -> None:
    def fail() -> None:
        raise ValueError("no")

    failed, fine = worker.submit(fail), worker.submit(lambda: 7)
    assert worker.stop(PATIENCE_S, finish=True)
    assert str(failed.exception()) == "no" and fine.result() == 7


def test_a_long_job_is_not_waited_for_and_what_queues_is_dropped(worker: Worker) -> None:
    job, never = Job(), Job()
    worker.submit(job)
    assert job.begun.wait(PATIENCE_S)
    worker.submit(never)
    assert not worker.stop(0.0)
    job.go.set()
    assert worker.stop(PATIENCE_S)
    assert never.runs == 0
