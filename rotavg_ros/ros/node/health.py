"""What the node measures about itself."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from rotavg_ros.online import Answer
from rotavg_ros.ros.node.message_counting import Durations, TopicCounter

# So long the diagnostics tell of something that has happened once.
_NOTICE_S = 60.0


@dataclass
class Health:
    """What the node measures about itself. Times are of the monotonic clock, in seconds.

    Attributes:
        odometry, edges: counters per topic name.
        ticks, odometry_callback, odometry_latency: durations; latency from sending to ``orientation``.
        answer: the last one published, and when.
        last_odometry: when a message was last taken, per topic name.
        mistakes: in the wiring and the parameters, a line each.
        joins: how often components became one.
        held_back: closures that wait to be sent on (``forward_topics``).
        held_back_dropped: closures that waited and will not be sent on, since too many did.
        unsolved_since: since when the graph has been ahead of the answer; None if it is not.
        solve_failures: how many ticks failed in all; ``failure`` is the last one's message, None after a good tick.
        save_failure: why the last save failed, None if it did not.
        waiting_for_frames: edges that wait for the transform between their frame and the body's.
        notices: what has happened to the graph, and when.
    """

    odometry: dict[str, TopicCounter] = field(default_factory=dict)
    edges: dict[str, TopicCounter] = field(default_factory=dict)
    ticks: Durations = field(default_factory=Durations)
    odometry_callback: Durations = field(default_factory=Durations)
    odometry_latency: Durations = field(default_factory=Durations)
    started: float = field(default_factory=time.monotonic)
    last_odometry: dict[str, float] = field(default_factory=dict)
    mistakes: list[str] = field(default_factory=list)
    answer: Answer | None = None
    joins: int = 0
    held_back: int = 0
    held_back_dropped: int = 0
    answered: float | None = None
    unsolved_since: float | None = None
    solve_failures: int = 0
    failure: str | None = None
    save_failure: str | None = None
    waiting_for_frames: int = 0
    notices: dict[str, float] = field(default_factory=dict)

    @property
    def lost(self) -> int:
        return sum(counter.lost for counter in self._counters())

    def _counters(self) -> Iterable[TopicCounter]:
        return [*self.odometry.values(), *self.edges.values()]

    def note(self, notice: str) -> None:
        """Have the diagnostics tell of something for a minute."""
        now = time.monotonic()
        self.notices = {text: noted for text, noted in self.notices.items() if now - noted < _NOTICE_S} | {notice: now}

    def recent_notices(self, now: float) -> list[str]:
        """What has happened in the last minute."""
        return [notice for notice, noted in self.notices.items() if now - noted < _NOTICE_S]

    def took_odometry(self, topic: str) -> None:
        """A message was taken."""
        self.last_odometry[topic] = time.monotonic()

    def fell_behind(self) -> None:
        """The graph has changed since the answer, if that was not known yet."""
        if self.unsolved_since is None:
            self.unsolved_since = time.monotonic()

    def waits_for_nothing(self) -> None:
        """No answer is due."""
        self.unsolved_since = None

    def tick_failed(self, error: Exception) -> None:
        """A tick ended in an error."""
        self.solve_failures += 1
        self.failure = str(error)

    def tick_went_well(self) -> None:
        """A tick came to its end, with an answer or without."""
        self.failure = None

    def joined(self) -> None:
        """Two components became one."""
        self.joins += 1

    def published(self, answer: Answer) -> None:
        """An answer went out, and is the last one from now on."""
        self.ticks.add(answer.seconds)
        self.answer, self.answered, self.unsolved_since = answer, time.monotonic(), None

    def forget_answer(self) -> None:
        """There is no last answer any more."""
        self.answer = None

    def begin_anew(self) -> None:
        """Everything that was solved was forgotten or replaced."""
        self.unsolved_since = None
        self.ticks = Durations()

    def saved(self, failure: str | None = None) -> None:
        """The state was saved, or why not."""
        self.save_failure = failure

    def noticed(self, mistakes: list[str]) -> None:
        """These are the mistakes in wiring and parameters now."""
        self.mistakes = mistakes
