"""Random signs that tell variances from a few right-hand sides (``uncertainty.py``)."""

from __future__ import annotations

import numpy as np


def probe_signs(first: np.ndarray, second: np.ndarray, num_probes: int) -> np.ndarray:
    """Signs ±1 ``(E, num_probes)`` int8 that depend on an edge's two node numbers alone; reversing it negates them.

    Hashed (SplitMix64), not drawn: the order of the edges and edges that are added later change nothing. Parallel edges
    share their signs; their number among the parallels is mixed in to keep them independent.
    """
    low, high = np.minimum(first, second).astype(np.uint64), np.maximum(first, second).astype(np.uint64)
    pair = low.astype(np.int64) * (int(high.max(initial=0)) + 1) + high.astype(np.int64)
    order = np.argsort(pair, kind="stable")  # takes hardly any time where pairs are sorted already
    run = np.arange(len(pair))
    start = np.maximum.accumulate(np.where(np.diff(pair[order], prepend=-1) > 0, run, 0))
    same = np.empty_like(pair)
    same[order] = run - start
    key = _mix(low * np.uint64(0x9E3779B97F4A7C15) ^ _mix(high ^ _mix(same.astype(np.uint64))))
    words = -(-num_probes // 64)
    bits = np.stack([_mix(key + np.uint64(word + 1)) for word in range(words)], axis=1).astype("<u8")
    is_positive = np.unpackbits(bits.view(np.uint8), axis=1, count=num_probes, bitorder="little").view(bool)
    is_positive ^= (first > second)[:, None]
    return np.asarray(2 * is_positive.view(np.int8) - np.int8(1))


def _mix(value: np.ndarray) -> np.ndarray:
    """The finaliser of SplitMix64 (Steele et al. 2014); unsigned arithmetic wraps around."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(value ^ (value >> np.uint64(31)))
