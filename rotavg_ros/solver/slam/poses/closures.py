"""What is known of closures while poses are estimated: by all else, by rotations alone, and of which class they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra.small_matrices import eigh, inverse_root
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.slam.noise.exceedance import exceedance
from rotavg_ros.solver.slam.noise.repeats import Near, places_near
from rotavg_ros.solver.slam.posterior.densities import log_half_turn

# Classes of good closures come first.
GOOD = 2
# The class of those that join the same wrong places as another one does, from the end.
REPEATS = -2
# What does not pull, in what it would: the system stays solvable.
NOTHING = 1e-8
# Two judge a closure's place otherwise if its chances to be right differ by this.
_OTHERWISE = 0.5
# In which errors are longer than a limit: in a plane, too, where that is a little too often.
_DIMENSIONS = 3
# Predicted to less than this share of what is known of anything.
_TOLD = 0.5
# rad² per component of a turn about which nothing is known.
ANYHOW = np.pi**2 / 3
# Closures detected before (and after) one that it is compared with.
_WINDOW = 48


@dataclass(frozen=True)
class Predictions:
    """What all else says of C closures' residuals.

    Attributes:
        mean: ``(C, k + m)`` μ, rad and metres.
        covariance: ``(C, k + m, k + m)`` P.
    """

    mean: np.ndarray
    covariance: np.ndarray

    def within(self, turns: int, turn: float, shift: np.ndarray) -> Predictions:
        """With what holds of any closure: that nothing is turned, or farther off, than can be.

        Where a closure alone joins two robots, nothing else predicts it, and the density of a good one would vanish.

        Args:
            turns: k.
            turn: variance per component a priori, rad², about what the closure says.
            shift: ``(C,)`` m², likewise.
        """
        spread = np.diagonal(self.covariance, axis1=1, axis2=2)
        # V / (p + V), of turns and of shifts by themselves: nothing absurd of the one gets into the other.
        share = np.empty_like(self.mean)
        share[:, :turns] = (turn / (spread[:, :turns].mean(axis=1) + turn))[:, None]
        share[:, turns:] = (shift / (spread[:, turns:].mean(axis=1) + shift))[:, None]
        root = np.sqrt(share)
        return Predictions(share * self.mean, root[:, :, None] * self.covariance * root[:, None, :])

    def tell(self, turns: int, extent: float) -> np.ndarray:
        """``(C,)`` bool, whether turns and shifts are predicted to less than half the variance of any at all.

        Args:
            turns: k.
            extent: m² per component, of places on the map.
        """
        spread = np.diagonal(self.covariance, axis1=1, axis2=2)
        turn, shift = spread[:, :turns].mean(axis=1), spread[:, turns:].mean(axis=1)
        return np.asarray((turn < _TOLD * ANYHOW) & (shift < _TOLD * extent))


@dataclass(frozen=True)
class Told:
    """What rotations alone say of C closures.

    Attributes:
        rotation_variance: ``(C,)`` rad² per component, of a good one's turn.
        false_odds: ``(C,)`` nats: density of the turn if it is false, and how likely that is beforehand.
        is_known: ``(C,)`` bool, whether a translation is stated.
        label: ``(C,)`` +1 if somebody has accepted it, −1 if rejected, 0 else.
        run: ``(C,)`` number of its run.
        follows: ``(C,)`` the closure before each, or -1.
        sign: ``(C,)`` +1 where it runs from its older to its newer end, else −1.
        detection, detected: ``(C,)`` closures in the order in which they were detected, and when each was, as a rank.
    """

    rotation_variance: np.ndarray
    false_odds: np.ndarray
    is_known: np.ndarray
    label: np.ndarray
    run: np.ndarray
    follows: np.ndarray
    sign: np.ndarray
    detection: np.ndarray
    detected: np.ndarray

    def detected_near(self, rows: np.ndarray, tells: np.ndarray, *, in_order: bool) -> Near:
        """Some closures with those that were detected not long before, or after, among others; never with themselves.

        Args:
            rows: ``(n,)`` the closures.
            tells: the others, in the order of their detection.
            in_order: those before alone.
        """
        is_one = None if in_order else np.isin(rows, tells)
        return Near(rows, tells, places_near(self.detected[tells], self.detected[rows], is_one, _WINDOW))


@dataclass(frozen=True)
class Places:
    """Of C closures and J classes of translations (good ones first).

    Attributes:
        chance: ``(J + 1, C)`` of each class; the last is a false rotation.
        weight: ``(C,)`` m⁻², with which each translation pulls.
        rotation_weight: ``(C,)`` rad⁻², likewise.
        squares, freedom: ``(3,)`` sums over good closures for the variances of their turns, of their translations
            whatever their length, and of what goes with that, in those.
        log_density: ``(C,)`` nats, of each with its classes summed over.
        error, error_variance: ``(J + 1, C)`` m and m² per component, of ε in each class, the last of a false rotation:
            length of its mean, and variance.
    """

    chance: np.ndarray
    weight: np.ndarray
    rotation_weight: np.ndarray
    squares: np.ndarray
    freedom: np.ndarray
    log_density: np.ndarray
    error: np.ndarray
    error_variance: np.ndarray

    @property
    def right(self) -> np.ndarray:
        """``(C,)`` probability that a closure joins the right places by the right rotation."""
        return np.asarray(self.chance[:GOOD].sum(axis=0))

    def is_like(self, other: Places) -> bool:
        """Whether the same closures join right places."""
        return bool((np.abs(self.right - other.right) < _OTHERWISE).all())

    @property
    def rotation_good(self) -> np.ndarray:
        """``(C,)`` probability that a closure's rotation is no false one."""
        return np.asarray(1 - self.chance[-1])

    def beyond(self, metres: float) -> np.ndarray:
        """``(J + 1, C)`` probability that a translation errs by more than some metres, in each class."""
        pairs = zip(self.error, self.error_variance, strict=True)
        return np.array([exceedance(length, variance, metres, _DIMENSIONS) for length, variance in pairs])


