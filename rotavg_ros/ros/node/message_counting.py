"""Counting what never arrived, and how long it took what did."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np

# Beyond so many, the name that was silent the longest is forgotten: names come from messages, and may be anything.
_MOST_NAMES = 1000
# The same of counts that are under way, and of gaps in them.
_MOST_COUNTS = 100
# A larger step is a sender that restarted or sends nonsense, not that many lost messages.
_LARGEST_GAP = 1_000_000


class SequenceGaps:
    """Lost messages of senders that number theirs consecutively.

    Messages do not say who has sent them: a sender may speak of several robots, and several of one. So a number goes
    on the nearest count below it, whosever that is; how many are missing in all does not depend on it. A number inside
    a gap shows that the gap was the step from one sender's count to another's: nothing was lost in it.

    Attributes:
        lost: numbers that were left out, or fewer: a count that has ended hides losses of one that passes it.
        before_first: numbers below the first that was seen: sent before we listened, or lost while we connected.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.before_first = 0
        self._names: dict[str, None] = {}
        self._counts: list[int] = []  # the last number of each; at the end that of the newest message
        self._gaps: list[tuple[int, int]] = []  # the numbers before and after

    def observe(self, name: str, number: int) -> None:
        """Note a number; one that goes on no count begins one: its sender is new, or started anew.

        Args:
            name: of what the message is about. The first of a name may well be the first of a sender.
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

    def _is_new(self, name: str) -> bool:
        """Whether nothing has come by this name."""
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
    """Messages of one subscription: how many came, and how many got lost by the sender's and the middleware's count."""

    def __init__(self) -> None:
        self.received = 0
        self.by_sequence = SequenceGaps()
        self.by_middleware = SequenceGaps()

    def observe(self, info: dict[str, Any] | None, num_publishers: int) -> None:
        """Note a message.

        Args:
            info: rclpy's message info, None where rclpy hands out none.
            num_publishers: the middleware's numbers are per publisher and do not say whose, so they count only while
                there is one.
        """
        self.received += 1
        if info is not None and num_publishers == 1:
            self.by_middleware.observe("", info.get("publication_sequence_number") or 0)

    @property
    def lost(self) -> int:
        """The larger of the two counts, for both see the same losses."""
        return max(self.by_sequence.lost, self.by_middleware.lost)

    @property
    def before_first(self) -> int:
        return max(self.by_sequence.before_first, self.by_middleware.before_first)


class Durations:
    """The last durations of something, in seconds, and their percentiles."""

    def __init__(self, length: int = 1000) -> None:
        # When, on the monotonic clock, and how long. Copied as a whole before it is read: another thread may add.
        self._recent: deque[tuple[float, float]] = deque(maxlen=length)
        self.count = 0
        self.longest = 0.0

    def add(self, seconds: float) -> None:
        self._recent.append((time.monotonic(), seconds))
        self.count += 1
        self.longest = max(self.longest, seconds)

    def percentile_ms(self, percent: float) -> float:
        """Milliseconds; NaN before the first."""
        recent = [seconds for _, seconds in list(self._recent)]
        return 1e3 * float(np.percentile(recent, percent)) if recent else float("nan")

    def between_ms(self, began: float, ended: float) -> list[float]:
        """All that ended between two moments of the monotonic clock, in milliseconds."""
        return [1e3 * seconds for when, seconds in list(self._recent) if began <= when < ended]

    def median_ms(self, window_s: float) -> float:
        """Milliseconds, of the last so many seconds; NaN where nothing happened in them."""
        now = time.monotonic()
        inside = self.between_ms(now - window_s, now)
        return float(np.median(inside)) if inside else float("nan")
