"""Finds nodes by keyframe id and by moment."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.growing_array import GrowingArray
from rotavg_ros.online.measurements import UNKNOWN_STAMP_NS


class KeyframeIndex:
    """Nodes of one robot by keyframe id, and by the moments of those that have a stamp.

    A moment is a stamp on a time line, see :class:`~rotavg_ros.online.odometry.samples.OdometrySamples`.
    """

    def __init__(self) -> None:
        self._node_of_id: dict[int, int] = {}
        # In ascending order of time line, then stamp, then node.
        self._time_line = GrowingArray(np.int64)
        self._stamp_ns = GrowingArray(np.int64)
        self._node = GrowingArray(np.int64)

    @classmethod
    def of(
        cls,
        nodes: NDArray[np.int64],
        keyframe_id: NDArray[np.uint64],
        time_line: NDArray[np.int64],
        stamp_ns: NDArray[np.int64],
    ) -> KeyframeIndex:
        """The index of keyframes ``(K,)`` in ascending order of their nodes.

        Raises:
            ValueError: a keyframe occurs twice.
        """
        index = cls()
        index._node_of_id = dict(zip(keyframe_id.tolist(), nodes.tolist(), strict=True))
        if len(index._node_of_id) < len(nodes):
            raise ValueError("a keyframe occurs twice")
        known = stamp_ns != UNKNOWN_STAMP_NS
        order = np.lexsort((stamp_ns[known], time_line[known]))
        index._time_line.extend(time_line[known][order])
        index._stamp_ns.extend(stamp_ns[known][order])
        index._node.extend(nodes[known][order])
        return index

    def node(self, keyframe_id: int) -> int | None:
        return self._node_of_id.get(keyframe_id)

    def add(self, keyframe_id: int, node: int) -> None:
        self._node_of_id[keyframe_id] = node

    def add_moment(self, time_line: int, stamp_ns: int, node: int) -> None:
        stamps, nodes = self._stamp_ns.view, self._node.view
        start, position = self._places(time_line, stamp_ns)
        while position > start and stamps[position - 1] == stamp_ns and nodes[position - 1] > node:
            position -= 1
        self._time_line.insert(position, time_line)
        self._stamp_ns.insert(position, stamp_ns)
        self._node.insert(position, node)

    def at_or_before(self, time_line: int, stamp_ns: int) -> int | None:
        """The time line's newest node that is not younger than the stamp."""
        start, position = self._places(time_line, stamp_ns)
        return int(self._node.view[position - 1]) if position > start else None

    def first(self, time_line: int) -> int | None:
        """The time line's node with the smallest stamp."""
        start, stop = self._rows_of(time_line)
        return int(self._node.view[start]) if stop > start else None

    @property
    def moments(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Stamps and time lines, in order of the moments."""
        return self._stamp_ns.view, self._time_line.view

    def _rows_of(self, time_line: int) -> tuple[int, int]:
        column = self._time_line.view
        if time_line == 0 and (not len(column) or column[-1] == 0):
            return 0, len(column)
        start, stop = np.searchsorted(column, (time_line, time_line + 1)).tolist()
        return start, stop

    def _places(self, time_line: int, stamp_ns: int) -> tuple[int, int]:
        """Where a time line begins, and where a stamp that comes after all its equals belongs on it."""
        start, stop = self._rows_of(time_line)
        return start, start + int(np.searchsorted(self._stamp_ns.view[start:stop], stamp_ns, "right"))

    def newest_first(self, time_line: int, first_ns: int, last_ns: int) -> Iterator[int]:
        """The time line's nodes with stamps from the first to the last, both included, the latest moment first."""
        start, stop = self._rows_of(time_line)
        stamps = self._stamp_ns.view[start:stop]
        first, behind = int(np.searchsorted(stamps, first_ns)), int(np.searchsorted(stamps, last_ns, "right"))
        return (int(node) for node in self._node.view[start + first : start + behind][::-1])