@dataclass(frozen=True)
class Scale:
    """How far C closures err, m² per component.

    Attributes:
        good: ``(C,)`` each, if it is good.
        own: ``(C,)`` what of that it does not share with its run.
        floor_share: ``(C,)`` the share of its own which does not go with its length.
        extent: how far two places of the map are apart.
        anywhere: ``(C,)`` how far a wrong one leads: to any place of the map, or as far as it states.
    """

    good: np.ndarray
    own: np.ndarray
    floor_share: np.ndarray
    extent: float
    anywhere: np.ndarray

    @cached_property
    def closure(self) -> float:
        """A typical good one."""
        return float(np.median(self.good)) if len(self.good) else self.extent


@dataclass(frozen=True)
class GivenTurn:
    """What all else and a closure's turn say of its shift, along axes of their own.

    Attributes:
        log_turn: ``(C,)`` nats, of the turn.
        square: ``(C,)`` of the turn in standard deviations.
        along: ``(C, m)`` metres, mean.
        spread: ``(C, m)`` m², variance.
    """

    log_turn: np.ndarray
    square: np.ndarray
    along: np.ndarray
    spread: np.ndarray


def given_turn(predictions: Predictions, variance: np.ndarray, turns: int) -> GivenTurn:
    """With the variance ``(C,)`` of the turn's own noise, rad²."""
    k, mean, covariance = turns, predictions.mean, predictions.covariance
    turn = covariance[:, :k, :k] + variance[:, None, None] * np.eye(k)
    root = inverse_root(turn)
    whitened, across = np.matmul(root, mean[:, :k, None]), np.matmul(root, covariance[:, :k, k:])
    explained = across.transpose(0, 2, 1)
    log_turn = np.log(np.diagonal(root, axis1=1, axis2=2) / np.sqrt(2 * np.pi)).sum(axis=1)
    square = (whitened[:, :, 0] ** 2).sum(axis=1)
    given = mean[:, k:] - np.matmul(explained, whitened)[:, :, 0]
    spread, axes = eigh(covariance[:, k:, k:] - np.matmul(explained, across))
    return GivenTurn(
        log_turn - square / 2,
        square,
        np.matmul(axes.transpose(0, 2, 1), given[:, :, None])[:, :, 0],
        np.maximum(spread, 0.0),
    )


def along_axes(predictions: Predictions, turns: int) -> tuple[np.ndarray, np.ndarray]:
    """``(C, m)`` metres and m² of shifts along the axes of their covariances, whatever the turns."""
    spread, axes = eigh(predictions.covariance[:, turns:, turns:])
    along = np.matmul(axes.transpose(0, 2, 1), predictions.mean[:, turns:, None])[:, :, 0]
    return along, np.maximum(spread, 0.0)


def log_from_behind(predictions: Predictions, variance: np.ndarray, turns: int) -> np.ndarray:
    """``(C,)`` nats, of turns that are half a turn off but for noise of ``variance`` ``(C,)`` rad²."""
    spread = np.trace(predictions.covariance[:, :turns, :turns], axis1=1, axis2=2) / turns
    angle = np.minimum(np.sqrt((predictions.mean[:, :turns] ** 2).sum(axis=1)), np.pi)
    return log_half_turn(angle, variance + spread, turns)
