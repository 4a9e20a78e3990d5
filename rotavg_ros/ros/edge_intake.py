"""Edges of messages, long ones a slice at a time, so that odometry and signals get their turn in between."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from rclpy.node import Node

from rotavg_ros.inputs import EdgeConverter, EdgeRecord, EdgeVerdict
from rotavg_ros.online import OnlineEstimator, RejectReason
from rotavg_ros.ros.message_counting import TopicCounter

_SLICE_S = 0.005
_BREAK_S = 0.001
# With more messages than this under way the sender is too fast for us; then its queue shall know.
_MOST_MESSAGES = 100


class EdgeIntake:
    """Takes edges in the order in which their messages came. Runs on the executor's thread."""

    def __init__(self, node: Node, estimator: OnlineEstimator, on_refusal: Callable[[RejectReason], None]) -> None:
        self._estimator = estimator
        self._on_refusal = on_refusal
        self._generation = estimator.generation
        self._converters: list[EdgeConverter] = []
        self._under_way: deque[tuple[TopicCounter, Iterator[EdgeRecord | EdgeVerdict]]] = deque()
        self._timer = node.create_timer(_BREAK_S, self._go_on, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._timer.cancel()

    def add_source(self, convert: EdgeConverter) -> None:
        """Have a converter forget what it remembers whenever the estimator does."""
        self._converters.append(convert)

    def take(self, convert: EdgeConverter, counter: TopicCounter, message: Any) -> None:
        """Take a message's edges, now or in a while."""
        self._forget_with_the_estimator()
        self._under_way.append((counter, iter(convert(message))))
        self._take_some(float("inf") if len(self._under_way) > _MOST_MESSAGES else _SLICE_S)

    def _go_on(self) -> None:
        self._forget_with_the_estimator()
        self._take_some(_SLICE_S)

    def _take_some(self, seconds: float) -> None:
        deadline = time.perf_counter() + seconds
        while self._under_way:
            counter, records = self._under_way[0]
            for record in records:
                self._take(record, counter)
                if time.perf_counter() > deadline:
                    self._timer.reset()
                    return
            self._under_way.popleft()
        self._timer.cancel()

    def _take(self, record: EdgeRecord | EdgeVerdict, counter: TopicCounter) -> None:
        if isinstance(record, EdgeVerdict):
            self._estimator.label_edge(record.source_robot, record.edge_id, record.label)
            return
        counter.by_sequence.observe(record.sender, record.sequence)
        if isinstance(record.edge, RejectReason):
            reason: RejectReason | None = record.edge
            self._estimator.reject(record.edge)
        else:
            reason = self._estimator.add_edge(record.edge)
        if reason is not None and reason is not RejectReason.DUPLICATE_EDGE:
            self._on_refusal(reason)

    def _forget_with_the_estimator(self) -> None:
        """After a reset, what a sender repeats is new again, and what it sent before is of no use."""
        if self._generation != self._estimator.generation:
            self._generation = self._estimator.generation
            self._under_way.clear()
            for convert in self._converters:
                convert.forget()
