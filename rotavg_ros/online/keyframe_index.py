"""From keys and stamps to nodes: which keyframe is meant."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.growing_array import GrowingArray
from rotavg_ros.online.measurements import UNKNOWN_STAMP_NS


class KeyframeIndex:
    """Nodes of one robot by keyframe id and by stamp."""

    def __init__(self) -> None:
        self._node_of_id: dict[int, int] = {}
        # In ascending order of the stamps; of equal ones in the order of the nodes.
        self._stamp_ns = GrowingArray(np.int64)
        self._node = GrowingArray(np.int64)

    @classmethod
    def of(
        cls, nodes: NDArray[np.int64], keyframe_id: NDArray[np.uint64], stamp_ns: NDArray[np.int64]
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
        order = np.argsort(stamp_ns[known], kind="stable")
        index._stamp_ns.extend(stamp_ns[known][order])
        index._node.extend(nodes[known][order])
        return index

    def node(self, keyframe_id: int) -> int | None:
        return self._node_of_id.get(keyframe_id)

    def add(self, keyframe_id: int, node: int) -> None:
        self._node_of_id[keyframe_id] = node

    def add_stamp(self, stamp_ns: int, node: int) -> None:
        stamps, nodes = self._stamp_ns.view, self._node.view
        position = int(np.searchsorted(stamps, stamp_ns, "right"))
        while position and stamps[position - 1] == stamp_ns and nodes[position - 1] > node:
            position -= 1
        self._stamp_ns.insert(position, stamp_ns)
        self._node.insert(position, node)

    def at_or_before(self, stamp_ns: int) -> int | None:
        """The newest node that is not younger than the stamp."""
        position = int(np.searchsorted(self._stamp_ns.view, stamp_ns, "right"))
        return int(self._node.view[position - 1]) if position else None

    def first(self) -> int | None:
        """The node with the smallest stamp."""
        return int(self._node.view[0]) if len(self._node) else None

    @property
    def stamps(self) -> NDArray[np.int64]:
        """Ascending."""
        return self._stamp_ns.view

    def newest_first(self) -> Iterator[int]:
        """Nodes with a stamp, in descending order of it."""
        return (int(node) for node in self._node.view[::-1])
