"""How many of the closures that came together are good, told by how many an answer explains that they are no part of.

An answer that errs by 5° explains one in fourteen random rotations about a fixed axis. So that a closure is explained
says little by itself. Of n closures that came together a share π is good. The residual r of each has the log-odds
l = log p(r | good) − log p(r | any rotation). The likelihood of π is Π (π exp(l) + 1 − π), and a closure is good with
the log-odds l + log π − log (1 − π): where no more are explained than by chance, π is small, and none is.

Good closures come beside each other, random ones anywhere. So how near a closure is to one that is believed, to a power
of two in steps, tells as well: by how often believed ones are as near to others of them, and unlikely ones are. Whoever
is nearer is no less likely, though a front end may tell of every tenth keyframe only.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

# So many good and false closures the prior of the share counts for, a Beta density: the solver's, by a test.
GOOD, FALSE = 3.0, 1.0
# Closures are beside each other whose ends are so many steps of odometry apart at most, both summed: the solver's, by a
# test.
GAP = 30.0
# Within 1, 2, 4, 8, 16 and 32 steps, and beyond.
_NEARNESSES = 7
# Beyond it nothing changes in double precision.
_CERTAIN = 30.0
_BISECTIONS = 30


@dataclass
class Arrivals:
    """Of a growing graph's first m edges, which came together, and what was told of them before they were solved.

    Those that came at the newest keyframes, where a robot that drives on finds closures, have a share of their own.

    Attributes:
        group: ``(m,)`` number of those that came together, 2 i or, at the newest keyframes, 2 i + 1; -1 of odometry.
        log_odds: ``(m,)`` nats, of a good closure to any rotation anywhere, by the last answer that each was no part
            of; NaN where nobody asked. What has entered keeps it: it cannot bear itself out.
        beside: ``(m,)`` how near to a believed one each was when it was looked at last (:func:`beside`).
    """

    group: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    log_odds: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    beside: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def forget(self) -> None:
        """After a compaction all that is there counts as come together."""
        self.group, self.log_odds = np.zeros(0, dtype=np.int64), np.zeros(0)
        self.beside = np.zeros(0, dtype=np.int64)

    def take(self, is_closure: NDArray[np.bool_], at_newest: NDArray[np.bool_]) -> None:
        """All M edges, which are closures and which are at the newest keyframes: those that are new came together."""
        known = len(self.group)
        first = 2 * (self.group.max(initial=-1) // 2 + 1)
        self.group = np.append(self.group, np.where(is_closure, first + at_newest, -1)[known:])
        self.log_odds = np.append(self.log_odds, np.full(len(is_closure) - known, np.nan))
        self.beside = np.append(self.beside, np.zeros(len(is_closure) - known, dtype=np.int64))

    def num_together(self, closures: NDArray[np.int64]) -> NDArray[np.int64]:
        """``(K,)`` with how many others each of these closures came, itself among them, at whatever keyframes."""
        arrival = self.group // 2
        return np.asarray(np.bincount(arrival + 1)[arrival[closures] + 1])

    def are_open(self, closures: NDArray[np.int64], log_odds: NDArray[np.float64]) -> NDArray[np.bool_]:
        """``(K,)`` of which it matters how near they are to believed ones: new ones, and those that may be good at all.

        What no share makes good is counted where it was when it came.
        """
        return np.isnan(self.log_odds[closures]) | (log_odds > -_CERTAIN)

    def prior_log_odds(
        self, closures: NDArray[np.int64], log_odds: NDArray[np.float64], believed: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """``(K,)`` nats, log π − log (1 − π) of those that each closure came with, and what its nearness tells.

        A robot that drives on finds closures where nobody was: of those at the newest keyframes nearness tells nothing.

        Args:
            closures: ``(K,)`` edges that wait.
            log_odds: ``(K,)`` nats, what their residuals tell of them now.
            believed: ``(B,)`` how near those that are believed are to others of these (:func:`beside`).
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
    """``(K,)`` how near each closure is to one that is believed: 0 within a step, then 2, 4, … up to :data:`GAP`.

    Args:
        asked, believed: ``(K, 2)``, ``(B, 2)`` ends along the odometry, steps, in any order; chains lie far apart.
        is_one: those that are asked are among them, and near to none by being one.
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

    Of B believed ones n have it, Poisson with mean ρ B q, q its share of unlikely ones. With ρ ~ Exp(1) beforehand, as
    if it told nothing, ρ is (n + 1) / (B q + 1) in the mean. Nobody nearer has less.
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
        log_odds: ``(K,)`` nats, of each to be good, both as likely before.
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
