"""Random signs that tell every edge's leverage from a few right-hand sides (see ``FactorisedLaplacian.samples``)."""

from __future__ import annotations

import numpy as np


def likeliest_leverage(square: np.ndarray, product: np.ndarray) -> np.ndarray:
    """Leverages ``(E,)`` in (0, 1], the effective resistance of each edge times its weight.

    A sample's difference over an edge, times the root of its weight, is ``x = l s + rest``: the edge's own sign s
    enters it by the leverage l, and what all other edges add has the variance ``l (1 - l)``. The mean square alone
    leaves an error of l of 20 % (48 probes), which for an edge that nearly alone ties a part of the graph is many times
    1 - l. The likelihood of both moments has one maximum, the root of a cubic that falls from 0 to 1.

    Args:
        square: ``(E,)`` means of x².
        product: ``(E,)`` means of x s.
    """
    # 2 l³ - 2 (1 + b) l² + (1 + 2 a) l - a = 0 in the form t³ + p t + q = 0, where p ≥ 0: Cardano's only real root.
    centre = (1 + product) / 3
    p = np.maximum(0.5 + square - 3 * centre**2, np.finfo(np.float64).tiny)
    q = centre * (0.5 + square - 2 * centre**2) - square / 2
    root = -np.copysign(np.cbrt(np.abs(q) / 2 + np.sqrt((q / 2) ** 2 + (p / 3) ** 3)), q)
    return np.asarray(np.clip(centre + root - p / (3 * root), np.finfo(np.float64).tiny, 1.0))


def probe_signs(first: np.ndarray, second: np.ndarray, num_probes: int) -> np.ndarray:
    """Signs ±1 ``(E, num_probes)`` int8 that depend on an edge's two node numbers alone; reversing it negates them.

    Hashed (SplitMix64), not drawn: the order of the edges and edges that are added later change nothing. Parallel edges
    share their signs; their number among the parallels is mixed in to keep them independent.
    """
    low, high = np.minimum(first, second).astype(np.uint64), np.maximum(first, second).astype(np.uint64)
    order = np.lexsort((high, low))
    same = np.zeros(len(low), dtype=np.int64)
    repeated = (np.diff(low[order]) == 0) & (np.diff(high[order]) == 0)
    run = np.arange(1, len(low))
    start = np.maximum.accumulate(np.where(repeated, 0, run)) if len(low) > 1 else run
    same[order[1:]] = np.where(repeated, run - start, 0)
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
