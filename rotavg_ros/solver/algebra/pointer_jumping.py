"""Pointer jumping: follow chains of pointers in log₂(length) vectorised rounds."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import numpy as np
from torch import Tensor

Pointers = TypeVar("Pointers", np.ndarray, Tensor)


def doublings(pointer: Pointers) -> Iterator[tuple[Pointers, Pointers]]:
    """Pointers ``(N,)`` over 1, 2, 4, … steps, each with those over twice as many, until every chain has ended.

    A chain ends in an element that points to itself.
    """
    while True:
        farther = pointer[pointer]
        if bool((farther == pointer).all()):
            return
        yield pointer, farther
        pointer = farther


def follow(pointer: np.ndarray) -> np.ndarray:
    """The end of every chain, ``(N,)``."""
    end = pointer
    for _, end in doublings(pointer):  # noqa: B007 (the last one counts)
        pass
    return end


def lowest_common_ancestors(parent: np.ndarray, level: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``(P,)`` where the ways upwards from nodes ``a`` and ``b``, of the same tree each, meet.

    Args:
        level: ``(N,)`` int, number of edges between each node and its root.
    """
    jumps = [parent, *(farther for _, farther in doublings(parent))]
    low, high = np.where(level[a] >= level[b], a, b), np.where(level[a] >= level[b], b, a)
    excess = level[low] - level[high]
    for power, jump in enumerate(jumps):
        low = np.where((excess >> power) & 1 == 1, jump[low], low)
    for jump in reversed(jumps):
        apart = jump[low] != jump[high]
        low, high = np.where(apart, jump[low], low), np.where(apart, jump[high], high)
    return np.asarray(np.where(low == high, low, parent[low]))


def sums_of_branches(parent: np.ndarray, level: np.ndarray, value: np.ndarray) -> np.ndarray:
    """``(N,)`` sum of ``value`` over each node and all below it; ``level`` as in :func:`lowest_common_ancestors`."""
    jumps, total = [parent, *(farther for _, farther in doublings(parent))], value
    for power, jump in enumerate(jumps):
        # What lies less than 2^power edges below a node is in its sum already.
        (reaches,) = np.nonzero(level >= 1 << power)
        total = total + np.bincount(jump[reaches], total[reaches], len(parent))
    return total
