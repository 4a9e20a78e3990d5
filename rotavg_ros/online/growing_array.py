"""Arrays that grow by appending, and views of them that do not change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class GrowingArray:
    """NumPy array that grows at its end; its storage grows by half, so an append is O(1) on average.

    A :attr:`view` keeps its length and its rows however much the array grows afterwards.
    """

    def __init__(self, dtype: DTypeLike, width: int | None = None) -> None:
        self._data = np.empty((64,) if width is None else (64, width), dtype=dtype)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def view(self) -> NDArray[Any]:
        """The rows so far, not copied."""
        return self._data[: self._size]

    def append(self, row: float | Sequence[float]) -> None:
        self._reserve(self._size + 1)
        self._data[self._size] = row
        self._size += 1

    def extend(self, rows: NDArray[Any]) -> None:
        self._reserve(self._size + len(rows))
        self._data[self._size : self._size + len(rows)] = rows
        self._size += len(rows)

    def insert(self, position: int, row: float) -> None:
        """Insert a row, which changes existing views; at the end it is an append."""
        self.append(row)
        if position < self._size - 1:
            self._data[position + 1 : self._size] = self._data[position : self._size - 1].copy()
            self._data[position] = row

    def replace(self, rows: NDArray[Any]) -> None:
        """Begin anew with these rows; old views keep theirs."""
        self._data = np.empty((max(64, len(rows)), *self._data.shape[1:]), dtype=self._data.dtype)
        self._size = 0
        self.extend(rows)

    def _reserve(self, size: int) -> None:
        capacity = len(self._data)
        if size <= capacity:
            return
        grown = np.empty((max(size, capacity + capacity // 2), *self._data.shape[1:]), dtype=self._data.dtype)
        grown[: self._size] = self.view
        self._data = grown  # old views keep the old storage
