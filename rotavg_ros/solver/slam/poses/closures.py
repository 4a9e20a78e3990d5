"""Data on closures while poses are estimated: predictions by all else, results of rotations alone, and classes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.algebra.small_matrices import eigh, inverse_root
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.slam.graph.chain_cuts import connected, joined_by_others
from rotavg_ros.solver.slam.noise.exceedance import exceedance
from rotavg_ros.solver.slam.noise.repeats import Near, places_near
from rotavg_ros.solver.slam.poses.even.shifts import EvenShifts
from rotavg_ros.solver.slam.posterior.densities import anyhow, log_half_turn

# Classes of good closures come first.
GOOD = 2
# Index of the class of good closures in the tails.
TAILS = 1
# Index, from the end, of the class of closures that join the same wrong places as another one.
REPEATS = -2
# Relative weight of a row that is not to pull: the system stays solvable.
NOTHING = 1e-8
# Two judgements of a closure's place differ if its probabilities of being right differ by this.
_OTHERWISE = 0.5
# Dimensions in which errors exceed a limit; used in a plane as well, where it gives slightly too high a probability.
_DIMENSIONS = 3
# A closure counts as predicted if the variance is less than this share of the uninformed one.
_TOLD = 0.5
# Variance of the normal density whose value at zero is the geometric mean of another one over its own values, in units
# of that one's variance: shifts of which nothing is known are as likely wherever they lead.
ANYWHERE = np.e


@dataclass(frozen=True)
class Predictions:
    """Predictions of C closures' residuals by all else, with even turns.

    Attributes:
        mean: ``(C, k + m)`` μ, rad and metres.
        covariance: ``(C, k + m, k + m)`` P.
        of_wrong: those of wrong closures, if they are others (:meth:`bounded`).
    """

    mean: np.ndarray
    covariance: np.ndarray
    of_wrong: Predictions | None = None

    @property
    def wrong(self) -> Predictions:
        """The predictions by which wrong closures are judged."""
        return self if self.of_wrong is None else self.of_wrong

    def turn(self, uneven: np.ndarray) -> np.ndarray:
        """``(C, k)`` rad, mean turns, given the maps ``(C, k, k)`` from even turns."""
        return np.asarray(np.matmul(uneven, self.mean[:, : uneven.shape[1], None])[:, :, 0])

    def bounded(self, turns: int, turn: float, shift: np.ndarray, within_chain: np.ndarray) -> Predictions:
        """The predictions combined with the prior bounds on turns and shifts.

        If a closure alone joins two robots, nothing else predicts it, and the density of a good one would vanish.

        Wrong closures are judged without what is unknown of where chains of odometry lie as wholes. All between two
        chains share that error: it says nothing of whether they agree; and integrated for each of them alone, it would
        make any number of them fit a chain whose place is unknown.

        Args:
            turns: k.
            turn: prior variance per component, rad², about the closure's own value.
            shift: ``(C,)`` m², likewise.
            within_chain: ``(C,)`` bool, closures whose ends odometry joins.
        """
        spread = np.diagonal(self.covariance, axis1=1, axis2=2)
        # V / (p + V), separately for turns and for shifts, so that absurd values of one do not affect the other.
        share = np.empty_like(self.mean)
        share[:, :turns] = (turn / (spread[:, :turns].mean(axis=1) + turn))[:, None]
        share[:, turns:] = (shift / (spread[:, turns:].mean(axis=1) + shift))[:, None]
        bounded = Predictions(share * self.mean, _scaled(self.covariance, share))
        return replace(bounded, of_wrong=self._of_parts(bounded, turns, within_chain, share.min(axis=1) > _TOLD))

    def _of_parts(self, bounded: Predictions, turns: int, within: np.ndarray, is_told: np.ndarray) -> Predictions:
        """The predictions with parts of all chains as uncertain as of those that closures ``within`` chains tell of.

        What nothing predicts, because its prior bound is smaller, is as ``bounded``.
        """
        if within.all() or not within.any():
            return bounded
        spread = np.diagonal(self.covariance, axis1=1, axis2=2)
        share = np.empty_like(spread)
        for part in (slice(turns), slice(turns, None)):
            variance = spread[:, part].mean(axis=1)
            share[:, part] = np.minimum(variance[within].max() / variance, 1.0)[:, None]
        covariance = np.where(is_told[:, None, None], _scaled(self.covariance, share), bounded.covariance)
        return Predictions(np.where(is_told[:, None], self.mean, bounded.mean), covariance)

    def square_length(self, stated: np.ndarray, own: np.ndarray) -> np.ndarray:
        """``(C,)`` m², expected squared lengths of closures, given what each states and the predictions by all else.

        The length that one states will not do: where its error is larger than its length, it would explain itself.

        Args:
            stated: ``(C, m)`` metres, stated shifts in the axes of the predictions.
            own: ``(C,)`` m² per component, variance of each as a good closure.
        """
        turns = self.mean.shape[1] - stated.shape[1]
        spread = np.trace(self.covariance[:, turns:, turns:], axis1=1, axis2=2) / stated.shape[1]
        share = own / (own + spread)
        between = stated - share[:, None] * self.mean[:, turns:]
        return np.asarray((between**2).sum(axis=1) + stated.shape[1] * share * spread)

    def square_length_known(self, stated: np.ndarray) -> np.ndarray:
        """``(C,)`` m², how much longer, squared, closures are by all else than its error would make them.

        Args:
            stated: ``(C, m)`` metres, stated shifts in the axes of the predictions.
        """
        turns = self.mean.shape[1] - stated.shape[1]
        spread = np.trace(self.covariance[:, turns:, turns:], axis1=1, axis2=2)
        return np.asarray(np.maximum(((stated - self.mean[:, turns:]) ** 2).sum(axis=1) - spread, 0.0))

    def even(self, shifts: np.ndarray) -> Predictions:
        """The predictions of even shifts, given the maps ``(C, m, m)`` from shifts to these."""
        turns = self.mean.shape[1] - shifts.shape[1]
        mean, covariance = self.mean.copy(), self.covariance.copy()
        mean[:, turns:] = np.matmul(shifts, mean[:, turns:, None])[:, :, 0]
        covariance[:, turns:] = np.matmul(shifts, covariance[:, turns:])
        covariance[:, :, turns:] = np.matmul(covariance[:, :, turns:], shifts.transpose(0, 2, 1))
        return Predictions(mean, covariance)

    def tell(self, turns: int, extent: float) -> np.ndarray:
        """``(C,)`` bool, whether turns and shifts are predicted with less than half the uninformed variance.

        Args:
            turns: k.
            extent: m² per component, variance of places on the map.
        """
        spread = np.diagonal(self.covariance, axis1=1, axis2=2)
        turn, shift = spread[:, :turns].mean(axis=1), spread[:, turns:].mean(axis=1)
        return np.asarray((turn < _TOLD * anyhow(turns)) & (shift < _TOLD * ANYWHERE * extent))


def _scaled(covariance: np.ndarray, share: np.ndarray) -> np.ndarray:
    """``(C, d, d)`` covariances with variances times ``share`` ``(C, d)`` and the same correlations."""
    root = np.sqrt(share)
    return np.asarray(root[:, :, None] * covariance * root[:, None, :])


@dataclass(frozen=True)
class Told:
    """What rotations alone say of C closures.

    Attributes:
        rotation_variance: ``(C,)`` rad² per component, of a good closure's even turn
            (:mod:`rotavg_ros.solver.slam.poses.even.turns`).
        uneven: ``(C, k, k)`` from a closure's even turn to its turn.
        false_odds: ``(C,)`` nats: log density of the turn if false, plus the prior log-odds of being false. Near misses
            have the prediction's variance added. For a labelled closure, only what that adds to the log density.
        is_known: ``(C,)`` bool, whether a translation is stated.
        label: ``(C,)`` +1 if the closure is labelled accepted, −1 if rejected, else 0.
        chains: ``(C, 2)`` numbers of the chains of odometry at its ends.
        run: ``(C,)`` number of the closure's run.
        follows: ``(C,)`` the closure before each, or -1.
        sign: ``(C,)`` +1 where the closure runs from its older to its newer end, else −1.
        detection, detected: ``(C,)`` closures in the order of their detection, and each one's rank in it.
    """

    rotation_variance: np.ndarray
    uneven: np.ndarray
    false_odds: np.ndarray
    is_known: np.ndarray
    label: np.ndarray
    chains: np.ndarray
    run: np.ndarray
    follows: np.ndarray
    sign: np.ndarray
    detection: np.ndarray
    detected: np.ndarray

    @property
    def is_within(self) -> np.ndarray:
        """``(C,)`` bool, closures whose ends odometry joins."""
        return np.asarray(self.chains[:, 0] == self.chains[:, 1])

    def joined(self, is_right: np.ndarray) -> np.ndarray:
        """``(C,)`` bool, closures whose ends odometry and other ones that are right ``(C,)`` join."""
        first, second = self.chains.T
        if self.is_within.all():
            return self.is_within
        count, right = int(self.chains.max()) + 1, np.flatnonzero(~self.is_within & is_right)
        component = connected(count, self.chains[right])
        joined = np.asarray(component[first] == component[second])
        joined[right] = joined_by_others(count, self.chains[right])
        return joined

    def alike_in(self, which: np.ndarray) -> np.ndarray:
        """``(C,)`` number of closures ``which``, ``(C,)`` bool, between the same two chains as each."""
        count = int(self.chains.max(initial=0)) + 1
        if count == 1:
            return np.full(len(which), which.sum())
        first, second = np.sort(self.chains, axis=1).T
        pair = np.unique(first * count + second, return_inverse=True)[1]
        return np.asarray(np.bincount(pair, which)[pair])

    def detected_near(self, rows: np.ndarray, tells: np.ndarray, *, in_order: bool) -> Near:
        """For some closures, those of the others detected shortly before or after them, never themselves.

        Args:
            rows: ``(n,)`` the closures.
            tells: the others, in the order of their detection.
            in_order: only those before.
        """
        is_one = None if in_order else np.isin(rows, tells)
        return Near(rows, tells, places_near(self.detected[tells], self.detected[rows], is_one))


@dataclass(frozen=True)
class Places:
    """Class probabilities and weights of C closures, with J classes of translations (good ones first).

    Attributes:
        chance: ``(J + 1, C)`` probability of each class; the last is a false rotation.
        weight: ``(C,)`` m⁻², weight of each translation.
        rotation_weight: ``(C,)`` rad⁻², likewise.
        squares, freedom: ``(2,)`` sums over good closures, in units of the respective variances: of their turns, and of
            their translations' errors that are independent of length.
        log_density: ``(C,)`` nats, of each closure, summed over its classes.
        error, error_variance: ``(J + 1, C)`` m and m² per component, of ε in each class (the last: a false rotation):
            length of its mean, and variance.
        even: ``(C, m, m)`` from shifts to the even ones that ``weight`` weighs.
        along_body: ``(2, m, m)`` squares and freedom of the latter in the body's axes.
        pulled: ``(2, C)`` m⁻², squares and freedom of each one's translation as a good closure, divided by its squared
            variance and by its variance.
    """

    chance: np.ndarray
    weight: np.ndarray
    rotation_weight: np.ndarray
    squares: np.ndarray
    freedom: np.ndarray
    log_density: np.ndarray
    error: np.ndarray
    error_variance: np.ndarray
    even: np.ndarray
    along_body: np.ndarray
    pulled: np.ndarray

    @property
    def closure_root(self) -> np.ndarray:
        """``(C, m, m)`` m⁻¹, root of the weight of each translation."""
        return np.asarray(np.sqrt(self.weight)[:, None, None] * self.even)

    @property
    def right(self) -> np.ndarray:
        """``(C,)`` probability that a closure joins the right places by the right rotation."""
        return np.asarray(self.chance[:GOOD].sum(axis=0))

    def is_like(self, other: Places, among: np.ndarray | slice = slice(None)) -> bool:
        """Whether the same closures join the right places, of all or ``among`` some of them."""
        return bool((np.abs(self.right - other.right)[among] < _OTHERWISE).all())

    def is_within(self, other: Places) -> bool:
        """Whether no closure joins the right places that does not in the others, too."""
        return bool((self.right - other.right < _OTHERWISE).all())

    @property
    def rotation_good(self) -> np.ndarray:
        """``(C,)`` probability that a closure's rotation is not false."""
        return np.asarray(1 - self.chance[-1])

    def beyond(self, metres: float) -> np.ndarray:
        """``(J + 1, C)`` probability that a translation errs by more than some metres, in each class."""
        pairs = zip(self.error, self.error_variance, strict=True)
        return np.array([exceedance(length, variance, metres, _DIMENSIONS) for length, variance in pairs])


