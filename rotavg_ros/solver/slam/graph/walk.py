"""What odometry since the last solve errs by: a random walk, in which an error of a turn moves all that comes later.

A new node's turn errs by δ = δ_a + Σ dθ_j and its position by p = p_a + w × δ_a + Σ (w - w_j) × dθ_j + Σ dx_j. Here a
is the node of the solve that it hangs on, w its way from there, and j are the steps in between, which end w_j from
there. So the covariances of two nodes follow from sums over their common steps, which are those of the earlier one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.slam.graph.odometry_paths import Growth

# Columns of the sums: variances of turns, these times w_j and w_j w_jᵀ, variances of shifts.
_TURN, _ARM, _SQUARE, _SHIFT, _ALL = 0, slice(1, 4), slice(4, 13), 13, 14


class Dependence(NamedTuple):
    """How p turns with shifts depend on those of s nodes each: by ± the node's own, and v × its turn in the shift.

    Attributes:
        node: ``(s, p)``.
        sign: ``(s,)`` ±1.
        lever: ``(s, p, 3)`` metres, v.
    """

    node: np.ndarray
    sign: np.ndarray
    lever: np.ndarray

    @classmethod
    def on(cls, node: np.ndarray) -> Dependence:
        """The turns and shifts of nodes ``(p,)`` themselves."""
        return cls(node[None], np.ones(1), np.zeros((1, len(node), 3)))


@dataclass(frozen=True)
class Walk:
    """The n nodes that odometry has appended to the N of a solve.

    Attributes:
        num_known: N.
        anchor: ``(n,)`` node of the solve that each hangs on.
        way: ``(n, 3)`` metres from there.
        sums: ``(n, 14)`` over the steps from there: variance v of a turn's component, v w_j and v w_j w_jᵀ, and that
            of a shift's component.
    """

    num_known: int
    anchor: np.ndarray
    way: np.ndarray
    sums: np.ndarray

    @classmethod
    def begin(cls, num_known: int) -> Walk:
        """No new nodes."""
        return cls(num_known, np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, _ALL)))

    def along(self, growth: Growth, variance: np.ndarray, position: np.ndarray) -> Walk:
        """The walk with further nodes.

        Args:
            growth: the n' further nodes.
            variance: ``(2, n')`` rad² and m² per component, of the edge that attaches each.
            position: ``(N + n + n', 3)`` metres.
        """
        above = growth.anchor - self.num_known
        hangs = above >= 0
        anchor = growth.anchor.copy()
        anchor[hangs] = self.anchor[above[hangs]]
        way = position[len(position) - len(anchor) :] - position[anchor]
        turn, shift = variance
        square = (turn[:, None, None] * way[:, :, None] * way[:, None, :]).reshape(-1, 9)
        own = np.column_stack((turn, turn[:, None] * way, square, shift))
        sums = np.stack([growth.along(column) for column in np.ascontiguousarray(own.T)], axis=1)
        sums[hangs] += self.sums[above[hangs]]
        parts = ((self.anchor, anchor), (self.way, way), (self.sums, sums))
        return Walk(self.num_known, *(np.concatenate(part) for part in parts))

    def since(self, count: int) -> Walk:
        """The walk without the first ``count`` of its nodes."""
        return Walk(self.num_known, self.anchor[count:], self.way[count:], self.sums[count:])

    def variances(self, crossing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """``(n,)`` rad² and m² per component, of turns and positions relative to the anchor, if that is exact.

        Args:
            crossing: ``(3, m, k)`` w × in the axes of shifts and turns.
        """
        arm, square = self.sums[:, _ARM], self.sums[:, _SQUARE].reshape(-1, 3, 3)
        outer = self.way[:, :, None] * (self.sums[:, _TURN, None] * self.way - arm)[:, None, :]
        spread = outer - arm[:, :, None] * self.way[:, None, :] + square
        moved = np.einsum("nab,ab->n", spread, mean_square(crossing))
        return self.sums[:, _TURN], np.maximum(moved, 0.0) + self.sums[:, _SHIFT]


def mean_square(crossing: np.ndarray) -> np.ndarray:
    """``(3, 3)`` quadratic form of w: variance per component of w × a turn with variance 1 about each axis."""
    return np.asarray(np.einsum("amk,bmk->ab", crossing, crossing) / max(crossing.shape[1], 1))


def common_walk(walk: Walk, crossing: np.ndarray, ones: Dependence, others: Dependence) -> np.ndarray:
    """``(p, d, q, d)`` covariances that odometry since the solve gives to what depends on its nodes; d = k + m.

    Args:
        walk: that odometry.
        crossing: ``(3, m, k)`` w × in the axes of shifts and turns; m = 0 by rotations alone, where k is 1.
        ones, others: p and q turns with shifts.
    """
    nodes = walk.num_known, walk.anchor, walk.way, walk.sums
    return np.asarray(_common_walk(nodes, (crossing, _squares(crossing)), ones, others))


@compiled
def _common_walk(
    walk: tuple[int, np.ndarray, np.ndarray, np.ndarray],
    crossings: tuple[np.ndarray, np.ndarray],
    ones: Dependence,
    others: Dependence,
) -> np.ndarray:
    """The same, given :func:`_squares`."""
    (known, anchor, way, sums), crossing = walk, crossings[0]
    d = crossing.shape[1] + crossing.shape[2]
    total, own = np.zeros((ones.node.shape[1], d, others.node.shape[1], d)), np.zeros((d, d))
    for i in range(ones.node.shape[1]):
        for s in range(len(ones.sign)):
            one = ones.node[s, i] - known
            if one < 0:
                continue
            for j in range(others.node.shape[1]):
                for e in range(len(others.sign)):
                    other = others.node[e, j] - known
                    if other < 0 or anchor[one] != anchor[other]:
                        continue
                    first = one if sums[one, 0] <= sums[other, 0] else other
                    _fill(own, (way[one], way[other]), sums[first], crossings)
                    _cross(own, ones.lever[s, i], ones.sign[s], crossing, False)
                    _cross(own, others.lever[e, j], others.sign[e], crossing, True)
                    factor = ones.sign[s] * others.sign[e]
                    for a in range(d):
                        for b in range(d):
                            total[i, a, j, b] += factor * own[a, b]
    return total


@compiled
def _squares(crossing: np.ndarray) -> np.ndarray:
    """``(3, 3, m, m)`` products X_x X_yᵀ of the matrices ``(m, k)`` in ``crossing``."""
    m, k = crossing.shape[1], crossing.shape[2]
    found = np.zeros((3, 3, m, m))
    for x in range(3):
        for y in range(3):
            for a in range(m):
                for b in range(m):
                    for c in range(k):
                        found[x, y, a, b] += crossing[x, a, c] * crossing[y, b, c]
    return found


@compiled
def _cross(own: np.ndarray, lever: np.ndarray, sign: float, crossing: np.ndarray, of_columns: bool) -> None:
    """Add to the rows (or columns) of shifts ``(d, d)`` ± the lever × those of turns."""
    m, k = crossing.shape[1], len(own) - crossing.shape[1]
    if lever[0] == 0.0 and lever[1] == 0.0 and lever[2] == 0.0:
        return
    for a in range(m):
        for b in range(k):
            factor = 0.0
            for x in range(3):
                factor += sign * lever[x] * crossing[x, a, b]
            for c in range(len(own)):
                if of_columns:
                    own[c, k + a] += factor * own[c, b]
                else:
                    own[k + a, c] += factor * own[b, c]


@compiled
def _fill(
    own: np.ndarray,
    ways: tuple[np.ndarray, np.ndarray],
    sums: np.ndarray,
    crossings: tuple[np.ndarray, np.ndarray],
) -> None:
    """Fill ``(d, d)``, covariance of the errors of two nodes, given their ways and the sums over their common steps."""
    (one, other), (crossing, squares) = ways, crossings
    m, k = crossing.shape[1], crossing.shape[2]
    for a in range(k):
        for b in range(k):
            own[a, b] = sums[0] if a == b else 0.0
    for a in range(m):
        for b in range(m):
            own[k + a, k + b] = sums[13] if a == b else 0.0
        for b in range(k):
            own[k + a, b] = own[b, k + a] = 0.0
    for x in range(3):
        ahead, behind = sums[0] * one[x] - sums[1 + x], sums[0] * other[x] - sums[1 + x]
        for a in range(m):
            for b in range(k):
                own[k + a, b] += ahead * crossing[x, a, b]
                own[b, k + a] += behind * crossing[x, a, b]
        for y in range(3):
            spread = ahead * other[y] - one[x] * sums[1 + y] + sums[4 + 3 * x + y]
            if spread != 0.0:
                for a in range(m):
                    for b in range(m):
                        own[k + a, k + b] += spread * squares[x, y, a, b]
