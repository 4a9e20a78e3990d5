"""The pattern of a sparse factor, from its elimination tree (Liu 1990)."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled

_NOWHERE = -1


@compiled
def elimination_tree(begin: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parent of each unknown, and number of entries of each column of L below its diagonal.

    Args:
        begin, row: the matrix's upper triangle by columns, in the order of elimination.
    """
    size = len(begin) - 1
    above, seen, count = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int64)
    for k in range(size):
        above[k], seen[k], count[k] = _NOWHERE, k, 0
        for at in range(begin[k], begin[k + 1]):
            i = row[at]
            while seen[i] != k:
                if above[i] == _NOWHERE:
                    above[i] = k
                count[i] += 1
                seen[i] = k
                i = above[i]
    return above, count


@compiled
def factor_rows(begin: np.ndarray, row: np.ndarray, above: np.ndarray, factor_begin: np.ndarray) -> np.ndarray:
    """Rows of L's entries, ascending in each column."""
    size = len(above)
    factor_row = np.empty(factor_begin[-1], np.int32)
    free, seen = np.empty(size, np.int64), np.empty(size, np.int32)
    for k in range(size):
        free[k], seen[k] = factor_begin[k], k
        for at in range(begin[k], begin[k + 1]):
            i = row[at]
            while seen[i] != k:
                factor_row[free[i]] = k
                free[i] += 1
                seen[i] = k
                i = above[i]
    return factor_row
