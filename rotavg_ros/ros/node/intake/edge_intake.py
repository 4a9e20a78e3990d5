"""Takes edges from messages, long ones in slices, so that odometry, services and signals are handled in between."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from rclpy.node import Node

from rotavg_ros.inputs import EdgeConverter, EdgeRecord, EdgeVerdict
from rotavg_ros.online import OnlineEstimator, RejectReason
from rotavg_ros.ros.node.intake.edge_frames import EdgeFrames
from rotavg_ros.ros.node.intake.forwarding import Forwarding
from rotavg_ros.ros.node.intake.wiring import Input
from rotavg_ros.ros.node.message_counting import TopicCounter
from rotavg_ros.view_graph import EdgeLabel

_SLICE_S = 0.005
_BREAK_S = 0.001
# Most messages in progress. Further ones wait in the middleware's queue, which is bounded; what it loses is counted.
_MOST_MESSAGES = 100


class _WhileThereIsRoom(MutuallyExclusiveCallbackGroup):
    """Runs callbacks one at a time, and only while there is room for further messages."""

    def __init__(self, has_room: Callable[[], bool]) -> None:
        super().__init__()
        self._has_room = has_room

    def can_execute(self, entity: Any) -> bool:
        return self._has_room() and bool(super().can_execute(entity))


class EdgeIntake:
    """Takes edges in the order in which their messages came. Runs on the executor's thread.

    Another thread may replace the graph at any moment (``~/load``). The rest of the messages is dropped then.

    Attributes:
        callback_group: for the subscriptions to edges; it holds them back while too many messages are in progress.
        frames: converts edges of sensors to the body's frame.
    """

    def __init__(
        self,
        node: Node,
        estimator: OnlineEstimator,
        forwarding: Forwarding,
        on_refusal: Callable[[RejectReason], None],
        frame_wait_s: float | None = None,
    ) -> None:
        """Take in edges.

        Args:
            node: the node.
            estimator: receives the edges.
            forwarding: is told what became of the edges that are to be sent on.
            on_refusal: is told of every edge that is refused.
            frame_wait_s: see :class:`EdgeFrames`.
        """
        self._estimator, self._forwarding = estimator, forwarding
        self.frames = EdgeFrames(node, frame_wait_s, self._add)
        self._on_refusal = on_refusal
        self.callback_group = _WhileThereIsRoom(lambda: len(self._under_way) < _MOST_MESSAGES)
        self._generation = estimator.generation
        self._converters: list[EdgeConverter] = []
        self._under_way: deque[tuple[Input, TopicCounter, Iterator[EdgeRecord | EdgeVerdict]]] = deque()
        self._timer = node.create_timer(_BREAK_S, self._go_on, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._timer.cancel()

    def add_source(self, convert: EdgeConverter) -> None:
        """Register a converter, which then forgets what it remembers whenever the estimator does."""
        self._converters.append(convert)

    def take(self, topic: Input, counter: TopicCounter, records: Iterator[EdgeRecord | EdgeVerdict]) -> None:
        """Take the records of a message, now or later."""
        self._forget_with_the_estimator()
        for ends in self._estimator.pop_given_up():
            for convert in self._converters:
                convert.note_given_up(*ends)
        self._under_way.append((topic, counter, records))
        self._take_some()

    def label_edge(self, source_robot: str, edge_id: int, label: EdgeLabel) -> int:
        """As :meth:`OnlineEstimator.label_edge`, edges that wait for their sensor's mounting included."""
        self._forget_with_the_estimator()
        return self._estimator.label_edge(source_robot, edge_id, label, self.frames.count(source_robot, edge_id))

    def _go_on(self) -> None:
        self._forget_with_the_estimator()
        self._take_some()

    def _take_some(self) -> None:
        self._take_a_slice()
        self._forget_with_the_estimator()
        if self._under_way:
            self._timer.reset()
        else:
            self._timer.cancel()

    def _take_a_slice(self) -> None:
        """Take records until none are left, time is up, or the graph has been forgotten."""
        generation, deadline = self._generation, time.perf_counter() + _SLICE_S
        while self._under_way:
            topic, counter, records = self._under_way[0]
            for record in records:
                self._take(record, topic, counter)
                if time.perf_counter() > deadline or self._estimator.generation != generation:
                    return
            self._under_way.popleft()

    def _take(self, record: EdgeRecord | EdgeVerdict, topic: Input, counter: TopicCounter) -> None:
        if isinstance(record, EdgeVerdict):
            self.label_edge(record.source_robot, record.edge_id, record.label)
            return
        topic.note_frames(record.frame_id)
        counter.by_sequence.observe(record.sender, record.sequence)
        if isinstance(record.edge, RejectReason):
            self._estimator.reject(record.edge)
            self._on_refusal(record.edge)
        else:
            self.frames.take(record, topic)

    def _add(self, record: EdgeRecord, topic: Input) -> None:
        if self._generation != self._estimator.generation:  # it has waited, and its graph has been forgotten
            self._forget_with_the_estimator()
            return
        assert not isinstance(record.edge, RejectReason)
        # The graph may be replaced right now, by another thread.
        reason = self._estimator.add_edge(record.edge, self._generation)
        if topic.forward is not None:
            self._forwarding.taken(topic.forward, record, reason, self._generation)
        if reason is not None and reason is not RejectReason.DUPLICATE_EDGE:
            self._on_refusal(reason)

    def _forget_with_the_estimator(self) -> None:
        """After a reset, what a sender repeats is new again, and what it sent before is useless."""
        if self._generation != self._estimator.generation:
            self._generation = self._estimator.generation
            self._under_way.clear()
            self.frames.forget()
            for convert in self._converters:
                convert.forget()
