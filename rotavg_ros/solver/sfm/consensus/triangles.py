"""Triangles of a view-graph: three edges whose rotations should compose to none."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows


@dataclass(frozen=True)
class Triangles:
    """T triangles of a graph of M edges.

    Attributes:
        edge: ``(3, T)``.
        angle: ``(T,)`` rad, by which each does not close.
    """

    edge: np.ndarray
    angle: np.ndarray

    @classmethod
    def of(cls, ends: np.ndarray, measured: np.ndarray, most: int) -> Triangles:
        """Of edges that run from lower to higher nodes.

        Args:
            ends: ``(2, M)`` source and target.
            measured: ``(4, M)`` target_from_source.
            most: triangles at most; about so many paths of two edges are looked at, evenly spread over all.
        """
        num_nodes = int(ends.max(initial=-1)) + 1
        key = ends[0] * num_nodes + ends[1]
        order = np.argsort(key, kind="stable")  # fast where they are sorted, as a canonical form's are
        key, (source, target) = key[order], ends[:, order]
        first = np.searchsorted(source, np.arange(num_nodes + 1))
        # Each edge u→v is followed by every edge v→w.
        count = (first[1:] - first[:-1])[target]
        before = np.cumsum(count) - count
        path = np.arange(0, int(count.sum()), max(1, -(-int(count.sum()) // most)))
        one = np.searchsorted(before, path, side="right") - 1
        two = first[target[one]] + path - before[one]
        wanted = source[one] * num_nodes + target[two]
        three = np.searchsorted(key, wanted)
        closes = three < len(key)
        closes[closes] = key[three[closes]] == wanted[closes]
        edge = order[np.stack((one, two, three))[:, closes]]
        passed = quaternion_rows.multiply(measured[:, edge[1]], measured[:, edge[0]])
        dot = np.abs(np.einsum("in,in->n", passed, measured[:, edge[2]]))
        sine = np.sqrt(np.maximum(1 - np.minimum(dot, 1.0) ** 2, 0.0))
        return cls(edge, np.asarray(2 * np.arctan2(sine, dot)))

    def votes(self, closing: float, num_edges: int) -> np.ndarray:
        """``(M,)`` how many triangles of each edge close, to within about ``closing`` rad."""
        vote = np.exp(-((self.angle / closing) ** 2) / 2)
        return np.bincount(self.edge.ravel(), np.tile(vote, 3), num_edges)

    def contradicting(self, rejected: np.ndarray, closing: float) -> float:
        """Triangles with a rejected edge that close to within ``closing`` rad, beyond those that do so by chance.

        By chance triangles close by any rotation near none, of which one in 27 is three times as near.

        Args:
            rejected: ``(M,)`` bool.
            closing: rad.

        Returns:
            their number, in standard deviations of what is by chance.
        """
        angle = self.angle[rejected[self.edge].any(axis=0)]
        by_chance = float((angle < 3 * closing).sum()) / 27
        return (float((angle < closing).sum()) - by_chance) / math.sqrt(by_chance + 1)
