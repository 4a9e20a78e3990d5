"""What the node measures about itself."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, field

from rotavg_ros.online import Answer
from rotavg_ros.ros.node.message_counting import Durations, TopicCounter

# How long the diagnostics mention something that happened once, seconds.
_NOTICE_S = 60.0


@dataclass
class Health:
    """What the node measures about itself. Times are in seconds of the monotonic clock.

    Attributes:
        odometry, edges: message counters by topic name.
        ticks, odometry_callback: durations of ticks and of the odometry callback.
        odometry_latency: time from the sending of odometry to the publishing of ``orientation``.
        odometry_wait: how long odometry has waited in the middleware's queue before it was taken.
        started: when the node started.
        last_odometry: when a message was last taken, by topic name.
        last_refusal: when odometry was last refused, and why, by topic name.
        mistakes: present mistakes in the wiring and the parameters, a line each.
        answer: the last answer published; None before the first, or once it is forgotten.
        answered: when an answer was last published; None before the first.
        joins: how often components became one.
        held_back: number of closures that wait to be sent on (``forward_topics``).
        held_back_dropped: number of closures that will not be sent on, because too many waited.
        unsolved_since: since when the graph has been ahead of the answer; None if it was not at the last comparison.
        solve_failures: number of ticks that have failed so far.
        failure: error message of the last tick; None if it succeeded.
        save_failure: why the last save failed; None if it succeeded.
        waiting_for_frames: number of edges that wait for the transform between their frame and the body's.
        notices: what has happened to the graph, with the time when it happened.
    """

    odometry: dict[str, TopicCounter] = field(default_factory=dict)
    edges: dict[str, TopicCounter] = field(default_factory=dict)
    ticks: Durations = field(default_factory=Durations)
    odometry_callback: Durations = field(default_factory=Durations)
    odometry_latency: Durations = field(default_factory=Durations)
    odometry_wait: Durations = field(default_factory=Durations)
    started: float = field(default_factory=time.monotonic)
    last_odometry: dict[str, float] = field(default_factory=dict)
    last_refusal: dict[str, tuple[float, str]] = field(default_factory=dict)
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
        """Let the diagnostics mention something for a minute."""
        now = time.monotonic()
        self.notices = {text: noted for text, noted in self.notices.items() if now - noted < _NOTICE_S} | {notice: now}

    def recent_notices(self, now: float) -> list[str]:
        """Notices of the last minute."""
        return [notice for notice, noted in self.notices.items() if now - noted < _NOTICE_S]

    def took_odometry(self, topic: str) -> None:
        """An odometry message was taken."""
        self.last_odometry[topic] = time.monotonic()

    def refused_odometry(self, topic: str, reason: str) -> None:
        """An odometry message was refused."""
        self.last_refusal[topic] = time.monotonic(), reason

    def compared(self, began: float, is_behind: bool) -> None:
        """The graph was compared with the answer; decides :attr:`unsolved_since`.

        The worker does not: it may be what hangs.

        Args:
            began: when the comparison began; an answer that is published during it counts at the next one.
            is_behind: whether the graph has changed since the answer.
        """
        if self.unsolved_since is not None and self.answered is not None and self.answered >= self.unsolved_since:
            self.unsolved_since = None
        if self.unsolved_since is None and is_behind:
            self.unsolved_since = began

    def waits_for_nothing(self) -> None:
        """No answer is due."""
        self.unsolved_since = None

    def tick_failed(self, error: Exception) -> None:
        """A tick ended in an error."""
        self.solve_failures += 1
        self.failure = str(error)

    def tick_went_well(self) -> None:
        """A tick ended without an error, with or without an answer."""
        self.failure = None

    def joined(self) -> None:
        """Two components became one."""
        self.joins += 1

    def published(self, answer: Answer) -> None:
        """An answer was published."""
        self.ticks.add(answer.seconds)
        self.answer, self.answered = answer, time.monotonic()

    def forget_answer(self) -> None:
        """The last answer was forgotten."""
        self.answer = None

    def begin_anew(self) -> None:
        """Everything that was solved was forgotten or replaced."""
        self.unsolved_since = None
        self.ticks = Durations()

    def saved(self, failure: str | None = None) -> None:
        """The state was saved, or ``failure`` says why not."""
        self.save_failure = failure

    def noticed(self, mistakes: list[str]) -> None:
        """Set the present mistakes in wiring and parameters."""
        self.mistakes = mistakes
