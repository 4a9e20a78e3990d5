"""How many of the closures that came together are good, judged by how many an answer without them explains.

An answer that errs by 5° explains one in fourteen random rotations about a fixed axis. So the fact that a closure is
explained says little by itself. Of n closures that came together a share π is good. The residual r of each has log-odds
l = log p(r | good) − log p(r | any rotation). The likelihood of π is Π (π exp(l) + 1 − π), and a closure is good with
the log-odds l + log π − log (1 − π). Where no more are explained than by chance, π is small, and none is good.

Good closures lie beside each other, random ones anywhere. So the distance from a closure to the nearest believed one,
in steps rounded to a power of two, is evidence as well: it is compared with how often believed closures, and unlikely
ones, are as near to other believed ones. A nearer closure is never less likely than one farther away, even if a front
end reports only every tenth keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

# Numbers of good and false closures that the Beta prior of the share counts for. Equal to the solver's; a test checks.
GOOD, FALSE = 3.0, 1.0
# Closures lie beside each other if their ends are at most this many odometry steps apart, summed over both ends. Equal
# to the solver's; a test checks.
GAP = 30.0
# Number of classes of nearness: within 1, 2, 4, 8, 16 and 32 steps, and beyond.
_NEARNESSES = 7
# Nats; beyond it nothing changes in double precision.
_CERTAIN = 30.0
_BISECTIONS = 30


@dataclass
class Arrivals:
    """Which of a growing graph's first m edges came together, and the evidence about each before it was solved.

    Those at the newest keyframes, where a robot that drives on finds closures, have a share of their own.

    Attributes:
        group: ``(m,)`` number of the group that came together: 2 i, or 2 i + 1 at the newest keyframes; -1: odometry.
        log_odds: ``(m,)`` nats, of a good closure against any rotation anywhere, by the last answer without this
            closure; NaN where it was never computed. A closure that has entered keeps its value, since an answer that
            contains it would confirm it.
        beside: ``(m,)`` how near each was to a believed one when last looked at (:func:`beside`).
    """

    group: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    log_odds: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    beside: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def forget(self) -> None:
        """After a compaction, all edges that are left count as having come together."""
        self.group, self.log_odds = np.zeros(0, dtype=np.int64), np.zeros(0)
        self.beside = np.zeros(0, dtype=np.int64)

    def take(self, is_closure: NDArray[np.bool_], at_newest: NDArray[np.bool_]) -> None:
        """Note which of all M edges are closures, and which at the newest keyframes; the new ones came together."""
        known = len(self.group)
        first = 2 * (self.group.max(initial=-1) // 2 + 1)
        self.group = np.append(self.group, np.where(is_closure, first + at_newest, -1)[known:])
        self.log_odds = np.append(self.log_odds, np.full(len(is_closure) - known, np.nan))
        self.beside = np.append(self.beside, np.zeros(len(is_closure) - known, dtype=np.int64))

    def num_together(self, closures: NDArray[np.int64]) -> NDArray[np.int64]:
        """``(K,)`` how many closures came together with each of these, itself included, at whatever keyframes."""
        arrival = self.group // 2
        return np.asarray(np.bincount(arrival + 1)[arrival[closures] + 1])

    def are_open(self, closures: NDArray[np.int64], log_odds: NDArray[np.float64]) -> NDArray[np.bool_]:
        """``(K,)`` whose nearness to believed ones matters: new ones, and those that may be good at all.

        Those that no share could make good keep the nearness that they had when they came.
        """
        return np.isnan(self.log_odds[closures]) | (log_odds > -_CERTAIN)

    def prior_log_odds(
        self, closures: NDArray[np.int64], log_odds: NDArray[np.float64], believed: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """``(K,)`` nats, log π − log (1 − π) of each closure's group, plus the evidence from its nearness.

        A robot that drives on finds closures in new places, so at the newest keyframes nearness is no evidence.

        Args:
            closures: ``(K,)`` edges that wait.
            log_odds: ``(K,)`` nats, the present evidence from their residuals.
            believed: ``(B,)`` how near each believed closure is to another believed one (:func:`beside`).
        """
        nearness = self.beside[closures]
        ratio = _log_ratio(believed, nearness[log_odds < 0])
        told = np.where(self.group[closures] % 2 == 0, ratio[nearness], 0.0)
        self.log_odds[closures] = log_odds + told
        asked = np.flatnonzero(np.isfinite(self.log_odds))
        _, group = np.unique(self.group[asked], return_inverse=True)
        of_edge = np.full(len(self.group), np.nan)
        of_edge[asked] = log_odds_of_share(self.log_odds[asked], group)[group]
        return np.asarray(of_edge[closures] + told)


def beside(asked: NDArray[np.float64], believed: NDArray[np.float64], *, is_one: bool = False) -> NDArray[np.int64]:
    """``(K,)`` how near each closure is to a believed one: 0 within a step, 1 within 2, 2 within 4, up to :data:`GAP`.

    Args:
        asked, believed: ``(K, 2)``, ``(B, 2)`` ends along the odometry, steps, in any order; chains lie far apart.
        is_one: the asked closures are believed ones themselves; the distance to itself does not count.
    """
    from scipy.spatial import KDTree  # loaded once a flood comes

    nearest = np.full(len(asked), np.inf)
    if len(believed) and len(asked):
        tree = KDTree(np.sort(believed, axis=1))
        nearest, _ = tree.query(np.sort(asked, axis=1), k=[2 if is_one else 1], p=1, distance_upper_bound=GAP)
        nearest = nearest[:, 0]
    return np.asarray(np.ceil(np.log2(np.clip(nearest, 1.0, 2 * GAP))), dtype=np.int64)


def _log_ratio(believed: NDArray[np.int64], unlikely: NDArray[np.int64]) -> NDArray[np.float64]:
    """``(7,)`` nats, how much more common each nearness is among good closures than among random ones.

    Of B believed closures, n have this nearness: Poisson with mean ρ B q, where q is its share among unlikely ones.
    With the prior ρ ~ Exp(1), whose mean says that nearness is no evidence, the posterior mean of ρ is
    (n + 1) / (B q + 1). The result never increases with the distance.
    """
    count = np.bincount(believed, minlength=_NEARNESSES)
    share = (np.bincount(unlikely, minlength=_NEARNESSES) + 1) / (len(unlikely) + _NEARNESSES)
    ratio = np.log((count + 1) / (len(believed) * share + 1))
    return np.asarray(np.maximum.accumulate(ratio[::-1])[::-1])


def log_odds_of_share(log_odds: NDArray[np.float64], group: NDArray[np.int64]) -> NDArray[np.float64]:
    """``(G,)`` nats, the likeliest log π − log (1 − π) of each group.

    Its log-posterior has one maximum, where π = (Σ p + :data:`GOOD`) / (n + :data:`GOOD` + :data:`FALSE`), p the
    probability that each is good. It is found by bisection.

    Args:
        log_odds: ``(K,)`` nats, of each being good, with even prior odds.
        group: ``(K,)`` from 0 to G - 1.
    """
    count = np.bincount(group) + GOOD + FALSE
    low, high = np.full((2, len(count)), _CERTAIN) * [[-1], [1]]
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        good = np.bincount(group, _probability(log_odds + middle[group]), len(count)) + GOOD
        is_more = good > _probability(middle) * count
        low, high = np.where(is_more, middle, low), np.where(is_more, high, middle)
    return np.asarray((low + high) / 2)


def _probability(log_odds: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(1 / (1 + np.exp(-np.clip(log_odds, -_CERTAIN, _CERTAIN))))
