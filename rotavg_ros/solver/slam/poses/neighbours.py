"""What closures before and after a closure, and all others, say of whether it joins wrong places, and which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.slam.poses.closures import GOOD, Told
from rotavg_ros.solver.slam.poses.priors import PlacePriors

# Squared widths of what repeats differ by, in those of two good closures.
_KERNELS = np.array([1.0, 16.0, 256.0])
# No share is less than this, or nearer to one.
_SHARE = 0.01


@dataclass(frozen=True)
class Repeats:
    """Of C closures, by the ones before and after.

    Attributes:
        chance: ``(C,)`` that such a one joins wrong places.
        alike, turned: ``(C,)`` densities of each one's shift if it is such a one's, where that is seen nearly at the
            right angle, and where not; times the chances of these.
    """

    chance: np.ndarray
    alike: np.ndarray
    turned: np.ndarray


def repeats_of(mean: np.ndarray, before: np.ndarray, told: Told, closure_variance: float, in_order: bool) -> Repeats:
    """By the closures that follow each other, if both join the same wrong place.

    Args:
        mean: ``(C, m)`` metres, what each is off by, from its older to its newer end.
        before: ``(J + 1, C)`` chances of classes.
        told: which follows which.
        closure_variance: m² per component, of good closures: of the difference of two, twice that.
        in_order: of the one before alone.
    """
    later = np.flatnonzero((told.follows >= 0) & told.is_known & told.is_known[told.follows])
    earlier = told.follows[later]
    square = ((mean[later] - mean[earlier]) ** 2).sum(axis=1)
    variance = 2 * closure_variance * _KERNELS[:, None]
    density = np.exp(-square / (2 * variance)) / (2 * np.pi * variance) ** (mean.shape[1] / 2)
    density = density.mean(axis=0)
    count = len(mean)
    ends = [(later, earlier)] if in_order else [(later, earlier), (earlier, later)]
    neighbours = np.maximum(sum(np.bincount(end, minlength=count) for end, _ in ends), 1)

    def mean_over(weight: np.ndarray, each: np.ndarray) -> np.ndarray:
        return np.asarray(sum(np.bincount(end, each * weight[other], count) for end, other in ends) / neighbours)

    alike, turned = before[GOOD:-1].sum(axis=0), before[-1]
    ones = np.ones(len(later))
    return Repeats(mean_over(alike + turned, ones), mean_over(alike, density), mean_over(turned, density))


def wrong_share(before: np.ndarray, told: Told, priors: PlacePriors) -> np.ndarray:
    """``(C,)`` how likely each is to join wrong places, by all others and by its run most (Beta, Bernoulli)."""
    wrong = before[GOOD:-1].sum(axis=0) * told.is_known
    any_one = (1 - before[-1]) * told.is_known
    overall = (wrong.sum() + priors.wrong_place) / (any_one.sum() + priors.counted)
    in_run, of_run = np.bincount(told.run, wrong)[told.run] - wrong, np.bincount(told.run, any_one)[told.run] - any_one
    return np.asarray(np.clip((overall + in_run) / (1 + of_run), _SHARE, 1 - _SHARE))
