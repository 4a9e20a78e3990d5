"""Where along its odometry a robot may slip so that good loop closures can locate the slip.

Closures cannot distinguish two places that they all span: a slip at either place agrees with all of them, and only the
map in between differs. So a slip can be located only where the sets of spanning closures differ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class SlipRule:
    """Which steps of odometry qualify.

    Attributes:
        max_stretch: largest number of steps between the neighbouring ends of good closures that contain it.
        min_across: least number of good closures that span it.
        min_difference: least number of good closures that span either it or another step, but not both, for every other
            step more than ``max_stretch`` steps away. If one slip is moved to another such place, with any turn, at
            least this many good closures contradict it. (This does not cover several slips moved at once.)
    """

    max_stretch: int = 3
    min_across: int = 2
    min_difference: int = 0


# Two good closures across, which may also span other places.
CROSSED = SlipRule()
# A slip is about as improbable as two false closures. So two closures more than that contradict an answer that
# overlooks this slip or moves it to another place, even one that already has a slip.
LOCATABLE = SlipRule(min_across=4, min_difference=4)


def slip_places(first: IntArray, last: IntArray, num_nodes: int, rule: SlipRule) -> BoolArray:
    """``(N,)`` bool: whether step k, from node k to node k + 1, qualifies; the last entry, without a step, is False.

    Args:
        first, last: ``(C,)`` ends of the good closures, ``first`` < ``last``.
    """
    is_end = np.zeros(num_nodes, dtype=bool)
    is_end[first] = is_end[last] = True
    stretch = np.cumsum(is_end)
    length = np.bincount(stretch[:-1], minlength=num_nodes + 1)[stretch]
    across = np.cumsum(np.bincount(first, minlength=num_nodes) - np.bincount(last, minlength=num_nodes))
    qualifies = (length <= rule.max_stretch) & (stretch > 0) & (stretch < is_end.sum())
    qualifies &= (across >= rule.min_across) & (np.arange(num_nodes) < num_nodes - 1)
    if rule.min_difference > 0:
        for step in np.flatnonzero(qualifies):
            far = np.abs(np.arange(num_nodes - 1) - step) > rule.max_stretch
            difference = crossing_difference(first, last, num_nodes, int(step))
            qualifies[step] = (difference[far] >= rule.min_difference).all()
    return np.asarray(qualifies)


def crossing_difference(first: IntArray, last: IntArray, num_nodes: int, step: int) -> IntArray:
    """``(N - 1,)`` how many closures span either ``step`` or each other step, but not both.

    Args:
        first, last: ``(C,)`` ends of the closures, ``first`` < ``last``.
    """
    spans = (first <= step) & (step < last)
    # A closure that spans both steps is subtracted from those that span this one.
    sign = np.where(spans, -1, 1)
    change = np.bincount(first, sign, num_nodes) - np.bincount(last, sign, num_nodes)
    return np.asarray(np.rint(spans.sum() + np.cumsum(change)[:-1]), dtype=np.int64)