@dataclass(frozen=True)
class Scale:
    """Scales of the errors of C closures, m² per component.

    Attributes:
        good: ``(C,)`` variance of each as a good closure.
        own: ``(C,)`` part of that which is not shared with its run.
        floor_share: ``(C,)`` share of the own part that does not grow with its length.
        extent: variance of the distance between two places of the map.
        anywhere: ``(C,)`` variance of a wrong closure: to any place of the map, or as far as it states.
        square_length: ``(C,)`` m², expected squared length of each, not per component.
        known_square: ``(C,)`` m², what of that all else knows.
        shape: shifts in units in which good closures err alike along all axes.
    """

    good: np.ndarray
    own: np.ndarray
    floor_share: np.ndarray
    extent: float
    anywhere: np.ndarray
    square_length: np.ndarray
    known_square: np.ndarray
    shape: EvenShifts

    @cached_property
    def closure(self) -> float:
        """Variance of a typical good closure."""
        return float(np.median(self.good)) if len(self.good) else self.extent

    @cached_property
    def own_closure(self) -> float:
        """The part of it that closures of a run do not share."""
        return float(np.median(self.own)) if len(self.own) else self.extent


@dataclass(frozen=True)
class GivenTurn:
    """Predictions of closures' shifts by all else, given their turns, along principal axes.

    Attributes:
        log_turn: ``(C,)`` nats, log density of the turn.
        square: ``(C,)`` squared turn, in standard deviations.
        along: ``(C, m)`` metres, mean.
        spread: ``(C, m)`` m², variance.
        axes: ``(C, m, m)`` principal axes, in columns.
    """

    log_turn: np.ndarray
    square: np.ndarray
    along: np.ndarray
    spread: np.ndarray
    axes: np.ndarray


def given_turn(predictions: Predictions, variance: np.ndarray, turns: int) -> GivenTurn:
    """The prediction given the turn, for a variance ``(C,)`` of the turn's own noise, rad²."""
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
        axes,
    )


def along_axes(predictions: Predictions, turns: int) -> tuple[np.ndarray, np.ndarray]:
    """``(C, m)`` means, metres, and variances, m², of shifts along their covariances' axes, marginal over turns."""
    spread, axes = eigh(predictions.covariance[:, turns:, turns:])
    along = np.matmul(axes.transpose(0, 2, 1), predictions.mean[:, turns:, None])[:, :, 0]
    return along, np.maximum(spread, 0.0)


def log_from_behind(predictions: Predictions, uneven: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """``(C,)`` nats, log density of turns that are half a turn off, with noise of ``variance`` ``(C,)`` rad²."""
    turns = uneven.shape[1]
    spread = np.trace(predictions.covariance[:, :turns, :turns], axis1=1, axis2=2) / turns
    angle = np.minimum(np.sqrt((predictions.turn(uneven) ** 2).sum(axis=1)), np.pi)
    return log_half_turn(angle, variance + spread, turns)
