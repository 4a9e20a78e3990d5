"""Which edges have been taken, at eight bytes each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

# Python objects take ten times the memory, so only the newest numbers are kept as such.
_NEWEST = 4096


class Fingerprints:
    """A set of 64-bit numbers that forgets the oldest.

    It holds at least the newest ``capacity`` numbers and at most twice as many.

    Attributes:
        capacity: may be changed at any time.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._newest: set[int] = set()
        # Ascending; when `_younger` is full it becomes `_older`, and the previous `_older` is forgotten.
        self._younger = self._older = np.empty(0, dtype=np.uint64)

    def __len__(self) -> int:
        return len(self._newest) + len(self._younger) + len(self._older)

    def __contains__(self, number: int) -> bool:
        return number in self._newest or _contains(self._younger, number) or _contains(self._older, number)

    def add(self, number: int) -> None:
        self._newest.add(number)
        if len(self._newest) >= min(_NEWEST, self.capacity):
            # Two ascending runs, which a stable sort merges quickly.
            runs = self._younger, np.sort(self._newest_as_array())
            self._younger = np.sort(np.concatenate(runs), kind="stable")
            self._newest = set()
            if len(self._younger) >= self.capacity:
                self._younger, self._older = self._older[:0], self._younger

    def arrays(self) -> dict[str, NDArray[np.uint64]]:
        """All of them, for :meth:`from_arrays`."""
        return {"older": self._older, "younger": self._younger, "newest": np.sort(self._newest_as_array())}

    @classmethod
    def from_arrays(cls, capacity: int, arrays: Mapping[str, NDArray[np.uint64]]) -> Fingerprints:
        """The set that :meth:`arrays` came from."""
        fingerprints = cls(capacity)
        fingerprints._older, fingerprints._younger = arrays["older"], arrays["younger"]
        fingerprints._newest = set(arrays["newest"].tolist())
        return fingerprints

    def _newest_as_array(self) -> NDArray[np.uint64]:
        return np.fromiter(self._newest, dtype=np.uint64, count=len(self._newest))


def _contains(ascending: NDArray[np.uint64], number: int) -> bool:
    position = int(np.searchsorted(ascending, np.uint64(number)))
    return position < len(ascending) and int(ascending[position]) == number
