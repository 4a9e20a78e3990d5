"""How a closure's translation errs: well, in tails, or because it joins wrong places; and whether its rotation does.

All of these are one mixture of normal densities of one error ε. What everything else says of a closure's residual,
N(μ, P) in k turns and m shifts together, gives each class its chance, and the weight with which the closure pulls.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rotavg_ros.solver.algebra.small_matrices import inverse_root
from rotavg_ros.solver.slam.noise.exceedance import exceedance
from rotavg_ros.solver.slam.poses.priors import PlacePriors
from rotavg_ros.solver.slam.posterior.densities import log_half_turn

# Classes of good closures, and of those of wrong places of their own; one more repeats another's.
_GOOD, _WRONG = 2, 6
_ELSEWHERE = _WRONG + 1
# In which errors are longer than a limit: in a plane, too, where that is a little too often.
_DIMENSIONS = 3
# What pulls least, of a good closure's weight: nothing, but the system stays solvable.
_NOTHING = 1e-8
_LOG_NOTHING = -1e6


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


@dataclass(frozen=True)
class Told:
    """What rotations alone say of C closures.

    Attributes:
        rotation_variance: ``(C,)`` rad² per component, of a good one's turn.
        false_odds: ``(C,)`` nats: density of the turn if it is false, and how likely that is beforehand.
        is_known: ``(C,)`` bool, whether a translation is stated.
        label: ``(C,)`` +1 if somebody has accepted it, −1 if rejected, 0 else.
        run: ``(C,)`` number of its run.
        own_share: ``(C,)`` share of its error's variance that it does not share with its run.
        follows: ``(C,)`` the closure before each, or -1.
        sign: ``(C,)`` +1 where it runs from its older to its newer end, else −1.
    """

    rotation_variance: np.ndarray
    false_odds: np.ndarray
    is_known: np.ndarray
    label: np.ndarray
    run: np.ndarray
    own_share: np.ndarray
    follows: np.ndarray
    sign: np.ndarray


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
        error, error_variance: ``(J, C)`` m and m² per component, of ε in each class: length of its mean, and variance.
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
    def rotation_good(self) -> np.ndarray:
        """``(C,)`` probability that a closure's rotation is no false one."""
        return np.asarray(1 - self.chance[-1])

    def false(self, metres: float) -> np.ndarray:
        """``(C,)`` probability that the rotation is false or a known translation errs by more than some metres."""
        beyond = [
            exceedance(length, variance, metres, _DIMENSIONS)
            for length, variance in zip(self.error, self.error_variance, strict=True)
        ]
        return np.asarray(self.chance[-1] + (self.chance[:-1] * np.array(beyond)).sum(axis=0))


@dataclass(frozen=True)
class Scale:
    """How far C closures err, m² per component.

    Attributes:
        good: ``(C,)`` each, if it is good.
        floor_share: ``(C,)`` the share of that which does not go with its length.
        extent: how far two places of the map are apart.
    """

    good: np.ndarray
    floor_share: np.ndarray
    extent: float

    @cached_property
    def closure(self) -> float:
        """A typical good one."""
        return float(np.median(self.good)) if len(self.good) else self.extent


