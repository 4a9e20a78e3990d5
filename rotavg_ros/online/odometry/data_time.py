"""The newest moment in the data, known from its stamps; no clock is read."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class DataTime:
    """The data's time, of one clock. A stamp far ahead counts only when a second one confirms it.

    Attributes:
        now_ns: newest stamp; None before the first, and again after time went back.
        claimed_ns: a stamp far ahead of it that nothing has confirmed yet.
    """

    now_ns: int | None = None
    claimed_ns: int | None = None

    def advance(self, stamp_ns: int, lead_ns: float) -> int | None:
        """Take a stamp; returns the present time if the stamp counts, however old it is, else None."""
        if self.now_ns is not None and stamp_ns - self.now_ns > lead_ns:
            claimed_ns, self.claimed_ns = self.claimed_ns, stamp_ns
            if claimed_ns is None or not 0 <= stamp_ns - claimed_ns <= lead_ns:
                return None
        self.now_ns = max(stamp_ns, self.now_ns or 0)
        return self.now_ns

    def go_back(self, now_ns: int | None) -> None:
        """Begin again from an earlier moment, or from the next stamp."""
        self.now_ns, self.claimed_ns = now_ns, None
