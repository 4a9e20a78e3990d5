"""Where along its odometry a robot may slip so that good loop closures can tell where it did.

Two places that the same closures span are one place to them: a slip at the one and a slip at the other agree with
all of them, and differ in how the map lies in between. So where a slip can be told, the sets of closures differ.
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
        max_stretch: steps between the neighbouring ends of good closures that contain it, at most.
        min_across: good closures that span it, at least.
        min_difference: good closures that span either it or another step, but not both, at least; for every other step
            that lies more than ``max_stretch`` steps away. If one slip is moved to another such place, with whatever
            turn, this many good closures at least contradict it. (Nothing is said of several slips moved at once.)
    """

    max_stretch: int = 3
    min_across: int = 2
    min_difference: int = 0


# Two good closures across, which may be the same that span other places.
CROSSED = SlipRule()
# A slip is about as rare as two false closures. So two more contradict whoever overlooks this one, or moves it to
# another place, even where another slip is already.
LOCATABLE = SlipRule(min_across=4, min_difference=4)


def slip_places(first: IntArray, last: IntArray, num_nodes: int, rule: SlipRule) -> BoolArray:
    """``(N,)`` bool: whether step k, from node k to node k + 1, qualifies; never the last, which leads nowhere.

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
    # A closure that spans both counts off one that counts for spanning this one.
    sign = np.where(spans, -1, 1)
    change = np.bincount(first, sign, num_nodes) - np.bincount(last, sign, num_nodes)
    return np.asarray(np.rint(spans.sum() + np.cumsum(change)[:-1]), dtype=np.int64)
