"""Counts lost messages, and measures durations."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np

# Most names remembered, since names come from messages and may be anything; the one silent longest is forgotten.
_MOST_NAMES = 1000
# The same limit for counts in progress, and for gaps in them.
_MOST_COUNTS = 100
# A larger step means a sender that restarted or sends nonsense, not that many lost messages.
_LARGEST_GAP = 1_000_000


class SequenceGaps:
    """Counts lost messages of senders that number theirs consecutively.

    Messages do not say who has sent them: a sender may report on several robots, and several senders on one. So a
    number continues the nearest count below it, whichever sender that belongs to; the total of missing numbers does not
    depend on this. A number inside a gap shows that the gap was the step from one sender's count to another's, in which
    nothing was lost.

    Attributes:
        lost: numbers that were skipped, or fewer: a count that has ended hides losses of one that passes it.
        before_first: numbers below the first one seen: sent before we listened, or lost while we connected.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.before_first = 0
        self._names: dict[str, None] = {}
        self._counts: list[int] = []  # the last number of each count; the newest message's is last
        self._gaps: list[tuple[int, int]] = []  # the numbers before and after each

    def observe(self, name: str, number: int) -> None:
        """Note a number; one that continues no count begins a new one: its sender is new or has restarted.

        Args:
            name: of what the message is about. The first message with a name may be the first of a sender.
            number: from 1; 0 if the sender does not count.
        """
        if number <= 0:
            return
        is_new = self._is_new(name)
        before = max((last for last in self._counts if 0 < number - last <= _LARGEST_GAP), default=0)
        gap = max(((low, high) for low, high in self._gaps if before < low < number < high), default=None)
        if gap is not None:
            self._gaps.remove(gap)
            self.lost -= _missing(*gap)
            before = gap[0]
        elif not before or (is_new and number > before + 1):
            if is_new:
                self.before_first += number - 1 if number <= _LARGEST_GAP else 0
            elif number in self._counts:  # a repetition
                return
            before = number - 1
        else:
            self._counts.remove(before)
        self._counts.append(number)
        if _missing(before, number):
            self.lost += _missing(before, number)
            self._gaps.append((before, number))
        del self._counts[:-_MOST_COUNTS], self._gaps[:-_MOST_COUNTS]

    def interrupt(self) -> None:
        """Numbers are missed from now on that say nothing of losses: the next one begins a count."""
        self._counts.clear()
        self._gaps.clear()

    def _is_new(self, name: str) -> bool:
        """Whether no message has come with this name before."""
        is_new = name not in self._names
        self._names.pop(name, None)
        self._names[name] = None
        if len(self._names) > _MOST_NAMES:
            del self._names[next(iter(self._names))]
        return is_new


def _missing(before: int, after: int) -> int:
    """How many numbers lie between two."""
    return after - before - 1


class TopicCounter:
    """Messages of one subscription: how many came, and how many were lost, by the sender's and middleware's counts."""

    def __init__(self) -> None:
        self.received = 0
        self.by_sequence = SequenceGaps()
        self.by_middleware = SequenceGaps()

    def observe(self, info: dict[str, Any] | None, num_publishers: int) -> None:
        """Note a message.

        Args:
            info: rclpy's message info; None if rclpy provides none.
            num_publishers: number of publishers. The middleware's numbers are per publisher and do not say which, so
                they count only while there is one. One that was killed still counts as a second for some seconds.
        """
        self.received += 1
        if info is None:
            return
        if num_publishers != 1:
            self.by_middleware.interrupt()
        else:
            self.by_middleware.observe("", info.get("publication_sequence_number") or 0)

    @property
    def lost(self) -> int:
        """The larger of the two counts, since both see the same losses."""
        return max(self.by_sequence.lost, self.by_middleware.lost)

    @property
    def before_first(self) -> int:
        return max(self.by_sequence.before_first, self.by_middleware.before_first)


class Durations:
    """The last durations of something, in seconds, and their percentiles."""

    def __init__(self, length: int = 1000) -> None:
        # Time of the end, on the monotonic clock, and duration. Copied before it is read: another thread may add.
        self._recent: deque[tuple[float, float]] = deque(maxlen=length)
        self.count = 0
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        self._recent.append((time.monotonic(), seconds))
        self.count += 1
        self.longest = max(self.longest, seconds)

    def percentile_ms(self, percent: float) -> float:
        """Percentile in milliseconds; NaN before the first."""
        recent = [seconds for _, seconds in list(self._recent)]
        return 1e3 * float(np.percentile(recent, percent)) if recent else float("nan")

    def between_ms(self, began: float, ended: float) -> list[float]:
        """All that ended between two moments of the monotonic clock, in milliseconds."""
        return [1e3 * seconds for when, seconds in list(self._recent) if began <= when < ended]

    def median_ms(self, window_s: float) -> float:
        """Median over the last ``window_s`` seconds, milliseconds; NaN if there is nothing in them."""
        now = time.monotonic()
        inside = self.between_ms(now - window_s, now)
        return float(np.median(inside)) if inside else float("nan")