@dataclass(frozen=True)
class Judge:
    """Tells the classes of all closures by what all else says of them.

    Attributes:
        told: what rotations alone say.
        turns: k.
        priors: of places.
        held: ``(C,)`` bool, which rotations are good; None: by their densities.
    """

    told: Told
    turns: int
    priors: PlacePriors
    held: np.ndarray | None = None

    def __call__(self, predictions: Predictions, before: np.ndarray, scale: Scale, *, in_order: bool = False) -> Places:
        """Classes under one choice of noise.

        Args:
            predictions: what all else says.
            before: ``(J + 1, C)`` chances as they were, for how common wrong places are.
            scale: of errors.
            in_order: given the closures before alone, so that densities multiply to that of all; else given all others.
        """
        k, told, known = self.turns, self.told, self.told.is_known
        seen_alike = told.rotation_variance + np.radians(self.priors.turned_deg) ** 2
        here = _given_turn(predictions, told.rotation_variance, k)
        elsewhere = _given_turn(predictions, seen_alike, k)
        spread = np.stack([here.spread] * _GOOD + [elsewhere.spread] * _ELSEWHERE)
        along = np.stack([here.along] * _GOOD + [elsewhere.along] * _ELSEWHERE)
        log_turn = np.stack([here.log_turn] * _GOOD + [elsewhere.log_turn] * _ELSEWHERE)
        variance = self._variances(scale)
        total = spread + variance[:, :, None]
        log_shift = -(along**2 / total + np.log(2 * np.pi * total)).sum(axis=2) / 2
        shift = told.sign[:, None] * predictions.mean[:, k:]
        repeats = _repeats(shift, before, told, scale.closure, in_order)
        log_shift[-1] = 0.0
        share = _wrong_share(before, told, self.priors)
        log_false = told.false_odds + np.where(known, self._log_unrelated(predictions, scale, repeats), 0.0)
        log_behind = _log_from_behind(predictions, seen_alike, k) + self._log_behind(predictions, scale, repeats)
        log_false = np.where(known, np.logaddexp(log_false, log_behind + np.log(share)), log_false)
        log_class = log_shift + self._log_classes(share, repeats)
        # Without a translation nothing tells of a place: a closure whose rotation is right is good.
        log_class[:, ~known] = _LOG_NOTHING
        log_class[0, ~known] = 0.0
        log_all = self._as_labelled(np.concatenate((log_turn + log_class, log_false[None])))
        log_density = _log_sum(log_all)
        chance = np.exp(log_all - log_density)

        each = chance[:-1, :, None]
        pull = (each / total).mean(axis=2).sum(axis=0)
        shrunk = (each * variance[:, :, None] / total).mean(axis=2).sum(axis=0) + chance[-1]
        right, alike = chance[:_GOOD].sum(axis=0), chance[_GOOD:-1].sum(axis=0)
        p = np.trace(predictions.covariance[:, :k, :k], axis1=1, axis2=2) / k
        turn_pull = right / (told.rotation_variance + p) + alike / (seen_alike + p)
        turn_shrunk = right / (1 + p / told.rotation_variance) + alike / (1 + p / seen_alike) + chance[-1]
        square, turn_total = (predictions.mean[:, :k] ** 2).sum(axis=1), told.rotation_variance + p
        turn_squares = right * square * told.rotation_variance / turn_total**2
        turn_freedom = right * k * told.rotation_variance / turn_total
        good, at_good = slice(_GOOD), each[:_GOOD] * known[:, None]
        own = variance[good, :, None] * np.stack((scale.floor_share, 1 - scale.floor_share))[:, None, :, None]
        axes = (1, 2, 3)
        return Places(
            chance,
            np.maximum(np.where(known, pull / shrunk, 0.0), _least_weight((shift**2).sum(axis=1), scale)),
            np.maximum(turn_pull / turn_shrunk, _NOTHING / told.rotation_variance),
            np.append(turn_squares.sum(), (at_good * own * along[good] ** 2 / total[good] ** 2).sum(axis=axes)),
            np.append(turn_freedom.sum(), (at_good * own / total[good]).sum(axis=axes)),
            log_density,
            np.sqrt(((variance[:, :, None] * along / total) ** 2).sum(axis=2)),
            (variance[:, :, None] * spread / total).mean(axis=2),
        )

    def nothing_known(self, is_good: np.ndarray, square: np.ndarray, scale: Scale) -> Places:
        """Before any solve: no translation pulls, rotations do as labelled, and as many places are wrong as may be.

        Args:
            is_good: ``(C,)`` labels.
            square: ``(C,)`` m², by what translations are off.
            scale: of errors.
        """
        count = len(is_good)
        chance = np.zeros((_GOOD + _ELSEWHERE + 1, count))
        wrong = self.priors.wrong_place / self.priors.counted
        chance[0], chance[_GOOD], chance[-1] = is_good * (1 - wrong), is_good * wrong, ~is_good
        none = np.zeros((_GOOD + _ELSEWHERE, count))
        turn = np.where(is_good, 1.0, _NOTHING) / self.told.rotation_variance
        return Places(
            chance,
            _least_weight(square, scale),
            turn,
            np.zeros(3),
            np.zeros(3),
            np.zeros(count),
            none,
            none,
        )

    def _variances(self, scale: Scale) -> np.ndarray:
        """``(J, C)`` m² per component, of ε in each class."""
        good = scale.good * self.told.own_share * np.array([[1.0], [self.priors.tail_ratio]])
        wrong = np.append(self._wrong(scale), scale.extent)
        return np.concatenate((good, np.broadcast_to(wrong[:, None], (_ELSEWHERE, good.shape[1]))))

    def _wrong(self, scale: Scale) -> np.ndarray:
        """m², from the least that a wrong place is off by to the map's extent."""
        least = min(self.priors.least_wrong**2 * scale.closure, scale.extent)
        return np.asarray(scale.extent * (least / scale.extent) ** np.linspace(1.0, 0.0, _WRONG))

    def _log_classes(self, share: np.ndarray, repeats: _Repeats) -> np.ndarray:
        """``(J, C)`` nats, of each class if the rotation is no false one.

        Args:
            share: ``(C,)`` of wrong places.
            repeats: of those before and after.
        """
        priors = self.priors
        right, wrong = np.log1p(-share), np.log(share)
        log_alone, log_repeat = self._log_repeats(repeats.alike, repeats)
        by_itself = wrong + log_alone + np.log1p(-priors.from_behind) - np.log(_WRONG)
        return np.stack(
            (
                right + np.log1p(-priors.tails),
                right + np.log(priors.tails),
                *[by_itself] * _WRONG,
                wrong + log_repeat,
            )
        )

    def _log_repeats(self, density: np.ndarray, repeats: _Repeats) -> tuple[np.ndarray, np.ndarray]:
        """``(C,)`` nats each: that a wrong place is no neighbour's; and that it is, with the density of its shift."""
        share = self.priors.repeats
        with np.errstate(divide="ignore"):
            return np.log1p(-share * repeats.chance), np.maximum(np.log(share * density), _LOG_NOTHING)

    def _log_anywhere(self, predictions: Predictions, scale: Scale) -> np.ndarray:
        """``(C,)`` nats, of shifts that lead anywhere on the map."""
        along, spread = _along_axes(predictions, self.turns)
        total = spread + scale.extent
        return np.asarray(-(along**2 / total + np.log(2 * np.pi * total)).sum(axis=1) / 2)

    def _log_behind(self, predictions: Predictions, scale: Scale, repeats: _Repeats) -> np.ndarray:
        """``(C,)`` nats, of shifts of closures that join wrong places, seen from the other side."""
        log_alone, log_repeat = self._log_repeats(repeats.turned, repeats)
        log_alone = log_alone + np.log(self.priors.from_behind) + self._log_anywhere(predictions, scale)
        return np.asarray(np.logaddexp(log_alone, log_repeat))

    def _log_unrelated(self, predictions: Predictions, scale: Scale, repeats: _Repeats) -> np.ndarray:
        """``(C,)`` nats, of shifts of closures whose rotation is false: wrong places, or the right one turned."""
        along, spread = _along_axes(predictions, self.turns)
        right = spread + (scale.good * self.told.own_share)[:, None]
        log_right = -(along**2 / right + np.log(2 * np.pi * right)).sum(axis=1) / 2
        share = self.priors.turned_in_place
        log_alone, log_repeat = self._log_repeats(repeats.turned, repeats)
        log_wrong = self._log_anywhere(predictions, scale)
        log_alone = log_alone + np.logaddexp(log_wrong + np.log1p(-share), log_right + np.log(share))
        return np.asarray(np.logaddexp(log_alone, log_repeat))

    def _as_labelled(self, log_all: np.ndarray) -> np.ndarray:
        """Without the classes that somebody's label, or that of rotations, rules out."""
        accepted = self.told.label > 0
        is_good = accepted if self.held is None else self.held
        is_false = self.told.label < 0 if self.held is None else ~self.held
        log_all[-1, is_good] = _LOG_NOTHING
        log_all[:-1, is_false] = _LOG_NOTHING
        log_all[_GOOD:, accepted & self.told.is_known] = _LOG_NOTHING
        return log_all


