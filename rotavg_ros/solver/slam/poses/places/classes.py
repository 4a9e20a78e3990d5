"""The classes of a closure's error ε, and its densities in each class given the predictions by all else.

Translations of good closures have normal noise or are in its tails. Those that join wrong places lead anywhere, at one
of a few scales, or to the same places as another one. A further class has a false rotation and an unknown place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.slam.poses.closures import GOOD, Predictions, Scale, Told, along_axes, given_turn
from rotavg_ros.solver.slam.poses.priors import PlacePriors

# Number of classes of wrong places of their own; one more repeats another closure's.
WRONG = 6
ELSEWHERE = WRONG + 1
# Number of all classes, with false rotations last.
CLASSES = GOOD + ELSEWHERE + 1
# The classes that are wrong independently.
BY_ITSELF = slice(GOOD, GOOD + WRONG)
# A place that is seen turned by more standard deviations than this does not look alike.
_FARTHEST = 3.0


@dataclass(frozen=True)
class Said:
    """Densities of C closures in each of J classes of translations, given the predictions by all else.

    Attributes:
        predictions: predicted turns and shifts, as good closures are judged.
        turns: k.
        scale: scales of errors.
        turned: ``(2, C)`` rad² per component, variances of turns of good ones and of wrong places seen nearly alike.
        variance: ``(J, C)`` m² per component, of ε.
        log_turn: ``(J, C)`` nats, log densities of turns.
        along, spread: ``(J, C, m)`` metres and m², mean and variance of shifts given turns, along principal axes; for
            good closures of even shifts.
        axes: ``(C, m, m)`` those axes of even shifts, in columns.
        anywhere: ``(C, m)`` metres and m² of shifts, marginal over turns, likewise.
        is_told: ``(C,)`` bool, whether anything that may be right predicts them.
        untold: ``(C,)`` number of closures between the same chains that nothing predicts, at least 1.
    """

    predictions: Predictions
    turns: int
    scale: Scale
    turned: np.ndarray
    variance: np.ndarray
    log_turn: np.ndarray
    along: np.ndarray
    spread: np.ndarray
    axes: np.ndarray
    anywhere: tuple[np.ndarray, np.ndarray]
    is_told: np.ndarray
    untold: np.ndarray

    @classmethod
    def of(
        cls, predictions: Predictions, told: Told, is_joined: np.ndarray, turns: int, scale: Scale, priors: PlacePriors
    ) -> Said:
        """Under one choice of noise.

        Args:
            predictions: by all else.
            told: results of rotations alone.
            is_joined: ``(C,)`` bool, whether right closures join the chains at each one's ends. What wrong ones say of
                a chain's place tells nothing of each other: the errors of two would be opposite for that alone.
            turns: k.
            scale: scales of errors.
            priors: prior parameters of places.
        """
        turned = np.stack((told.rotation_variance, told.rotation_variance + np.radians(priors.turned_deg) ** 2))
        here = given_turn(predictions.even(scale.shape.even), turned[0], turns)
        elsewhere = given_turn(predictions.wrong, turned[1], turns)
        spread = np.stack([here.spread] * GOOD + [elsewhere.spread] * ELSEWHERE)
        along = np.stack([here.along] * GOOD + [elsewhere.along] * ELSEWHERE)
        # A repeat has the turn and shift of the closure that it repeats, which is seen nearly at the right angle.
        repeats = -np.maximum(elsewhere.square - _FARTHEST**2, 0.0) / 2
        log_turn = np.stack([here.log_turn] * GOOD + [elsewhere.log_turn] * WRONG + [repeats])
        variance = _variances(scale, priors)
        anywhere, is_told = along_axes(predictions.wrong, turns), predictions.tell(turns, scale.extent) & is_joined
        shifts, untold = (along, spread, here.axes, anywhere), np.maximum(told.alike_in(told.is_known & ~is_told), 1)
        return cls(predictions, turns, scale, turned, variance, log_turn, *shifts, is_told, untold)

    @cached_property
    def total(self) -> np.ndarray:
        """``(J, C, m)`` m², variances of shifts including their own errors."""
        return np.asarray(self.spread + self.variance[:, :, None])

    @cached_property
    def log_shift(self) -> np.ndarray:
        """``(J, C)`` nats, log densities of shifts given turns; 0 for repeats."""
        log_shift = log_normal(self.along, self.total)
        return np.where(np.arange(len(log_shift))[:, None] < len(log_shift) - 1, log_shift, 0.0)

    @cached_property
    def log_anywhere(self) -> np.ndarray:
        """``(C,)`` nats, log densities of shifts that lead anywhere on the map.

        The geometric mean of a normal density over its own values, wherever the ends lie. Itself it would draw together
        what false closures join at random, since all of these are shorter then.
        """
        components = self.anywhere[0].shape[1]
        return np.asarray(-(np.log(2 * np.pi * self.scale.anywhere) + 1) * components / 2)

    @cached_property
    def log_in_place(self) -> np.ndarray:
        """``(C,)`` nats, log densities of shifts at the right place, marginal over turns.

        Where nothing tells of that place, any of them may be the one that is there, wherever that is.
        """
        along, spread = self.anywhere
        unknown = self.log_anywhere - np.log(self.untold)
        return np.where(self.is_told, log_normal(along, spread + self.scale.own[:, None]), unknown)

    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """``(J + 1, C)`` metres and m² per component: length of ε's mean, and its variance.

        A closure with a false rotation may be anywhere, independent of its turn.
        """
        along, spread = (
            np.concatenate((of_classes, anywhere[None]))
            for of_classes, anywhere in zip((self.along, self.spread), self.anywhere, strict=True)
        )
        variance = np.concatenate((self.variance, self.scale.anywhere[None]))[:, :, None]
        total = spread + variance
        mean, shrunk = variance * along / total, variance * spread / total
        back = np.matmul(self.scale.shape.uneven, self.axes)
        mean[:GOOD] = np.matmul(back, mean[:GOOD, :, :, None])[:, :, :, 0]
        shrunk[:GOOD] = np.matmul(back**2, shrunk[:GOOD, :, :, None])[:, :, :, 0]
        return np.sqrt(over_components(mean**2)), over_components(shrunk) / shrunk.shape[2]


def _variances(scale: Scale, priors: PlacePriors) -> np.ndarray:
    """``(J, C)`` m² per component; those of wrong places range from the least error to the largest."""
    good = scale.own * np.array([[1.0], [priors.tail_ratio]])
    least = min(priors.least_wrong**2 * scale.closure, scale.extent)
    wrong = scale.anywhere * (least / scale.anywhere) ** np.linspace(1.0, 0.0, WRONG)[:, None]
    return np.concatenate((good, wrong, scale.anywhere[None]))


def log_normal(off: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """``(…,)`` nats, log normal densities of ``(…, m)`` with these variances."""
    return -over_components(off**2 / variance + np.log(2 * np.pi * variance)) / 2


def over_components(value: np.ndarray) -> np.ndarray:
    """``(…,)`` sums of ``(…, m)``: over a short last axis, einsum takes a third of the time of NumPy's sum."""
    return np.asarray(np.einsum("...m->...", value))


def log_sum(logarithms: np.ndarray) -> np.ndarray:
    """``(n,)`` log-sum-exp over the first axis, for finite numbers."""
    largest = logarithms.max(axis=0)
    return np.asarray(largest + np.log(np.exp(logarithms - largest).sum(axis=0)))
