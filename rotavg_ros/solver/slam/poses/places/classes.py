"""The classes of a closure's error ε, and what all else says of it if it is of each.

Translations of good closures err by their noise, or are in its tails; those that join wrong places lead anywhere, at
one of a few scales, or to where another one's do. One class more has a false rotation, whose place nothing is known of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.slam.poses.closures import GOOD, Predictions, Scale, Told, along_axes, given_turn
from rotavg_ros.solver.slam.poses.priors import PlacePriors

# Classes of wrong places of their own; one more repeats another's.
WRONG = 6
ELSEWHERE = WRONG + 1
# All classes, those of false rotations last.
CLASSES = GOOD + ELSEWHERE + 1
# Those that are wrong by themselves.
BY_ITSELF = slice(GOOD, GOOD + WRONG)
# Nobody calls a place alike that is seen turned by more standard deviations than this.
_FARTHEST = 3.0


@dataclass(frozen=True)
class Said:
    """What all else says of C closures, if they are of each of J classes of translations.

    Attributes:
        predictions: turns and shifts, whatever their class.
        turns: k.
        scale: of errors.
        turned: ``(2, C)`` rad² per component, variances of turns of good ones and of wrong places seen nearly alike.
        variance: ``(J, C)`` m² per component, of ε.
        log_turn: ``(J, C)`` nats, of turns.
        along, spread: ``(J, C, m)`` metres and m², of shifts given turns, along axes of their own.
        anywhere: ``(C, m)`` metres and m² of shifts whatever the turns, likewise.
    """

    predictions: Predictions
    turns: int
    scale: Scale
    turned: np.ndarray
    variance: np.ndarray
    log_turn: np.ndarray
    along: np.ndarray
    spread: np.ndarray
    anywhere: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(cls, predictions: Predictions, told: Told, turns: int, scale: Scale, priors: PlacePriors) -> Said:
        """Under one choice of noise."""
        turned = np.stack((told.rotation_variance, told.rotation_variance + np.radians(priors.turned_deg) ** 2))
        here, elsewhere = (given_turn(predictions, variance, turns) for variance in turned)
        spread = np.stack([here.spread] * GOOD + [elsewhere.spread] * ELSEWHERE)
        along = np.stack([here.along] * GOOD + [elsewhere.along] * ELSEWHERE)
        # Turn and shift of a repeat are those of the one that it repeats, which is seen nearly at the right angle.
        repeats = -np.maximum(elsewhere.square - _FARTHEST**2, 0.0) / 2
        log_turn = np.stack([here.log_turn] * GOOD + [elsewhere.log_turn] * WRONG + [repeats])
        variance = _variances(scale, priors)
        anywhere = along_axes(predictions, turns)
        return cls(predictions, turns, scale, turned, variance, log_turn, along, spread, anywhere)

    @cached_property
    def total(self) -> np.ndarray:
        """``(J, C, m)`` m², of shifts, their own errors included."""
        return np.asarray(self.spread + self.variance[:, :, None])

    @cached_property
    def log_shift(self) -> np.ndarray:
        """``(J, C)`` nats, of shifts given turns; nothing of a repeat's."""
        log_shift = log_normal(self.along, self.total)
        return np.where(np.arange(len(log_shift))[:, None] < len(log_shift) - 1, log_shift, 0.0)

    @cached_property
    def log_anywhere(self) -> np.ndarray:
        """``(C,)`` nats, of shifts that lead anywhere on the map."""
        along, spread = self.anywhere
        return log_normal(along, spread + self.scale.anywhere[:, None])

    @cached_property
    def log_in_place(self) -> np.ndarray:
        """``(C,)`` nats, of shifts at the right place, whatever the turns."""
        along, spread = self.anywhere
        return log_normal(along, spread + self.scale.own[:, None])

    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """``(J + 1, C)`` metres and m² per component: length of ε's mean, and its variance.

        A false rotation may be anywhere, whatever its turn says.
        """
        along, spread = (
            np.concatenate((of_classes, anywhere[None]))
            for of_classes, anywhere in zip((self.along, self.spread), self.anywhere, strict=True)
        )
        variance = np.concatenate((self.variance, self.scale.anywhere[None]))[:, :, None]
        total = spread + variance
        mean, shrunk = variance * along / total, variance * spread / total
        return np.sqrt(over_components(mean**2)), over_components(shrunk) / shrunk.shape[2]


def _variances(scale: Scale, priors: PlacePriors) -> np.ndarray:
    """``(J, C)`` m² per component: of wrong places from the least that they are off by to the farthest."""
    good = scale.own * np.array([[1.0], [priors.tail_ratio]])
    least = min(priors.least_wrong**2 * scale.closure, scale.extent)
    wrong = scale.anywhere * (least / scale.anywhere) ** np.linspace(1.0, 0.0, WRONG)[:, None]
    return np.concatenate((good, wrong, scale.anywhere[None]))


def log_normal(off: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """``(…,)`` nats of ``(…, m)`` under normal densities with these variances."""
    return -over_components(off**2 / variance + np.log(2 * np.pi * variance)) / 2


def over_components(value: np.ndarray) -> np.ndarray:
    """``(…,)`` sums of ``(…, m)``: over a last axis that is short, einsum takes a third of what NumPy's sums do."""
    return np.asarray(np.einsum("...m->...", value))


def log_sum(logarithms: np.ndarray) -> np.ndarray:
    """``(n,)`` log of sums over the first axis, of numbers that are finite."""
    largest = logarithms.max(axis=0)
    return np.asarray(largest + np.log(np.exp(logarithms - largest).sum(axis=0)))