def _log_sum(logarithms: np.ndarray) -> np.ndarray:
    """``(n,)`` log of sums over the first axis, of numbers that are finite."""
    largest = logarithms.max(axis=0)
    return np.asarray(largest + np.log(np.exp(logarithms - largest).sum(axis=0)))


def _least_weight(square: np.ndarray, scale: Scale) -> np.ndarray:
    """``(C,)`` m⁻², of closures that are off by ``square`` m²: however far that is, they pull next to nothing."""
    return np.asarray(_NOTHING / (scale.closure + square))


@dataclass(frozen=True)
class _GivenTurn:
    """What all else and a closure's turn say of its shift, along axes of their own.

    Attributes:
        log_turn: ``(C,)`` nats, of the turn.
        along: ``(C, m)`` metres, mean.
        spread: ``(C, m)`` m², variance.
    """

    log_turn: np.ndarray
    along: np.ndarray
    spread: np.ndarray


def _given_turn(predictions: Predictions, variance: np.ndarray, turns: int) -> _GivenTurn:
    """With the variance ``(C,)`` of the turn's own noise, rad²."""
    k, mean, covariance = turns, predictions.mean, predictions.covariance
    turn = covariance[:, :k, :k] + variance[:, None, None] * np.eye(k)
    root = inverse_root(turn)
    whitened, across = np.matmul(root, mean[:, :k, None]), np.matmul(root, covariance[:, :k, k:])
    explained = across.transpose(0, 2, 1)
    log_turn = np.log(np.diagonal(root, axis1=1, axis2=2) / np.sqrt(2 * np.pi)).sum(axis=1)
    log_turn -= (whitened[:, :, 0] ** 2).sum(axis=1) / 2
    given = mean[:, k:] - np.matmul(explained, whitened)[:, :, 0]
    spread, axes = np.linalg.eigh(covariance[:, k:, k:] - np.matmul(explained, across))
    return _GivenTurn(log_turn, np.matmul(axes.transpose(0, 2, 1), given[:, :, None])[:, :, 0], np.maximum(spread, 0.0))


