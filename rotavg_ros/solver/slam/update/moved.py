"""Poses of all nodes of a graph that has grown, after a step of the last solve's unknowns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.quaternion_loops import Vector, canonical, exp, inverse, product, rotate, unit


class Hangs(NamedTuple):
    """How N' nodes are attached to the N nodes of the last solve, and these to its blocks.

    Attributes:
        anchor: ``(N',)`` the node of the last solve that each moves with.
        above, below: ``(N,)`` blocks between which each of these lies.
        share: ``(2, N)`` how far from the one to the other, for turns and for shifts.
    """

    anchor: np.ndarray
    above: np.ndarray
    below: np.ndarray
    share: np.ndarray


@compiled
def _between(hangs: Hangs, kind: int, of_block: np.ndarray, v: int) -> Vector:
    """Step of node v's anchor, interpolated from those of blocks ``(K + R, 3)``: turns (kind 0) or shifts (1)."""
    node = hangs.anchor[v]
    share, above, below = hangs.share[kind, node], hangs.above[node], hangs.below[node]
    return (
        (1 - share) * of_block[above, 0] + share * of_block[below, 0],
        (1 - share) * of_block[above, 1] + share * of_block[below, 1],
        (1 - share) * of_block[above, 2] + share * of_block[below, 2],
    )


@compiled
def turned(hangs: Hangs, turn: np.ndarray, walked: np.ndarray, before: np.ndarray) -> np.ndarray:
    """``(N', 4)`` orientations after turns of blocks ``(K + R, 3)`` and additional ones of new nodes ``(n, 3)``."""
    found, first = np.empty_like(before), len(hangs.above)
    for v in range(len(hangs.anchor)):
        x, y, z = _between(hangs, 0, turn, v)
        if v >= first:
            x, y, z = x + walked[v - first, 0], y + walked[v - first, 1], z + walked[v - first, 2]
        own = product((before[v, 0], before[v, 1], before[v, 2], before[v, 3]), exp((x, y, z)))
        found[v, 0], found[v, 1], found[v, 2], found[v, 3] = unit(canonical(own))
    return found


@compiled
def shifted(
    hangs: Hangs, turn: np.ndarray, shifts: tuple[np.ndarray, np.ndarray], way: np.ndarray, before: np.ndarray
) -> np.ndarray:
    """``(N', 3)`` positions after shifts, likewise; the way ``(N', 3)`` from its anchor turns with the anchor."""
    (shift, walked), found, first = shifts, np.empty_like(before), len(hangs.above)
    for v in range(len(hangs.anchor)):
        x, y, z = _between(hangs, 1, shift, v)
        found[v, 0], found[v, 1], found[v, 2] = before[v, 0] + x, before[v, 1] + y, before[v, 2] + z
        if v >= first:
            back = inverse(exp(_between(hangs, 0, turn, v)))
            x, y, z = rotate(back, (way[v, 0], way[v, 1], way[v, 2]))
            found[v, 0] += walked[v - first, 0] + x - way[v, 0]
            found[v, 1] += walked[v - first, 1] + y - way[v, 1]
            found[v, 2] += walked[v - first, 2] + z - way[v, 2]
    return found
