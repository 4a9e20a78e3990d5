"""Counting what never arrived, and how long it took what did."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np

# Beyond so many, the sender that was silent the longest is forgotten: names come from messages, and may be anything.
_MOST_SENDERS = 1000
# A larger step is a sender that restarted or sends nonsense, not that many lost messages.
_LARGEST_GAP = 1_000_000


class SequenceGaps:
    """Lost messages of senders that number theirs consecutively.

    Attributes:
        lost: numbers that were left out.
        before_first: numbers below the first that was seen: sent before we listened, or lost while we connected.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.before_first = 0
        self._last: dict[str, int] = {}

    def observe(self, sender: str, number: int) -> None:
        """Note a number; one that is not ahead of the last means that the sender started anew.

        Args:
            sender: whose count it is.
            number: from 1; 0 if the sender does not count.
        """
        if number <= 0:
            return
        last = self._last.pop(sender, None)  # and back in at the end
        if last is None:
            self.before_first += number - 1 if number <= _LARGEST_GAP else 0
        elif last < number <= last + _LARGEST_GAP:
            self.lost += number - last - 1
        self._last[sender] = number
        if len(self._last) > _MOST_SENDERS:
            del self._last[next(iter(self._last))]


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