def _along_axes(predictions: Predictions, turns: int) -> tuple[np.ndarray, np.ndarray]:
    """``(C, m)`` metres and m² of shifts along the axes of their covariances, whatever the turns."""
    spread, axes = np.linalg.eigh(predictions.covariance[:, turns:, turns:])
    along = np.matmul(axes.transpose(0, 2, 1), predictions.mean[:, turns:, None])[:, :, 0]
    return along, np.maximum(spread, 0.0)


def _log_from_behind(predictions: Predictions, variance: np.ndarray, turns: int) -> np.ndarray:
    """``(C,)`` nats, of turns that are half a turn off but for noise of ``variance`` ``(C,)`` rad²."""
    spread = np.trace(predictions.covariance[:, :turns, :turns], axis1=1, axis2=2) / turns
    angle = np.minimum(np.sqrt((predictions.mean[:, :turns] ** 2).sum(axis=1)), np.pi)
    return log_half_turn(angle, variance + spread, turns)


def _wrong_share(before: np.ndarray, told: Told, priors: PlacePriors) -> np.ndarray:
    """``(C,)`` how likely each is to join wrong places, by all others and by its run most (Beta, Bernoulli)."""
    wrong = before[_GOOD:-1].sum(axis=0) * told.is_known
    any_one = (1 - before[-1]) * told.is_known
    overall = (wrong.sum() + priors.wrong_place) / (any_one.sum() + priors.counted)
    in_run, of_run = np.bincount(told.run, wrong)[told.run] - wrong, np.bincount(told.run, any_one)[told.run] - any_one
    return np.asarray(np.clip((overall + in_run) / (1 + of_run), _SHARE, 1 - _SHARE))


@dataclass(frozen=True)
class _Repeats:
    """Of C closures, by the ones before and after.

    Attributes:
        chance: ``(C,)`` that such a one joins wrong places.
        alike, turned: ``(C,)`` densities of each one's shift if it is such a one's, where that is seen nearly at the
            right angle, and where not; times the chances of these.
    """

    chance: np.ndarray
    alike: np.ndarray
    turned: np.ndarray


def _repeats(mean: np.ndarray, before: np.ndarray, told: Told, closure_variance: float, in_order: bool) -> _Repeats:
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

    alike, turned = before[_GOOD:-1].sum(axis=0), before[-1]
    ones = np.ones(len(later))
    return _Repeats(mean_over(alike + turned, ones), mean_over(alike, density), mean_over(turned, density))


# Squared widths of what repeats differ by, in those of two good closures.
_KERNELS = np.array([1.0, 16.0, 256.0])
# No share is less than this, or nearer to one.
_SHARE = 0.01
